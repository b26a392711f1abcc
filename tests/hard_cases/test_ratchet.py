"""No bundled model becomes worse in a hard case by more than noise."""

from __future__ import annotations

from pathlib import Path

import pytest

from sdfsim.evaluation.stress import slipped_back, stress

RATCHET = Path(__file__).resolve().parents[2] / "benchmarks" / "hard_cases_ratchet.json"


@pytest.mark.slow
def test_no_bundled_model_is_worse_than_was_accepted(tmp_path):
    assert RATCHET.exists(), "write it: python benchmarks/hard_cases.py -o DIR --quick"
    assert slipped_back(stress(tmp_path, quick=True), RATCHET) == []
