"""Laws of assembly: meshes whose edges, holes and teeth must be as sharp as their files say."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from math import cos, pi, radians, sin, sqrt, tan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from sdfsim.evaluation.laws.scenes import UNIT, Check, G, Put, Ran, Setting, about, fixed, floor, run, run_built, solid
from sdfsim.geometry.mesh import Mesh, clean, joined
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import box, cylinder, revolve, ring, sleeve, torus, tube
from sdfsim.scene.builder import SceneBuilder
from sdfsim.shape.make import mesh_shape
from sdfsim.shape.shape import Shape


@cache
def plate(hole: float) -> Shape:
    """A plate 6 wide and 1 thick with a square hole."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return mesh_shape(sleeve(3.0 * square, 0.5 * hole * square, 1.0), name="plate", kind="mesh")


def pegs(at: Setting) -> Iterator[Check]:
    """A peg falls through a hole that is wider by a thousandth, and stands on one that is narrower."""
    long, through = solid("analytic", "box", 1, 1, 1.5), [0, 0, 0]
    for gap in (1e-2, 5e-3, 1e-3):
        for part in (0.0, 0.3, -0.45):
            bodies = [Put("peg", long, [part * gap, 0, 1.3], mu=0.2), fixed("plate", plate(1 + gap), through)]
            ran = run(at, f"square, {gap:g} wider, {part:g} of it aside", bodies, 0.3)
            yield ran.near("falls", -ran.moved("peg")[-1, 2], 0.5 * G * ran.seconds[-1] ** 2 / UNIT, 0.05, "sizes")
    hole = mesh_shape(tube(3.0, 0.505 / cos(pi / 64), 1.0), name="hole", kind="mesh")
    peg = Put("peg", solid("mesh", "cylinder", 0.5, 1.5, 64), [0.002, 0, 1.3], mu=0.2)
    ran = run(at, "round, a hundredth wider", [peg, fixed("plate", hole, through)], 0.3)
    yield ran.near("falls", -ran.moved("peg")[-1, 2], 0.5 * G * ran.seconds[-1] ** 2 / UNIT, 0.05, "sizes")
    peg = Put("peg", long, [0, 0, 1.25], mu=0.2)
    ran = run(at, "square, a hundredth narrower", [peg, fixed("plate", plate(0.99), through)], 1.0)
    yield ran.most("sinks", np.abs(ran.moved("peg")).max(), 1e-3, "sizes")


def rims(at: Setting) -> Iterator[Check]:
    """A box crosses a gap in a floor that is one mesh; a ball rests on the edge of a hole, and stops at a rim."""
    half = box((10, 10, 1))
    halves = [Mesh(half.vertices + np.array([5.1 * side, 0, -0.5]), half.faces) for side in (-1, 1)]
    ground = mesh_shape(joined(halves), name="ground", kind="mesh")
    for size in (2.0, 1.0):
        for yaw in (0, 30, 45):
            slab = solid("analytic", "box", size, size, 1)
            moves = Put("box", slab, [-3, 0, 0.5], about("z", yaw), v=[0.5, 0, 0], mu=0.0)
            ran = run(at, f"box of {size:g} at {yaw} degrees", [moves, fixed("ground", ground, [0, 0, 0])], 1.2)
            yield ran.near("speed", ran.v("box")[-1, 0], 0.5, 1e-3, "m/s")
            yield ran.most("hops", ran.moved("box")[:, 2].max(), 1e-3, "sizes")
    for radius in (0.5, 0.75):
        hole = mesh_shape(tube(3.0, radius, 1.0, 128), name="hole", kind="mesh")
        ball = Put("ball", solid("analytic", "ball", 1.0), [0.01, 0, 1.5])
        ran = run(at, f"ball on a hole of {radius:g}", [ball, fixed("hole", hole, [0, 0, 0])], 2.0)
        inner = radius * cos(pi / 128)
        yield ran.near("height", ran.place("ball")[-1, 2], 0.5 + sqrt(1 - inner**2), 0.0, "sizes", 1e-3)
    turn = np.linspace(-pi / 2, 0.0, 24)
    shell = [np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1) for radius in (1.0, 0.9)]
    bowl = np.concatenate([shell[0], shell[1][::-1]])
    bowl[[0, -1], 0] = 0.0
    rim = mesh_shape(revolve(bowl, 96), name="bowl", kind="mesh")
    for gap in (8e-3, 2e-3):
        place = np.array([1.0, 0, 0]) + (0.2 + gap) * np.array([1.0, 0, 1.0]) / sqrt(2)
        ball = Put("ball", solid("analytic", "ball", 0.2), place, v=[-0.02, 0, -0.02])
        ran = run(at, f"ball, {gap:g} from a rim", [ball, fixed("bowl", rim, [0, 0, 0])], 1.0, gravity=0.0)
        end = ran.place("ball")[-1]
        yield ran.near("stops at", np.hypot(end[0] - 1.0, end[2]), 0.2, 0.0, "sizes", 5e-4)


def rollers(at: Setting) -> Iterator[Check]:
    """Fine meshes of round things keep most of their speed: a ring, a wheel of 128 sides, a disc of 1,024. Limits
    are what is reached, not what dead impacts of the polygons would leave (0.99, 0.97, 0.92; 0.994)."""
    torus = solid("mesh", "torus", 1.0, 0.3)
    put = Put("ring", torus, [0, 0, 1.3], about("x", 90), v=[1.2, 0, 0], w=[0, 1.2 / 0.13, 0])
    ran = run(at, "torus", [put, floor()], 1.5)
    yield Check("torus: keeps", ran.v("ring")[-1, 0] / 1.2, 0.85, 1.001, "of its speed")
    wheel = mesh_shape(tube(1.0, 0.5, 0.4, 128), name="wheel", kind="mesh")
    for speed, kept in ((0.1, 0.9), (0.4, 0.9), (1.0, 0.89)):
        put = Put("wheel", wheel, [0, 0, 1.0], about("x", 90), v=[speed, 0, 0], w=[0, speed / 0.1, 0])
        ran = run(at, f"wheel at {speed:g} m/s", [put, floor()], 1.2)
        yield Check(f"{ran.label}: keeps", ran.v("wheel")[-1, 0] / speed, kept, 1.001, "of its speed")
    put = Put(
        "disc", solid("mesh", "cylinder", 1.0, 0.4, 1024), [0, 0, 1.0], about("x", 90), v=[0.4, 0, 0], w=[0, 4, 0]
    )
    ran = run(at, "disc of 1,024 sides", [put, floor()], 1.0)
    yield Check(f"{ran.label}: keeps", ran.v("disc")[-1, 0] / 0.4, 0.93, 1.001, "of its speed")


def outline(teeth: int, module: float, tip: float = 1.0, root: float = 1.25, wider: float = -0.01) -> np.ndarray:
    """A gear about z as corners [K, 2] m, its first tooth at +x: involute flanks at 20 degrees, teeth from `root` below
    the pitch circle to `tip` above it, and on each side `wider` than a quarter of the pitch, in modules of `module`
    m."""
    pitch, press = 0.5 * module * teeth, radians(20.0)
    low, base = pitch - root * module, pitch * cos(press)
    half = pi / (2 * teeth) + tan(press) - press + wider * module / pitch  # of a tooth at the base circle
    radius = np.linspace(max(base, low), pitch + tip * module, 8)
    angle = np.arccos(base / radius)
    off = half - (np.tan(angle) - angle)
    if low < base:
        radius, off = np.append(low, radius), np.append(half, off)
    radius, off = np.append(radius, radius[::-1]), np.append(-off, off[::-1])
    turn = (2 * pi / teeth * np.arange(teeth)[:, None] + off).reshape(-1)
    return np.tile(radius, teeth)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def spur_gear(teeth: int, module: float, height: float) -> Mesh:
    """A gear with a bore and a hundredth of its module of backlash, m."""
    rim = outline(teeth, module)
    return sleeve(rim, 2 * module * rim / np.linalg.norm(rim, axis=1, keepdims=True), height)


def ring_gear(teeth: int, module: float, height: float) -> Mesh:
    """A ring with teeth inside, low enough not to meet what is below the involutes of small gears."""
    rim = outline(teeth, module, tip=1.25, root=0.75, wider=0.01)
    return sleeve((0.5 * teeth + 4) * module * rim / np.linalg.norm(rim, axis=1, keepdims=True), rim, height)


class Files(TemporaryDirectory):
    """Meshes as files, until the scene is read."""

    def __enter__(self) -> Self:
        return self

    def __call__(self, name: str, mesh: Mesh) -> str:
        path = Path(self.name) / f"{name}.ply"
        path.write_bytes(write_ply(mesh))
        return str(path)


def spun(ran: Ran, name: str) -> np.ndarray:
    """[T+1] rad by which a body has turned about z, less than half a turn in a frame."""
    turned = np.unwrap(ran.turn(name).as_euler("ZYX")[:, 0])
    return turned - turned[0]


def gears(at: Setting) -> Iterator[Check]:
    """Two spur gears of 20 and 40 teeth of 5 mm, and a planet set of 18, 18 and 54 teeth of 2 mm: ten turns, without a
    tooth that is skipped."""
    built, planets = SceneBuilder(gravity=(0, 0, 0)), SceneBuilder(gravity=(0, 0, 0))
    spins: dict[str, Any] = {"axis": (0, 0, 1)}
    with Files() as mesh:
        for name, teeth, place, turn in (("small", 20, 0.0, 0.0), ("large", 40, 0.15, 180 + 180 / 40)):
            gear = mesh(name, spur_gear(teeth, 5e-3, 0.02))
            built.add(name, mesh=gear, position=(place, 0, 0), mass=0.1, euler_xyz_deg=(0, 0, turn))
        built.join("driven", "hinge", "small", anchor=(0, 0, 0), motor={"speed": 2 * pi, "max_force": 10}, **spins)
        built.join("follows", "hinge", "large", anchor=(0.15, 0, 0), damping=0.01, **spins)
        pair = run_built(at, "spur gears", built, 10.0)
        gear, ring = mesh("gear", spur_gear(18, 2e-3, 0.01)), mesh("ring", ring_gear(54, 2e-3, 0.01))
        planets.add("ring", mesh=ring, motion="static", euler_xyz_deg=(0, 0, 180 / 54))
        planets.add("sun", mesh=gear, mass=0.05)
        planets.join("driven", "hinge", "sun", anchor=(0, 0, 0), motor={"speed": 20 * pi, "max_force": 10}, **spins)
        planets.add("carrier", box={"size": [0.04, 0.04, 2e-3]}, position=(0, 0, 0.03), mass=0.05, collides_with=[])
        planets.join("follows", "hinge", "carrier", anchor=(0, 0, 0), damping=0.01, **spins)
        for k in range(3):
            place, turn = 0.036 * np.array([cos(2 * pi * k / 3), sin(2 * pi * k / 3), 0]), 120 * k + 190
            planets.add(f"planet{k}", mesh=gear, position=place, mass=0.05, euler_xyz_deg=(0, 0, turn))
            planets.join(f"axle{k}", "hinge", f"planet{k}", "carrier", anchor=place, **spins)
        orbits = run_built(at, "planet set", planets, 1.0)
    for ran, least, names, ratio in ((pair, 9.9, ("small", "large"), -2.0), (orbits, 9.0, ("sun", "carrier"), 4.0)):
        first, second = (spun(ran, name)[-1] / (2 * pi) for name in names)
        yield ran.between("turns", first, least, 10.1, "")
        yield ran.near("ratio", first / second, ratio, 1e-3)


def threaded(flanks: np.ndarray, pitch: float, turns: int, other: float, around: int = 96) -> Mesh:
    """A solid between a thread about z and the radius `other`: a bolt if that is 0, else a nut. `flanks` [K, 2] are
    corners of the thread's profile: their place along the pitch, from 0 to 1, and their radius. Lengths in m."""
    corners, knot = len(flanks), np.arange(turns * len(flanks) + 1)
    along = pitch * (flanks[knot % corners, 0] + knot // corners)
    turn = 2 * pi * np.arange(around)[:, None] / around

    def sheet(radius: float | np.ndarray, height: np.ndarray) -> np.ndarray:
        flat = np.broadcast_arrays(radius * np.cos(turn), radius * np.sin(turn), height)
        return np.stack(flat, axis=-1).reshape(-1, 3)

    helix = along + pitch * turn / (2 * pi)
    ends = np.where(knot < len(knot) / 2, helix[0, 0], helix[0, -1]) + 0.5 * pitch  # points on the axis
    this = np.arange(around * len(knot)).reshape(around, -1)
    # After a turn the thread meets itself one pitch higher.
    following = np.concatenate([this[1:], np.append(this[0, corners:], np.full(corners, -1))[None]])
    quads = np.stack([this[:, :-1], following[:, :-1], following[:, 1:], this[:, 1:]], axis=-1).reshape(-1, 4)
    quads = quads[(quads >= 0).all(1)]
    edges = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    inner = set(map(tuple, edges.tolist()))
    rims = np.array([(b, a) for a, b in inner if (b, a) not in inner])
    walls = np.concatenate([rims, rims[:, ::-1] + this.size], axis=1)
    faces = np.concatenate([quads, quads[:, ::-1] + this.size, walls])
    vertices = [sheet(flanks[knot % corners, 1], helix), sheet(other, helix if other else ends)]
    return clean(Mesh(np.concatenate(vertices), np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])))


def nuts(at: Setting) -> Iterator[Check]:
    """An M16 nut with a tenth of a millimetre of play on its bolt, both of 96 facets: friction locks it, a motor drives
    it by its pitch a turn, and without friction it turns down by the lead, somewhat slower than on a true screw, as
    each facet is an impact."""
    pitch, radius = 2e-3, 8e-3
    root = radius - 5 / 8 * pitch * sqrt(0.75)
    flanks = np.array([(0.0, radius), (1 / 8, radius), (7 / 16, root), (11 / 16, root)])
    screw, female = threaded(flanks, pitch, 14, 0.0), threaded(flanks + np.array([0.0, 1e-4]), pitch, 5, 12e-3)
    bolt, nut = (mesh_shape(mesh, name=name, kind="mesh") for mesh, name in ((screw, "bolt"), (female, "nut")))
    lead, spin = pitch / (2 * pi), nut.inertia[2, 2] / nut.volume
    for mu in (0.2, 0.0):
        scale = 1 / at.size
        bodies = [Put("nut", nut, [0, 0, 8 * pitch * scale], mu=mu, scale=scale), fixed("bolt", bolt, [0, 0, 0])]
        ran = run(at, f"mu = {mu:g}", [bodies[0], replace(bodies[1], scale=scale)], 1.0 / at.time)
        spins, half = ran.rollout.angular_velocity[:, 0, 2], len(ran.time) // 2
        if mu:
            yield ran.most("turns", abs(spins[-1]), 1e-3, "rad/s")
        else:
            way, turned = np.ptp(ran.rollout.position[half:, 0, 2]), np.trapezoid(spins[half:], ran.time[half:])
            yield ran.near("down a turn", 2 * pi * way / -turned, pitch, 0.02, "m")
            full = G * lead / (lead**2 + spin) * ran.time[-1]
            yield ran.between("speed of a true screw", -spins[-1] / full, 0.75, 1.01, "")
    built, start = SceneBuilder(), (0, 0, 6 * pitch)
    with Files() as mesh:
        built.add("bolt", mesh=mesh("bolt", screw), motion="static")
        built.add("nut", mesh=mesh("nut", female), position=start, mass=0.02, friction=0.2)
        built.add("driver", box={"size": [5e-3, 5e-3, 5e-3]}, position=(0, 0, 0.05), mass=0.02, collides_with=[])
        built.join("up", "slider", "driver", axis=(0, 0, 1))
        built.join("drive", "hinge", "nut", "driver", axis=(0, 0, 1), anchor=start,
                   motor={"speed": 4 * pi, "max_force": 1.0})  # fmt: skip
        ran = run_built(at, "driven", built, 1.0)
    quarter = len(ran.time) // 4
    way, turned = np.ptp(ran.rollout.position[quarter:, 1, 2]), np.ptp(spun(ran, "nut")[quarter:])
    yield ran.near("up a turn", 2 * pi * way / turned, pitch, 0.01, "m")
    yield ran.between("turns", turned / (2 * pi), 1.4, 1.6, "")


def bearings(at: Setting) -> Iterator[Check]:
    """Eight balls in the grooves of a ring that turns under its weight, in one that is held: they orbit at the rate at
    which they roll, and friction takes little of the spin."""
    middle, ball, groove, play = 20e-3, 3e-3, 3.12e-3, 1e-5  # m: the radius of the orbit; radii; on each side
    built = SceneBuilder()
    with Files() as mesh:
        for name, side in (("outer", 1), ("inner", -1)):
            centre, edge = middle + side * (ball + play - groove), middle + side * 0.6 * ball
            half = np.arccos(side * (edge - centre) / groove)
            turn = np.linspace(-half, half, 24)
            arc = np.column_stack([centre + side * groove * np.cos(turn), groove * np.sin(turn)])
            back = middle + side * 2 * ball
            profile = np.array([(back, -5e-3), (edge, -5e-3), *arc, (edge, 5e-3), (back, 5e-3)])[::side]
            motion: dict[str, Any] = {"motion": "static"} if side > 0 else {"mass": 2.0, "angular_velocity": (0, 0, 20)}
            built.add(name, mesh=mesh(name, ring(profile, 192)), friction=1.0, restitution=0, **motion)
        for k in range(8):
            place = middle * np.array([cos(pi * k / 4), sin(pi * k / 4), 0])
            built.add(f"ball{k}", sphere={"radius": ball}, position=place, mass=1e-3, friction=0.3, restitution=0)
        ran = run_built(at, "ball bearing", built, 0.6)
    places, half = ran.rollout.position[:, 2:], len(ran.time) // 2
    angle = np.unwrap(np.arctan2(places[..., 1], places[..., 0]), axis=0)
    spins, seconds = ran.rollout.angular_velocity[:, 1, 2], ran.time[-1] - ran.time[half]
    lean = 1 - play / (groove - ball)  # cosine of the angle at which the grooves meet the balls
    orbit = (angle[-1] - angle[half]).mean() / seconds
    yield ran.near("orbits for a turn", orbit / spins[half:].mean(), 0.5 * (1 - ball / middle * lean), 0.02)
    yield ran.between("spin kept", spins[-1] / spins[0], 0.8, 1.001, "")
    yield from ran.laws()


def bricks(at: Setting) -> Iterator[Check]:
    """Two toy bricks of a given stiffness, pressed together: their studs are a tenth of a millimetre too wide, which
    friction turns into a hold of 1.25 N."""
    wall, high, studs, over, stiffness = 1.5e-3, 9.6e-3, 4e-3, 1e-4, 5e4  # m; N/m
    size, parts = 16e-3, []
    for extent, place in (
        ((size, size, wall), (0, 0, high - wall / 2)),
        *(((wall, size, high - wall), (s * (size - wall) / 2, 0, (high - wall) / 2)) for s in (-1, 1)),
        *(((size, wall, high - wall), (0, s * (size - wall) / 2, (high - wall) / 2)) for s in (-1, 1)),
    ):
        parts.append(Mesh(box(extent).vertices + np.array(place), box(extent).faces))
    stud = cylinder(size / 2 - wall - studs + over, 2.8e-3, 48)
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        parts.append(Mesh(stud.vertices + np.array([x * studs, y * studs, high + 4e-4]), stud.faces))
    for weight, holds in ((1.0, True), (10.0, False)):
        built = SceneBuilder()
        with Files() as mesh:
            brick = mesh("brick", joined(parts))
            built.add("upper", mesh=brick, position=(0, 0, high + 1e-5), motion="static")
            built.add("lower", mesh=brick, mass=weight / G, stiffness=stiffness, damping=5.0)
            ran = run_built(at, f"{weight:g} N", built, 0.3)
        fallen = -float(np.ptp(ran.rollout.position[:, 1, 2]))
        wanted = (-1e-5, 0.0) if holds else (-np.inf, -0.1)
        yield ran.between("moves", fallen, *wanted, "m")


def links(at: Setting) -> Iterator[Check]:
    """A chain of 50 rings of 4 cm, of which the first is shaken by a decimetre until its end cracks like a whip: none
    comes off."""
    built, apart = SceneBuilder(), 2 * (20e-3 - 4e-3) - 2e-4
    times = np.linspace(0, 4, 201)
    along = 0.1 * np.sin(2 * pi * times) * (1 - np.exp(-times))
    path = [{"time": t, "position": (x, 0, 0), "euler_xyz_deg": (90, 0, 0)} for t, x in zip(times, along, strict=True)]
    with Files() as mesh:
        ring = mesh("ring", torus(20e-3, 4e-3, 96, 32))
        built.add("link0", mesh=ring, motion="kinematic", path=path)
        for k in range(1, 50):
            turn = (90, 0, 90 * (k % 2))
            built.add(f"link{k}", mesh=ring, position=(0, 0, -k * apart), euler_xyz_deg=turn, mass=0.02, restitution=0)
        ran = run_built(at, "shaken", built, 4.0)
    places = ran.rollout.position
    yield ran.most("apart", np.linalg.norm(np.diff(places, axis=1), axis=2).max() / apart, 1.05, "of their distance")
    yield ran.between("speed of the end", np.abs(ran.rollout.velocity[:, -1]).max(), 1.0, 100.0, "m/s")


CUTS = (1.2e-3, 1.8e-3, 0.9e-3, 1.5e-3)  # m: heights of a key's cuts
# m: radius of a lock's bore, half of the width of the grooves above and below, and how deep plates drop into them
BORE, GROOVE, DROP = 6.1e-3, 2.5e-3, 2e-3


def rays(center: tuple[float, float], corners: np.ndarray, count: int) -> np.ndarray:
    """[K] rad, angles around a centre: `count` even ones, and those of corners [C, 2] m."""
    even = 2 * pi * np.arange(count) / count - pi
    return np.unique(np.concatenate([even, np.arctan2(*(corners - center).T[::-1])]).round(9))


def blade(profile: np.ndarray) -> Mesh:
    """A key 2 mm thick along z, from 2 mm below its axis up to a profile [K, 2] (z, height) m."""
    z, high = profile.T
    low = np.full_like(z, -2e-3)
    rings = np.stack(
        [
            np.column_stack([np.full_like(z, x), y, z])
            for x, y in ((-1e-3, low), (1e-3, low), (1e-3, high), (-1e-3, high))
        ],
        1,
    )
    at = (
        4 * np.arange(len(z) - 1)[:, None] + np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])[:, None]
    )
    last = 4 * len(z) - 4
    quads = np.concatenate([at.reshape(-1, 4), [[3, 2, 1, 0], [last, last + 1, last + 2, last + 3]]])
    return clean(Mesh(rings.reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])))


def lock(mesh: Files, key: tuple[float, ...], **keys: Any) -> SceneBuilder:
    """A lock with four plates in gaps of its plug, which the cuts of a key lift out of the grooves of the housing; and
    a key in it, with further `keys` of its body."""
    built = SceneBuilder(gravity=(0, -G, 0))
    side = np.sqrt(BORE**2 - GROOVE**2)
    turn = np.linspace(-np.arctan2(side, GROOVE), np.arctan2(side, GROOVE), 24)
    half = np.concatenate(
        [BORE * np.stack([np.cos(turn), np.sin(turn)], 1), [(GROOVE, 5.4e-3 + DROP), (-GROOVE, 5.4e-3 + DROP)]]
    )
    inner = np.concatenate([half, -half])
    outer = 10e-3 * inner / np.linalg.norm(inner, axis=1)[:, None]
    hole, middle = np.array([(1.1e-3, 3e-3), (-1.1e-3, 3e-3), (-1.1e-3, -2.2e-3), (1.1e-3, -2.2e-3)]), (0.0, 0.4e-3)
    angle = rays(middle, hole, 64)
    way = np.stack([np.cos(angle), np.sin(angle)], 1)
    with np.errstate(divide="ignore"):
        slot = np.array(middle) + way * np.minimum(1.1e-3 / np.abs(way[:, :1]), 2.6e-3 / np.abs(way[:, 1:]))
    slice_ = sleeve(6e-3 * slot / np.linalg.norm(slot, axis=1)[:, None], slot, 1.2e-3)
    plug = joined([Mesh(slice_.vertices + np.array([0, 0, 2.2e-3 * k]), slice_.faces) for k in range(5)])
    top = [
        (z + dz, high)
        for z, high in zip(2.2e-3 * np.arange(4) + 1.1e-3, key, strict=True)
        for dz in (-0.55e-3, 0.55e-3)
    ]
    profile = np.array([(-3e-3, key[0]), *top, (top[-1][0] + key[-1] + 1.8e-3, -1.8e-3)])
    square = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    steel = {"friction": 0.3, "restitution": 0}
    built.add("housing", mesh=mesh("housing", sleeve(outer, inner, 20e-3)), motion="static", **steel)
    built.add("plug", mesh=mesh("plug", plug), density=7850, **steel)
    built.join("axle", "hinge", "plug", axis=(0, 0, 1), anchor=(0, 0, 0))
    built.add(
        "key",
        mesh=mesh("key", blade(profile)),
        collides_with=["plug", *(f"plate{k}" for k in range(4))],
        **steel | keys,
    )
    for k, (cut, high) in enumerate(zip(CUTS, key, strict=True)):
        window = np.array([(1.1e-3, cut), (-1.1e-3, cut), (-1.1e-3, -3.4e-3), (1.1e-3, -3.4e-3)])
        plate = mesh(f"plate{k}", sleeve(square * (2.3e-3, 5.4e-3), window, 0.8e-3))
        lift = 2e-5 + (-DROP if "path" in keys else high - cut)
        built.add(f"plate{k}", mesh=plate, position=(0, lift, 2.2e-3 * k + 1.1e-3), density=7850, **steel)
    return built


def keys(at: Setting) -> Iterator[Check]:
    """A key that is pushed into a lock lifts its plates to where they clear the housing; it turns the plug then, and
    another key does not."""
    path = [{"time": 0, "position": (0, 0, -14e-3)}, {"time": 1.0, "position": (0, 0, 0)}]
    with Files() as mesh:
        ran = run_built(at, "pushed in", lock(mesh, CUTS, motion="kinematic", path=path), 1.05)
    lifted = np.ptp(ran.rollout.position[[0, -1], 3:, 1], axis=0)
    yield ran.most("plates too high or low", np.abs(lifted - DROP).max(), 1e-4, "m")
    for name, cuts in (("its own key", CUTS), ("another key", CUTS[::-1])):
        with Files() as mesh:
            built = lock(mesh, cuts)
            motor = {"speed": 3.0, "max_force": 0.02}
            built.join("hand", "hinge", "key", axis=(0, 0, 1), anchor=(0, 0, 0), motor=motor)
            ran = run_built(at, name, built, 0.5)
        turned = spun(ran, "plug")[-1]
        yield ran.between("turns the plug", turned, *((1.3, 1.6) if cuts == CUTS else (-0.02, 0.2)), "rad")


# The six sticks of a burr puzzle, two along each axis, in cells; and which of them has each cell that several cross.
STICKS = [[(-3, 3), (-1, 1), (low, low + 2)] for low in (0, -2)]
STICKS += [[(low, low + 2), (-3, 3), (-1, 1)] for low in (0, -2)] + [
    [(-1, 1), (low, low + 2), (-3, 3)] for low in (0, -2)
]
OWNERS = "30305555001300335515001100442020"


def blocks(cells: np.ndarray, size: float, gap: float) -> Mesh:
    """The surface of cubes [K, 3] of `size` m, drawn in by `gap` m."""
    known = set(map(tuple, cells.tolist()))
    corners, normals = [], []
    for axis in range(3):
        for side in (0, 1):
            out = np.eye(3, dtype=int)[axis] * (2 * side - 1)
            bare = np.array([cell for cell in known if tuple(np.add(cell, out).tolist()) not in known])
            one, two = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
            square = np.array([0 * one, one, one + two, two][:: 2 * side - 1]) + side * np.eye(3, dtype=int)[axis]
            corners.append(bare[:, None] + square)
            normals.append(np.broadcast_to(out, corners[-1].shape))
    place, index = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    drawn = np.zeros((2, *place.shape))
    for way, name in ((np.maximum, 1), (np.minimum, 0)):
        way.at(drawn[name], index.reshape(-1), np.concatenate(normals).reshape(-1, 3))
    quads = index.reshape(-1, 4)
    return clean(Mesh(size * place - gap * drawn.sum(0), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))


def puzzles(at: Setting) -> Iterator[Check]:
    """A burr puzzle of six sticks of 20 x 20 x 60 mm with a fifth of a millimetre of play, one of them held: whichever
    way gravity pulls, the key slides out along its axis only, and no other stick comes off."""
    size, gap = 10e-3, 1e-4
    cells = np.array([*np.ndindex(6, 6, 6)]) - 3
    inside = np.array(
        [
            np.all([(cells[:, a] >= low) & (cells[:, a] < high) for a, (low, high) in enumerate(stick)], 0)
            for stick in STICKS
        ]
    )
    shared = iter(OWNERS)
    owner = [int(next(shared)) if sum(who) > 1 else int(np.argmax(who)) if any(who) else -1 for who in inside.T]
    meshes = [blocks(cells[np.array(owner) == k], size, gap) for k in range(6)]
    for way in ([1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 1, 1]):
        built = SceneBuilder(gravity=(G * np.array(way) / np.linalg.norm(way)).tolist())
        with Files() as mesh:
            for k, one in enumerate(meshes):
                keys: dict[str, Any] = {"motion": "static"} if k == 1 else {"mass": 0.02}
                built.add(f"stick{k}", mesh=mesh(f"stick{k}", one), friction=0.5, restitution=0, **keys)
            ran = run_built(at, f"towards {way}", built, 0.3)
        moved = np.linalg.norm(ran.rollout.position - ran.rollout.position[0], axis=2).max(0)
        if way[0]:
            yield ran.near("key slides out", ran.rollout.position[-1, 0, 0], 0.5 * G * 0.3**2, 0.02, "m")
        yield ran.most("others move", moved[1 if way[0] else 0 :].max(), 20 * gap, "m")


ASSEMBLY = (pegs, rims, rollers, gears, nuts, bearings, bricks, links, puzzles, keys)
