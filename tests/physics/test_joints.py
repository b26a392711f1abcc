"""Joints against closed forms, and against equations of motion integrated by scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from scipy.special import ellipk

from sdfsim import Rollout, Scene, Simulator

G = 9.81


def scene(**settings) -> Scene:
    return Scene(model="solver", **({"effects": {"sleep": "off"}} | settings))


def ball(radius: float) -> dict:
    return {"sphere": {"radius": radius}}


def period_of(time: np.ndarray, angle: np.ndarray) -> float:
    """The mean time between rising zeros of a swing."""
    up = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    at = time[up] - angle[up] * (time[up + 1] - time[up]) / (angle[up + 1] - angle[up])
    return (at[-1] - at[0]) / (len(at) - 1)


def energy_of(rollout: Rollout) -> np.ndarray:
    return rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]


def swinging(amplitude: float, kind: str, seconds: float) -> tuple[Rollout, float]:
    """A ball of 0.1 m on an arm of 1 m, let go at an angle from below; and its period by the elliptic integral."""
    built, start = scene(), (math.sin(amplitude), 0.0, -math.cos(amplitude))
    built.add("bob", **ball(0.1), position=start, mass=1.0, euler_xyz_deg=(0, -math.degrees(amplitude), 0))
    if kind == "hinge":
        built.join("arm", "hinge", "bob", anchor=(0, 0, 0), axis=(0, -1, 0), start_deg=math.degrees(amplitude))
    else:
        built.join("arm", "distance", "bob", anchor=start, to=(0, 0, 0), rod=1.0)
    turning = 0.4 * 0.1**2 if kind == "hinge" else 0.0  # the ball on a hinge turns with its arm
    period = 4.0 * math.sqrt((1.0 + turning) / G) * ellipk(math.sin(amplitude / 2) ** 2)
    return Simulator(built).run(seconds), period


@pytest.mark.parametrize("kind", ["hinge", "rod"])
@pytest.mark.parametrize("degrees", [1.0, 90.0])
def test_a_pendulum_swings_with_the_period_of_the_elliptic_integral(degrees: float, kind: str):
    rollout, period = swinging(math.radians(degrees), kind, 12.0)
    angle = np.arctan2(rollout.position[:, 0, 0], -rollout.position[:, 0, 2])
    assert period_of(rollout.time, angle) == pytest.approx(period, rel=1e-4)
    assert np.linalg.norm(rollout.position[:, 0], axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_a_pendulum_keeps_its_energy_for_a_minute():
    rollout, _ = swinging(math.radians(90.0), "hinge", 60.0)
    assert energy_of(rollout) == pytest.approx(energy_of(rollout)[0], abs=1e-3 * G)


def test_a_plate_swings_about_its_edge_as_a_physical_pendulum():
    size, start = (0.6, 0.05, 0.9), 0.4
    built = scene()
    rim = np.array([math.sin(start), -math.cos(start)]) * 0.45
    place = (0.0, rim[0], rim[1])
    built.add("plate", box={"size": size}, position=place, mass=3.0, euler_xyz_deg=(math.degrees(start), 0, 0))
    built.join("edge", "hinge", "plate", anchor=(0, 0, 0), axis=(1, 0, 0), start_deg=math.degrees(start))
    rollout = Simulator(built).run(8.0)
    about = 3.0 * ((0.05**2 + 0.9**2) / 12 + 0.45**2)
    period = 4.0 * math.sqrt(about / (3.0 * G * 0.45)) * ellipk(math.sin(start / 2) ** 2)
    assert period_of(rollout.time, rollout.joint_position[:, 0]) == pytest.approx(period, rel=1e-4)
    assert rollout.joint_position[0, 0] == pytest.approx(start)


def double_pendulum(angles: tuple[float, float]) -> Scene:
    """Two balls of 0.1 m, 1 kg and 2 kg, on arms of 1 m and 0.7 m, each of which turns with its arm."""
    one = np.array([math.sin(angles[0]), 0.0, -math.cos(angles[0])])
    two = one + 0.7 * np.array([math.sin(angles[1]), 0.0, -math.cos(angles[1])])
    built = scene()
    built.add("one", **ball(0.1), position=one, mass=1.0)
    built.add("two", **ball(0.1), position=two, mass=2.0)
    built.join("upper", "hinge", "one", anchor=(0, 0, 0), axis=(0, -1, 0), start_deg=math.degrees(angles[0]))
    built.join("lower", "hinge", "two", "one", anchor=one, axis=(0, -1, 0))
    return built


def test_a_double_pendulum_moves_as_its_equations_say_and_keeps_its_energy():
    start = (2.0, 1.2)
    rollout = Simulator(double_pendulum(start)).run(10.0)
    m, n, k, i = 1.0, 2.0, 0.7, 0.4 * 0.1**2

    def slope(_, y):
        a, b, u, v = y
        both = n * k * math.cos(a - b)
        mass = np.array([[m + n + m * i, both], [both, n * k**2 + n * i]])
        force = [
            -n * k * v**2 * math.sin(a - b) - (m + n) * G * math.sin(a),
            n * k * u**2 * math.sin(a - b) - n * G * k * math.sin(b),
        ]
        return [u, v, *np.linalg.solve(mass, force)]

    until = np.flatnonzero(rollout.time <= 3.0)
    truth = solve_ivp(slope, (0, 3.0), [*start, 0, 0], "DOP853", rollout.time[until], rtol=1e-11, atol=1e-11).y
    angle = np.unwrap(np.arctan2(rollout.position[until, 0, 0], -rollout.position[until, 0, 2]))
    assert angle == pytest.approx(truth[0], abs=2e-3)
    energy = energy_of(rollout)
    assert energy == pytest.approx(energy[0], abs=1e-3 * (3 * G * 1.0 + 2 * G * 0.7))


def test_a_slider_on_a_slope_is_braked_by_its_friction():
    slope, built = math.radians(30.0), scene()
    down = np.array([math.cos(slope), 0.0, -math.sin(slope)])
    built.add("cart", box={"size": (0.3, 0.2, 0.1)}, position=(0, 0, 0), mass=2.0, euler_xyz_deg=(0, 30, 0))
    built.join("rail", "slider", "cart", axis=down, friction=4.0)
    built.add("held", box={"size": (0.3, 0.2, 0.1)}, position=(0, 2, 0), mass=2.0, euler_xyz_deg=(0, 30, 0))
    built.join("brake", "slider", "held", axis=down, anchor=(0, 2, 0), friction=10.0)
    simulator = Simulator(built)
    rollout = simulator.run(1.0)
    pull = G * math.sin(slope) - 4.0 / 2.0
    assert rollout.joint_position[:, 0] == pytest.approx(0.5 * pull * rollout.time**2, abs=1e-3 * 0.5 * pull)
    assert simulator.joint("rail").speed == pytest.approx(pull * rollout.time[-1], rel=1e-3)
    assert rollout.joint_position[:, 1] == pytest.approx(0.0, abs=1e-9)
    # The rail carries what is across it, and the friction.
    across = 2.0 * G * math.cos(slope) * np.array([math.sin(slope), 0.0, math.cos(slope)])
    assert simulator.joint("rail").force == pytest.approx(across - 4.0 * down, abs=1e-3 * 2.0 * G)


def test_a_ball_on_a_rope_goes_round_as_a_conical_pendulum():
    length, lean = 1.0, math.radians(35.0)
    rate = math.sqrt(G / (length * math.cos(lean)))
    start = np.array([math.sin(lean), 0.0, -math.cos(lean)])
    built = scene()
    built.add("bob", **ball(0.05), position=start, mass=0.5, velocity=(0, rate * math.sin(lean), 0))
    built.join("rope", "distance", "bob", anchor=start, to=(0, 0, 0), rope=length)
    simulator = Simulator(built)
    rollout = simulator.run(6.0)
    turned = np.unwrap(np.arctan2(rollout.position[:, 0, 1], rollout.position[:, 0, 0]))
    assert turned == pytest.approx(rate * rollout.time, abs=1e-3 * rate * 6.0)
    assert rollout.joint_position[:, 0].max() <= length * (1 + 1e-3)
    assert np.linalg.norm(simulator.joint("rope").force) == pytest.approx(0.5 * G / math.cos(lean), rel=1e-3)


def test_a_slack_rope_lets_a_ball_fall_freely_and_then_holds_it():
    built = scene()
    built.add("bob", **ball(0.05), position=(0, 0, -0.2), mass=0.5)
    built.join("rope", "distance", "bob", anchor=(0, 0, -0.2), to=(0, 0, 0), rope=0.8)
    rollout = Simulator(built).run(1.0)
    free = rollout.time < math.sqrt(2 * 0.6 / G) - 0.01
    assert rollout.position[free, 0, 2] == pytest.approx(-0.2 - 0.5 * G * rollout.time[free] ** 2, abs=1e-9)
    assert rollout.position[-1, 0, 2] == pytest.approx(-0.8, abs=1e-4)


def test_a_door_is_closed_by_its_spring_and_bounces_at_its_limit():
    """Each time it comes back to its limit it has the energy of the spring, of which e^2 is left."""
    built = scene(gravity=(0, 0, -9.81))
    built.add("leaf", box={"size": (0.8, 0.04, 2.0)}, position=(0.4, 0, 1.0), mass=20.0)
    about = 20.0 * ((0.8**2 + 0.04**2) / 12 + 0.4**2)
    built.join(
        "door", "hinge", "leaf", anchor=(0, 0, 1), axis=(0, 0, 1), start_deg=60, limits_deg=(0, 110), restitution=0.6,
        spring={"stiffness": about * 4.0},
    )  # fmt: skip
    rollout = Simulator(built).run(6.0)
    angle = rollout.joint_position[:, 0]
    closes = math.pi / 2 / 2.0  # a quarter of the spring's period, at 2 rad/s
    before = rollout.time < closes - 0.01
    assert angle[before] == pytest.approx(math.radians(60) * np.cos(2.0 * rollout.time[before]), abs=1e-3)
    tops = [angle[k] for k in range(1, len(angle) - 1) if angle[k - 1] < angle[k] >= angle[k + 1]]
    assert tops[0] == pytest.approx(0.6 * math.radians(60), rel=0.01)
    assert tops[1] == pytest.approx(0.36 * math.radians(60), rel=0.02)
    assert angle.min() >= -1e-4


def test_a_motor_works_against_friction_and_holds_its_speed():
    built = scene(gravity=(0, 0, 0))
    about = 0.5 * 4.0 * 0.3**2
    built.add("wheel", cylinder={"radius": 0.3, "height": 0.1}, mass=4.0)
    motor = {"speed": 5.0, "max_force": 2.0}
    built.join("axle", "hinge", "wheel", anchor=(0, 0, 0), axis=(0, 0, 1), friction=0.5, motor=motor)
    simulator = Simulator(built)
    rate = (2.0 - 0.5) / about
    rollout = simulator.run(0.4)
    assert rollout.angular_velocity[:, 0, 2] == pytest.approx(rate * rollout.time, abs=1e-3 * rate * 0.4)
    given = np.cumsum(rollout.counters["energy_given"])[-1]
    assert given == pytest.approx(2.0 * rollout.joint_position[-1, 0], rel=1e-3)
    simulator.step(simulator.steps_in(1.0))
    assert simulator.joint("axle").speed == pytest.approx(5.0, rel=1e-6)
    # Weaker than its friction, it stops the wheel.
    simulator.joint("axle").target = 0.0
    simulator.step(simulator.steps_in(1.0))
    assert simulator.joint("axle").speed == pytest.approx(0.0, abs=1e-9)


def test_a_motor_goes_to_its_place_and_holds_it_against_gravity():
    built = scene()
    built.add("arm", box={"size": (0.6, 0.1, 0.1)}, position=(0.3, 0, 0), mass=1.0)
    motor = {"position_deg": 40.0, "max_force": 20.0}
    built.join("shoulder", "hinge", "arm", anchor=(0, 0, 0), axis=(0, -1, 0), motor=motor)
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(2.0))
    shoulder = simulator.joint("shoulder")
    assert shoulder.angle == pytest.approx(math.radians(40.0), abs=1e-4)
    assert shoulder.torque[1] == pytest.approx(-1.0 * G * 0.3 * math.cos(math.radians(40.0)), rel=1e-3)
    shoulder.target = -0.5
    simulator.step(simulator.steps_in(2.0))
    assert shoulder.angle == pytest.approx(-0.5, abs=1e-4)


def test_damping_slows_a_wheel_exponentially():
    built = scene(gravity=(0, 0, 0))
    about = 0.5 * 4.0 * 0.3**2
    built.add("wheel", cylinder={"radius": 0.3, "height": 0.1}, mass=4.0, angular_velocity=(0, 0, 6))
    built.join("axle", "hinge", "wheel", anchor=(0, 0, 0), axis=(0, 0, 1), damping=about * 3.0)
    rollout = Simulator(built).run(1.0)
    assert rollout.angular_velocity[:, 0, 2] == pytest.approx(6.0 * np.exp(-3.0 * rollout.time), rel=1e-3)


def test_a_four_bar_linkage_moves_as_its_closed_form():
    """A crank turns evenly; coupler and rocker follow from the two circles in which the coupler's end may be."""
    crank, coupler, rocker, ground = 0.3, 0.9, 0.7, 1.0
    a = np.array([crank, 0.0])

    def joined(angle: float, near: np.ndarray) -> np.ndarray:
        p = crank * np.array([math.cos(angle), math.sin(angle)])
        return np.array(fsolve(lambda q: [np.hypot(*(q - p)) - coupler, np.hypot(*(q - [ground, 0])) - rocker], near))

    b = joined(0.0, np.array([0.9, 0.6]))
    built = scene(gravity=(0, 0, 0))

    def bar(name: str, one: np.ndarray, two: np.ndarray) -> None:
        middle, way = 0.5 * (one + two), two - one
        turn = math.degrees(math.atan2(way[1], way[0]))
        size = (float(np.hypot(*way)), 0.04, 0.04)
        built.add(name, box={"size": size}, position=(*middle, 0), euler_xyz_deg=(0, 0, turn), mass=1.0)

    for name, one, two in (("crank", 0 * a, a), ("coupler", a, b), ("rocker", b, np.array([ground, 0.0]))):
        bar(name, one, two)
    up = {"axis": (0, 0, 1)}
    built.join("shaft", "hinge", "crank", anchor=(0, 0, 0), motor={"speed": 4.0, "max_force": 1000.0}, **up)
    built.join("pin", "hinge", "coupler", "crank", anchor=(*a, 0), **up)
    built.join("pin2", "hinge", "rocker", "coupler", anchor=(*b, 0), **up)
    built.join("pivot", "hinge", "rocker", anchor=(ground, 0, 0), **up)
    rollout = Simulator(built).run(2.0)
    for k in range(0, len(rollout.time), 10):
        b = joined(rollout.joint_position[k, 0], b)
        assert rollout.position[k, 2, :2] == pytest.approx(0.5 * (b + np.array([ground, 0.0])), abs=1e-4)
    assert rollout.joint_position[-1, 0] == pytest.approx(4.0 * rollout.time[-1], rel=5e-3)


@pytest.mark.parametrize("held_by", ["world", "other"])
def test_a_spinning_ball_on_a_ball_joint_is_braked_by_its_friction(held_by):
    """The torque of friction opposes the spin about any axis, has its full strength until the spin ends, and then
    holds; on another body in free space it acts as well."""
    built, spin = scene(gravity=(0, 0, 0)), np.array([3.0, -2.0, 6.0])
    built.add("ball", **ball(0.2), mass=1.5, angular_velocity=spin.tolist())
    built.add("other", **ball(0.3), mass=2.0, position=(0, 0, 0 if held_by == "other" else 5))
    built.join("socket", "ball", "ball", held_by, anchor=(0, 0, 0), friction=0.3)
    own, others = 0.4 * 1.5 * 0.2**2, 0.4 * 2.0 * 0.3**2
    rollout, rate = Simulator(built).run(1.2), np.linalg.norm(spin)
    slowing = 0.3 / own + (0.3 / others if held_by == "other" else 0.0)
    end = own / (own + others) if held_by == "other" else 0.0  # share of the spin that both have at last
    left = np.maximum(1.0 - slowing / rate * rollout.time, 0.0)
    assert left[-1] == 0.0 < left[len(left) // 5]
    seen = rollout.angular_velocity[:, 0] - rollout.angular_velocity[:, 1]
    assert seen == pytest.approx(left[:, None] * spin, abs=2e-2)
    assert rollout.angular_velocity[-1, 0] == pytest.approx(end * spin, abs=1e-6)


def door(built: Scene, deep: float) -> tuple[dict, float]:
    """On a vertical hinge, in the floor."""
    built.add("floor", plane={})
    built.add("it", box={"size": (0.8, 0.04, 2.0)}, position=(0.4, 0, 1 - deep), mass=20.0, velocity=(0, 0.4, 0),
              angular_velocity=(0, 0, 1))  # fmt: skip
    return {"type": "hinge", "anchor": (0, 0, 1), "axis": (0, 0, 1)}, 0.4


def drawer(built: Scene, deep: float) -> tuple[dict, float]:
    """Between two shelves that are too near to each other."""
    for name, z in (("low", -0.05), ("high", 0.25)):
        built.add(name, box={"size": (1, 0.6, 0.1)}, position=(0, 0, z), motion="static")
    built.add("it", box={"size": (0.6, 0.4, 0.2 + 2 * deep)}, position=(0, 0, 0.1), mass=5.0, velocity=(0.5, 0, 0))
    return {"type": "slider", "axis": (1, 0, 0)}, 0.5


def cart(built: Scene, deep: float) -> tuple[dict, float]:
    """On a rail above the floor, driven by a motor."""
    built.add("floor", plane={}, friction=0.0)
    built.add("it", box={"size": (0.3, 0.3, 0.3)}, position=(0, 0, 0.15 - deep), mass=5.0, velocity=(0.5, 0, 0))
    return {"type": "slider", "axis": (1, 0, 0), "motor": {"speed": 0.5, "max_force": 500.0}}, 0.5


@pytest.mark.parametrize("deep", [0.0, 5e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("kind", [door, drawer, cart])
def test_a_joint_bears_what_pushes_where_it_allows_no_motion(kind, deep):
    """Bodies that overlap in a direction in which a joint holds them stay on the joint, which bears their weight. They
    were thrown off at up to 1e12 m/s."""
    built = scene()
    joint, speed = kind(built, deep)
    built.join("joint", joint.pop("type"), "it", **joint)
    simulator = Simulator(built)
    rollout = simulator.run(1.0)
    row = rollout.names.index("it")
    assert np.ptp(rollout.position[:, row, 2]) < 1e-6
    assert np.linalg.norm(rollout.velocity[:, row], axis=-1) == pytest.approx(speed, abs=1e-4)
    weight = (20.0 if kind is door else 5.0) * G
    assert simulator.joint("joint").force[2] == pytest.approx(weight, rel=1e-3)


def rod(joint: dict, gravity: float = G, **more) -> Simulator:
    """A rod of 0.5 m and 2 kg, level, on a hinge at its end about y."""
    built = scene(gravity=(0, 0, -gravity))
    built.add("rod", box={"size": (0.5, 0.05, 0.05)}, position=(0.25, 0, 0), mass=2.0, **more)
    built.join("pin", "hinge", "rod", anchor=(0, 0, 0), axis=(0, 1, 0), **joint)
    return Simulator(built)


ABOUT_END = 2.0 * ((0.5**2 + 0.05**2) / 12 + 0.25**2)  # kg m^2
WEIGHT = 2.0 * G * 0.25  # N m about the end, level


@pytest.mark.parametrize(
    ("limits", "start"),
    [((0, 720), 0), ((-720, 0), 0), ((0, 720), 400), ((-900, 10), -500), ((0, 360), 0), ((0, 360), 360), (None, 270)],
)
def test_a_hinge_starts_at_the_angle_that_is_given(limits, start):
    """A pose shows an angle up to full turns only."""
    ends = {"limits_deg": limits} if limits else {"spring": {"stiffness": 5.0, "rest_deg": start}}
    simulator = rod({"start_deg": start, **ends}, gravity=0.0)
    for _ in range(2):
        assert math.degrees(simulator.joint("pin").angle) == pytest.approx(start, abs=1e-9)
        assert simulator.joint("pin").speed == pytest.approx(0.0, abs=1e-9)
        simulator.step(20)


def test_jointed_bodies_with_nothing_to_touch_swing():
    free, alone = rod({}), rod({}, collides_with=[])
    free.step(50)
    alone.step(50)
    assert alone.joint("pin").angle == pytest.approx(free.joint("pin").angle, abs=1e-12)
    assert alone.contact_points() == []


MOTORS = {
    "as strong as it takes": {"position_deg": 0, "max_force": 50.0},
    "keen": {"position_deg": 0, "max_force": 50.0, "time": 0.02},
    "weak": {"position_deg": 0, "max_force": 2.0},
    "with a gain": {"position_deg": 0, "max_force": 50.0, "gain": 60.0, "time": 0.05},
    "speed": {"speed": 0.0, "max_force": 3.0},
}


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS.keys())
@pytest.mark.parametrize("gravity", [0.0, G])
def test_the_work_of_a_motor_is_what_energy_grows_by(motor: dict, gravity: float):
    simulator = rod({"motor": motor}, gravity)
    start, goal = simulator.initial_rollout(), 3.0 if "speed" in motor else 0.5
    simulator.step(3)
    simulator.joint("pin").target = goal
    after = list(simulator.frames(60))
    energy = np.concatenate([energy_of(part) for part in (start, *after)])
    given = np.concatenate([part.counters["energy_given"] for part in after])
    swing = max(np.ptp(energy), 0.1)
    assert np.abs(np.cumsum(given) - (energy[1:] - energy[0])).max() < 2e-3 * swing


def test_a_gripper_that_lifts_makes_no_energy():
    """Targets change in each step while contacts hold: what the solve knows of impulses stays valid."""
    built = scene()
    built.add("floor", plane={}, friction=1.0)
    built.add("cup", box={"size": (0.06, 0.06, 0.1)}, position=(0, 0, 0.05), mass=0.3, friction=1.0)
    built.add("hand", box={"size": (0.2, 0.1, 0.02)}, position=(0, 0, 0.3), mass=1.0)
    for name, x in (("left", -0.06), ("right", 0.06)):
        built.add(name, box={"size": (0.02, 0.04, 0.16)}, position=(x, 0, 0.16), mass=0.1, friction=1.0)
        close = {"position": 0.05, "max_force": 20.0}
        built.join(f"{name} rail", "slider", name, "hand", axis=(-np.sign(x), 0, 0), motor=close)
    built.join("lift", "slider", "hand", axis=(0, 0, 1), motor={"position": 0.0, "max_force": 100.0})
    simulator = Simulator(built)
    parts = list(simulator.frames(80))
    for k in range(200):
        simulator.joint("lift").target = 0.2 + 0.05 * math.sin(0.3 * k)
        parts += list(simulator.frames(1))
    energy = np.concatenate([energy_of(part) for part in parts])
    given = np.concatenate([part.counters["energy_given"] for part in parts])
    gained = np.diff(energy) - given[1:]
    assert simulator["cup"].position[2] > 0.15
    assert np.cumsum(gained).max() < 0.01 * 1.5 * G * 0.2  # of what lifts all of it
    assert simulator["cup"].position[:2] == pytest.approx([0.0, 0.0], abs=1e-4)


@pytest.mark.parametrize("gain", [50.0, 1e3, 1e5, 1e7])
@pytest.mark.parametrize("time", [0.0, 0.02, 0.3])
def test_a_motor_with_a_gain_sags_by_the_load_over_it(gain: float, time: float):
    simulator = rod({"motor": {"position_deg": 0, "max_force": 1e6, "gain": gain, "time": time}, "damping": 3.0})
    simulator.step(2000)
    angle = simulator.joint("pin").angle
    assert angle == pytest.approx(WEIGHT * math.cos(angle) / gain, rel=1e-3)
    assert simulator.joint("pin").speed == pytest.approx(0.0, abs=max(1e-3 * WEIGHT / gain, 1e-8))


@pytest.mark.parametrize(("gain", "time"), [(20.0, 0.0), (20.0, 0.02), (20.0, 0.3), (400.0, 0.01)])
def test_a_motor_with_a_gain_moves_as_a_damped_oscillator(gain: float, time: float):
    rollout = rod({"motor": {"position_deg": 30, "max_force": 1e6, "gain": gain, "time": time}}, gravity=0.0).run(2.0)

    def rates(_: float, y: np.ndarray) -> list[float]:
        return [y[1], gain * (math.pi / 6 - y[0] - time * y[1]) / ABOUT_END]

    known = solve_ivp(rates, (0.0, 3.0), [0.0, 0.0], t_eval=rollout.time, rtol=1e-9, atol=1e-12).y[0]
    assert np.abs(rollout.joint_position[:, 0] - known).max() < 0.01 * math.pi / 6


def test_a_motor_with_a_gain_has_friction_and_a_largest_torque_beside_it():
    motor = {"position_deg": 60, "max_force": 1.0, "gain": 20.0, "time": 0.02}
    weak = rod({"motor": motor}, gravity=0.0).run(0.3)
    assert weak.joint_position[-1, 0] == pytest.approx(0.5 * weak.time[-1] ** 2 / ABOUT_END, rel=2e-3)
    stiff = rod({"motor": {"speed": 2.0, "max_force": 100.0, "gain": 3.0}, "friction": 0.5}, gravity=0.0)
    stiff.step(300)
    assert stiff.joint("pin").speed == pytest.approx(2.0 - 0.5 / 3.0, rel=1e-4)
    pushed = rod({"motor": motor | {"gain": 1e-5}}, gravity=0.0)
    pushed.joint("pin").effort = 0.8
    pushed.step(20)
    assert pushed.joint("pin").speed == pytest.approx(0.8 * pushed.steps_done * pushed.dt / ABOUT_END, rel=1e-6)
    stuck = rod({"motor": motor | {"position_deg": 1.0}, "friction": 0.5}, gravity=0.0)
    stuck.step(100)
    assert abs(stuck.joint("pin").angle) < 1e-12  # 20 N m/rad of a degree is less than the friction


@pytest.mark.parametrize(("stiffness", "damping"), [(1e3, 25.9), (1e6, 245.0), (1e4, 3.0)])
def test_a_lever_on_a_spring_rests_where_its_weight_says(stiffness: float, damping: float):
    simulator = rod({"spring": {"stiffness": stiffness}, "damping": damping})
    simulator.step(3000)
    assert simulator.joint("pin").angle == pytest.approx(WEIGHT / stiffness, rel=1e-3)
    assert simulator.joint("pin").speed == pytest.approx(0.0, abs=1e-6)


def test_a_target_at_the_joint_s_own_reading_is_within_its_limits(recwarn):
    simulator = rod({"limits_deg": (0, 90), "motor": {"position_deg": 0, "max_force": 50.0}})
    simulator.step(100)
    for _ in range(20):
        simulator.joint("pin").target = simulator.joint("pin").angle
        simulator.step(1)
    assert not recwarn
    with pytest.warns(UserWarning, match="beyond the limits"):
        simulator.joint("pin").target = -0.01


@pytest.mark.parametrize(
    "hold", [None, {"position_deg": 0, "max_force": 400}, {"position_deg": 0, "max_force": 40, "gain": 90}]
)
def test_the_work_of_two_motors_of_an_arm_is_what_energy_grows_by(hold: dict | None):
    built = scene(gravity=(0, 0, 0))
    built.add("upper", box={"size": (0.5, 0.05, 0.05)}, position=(0.25, 0, 0), mass=2.0)
    built.add("lower", box={"size": (0.5, 0.05, 0.05)}, position=(0.75, 0, 0), mass=1.0)
    built.join(
        "shoulder", "hinge", "upper", anchor=(0, 0, 0), axis=(0, 1, 0), motor={"position_deg": 0, "max_force": 100}
    )
    built.join(
        "elbow", "hinge", "lower", "upper", anchor=(0.5, 0, 0), axis=(0, 1, 0), **({"motor": hold} if hold else {})
    )
    simulator = Simulator(built)
    simulator.joint("shoulder").target = 3.0
    rollout = simulator.run(2.0)
    energy = energy_of(rollout)
    off = np.cumsum(rollout.counters["energy_given"]) - (energy - energy[0])
    assert np.abs(off).max() < 1e-3 * np.ptp(energy)
