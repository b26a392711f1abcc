"""The starts of the teacher's scenes: MOVi-B and MOVi-C as Kubric spawns them (Greff et al., 2022), and our own."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.shape_assets import ShapeSource

TRIES = 100  # places for one body before the scene is drawn again
UP, STILL = np.array([0.0, 0.0, 1.0]), np.zeros(3)

# Tossed bodies, as in Kubric.
REGION = ((-5.0, -5.0, 1.0), (5.0, 5.0, 5.0))  # m, contains the bounds of every tossed body at the start
COUNT = (3, 10)
SIZES = (0.7, 1.4)
MATERIALS = {"metal": (2.7, 0.4, 0.3), "rubber": (1.1, 0.8, 0.7)}  # density, friction, restitution
# MOVi-C: largest extent in m; Kubric's coefficients. Our meshes have no true size, and so no mass of their own: all
# have rubber's density.
EXTENTS_C = (0.75, 3.0)
PLAIN = (1.1, 0.5, 0.5)  # density, friction, restitution

VARIED_EXTENTS = (0.7, 1.4)  # m, of the smallest kind of body in a scene
LARGER = 8.0  # largest ratio of a body's extent to that, at rest; small ones are more frequent
LARGER_TOSSED = 2.0  # the same for tossed bodies
HOLLOW_SHARE = 0.2  # share of bowls among bodies that do not begin in one kind of motion
FRICTIONS, RESTITUTIONS = (0.0, 1.0), (0.0, 1.0)
DENSITIES = (0.1, 10.0)  # log-uniform
MASS_RATIO = 100.0  # largest mass ratio within a scene
OBSTACLES = {
    "obstacle_bowl": "bowl", "obstacle_torus": "torus", "obstacle_gear": "gear", "obstacle_table": "table"
}  # fmt: skip
OBSTACLE_EXTENTS = (2.0, 8.0)  # m
OBSTACLE_SHARE = 0.5  # share of the scenes whose bodies are tossed or at rest
ON_TOP = 0.5  # share of bodies at rest that are put on an obstacle, if there is one
# Shares of scenes by their start: tossed as in MOVi, `at_rest`, or in one of the motions of `set_moving`.
SHARES = {
    "tossed": 0.35,
    "resting": 0.35,
    "rolling": 0.08,
    "sliding": 0.07,
    "falling": 0.07,
    "head-on": 0.05,
    "spinning": 0.03,
}
FEW = (1, 4)  # number of bodies in one kind of motion; head-on two or four
BALL_SHARE = 0.5  # share of balls among the bodies in one kind of motion; of those that roll, all are balls

# Starts at or near rest.
STARTS = ("still", "dropped", "nudged", "pressed")
GAP = 2.5e-3  # m, under a body that is put down: the engine adds 1 mm around convex pieces, so 2 mm between two
DROP = 0.1  # m, largest height of one that is dropped
NUDGE = 0.3  # m/s, largest speed along x and along y
PRESSED = 0.08  # relative to its extent: how far at most a body is moved into others, along each axis
FIELD = 3.0  # m, half the side of the square of floor that is used
STACKED = 0.5  # share of bodies that are put on top of the one before
STEADY = 0.03  # least distance of the centre of mass from the rim of the face below it, relative to the extent

# Starts in one kind of motion.
SPEEDS = (0.5, 16.0)  # m/s, log-uniform
SPINS = (1.0, 10.0)  # rad/s, about the vertical
HEIGHTS = (0.1, 2.0)  # m, under a body that falls
MEETING = (0.1, 1.0)  # s, until the bodies of a pair touch
ALOFT = 32.0  # m, height of the lowest pair: more than it falls in 2 s, including what a hit may add
APART = 12.0  # m between the heights of pairs
HALF = 0.5  # share of bodies that move along x or y, have the spin of rolling, or are not turned; others: random

Bodies = list[tuple[ShapeSource, TeacherBody]]
Draw = Callable[[ShapeSource], TeacherBody]
Pose = tuple[np.ndarray, Rotation]  # [3] m of the centre of mass, and the orientation


@dataclass(frozen=True)
class Cast:
    shapes: list[ShapeSource]  # to draw bodies from
    scenery: dict[str, ShapeSource] = field(default_factory=dict)  # the recipe's own shapes, by name


@dataclass(frozen=True)
class Recipe:
    """How scenes start: `spawn` puts the bodies of a scene into the teacher's world and returns them in that order,
    static ones with mass 0; None if there was no room for one."""

    spawn: Callable[[Teacher, np.random.Generator, Cast], Bodies | None]
    kubasic: bool = False  # takes NAME/ folders as they are, in all splits; otherwise shapes are split by name
    scenery: dict[str, str] = field(default_factory=dict)  # the recipe's own shapes, name -> primitive


def movi_b(teacher: Teacher, rng: np.random.Generator, cast: Cast) -> Bodies | None:
    """Kubric's `movi_ab_worker`, restated."""
    names = list(MATERIALS)
    return _toss(
        teacher, rng, cast, lambda source: _body(source, rng.uniform(*SIZES), *MATERIALS[str(rng.choice(names))])
    )


def movi_c(teacher: Teacher, rng: np.random.Generator, cast: Cast) -> Bodies | None:
    """Kubric's `movi_c_worker`, restated."""
    return _toss(teacher, rng, cast, lambda source: _body(source, rng.uniform(*EXTENTS_C), *PLAIN))


def varied(teacher: Teacher, rng: np.random.Generator, cast: Cast) -> Bodies | None:
    """Any friction, restitution and mass ratio, and starts of all kinds, in the shares `SHARES`.

    Half of the scenes that are tossed or at rest (the kinds of `STARTS` in equal parts) have an obstacle, on which
    bodies may rest. Sizes in a scene differ by up to `LARGER`. In the other scenes one to four bodies, half of them
    balls, are in one kind of motion on an empty floor; pairs that meet head-on do so in flight, far above it.
    """
    start = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    placed, place = [], np.zeros(2)
    if start in ("tossed", "resting") and rng.random() < OBSTACLE_SHARE:
        source = cast.scenery[str(rng.choice(list(OBSTACLES)))]
        extent = rng.uniform(*OBSTACLE_EXTENTS)
        obstacle = _body(source, extent, 0.0, rng.uniform(*FRICTIONS), rng.uniform(*RESTITUTIONS))
        place, rotation = rng.uniform(-1.0, 1.0, 2), Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
        teacher.add(obstacle, upright(source, obstacle, place, 0.0, rotation), rotation.as_quat())
        placed.append((source, obstacle))
    masses: list[float] = []
    smallest, larger = rng.uniform(*VARIED_EXTENTS), {"tossed": LARGER_TOSSED, "resting": LARGER}.get(start, 1.0)

    def draw(source: ShapeSource) -> TeacherBody:
        extent = smallest * larger ** (rng.random() ** 2)
        volume = source.volume * extent**3
        heaviest, most = max(masses, default=0.0), min(masses, default=np.inf) * MASS_RATIO
        low = min(max(volume * DENSITIES[0], heaviest / MASS_RATIO), most)
        high = max(min(volume * DENSITIES[1], most), low)  # the mass ratio takes precedence over densities
        masses.append(float(np.exp(rng.uniform(np.log(low), np.log(high)))))
        return TeacherBody(source.urdf, extent, masses[-1], rng.uniform(*FRICTIONS), rng.uniform(*RESTITUTIONS))

    if start == "tossed":
        tossed = _toss(teacher, rng, replace(cast, shapes=_with_bowls(cast)), draw)
        return None if tossed is None else placed + tossed
    if start == "resting":
        shapes = _with_bowls(cast)
        picked = [shapes[k] for k in rng.integers(len(shapes), size=rng.integers(COUNT[0], COUNT[1] + 1))]
        bodies = [(source, draw(source)) for source in picked]
        under = (place, placed[0]) if placed else None
        return placed + bodies if at_rest(teacher, rng, bodies, str(rng.choice(STARTS)), under) else None
    count = 2 * int(rng.integers(1, 3)) if start == "head-on" else int(rng.integers(FEW[0], FEW[1] + 1))
    balls = rng.random(count) < (1.0 if start == "rolling" else BALL_SHARE)
    picked = [cast.scenery["ball"] if ball else cast.shapes[rng.integers(len(cast.shapes))] for ball in balls]
    bodies = [(source, draw(source)) for source in picked]
    return bodies if set_moving(teacher, rng, bodies, start) else None


RECIPES = {
    "movi-b": Recipe(movi_b, kubasic=True),
    "movi-c": Recipe(movi_c),
    "varied": Recipe(varied, scenery=OBSTACLES | {"ball": "sphere"}),
}


def _toss(teacher: Teacher, rng: np.random.Generator, cast: Cast, draw: Draw) -> Bodies | None:
    """Kubric's 3 to 10 bodies without overlaps, thrown across the floor; None if there is no room for one."""

    def propose(source: ShapeSource, body: TeacherBody) -> Pose | None:
        rotation = Rotation.random(rng=rng)
        low, high = _box(source, body, rotation)
        fits = (REGION[1] - high >= REGION[0] - low).all()
        return (rng.uniform(REGION[0] - low, REGION[1] - high), rotation) if fits else None

    bodies = []
    for index in range(len(teacher.bodies), len(teacher.bodies) + rng.integers(COUNT[0], COUNT[1] + 1)):
        source = cast.shapes[rng.integers(len(cast.shapes))]
        bodies.append((source, draw(source)))
        if (pose := _find_room(teacher, bodies[-1], propose)) is None:
            return None
        aim = rng.uniform((-4.0, -4.0, 0.0), (4.0, 4.0, 0.0))
        teacher.push(index, aim - pose[0] * (1.0, 1.0, 0.0), STILL)
    return bodies


def _with_bowls(cast: Cast) -> list[ShapeSource]:
    """The shapes to draw from, with as many bowls among them that `HOLLOW_SHARE` of the drawn ones are bowls."""
    bowls = max(1, round(len(cast.shapes) * HOLLOW_SHARE / (1.0 - HOLLOW_SHARE)))
    return cast.shapes + bowls * [cast.scenery["obstacle_bowl"]]


def at_rest(
    teacher: Teacher, rng: np.random.Generator, bodies: Bodies, start: str,
    under: tuple[np.ndarray, tuple[ShapeSource, TeacherBody]] | None = None,
) -> bool:  # fmt: skip
    """Put bodies down, after those that the teacher has already: all at rest, all dropped from `DROP` at most, all
    given a nudge, or pressed into each other, as `start` says. `under` is where [2] m an obstacle stands on which they
    may be put, and this obstacle. False if there was no room for one.

    Only pressed bodies overlap; from these models learn how bodies separate. Shapes have a largest extent of 1 m at
    scale 1.
    """
    first, below, top = len(teacher.bodies), np.zeros(2), 0.0
    poses: list[Pose] = []

    def propose(source: ShapeSource, body: TeacherBody) -> Pose:
        stacked = len(poses) > 0 and rng.random() < STACKED
        place, height = rng.uniform(-FIELD, FIELD, 2), 0.0
        if stacked:
            place, height = below + rng.uniform(-0.1, 0.1, 2) * body.scale, top
        elif under is not None and rng.random() < ON_TOP:
            low, high = _box(*under[1], Rotation.identity())
            place, height = under[0] + rng.uniform(-0.4, 0.4, 2) * under[1][1].scale, float(high[2] - low[2])
        gap = rng.uniform(GAP, DROP) if start == "dropped" else GAP
        rotation = _standing(source, rng)
        return upright(source, body, place, height + gap, rotation), rotation

    for index, (source, body) in enumerate(bodies, start=first):
        if (pose := _find_room(teacher, (source, body), propose)) is None:
            return False
        poses.append(pose)
        below, top = pose[0][:2], float(pose[0][2] + _box(source, body, pose[1])[1][2])
        if start == "nudged":
            teacher.push(index, np.array([*rng.uniform(-NUDGE, NUDGE, 2), 0.0]), STILL)
    if start == "pressed":
        for index, ((_, body), (position, rotation)) in enumerate(zip(bodies, poses, strict=True), start=first):
            teacher.place(index, position + rng.uniform(-PRESSED, PRESSED, 3) * body.scale, rotation.as_quat())
    return True


def set_moving(teacher: Teacher, rng: np.random.Generator, bodies: Bodies, motion: str) -> bool:
    """Put bodies into the world, after those that it has already, all in one kind of motion. False if there was no room
    for one.

    Bodies that roll must be balls: half move along x or y; half have the spin of rolling and the others a random one.
    Bodies that slide do not turn at first. Bodies that spin or fall have no other velocity. "head-on" takes two bodies
    at a time. Shapes have a largest extent of 1 m at scale 1.
    """
    if motion == "head-on":
        for k in range(0, len(bodies) - 1, 2):
            _meet(teacher, rng, bodies[k : k + 2], ALOFT + APART * (k // 2))
        return True

    def propose(source: ShapeSource, body: TeacherBody) -> Pose:
        gap = rng.uniform(*HEIGHTS) if motion == "falling" else GAP
        any_way = source.sphere or (motion == "falling" and rng.random() < HALF)
        rotation = Rotation.random(rng=rng) if any_way else _standing(source, rng)
        return upright(source, body, rng.uniform(-FIELD, FIELD, 2), gap, rotation), rotation

    for index, one in enumerate(bodies, start=len(teacher.bodies)):
        if _find_room(teacher, one, propose) is None:
            return False
        teacher.push(index, *_velocities(rng, motion, one[1].scale))
    return True


def _velocities(rng: np.random.Generator, motion: str, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear [3] m/s and angular [3] rad/s velocity of a body on the floor or above it."""
    if motion == "falling":
        return STILL, STILL
    if motion == "spinning":
        return STILL, rng.choice((-1.0, 1.0)) * rng.uniform(*SPINS) * UP
    turn = 0.5 * np.pi * rng.integers(4) if rng.random() < HALF else rng.uniform(0.0, 2 * np.pi)
    velocity = _speeds(rng) * np.array([np.cos(turn), np.sin(turn), 0.0])
    if motion == "sliding":
        return velocity, STILL
    spin = np.cross(UP, velocity) / (0.5 * extent)
    if rng.random() < HALF:
        spin = Rotation.random(rng=rng).apply(rng.uniform(0.0, 2.0) * spin)
    return velocity, spin


def _speeds(rng: np.random.Generator, count: int = 1) -> np.ndarray:
    low, high = np.log(SPEEDS)
    return np.exp(rng.uniform(low, high, count))


def _meet(teacher: Teacher, rng: np.random.Generator, pair: Bodies, height: float) -> None:
    """Put two bodies at `height` m that fly towards each other along a horizontal line."""
    line = _direction(rng)
    speeds, rotations = _speeds(rng, 2), Rotation.random(2, rng=rng)
    reach = [body.scale * np.linalg.norm(source.vertices, axis=1).max() for source, body in pair]
    middle = np.array([*rng.uniform(-FIELD, FIELD, 2), height])
    time = rng.uniform(*MEETING)
    for k, side in enumerate((-1.0, 1.0)):
        place = middle + side * (reach[k] + speeds[k] * time) * line
        index = teacher.add(pair[k][1], place, rotations[k].as_quat())
        teacher.push(index, -side * speeds[k] * line, STILL)


def _find_room(
    teacher: Teacher, one: tuple[ShapeSource, TeacherBody], propose: Callable[[ShapeSource, TeacherBody], Pose | None]
) -> Pose | None:
    """Add a body at the first of `TRIES` proposed poses where it overlaps nothing. Returns this pose, or None if there
    is none."""
    index = teacher.add(one[1])
    for _ in range(TRIES):
        if (pose := propose(*one)) is None:
            continue
        teacher.place(index, pose[0], pose[1].as_quat())
        if not teacher.overlaps(index):
            return pose
    return None


def _body(source: ShapeSource, extent: float, density: float, friction: float, restitution: float) -> TeacherBody:
    """A body of a shape at scale `extent`; density 0 makes it static."""
    return TeacherBody(source.urdf, extent, source.volume * density * extent**3, friction, restitution)


def _box(source: ShapeSource, body: TeacherBody, rotation: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [3] m of the box around a turned body, about its centre of mass."""
    vertices = body.scale * rotation.apply(source.vertices)
    return vertices.min(0), vertices.max(0)


def _direction(rng: np.random.Generator) -> np.ndarray:
    """A horizontal unit vector [3]."""
    turn = rng.uniform(0.0, 2 * np.pi)
    return np.array([np.cos(turn), np.sin(turn), 0.0])


def upright(source: ShapeSource, body: TeacherBody, place: np.ndarray, height: float, rotation: Rotation) -> np.ndarray:
    """The centre of mass [3] m for which the body's lowest point is `height` m above the floor at `place` [2] m."""
    return np.array([*place, height - _box(source, body, rotation)[0][2]])


def _standing(source: ShapeSource, rng: np.random.Generator) -> Rotation:
    """A rotation in which a shape stands on a random one of its stable faces; any rotation if it has none."""
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    faces = steady_faces(source.vertices)
    if len(faces) == 0:
        return turn * Rotation.random(rng=rng)
    return turn * Rotation.align_vectors([-UP], faces[rng.integers(len(faces))][None])[0]


def steady_faces(vertices: np.ndarray) -> np.ndarray:
    """Outward unit normals [K, 3] of the faces of the convex hull on which a body stands without tipping over;
    `vertices` [V, 3] are relative to its centre of mass."""
    hull = ConvexHull(vertices)
    extent = float(np.ptp(vertices, axis=0).max())
    corners = vertices[hull.vertices]
    # The normals of triangles of one face differ by rounding.
    _, first = np.unique(hull.equations.round(3), axis=0, return_index=True)
    steady = [plane[:3] for plane in hull.equations[first] if _margin(corners, plane, extent) >= STEADY * extent]
    return np.array(steady).reshape(-1, 3)


def _margin(corners: np.ndarray, plane: np.ndarray, extent: float) -> float:
    """How far the origin's foot is within the face on `plane` [4] (normal, offset); negative outside, -inf if it is not
    a face."""
    normal, offset = plane[:3], plane[3]
    face = corners[np.abs(corners @ normal + offset) < 1e-3 * extent]
    axes = np.linalg.svd(normal[None])[2][1:]
    try:
        rim = ConvexHull(face @ axes.T)
    except (QhullError, ValueError):
        return -np.inf
    return float(-rim.equations[:, 2].max())
