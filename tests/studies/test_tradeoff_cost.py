"""The cost model finds planted coefficients; landings are those of falling bodies; a run is the sum of its parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim import Simulator
from sdfsim.dynamics.model import Model, new_network
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json
from sdfsim.scene.types import Effects
from sdfsim.studies import tradeoff_growth
from sdfsim.studies.tradeoff_cost import CostModel, Load, fit_cost, relative_errors, store_cost, stored_cost
from sdfsim.studies.tradeoff_estimate import LOOKS, estimate, landings, roundness
from sdfsim.studies.tradeoff_growing import BALL, BOX, Growing, build
from sdfsim.studies.tradeoff_growth import curves, slopes

PLANTED = CostModel(
    base=2.0, body=0.01, touching=5.0, node=2e-4, edge=0.03, edges_a_body=10.0, edges_a_round_body=3.0
)  # fmt: skip


def loads(count: int) -> list[Load]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(count):
        bodies = float(rng.integers(1, 500))
        touching, roundness = (float(rng.integers(2)) for _ in range(2))
        nodes = touching * bodies * float(rng.integers(20, 500))
        found.append(Load(bodies, touching, nodes, PLANTED.edges(touching * bodies, roundness), roundness))
    return found


@pytest.fixture(scope="module")
def model() -> Model:
    torch.manual_seed(0)
    return Model("untrained", "impulse", new_network("impulse", {"width": 8, "rounds": 1}), 0.02, 10.0, 1.4, 0.1)


def test_planted_coefficients_are_found():
    chosen = loads(60)
    found = fit_cost(chosen, [PLANTED(load) for load in chosen])
    assert found.to_json() == pytest.approx(PLANTED.to_json(), rel=1e-6)
    assert np.abs(relative_errors(found, chosen, [PLANTED(load) for load in chosen])).max() < 1e-6


def test_noise_of_a_tenth_leaves_predictions_near():
    chosen, rng = loads(120), np.random.default_rng(1)
    found = fit_cost(chosen[:80], [PLANTED(load) * rng.uniform(0.9, 1.1) for load in chosen[:80]])
    assert np.abs(relative_errors(found, chosen[80:], [PLANTED(load) for load in chosen[80:]])).max() < 0.1
    assert min(found.to_json().values()) >= 0


def test_too_few_scenes_are_refused():
    with pytest.raises(SdfsimError, match="at least 5 scenes"):
        fit_cost(loads(4), [1.0] * 4)


def test_stored_costs_are_the_model_s_own_else_of_its_kind(tmp_path, model):
    file = tmp_path / "costs.json"
    assert stored_cost(model, file) is None
    other = replace(PLANTED, base=9.0)
    entries = {
        "small": {"kind": "impulse", "cost": PLANTED.to_json()},
        "big": {"kind": "paper", "cost": other.to_json()},
    }
    write_json(file, {"models": entries})
    assert stored_cost(model, file) == PLANTED
    assert stored_cost(replace(model, kind="paper"), file) == other
    assert stored_cost(replace(model, kind="unheard of"), file) is None


def test_costs_of_one_model_leave_those_of_others(tmp_path):
    with pytest.raises(SdfsimError, match=r"growth\.json"):
        store_cost(tmp_path, tmp_path / "c.json")
    grown = {"kind": "impulse", "quick": True, "cost": {"base": 1.0}, "held_out_median": 0.1, "held_out_within": 1.0}
    for name in ("small", "base"):
        write_json(tmp_path / "growth.json", grown | {"model": name})
        store_cost(tmp_path, tmp_path / "c.json")
    stored = read_json(tmp_path / "c.json")["models"]
    assert set(stored) == {"small", "base"} and stored["base"] == grown


def falling(height: float):
    """A column of one box whose lower side is at `height` m."""
    scene = build(Growing("pile", 1))
    box = replace(scene.bodies[1], position=np.array([0.0, 0.0, height + 0.5 * BOX]))
    return replace(scene, bodies=(scene.bodies[0], box))


def test_a_body_lands_when_it_has_fallen_far_enough(model):
    simulator = Simulator(falling(5.0), model)
    steps = round(4.0 / simulator.dt)
    landed = landings(simulator, steps)
    # Free fall over 5 m, less the contact radius; found at the next of the looks, which lie at squares of k / LOOKS.
    exact = np.sqrt(2 * 5.0 / 9.81) / 4.0
    latest = ((np.ceil(np.sqrt(exact) * LOOKS)) / LOOKS) ** 2
    assert landed[0] == 0 and 1 - latest <= landed[1] <= 1 - 0.8 * exact
    assert landings(Simulator(falling(0.0), model), steps)[1] == 1.0
    assert landings(Simulator(falling(500.0), model), steps)[1] == 0.0
    apart = replace(falling(0.0), effects=Effects(contact="off"))
    assert landings(Simulator(apart, model), steps).sum() == 0.0


def test_balls_are_round_and_boxes_are_not(model):
    ball, box = (Simulator(build(Growing(kind, 3)), model) for kind in ("bowl", "pile"))
    assert roundness(ball) == 1.0 and roundness(box) < 0.5
    counters = {"edges": np.ones(6), "active": np.ones(6), "step_ms": np.full(6, 4.0)}
    landed = np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    assert estimate(PLANTED, ball, counters, landed, 100)["edges"] == pytest.approx(9.0)
    assert estimate(PLANTED, box, counters, landed, 100)["edges"] > 15.0


def test_a_run_is_estimated_by_the_ratio_to_its_first_steps(model):
    simulator = Simulator(falling(5.0), model)
    counters = {"edges": np.zeros(6), "active": np.zeros(6), "step_ms": np.array([0, 99.0, 4.0, 4.0, 4.0, 4.0])}
    own = float(len(simulator.bodies.node))
    found = estimate(PLANTED, simulator, counters, np.array([0.0, 0.75]), 100)
    flying = PLANTED(Load(1, 0, 0, 0))
    landed = PLANTED(Load(1, 0.75, 0.75 * own, 7.5))
    assert found["step_ms"] == pytest.approx(4.0 * landed / flying)
    assert found["seconds"] == pytest.approx(0.1 * found["step_ms"])
    assert (found["in_contact"], found["edges"]) == (0.75, 7.5)


@pytest.mark.parametrize("kind", ["pile", "bowl"])
@pytest.mark.parametrize("count", [1, 7, 40])
def test_growing_scenes_touch_without_overlapping(kind, count):
    scene = build(Growing(kind, count))
    moving = np.array([b.position for b in scene.bodies if b.motion == "dynamic"])
    assert len(moving) == count
    size = BOX if kind == "pile" else 2 * BALL
    apart = np.linalg.norm(moving[:, None] - moving, axis=-1) + 10.0 * np.eye(count)
    assert apart.min() > size
    if kind == "bowl":
        bowl = scene.shapes[1]
        distance, _ = bowl.sdf(moving - scene.bodies[1].position)
        assert np.asarray(distance).min() > 0.97 * BALL and np.asarray(distance).min() < 1.5 * BALL
        assert np.isclose(scene.bodies[1].position[2] + bowl.sdf.bounds[0, 2], 0.0, atol=0.01)
    else:
        assert np.isclose(moving[:, 2].min(), 0.5 * BOX)


def test_flying_scenes_touch_nothing(model):
    simulator = Simulator(build(Growing("pile", 9, flying=True)), model)
    next(simulator.steps(1))
    assert simulator.memory.counts["edges"] == 0 and simulator.memory.counts["free"] == 9
    simulator = Simulator(build(Growing("pile", 9)), model)
    next(simulator.steps(1))
    assert simulator.memory.counts["active"] == 9


def test_slopes_are_exponents():
    def point(kind: str, bodies: int, ms: float) -> dict:
        return {"kind": kind, "bodies": bodies, "nodes": None, "flying": False, "ms": ms, "mib": 3.0, "all_nodes": 1.0}

    points = [point("pile", n, 0.5 * n**1.5) for n in (1, 2, 4, 8)] + [point("bowl", n, 7.0) for n in (1, 2, 4)]
    found = slopes(points)
    assert found["pile, bodies"]["time"] == pytest.approx(1.5) and found["pile, bodies"]["memory"] == pytest.approx(0)
    assert found["bowl, bodies"]["time"] == pytest.approx(0, abs=1e-12)
    assert [name for name, _, _ in curves(points)] == ["pile, bodies", "bowl, bodies"]


def test_a_study_of_growth_is_resumed_and_says_how_far_off_it_is(tmp_path, monkeypatch):
    few = [Growing("pile", n, flying=flying) for n in (1, 2, 3, 4) for flying in (False, True)]
    monkeypatch.setattr(tradeoff_growth, "scenes", lambda *, quick: few)
    monkeypatch.setattr(tradeoff_growth, "COURSES", ((Growing("pile", 1), 0.0),))
    monkeypatch.setattr(tradeoff_growth, "COURSE", 8)
    monkeypatch.setattr(tradeoff_growth, "STEPS", 3)
    told = []
    options = {"model": "small", "quick": True, "device": "cpu", "on_progress": lambda *a: told.append(a)}
    report = tradeoff_growth.growth(tmp_path, **options)
    assert len(report["held_out"]) == 3 and np.isfinite(list(report["courses"].values())).all()
    # What the network costs is by far the most of so small a step.
    assert report["cost"]["touching"] > report["cost"]["base"] >= 0
    assert (tmp_path / "growth.png").stat().st_size > 1000
    rows, notes = tradeoff_growth.told(report)
    assert len(rows) == 9 and any(note.startswith("plan's estimate") for note in notes)
    monkeypatch.setattr(tradeoff_growth, "peak_memory", None)  # what is measured again would need it
    again = tradeoff_growth.growth(tmp_path, **options)
    assert again["points"] == report["points"] and again["cost"] == report["cost"]
