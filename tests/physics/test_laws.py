"""Laws of a school book that the contact solve keeps, each in closed form, for bodies of 2 cm, 10 cm and 1 m."""

from math import atan, cos, pi, radians, sin, sqrt, tan

import numpy as np
import pytest

from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import ball, cube
from tests.helpers.scenes import make_body as body

G = 9.81  # m/s^2
STARTS = (0.95, 0.98, 1.0, 1.03, 1.07)
STILL = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(params=[0.02, 0.1, 1.0], ids="{:g}m".format)
def size(request) -> float:
    return request.param


def simulator(shapes: list[Shape], bodies: list[Body], *, tilt: float = 0.0, weight: float = 1.0) -> Simulator:
    """On a floor with coefficients 1, so that products are the bodies' own; gravity leans by `tilt` rad to +x."""
    floor = body("floor", len(shapes), [0, 0, 0], 0.0, motion="static", friction=1.0, restitution=1.0)
    gravity = weight * G * np.array([sin(tilt), 0.0, -cos(tilt)])
    return Simulator(Scene((*shapes, analytic_shape("plane")), (*bodies, floor), gravity, 1.0), "solver")


def run(shapes, bodies, seconds: float, **how) -> Rollout:
    return simulator(shapes, bodies, **how).run(seconds)


@pytest.mark.parametrize("e", [0.3, 0.5, 0.7, 0.9, 1.0])
def test_a_ball_comes_back_to_e_squared_of_its_height(size, e):
    found = []
    for start in STARTS:
        height = start * size
        dropped = body("ball", 0, [0, 0, size / 2 + height], restitution=e)
        motion = run([ball(size)], [dropped], 3.0 * sqrt(2 * height / G))
        z = motion.position[:, 0, 2] - size / 2
        found.append(z[int(np.argmax(motion.velocity[:, 0, 2] > 0)) :].max() / height)
    assert np.mean(found) == pytest.approx(e**2, abs=0.02 * e**2 + 0.01)
    assert np.std(found) < 0.02


@pytest.mark.parametrize("e", [0.2, 0.5, 0.8, 1.0])
def test_balls_that_meet_head_on_part_at_e_times_their_speed(size, e):
    for speed in (0.3, 1.0, 3.0):
        v = speed * sqrt(size)
        both = [
            body(n, 0, [x, 0, 10 * size], velocity=[-np.sign(x) * v / 2, 0, 0], restitution=sqrt(e))
            for n, x in (("a", -0.7 * size), ("b", 0.7 * size))
        ]
        after = run([ball(size)], both, 1.2 * size / v, weight=0.0).velocity[-1, :2, 0]
        assert after[1] - after[0] == pytest.approx(e * v, rel=0.01)
        assert abs(after.sum()) < 1e-9 * v


def test_a_rolling_ball_keeps_its_speed(size):
    v = 0.5 * sqrt(size)
    one = body("ball", 0, [0, 0, size / 2], velocity=[v, 0, 0], angular_velocity=[0, v / (size / 2), 0])
    motion = run([ball(size)], [one], 3.0 * sqrt(size))
    assert np.linalg.norm(motion.velocity[1:, 0], axis=1) == pytest.approx(v, rel=1e-3)


def test_a_ball_rolls_down_a_slope_by_five_sevenths_or_slips(size):
    t = 1.5 * sqrt(size)
    steep = radians(40)
    rolling = run([ball(size)], [body("b", 0, [0, 0, size / 2])], t, tilt=radians(10))
    assert 2 * rolling.position[-1, 0, 0] / t**2 == pytest.approx(5 / 7 * G * sin(radians(10)), rel=0.02)
    mu = 0.5 * 2 / 7 * tan(steep)
    slipping = run([ball(size)], [body("b", 0, [0, 0, size / 2], friction=mu)], t, tilt=steep)
    assert 2 * slipping.position[-1, 0, 0] / t**2 == pytest.approx(G * (sin(steep) - mu * cos(steep)), rel=0.02)


@pytest.mark.parametrize("mu", [0.2, 0.6])
def test_a_box_on_a_slope_holds_below_the_angle_of_friction_and_slides_above(size, mu):
    t = 1.5 * sqrt(size)
    for factor in (0.9, 0.97):
        held = run([cube(size)], [body("b", 0, [0, 0, size / 2], friction=mu)], t, tilt=factor * atan(mu))
        assert abs(held.position[-1, 0, 0]) < 1e-3 * size
    tilt = 1.1 * atan(mu)
    sliding = run([cube(size)], [body("b", 0, [0, 0, size / 2], friction=mu)], t, tilt=tilt)
    assert 2 * sliding.position[-1, 0, 0] / t**2 == pytest.approx(G * (sin(tilt) - mu * cos(tilt)), rel=0.02)


def test_a_sliding_box_stops_after_its_way(size):
    mu, v = 0.4, 2.0 * sqrt(size)
    motion = run([cube(size)], [body("b", 0, [0, 0, size / 2], friction=mu, velocity=[v, 0, 0])], 2 * v / (mu * G))
    assert motion.position[-1, 0, 0] == pytest.approx(v**2 / (2 * mu * G), rel=0.02)


@pytest.mark.parametrize("form", ["square", "disc"])
def test_a_spinning_plate_stops_in_time(size, form):
    """Pressure that is even over the plate stops it by the torque mu m g times the mean distance from its middle."""
    mu, spin, thin = 0.4, 5.0 / sqrt(size), 0.1 * size
    if form == "square":
        plate, lever, inertia = analytic_shape("box", size=(size, size, thin)), 0.3826 * size, size**2 / 6
    else:
        plate, lever, inertia = analytic_shape("cylinder", radius=size / 2, height=thin), size / 3, size**2 / 8
    one = body("plate", 0, [0, 0, thin / 2], friction=mu, angular_velocity=[0, 0, spin])
    wanted = spin * inertia / (mu * G * lever)
    motion = run([plate], [one], 2 * wanted)
    stopped = motion.time[int(np.argmax(np.abs(motion.angular_velocity[:, 0, 2]) < 0.01 * spin))]
    assert stopped == pytest.approx(wanted, rel=0.2)


@pytest.mark.parametrize("form", ["box", "cylinder", "sphere"])
def test_what_is_dropped_straight_lands_where_it_was_let_go_and_rests(size, form):
    shape = {
        "box": cube(size),
        "cylinder": analytic_shape("cylinder", radius=size / 2, height=size),
        "sphere": ball(size),
    }[form]
    motion = run([shape], [body("b", 0, [0, 0, size])], 10.0 * sqrt(size))
    assert np.linalg.norm(motion.position[-1, 0, :2]) < 1e-3 * size
    assert motion.position[-1, 0, 2] == pytest.approx(size / 2, abs=1e-3 * size)
    half = len(motion) // 2
    assert np.abs(motion.velocity[half:, 0]).max() < 1e-6 * sqrt(size)
    assert np.abs(motion.position[half:, 0] - motion.position[half, 0]).max() < 1e-6 * size


def test_a_capsule_lies_and_rolls(size):
    shape = analytic_shape("capsule", radius=size / 4, height=size)
    lying = np.array([0.0, sqrt(0.5), 0.0, sqrt(0.5)])
    v = 0.5 * sqrt(size)
    one = body("c", 0, [0, 0, size / 4], quat_xyzw=lying, velocity=[0, v, 0], angular_velocity=[-v / (size / 4), 0, 0])
    motion = run([shape], [one], 2.0 * sqrt(size))
    assert motion.velocity[-1, 0, 1] == pytest.approx(v, rel=0.01)
    assert motion.position[-1, 0, 2] == pytest.approx(size / 4, abs=2e-3 * size)


def stack(size: float, places) -> list[Body]:
    return [body(str(k), 0, np.asarray(p) * size) for k, p in enumerate(places)]


@pytest.mark.parametrize("count", [5, 10, 20])
def test_towers_stand(size, count):
    bodies = stack(size, [(0, 0, k + 0.5) for k in range(count)])
    motion = run([cube(size)], bodies, 5.0 * sqrt(size))
    moved = np.linalg.norm(motion.position[-1] - motion.position[0], axis=1)
    assert moved.max() < 0.1 * size


def test_a_pyramid_stands(size):
    places = [(1.02 * (k - 0.5 * (4 - row)), 0, row + 0.5) for row in range(5) for k in range(5 - row)]
    motion = run([cube(size)], stack(size, places), 5.0 * sqrt(size))
    assert np.linalg.norm(motion.position[-1] - motion.position[0], axis=1).max() < 0.1 * size


def test_a_tower_of_planks_stands(size):
    """Six layers of three planks, every other one turned by a right angle."""
    plank = analytic_shape("box", size=(size, 0.2 * size, 0.1 * size))
    across = np.array([0.0, 0.0, sqrt(0.5), sqrt(0.5)])
    bodies = []
    for layer in range(6):
        for k in (-0.4, 0.0, 0.4):
            place = [0, k * size, (layer + 0.5) * 0.1 * size]
            turned = layer % 2 == 1
            bodies.append(
                body(
                    f"{layer}{k}",
                    0,
                    place[1::-1] + place[2:] if turned else place,
                    quat_xyzw=across if turned else STILL,
                )
            )
    motion = run([plank], bodies, 5.0 * sqrt(size))
    assert np.linalg.norm(motion.position[-1] - motion.position[0], axis=1).max() < 0.01 * size


@pytest.mark.parametrize("ratio", [10.0, 30.0, 100.0])
def test_the_heavy_rests_on_the_light(size, ratio):
    bodies = [body(str(k), 0, [0, 0, (k + 0.5) * size], m) for k, m in enumerate((1.0, ratio))]
    sim = simulator([cube(size)], bodies)
    sim.options = sim.options._replace(sleep=False)
    motion = sim.run(3.0 * sqrt(size))
    assert np.linalg.norm(motion.position[-1] - motion.position[0], axis=1).max() < 0.01 * size
    touch = sim.state.touch
    inner = sim.options.dt / sim.options.substeps
    weight, gravity = np.zeros(3), np.linalg.norm(sim.options.gravity)
    for pair, count, point in zip(touch.pair, touch.count, touch.point, strict=True):
        weight[pair[1]] += point[:count, 10].sum() / inner / gravity
    masses = sim.bodies.mass
    assert weight[2] == pytest.approx(float(masses.sum()), rel=0.02)
    assert weight[1] == pytest.approx(float(masses[1]), rel=0.02)


@pytest.mark.parametrize("ratio", [300.0, 1000.0])
def test_the_very_heavy_stays_on_the_light(size, ratio):
    """A block beside the middle of another, for half a minute at 1 m: what sweeps left over had made it creep off."""
    bodies = [body("light", 0, [0, 0, 0.5 * size], 0.01), body("heavy", 0, [0.01 * size, 0, 1.5 * size], 0.01 * ratio)]
    sim = simulator([cube(size)], bodies)
    sim.options = sim.options._replace(sleep=False)
    motion = sim.run(30.0 * sqrt(size))
    assert np.linalg.norm(motion.position - motion.position[0], axis=2).max() < 1e-3 * size


@pytest.mark.parametrize("depth", [0.02, 0.2, 0.5])
def test_what_overlaps_parts_without_more_energy_than_its_depth(size, depth):
    motion = run([cube(size)], [body("b", 0, [0, 0, (0.5 - depth) * size])], 3.0 * sqrt(size))
    energy = 0.5 * (motion.velocity[:, 0] ** 2).sum(1) + G * (motion.position[:, 0, 2] - motion.position[0, 0, 2])
    assert energy.max() <= 1.02 * G * depth * size
    assert motion.position[-1, 0, 2] == pytest.approx(size / 2, abs=2e-3 * size)


@pytest.mark.parametrize("form", ["ball", "cube"])
@pytest.mark.parametrize("speed", [1.0, 5.0, 20.0, 50.0])
def test_nothing_passes_through_a_plate_of_a_hundredth(form, speed):
    plate = analytic_shape("box", size=(4.0, 4.0, 0.01))
    flying = body("b", 0, [0.1, 0.2, 3.0], velocity=[0, 0, -speed])
    wall = body("w", 1, [0, 0, 1.0], 0.0, motion="static")
    motion = run([ball(1.0) if form == "ball" else cube(1.0), plate], [flying, wall], 0.5)
    assert motion.position[:, 0, 2].min() > 1.4


def test_the_mean_levers_of_square_and_disc():
    """0.3826 is the mean distance of the points of a unit square from its middle."""
    x = (np.arange(1000) + 0.5) / 1000 - 0.5
    assert np.hypot(*np.meshgrid(x, x)).mean() == pytest.approx(0.3826, abs=1e-4)
    assert 2 * pi * (0.5**3 / 3) / (pi * 0.25) == pytest.approx(1 / 3)
