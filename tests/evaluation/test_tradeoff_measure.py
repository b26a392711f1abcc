"""Measuring goes on where it was, keeps failures as points, and its page needs nothing beside it."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from sdfsim.data.dataset import Trajectory
from sdfsim.errors import SdfsimError
from sdfsim.evaluation import tradeoff as study
from sdfsim.evaluation.tradeoff import Sweep, claims, clearly
from sdfsim.evaluation.tradeoff_cases import Cases, load_cases
from sdfsim.evaluation.tradeoff_contenders import Timed
from sdfsim.evaluation.tradeoff_engines import Engine
from sdfsim.evaluation.tradeoff_knobs import Setting
from sdfsim.evaluation.tradeoff_measure import REPEATS, judged, measure
from sdfsim.evaluation.tradeoff_picture import draw
from sdfsim.evaluation.tradeoff_report import write_report
from sdfsim.evaluation.tradeoff_told import table

CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
SIDES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
CUBE = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in SIDES
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A dataset of three trajectories of cubes whose distances are a closed form."""
    pytest.importorskip("pybullet")
    from sdfsim.data.generate import make_dataset
    from sdfsim.shape.shape import analytic_shape

    meshes, out = tmp_path_factory.mktemp("meshes"), tmp_path_factory.mktemp("data")
    (meshes / "cube").mkdir()
    (meshes / "cube" / "visual_geometry.obj").write_text(CUBE)
    (meshes / "cube" / "collision_geometry.obj").write_text("o piece\n" + CUBE)
    analytic_shape("box", size=(1.0, 1.0, 1.0), name="cube").save(out / "shapes" / "cube")
    make_dataset("movi-b", out, shapes=meshes, trajectories=3, seed=1, split="test")
    return out


@pytest.fixture(scope="module")
def cases(data, tmp_path_factory) -> Cases:
    return load_cases(data, tmp_path_factory.mktemp("scratch"), quick=True)


@dataclass
class Fake:
    """A contender that shifts the recording, or does what a test tells it to."""

    key: str
    shift: float = 0.01
    fault: str = ""
    kind: str = "ours"
    cpu: float = 0.5
    one_core: bool = True
    calls: list[str] = field(default_factory=list)
    cases: Cases | None = None

    @property
    def label(self) -> str:
        return self.key.replace("__", ", ")

    def describe(self) -> dict:
        return {"setting": Setting().to_json(), "shift": self.shift}

    def prepare(self, cases: Cases) -> Fake:
        self.calls.append("prepare")
        self.cases = cases
        if self.fault == "prepare":
            raise SdfsimError("cannot be prepared")
        return self

    def fitted_s(self) -> float | None:
        return None

    def motions(self) -> list[Trajectory]:
        assert self.cases is not None
        self.calls.append("motions")
        far = {"nan": np.nan, "explode": 1e4}.get(self.fault, self.shift)
        offset = np.array([far, 0.0, far if self.fault else 0.0])
        moved = [t.position + offset * (np.arange(len(t.position)) > 0)[:, None, None] for t in self.cases.recorded]
        return [replace(t, position=p) for t, p in zip(self.cases.recorded, moved, strict=True)]

    def timed(self) -> Timed:
        self.calls.append("timed")
        if self.fault == "wander":
            return Timed(1.0, self.cpu, 0.5, 9.0, np.full((2, 3), 1e-3 * len(self.calls)), [{"bodies": 2.0, "ms": 1.0}])
        return Timed(1.0, self.cpu, 0.5, 9.0, np.zeros((2, 3)), [{"bodies": 2.0, "nodes": 9.0, "ms": 1.0}])


def quietly(*_: object) -> None:
    pass


def test_errors_and_times_are_those_of_the_motions(cases, tmp_path):
    (point,) = measure([Fake("a", shift=0.03)], cases, tmp_path, quietly)
    assert point["errors"]["50"]["translation_rmse"] == pytest.approx(0.03)
    assert point["errors"]["50"]["rotation_error"] == pytest.approx(0.0, abs=1e-5)
    assert point["ms"]["median"] == pytest.approx(1000.0) and point["busy"] == pytest.approx(2.0)
    shared = measure([Fake("b", one_core=False)], cases, tmp_path, quietly)[0]
    assert shared["ms"]["median"] == pytest.approx(2000.0)  # by the clock where threads or a device take part


def test_errors_are_told_in_the_scene_s_own_metres(cases):
    fake = Fake("a", shift=0.03).prepare(replace(cases, length=0.1))
    found = judged(fake.motions(), fake.cases)
    assert found["errors"]["50"]["translation_rmse"] == pytest.approx(0.003)


def test_failures_are_points_that_say_why(cases, tmp_path):
    faults = [Fake(name, fault=name) for name in ("prepare", "nan", "explode", "wander")]
    points = measure([*faults, Fake("fine")], cases, tmp_path, quietly)
    told = {p["key"]: p["failed"] for p in points}
    assert told["prepare"] == "cannot be prepared" and told["nan"] == "a state is not finite"
    assert "times its energy" in told["explode"] and "repeats end" in told["wander"] and told["fine"] == ""
    assert len(points) == 5 and all((tmp_path / f"{name}.json").exists() for name in told)
    assert [p["key"] for p in Sweep(points, "50").front] == ["fine"]
    assert table(points).count("\n") == 6


def test_a_second_call_goes_on_where_the_first_was_cut_off(cases, tmp_path):
    class Cut(Exception):
        pass

    first, seen = [Fake("a"), Fake("b")], []

    def cut(fraction: float, message: str) -> None:
        seen.append(message)
        if message == "time of b, repeat 2 of 5":
            raise Cut

    with pytest.raises(Cut):
        measure(first, cases, tmp_path, cut)
    again = [Fake("a"), Fake("b")]
    points = measure(again, cases, tmp_path, quietly)
    assert [len(p["repeats"]) for p in points] == [REPEATS, REPEATS]
    assert again[0].calls == ["prepare"] + ["timed"] * (REPEATS - 2)
    assert again[1].calls == ["prepare"] + ["timed"] * (REPEATS - 1)
    changed = [Fake("a", shift=0.02), Fake("b")]
    measure(changed, cases, tmp_path, quietly)
    assert "motions" in changed[0].calls and changed[1].calls == []


def test_what_beats_the_default_is_told_with_its_certainty(cases, tmp_path):
    fakes = [Fake("small", 0.04, cpu=0.5), Fake("small__better", 0.01, cpu=0.2), Fake("small__slow", 0.01, cpu=0.9)]
    sweep = Sweep(measure(fakes, cases, tmp_path, quietly), "50")
    told = claims(sweep)
    assert told["default_beaten_by"] == told["default_clearly_beaten_by"] == ["small__better"]
    assert told["slowest_over_fastest_of_front"] == 1.0 and clearly(sweep.points[1], sweep.points[0], "50")
    assert told.get("resampled") is None
    noisy = [
        dict(p, errors={"50": {"squared_by_trajectory": v}})
        for p, v in zip(sweep.points, ([1, 9], [9, 1]), strict=False)
    ]
    assert not clearly(noisy[1], noisy[0], "50")


def test_page_and_picture_stand_alone(cases, tmp_path):
    fakes = [Fake("small"), Fake("small__x", 0.02, cpu=0.2), Fake("bad", fault="nan")]
    engine = Fake("engine", 1e-9, kind="engine", cpu=0.01)
    floor = Fake("floor", 0.005, kind="floor")
    points = measure([*fakes, engine, floor], cases, tmp_path / "points", quietly)
    sweep = Sweep(points, "50")
    draw(points, sweep.front, "50", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    report = {
        "source": "<data>", "trajectories": 3, "bodies": 9, "horizon_steps": 50, "dt_s": 0.02, "sdfsim": "0",
        "points": points, "front": [p["key"] for p in sweep.front], "claims": claims(sweep),
    }  # fmt: skip
    write_report(report, "none", tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    assert "&lt;data&gt;" in text and "<data>" not in text
    assert not re.search(r"https?://|<script|<link|src=|url\(", text)
    assert text.count("<circle") == 2 and "a state is not finite" in text and text.count("<title>") >= 4


def test_the_whole_study_in_small(data, tmp_path, monkeypatch):
    only = [Setting(), Setting(nodes="thin 20")]
    monkeypatch.setattr(study, "settings", lambda *_, **__: only)
    monkeypatch.setattr("sdfsim.evaluation.tradeoff_measure.REPEATS", 2)
    monkeypatch.setattr("sdfsim.evaluation.tradeoff_cases.MOST_QUICK", 1)
    monkeypatch.setattr(study, "QUICK_ENGINES", [Engine("PyBullet", 5), Engine("PyBullet", 5, off=1e-3)])
    options = {"models": [], "quick": True, "device": "cpu", "on_progress": quietly}
    report, rows, notes = study.run(data, tmp_path, **options)
    by_key = {p["key"]: p for p in report["points"]}
    assert set(by_key) == {"small", "small__nodes-20", "ballistic", "pybullet__5", "pybullet__5__off-0.001"}
    assert not any(p["failed"] for p in report["points"])
    assert by_key["pybullet__5"]["errors"]["50"]["translation_rmse"] < 1e-6  # the teacher repeats itself
    assert by_key["small"]["errors"]["50"]["translation_rmse"] < by_key["ballistic"]["errors"]["50"]["translation_rmse"]
    assert by_key["small"]["ms"]["median"] > by_key["ballistic"]["ms"]["median"]
    for name in ("tradeoff.png", "tradeoff.csv", "tradeoff.json", "report.html"):
        assert (tmp_path / name).stat().st_size > 500
    assert json.loads((tmp_path / "tradeoff.json").read_text())["front"] == report["front"]
    assert len(rows) == 6 and any("front of ours" in note for note in notes)


def test_nothing_to_study_is_one_clear_line(tmp_path):
    options = {"models": [], "quick": True, "device": "cpu", "on_progress": quietly}
    with pytest.raises(SdfsimError, match="no such file or folder"):
        study.run(tmp_path / "absent", tmp_path / "out", **options)
