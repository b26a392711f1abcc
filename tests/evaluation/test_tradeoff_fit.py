"""Fits against their budgets: what ended by itself is not made again, what failed stays, what is there is kept."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from sdfsim.errors import SdfsimError
from sdfsim.evaluation import tradeoff_fit
from sdfsim.evaluation.tradeoff import run
from sdfsim.evaluation.tradeoff_fit import ERRORS, QUICK_BUDGETS, fit_tradeoff, told
from sdfsim.shape import primitives
from sdfsim.shape.fit import training_share


@pytest.fixture
def meshes(tmp_path):
    found = {}
    for name in ("cube", "bad"):
        box = primitives.box()
        lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"f {a} {b} {c}" for a, b, c in box.faces + 1]
        (tmp_path / f"{name}.obj").write_text("\n".join(lines))
        found[name] = tmp_path / f"{name}.obj"
    return found


@pytest.fixture
def fits(monkeypatch):
    """The budgets that were asked for; a fit takes 6 s at most by a clock of its own, "slow" all that training may."""
    asked, clock = [], SimpleNamespace(now=0.0)

    def fit_mesh(mesh, *, name, budget):
        asked.append((name, budget))
        clock.now += 1.1 * training_share(budget) if name == "slow" else min(budget, 6.0)
        if name == "bad":
            raise SdfsimError("no inside")
        errors = dict.fromkeys(ERRORS, 0.01 / min(budget, 6.0))
        told = {"reason": "" if budget > 6 else "x", "caveat": ""}
        return SimpleNamespace(certificate=errors | told | {"steps": 9})

    monkeypatch.setattr(tradeoff_fit, "fit_mesh", fit_mesh)
    monkeypatch.setattr(tradeoff_fit.time, "monotonic", lambda: clock.now)
    return asked


def test_a_fit_that_its_budget_cut_short_is_made_again_with_a_larger_one(meshes, fits, tmp_path):
    """It takes less than the budget then too: a part is kept for the certificate."""
    slow = {"slow": meshes["cube"]}
    report = fit_tradeoff(slow, tmp_path / "out", quick=True, on_progress=lambda *_: None)
    assert fits == [("slow", budget) for budget in QUICK_BUDGETS]
    assert all(p["wall_s"] < 0.95 * p["budget_s"] and not p["ended_by_itself"] for p in report["points"])


def test_fits_are_made_once_and_failures_stay(meshes, fits, tmp_path):
    out = tmp_path / "out"
    report = fit_tradeoff(meshes, out, quick=True, on_progress=lambda *_: None)
    # The cube's fit ends by itself after 6 of 10 s, so that 20 s would change nothing; the bad mesh fails each time.
    assert fits == [("cube", 5.0), ("cube", 10.0), *(("bad", b) for b in QUICK_BUDGETS)]
    cube = [p for p in report["points"] if p["name"] == "cube"]
    assert [p["ended_by_itself"] for p in cube] == [False, False, True]
    assert [p["error_within_0.01"] for p in cube] == pytest.approx([0.002, 0.01 / 6, 0.01 / 6])
    assert [p["failed"] for p in report["points"] if p["name"] == "bad"] == ["no inside"] * 3
    assert (out / "fit.png").stat().st_size > 1000 and (out / "fit.csv").read_text().count("\n") == 7
    rows, _ = told(report)
    assert rows[1][-1] == "missed: x" and rows[2][-1] == "met" and "no inside" in rows[4]
    fits.clear()
    again, _, _ = run(tmp_path, out, models=[], quick=True, device="auto", on_progress=lambda *_: None)
    assert fits == [] and [p["name"] for p in again["points"]][:1] == ["bad"]  # a folder's meshes, by name
    # As long a file as before, of another mesh.
    text = meshes["cube"].read_text().replace("v 0.5", "v 0.4").replace("v -0.5", "v -0.4")
    assert len(text) == len(meshes["cube"].read_text())
    meshes["cube"].write_text(text)
    fit_tradeoff(meshes, out, quick=True, on_progress=lambda *_: None)
    assert [name for name, _ in fits] == ["cube", "cube"]


def test_what_cannot_be_measured_of_fits_is_refused(meshes, fits, tmp_path):
    def asked(source, **options):
        plain = {"models": [], "quick": True, "device": "auto", "on_progress": lambda *_: None}
        return run(source, tmp_path / "out", **(plain | options))

    with pytest.raises(SdfsimError, match="nothing could be fitted: no inside"):
        asked(meshes["bad"])
    with pytest.raises(SdfsimError, match="fits of meshes are measured on the CPU, without a model"):
        asked(meshes["cube"], models=["small"])
    with pytest.raises(SdfsimError, match="fits of meshes are measured on the CPU"):
        asked(meshes["cube"], device="cuda")
    (tmp_path / "cube.stl").write_text("")
    with pytest.raises(SdfsimError, match="two meshes are called 'cube'"):
        asked(tmp_path)
    (tmp_path / "broken.off").write_text("OFF nonsense")
    with pytest.raises(SdfsimError, match=r"broken\.off"):
        asked(tmp_path / "broken.off")
