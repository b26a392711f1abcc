"""Laws of a textbook in closed form: single bodies and stacks, tighter than in everyday scenes."""

from collections.abc import Iterator
from math import atan, cos, inf, pi, radians, sin, sqrt, tan
from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from sdfsim.evaluation.laws.scenes import (
    DENSITY,
    STILL,
    UNIT,
    Check,
    G,
    Put,
    Setting,
    about,
    floor,
    most,
    near,
    run,
    run_built,
    solid,
)
from sdfsim.geometry.primitives import revolve
from sdfsim.scene.builder import SceneBuilder
from sdfsim.shape.make import mesh_shape

METRE = sqrt(UNIT)  # times and speeds at 10 cm for one of bodies of a metre
STARTS = (0.95, 0.98, 1.0, 1.03, 1.07)  # sizes
BALL, CUBE = solid("analytic", "ball", 0.5), solid("analytic", "box", 1, 1, 1)


def bounces(at: Setting) -> Iterator[Check]:
    """A ball comes back to e^2 of its height, wherever in a step it lands."""
    for e in (0.3, 0.5, 0.7, 0.9, 1.0):
        shares = []
        for start in STARTS:
            put = Put("ball", BALL, [0, 0, 0.5 + start], e=e)
            ran = run(at, "drop", [put, floor()], 3 * sqrt(2 * start * UNIT / G))
            up = int(np.argmax(ran.v("ball")[:, 2] > 0))
            shares.append((ran.place("ball")[up:, 2].max() - 0.5) / start)
        yield near(f"e = {e:g}: height", float(np.mean(shares)), e**2, 0.0, "of the drop", 0.002)
        yield most(f"e = {e:g}: spread", float(np.std(shares)), 0.001, "of the drop")


def head_on(at: Setting) -> Iterator[Check]:
    """Balls that meet head-on separate at e times their speed, and keep their momentum."""
    for e in (0.2, 0.5, 0.8, 1.0):
        for speed in (0.1, 0.3, 1.0):
            both = [Put(name, BALL, [0.7 * side, 0, 10], v=[-0.5 * side * speed, 0, 0], e=sqrt(e))
                    for name, side in (("a", -1), ("b", 1))]  # fmt: skip
            ran = run(at, f"e = {e:g} at {speed:g} m/s", both, 1.2 * UNIT / speed, gravity=0.0)
            a, b = (ran.v(put.name)[-1, 0] for put in both)
            yield ran.near("speed apart", b - a, e * speed, 0.01, "m/s")
            yield ran.most("momentum", abs(a + b) / speed, 1e-9)


def slopes(at: Setting) -> Iterator[Check]:
    """Rolling, and Coulomb's friction on slopes and on the level, where it is the same in all directions."""

    def way(label: str, put: Put, degrees: float, pull: float) -> Iterator[Check]:
        ran = run(at, label, [put, floor()], 1.5 * METRE, tilt=degrees)
        wanted = 0.5 * pull * G * ran.seconds[-1] ** 2 / UNIT
        yield ran.near("way", ran.moved("it")[-1, 0], wanted, 0.02, "sizes", 0.0 if pull else 1e-3)

    v = 0.5 * METRE
    rolls = Put("it", BALL, [0, 0, 0.5], v=[v, 0, 0], w=[0, v / (0.5 * UNIT), 0])
    ran = run(at, "ball that rolls", [rolls, floor()], 3 * METRE)
    yield ran.most("speed off", np.abs(np.linalg.norm(ran.v("it"), axis=1) / v - 1).max(), 1e-3)
    capsule = solid("analytic", "capsule", 0.25, 1.0)
    rolls = Put("it", capsule, [0, 0, 0.25], about("y", 90), v=[0, v, 0], w=[-v / (0.25 * UNIT), 0, 0])
    ran = run(at, "capsule that rolls", [rolls, floor()], 2 * METRE)
    yield ran.near("speed", ran.v("it")[-1, 1], v, 0.01, "m/s")
    yield ran.near("height", ran.place("it")[-1, 2], 0.25, 0.0, "sizes", 2e-3)
    yield from way("ball that rolls down", Put("it", BALL, [0, 0, 0.5]), 10.0, 5 / 7 * sin(radians(10)))
    steep = radians(40)
    mu = 0.5 * 2 / 7 * tan(steep)
    yield from way("ball that slips", Put("it", BALL, [0, 0, 0.5], mu=mu), 40.0, sin(steep) - mu * cos(steep))
    for degrees in (0.0, 30.0, 45.0):
        ahead, speed = about("z", degrees).apply([1.0, 0.0, 0.0]), 1.5 * METRE
        slides = Put("it", CUBE, [0, 0, 0.5], v=speed * ahead)
        ran = run(at, f"cube that slides at {degrees:g} degrees", [slides, floor()], 4 * METRE)
        wanted, dt = speed**2 / (2 * 0.5 * G) / UNIT, float(np.diff(ran.seconds).mean())
        yield ran.near("way", ran.moved("it")[-1] @ ahead, wanted, 0.01, "sizes", speed * dt / 2 / UNIT)
    for mu in (0.2, 0.6):
        for share in (0.9, 0.99, 1.01, 1.1):
            angle = share * atan(mu)
            pull = max(0.0, sin(angle) - mu * cos(angle))
            put = Put("it", CUBE, [0, 0, 0.5], mu=mu)
            yield from way(f"cube, mu = {mu:g}, {share:g} of its angle", put, np.degrees(angle), pull)


def plates(at: Setting) -> Iterator[Check]:
    """A spinning plate under even pressure stops by the torque mu m g times the mean distance from its middle."""
    square, disc = solid("analytic", "box", 1, 1, 0.1), solid("analytic", "cylinder", 0.5, 0.1)
    mu, spin = 0.4, 5.0 / METRE
    for name, shape, lever in (("square", square, 0.3826), ("disc", disc, 1 / 3)):
        wanted = spin * shape.inertia[2, 2] / shape.volume * UNIT / (mu * G * lever)
        put = Put("it", shape, [0, 0, 0.05], w=[0, 0, spin], mu=mu)
        ran = run(at, name, [put, floor()], 2 * wanted)
        stopped = ran.seconds[int(np.argmax(np.abs(ran.w("it")[:, 2]) < 0.01 * spin))]
        yield ran.near("stops after", stopped, wanted, 0.2, "s")


def drops(at: Setting) -> Iterator[Check]:
    """What is dropped straight lands where it was let go, and rests."""
    for name, shape in (("cube", CUBE), ("cylinder", solid("analytic", "cylinder", 0.5, 1.0)), ("ball", BALL)):
        ran = run(at, name, [Put("it", shape, [0, 0, 1]), floor()], 10 * METRE, sleep=True)
        place, half = ran.place("it"), len(ran.seconds) // 2
        yield ran.most("off its place", np.abs(place[-1] - [0, 0, 0.5]).max(), 1e-3, "sizes")
        yield ran.most("speed at rest", np.abs(ran.v("it")[half:]).max(), 3e-7, "m/s")
        yield ran.most("moved at rest", np.abs(place[half:] - place[half]).max(), 1e-6, "sizes")


def stacks(at: Setting) -> Iterator[Check]:
    """Towers, a pyramid and a tower of planks stand, also if what lies on top is much heavier."""
    cubes: dict[str, list[tuple[float, float, float]]] = {
        f"tower of {n}": [(0.0, 0.0, k + 0.5) for k in range(n)] for n in (5, 10, 20)
    }
    cubes["pyramid"] = [(1.02 * (k - 0.5 * (4 - row)), 0.0, row + 0.5) for row in range(5) for k in range(5 - row)]
    stacked = {name: (5.0, 0.1, [Put(f"{k}", CUBE, p) for k, p in enumerate(places)]) for name, places in cubes.items()}
    plank, planks = solid("analytic", "box", 1, 0.2, 0.1), []
    for k in range(18):
        turn = about("z", 90) if k // 3 % 2 else STILL
        place = turn.apply([0, 0.4 * (k % 3 - 1), (k // 3 + 0.5) * 0.1])
        planks.append(Put(f"{k}", plank, place, turn))
    stacked["planks"] = (5.0, 0.01, planks)
    for ratio in (10, 30, 100, 300, 1000):
        heavy = ratio > 100  # sweeps that end early make it creep off within half a minute at 1 m
        pair = [Put("light", CUBE, [0, 0, 0.5]), Put("heavy", CUBE, [0.01 * heavy, 0, 1.5], dense=ratio)]
        stacked[f"{ratio} on 1"] = (30.0 if heavy else 3.0, 1e-3 if heavy else 0.01, pair)
    for name, (seconds, limit, bodies) in stacked.items():
        ran = run(at, name, [*bodies, floor()], seconds * METRE)
        moved = max(float(np.linalg.norm(ran.moved(put.name), axis=1).max()) for put in bodies)
        yield ran.most("moved", moved, limit, "sizes")


def overlaps(at: Setting) -> Iterator[Check]:
    """What overlaps at the start comes apart, with no more energy than its depth gives."""
    for depth in (0.02, 0.2, 0.5):
        ran = run(at, f"cube {depth:g} deep in the floor", [Put("it", CUBE, [0, 0, 0.5 - depth]), floor()], 3 * METRE)
        energy = 0.5 * (ran.v("it") ** 2).sum(1) + G * UNIT * ran.moved("it")[:, 2]
        yield ran.most("energy", energy.max() / (G * UNIT * depth), 1.02, "of its depth's")
        yield ran.near("height", ran.place("it")[-1, 2], 0.5, 0.0, "sizes", 2e-3)
    for name, shape in (("balls", BALL), ("cubes", CUBE)):
        for off in (0.0, 0.5):
            both = [Put("a", shape, [0, 0, 0]), Put("b", shape, [0.8 * off, 0.6 * off, 0])]
            ran = run(at, f"{name} {off:g} apart", both, 1.3 * METRE, gravity=0.0)
            yield ran.most("speed", max(np.linalg.norm(ran.v(n), axis=1).max() for n in "ab"), 3 * METRE, "m/s")
            away = ran.place("b")[-1] - ran.place("a")[-1]
            yield ran.between("apart at the end", float(np.linalg.norm(away)), off + 0.1, np.inf, "sizes")
            middle = ran.moved("a") + ran.moved("b")
            yield ran.most("common centre moved", 0.5 * np.abs(middle).max(), 1e-3, "sizes")


def sleepers(at: Setting) -> Iterator[Check]:
    """What sleeps is hit as if it were awake: a cube that slides without friction gives all of its speed to it."""
    speed = 0.5 * METRE
    still = Put("still", CUBE, [0, 0, 0.5], mu=0.0, e=1.0)
    slides = Put("slides", CUBE, [-3, 0, 0.5], v=[speed, 0, 0], mu=0.0, e=1.0)
    ran = run(at, "cubes", [still, slides, floor()], 4 * UNIT / speed, sleep=True)
    yield ran.near("speed after", ran.v("still")[-1, 0], speed, 0.01, "m/s")
    yield ran.near("speed of the other", ran.v("slides")[-1, 0], 0.0, 0.0, "m/s", 0.01 * speed)


def trays(at: Setting) -> Iterator[Check]:
    """A cup stays on a tray that is sped up below the limit of friction, level or tilted, and slips by the surplus
    above it."""
    for pull in (3.0, 4.2):
        path = [{"time": 0.1 + t, "position": (0.5 * pull * t * t, 0, 0)} for t in np.linspace(0, 1, 1001).tolist()]
        built = SceneBuilder(model="solver")
        built.add("tray", box={"size": (4, 1, 0.04)}, motion="kinematic", path=path, friction=1, restitution=0)
        built.add("cup", cylinder={"radius": 0.05, "height": 0.08}, position=(0, 0, 0.06), friction=0.4, restitution=0)
        ran = run_built(at, f"{pull:g} m/s^2", built, 0.9)
        behind = ran.rollout.position[-1, 0, 0] - ran.rollout.position[-1, 1, 0]
        wanted = max(0.0, 0.5 * (pull - 0.4 * G) * (ran.time[-1] - 0.1) ** 2)
        yield ran.near("behind", behind, wanted, 0.0, "m", 1e-3)
    turn, mu = about("x", 20), 0.5  # the weight pulls down the tray, its acceleration along it: friction holds the sum
    for share in (0.25, 0.4):
        path = [{"time": 0.1 + t, "position": (0.5 * share * G * t * t, 0, 0), "quat_xyzw": turn.as_quat()}
                for t in np.linspace(0, 1, 1001).tolist()]  # fmt: skip
        built = SceneBuilder(model="solver")
        built.add("tray", box={"size": (8, 1, 0.04)}, motion="kinematic", path=path, friction=1, restitution=0)
        built.add("cup", cylinder={"radius": 0.05, "height": 0.08}, position=turn.apply((0, 0.2, 0.06)),
                  quat_xyzw=turn.as_quat(), friction=mu, restitution=0)  # fmt: skip
        ran = run_built(at, f"{share:g} g along a tray tilted by 20 degrees", built, 0.9)
        slip = ran.rollout.position[-1] - ran.rollout.position[0]
        surplus = max(0.0, sqrt(share**2 + sin(radians(20)) ** 2) - mu * cos(radians(20))) * G
        wanted = 0.5 * surplus * (ran.time[-1] - 0.1) ** 2
        yield ran.near("slips", np.linalg.norm(slip[1] - slip[0]), wanted, 0.02, "m", 1e-3)


def cones(at: Setting) -> Iterator[Check]:
    """Coulomb's cone: what hits the ground, spinning, gains at most mu times as much momentum along it as away."""
    rng, mu, shares = np.random.default_rng(5), 0.3, []
    shapes = [at.box(*size) for size in ((1, 1, 1), (3, 0.3, 0.3), (2, 2, 0.2), (2, 1, 0.5))]
    for _ in range(24):
        speed = np.r_[rng.uniform(-0.6, 0.6, 2), -1.0]
        put = Put("it", shapes[rng.integers(4)], [0, 0, 2.2], Rotation.random(rng=rng), v=speed,
                  w=rng.uniform(-5, 5, 3), mu=mu, e=0.3)  # fmt: skip
        ran = run(at, "throw", [put, floor()], 0.4, gravity=0.0)
        gained = ran.v("it")[-1] - ran.v("it")[0]
        shares += [float(np.hypot(*gained[:2])) / (mu * gained[2])] if gained[2] > 1e-6 else []
    yield Check("24 throws: hits", len(shares), 12, 24)
    yield most("24 throws: of mu times the normal", max(shares, default=inf), 1.001)


def soft(at: Setting) -> Iterator[Check]:
    """Soft material gives way by its load over the stiffness, two of them in series, and rebounds as a spring."""
    for stiffness in (2e3, 1e4, 1e5, 1e7):
        damping = 0.6 * sqrt(2.0 * stiffness)
        kinds: dict[str, Any] = {"box": {"box": {"size": (0.2, 0.2, 0.2)}}, "ball": {"sphere": {"radius": 0.1}}}
        for name, shape in kinds.items():
            built = SceneBuilder().add("floor", plane={})
            built.add("it", **shape, position=(0, 0, 0.1), mass=2.0, stiffness=stiffness, damping=damping)
            ran = run_built(at, f"{name} of {stiffness:g} N/m", built, 3.0)
            yield ran.near("rests at", 0.1 - ran.rollout.position[-1, 1, 2], 2.0 * G / stiffness, 2e-2, "m")
    built = SceneBuilder().add("floor", plane={})
    for k in range(2):
        place = (0, 0, 0.1 + 0.2 * k)
        built.add(f"{k}", box={"size": (0.2, 0.2, 0.2)}, position=place, mass=2.0, stiffness=1e4, damping=60)
    ran = run_built(at, "two boxes", built, 3.0)
    height = ran.rollout.position[-1, :, 2]
    yield ran.near("floor gives way", 0.1 - height[1], 4.0 * G / 1e4, 2e-2, "m")
    yield ran.near("both give way", 0.2 - (height[2] - height[1]), 2.0 * G / 5e3, 2e-2, "m")
    built = SceneBuilder().add("floor", plane={})
    built.add("it", sphere={"radius": 0.1}, position=(0, 0, 0.6), mass=0.5, stiffness=5e3)
    ran = run_built(at, "ball without damping", built, 1.2)
    height = ran.rollout.position[:, 1, 2]
    yield ran.near("comes back to", height[int(np.argmin(height)) :].max(), 0.6, 0.04, "m")


def gliding(at: Setting) -> Iterator[Check]:
    """What nothing brakes goes on, however slowly; what is braked sleeps."""
    for speed in (1.2e-3, 2.5e-3):
        built = SceneBuilder().add("floor", plane={}, friction=0)
        built.add("puck", cylinder={"radius": 0.04, "height": 0.02}, position=(0, 0, 0.01), velocity=(speed, 0, 0))
        ran = run_built(at, f"puck at {speed:g} m/s", built, 3.0)
        yield ran.near("way", ran.rollout.position[-1, 1, 0], speed * ran.time[-1], 1e-3, "m")
    yaw, built = 20.0, SceneBuilder()
    for k in range(72):
        place = (0.25 * (k % 12) - 0.3, 0.25 * (k // 12) - 0.6, -0.05)
        built.add(f"tile{k}", box={"size": (0.25, 0.25, 0.1)}, position=place, motion="static", friction=1)
    built.add(
        "slab", box={"size": (0.3, 0.15, 0.04)}, position=(0, 0, 0.02), euler_xyz_deg=(0, 0, yaw), velocity=(2, 0, 0),
        friction=0.3,
    )  # fmt: skip
    ran = run_built(at, "slab on tiles", built, 1.0)
    yield ran.near("way", ran.rollout.position[-1, -1, 0], 4.0 / (2.0 * 0.3 * G), 0.01, "m", 0.01)
    _, _, z, w = ran.rollout.orientation[-1, -1]
    yield ran.near("yaw", float(np.degrees(2.0 * np.arctan2(z, w))), yaw, 0.0, "degrees", 2.0)


def parting(at: Setting) -> Iterator[Check]:
    """Bodies that start inside each other part without speed, and a dead impact ends at the surface."""
    for deep in (1e-3, 0.0399, 0.0401, 0.1):
        built = SceneBuilder(gravity=(0, 0, 0)).add("floor", plane={})
        built.add("it", box={"size": (1.4, 1.4, 1.4)}, position=(0, 0, 0.7 - deep))
        ran = run_built(at, f"{deep:g} m deep", built, 2.0)
        yield ran.most("speed", np.abs(ran.rollout.velocity).max(), 1e-9, "m/s")
        yield ran.most("is still deep by", 0.7 - ran.rollout.position[-1, 1, 2], 1e-3, "m")
    built = SceneBuilder(gravity=(0, 0, 0)).add("wall", box={"size": (0.8, 0.8, 0.8)}, motion="static", restitution=0)
    built.add("ball", sphere={"radius": 0.4}, position=(1.2, 0.01, 0.02), velocity=(-0.2, 0, 0), restitution=0)
    ran = run_built(at, "dead impact", built, 4.0)
    yield ran.near("place", ran.rollout.position[-1, 1, 0], 0.8, 0.0, "m", 1e-3)
    yield ran.most("speed", abs(ran.rollout.velocity[-1, 1, 0]), 1e-9, "m/s")


def rocking(at: Setting) -> Iterator[Check]:
    """A hollow half ball that rocks, rolling or without friction, has the period that energy gives it, and gains
    none."""
    turn = np.linspace(-pi / 2, 0.0, 40)
    shell = [np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1) for radius in (0.5, 0.45)]
    profile = np.concatenate([shell[0], shell[1][::-1]])
    profile[[0, -1], 0] = 0.0
    lean = 20.0
    for kind in ("mesh", "grid"):
        half_ball = mesh_shape(revolve(profile, 96), name="half ball", kind=kind)
        # Of its mass: how far it is below the middle of the ball, and its inertia for a mass of 1.
        low, inertia = -half_ball.com[2], half_ball.inertia[0, 0] / half_ball.volume
        for mu in (0.0, 1.0):

            def pace(angle: float, mu: float = mu, low: float = low, inertia: float = inertia) -> float:
                """Turning speed at an angle, by energy, where the size and gravity are 1."""
                # Squared distance of the mass from the point at rest: the lowest one, or, without friction, below it.
                arm = 0.25 + low**2 - low * cos(angle) if mu else (low * sin(angle)) ** 2
                return sqrt(2 * low * (cos(angle) - cos(radians(lean))) / (inertia + arm))

            quarter = quad(lambda u, pace=pace: 2 * u / pace(radians(lean) - u * u), 0.0, sqrt(radians(lean)))[0]
            period = 4 * quarter * sqrt(UNIT / G)
            put = Put("it", half_ball, [0, 0, 0.5], about("y", lean), mu=mu)
            ran = run(at, f"{kind}, mu = {mu:g}", [put, floor()], 10 * period)
            swing, time = ran.turn("it").apply([0, 0, 1])[:, 0], ran.seconds
            down = np.flatnonzero((swing[:-1] > 0) & (swing[1:] <= 0))
            crossed = time[down] + swing[down] / (swing[down] - swing[down + 1]) * (time[down + 1] - time[down])
            yield ran.near("period", float(np.diff(crossed).mean()), period, 0.03, "s")
            energy = ran.energy()
            swings = put.dense * DENSITY * half_ball.volume * at.size**4 * G * low * (1 - cos(radians(lean)))
            yield ran.most("energy gained", (energy - np.minimum.accumulate(energy)).max() / swings, 0.06)


TEXTBOOK = (
    bounces, head_on, slopes, plates, drops, stacks, overlaps, sleepers, trays, cones, soft, gliding, parting, rocking,
)  # fmt: skip
