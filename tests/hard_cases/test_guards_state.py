"""What cannot be is an error that names step, body and last good state, and what was computed stays readable."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from sdfsim import Rollout, SdfsimError
from sdfsim.learned import inference
from sdfsim.physics.bodies import State
from sdfsim.simulate import simulator
from sdfsim.simulate.simulator import SimulationError, Simulator
from tests.hard_cases import gates
from tests.helpers.command import run
from tests.helpers.scenes import random_model

BROKEN = {
    "nan": ("velocity", np.nan),
    "inf": ("position", np.inf),
    "nan turn": ("orientation", np.nan),
    "far": ("position", 1e12),
    "fast": ("velocity", 1e9),
    "fast turn": ("angular_velocity", 1e9),
    "long quaternion": ("orientation", 1.0),
    "no quaternion": ("orientation", 0.0),
}


def spoil(state, name: str, value: float):
    """The state with one number (the whole quaternion where 0 is asked for) of body 1 replaced."""
    array = getattr(state, name).copy()
    array[1, slice(None) if value == 0.0 else 0] = value
    return replace(state, **{name: array})


@pytest.mark.parametrize("kind", BROKEN)
def test_a_state_that_cannot_be_is_named_and_the_last_good_one_kept(kind, monkeypatch):
    steps = 5
    sim = Simulator(gates.mixed(), random_model("impulse", push=0.1))
    advance = sim._advance

    def inject(count: int, *, keep: bool):
        if sim.steps_done == steps:
            sim.state = spoil(sim.state, *BROKEN[kind])
        return advance(count, keep=keep)

    monkeypatch.setattr(simulator, "GLANCE", 0.0)  # one step in a call
    monkeypatch.setattr(sim, "_advance", inject)
    with pytest.raises(SimulationError) as caught:
        sim.run(steps=20)
    told = caught.value.message
    assert told.startswith(f"step {steps + 1}: body 'box': ") and "\n" not in told
    assert f"the last good state is that of step {steps}, t = {steps * sim.dt:.4g} s" in told
    assert caught.value.exit_code == 3 and len(caught.value.rollout) == steps
    gates.assert_sound(caught.value.rollout)
    np.testing.assert_array_equal(sim.si_state().position, caught.value.rollout.position[-1])
    monkeypatch.undo()
    sim.run(steps=1)  # from the last good state it goes on


def breaking(monkeypatch, at_call: int, name: str, value: float) -> None:
    """At its `at_call`th call the network on bodies answers `value` in the array `name`, for the last body."""
    real, calls = inference.stepped, []

    def stepped(*given) -> State:
        calls.append(1)
        after = real(*given)
        if len(calls) == at_call:
            broken = getattr(after, name).copy()
            broken[-1, 0] = value
            after = replace(after, **{name: broken})
        return after

    monkeypatch.setattr(inference, "stepped", stepped)


IMPOSSIBLE = [
    ("velocity", 1e30),
    ("angular_velocity", float("-inf")),
    ("position", 1e30),
    ("orientation", float("nan")),
]


@pytest.mark.parametrize(("name", "value"), IMPOSSIBLE)
def test_an_answer_of_the_impulse_network_that_cannot_be(name, value, monkeypatch):
    model = random_model("impulse", push=0.1)
    breaking(monkeypatch, 3, name, value)
    sim = Simulator(gates.mixed(), model)
    with pytest.raises(SimulationError, match=r"step \d+: body '(box|ball|ring)': .*; the last good state") as caught:
        sim.run(steps=30)
    gates.assert_sound(caught.value.rollout)
    assert len(caught.value.rollout) == sim.steps_done >= 2


def test_a_run_on_disk_is_readable_up_to_the_last_good_step(tmp_path, monkeypatch):
    scene, out = tmp_path / "scene.yaml", tmp_path / "run"
    scene.write_text(
        "version: 1\nduration: 1\nshapes: {ball: {sphere: {radius: 0.5}}}\n"
        "bodies:\n  - {name: floor, plane: {}}\n  - {name: ball, shape: ball, position: [0, 0, 0.52]}\n"
    )
    at = int(np.random.default_rng(7).integers(3, 20))
    breaking(monkeypatch, at, "velocity", np.nan)
    done = run("simulate", scene, "-o", out, "--json", "--model", "gnn")
    assert done.exit_code == 3
    rollout, report = Rollout.load(out / "rollout.npz"), json.loads((out / "report.json").read_text())
    # The network is first asked when the ball meets the floor.
    last = report["steps"]
    assert len(rollout) == last >= at - 1 and report["status"] == "failed"
    gates.assert_sound(rollout)
    assert report["error"].startswith(f"step {last + 1}: body 'ball': ") and report["error"] in done.stderr
    assert f"the last good state is that of step {last}" in report["error"]
    assert (out / "rollout.rrd").stat().st_size > 0 and yaml.safe_load((out / "config.yaml").read_text())


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"position": np.array([0.0, np.nan, 1.0])}, "body 'b0': position is not finite"),
        ({"position": np.array([1e15, 0.0, 1.0])}, "too far to be placed exactly"),
        ({"quat_xyzw": np.array([0.0, 0.0, 0.0, 2.0])}, "orientation is not a unit quaternion"),
    ],
)
def test_a_start_that_cannot_be_is_told_before_any_step(fields, told):
    scene = gates.placed(gates.CUBE, [(0, 0, 1)])
    broken = replace(scene, bodies=(replace(scene.bodies[0], **fields),))
    with pytest.raises(SdfsimError, match=told) as caught:
        Simulator(broken, random_model("impulse"))
    assert caught.value.exit_code == 1
