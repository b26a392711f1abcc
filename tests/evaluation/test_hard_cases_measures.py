"""Measures on motions whose figures are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Simulator
from sdfsim.dynamics.rollout import Rollout
from sdfsim.evaluation import hard_cases_measures as measure
from sdfsim.evaluation import hard_cases_scenes as scenes
from sdfsim.evaluation.hard_cases_depth import penetration
from sdfsim.evaluation.hard_cases_measures import Run
from sdfsim.scene.scene import Effects, Scene

DT = 0.01


def motion(scene: Scene, steps: int, moved=None, velocity=None) -> Rollout:
    """A rollout in which body k is displaced by `moved`[k] [T+1, 3] m and has `velocity`[k]; all others are still."""
    frames, count = steps + 1, len(scene.bodies)
    place = np.tile(np.array([b.position for b in scene.bodies]), (frames, 1, 1))
    turn = np.tile(np.array([b.quat_xyzw for b in scene.bodies]), (frames, 1, 1))
    speed = np.zeros((frames, count, 3))
    for k, path in (moved or {}).items():
        place[:, k] += path
    for k, values in (velocity or {}).items():
        speed[:, k] = values
    return Rollout(
        time=np.arange(frames) * DT,
        position=place,
        orientation=turn,
        velocity=speed,
        angular_velocity=np.zeros((frames, count, 3)),
        contact_count=np.zeros(frames, dtype=np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), dtype=np.int64),
        meta={"dt": DT},
    )


def line(steps: int, x=0.0, y=0.0, z=0.0) -> np.ndarray:
    """[steps + 1, 3] m, straight from 0 to (x, y, z)."""
    return np.linspace(0.0, 1.0, steps + 1)[:, None] * np.array([x, y, z])


def test_energy_is_what_the_simulator_counts():
    scene = replace(scenes.tossed((5,)), effects=Effects(contact="off"))
    rollout = Simulator(scene).run(steps=5)
    course = measure.energy(Run(scene, rollout))
    counted = rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]
    np.testing.assert_allclose(course, counted, rtol=1e-9)
    np.testing.assert_allclose(course, course[0], rtol=1e-6)


def test_a_motion_with_ten_times_the_energy_has_run_away_and_a_fall_has_not():
    scene = scenes.dropped(0.5, 0)
    time = np.arange(101) * DT
    fall = np.stack([0 * time, 0 * time, -5.0 * time**2], -1)
    falling = motion(scene, 100, {0: fall}, {0: np.stack([0 * time, 0 * time, -10.0 * time], -1)})
    assert measure.ran_away(Run(scene, falling)) == ""
    flung = replace(falling, velocity=falling.velocity.copy())
    flung.velocity[60:, 0] = [0.0, 0.0, 60.0]
    assert "0.60 s" in measure.ran_away(Run(scene, flung))


def test_a_creeping_body_drifts_by_what_it_creeps():
    scene = scenes.resting(scenes.box(2.0), sleep=False)
    run = Run(scene, motion(scene, 1000, {0: line(1000, x=0.3, y=0.4, z=-0.1)}))
    found = measure.rest([run], times=(5.0, 10.0)).figures
    assert found["drift 5 s"] == pytest.approx(12.5) and found["drift 10 s"] == pytest.approx(25.0)
    assert found["speed"] == pytest.approx(np.sqrt(0.3**2 + 0.4**2 + 0.1**2) / 10)
    assert found["height"] == pytest.approx(10.0) and found["motion"] == pytest.approx(0.04)
    assert measure.rest([Run(scene, motion(scene, 1000))], times=(10.0,)).figures["motion"] == 0.0


def test_what_has_sunk_has_fallen_and_the_others_shift():
    scene = scenes.tower(3)
    moved = {2: line(100, x=0.5, z=-1.0), 1: line(100, y=0.07)}
    found = measure.standing([Run(scene, motion(scene, 100, moved))])
    assert found.figures == {"fallen": 1.0, "shift": pytest.approx(7.0)}
    assert found.curve[1, -1] == pytest.approx(100 * np.sqrt(1.25))
    cards = scenes.card_house()
    assert measure.standing([Run(cards, motion(cards, 10, {0: line(10, z=-0.2)}))]).figures["fallen"] == 0


def test_penetration_is_the_overlap_of_two_cubes_and_of_one_with_the_floor():
    scene = scenes.tower(2)
    rollout = motion(scene, 20, {1: line(20, z=-0.1)})
    assert penetration(scene, rollout, every=20) == pytest.approx([0.1])
    assert measure.squeezed([Run(scene, rollout)]).figures == {"worst depth": pytest.approx(10.0), "fallen": 0.0}
    sunk = scenes.sunk(scenes.box(1.0))
    assert penetration(sunk, motion(sunk, 5), every=5) == pytest.approx([0.5])
    apart = scenes.overlapping(scenes.ball(), scenes.ball(), 1.2)
    assert (penetration(apart, motion(apart, 5), every=5) == 0).all()


def test_separation_tells_the_fastest_speed_and_what_is_left():
    scene = scenes.overlapping(scenes.box(1.0), scenes.box(1.0), 0.5)
    speed = {1: np.stack([[3.0 * np.sin(k / 50 * np.pi), 0, 0] for k in range(51)])}
    found = measure.separated([Run(scene, motion(scene, 50, {1: line(50, x=0.3)}, speed))]).figures
    assert found["exit speed"] == pytest.approx(3.0)
    # The deepest node of the one is 0.2 m from the other's nearest face.
    assert found["depth left"] == pytest.approx(20.0)


def test_only_what_is_below_the_plate_over_its_area_has_passed_it():
    scene = scenes.thrown_at_plate(5.0, 0)
    moved = {k: line(40, z=-0.4) for k in range(16)}
    assert measure.passed([Run(scene, motion(scene, 40, moved))]).figures["through"] == 0
    through = moved | {0: line(40, z=-0.8)}
    around = moved | {0: line(40, x=-3.0, z=-0.8)}
    assert measure.passed([Run(scene, motion(scene, 40, through))]).figures["through"] == pytest.approx(100 / 16)
    assert measure.passed([Run(scene, motion(scene, 40, around))]).figures["through"] == 0
    both = [Run(scene, motion(scene, 40, m)) for m in (moved, through)]
    assert measure.passed(both).worst == 1


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
    scene = scenes.dropped(wanted, 0)
    time = np.arange(131) * DT
    moved, speed = {}, {}
    for k in range(scenes.BALLS):
        height = scene.bodies[k].position[2] - 0.5
        low, rate = bouncing(height, e, time)
        moved[k] = np.stack([0 * time, 0 * time, low - height], -1)
        speed[k] = np.stack([0 * time, 0 * time, rate], -1)
    found = measure.rebound([Run(scene, motion(scene, 130, moved, speed))], restitution=wanted)
    assert found.figures["error"] == pytest.approx(error, abs=0.1)
    assert found.figures["rebound"] == pytest.approx(100 * e**2, abs=0.1)


@pytest.mark.parametrize("actual", [0.3, 0.4, 0.5])
def test_a_body_that_slides_by_coulombs_law_slips_at_its_friction(actual):
    offsets = (-6.0, -2.0, 2.0, 6.0)
    critical = np.degrees(np.arctan(0.4))
    runs = []
    for off in offsets:
        scene = scenes.slope(0.4, critical + off)
        runs.append(Run(scene, motion(scene, 200, {0: line(200, x=measure.slide(actual, critical + off, 2.0, 10.0))})))
    found = measure.slipped(runs, friction=0.4, offsets=offsets)
    assert found.figures["slips at"] == pytest.approx(np.degrees(np.arctan(actual)) - critical, abs=0.4)
    np.testing.assert_allclose(found.curve[0], offsets)


def test_a_body_that_never_slides_slips_at_the_steepest_angle_tried():
    scene = scenes.slope(0.4, 28.0)
    runs = [Run(scene, motion(scene, 200))] * 2
    assert measure.slipped(runs, friction=0.4, offsets=(-6.0, 6.0)).figures == {"slips at": 6.0, "error": 6.0}


def test_slide_is_the_closed_form():
    assert measure.slide(0.0, 30.0, 2.0, 10.0) == pytest.approx(10.0)
    assert measure.slide(0.4, 20.0, 2.0, 10.0) == 0.0
    assert measure.slide(0.4, 30.0, 2.0, 10.0) == pytest.approx(20.0 * (0.5 - 0.2 * np.sqrt(3.0)))


def test_who_crosses_the_wall_counts_and_who_comes_over_the_rim_does_not():
    scene = scenes.piled(8, 0)
    _, outer = scenes.bowl_radii(8)
    bowl = scene.bodies[8].position
    still = measure.heaped([Run(scene, motion(scene, 20))]).figures
    assert still["through the wall"] == 0 and still["energy gain"] == 0 and still["depth 95 %"] == 0
    start = scene.bodies[0].position - bowl
    out = line(20, *(np.array([2.0 * outer, 0, -0.2]) - start))
    assert measure.heaped([Run(scene, motion(scene, 20, {0: out}))]).figures["through the wall"] == 1
    up = np.array([0, 0, 1.0]) - start
    over = np.concatenate([line(10, *up), (up + line(10, x=2 * outer))[1:]])
    over[-3:, 2] -= 1.5
    assert measure.heaped([Run(scene, motion(scene, 20, {0: over}))]).figures["through the wall"] == 0


def test_steps_that_add_energy_are_counted():
    scene = scenes.dropped(0.5, 0)
    start = measure.energy(Run(scene, motion(scene, 1)))[0]
    one = scene.bodies[0]
    lifted = np.zeros((11, 3))
    lifted[4:, 2] = 0.05 * start / (10.0 * one.mass)  # one step adds 5 %
    lifted[8:, 2] += 0.005 * start / (10.0 * one.mass)  # another half a percent
    runs = [Run(scene, motion(scene, 10)), Run(scene, motion(scene, 10, {0: lifted}))]
    found = measure.created(runs)
    assert found.figures == {"steps with gain": pytest.approx(5.0), "worst gain": pytest.approx(5.0)}
    assert found.worst == 1


def test_a_turned_motion_deviates_by_what_it_is_off():
    scene = scenes.tower(2)
    path = line(50, x=0.4, y=0.1)
    turned = scenes.yawed(scene, 30.0)
    runs = [Run(scene, motion(scene, 50, {0: path}))]
    exact = Rotation.from_euler("z", 30, degrees=True).apply(path)
    assert measure.turned_back([*runs, Run(turned, motion(turned, 50, {0: exact}))], degrees=(0.0, 30.0)).figures[
        "deviation"
    ] == pytest.approx(0.0, abs=1e-10)
    off = Run(turned, motion(turned, 50, {0: exact + line(50, z=0.2)}))
    found = measure.turned_back([*runs, off], degrees=(0.0, 30.0))
    assert found.figures["deviation"] == pytest.approx(20.0 / np.sqrt(2)) and found.worst == 1


def test_divergence_is_timed_from_the_start():
    scene = scenes.resting(scenes.ball(), sleep=False)
    still, away = (Run(scene, motion(scene, 100, {0: line(100, x=x)})) for x in (0.0, 0.2))
    found = measure.diverged([still, still, still, away])
    # 10 % of a metre is passed just after half of a second; the pair that never parts counts with its length.
    assert found.figures["diverges after"] == pytest.approx((1.0 + 0.51) / 2, abs=0.011) and found.worst == 3
