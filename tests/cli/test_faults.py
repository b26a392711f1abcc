"""Commands that break or are broken off: exit codes, what is told, and what is kept."""

import signal
from functools import partial

import pytest

from sdfsim import SdfsimError
from sdfsim.base.errors import run_main
from tests.helpers.command import run


def test_an_interrupt_that_a_library_turns_into_another_error_is_code_130_too(scene, monkeypatch):
    def interrupted(*_, **__):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise TypeError("half imported") from None

    monkeypatch.setattr("sdfsim.apps.plan.describe", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background shells have it ignored
    try:
        done = run("plan", scene)
        assert (done.exit_code, "internal" in done.stderr) == (130, False), done.stderr
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_tracebacks_only_with_v(scene, monkeypatch):
    def fail(*arguments, **options):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("sdfsim.apps.plan.describe", fail)
    plain, verbose = run("plan", scene), run("plan", scene, "-v")
    assert plain.exit_code == verbose.exit_code == 1
    assert "internal error: ZeroDivisionError" in plain.stderr and "Traceback" not in plain.stderr
    assert "Traceback" in verbose.stderr


def test_scripts_say_the_same_and_end_with_the_same_codes(capsys):
    def fail(error: BaseException):
        raise error

    failed = SdfsimError("what is wrong", "what to try", exit_code=3)
    for error, code in ((failed, 3), (SdfsimError("no hint"), 1), (KeyboardInterrupt(), 130)):
        with pytest.raises(SystemExit) as end:
            run_main(partial(fail, error))
        assert end.value.code == code
    assert capsys.readouterr().err == "error: what is wrong\nhint: what to try\nerror: no hint\n"
    run_main(lambda: None)


@pytest.mark.parametrize(
    "words",
    [
        ("render", "MISSING", "-o", "x.png"),
        ("identify", "MISSING.csv", "--scene", "SCENE"),
        ("train", "--data", "MISSING", "-o", "x"),
        ("import", "MISSING.urdf", "-o", "x.yaml"),
        ("simulate", "MISSING.yaml", "-o", "x"),
        ("export", "MISSING", "-o", "x.glb"),
        ("view", "MISSING"),
    ],
    ids=lambda words: words[0],
)
def test_what_is_not_there_is_told_in_plain_words_with_what_to_give(scene, tmp_path, words):
    named = {"MISSING": str(tmp_path / "missing"), "SCENE": str(scene)}
    given = [named.get(word, word.replace("MISSING", named["MISSING"])) for word in words]
    done = run(*given)
    told, *rest = done.stderr.strip().splitlines()
    assert done.exit_code == 1 and told.startswith(f"error: {named['MISSING']}") and told.count(named["MISSING"]) == 1
    assert "Errno" not in told and " no such " in told
    assert len(rest) == 1 and rest[0].startswith("hint: ")
