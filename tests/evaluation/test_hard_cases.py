"""The scenes are what they are called, and the measures are right on motions whose figures are known."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Simulator
from sdfsim.evaluation import hard_cases
from sdfsim.evaluation.engines import Ran, scene_rollout, start_motion
from sdfsim.evaluation.hard_cases import cases
from sdfsim.evaluation.penetration import depths
from sdfsim.scene.scene import Body, Effects, Scene

DT = 0.01


def motion(scene: Scene, steps: int, moved=None, velocity=None) -> Ran:
    """A run in which body k is displaced by `moved`[k] [T+1, 3] m and has `velocity`[k]; all others are still."""
    start = start_motion(scene)
    place, turn = (np.repeat(values, steps + 1, axis=0) for values in (start.position, start.orientation))
    speed = np.zeros_like(place)
    for k, path in (moved or {}).items():
        place[:, k] += path
    for k, values in (velocity or {}).items():
        speed[:, k] = values
    found = {"position": place, "orientation": turn, "velocity": speed, "angular_velocity": np.zeros_like(place)}
    return Ran(scene, scene_rollout(scene, replace(start, **found, dt=DT)))


def line(steps: int, x=0.0, y=0.0, z=0.0) -> np.ndarray:
    """[steps + 1, 3] m, straight from 0 to (x, y, z)."""
    return np.linspace(0.0, 1.0, steps + 1)[:, None] * np.array([x, y, z])


def test_energy_is_what_the_simulator_counts():
    scene = replace(hard_cases.tossed((5,)), effects=Effects(contact="off"))
    rollout = Simulator(scene).run(steps=5)
    course = hard_cases.energy(Ran(scene, rollout).motion)
    counted = rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]
    np.testing.assert_allclose(course, counted, rtol=1e-9)
    np.testing.assert_allclose(course, course[0], rtol=1e-6)


def test_a_motion_with_ten_times_the_energy_has_run_away_and_a_fall_has_not():
    scene = hard_cases.dropped(0.5, 0)
    time = np.arange(101) * DT
    fall = np.stack([0 * time, 0 * time, -5.0 * time**2], -1)
    falling = motion(scene, 100, {0: fall}, {0: np.stack([0 * time, 0 * time, -10.0 * time], -1)})
    assert hard_cases.ran_away(falling) == ""
    falling.motion.velocity[60:, 0] = [0.0, 0.0, 60.0]
    assert "0.60 s" in hard_cases.ran_away(falling)


def test_a_creeping_body_drifts_by_what_it_creeps():
    scene = hard_cases.resting(hard_cases.box(2.0), sleep=False)
    found = hard_cases.rest([motion(scene, 1000, {0: line(1000, x=0.3, y=0.4, z=-0.1)})], times=(5.0, 10.0))
    assert found["drift 5 s"] == pytest.approx(12.5) and found["drift 10 s"] == pytest.approx(25.0)
    assert found["speed"] == pytest.approx(np.sqrt(0.3**2 + 0.4**2 + 0.1**2) / 10)
    assert found["height"] == pytest.approx(10.0) and found["motion"] == pytest.approx(0.04)
    assert hard_cases.rest([motion(scene, 1000)], times=(10.0,))["motion"] == 0.0


def test_what_has_sunk_has_fallen_and_the_others_shift():
    scene = hard_cases.tower(3)
    moved = {2: line(100, x=0.5, z=-1.0), 1: line(100, y=0.07)}
    found = hard_cases.standing([motion(scene, 100, moved)])
    assert found == {"fallen": 1.0, "shift": pytest.approx(7.0)}
    cards = hard_cases.card_house()
    assert hard_cases.standing([motion(cards, 10, {0: line(10, z=-0.2)})])["fallen"] == 0


def test_penetration_is_the_overlap_of_two_cubes_and_of_one_with_the_floor():
    scene = hard_cases.tower(2)
    rollout = motion(scene, 20, {1: line(20, z=-0.1)})
    assert depths(rollout, every=20) == pytest.approx([0.1])
    found = hard_cases.squeezed([rollout])
    assert found["worst depth"] == pytest.approx(10.0) and found["fallen"] == 0.0
    sunk = hard_cases.on_floor([hard_cases.box(1.0)], [hard_cases.body("sunk", 0, [0, 0, 0])])
    assert depths(motion(sunk, 5), every=5) == pytest.approx([0.5])
    apart = hard_cases.overlapping(hard_cases.ball(), hard_cases.ball(), 1.2)
    assert (depths(motion(apart, 5), every=5) == 0).all()


def test_separation_gives_the_fastest_speed_and_what_is_left():
    scene = hard_cases.overlapping(hard_cases.box(1.0), hard_cases.box(1.0), 0.5)
    speed = {1: np.stack([[3.0 * np.sin(k / 50 * np.pi), 0, 0] for k in range(51)])}
    found = hard_cases.separated([motion(scene, 50, {1: line(50, x=0.3)}, speed)])
    assert found["exit speed"] == pytest.approx(3.0)
    # The deepest node of the one is 0.2 m from the other's nearest face.
    assert found["depth left"] == pytest.approx(20.0)


def test_only_what_is_below_the_plate_over_its_area_has_passed_it():
    scene = hard_cases.thrown_at_plate(5.0, 0)
    moved = {k: line(40, z=-0.4) for k in range(16)}
    assert hard_cases.passed([motion(scene, 40, moved)])["through"] == 0
    through = moved | {0: line(40, z=-0.8)}
    around = moved | {0: line(40, x=-3.0, z=-0.8)}
    assert hard_cases.passed([motion(scene, 40, through)])["through"] == pytest.approx(100 / 16)
    assert hard_cases.passed([motion(scene, 40, around)])["through"] == 0


def bouncing(height: float, e: float, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the lowest point m and velocity m/s of a ball that bounces once, at 10 m/s^2."""
    hit = np.sqrt(2 * height / 10)
    before, since = time < hit, time - hit
    away = e * 10 * hit
    low = np.where(before, height - 5 * time**2, away * since - 5 * since**2)
    return np.maximum(low, 0.0), np.where(before, -10 * time, np.where(low > 0, away - 10 * since, 0.0))


@pytest.mark.parametrize(
    ("e", "wanted", "error"), [(0.5, 0.5, 0.0), (0.9, 0.9, 0.0), (0.5, 0.7, 24.0), (0.0, 0.0, 0.0)]
)
def test_a_ball_that_bounces_by_the_law_has_no_error(e, wanted, error):
    scene = hard_cases.dropped(wanted, 0)
    time = np.arange(131) * DT
    moved, speed = {}, {}
    for k in range(hard_cases.BALLS):
        height = scene.bodies[k].position[2] - 0.5
        low, rate = bouncing(height, e, time)
        moved[k] = np.stack([0 * time, 0 * time, low - height], -1)
        speed[k] = np.stack([0 * time, 0 * time, rate], -1)
    found = hard_cases.rebound([motion(scene, 130, moved, speed)], restitution=wanted)
    assert found["error"] == pytest.approx(error, abs=0.1)
    assert found["rebound"] == pytest.approx(100 * e**2, abs=0.1)


@pytest.mark.parametrize("actual", [0.3, 0.4, 0.5])
def test_a_body_that_slides_by_coulombs_law_slips_at_its_friction(actual):
    offsets = (-6.0, -2.0, 2.0, 6.0)
    critical = np.degrees(np.arctan(0.4))
    runs = []
    for off in offsets:
        scene = hard_cases.slope(0.4, critical + off)
        runs.append(motion(scene, 200, {0: line(200, x=hard_cases.slide(actual, critical + off, 2.0, 10.0))}))
    found = hard_cases.slipped(runs, friction=0.4, offsets=offsets)
    assert found["slips at"] == pytest.approx(np.degrees(np.arctan(actual)) - critical, abs=0.4)


def test_who_crosses_the_wall_counts_and_who_comes_over_the_rim_does_not():
    scene = hard_cases.piled(8, 0)
    _, outer = hard_cases.bowl_radii(8, hard_cases.BOWL_BALL)
    bowl = scene.bodies[8].position
    still = hard_cases.heaped([motion(scene, 20)])
    assert still["through the wall"] == 0 and still["energy gain"] == 0 and still["depth 95 %"] == 0
    start = scene.bodies[0].position - bowl
    out = line(20, *(np.array([2.0 * outer, 0, -0.2]) - start))
    assert hard_cases.heaped([motion(scene, 20, {0: out})])["through the wall"] == 1
    up = np.array([0, 0, 1.0]) - start
    over = np.concatenate([line(10, *up), (up + line(10, x=2 * outer))[1:]])
    over[-3:, 2] -= 1.5
    assert hard_cases.heaped([motion(scene, 20, {0: over})])["through the wall"] == 0


def test_steps_that_add_energy_are_counted():
    scene = hard_cases.dropped(0.5, 0)
    start = hard_cases.energy(motion(scene, 1).motion)[0]
    one = scene.bodies[0]
    lifted = np.zeros((11, 3))
    lifted[4:, 2] = 0.05 * start / (10.0 * one.mass)  # one step adds 5 %
    lifted[8:, 2] += 0.005 * start / (10.0 * one.mass)  # another half a percent
    runs = [motion(scene, 10), motion(scene, 10, {0: lifted})]
    found = hard_cases.created(runs)
    assert found == {"steps with gain": pytest.approx(5.0), "worst gain": pytest.approx(5.0)}


def test_a_turned_motion_deviates_by_what_it_is_off():
    scene = hard_cases.tower(2)
    path = line(50, x=0.4, y=0.1)
    turned = hard_cases.yawed(scene, 30.0)
    runs = [motion(scene, 50, {0: path})]
    exact = Rotation.from_euler("z", 30, degrees=True).apply(path)
    assert hard_cases.turned_back([*runs, motion(turned, 50, {0: exact})], degrees=(0.0, 30.0))[
        "deviation"
    ] == pytest.approx(0.0, abs=1e-10)
    off = motion(turned, 50, {0: exact + line(50, z=0.2)})
    found = hard_cases.turned_back([*runs, off], degrees=(0.0, 30.0))
    assert found["deviation"] == pytest.approx(20.0 / np.sqrt(2))


def test_divergence_is_timed_from_the_start():
    scene = hard_cases.resting(hard_cases.ball(), sleep=False)
    still, away = (motion(scene, 100, {0: line(100, x=x)}) for x in (0.0, 0.2))
    found = hard_cases.diverged([still, still, still, away])
    # 10 % of a metre is passed just after half of a second; the pair that never parts counts with its length.
    assert found["diverges after"] == pytest.approx((1.0 + 0.51) / 2, abs=0.011)


def moving(scene: Scene) -> list[Body]:
    return [b for b in scene.bodies if b.motion == "dynamic"]


def vertices(scene: Scene, body: Body) -> np.ndarray:
    """[V, 3] m, world."""
    return body.position + Rotation.from_quat(body.quat_xyzw).apply(scene.shapes[body.shape].mesh.vertices * body.scale)


def boxes(scene: Scene) -> np.ndarray:
    """[N, 2, 3] m, the boxes around the dynamic bodies."""
    corners = [vertices(scene, b) for b in moving(scene)]
    return np.array([[c.min(0), c.max(0)] for c in corners])


@pytest.mark.parametrize(("built", "count", "layers"), [("tower", 5, 5), ("pyramid", 10, 4), ("wall", 22, 5)])
def test_stacks_touch_without_overlap_and_each_body_has_something_below(built, count, layers):
    placed = boxes({"tower": hard_cases.tower, "pyramid": hard_cases.pyramid, "wall": hard_cases.wall}[built](layers))
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


def test_a_body_is_put_to_rest_on_the_floor_on_its_steady_face():
    cone = hard_cases.shape_from_primitive("cone", sdf="mesh")
    scene = hard_cases.resting(cone, sleep=True)
    assert scene.effects.sleep == "on"
    placed = vertices(scene, moving(scene)[0])
    assert placed[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    low = placed[placed[:, 2] < 1e-6]
    assert np.ptp(low[:, 0]) == pytest.approx(1.0, abs=0.01), "a cone stands on its base"


def test_every_case_has_a_name_of_its_own_and_the_short_form_is_shorter():
    long, short = cases(), cases(quick=True)
    assert len({case.name for case in long}) == len(long)
    assert {case.name for case in short} < {case.name for case in long}
    work = [sum(len(case.scenes(0)) * case.seconds for case in found) for found in (long, short)]
    assert work[1] < 0.5 * work[0]
