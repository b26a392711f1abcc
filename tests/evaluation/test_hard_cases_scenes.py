"""The scenes of the hard cases are what they are called."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.evaluation import hard_cases_scenes as scenes
from sdfsim.evaluation.hard_cases_list import SPEEDS, cases
from sdfsim.scene.scene import Body, Scene


def moving(scene: Scene) -> list[Body]:
    return [b for b in scene.bodies if b.motion == "dynamic"]


def vertices(scene: Scene, body: Body) -> np.ndarray:
    """[V, 3] m, world."""
    return body.position + Rotation.from_quat(body.quat_xyzw).apply(scene.shapes[body.shape].mesh.vertices * body.scale)


def boxes(scene: Scene) -> np.ndarray:
    """[N, 2, 3] m, the boxes around the dynamic bodies."""
    corners = [vertices(scene, b) for b in moving(scene)]
    return np.array([[c.min(0), c.max(0)] for c in corners])


@pytest.mark.parametrize("degrees", [0.0, 11.3, 30.0])
def test_a_slope_pulls_along_x_and_presses_as_one_of_its_angle_does(degrees):
    scene = scenes.slope(0.4, degrees)
    along, across, press = scene.gravity
    assert along == pytest.approx(10.0 * np.sin(np.radians(degrees)))
    assert press == pytest.approx(-10.0 * np.cos(np.radians(degrees))) and across == 0
    slab, floor = scene.bodies
    assert slab.friction * floor.friction == pytest.approx(0.4)
    assert vertices(scene, slab)[:, 2].min() == pytest.approx(0.0)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.9])
def test_balls_are_dropped_from_about_a_metre_onto_a_contact_of_that_restitution(restitution):
    scene = scenes.dropped(restitution, 3)
    heights = np.array([b.position[2] - 0.5 for b in moving(scene)])
    assert len(heights) == scenes.BALLS and len(set(heights)) == scenes.BALLS
    assert heights.min() >= 0.9 and heights.max() <= 1.1
    assert {b.restitution * scene.bodies[-1].restitution for b in moving(scene)} == {restitution}


def test_cards_stand_on_the_floor_and_meet_over_the_middle():
    left, right = boxes(scenes.card_house())
    assert left[0, 2] == pytest.approx(0.0, abs=1e-12) and right[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert left[1, 0] == pytest.approx(0.0, abs=1e-12) and right[0, 0] == pytest.approx(0.0, abs=1e-12)
    scene = scenes.card_house()
    upright = [Rotation.from_quat(b.quat_xyzw).apply([0, 0, 1]) for b in moving(scene)]
    assert [np.degrees(np.arccos(u[2])) for u in upright] == pytest.approx([scenes.LEAN] * 2)
    assert upright[0][0] > 0 > upright[1][0], "each leans towards the other"


@pytest.mark.parametrize(
    ("built", "count", "layers"),
    [("tower", 5, 5), ("pyramid", 10, 4), ("wall", 22, 5)],
)
def test_stacks_touch_without_overlap_and_each_body_has_something_below(built, count, layers):
    placed = boxes({"tower": scenes.tower, "pyramid": scenes.pyramid, "wall": scenes.wall}[built](layers))
    assert len(placed) == count
    for one, other in combinations(placed, 2):
        overlap = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
        assert (overlap < 1e-9).any()
    bottoms = np.unique(placed[:, 0, 2].round(9))
    assert len(bottoms) == layers and bottoms[0] == 0
    for box in placed[placed[:, 0, 2] > 1e-9]:
        under = placed[np.abs(placed[:, 1, 2] - box[0, 2]) < 1e-9]
        shared = np.minimum(under[:, 1, :2], box[1, :2]) - np.maximum(under[:, 0, :2], box[0, :2])
        middle = box[:, 0].mean()
        rests = under[(shared > 0).all(1)]
        assert len(rests) and rests[:, 0, 0].min() < middle < rests[:, 1, 0].max()


def test_a_pile_starts_within_the_bowl_and_nothing_touches():
    scene = scenes.piled(64, 1)
    inner, outer = scenes.bowl_radii(64)
    *bodies, bowl, _ = scene.bodies
    assert len(bodies) == 64 and bowl.scale == pytest.approx(2 * outer)
    centre = np.array([b.position for b in bodies]) - bowl.position
    reach = np.linalg.norm(np.minimum(centre, [np.inf, np.inf, 0.0]), axis=1)
    around = np.array([np.linalg.norm(scene.shapes[b.shape].sdf.bounds[1]) for b in bodies])
    around[[b.shape == 0 for b in bodies]] = scenes.BOWL_BALL / 2
    assert (reach + around < inner).all()
    for i, j in combinations(range(64), 2):
        assert np.linalg.norm(centre[i] - centre[j]) > around[i] + around[j]
    assert np.ptp(scene.shapes[bowl.shape].mesh.vertices, axis=0).max() * bowl.scale == pytest.approx(2 * outer)


@pytest.mark.parametrize("speed", SPEEDS)
def test_bodies_are_thrown_straight_at_a_plate_of_a_centimetre(speed):
    scene = scenes.thrown_at_plate(speed, 0)
    plate = scene.bodies[-1]
    top = vertices(scene, plate)[:, 2]
    assert top.max() == pytest.approx(0.0) and np.ptp(top) == pytest.approx(0.01)
    placed = boxes(scene)
    assert len(placed) == 16 and placed[:, 0, 2].min() > 0
    assert np.abs(placed[..., :2]).max() < 1.5
    for one, other in combinations(placed, 2):
        assert (np.minimum(one[1], other[1]) < np.maximum(one[0], other[0])).any()
    assert {tuple(b.velocity) for b in moving(scene)} == {(0.0, 0.0, -speed)}


def test_a_body_is_put_to_rest_on_the_floor_on_its_steady_face():
    cone = scenes.shape_from_primitive("cone", sdf="mesh")
    scene = scenes.resting(cone, sleep=True)
    assert scene.effects.sleep == "on"
    placed = vertices(scene, moving(scene)[0])
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    low = placed[placed[:, 2] < 1e-6]
    assert np.ptp(low[:, 0]) == pytest.approx(1.0, abs=0.01), "a cone stands on its base"


def test_a_turned_scene_turned_back_is_the_same():
    scene = scenes.tossed((1, 2))
    there = scenes.yawed(scene, 73.0)
    back = scenes.yawed(there, -73.0)
    for one, turned, other in zip(scene.bodies, there.bodies, back.bodies, strict=True):
        np.testing.assert_allclose(other.position, one.position, atol=1e-12)
        np.testing.assert_allclose(other.velocity, one.velocity, atol=1e-12)
        assert abs(other.quat_xyzw @ one.quat_xyzw) == pytest.approx(1.0)
        assert np.linalg.norm(turned.position) == pytest.approx(np.linalg.norm(one.position))
    assert np.linalg.norm(there.bodies[0].position - scene.bodies[0].position) > 0.1


def test_a_nudge_is_small_and_repeatable_and_none_for_the_case_itself():
    scene = scenes.tower(3)
    assert scenes.nudged(scene, 0) is scene
    one, again, other = (scenes.nudged(scene, seed) for seed in (1, 1, 2))
    shift = np.array([b.position - a.position for a, b in zip(scene.bodies, one.bodies, strict=True)])
    assert 0 < np.abs(shift[:3, :2]).max() <= scenes.NUDGE and not shift[:, 2].any() and not shift[3].any()
    assert all((a.position == b.position).all() for a, b in zip(one.bodies, again.bodies, strict=True))
    assert any((a.position != b.position).any() for a, b in zip(one.bodies, other.bodies, strict=True))


def test_tossed_scenes_are_random_repeatable_and_start_apart():
    counts = set()
    for seed in range(10):
        scene, again = scenes.tossed((seed,)), scenes.tossed((seed,))
        bodies = moving(scene)
        counts.add(len(bodies))
        assert [tuple(b.position) for b in bodies] == [tuple(b.position) for b in moving(again)]
        assert 3 <= len(bodies) <= 8 and boxes(scene)[:, 0, 2].min() > 0
        reach = [np.linalg.norm(vertices(scene, b) - b.position, axis=1).max() for b in bodies]
        for i, j in combinations(range(len(bodies)), 2):
            assert np.linalg.norm(bodies[i].position - bodies[j].position) > reach[i] + reach[j] - 1e-9
    assert len(counts) > 2


def test_every_case_has_a_name_of_its_own_and_the_short_form_is_shorter():
    long, short = cases(), cases(quick=True)
    assert len({case.name for case in long}) == len(long)
    assert {case.name for case in short} < {case.name for case in long}
    work = [sum(len(case.scenes(0)) * case.seconds for case in found) for found in (long, short)]
    assert work[1] < 0.5 * work[0]
