"""Depths that are known: balls in balls, in the floor and in a ring; geometry that is the engine's own."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.data.pybullet_sim import write_urdf
from sdfsim.evaluation.penetration import ExactSolid, deepest, exact_solids, penetration
from sdfsim.geometry import primitives
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from tests.helpers.recordings import CUBE, balls

POLES = np.concatenate([np.eye(3), -np.eye(3)])
BALL = ExactSolid(
    0.5 * POLES, np.array([[-0.5] * 3, [0.5] * 3]), lambda p: np.linalg.norm(p, axis=1) - 0.5, "closed form"
)


def apart(*offsets: float, **fields):
    """Two balls high up; in frame k their centres are offsets[k] m apart, along a slanted axis of both."""
    axis = np.array([0.6, 0.0, 0.8])
    turn = np.array([0.0, np.sin(0.5 * np.arctan2(0.6, 0.8)), 0.0, np.cos(0.5 * np.arctan2(0.6, 0.8))])  # z -> axis
    position = np.array([[[0.0, 0.0, 9.0], np.array([0.0, 0.0, 9.0]) + d * axis] for d in offsets])
    motion = balls(position, **fields)
    return replace(motion, orientation=np.tile(turn, (len(offsets), 2, 1)))


def test_two_balls_are_as_deep_in_each_other_as_their_centres_say():
    far, touching, deep = deepest(apart(2.0, 2.0, 1.0, 0.9), {"ball": BALL}, every=1)
    assert far == np.inf and touching == pytest.approx(0.0, abs=1e-9) and deep == pytest.approx(-0.1)


def test_depth_grows_with_the_size():
    twice = apart(2.0, 1.8, scale=np.array([2.0, 2.0]))
    assert deepest(twice, {"ball": BALL}, every=1) == pytest.approx([-0.2])
    uneven = apart(2.0, 1.4, scale=np.array([2.0, 1.0]))
    assert deepest(uneven, {"ball": BALL}, every=1) == pytest.approx([-0.1])


def test_scenery_counts_against_what_moves_and_not_against_itself_or_the_floor():
    one_moves, none_meets = np.array([True, False]), np.array([True, True, False])
    assert deepest(apart(2.0, 0.9, static=one_moves), {"ball": BALL}, every=1) == pytest.approx([-0.1])
    sunk = np.tile([[0.0, 0.0, 0.1], [0.3, 0.0, 0.1], [9.0, 0.0, 9.0]], (2, 1, 1))
    assert deepest(balls(sunk, static=none_meets), {"ball": BALL}, every=1) == np.inf
    moves = np.tile([[9.0, 0.0, 0.47]], (2, 1, 1))
    assert deepest(balls(moves), {"ball": BALL}, every=1) == pytest.approx([-0.03])


def test_only_every_tenth_frame_is_looked_at_and_frames_without_contact_do_not_count():
    motion = apart(*[0.5] * 10, 0.9, *[0.5] * 9, 0.98, *[0.5] * 9, 3.0, *[0.5] * 9)
    found = penetration([motion, motion], {"ball": BALL})
    assert found["steps_with_contact"] == 4 and found["worst"] == pytest.approx(0.1)
    assert found["percentile_95"] == pytest.approx(np.percentile([0.1, 0.1, 0.02, 0.02], 95))
    nothing = penetration([apart(*[3.0] * 11)], {"ball": BALL})
    assert nothing == {"percentile_95": None, "worst": None, "steps_with_contact": 0}


def test_the_hole_of_static_concave_scenery_is_empty(tmp_path):
    """A ball of radius 0.1 m hangs in a ring's hole, then in its tube, where the nodes along the tube are deepest."""
    ring = replace(analytic_shape("sphere", radius=1.0), name="ring", mesh=primitives.torus(0.35, 0.15))
    solids = exact_solids(tmp_path, {"ring": with_sdf(ring, "grid", resolution=8)})
    assert solids["ring"].kind == "mesh"
    solids = {"ring": replace(solids["ring"], nodes=np.zeros((0, 3))), "ball": BALL}
    position = np.array([[[0.0, 0.0, 3.0], [x, 0.0, 3.0]] for x in (0.0, 0.0, 0.35)])
    motion = balls(position, scale=np.array([1.0, 0.2]), static=np.array([True, False]))
    hanging, within = deepest(replace(motion, shape=np.array(["ring", "ball"])), solids, every=1)
    assert hanging == np.inf
    assert within == pytest.approx(np.hypot(0.35, 0.1) - 0.35 - 0.15, abs=2e-3)


def test_a_shape_of_pieces_is_the_engines_pieces_where_they_are_at_hand(tmp_path):
    """The pieces are a unit cube; the mesh that is shown is smaller."""
    shown = replace(analytic_shape("box", size=(0.8, 0.8, 0.8)), source={"kind": "pieces"})
    shapes = {"cube": with_sdf(shown, "grid", resolution=4)}
    shapes["cube"] = replace(shapes["cube"], source={"kind": "pieces"})
    assert exact_solids(tmp_path, shapes)["cube"].kind == "shown mesh"
    engine = tmp_path / "shapes" / "engine"
    engine.mkdir(parents=True)
    (engine / "cube.obj").write_text("o piece\n" + CUBE)
    write_urdf(f'<mesh filename="{engine / "cube.obj"}"/>', engine / "cube.urdf")
    solid = exact_solids(tmp_path, shapes)["cube"]
    assert solid.kind == "pieces"
    np.testing.assert_allclose(solid.bounds, [[-0.5] * 3, [0.5] * 3])
    np.testing.assert_allclose(solid.distance(np.array([[0.0, 0.0, 0.4], [0.75, 0.0, 0.0]])), [-0.1, 0.25], atol=1e-6)
