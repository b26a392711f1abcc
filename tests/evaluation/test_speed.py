"""The ratios of two timings that the repository keeps: none may slip back."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("pybullet")

from benchmarks.contact_step import LEAST, RATCHET, slipped_back
from sdfsim.base.files import read_json

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_no_ratio_of_timings_slips_back():
    command = [sys.executable, "-m", "benchmarks", "contact_step", "--check"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_a_ratio_that_grew_by_half_is_reported():
    kept = read_json(RATCHET)
    slower = {name: 1.5 * max(ratio, LEAST) for name, ratio in kept.items()}
    assert slipped_back(kept, kept) == [] and len(slipped_back(slower, kept)) == len(kept) >= 5
