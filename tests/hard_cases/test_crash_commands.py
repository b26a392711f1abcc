"""Killed at any moment: nothing torn under its final name, and the same command afterwards ends as if undisturbed."""

import random
import resource
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tests.hard_cases.crashing import NEVER, Ended, Moment, Work, call, litter, whole

FEW, MANY = 2, 24
COMMANDS = ["fit", "simulate", "train", "reconstruct"]
ONE_FAST = [
    pytest.param(n, marks=pytest.mark.slow) if n != "simulate" else n for n in COMMANDS
]  # each has its kills among the fast tests


def kill_and_resume(work: Work, folder: Path, moments: list[Moment], expected: dict) -> None:
    """Kill one run at each of the moments in turn, then let it end."""
    for moment in moments:
        ended = call(work, folder, moment, *work.again)
        stopped = (130,) if moment.how == signal.SIGINT else (-signal.SIGKILL, -signal.SIGPROF)
        assert ended.code in (*stopped, work.code), ended.said
        whole(folder)
    ended = call(work, folder, NEVER, *work.again)
    assert ended.code == work.code, ended.said
    whole(folder)
    assert litter(folder) == []
    assert work.result(folder) == expected


def moments(ended: Ended, count: int, seed: int) -> list[Moment]:
    """Half of them before a change of the file system, half anywhere in the time that the work takes."""
    rng = random.Random(seed)
    changes = [Moment(change=rng.randint(1, ended.changes)) for _ in range(count // 2)]
    return changes + [Moment(seconds=rng.uniform(0.01, ended.seconds)) for _ in range(count - count // 2)]


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_goes_on(works, undisturbed, tmp_path, name, count):
    """The few moments one after the other in one folder, so that it is also killed while it goes on."""
    ended, expected = undisturbed(name)
    chosen = moments(ended, count, seed=count)
    for number, some in enumerate([chosen] if count == FEW else [[moment] for moment in chosen]):
        kill_and_resume(works[name], tmp_path / str(number) / name, some, expected)


@pytest.mark.parametrize("name", ONE_FAST)
def test_ctrl_c_keeps_what_was_finished(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    work, folder = works[name], tmp_path / name
    stopped = call(work, folder, Moment(change=max(3, ended.changes // 2), how=signal.SIGINT), *work.again)
    assert stopped.code == 130 and "interrupted; finished work is kept" in stopped.said
    assert "Traceback" not in stopped.said
    whole(folder)
    kept = {
        "fit": ".",  # it starts over
        "simulate": "rollout.npz",
        "train": "checkpoint.npz",
        "reconstruct": "photos/stage.json",
    }[name]
    assert (folder / kept).exists()
    kill_and_resume(work, folder, [], expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_at_any_moment_changes_nothing_in_the_end(works, undisturbed, tmp_path, name):
    ended, expected = undisturbed(name)
    rng = random.Random(4)
    for number in range(MANY // 2):
        moment = Moment(seconds=rng.uniform(0.3, 0.9) * ended.seconds, how=signal.SIGINT)
        kill_and_resume(works[name], tmp_path / str(number) / name, [moment], expected)


def limit_files(prepare) -> None:
    """Writing past 4,000 bytes of a file fails."""
    prepare()
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))


@pytest.mark.parametrize("name", ONE_FAST[:-1])
def test_files_that_may_not_grow_are_told(works, undisturbed, tmp_path, name):
    work, (_, expected), folder = works[name], undisturbed(name), tmp_path / name
    ended = call(replace(work, prepare=partial(limit_files, work.prepare)), folder, NEVER, *work.again)
    assert ended.code == 1 and "File too large" in ended.said and "Traceback" not in ended.said, ended.said
    errors = [line for line in ended.said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and str(folder) in errors[0] and "internal" not in errors[0]
    if folder.exists():
        whole(folder)
    ended = call(work, folder, NEVER, *work.again)
    assert ended.code == work.code, ended.said
    assert litter(folder) == [] and work.result(folder) == expected
