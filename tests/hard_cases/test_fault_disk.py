"""Files that cannot be written to their end: one clear line, nothing torn, and the same command goes on afterwards."""

import resource
from dataclasses import replace
from functools import partial

import pytest

from tests.hard_cases.crashing import NEVER, call, litter, whole


def limit_files(prepare) -> None:
    """Writing past 4,000 bytes of a file fails."""
    prepare()
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))


@pytest.mark.parametrize("name", ["fit", "simulate", "train"])
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
