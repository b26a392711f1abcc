"""No bundled model becomes worse in a hard case by more than noise."""

import pytest

from benchmarks.hard_cases import RATCHET, slipped_back
from sdfsim.apps.stress import stress


@pytest.mark.slow
def test_no_bundled_model_is_worse_than_was_accepted(tmp_path):
    assert RATCHET.exists(), "write it: python -m benchmarks hard_cases -o DIR --quick"
    assert slipped_back(stress(tmp_path, quick=True), RATCHET) == []
