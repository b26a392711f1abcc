"""The contact solve as a simulator's model: scaling, places, sleep, going on after a kill, crowds."""

import pickle

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
