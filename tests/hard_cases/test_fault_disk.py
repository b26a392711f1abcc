"""A full disk: one clear line, nothing torn, and the same command goes on once there is room."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.hard_cases import crashing
from tests.hard_cases.crashing import NEVER, Work, call, litter, whole


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system in memory of 64 KiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", place], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"a full disk is made by mounting a small one, which needs root: {mounted.stderr.decode().strip()}")
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def check_told(work: Work, folder: Path, why: str) -> None:
    ended = call(work, folder, NEVER, *work.again)
    assert ended.code == 1 and why in ended.said, ended.said
    errors = [line for line in ended.said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and str(folder) in errors[0] and "internal" not in errors[0]
    assert "Traceback" not in ended.said
    if folder.exists():
        whole(folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fit", "simulate", "train"])
def test_a_full_disk_is_told_and_the_run_goes_on_when_there_is_room(works, undisturbed, small_disk, name):
    work, (_, expected) = works[name], undisturbed(name)
    folder, disk = small_disk / name, os.statvfs(small_disk)
    (small_disk / "filler").write_bytes(bytes((disk.f_bavail - 1) * disk.f_bsize))
    check_told(work, folder, "No space left on device")
    subprocess.run(["mount", "-o", "remount,size=16m", small_disk], check=True)
    ended = call(work, folder, NEVER, *work.again)
    assert ended.code == work.code, ended.said
    assert litter(folder) == [] and work.result(folder) == expected


@pytest.mark.parametrize("name", ["fit", "simulate", "train"])
def test_files_that_may_not_grow_are_told(works, undisturbed, tmp_path, name):
    work, (_, expected) = works[name], undisturbed(name)
    check_told(replace(work, prepare=SMALL[name]), tmp_path / name, "File too large")
    ended = call(work, tmp_path / name, NEVER, *work.again)
    assert ended.code == work.code, ended.said
    assert litter(tmp_path / name) == [] and work.result(tmp_path / name) == expected


def limit_files() -> None:
    """Writing past 4,000 bytes of a file fails."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))


def small_fit() -> None:
    crashing.tiny_fit()
    limit_files()


def small_simulate() -> None:
    crashing.tiny_simulate()
    limit_files()


def small_train() -> None:
    crashing.tiny_train()
    limit_files()


SMALL = {"fit": small_fit, "simulate": small_simulate, "train": small_train}
