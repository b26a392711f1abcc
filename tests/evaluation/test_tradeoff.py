"""The trade-off study: what variants change, what a scene becomes, and the whole study in small."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")

from sdfsim.base.errors import SdfsimError
from sdfsim.evaluation import tradeoff as study
from sdfsim.evaluation.tradeoff import Variant, arranged, load_cases
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf


@pytest.fixture(scope="module")
def cases(cube_data):
    return load_cases(cube_data, quick=True)


def test_networks_and_shapes_are_what_a_setting_says(cases):
    box = with_sdf(analytic_shape("box", size=(1.0, 0.6, 0.4)), "grid", resolution=48)
    cases = replace(cases, shapes={"box": box, "ball": analytic_shape("sphere", radius=0.5)})
    few = arranged(Variant("solver", nodes="thin 10"), cases)["box"].nodes
    # Outermost first: of a box, the eight corners are among them.
    assert len(few) == 10 and (np.abs(np.abs(few) - [0.5, 0.3, 0.2]).max(1) < 1e-9).sum() == 8
    grid = arranged(Variant("solver", nodes="grid 6"), cases)["box"].nodes
    assert 8 <= len(grid) <= 6**3 and np.abs(np.asarray(box.sdf(grid)[0])).max() < 0.01


def test_the_whole_study_in_small(cube_data, tmp_path, monkeypatch):
    chosen = [Variant("solver"), Variant("gnn", nodes="thin 20"), Variant("solver", contact=False)]
    monkeypatch.setattr(study, "variants", lambda *_, **__: chosen)
    monkeypatch.setattr(study, "REPEATS", 2)
    monkeypatch.setattr(study, "MOST_QUICK", 1)
    monkeypatch.setattr(study, "INNER_QUICK", {"PyBullet": (5,), "MuJoCo": (5,)})

    def absent(*_, **__):
        raise SdfsimError("MuJoCo is not installed")

    before = torch.get_num_threads()

    def run():
        return study.tradeoff(cube_data, tmp_path, quick=True, engines={"MuJoCo": absent}, on_progress=lambda *_: None)

    report = run()
    by_label = {p["label"]: p for p in report["points"]}
    error = {label: p["translation_rmse"]["50"] for label, p in by_label.items() if "failed" not in p}
    assert set(error) == {"solver", "gnn, nodes thin 20", "ballistic", "PyBullet 4 ms", study.FLOOR_LABEL}
    assert error["PyBullet 4 ms"] < 1e-6, "the teacher repeats itself"
    assert error["solver"] < 0.5 * error["ballistic"] and by_label["solver"]["ms"] > by_label["PyBullet 4 ms"]["ms"] / 9
    assert set(report["front"]) <= {"solver", "gnn, nodes thin 20"} and report["front"]
    assert torch.get_num_threads() == before
    rows = list(csv.DictReader((tmp_path / "tradeoff.csv").read_text().splitlines()))
    assert len(rows) == 6 and float(rows[0]["translation_rmse_50"]) == pytest.approx(error["solver"], rel=1e-4)
    assert (tmp_path / "tradeoff.png").stat().st_size > 500
    assert json.loads((tmp_path / "report.json").read_text())["front"] == report["front"]
    table, notes = study.report_table(report)
    assert len(table) == 7 and any("front of ours" in note for note in notes)
    monkeypatch.setattr(study, "measure_ours", lambda *_: pytest.fail("measured again"))
    assert run()["points"] == report["points"]
