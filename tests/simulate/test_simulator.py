"""What a `Simulator` takes from its caller, and what it refuses in one line."""

from dataclasses import replace

import numpy as np
import pytest

import sdfsim
from sdfsim import SdfsimError, Simulator
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import SimulationError
from tests.helpers.scenes import make_body, random_model


def test_a_run_takes_the_steps_that_its_time_is(free_pair):
    simulator = Simulator(free_pair, model=random_model("impulse"))
    step = simulator.dt
    for seconds, steps in ((0, 0), (0.1 * step, 1), (2.4 * step, 2), (2.6 * step, 3)):
        assert len(simulator.run(seconds=seconds)) == steps
    for seconds in (-1.0, -1e-9, float("nan"), float("inf")):
        with pytest.raises(SdfsimError, match="seconds: must be >= 0"):
            simulator.run(seconds=seconds)
    assert simulator.steps_done == 6


@pytest.mark.parametrize("motion", ["dynamic", "static"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_body_of_an_absurd_size_is_the_one_that_is_named(box_shape, motion, place):
    bodies = [make_body(name, 0, [9.0 * k, 0, 0]) for k, name in enumerate(("one", "two", "three"))]
    bodies[place] = replace(bodies[place], scale=1e10, motion=motion)
    with pytest.raises(SdfsimError, match=f"^body {bodies[place].name!r}: 1e[+]10 m wide"):
        Simulator(Scene((box_shape,), tuple(bodies), np.array([0.0, 0.0, -9.81]), 1.0), random_model("impulse"))


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_of_two_bodies_the_less_ordinary_size_is_named(box_shape, scale):
    bodies = make_body("usual", 0, [0, 0, 0]), make_body("absurd", 0, [9, 0, 0], scale=scale)
    with pytest.raises(SdfsimError, match=r"^body 'absurd': .* beside body 'usual' of 1 m "):
        Simulator(Scene((box_shape,), bodies, np.zeros(3), 1.0), random_model("impulse"))
    alone = Simulator(
        Scene((box_shape,), (replace(bodies[1], position=np.zeros(3)),), np.zeros(3), 1.0), random_model("impulse")
    )
    assert alone.units.length == pytest.approx(scale)


WAYS = {
    "initial_rollout": lambda simulator: simulator.initial_rollout(),
    "no steps": lambda simulator: simulator.run(steps=0),
    "run": lambda simulator: simulator.run(steps=1),
    "steps": lambda simulator: next(simulator.steps(1)),
    "frames": lambda simulator: next(simulator.frames(1)),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("time", np.nan, "time is not finite"),
        ("velocity", np.nan, "body 'right': velocity is not finite"),
        ("position", np.inf, "body 'right': position is not finite"),
        ("position", 1e12, "body 'right': .* too far to be placed exactly"),
        ("velocity", 1e9, "body 'right': .* too fast"),
        ("angular_velocity", 1e9, "body 'right': .* too fast"),
        ("orientation", np.nan, "body 'right': orientation is not finite"),
        ("orientation", 2.0, "body 'right': orientation is not a unit quaternion"),
        ("orientation", 0.0, "body 'right': orientation is not a unit quaternion"),
    ],
)
def test_a_state_of_the_caller_that_cannot_be_is_refused_in_every_way(free_pair, way, name, value, told):
    simulator = Simulator(free_pair, model=random_model("impulse"))
    good = simulator.state
    broken = value
    if name != "time":
        broken = getattr(good, name).copy()
        broken[1] = value
    simulator.state = replace(good, **{name: broken})
    with pytest.raises(SimulationError, match=f"step 1: {told}"):
        WAYS[way](simulator)
    assert simulator.state is good


def box() -> sdfsim.Scene:
    scene = sdfsim.Scene(model="solver").add("floor", plane={}, restitution=0.0)
    return scene.add("box", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 0.1), mass=3.0, restitution=0.0)


def test_a_simulator_takes_a_path_and_a_sample(tmp_path):
    file = box().save(tmp_path / "scene.yaml")
    assert Simulator(file).scene.bodies[1].name == Simulator(str(file)).scene.bodies[1].name == "box"
    assert any(joint.name == "door" for joint in Simulator("door").scene.joints)
    with pytest.raises(SdfsimError, match=r"truth\.yaml: no such file"):
        Simulator("truth.yaml")


SCENE, SOURCE = "scene: must be a Scene, the path .*got a ", "source: must be a path"


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (lambda out: Simulator(3), SCENE + "int"), (lambda out: Simulator(None), SCENE + "NoneType"),
        (lambda out: Simulator({"bodies": []}), SCENE + "dict"),
        (lambda out: sdfsim.export(3, out / "out.glb"), SOURCE),
        (lambda out: sdfsim.export(None, out / "out.glb"), SOURCE),
        (lambda out: sdfsim.export({"bodies": []}, out / "out.glb"), SOURCE),
        (lambda out: sdfsim.export(box(), out / "out.glb"), SOURCE + r" \(got a SceneBuilder\)\nhint: .*scene\.save"),
        (lambda out: sdfsim.render(box(), 3, out / "out.png"), "rollout: must be a Rollout or the path"),
    ],
)  # fmt: skip
def test_what_is_no_scene_source_or_rollout_is_refused_with_what_is_wanted(act, told, tmp_path):
    with pytest.raises(SdfsimError, match=told):
        act(tmp_path)


@pytest.mark.parametrize("count", [0.5, -1, "3", None, True])
@pytest.mark.parametrize("act", [lambda sim, count: sim.step(count), lambda sim, count: next(sim.steps(count))])
def test_steps_are_whole_numbers(count, act):
    with pytest.raises(SdfsimError, match="steps: must be a whole number"):
        act(Simulator(box()), count)
