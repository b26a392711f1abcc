"""The faults of `scripts/seeded_faults.py` fit the source as it is. The script itself takes minutes: run it by hand."""

import runpy
from collections import Counter
from pathlib import Path

from sdfsim.evaluation.laws.table import laws

ROOT = Path(__file__).resolve().parents[2]
SOLVER = ROOT / "sdfsim" / "physics" / "solver"
FAULTS = runpy.run_path(str(ROOT / "scripts" / "seeded_faults.py"))["FAULTS"]


def test_each_fault_replaces_what_is_there_once_and_names_laws_of_the_table():
    assert len(FAULTS) >= 20 and max(Counter(one.name for one in FAULTS).values()) == 1
    known = {law.name for law in laws()}
    for one in FAULTS:
        text = (SOLVER / one.file).read_text(encoding="utf-8")
        for right, wrong in one.edits:
            assert text.count(right) == 1 and right != wrong, one.name
        assert set(one.laws.split()) <= known, one.name
