"""Laws of joints: closed forms, and equations of motion that SciPy integrates. Scenes are of about a metre, in SI."""

from collections.abc import Iterator
from math import acos, atan2, cos, degrees, pi, radians, sin, sqrt
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve
from scipy.special import ellipk

from sdfsim.evaluation.laws.scenes import Check, G, Ran, Setting, run_built
from sdfsim.scene.builder import SceneBuilder

ABOUT_Z: dict[str, Any] = {"axis": (0, 0, 1)}
LEVEL: dict[str, Any] = {"anchor": (0, 0, 0), "axis": (0, -1, 0)}  # about y, from +x upwards


def scene(gravity: float = G) -> SceneBuilder:
    return SceneBuilder(model="solver", gravity=(0, 0, -gravity), effects={"sleep": "off"})


def off(ran: Ran, what: str, measured: Any, wanted: Any, limit: float, unit: str = "") -> Check:
    """A check of the largest difference of two arrays."""
    return ran.most(f"{what} off by", float(np.abs(np.asarray(measured) - wanted).max()), limit, unit)


def at_end(rollout: Any, joint: int, what: str = "position") -> Any:
    """A joint's position, force or torque in the last frame."""
    return getattr(rollout, f"joint_{what}")[-1, joint]


# --- one joint ---


def _period(time: np.ndarray, angle: np.ndarray) -> float:
    """The mean time between rising zeros of a swing."""
    up = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    zero = time[up] - angle[up] * (time[up + 1] - time[up]) / (angle[up + 1] - angle[up])
    return float(zero[-1] - zero[0]) / (len(zero) - 1)


def pendulums(at: Setting) -> Iterator[Check]:
    """A ball of 0.1 m on an arm of 1 m, on a hinge or a rod, and a plate on its edge swing with the periods of the
    elliptic integral."""
    for kind in ("hinge", "rod"):
        for swing in (1.0, 90.0):
            start = radians(swing)
            place = (sin(start), 0.0, -cos(start))
            built = scene().add("bob", sphere={"radius": 0.1}, position=place, mass=1.0, euler_xyz_deg=(0, -swing, 0))
            if kind == "hinge":
                built.join("arm", "hinge", "bob", start_deg=swing, **LEVEL)
            else:
                built.join("arm", "distance", "bob", anchor=place, to=(0, 0, 0), rod=1.0)
            ran = run_built(at, f"{kind}, {swing:g} degrees", built, 60.0 if kind == "hinge" and swing > 1 else 12.0)
            turning = 0.4 * 0.1**2 if kind == "hinge" else 0.0  # on a hinge the ball turns with its arm
            period = 4.0 * sqrt((1.0 + turning) / G) * ellipk(sin(start / 2) ** 2)
            path = ran.rollout.position[:, 0]
            yield ran.near("period", _period(ran.time, np.arctan2(path[:, 0], -path[:, 2])), period, 1e-4, "s")
            yield off(ran, "length", np.linalg.norm(path, axis=1), 1.0, 1e-6, "m")
            yield off(ran, "energy", ran.energy(), ran.energy()[0], 1e-3 * G, "J")
    start, size = 0.4, (0.6, 0.05, 0.9)
    place = (0.0, 0.45 * sin(start), -0.45 * cos(start))
    built = scene().add("plate", box={"size": size}, position=place, mass=3.0, euler_xyz_deg=(degrees(start), 0, 0))
    built.join("edge", "hinge", "plate", anchor=(0, 0, 0), axis=(1, 0, 0), start_deg=degrees(start))
    ran = run_built(at, "plate", built, 8.0)
    about = (0.05**2 + 0.9**2) / 12 + 0.45**2
    period = 4.0 * sqrt(about / (G * 0.45)) * ellipk(sin(start / 2) ** 2)
    yield ran.near("period", _period(ran.time, ran.rollout.joint_position[:, 0]), period, 1e-4, "s")
    yield ran.near("angle at the start", ran.rollout.joint_position[0, 0], start, 1e-6, "rad")


def sliders(at: Setting) -> Iterator[Check]:
    """Carts on a slope, braked by the friction of their rails, which carry what is across them."""
    down = np.array([cos(pi / 6), 0.0, -sin(pi / 6)])
    built = scene()
    for k, friction in enumerate((4.0, 10.0)):
        place = (0, 2 * k, 0)
        built.add(f"cart {k}", box={"size": (0.3, 0.2, 0.1)}, position=place, mass=2.0, euler_xyz_deg=(0, 30, 0))
        built.join(f"rail {k}", "slider", f"cart {k}", axis=down, anchor=place, friction=friction)
    ran = run_built(at, "slope of 30 degrees", built, 1.0)
    pull, rollout = G * sin(pi / 6) - 4.0 / 2.0, ran.rollout
    yield off(ran, "way", rollout.joint_position[:, 0], 0.5 * pull * ran.time**2, 1e-3 * 0.5 * pull, "m")
    yield ran.near("speed", rollout.velocity[-1, 0] @ down, pull * ran.time[-1], 1e-3, "m/s")
    yield off(ran, "what friction holds", rollout.joint_position[:, 1], 0.0, 1e-9, "m")
    across = 2.0 * G * cos(pi / 6) * np.array([sin(pi / 6), 0.0, cos(pi / 6)])
    yield off(ran, "force", at_end(rollout, 0, "force"), across - 4.0 * down, 2e-3 * G, "N")


def ropes(at: Setting) -> Iterator[Check]:
    """A ball goes round on a rope as a conical pendulum; a slack rope lets a ball fall freely and then holds it."""
    lean = radians(35.0)
    rate, start = sqrt(G / cos(lean)), np.array([sin(lean), 0.0, -cos(lean)])
    built = scene().add(
        "bob", sphere={"radius": 0.05}, position=start, mass=0.5, velocity=(0, rate * sin(lean), 0)
    ).join("rope", "distance", "bob", anchor=start, to=(0, 0, 0), rope=1.0)  # fmt: skip
    ran = run_built(at, "conical pendulum", built, 6.0)
    path = ran.rollout.position[:, 0]
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    yield off(ran, "angle", turned, rate * ran.time, 6e-3 * rate, "rad")
    yield ran.most("length", ran.rollout.joint_position[:, 0].max(), 1.0 + 1e-3, "m")
    yield ran.near("pull", np.linalg.norm(at_end(ran.rollout, 0, "force")), 0.5 * G / cos(lean), 1e-3, "N")
    built = scene().add("bob", sphere={"radius": 0.05}, position=(0, 0, -0.2), mass=0.5)
    built.join("rope", "distance", "bob", anchor=(0, 0, -0.2), to=(0, 0, 0), rope=0.8)
    ran = run_built(at, "slack rope", built, 1.0)
    free = ran.time < sqrt(2 * 0.6 / G) - 0.01
    height = ran.rollout.position[:, 0, 2]
    yield off(ran, "fall", height[free], -0.2 - 0.5 * G * ran.time[free] ** 2, 1e-9, "m")
    yield off(ran, "height at the end", height[-1], -0.8, 1e-4, "m")


def doors(at: Setting) -> Iterator[Check]:
    """A door is closed by its spring, and comes back from its limit with the part e of the angle each time."""
    about, rate = 20.0 * ((0.8**2 + 0.04**2) / 12 + 0.4**2), 2.0
    built = scene().add("leaf", box={"size": (0.8, 0.04, 2.0)}, position=(0.4, 0, 1.0), mass=20.0)
    built.join(
        "door", "hinge", "leaf", anchor=(0, 0, 1), start_deg=60, limits_deg=(0, 110), restitution=0.6,
        spring={"stiffness": about * rate**2}, **ABOUT_Z,
    )  # fmt: skip
    ran = run_built(at, "door", built, 3.5)
    angle = ran.rollout.joint_position[:, 0]
    before = ran.time < pi / 2 / rate - 0.01  # a quarter of the spring's period
    yield off(ran, "angle", angle[before], pi / 3 * np.cos(rate * ran.time[before]), 1e-3, "rad")
    tops = angle[1:-1][(angle[:-2] < angle[1:-1]) & (angle[1:-1] >= angle[2:])]
    for k in range(2):
        top = tops[k] if k < len(tops) else 0.0
        yield ran.near(f"top of bounce {k + 1}", top, 0.6 ** (k + 1) * pi / 3, 0.01 * (k + 1), "rad")
    yield ran.between("least angle", angle.min(), -1e-4, 1e-2, "rad")


def _wheel(**joint: Any) -> tuple[SceneBuilder, float]:
    """A wheel on an axle, and its inertia."""
    built = scene(0.0).add("wheel", cylinder={"radius": 0.3, "height": 0.1}, mass=4.0, angular_velocity=(0, 0, 6))
    return built.join("axle", "hinge", "wheel", anchor=(0, 0, 0), **ABOUT_Z, **joint), 0.5 * 4.0 * 0.3**2


def damping(at: Setting) -> Iterator[Check]:
    """Damping slows a wheel exponentially."""
    built, _ = _wheel(damping=0.5 * 4.0 * 0.3**2 * 3.0)
    ran = run_built(at, "wheel", built, 1.0)
    yield off(ran, "speed", ran.rollout.angular_velocity[:, 0, 2] / np.exp(-3.0 * ran.time), 6.0, 6e-3, "rad/s")


def motors(at: Setting) -> Iterator[Check]:
    """A motor works against friction with its full strength, and then holds its speed; another goes to its place, and
    holds it against gravity."""
    built, about = _wheel(friction=0.5, motor={"speed": 11.0, "max_force": 2.0})
    rate = (2.0 - 0.5) / about
    ran = run_built(at, "wheel", built, 1.0)
    speed, rollout = ran.rollout.angular_velocity[:, 0, 2], ran.rollout
    rising = ran.time < 5.0 / rate - 0.02
    yield off(ran, "speed", speed[rising], 6.0 + rate * ran.time[rising], 6e-4 * rate, "rad/s")
    yield off(ran, "speed at the end", speed[-1], 11.0, 1e-5, "rad/s")
    given, turned = np.cumsum(rollout.counters["energy_given"])[rising], rollout.joint_position[rising, 0]
    yield ran.near("work", given[-1], 2.0 * turned[-1], 1e-3, "J")
    built, _ = _wheel(friction=3.0, motor={"speed": 11.0, "max_force": 2.0})
    yield off(
        ran := run_built(at, "weak motor", built, 1.2), "speed", ran.rollout.angular_velocity[-1], 0.0, 1e-9, "rad/s"
    )
    arm = scene().add("arm", box={"size": (0.6, 0.1, 0.1)}, position=(0.3, 0, 0), mass=1.0)
    arm.join("shoulder", "hinge", "arm", motor={"position_deg": 40.0, "max_force": 20.0}, **LEVEL)
    ran = run_built(at, "arm", arm, 2.0)
    yield off(ran, "angle", at_end(ran.rollout, 0), radians(40.0), 1e-4, "rad")
    yield ran.near("torque", at_end(ran.rollout, 0, "torque")[1], -G * 0.3 * cos(radians(40.0)), 1e-3, "N m")


# A rod of 0.5 m and 2 kg, level, on a hinge at its end about y.
ROD = (0.5, 0.05, 0.05)  # m
ABOUT_END = 2.0 * ((0.5**2 + 0.05**2) / 12 + 0.25**2)  # kg m^2
WEIGHT = 2.0 * G * 0.25  # N m about the end, level


def rod(gravity: float, **joint: Any) -> SceneBuilder:
    built = scene(gravity).add("rod", box={"size": ROD}, position=(0.25, 0, 0), mass=2.0)
    return built.join("pin", "hinge", "rod", **LEVEL, **joint)


def levers(at: Setting) -> Iterator[Check]:
    """A lever on a spring, or on a motor with a gain, sags by the load over the stiffness."""
    for stiffness, drag in ((1e3, 25.9), (1e6, 245.0), (1e4, 3.0)):
        ran = run_built(at, f"{stiffness:g} N m/rad", rod(G, spring={"stiffness": stiffness}, damping=drag), 20.0)
        angle = at_end(ran.rollout, 0)
        yield ran.near("rests at", angle, -WEIGHT * cos(angle) / stiffness, 1e-3, "rad")
        yield off(ran, "speed", ran.rollout.angular_velocity[-1], 0.0, 1e-6, "rad/s")
    for gain in (50.0, 1e3, 1e7):
        for time in (0.0, 0.3):
            motor = {"position_deg": 0, "max_force": 1e6, "gain": gain, "time": time}
            ran = run_built(at, f"gain {gain:g}, time {time:g}", rod(G, motor=motor, damping=3.0), 20.0)
            angle = at_end(ran.rollout, 0)
            yield ran.near("rests at", angle, -WEIGHT * cos(angle) / gain, 1e-3, "rad")
            yield off(ran, "speed", ran.rollout.angular_velocity[-1], 0.0, max(1e-3 * WEIGHT / gain, 1e-8), "rad/s")


def servos(at: Setting) -> Iterator[Check]:
    """A motor with a gain moves as a damped oscillator, with at most its strength, and less by friction."""
    for gain, time in ((20.0, 0.0), (20.0, 0.02), (20.0, 0.3), (400.0, 0.01)):
        motor: dict[str, Any] = {"position_deg": 30, "max_force": 1e6, "gain": gain, "time": time}
        ran = run_built(at, f"gain {gain:g}, time {time:g}", rod(0.0, motor=motor), 2.0)

        def rates(_: float, y: np.ndarray, gain: float = gain, time: float = time) -> list[float]:
            return [y[1], gain * (pi / 6 - y[0] - time * y[1]) / ABOUT_END]

        known = solve_ivp(rates, (0.0, 3.0), [0.0, 0.0], t_eval=ran.time, rtol=1e-9, atol=1e-12).y[0]
        yield off(ran, "angle", ran.rollout.joint_position[:, 0], known, 0.01 * pi / 6, "rad")
    ran = run_built(at, "weak", rod(0.0, motor={"position_deg": 60, "max_force": 1.0, "gain": 20.0, "time": 0.02}), 0.3)
    yield ran.near("angle", at_end(ran.rollout, 0), 0.5 * ran.time[-1] ** 2 / ABOUT_END, 2e-3, "rad")
    ran = run_built(at, "friction", rod(0.0, motor={"speed": 2.0, "max_force": 100.0, "gain": 3.0}, friction=0.5), 3.5)
    yield ran.near("speed", -ran.rollout.angular_velocity[-1, 0, 1], 2.0 - 0.5 / 3.0, 1e-4, "rad/s")
    stuck = {"position_deg": 1.0, "max_force": 1.0, "gain": 20.0, "time": 0.02}
    ran = run_built(at, "stuck", rod(0.0, motor=stuck, friction=0.5), 1.0)  # 20 N m/rad of a degree is less than that
    yield off(ran, "angle", ran.rollout.joint_position, 0.0, 1e-12, "rad")


def work(at: Setting) -> Iterator[Check]:
    """The work of motors is what energy grows by."""
    motors: dict[str, dict[str, Any]] = {
        "as strong as it takes": {"position_deg": 29, "max_force": 50.0},
        "keen": {"position_deg": 29, "max_force": 50.0, "time": 0.02},
        "weak": {"position_deg": 29, "max_force": 2.0},
        "with a gain": {"position_deg": 29, "max_force": 50.0, "gain": 60.0, "time": 0.05},
        "speed": {"speed": 3.0, "max_force": 3.0},
    }
    made = {f"{name}, g = {g:g}": rod(g, motor=motor) for name, motor in motors.items() for g in (0.0, G)}
    for name, hold in {
        "free": {},
        "held": {"motor": {"position_deg": 0, "max_force": 400}},
        "soft": {"motor": {"position_deg": 0, "max_force": 40, "gain": 90}},
    }.items():
        arm = rod(0.0, motor={"position_deg": 170, "max_force": 100})
        arm.add("lower", box={"size": ROD}, position=(0.75, 0, 0), mass=1.0)
        arm.join("elbow", "hinge", "lower", "rod", anchor=(0.5, 0, 0), axis=(0, 1, 0), **hold)
        made[f"arm, elbow {name}"] = arm
    for label, built in made.items():
        ran = run_built(at, label, built, 2.0 if "arm" in label else 0.7)
        energy = ran.energy()
        gained = np.cumsum(ran.rollout.counters["energy_given"]) - (energy - energy[0])
        yield ran.most("not accounted for", np.abs(gained).max() / max(np.ptp(energy), 0.1), 2e-3)


def sockets(at: Setting) -> Iterator[Check]:
    """Friction in a ball joint opposes the spin about any axis with its full torque until the spin ends, and then
    holds; on another body in free space as well."""
    spin = np.array([3.0, -2.0, 6.0])
    for beside in (False, True):
        built = scene(0.0).add("ball", sphere={"radius": 0.2}, mass=1.5, angular_velocity=spin)
        built.add("other", sphere={"radius": 0.3}, mass=2.0, position=(0, 0, 0 if beside else 5))
        built.join("socket", "ball", "ball", "other" if beside else "world", anchor=(0, 0, 0), friction=0.3)
        own, others = 0.4 * 1.5 * 0.2**2, 0.4 * 2.0 * 0.3**2
        ran = run_built(at, "on another body" if beside else "on the world", built, 1.2)
        slowing = 0.3 / own + (0.3 / others if beside else 0.0)
        left = np.maximum(1.0 - slowing / np.linalg.norm(spin) * ran.time, 0.0)
        seen = ran.rollout.angular_velocity[:, 0] - ran.rollout.angular_velocity[:, 1]
        yield off(ran, "spin", seen, left[:, None] * spin, 2e-2, "rad/s")
        share = own / (own + others) if beside else 0.0  # of the spin that both have at last
        yield off(ran, "spin at the end", ran.rollout.angular_velocity[-1, 0], share * spin, 1e-6, "rad/s")


def blocked(at: Setting) -> Iterator[Check]:
    """A joint bears what pushes where it allows no motion: a door in the floor, a drawer between shelves that are too
    near to each other, a driven cart in the floor."""
    for deep in (0.0, 5e-4, 1e-2):
        door = scene().add("floor", plane={})
        door.add("it", box={"size": (0.8, 0.04, 2.0)}, position=(0.4, 0, 1 - deep), mass=20.0, velocity=(0, 0.4, 0),
                 angular_velocity=(0, 0, 1)).join("joint", "hinge", "it", anchor=(0, 0, 1), **ABOUT_Z)  # fmt: skip
        drawer = scene()
        for name, z in (("low", -0.05), ("high", 0.25)):
            drawer.add(name, box={"size": (1, 0.6, 0.1)}, position=(0, 0, z), motion="static")
        size = (0.6, 0.4, 0.2 + 2 * deep)
        drawer.add("it", box={"size": size}, position=(0, 0, 0.1), mass=5.0, velocity=(0.5, 0, 0))
        drawer.join("joint", "slider", "it", axis=(1, 0, 0))
        cart = scene().add("floor", plane={}, friction=0.0)
        cart.add("it", box={"size": (0.3, 0.3, 0.3)}, position=(0, 0, 0.15 - deep), mass=5.0, velocity=(0.5, 0, 0))
        cart.join("joint", "slider", "it", axis=(1, 0, 0), motor={"speed": 0.5, "max_force": 500.0})
        for name, built, speed, mass in (("door", door, 0.4, 20), ("drawer", drawer, 0.5, 5), ("cart", cart, 0.5, 5)):
            ran = run_built(at, f"{name}, {1e3 * deep:g} mm deep", built, 1.0)
            row = ran.rollout.names.index("it")
            yield off(ran, "height", ran.rollout.position[:, row, 2], ran.rollout.position[0, row, 2], 1e-6, "m")
            yield off(ran, "speed", np.linalg.norm(ran.rollout.velocity[:, row], axis=1), speed, 1e-4, "m/s")
            yield ran.near("weight", at_end(ran.rollout, 0, "force")[2], mass * G, 1e-3, "N")


def breaks(at: Setting) -> Iterator[Check]:
    """A joint breaks at its load and not before; what breaks in an impact does not hold against it."""
    built = scene()
    for name, mass, x in (("light", 1.0, 0.0), ("heavy", 3.0, 1.0)):
        built.add(name, sphere={"radius": 0.1}, position=(x, 0, -0.5), mass=mass)
        built.join(name, "fixed", name, anchor=(x, 0, -0.5), breaks_at={"force": 20.0})
    ran = run_built(at, "20 N", built, 0.5)
    light, heavy = ran.rollout.position[-1, :2, 2] + 0.5
    yield off(ran, "height of 1 kg", light, 0.0, 1e-6, "m")
    yield ran.most("height of 3 kg", heavy, -1.0, "m")
    after = []
    for bolted in (True, False):
        built = scene(0.0).add("block", box={"size": (0.2, 0.2, 0.2)}, mass=2.0, restitution=0.5)
        built.add("ball", sphere={"radius": 0.1}, position=(-0.5, 0, 0), velocity=(5, 0, 0), mass=1.0, restitution=1.0)
        if bolted:
            built.join("bolt", "fixed", "block", breaks_at={"force": 50.0})
        ran = run_built(at, "blow", built, 0.3)
        after.append(ran.rollout.velocity[-1])
    yield off(ran, "velocities", after[0], after[1], 1e-9, "m/s")
    yield ran.near("speed", after[0][0, 0], 1.5 * 5.0 / 3.0, 1e-6, "m/s")


# --- several joints ---


def double_pendulum(at: Setting) -> Iterator[Check]:
    """Two balls of 0.1 m, 1 kg and 2 kg, on arms of 1 m and 0.7 m, each of which turns with its arm."""
    start, m, n, k, i = (2.0, 1.2), 1.0, 2.0, 0.7, 0.4 * 0.1**2
    one = np.array([sin(start[0]), 0.0, -cos(start[0])])
    built = scene().add("one", sphere={"radius": 0.1}, position=one, mass=m)
    built.add("two", sphere={"radius": 0.1}, position=one + k * np.array([sin(1.2), 0.0, -cos(1.2)]), mass=n)
    built.join("upper", "hinge", "one", start_deg=degrees(start[0]), **LEVEL)
    built.join("lower", "hinge", "two", "one", anchor=one, axis=(0, -1, 0))
    ran = run_built(at, "double pendulum", built, 10.0)

    def slope(_: float, y: np.ndarray) -> list[float]:
        a, b, u, v = y
        both = n * k * cos(a - b)
        mass = np.array([[m + n + m * i, both], [both, n * k**2 + n * i]])
        force = [
            -n * k * v**2 * sin(a - b) - (m + n) * G * sin(a),
            n * k * u**2 * sin(a - b) - n * G * k * sin(b),
        ]
        return [u, v, *np.linalg.solve(mass, force)]

    until = np.flatnonzero(ran.time <= 3.0)
    truth = solve_ivp(slope, (0, 3.0), [*start, 0, 0], "DOP853", ran.time[until], rtol=1e-11, atol=1e-11).y
    path = ran.rollout.position[until, 0]
    yield off(ran, "angle", np.unwrap(np.arctan2(path[:, 0], -path[:, 2])), truth[0], 2e-3, "rad")
    yield off(ran, "energy", ran.energy(), ran.energy()[0], 1e-3 * G * ((m + n) * 1.0 + n * k), "J")


def linkages(at: Setting) -> Iterator[Check]:
    """Four bars: a crank turns evenly; coupler and rocker follow from the two circles in which the coupler's end may
    be."""
    crank, coupler, rocker, ground = 0.3, 0.9, 0.7, 1.0

    def joined(angle: float, near: np.ndarray) -> np.ndarray:
        p = crank * np.array([cos(angle), sin(angle)])
        return np.array(fsolve(lambda q: [np.hypot(*(q - p)) - coupler, np.hypot(*(q - [ground, 0])) - rocker], near))

    a, end = np.array([crank, 0.0]), np.array([ground, 0.0])
    b = joined(0.0, np.array([0.9, 0.6]))
    built = scene(0.0)
    for name, one, two in (("crank", 0 * a, a), ("coupler", a, b), ("rocker", b, end)):
        middle, way = 0.5 * (one + two), two - one
        turn, size = degrees(atan2(way[1], way[0])), (float(np.hypot(*way)), 0.04, 0.04)
        built.add(name, box={"size": size}, position=(*middle, 0), euler_xyz_deg=(0, 0, turn), mass=1.0)
    built.join("shaft", "hinge", "crank", anchor=(0, 0, 0), motor={"speed": 4.0, "max_force": 1000.0}, **ABOUT_Z)
    built.join("pin", "hinge", "coupler", "crank", anchor=(*a, 0), **ABOUT_Z)
    built.join("pin2", "hinge", "rocker", "coupler", anchor=(*b, 0), **ABOUT_Z)
    built.join("pivot", "hinge", "rocker", anchor=(ground, 0, 0), **ABOUT_Z)
    ran = run_built(at, "four bars", built, 2.0)
    wanted = []
    for angle in ran.rollout.joint_position[:, 0]:
        b = joined(angle, b)
        wanted.append(0.5 * (b + end))
    yield off(ran, "rocker", ran.rollout.position[:, 2, :2], wanted, 1e-4, "m")
    yield ran.near("crank's angle", at_end(ran.rollout, 0), 4.0 * ran.time[-1], 5e-3, "rad")


def _hanging(count: int, length: float, span: float) -> tuple[np.ndarray, float]:
    """The slopes [count] rad of equal rigid links between two points at one height, and the pull across in weights of a
    link: where moments about a link's middle are in balance, its slope is half of the pulls up at both ends over that
    across."""
    up = np.arange(count) - 0.5 * (count - 1)

    def slopes(pull: float) -> np.ndarray:
        return np.arctan(up / pull)

    pull = float(np.array(brentq(lambda h: length * np.cos(slopes(h)).sum() - span, 1e-3, 1e6)))
    return slopes(pull), pull


def _middles(slopes: np.ndarray, length: float) -> np.ndarray:
    way = length * np.stack([np.cos(slopes), np.zeros(len(slopes)), np.sin(slopes)], 1)
    return np.cumsum(way, 0) - 0.5 * way


def _linked(slopes: np.ndarray, size: tuple[float, float, float], mass: float, kind: Any, **keys: Any) -> SceneBuilder:
    """Links along x, joined at their ends and to the world, with `slopes` [K] rad."""
    built, count = scene(), len(slopes)
    middle = _middles(slopes, size[0])
    way = 0.5 * size[0] * np.stack([np.cos(slopes), np.zeros(count), np.sin(slopes)], 1)
    for k, slope in enumerate(slopes):
        form: dict[str, Any] = (
            {"shape": "link0"} if k else {"box": {"size": size}}
        )  # a shape of its own each would take longer
        turn = (0, -degrees(slope), 0)
        built.add(f"link{k}", **form, position=middle[k], euler_xyz_deg=turn, mass=mass, friction=0.8)
        built.join(f"joint{k}", kind, f"link{k}", f"link{k - 1}" if k else "world", anchor=middle[k] - way[k], **keys)
    return built.join(f"joint{count}", kind, f"link{count - 1}", anchor=middle[-1] + way[-1], **keys)


def chains(at: Setting) -> Iterator[Check]:
    """A chain of a hundred links hangs as its own equilibrium, and one of thirty that is let go aside falls into it."""
    slopes, pull = _hanging(100, 0.05, 3.5)
    ran = run_built(at, "100 links", _linked(slopes, (0.05, 0.01, 0.01), 0.02, "ball", damping=1e-4), 2.0)
    path, first = ran.rollout.position, ran.rollout.position[0]
    yield off(ran, "links", path, first, -1e-3 * first[:, 2].min(), "m")
    wanted = 0.02 * G * np.array([-pull, 0.0, 50.0])
    yield off(
        ran, "force at the end", at_end(ran.rollout, 0, "force"), wanted, 2e-3 * float(np.linalg.norm(wanted)), "N"
    )
    slopes, _ = _hanging(30, 0.1, 2.2)
    bent = np.where(np.arange(30) < 15, -1.0, 1.0) * acos(2.2 / 3.0)
    ran = run_built(at, "30 links", _linked(bent, (0.1, 0.02, 0.02), 0.1, "ball", damping=0.08), 20.0)
    yield off(ran, "links", ran.rollout.position[-1], _middles(slopes, 0.1), 3e-3, "m")


def bridges(at: Setting) -> Iterator[Check]:
    """A bridge of forty planks carries a tonne."""
    slopes, _ = _hanging(40, 0.25, 9.6)
    built = _linked(slopes, (0.25, 1.2, 0.05), 12.5, "hinge", axis=(0, 1, 0), damping=40.0)
    place = (4.8, 0, 0.25 * np.sin(slopes[:20]).sum() + 0.36)
    built.add("tonne", box={"size": (1.0, 1.0, 0.6)}, position=place, mass=1000.0, friction=0.8)
    ran = run_built(at, "bridge", built, 12.0)
    later = ran.time > 9.0  # a mean, as it still swings a little
    carried = ran.rollout.joint_force[later][:, [0, 40], 2].mean(0).sum()
    yield ran.near("carried", carried, (40 * 12.5 + 1000) * G, 1e-2, "N")
    yield off(ran, "height of the tonne", ran.rollout.position[-50, -1, 2], ran.rollout.position[-1, -1, 2], 2e-3, "m")
    yield from ran.laws()


def cradles(at: Setting) -> Iterator[Check]:
    """Newton's cradle throws off as many balls as come in; gears turn as their teeth count."""
    built, swing = scene(), radians(30.0)
    for k in range(5):
        top, angle = np.array([k * 0.100001, 0.0, 0.0]), 0.0 if k else -swing
        place = top + 0.5 * np.array([sin(angle), 0.0, -cos(angle)])
        built.add(f"ball{k}", sphere={"radius": 0.05}, position=place, mass=0.5, friction=0.0, restitution=1.0)
        built.join(f"rod{k}", "distance", f"ball{k}", anchor=place, to=top, rod=0.5)
    ran = run_built(at, "cradle", built, 1.1)
    height, full = ran.rollout.position[:, :, 2] + 0.5, 0.5 * (1.0 - cos(swing))
    yield ran.near("height of the last ball", height[:, 4].max(), full, 0.03, "m")
    yield ran.most("height of the others", height[:, 1:4].max(), 0.02 * full, "m")
    yield off(ran, "energy", ran.energy(), ran.energy()[0], 0.02 * 0.5 * G * full, "J")

    built = scene(0.0)
    for name, teeth, pitch, x, first in (("small", 8, 0.2, 0.0, 0.0), ("large", 12, 0.3, 0.5, pi + pi / 12)):
        built.add(name, cylinder={"radius": pitch - 0.08, "height": 0.1}, position=(x, 0, 0), mass=1.0)
        for k in range(teeth):
            angle = first + 2.0 * pi * k / teeth
            place = np.array([x, 0, 0]) + (pitch - 0.005) * np.array([cos(angle), sin(angle), 0.0])
            form: dict[str, Any] = (
                {"shape": "small 0"} if built.bodies[-1]["name"] != "small" else {"box": {"size": (0.09, 0.05, 0.1)}}
            )
            turn = (0, 0, degrees(angle))
            built.add(
                f"{name} {k}", **form, euler_xyz_deg=turn, position=place, mass=0.1, friction=0.1, restitution=0.0
            )
            built.join(f"{name} tooth {k}", "fixed", f"{name} {k}", name)
    built.join("drive", "hinge", "small", anchor=(0, 0, 0), motor={"speed": 2.0, "max_force": 50.0}, **ABOUT_Z)
    built.join("driven", "hinge", "large", anchor=(0.5, 0, 0), friction=0.2, **ABOUT_Z)
    ran = run_built(at, "gears", built, 4.0)
    drive, driven = ran.rollout.joint_position[-1, -2:]
    yield ran.near("angle of the first", drive, 8.0, 0.05, "rad")
    yield ran.near("angle of the second", driven, -drive * 8 / 12, 0.0, "rad", 0.2)


def governors(at: Setting) -> Iterator[Check]:
    """Watt's governor: arms and rods of one length from the spindle to two balls and on to a sleeve, at rest where
    w^2 h = g (m + M) / m."""
    length, ball, sleeve = 0.4, 1.0, 1.5
    for rate in (9.0, 11.0):
        height = G * (ball + sleeve) / (ball * rate**2)
        lean, spin = acos(height / length) + 0.05, (0, 0, rate)
        low = (0.0, 0.0, -2.0 * length * cos(lean))
        built = scene().add("spindle", cylinder={"radius": 0.02, "height": 1.2}, position=(0, 0, -0.5), mass=2.0)
        built.add("sleeve", cylinder={"radius": 0.05, "height": 0.1}, position=low, mass=sleeve, angular_velocity=spin)
        built.join("shaft", "hinge", "spindle", anchor=(0, 0, 0), motor={"speed": rate, "max_force": 500.0}, **ABOUT_Z)
        built.join("guide", "slider", "sleeve", "spindle", anchor=low, damping=20.0, **ABOUT_Z)
        for k, side in enumerate((1.0, -1.0)):
            place = np.array([side * length * sin(lean), 0.0, -length * cos(lean)])
            moving = {"velocity": (0.0, rate * place[0], 0.0), "angular_velocity": spin}
            built.add(f"ball{k}", sphere={"radius": 0.05}, position=place, mass=ball, **moving)
            built.join(f"arm{k}", "hinge", f"ball{k}", "spindle", anchor=(0, 0, 0), axis=(0, 1, 0))
            built.join(f"rod{k}", "distance", f"ball{k}", "sleeve", anchor=place, to=low, rod=length)
        ran = run_built(at, f"{rate:g} rad/s", built, 4.0)
        yield ran.near("height", ran.rollout.position[-1, 2, 2], -height, 2e-3, "m")


def loads(at: Setting) -> Iterator[Check]:
    """Masses of one to a hundred hang on each other; a load of up to a thousand links swings on a taut rope of them,
    and one of a hundred pulls a slack rope taut with some damping."""
    for ratio in (100.0, 0.01):
        built = scene()
        for k in range(6):
            mass = 1.0 if k < 5 else ratio
            moving = (0.5, 0, 0) if k == 5 else (0, 0, 0)
            built.add(f"link{k}", box={"size": (0.1, 0.1, 0.3)}, position=(0, 0, -0.15 - 0.3 * k), mass=mass,
                      velocity=moving)  # fmt: skip
            built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=(0, 0, -0.3 * k))
        ran = run_built(at, f"five links of 1 kg and one of {ratio:g} kg", built, 3.0)
        yield off(ran, "energy", ran.energy(), ran.energy()[1], 1e-3 * (5 + ratio) * G * 0.1, "J")
        yield ran.most("joints that do not hold", sum("joint" in law for law in ran.verdict.broken), 0)
    way = np.array([sin(0.5), 0.0, -cos(0.5)])
    for ratio in (100.0, 1000.0):
        built = scene()
        for k in range(20):
            built.add(f"link{k}", capsule={"radius": 0.01, "height": 0.1}, position=(0.1 * k + 0.05) * way,
                      euler_xyz_deg=(0, -degrees(0.5), 0), mass=0.1)  # fmt: skip
            built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=0.1 * k * way)
        built.add("load", sphere={"radius": 0.1}, position=2.1 * way, mass=0.1 * ratio)
        built.join("hook", "ball", "load", "link19", anchor=2.0 * way)
        ran = run_built(at, f"{ratio:g} times a link's mass", built, 6.0)
        swing = 0.1 * ratio * G * 2.1 * (1.0 - cos(0.5))
        yield off(ran, "energy", ran.energy(), ran.energy()[0], 1e-4 * swing, "J")
        yield from ran.laws()
    built = scene()
    for k in range(20):
        built.add(f"link{k}", capsule={"radius": 0.01, "height": 0.1}, position=(0.1 * k + 0.05, 0, 0),
                  euler_xyz_deg=(0, 90, 0), mass=0.1)  # fmt: skip
        other = f"link{k - 1}" if k else "world"
        built.join(f"joint{k}", "ball", f"link{k}", other, anchor=(0.1 * k, 0, 0), damping=0.02)
    built.add("load", sphere={"radius": 0.1}, position=(1.0, 0, -0.3), mass=10.0)
    built.join("hook", "distance", "link10", "load", anchor=(1.0, 0, 0), to=(1.0, 0, -0.3), rope=0.3)
    ran = run_built(at, "slack rope under a load", built, 1.5)
    yield ran.most("energy gained", (ran.energy() - ran.energy()[0]).max(), 1e-3 * 10.0 * G * 0.3, "J")


def couplings(at: Setting) -> Iterator[Check]:
    """A joint follows another under load, and both share the effort."""
    built = scene().add("hand", box={"size": (0.1, 0.3, 0.05)}, position=(0, 0, 1), motion="static")
    servo = {"position": 0.03, "gain": 2000.0, "time": 0.05, "max_force": 40}
    for side, name in ((1, "left"), (-1, "right")):
        built.add(name, box={"size": (0.02, 0.02, 0.1)}, position=(0, 0.05 * side, 0.9), mass=0.5, avoids=["hand"])
        keys: dict[str, Any] = {"motor": servo} if side == 1 else {}
        built.join(name, "slider", name, "hand", anchor=(0, 0.05 * side, 0.95), axis=(0, 0.6, 0.8 * side), **keys)
    ran = run_built(at, "fingers", built.couple("right", "left", ratio=-1.0), 3.0)
    place = ran.rollout.joint_position
    yield off(ran, "right and left", place[:, 1] + place[:, 0], 0.0, 1e-6, "m")
    yield ran.near("sags by", 0.03 - place[-1, 0], 2 * 0.5 * G * 0.8 / 2000.0, 1e-3, "m")
    built = scene(0.0)
    for name, x, radius in (("wheel", 0.0, 0.1), ("pinion", 0.3, 0.05)):
        built.add(name, cylinder={"radius": radius, "height": 0.05}, position=(x, 0, 0), mass=1.0)
    built.join("wheel", "hinge", "wheel", anchor=(0, 0, 0), axis=(0, 0, 1), motor={"speed": 1e3, "max_force": 0.01})
    built.join("pinion", "hinge", "pinion", anchor=(0.3, 0, 0), axis=(0, 0, 1)).couple("pinion", "wheel", ratio=-2.0)
    ran = run_built(at, "gears", built, 3.0)
    inertia = 0.5 * 0.1**2 + 2.0**2 * 0.5 * 0.05**2
    place = ran.rollout.joint_position
    yield off(ran, "ratio", place[:, 1], -2.0 * place[:, 0], 1e-9, "rad")
    yield ran.near("speed", ran.rollout.angular_velocity[-1, 0, 2], 0.01 * ran.time[-1] / inertia, 1e-6, "rad/s")


JOINTS = (
    pendulums, sliders, ropes, doors, damping, motors, levers, servos, work, sockets, blocked, breaks, double_pendulum,
    linkages, chains, bridges, cradles, governors, loads, couplings,
)  # fmt: skip
