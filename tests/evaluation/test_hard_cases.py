"""The measures of motions and of hard cases are right on motions whose figures are known."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.engines import Ran, scene_rollout, start_motion
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.laws import hard_cases
from sdfsim.evaluation.laws.scenes import Check
from sdfsim.evaluation.metrics import compared, energy, energy_gain, resting, speeds, survival
from sdfsim.scene.scene import Scene
from tests.helpers.recordings import balls

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


def figures(checks: Iterable[Check]) -> dict[str, float]:
    return {check.name: check.measured for check in checks}


def cubes(*heights: float) -> Scene:
    """Cubes of a metre above the floor, with their middles at these heights m."""
    bodies = [hard_cases.body(f"{k}", 0, [0, 0, height]) for k, height in enumerate(heights)]
    return hard_cases.on_floor([hard_cases.box(1.0)], bodies)


def test_a_motion_with_ten_times_the_energy_has_run_away_and_a_fall_has_not():
    scene = cubes(1.5)
    time = np.arange(101) * DT
    fall = np.stack([0 * time, 0 * time, -5.0 * time**2], -1)
    falling = motion(scene, 100, {0: fall}, {0: np.stack([0 * time, 0 * time, -10.0 * time], -1)})
    assert hard_cases.ran_away(falling) == ""
    falling.motion.velocity[60:, 0] = [0.0, 0.0, 60.0]
    assert "0.60 s" in hard_cases.ran_away(falling)


def test_a_creeping_body_drifts_by_what_it_creeps():
    scene, path = hard_cases.resting(hard_cases.box(2.0), sleep=False), line(1000, x=0.3, y=0.4, z=-0.1)
    found = figures(hard_cases.rest([motion(scene, 1000, {0: path})], times=(5.0, 10.0)))
    wanted = {"drift 5 s": 12.5, "drift 10 s": 25.0, "speed": np.sqrt(0.26) / 10, "height": 10.0}
    assert found == pytest.approx(wanted)
    asleep = hard_cases.resting(hard_cases.box(2.0), sleep=True)
    assert figures(hard_cases.rest([motion(asleep, 1000, {0: path})], times=(10.0,)))["motion"] == pytest.approx(0.04)


def test_what_has_sunk_has_fallen_and_the_others_shift():
    moved = {2: line(100, x=0.5, z=-1.0), 1: line(100, y=0.07)}
    found = figures(hard_cases.standing([motion(cubes(0.5, 1.5, 2.5), 100, moved)]))
    assert found == {"fallen": 1.0, "shift": pytest.approx(7.0)}


def test_depth_is_the_overlap_of_two_cubes_and_of_one_with_the_floor():
    rollout = motion(cubes(0.5, 1.5), 20, {1: line(20, z=-0.1)})
    assert depths(rollout.scene, rollout.rollout).max() == pytest.approx(0.1, rel=1e-3)
    sunk = motion(cubes(0.0), 5)
    assert depths(sunk.scene, sunk.rollout) == pytest.approx([0.5], rel=1e-3)
    balls = motion(hard_cases.overlapping(hard_cases.ball(), hard_cases.ball(), 1.2), 5)
    assert (depths(balls.scene, balls.rollout) == 0).all()  # they touch the floor
    scene = hard_cases.overlapping(hard_cases.box(1.0), hard_cases.box(1.0), 0.5)
    speed = {1: np.stack([[3.0 * np.sin(k / 50 * np.pi), 0, 0] for k in range(51)])}
    found = figures(hard_cases.separated([motion(scene, 50, {1: line(50, x=0.3)}, speed)]))
    assert found == {"exit speed": pytest.approx(3.0), "depth left": pytest.approx(20.0, rel=1e-3)}


def test_only_what_is_below_the_plate_over_its_area_has_passed_it():
    scene = hard_cases.thrown_at_plate(5.0, 0)
    for first, wanted in (((0, -0.4), 0.0), ((0, -0.8), 100 / 16), ((-3.0, -0.8), 0.0)):
        moved = {k: line(40, z=-0.4) for k in range(16)} | {0: line(40, x=first[0], z=first[1])}
        assert figures(hard_cases.passed([motion(scene, 40, moved)]))["through"] == pytest.approx(wanted)


def test_who_crosses_the_wall_counts_and_who_comes_over_the_rim_does_not():
    scene = hard_cases.piled(8, 0)
    _, outer = hard_cases.bowl_radii(8, hard_cases.BOWL_BALL)
    start, up = scene.bodies[0].position - scene.bodies[8].position, np.array([0, 0, 1.0])
    over = np.concatenate([line(10, *(up - start)), (up - start + line(10, x=2 * outer))[1:]])
    over[-3:, 2] -= 1.5
    for path, crossed in ((line(20), 0), (line(20, *([2.0 * outer, 0, -0.2] - start)), 1), (over, 0)):
        assert figures(hard_cases.heaped([motion(scene, 20, {0: path})]))["through the wall"] == crossed


def test_steps_that_add_energy_are_counted():
    scene = cubes(1.5)
    start = hard_cases.energy(motion(scene, 1).motion)[0]
    lifted = np.zeros((11, 3))
    lifted[4:, 2] = 0.05 * start / (10.0 * scene.bodies[0].mass)  # one step adds 5 %
    lifted[8:, 2] += 0.005 * start / (10.0 * scene.bodies[0].mass)  # another half a percent
    found = figures(hard_cases.created([motion(scene, 10), motion(scene, 10, {0: lifted})]))
    assert found == pytest.approx({"steps with gain": 5.0, "worst gain": 5.0})


def test_a_turned_motion_deviates_by_what_it_is_off_and_divergence_is_timed():
    scene, path = cubes(0.5, 1.5), line(50, x=0.4, y=0.1)
    exact = Rotation.from_euler("z", 30, degrees=True).apply(path)
    runs = [motion(scene, 50, {0: path}), motion(hard_cases.yawed(scene, 30.0), 50, {0: exact + line(50, z=0.2)})]
    found = figures(hard_cases.turned_back(runs, degrees=(0.0, 30.0)))
    assert found["deviation"] == pytest.approx(20.0 / np.sqrt(2))
    still, away = (motion(scene, 100, {0: line(100, x=x)}) for x in (0.0, 0.2 * np.sqrt(2)))
    # 10 % of a metre is passed just after half of a second; the pair that never parts counts with its length.
    found = figures(hard_cases.diverged([still, still, still, away]))
    assert found["diverges after"] == pytest.approx((1.0 + 0.51) / 2, abs=0.011)


def test_translation_rmse_of_a_constant_offset_is_its_length():
    truth = balls(np.random.default_rng(0).normal(size=(7, 3, 3)))
    moved = replace(truth, position=truth.position + np.array([3.0, 4.0, 0.0]))
    assert compared(moved, truth, slice(None))[0] == pytest.approx(5.0)


def test_rotation_error_is_the_mean_angle_and_ignores_the_quaternions_sign():
    truth = Rotation.random(12, rng=np.random.default_rng(0))
    turn = Rotation.from_rotvec(np.repeat([[0.0, 0.0, np.radians(10)], [np.radians(30), 0.0, 0.0]], 6, axis=0))
    recorded, turned = (
        balls(np.zeros((6, 2, 3)), orientation=sign * turns.as_quat().reshape(6, 2, 4))
        for sign, turns in ((1.0, truth), (-1.0, truth * turn))
    )
    assert compared(turned, recorded, slice(None))[1] == pytest.approx(20.0)


def flight(seconds: float = 1.0, **fields):
    """A ball thrown from 20 m along an exact parabola, spinning."""
    time = np.arange(0.0, seconds, 0.02)[:, None, None]
    start, gravity = np.array([1.0, 2.0, -3.0]), np.array([0.0, 0.0, -10.0])
    position = np.array([0.0, 0.0, 20.0]) + start * time + 0.5 * gravity * time**2
    spin = np.tile([1.0, -2.0, 3.0], (len(time), 1, 1))
    return balls(position, velocity=start + gravity * time, angular_velocity=spin, **fields)


def test_the_energy_of_a_flying_body_is_constant_and_is_what_it_should_be():
    course = energy(flight(mass=np.array([2.0])))
    np.testing.assert_allclose(course, 0.5 * 2.0 * 14.0 + 0.5 * 0.1 * 14.0 + 2.0 * 10.0 * 20.0, rtol=1e-12)
    assert energy_gain([flight()])["worst"] == pytest.approx(0.0, abs=1e-12)


def test_spin_is_taken_about_the_bodys_own_axes():
    quarter = Rotation.from_euler("x", 90, degrees=True).as_quat()  # the body's z axis becomes the world's -y axis
    turned = balls(np.zeros((2, 1, 3)), orientation=np.tile(quarter, (2, 1, 1)), inertia=np.array([[1.0, 2.0, 3.0]]))
    turned = replace(turned, angular_velocity=np.tile([0.0, 4.0, 0.0], (2, 1, 1)))
    np.testing.assert_allclose(energy(turned), 0.5 * 3.0 * 16.0)


def test_a_springs_push_is_the_gain_and_scenery_has_no_part_in_it():
    """1 kg at rest 2 m up has 20 J; 3 m/s more are 4.5 J. The static body is heavy, and would drown that."""
    still = balls(np.tile([[0.0, 0.0, 2.0], [5.0, 0.0, 3.0]], (6, 1, 1)), static=np.array([False, True]))
    still = replace(still, mass=np.array([1.0, 1e6]))
    velocity = still.velocity.copy()
    velocity[3:, 0] = [3.0, 0.0, 0.0]
    velocity[5, 0] = 0.0
    found = energy_gain([replace(still, velocity=velocity), still, replace(still, position=0.0 * still.position)])
    assert found == {"mean": pytest.approx(4.5 / 40.0), "worst": pytest.approx(4.5 / 20.0)}
    assert energy_gain([replace(still, position=0.0 * still.position)]) == {"mean": None, "worst": None}


def test_what_rests_is_reported_by_displacement_in_the_last_steps():
    """Ball 0 creeps at 0.02 m/s, 1 stops only in the end, 2 is scenery; recorded velocities say nothing of it."""
    step = np.zeros((30, 3, 3))
    step[:, 0, 0] = 0.02 * 0.02
    step[:-5, 1, 1] = 0.1 * 0.02
    motion = balls(np.cumsum(step, axis=0), static=np.array([False, False, True]))
    np.testing.assert_allclose(speeds(motion)[:, 0], 0.02)
    assert speeds(motion).shape == (10, 3) and resting(motion).tolist() == [True, False, False]


def test_survivors_are_those_that_have_never_left():
    """Three of four leave 0.25 m, at frames 2, 4 and 6; one of them comes back, and stays lost."""
    truth, error = balls(np.zeros((8, 4, 3))), np.zeros((8, 4, 3))
    error[2, 0, 0], error[4:, 1, 1], error[6:, 2, 2] = 0.3, 0.25, 0.4
    found = survival([balls(error)], [truth])
    assert found == {"0.1": pytest.approx(0.12), "0.25": pytest.approx(0.12), "0.5": None}
