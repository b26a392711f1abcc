"""The command line from outside: exit codes, one line an error, one JSON object, run folders; commands that break or
are broken off."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import cli
from sdfsim import Rollout, SdfsimError, load_scene
from sdfsim.apps import about
from sdfsim.apps import run as runs
from sdfsim.base.arguments import seconds_of
from sdfsim.base.errors import run_main
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh_io import write_ply
from tests.helpers.command import SCENE, run

ROOT = Path(__file__).resolve().parents[2]


def test_simulate_leaves_a_run_folder_and_says_how_to_watch_it(scene, model, tmp_path):
    out = tmp_path / "run"
    done = run("simulate", scene, "-o", out, "--model", model, "--seconds", 0.1, "--seed", 3)
    assert done.exit_code == 0, done.stderr
    assert sorted(p.name for p in out.iterdir()) == ["config.yaml", "report.json", "rollout.npz", "rollout.rrd"]
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert config["seconds"] == 0.1 and config["seed"] == 3 and config["model"] == model
    assert f"sdfsim view {out}   (or: rerun {out / 'rollout.rrd'})" in done.stdout
    rollout, report = Rollout.load(out / "rollout.npz"), json.loads((out / "report.json").read_text())
    assert len(rollout) == report["steps"] and report["status"] == "done" and report["finite"]
    fallen = 5 - 0.5 * 9.81 * rollout.time**2
    np.testing.assert_allclose(rollout.position[:, 1, 2], fallen, atol=1e-9)


def test_a_run_that_breaks_a_law_says_so_in_its_last_line(tmp_path, scene):
    """Two boxes that start in each other, which no solver can have kept apart; and nothing of the kind for the ball."""
    done = run("simulate", scene, "-o", tmp_path / "fall", "--seconds", 0.1)
    assert "breaks a law" not in done.stdout
    boxes = SCENE.replace("sphere: {radius: 0.5}", "box: {size: [1, 1, 1]}")
    boxes += "  - {name: other, shape: ball, position: [0.5, 0, 5.02]}\n"
    (tmp_path / "boxes.yaml").write_text(boxes)
    done = run("simulate", tmp_path / "boxes.yaml", "-o", tmp_path / "run", "--seconds", 0.05)
    laws = json.loads((tmp_path / "run" / "report.json").read_text())["broken_laws"]
    assert done.stdout.splitlines()[-1] == f"breaks a law: {laws[-1]}"
    assert laws[0].startswith("overlap: 'ball' and 'other' are 0.")


def test_a_second_run_replaces_the_first(scene, model, tmp_path):
    assert run("simulate", scene, "-o", tmp_path / "run", "--model", model, "--seconds", 0.1).exit_code == 0
    done = run("simulate", scene, "-o", tmp_path / "run", "--model", model, "--seconds", 0.1, "--viewer", "none")
    assert done.exit_code == 0
    assert not (tmp_path / "run" / "rollout.rrd").exists()
    assert done.stderr.count(f"replaced the earlier run in {tmp_path / 'run'}\n") == 1
    done = run("simulate", scene, "-o", tmp_path / "run", "--model", model, "--seconds", 0.1, "--resume")
    assert done.exit_code == 0 and f"{tmp_path / 'run'}: finished already\n" in done.stderr


def test_json_is_one_object_and_nothing_else(scene, model, tmp_path):
    for arguments in (
        ("simulate", scene, "-o", tmp_path / "run", "--model", model, "--seconds", 0.1),
        ("plan", scene, "--model", model),
        ("info",),
        ("plan", tmp_path / "missing.yaml"),
    ):
        done = run(*arguments, "--json")
        assert isinstance(json.loads(done.stdout), dict), done.stdout
        assert done.stdout.count("\n") == 1


def test_json_keeps_native_output_off_stdout(scene, model, tmp_path, monkeypatch, capfd):
    real = runs.simulate

    def noisy(*arguments, **options):
        os.write(1, b"from C\n")
        print("from Python")
        return real(*arguments, **options)

    monkeypatch.setattr(runs, "simulate", noisy)
    with pytest.raises(SystemExit) as end:
        cli.app(["simulate", scene, "-o", str(tmp_path / "run"), "--model", model, "--json"])
    told = capfd.readouterr()
    assert end.value.code == 0, told.err
    assert json.loads(told.out)["steps"] > 0
    assert "from C" in told.err and "from Python" in told.err


@pytest.mark.parametrize("command", ["simulate", "plan"])
def test_a_bad_scene_is_one_line_and_code_1(tmp_path, command):
    file = tmp_path / "scene.yaml"
    file.write_text(SCENE.rstrip().removesuffix("}") + ", mass: -0.3}\n")
    told = f"{file}:8: bodies[1].mass: must be > 0 (got -0.3 kg)"
    done = run(command, file, *(["-o", tmp_path / "run"] if command == "simulate" else []))
    assert done.exit_code == 1
    assert done.stderr == f"error: {told}\n" and done.stdout == ""
    assert not (tmp_path / "run").exists()
    answer = json.loads(run("plan", file, "--json").stdout)
    assert answer["exit_code"] == 1 and answer["problems"] == [told]


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate",),
        ("simulate", "scene.yaml", "-o", "run", "--seconds", "-1"),
        ("reconstruct", "photos", "-o", "out", "--budget", "soon"),
        ("reconstruct", "photos", "-o", "out", "--from", "dessert"),
        ("fit", "mesh.obj"),
        ("fit", ".", "--cap"),
        ("nonsense",),
    ],
)
def test_wrong_usage_is_code_2(arguments):
    done = run(*arguments)
    assert done.exit_code == 2 and "rror" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("simulate", "{scene}", "-o", "{run}", "--model", "gigantic"), "'gigantic'"),
        (("simulate", "{scene}", "-o", "{scene}/run", "--model", "{model}"), "{scene}"),
        (("reconstruct", "{run}", "-o", "{run}/out"), "{run}"),
        (("fit", "{run}.obj", "-o", "{run}"), "no such mesh file"),
        (("fit", "{mesh}", "-o", "{scene}/shape"), "{scene}/shape: cannot be written"),
        (("view", "{run}.rrd"), "no such recording"),
        (("simulate", "{mesh}", "-o", "{run}"), "mesh.ply: a mesh is not a scene"),
        (("export", "{mesh}", "-o", "{run}.glb"), "mesh.ply: not a run folder"),
        (("evaluate", "{run}", "--model", "{model}"), "{run}"),
        (("train", "--data", "{run}", "-o", "{run}/out"), "{run}"),
    ],
)
def test_bad_input_is_one_line_and_code_1(scene, model, tmp_path, arguments, told):
    (tmp_path / "mesh.ply").write_bytes(write_ply(primitives.box()))
    names = {"scene": scene, "model": model, "run": str(tmp_path / "run"), "mesh": str(tmp_path / "mesh.ply")}
    done = run(*(a.format(**names) for a in arguments))
    lines = done.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert done.exit_code == 1 and len(errors) == 1, done.stderr
    assert told.format(**names) in errors[0] and "Traceback" not in done.stderr


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="/dev/full, a disk that is always full, exists on Linux only"
)
def test_a_report_that_cannot_be_written_is_one_line():
    command = [sys.executable, "-c", "import cli; cli.app()", "info", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: the report cannot be written: No space left on device\n"


@pytest.mark.parametrize(
    "wrong", [("--model", "gigantic"), ("--device", "cuda"), ("--viewer", "native")], ids=lambda option: option[0]
)
def test_what_is_wrong_from_the_start_is_reported_before_work_and_deletes_nothing(
    scene, model, tmp_path, monkeypatch, wrong
):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("sdfsim.apps.run.load_scene", lambda *a, **k: pytest.fail("worked first"))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "report.json").write_text("{}")
    done = run("simulate", scene, "-o", tmp_path / "run", "--model", model, *wrong)
    assert done.exit_code == 1 and done.stderr.startswith("error: "), done.stderr
    assert (tmp_path / "run" / "report.json").read_text() == "{}"


def test_a_fit_that_missed_its_certificate_is_code_3_and_the_run_still_whole(scene, model, tmp_path, monkeypatch):
    real = load_scene
    missed = ("ball: thin walls",)
    for module in ("run", "plan"):
        monkeypatch.setattr(f"sdfsim.apps.{module}.load_scene", lambda *a, **k: replace(real(*a, **k), missed=missed))
    done = run("simulate", scene, "-o", tmp_path / "run", "--model", model)
    assert done.exit_code == 3 and "failed check: fit of shape ball: thin walls" in done.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["status"] == "done" and report["failed_checks"] == ["fit of shape ball: thin walls"]
    done = run("plan", scene, "--model", model)
    assert done.exit_code == 0 and "failed check: fit of shape ball: thin walls" in done.stderr


@pytest.mark.parametrize("option", ["--json", "--device", "--verbose"])
def test_every_command_takes_the_common_options(option):
    commands = [c.name or c.callback.__name__ for c in cli.app.registered_commands if c.callback]
    assert "reconstruct" in commands and "identify" in commands
    for command in commands:
        assert option in run(command, "--help").stdout, command


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10m", 600), ("1h", 3600), ("45", 45), ("1.5m", 90)])
def test_budgets(text, seconds):
    assert seconds_of(text) == seconds


def test_the_version_is_the_package_s():
    import sdfsim

    assert run("--version").stdout == f"sdfsim {sdfsim.__version__}\n"


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


def test_extras_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    extras = {name: {re.split(r"[<>=]", one)[0] for one in listed} for name, listed in optional.items()}
    for package, (extra, _) in about.EXTRAS.items():
        assert package in extras[extra]
    known = {re.split(r"[<>=]", one)[0] for one in project["dependencies"]}
    assert set(about.NEEDED) <= known


def test_what_is_not_installed_is_told_with_what_it_is_for(monkeypatch):
    real = metadata.version

    def version(name: str) -> str:
        if name in ("usd-core", "mujoco", "xatlas", "pi-heif"):
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(metadata, "version", version)
    report = json.loads(run("info", "--json").stdout)
    assert report["versions"]["usd-core"] == "missing" and report["versions"]["torch"] == real("torch")
    told = [line for line in report["missing"] if "pip install" in line]
    assert told == [
        "pi-heif: pip install pi-heif",
        "xatlas: pip install xatlas",
        "usd-core, for export of .usd: pip install 'sdfsim[export]'",
        "mujoco, for import of MJCF, and comparisons with MuJoCo: pip install 'sdfsim[export]'",
    ]
    shown = run("info").stdout
    assert all(f"not here: {line}" in shown for line in told) and "usd-core missing" not in shown


@pytest.mark.parametrize(
    ("why", "told"),
    [
        ("libGL.so.1: cannot open shared object file", "libGL.so.1, which open3d loads: apt-get install libgl1"),
        ("libusb-1.0.so.0: cannot open", "libusb-1.0.so.0, which open3d loads: apt-get install libusb-1.0-0"),
        ("DLL load failed\nwhile importing", "open3d does not load: DLL load failed while importing"),
    ],
)
def test_a_library_of_the_system_that_is_missing_is_named_with_its_package(why, told):
    assert about._unloaded("open3d", why) == told


def test_the_systems_libraries_are_those_that_the_set_up_installs():
    text = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    pairs = dict(pair.split(":") for pair in re.findall(r"lib[\w.+-]+\.so[\w.]*:[\w.+-]+", text))
    assert about.LIBRARIES.items() <= pairs.items()


def test_info_goes_on_where_a_package_does_not_load():
    code = (
        "import sys; sys.modules['open3d'] = None\nfrom sdfsim.apps.about import about\n"
        "print(*[line for line in about()['missing'] if 'open3d' in line])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("open3d does not load")
