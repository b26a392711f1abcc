"""The contact solve as a simulator's model: scaling, places, sleep, going on after a kill, crowds."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from sdfsim import Simulator
from sdfsim.evaluation.laws import hard_cases
from sdfsim.scene.scene import Scene
from sdfsim.shape import contact_geometry
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import load_shape, with_sdf
from tests.helpers.scenes import ball, cube
from tests.helpers.scenes import make_body as body
from tests.helpers.shapes import SHAPES


def heap(seed: int, count: int = 6, weight: float = 9.81) -> Scene:
    """Boxes, balls and capsules that fall on each other, each turned somehow."""
    draw = np.random.default_rng(seed)
    shapes = (cube(1.0), ball(1.0), analytic_shape("capsule", radius=0.2, height=1.0), analytic_shape("plane"))
    bodies = []
    for k in range(count):
        quat = draw.normal(size=4)
        bodies.append(
            body(
                str(k), int(draw.integers(3)), [*draw.uniform(-0.8, 0.8, 2), 1.0 + 1.8 * k], draw.uniform(0.5, 5.0),
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3),
                angular_velocity=draw.normal(size=3),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 0.5),
            )
        )  # fmt: skip
    floor = body("floor", 3, [0, 0, 0], 0.0, motion="static", friction=0.8, restitution=1.0)
    return Scene(shapes, (*bodies, floor), np.array([0.0, 0.0, -weight]), 1.0)


@pytest.mark.parametrize("ratio", [10.0, 100.0])
def test_contacts_bear_the_weights_of_a_heavy_cube_on_a_light_one(ratio):
    bodies = [body(str(k), 0, [0, 0, k + 0.5], m) for k, m in enumerate((1.0, ratio))]
    bodies.append(body("floor", 1, [0, 0, 0], 0.0, motion="static"))
    sim = Simulator(Scene((cube(1.0), analytic_shape("plane")), tuple(bodies), np.array([0, 0, -9.81]), 1.0), "solver")
    sim.options = sim.options._replace(sleep=False)
    sim.run(3.0)
    touch, inner = sim.state.touch, sim.options.dt / sim.options.substeps
    weight, gravity = np.zeros(3), np.linalg.norm(sim.options.gravity)
    for pair, count, point in zip(touch.pair, touch.count, touch.point, strict=True):
        weight[pair[1]] += point[:count, 10].sum() / inner / gravity
    masses = sim.bodies.mass
    assert weight[1:] == pytest.approx([masses[1], masses.sum()], rel=0.02)


def test_what_rests_sleeps_and_wakes_when_it_is_hit_or_changed():
    boxes = [body(str(k), 0, [0, 0, k + 0.5]) for k in range(3)]
    far = body("ball", 1, [0, 0, 40.0])
    floor = body("floor", 2, [0, 0, 0], 0.0, motion="static")
    scene = Scene((cube(1.0), ball(1.0), analytic_shape("plane")), (*boxes, far, floor), np.array([0, 0, -9.81]), 4.0)
    sim = Simulator(scene, "solver")
    motion = sim.run(2.0)
    assert motion.counters["asleep"][-1] == 3
    assert (motion.position[-1, :3] == motion.position[-10, :3]).all() and not motion.velocity[-1, :3].any()
    kept, velocity = sim.state, sim.state.velocity.copy()
    velocity[1] = 0.5
    sim.state = replace(kept, velocity=velocity)
    assert sim.run(steps=1).counters["asleep"][-1] == 0
    sim.state = kept
    hit = sim.run(1.5)
    assert hit.counters["asleep"].min() == 0  # the ball comes down on them


def test_effects_that_are_off_do_not_act():
    scene = heap(1)
    flat = Simulator(scene, "solver")
    flat.options = flat.options._replace(rotation=False, friction=False)
    motion = flat.run(1.0)
    assert not motion.angular_velocity[1:, :-1].any()


def test_a_long_inner_step_is_told():
    """4 ms are for bodies of 1.4 m: at nine metres it is 10 ms."""

    def lines(size: float) -> list[str]:
        shapes = (cube(size), analytic_shape("plane"))
        bodies = (body("one", 0, [0, 0, size]), body("floor", 1, [0, 0, 0], 0.0, motion="static"))
        return Simulator(Scene(shapes, bodies, np.array([0.0, 0.0, -9.81]), 1.0), "solver").outside_training

    assert lines(4.0) == []
    (line,) = lines(40.0)
    assert line.startswith("inner step: ") and "checked up to 10 ms" in line


@pytest.mark.parametrize("wide", [0.3, 1.5, 9.0])
@pytest.mark.parametrize("name", ["can", "ring"])
def test_a_fitted_shape_rests_on_a_large_box_as_on_a_plane(name, wide):
    """A node of a large body sees another's grid from no farther than the grid is fine."""
    shape = load_shape(SHAPES / name)
    bottom = shape.sdf.bounds[0, 2]
    thing = body("thing", 0, [0.03, 0.0, -bottom], 0.2, restitution=0.0)
    table = body("table", 1, [0, 0, -0.02], 0.0, motion="static", restitution=0.0)
    top = analytic_shape("box", size=(wide, wide, 0.04))
    sim = Simulator(Scene((shape, top), (thing, table), np.array([0.0, 0.0, -9.81]), 1.0))
    rollout = sim.run(1.5)
    moved = np.abs(rollout.position[:, 0] - rollout.position[0, 0])
    assert moved.max() < 3e-3 * float(np.ptp(shape.sdf.bounds, axis=0).max())
    assert sim["thing"].asleep


def test_a_copy_of_a_scene_is_not_baked_again(monkeypatch):
    """Workers get copies of scenes, which bring what is known of their shapes."""
    shape = with_sdf(analytic_shape("box", size=(1.0, 0.7, 0.3)), "grid", resolution=16)
    scene = hard_cases.on_floor([shape], [hard_cases.body("b", 0, [0, 0, 1.0])])
    first = Simulator(scene, "solver").run(steps=5)
    monkeypatch.setattr(contact_geometry, "baked", None)
    again = Simulator(pickle.loads(pickle.dumps(scene)), "solver").run(steps=5)
    np.testing.assert_array_equal(first.position, again.position)
