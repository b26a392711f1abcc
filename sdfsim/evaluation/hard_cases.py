"""The hard cases: their scenes, what is measured on the motions, and what is wanted.

Scenes are of metre-sized boxes and balls on a floor, in the teacher's gravity. Coefficients of the bodies and the floor
are such that their products lie within what models are trained on, unless a case is about them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from math import atan, degrees
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.scenarios import steady_faces
from sdfsim.dynamics.bodies import largest_extent
from sdfsim.dynamics.rollout import Rollout
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.engines import body_inertia
from sdfsim.evaluation.penetration import rollout_penetration
from sdfsim.scene.scene import Body, Effects, Scene
from sdfsim.shape.mesh import MESH_SUFFIXES
from sdfsim.shape.shape import Shape, analytic_shape, shape_from_mesh, shape_from_primitive

G = 10.0  # m/s^2
FRICTION, RESTITUTION = 0.8, 0.5  # of a body
FLOOR_FRICTION, FLOOR_RESTITUTION = 0.5, 0.5
NUDGE = 1e-3  # m and rad: how far repetitions of a case start from the exact one
PLATE = 0.01  # m, thickness of what fast bodies are thrown at
BRICK = (1.0, 0.5, 0.4)  # m
CARD = (0.06, 0.6, 1.0)  # m, thickness along x, standing
LEAN = 20.0  # degrees from upright
BALLS = 8  # dropped at once
BOXES = ((1.0, 1.0, 1.0), (1.0, 0.7, 0.5), (1.0, 0.5, 0.5), (0.4, 1.0, 0.8))  # m, of those tossed
WALL = 0.12  # of the bowl primitive, relative to its outer radius
BOWL_BALL = 0.5  # m, size of what is piled into the bowl

UP = np.array([0.0, 0.0, 1.0])

FALLEN = 0.25  # of a body's height at the start: what has sunk by more has fallen
GAIN = 0.01  # of the energy at the start: a step that adds more is counted
APART = 0.1  # of a body's size: motions farther from each other than this have diverged
RUNAWAY = 10.0  # times the energy at the start, and no motion is worth measuring
CURVE = 120  # points kept of a curve

FEWEST = 2  # repetitions: there is no spread of one
YAWS = (0.0, 37.0, 121.0, 245.0)  # degrees
SPEEDS = (1.0, 5.0, 20.0, 50.0)  # m/s
TOWERS = (3, 5, 10, 20)
RATIOS = (1.0, 10.0, 100.0, 1000.0)
RESTITUTIONS = (0.0, 0.3, 0.5, 0.7, 0.9)
FRICTIONS = (0.2, 0.4, 0.6)
OFFSETS = (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0)  # degrees from the angle at which a body begins to slide


@dataclass(frozen=True)
class Run:
    """One motion of one scene.

    Attributes:
        scene: what moved.
        rollout: how, up to the last good state.
        broke: the simulator's error where it ended early, else empty.
    """

    scene: Scene
    rollout: Rollout
    broke: str = ""


Measured = tuple[dict[str, float], np.ndarray]  # figures by name, and the curve [2, K] to draw (K may be 0)
Measure = Callable[[Sequence["Run"]], Measured]
NO_CURVE = np.zeros((2, 0))


@dataclass(frozen=True)
class Figure:
    """One number that a case gives.

    Attributes:
        name: as the measure calls it.
        unit: of the number.
        digits: shown after the point; differences that are not shown do not count.
        limit: what is wanted is at most this; None where only the teacher says how good one can be.
        largest: of several repetitions the largest counts, not the mean.
        judged: whether lower is better; the others tell, such as the height of a rebound.
        longer: higher is better instead.
    """

    name: str
    unit: str
    digits: int = 2
    limit: float | None = None
    largest: bool = False
    judged: bool = True
    longer: bool = False


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: unique, fit for a file.
        group: name of the `Group` it belongs to.
        title: what it is.
        scenes: the scenes of one repetition, given its number; repetition 0 is the case as it is meant.
        measure: of the motions of these scenes, in their order.
        figures: what `measure` gives.
        seconds: how long.
        steps: how many steps instead.
        repeats: repetitions, from starts slightly off or with other random scenes: their spread is the noise.
        cuda: the scenes are simulated a second time there, behind the first.
        teacher: whether the teacher can take part.
        x: where it stands in its group's plot of the first figure; None for a case that is not one of a row.
    """

    name: str
    group: str
    title: str
    scenes: Callable[[int], list[Scene]]
    measure: Measure
    figures: tuple[Figure, ...]
    seconds: float = 3.0
    steps: int | None = None
    repeats: int = 3
    cuda: bool = False
    teacher: bool = True
    x: float | None = None


@dataclass(frozen=True)
class Group:
    """Cases of one kind.

    Attributes:
        title: what they have in common.
        curve: labels (x, y) of what a case draws.
        axis: label of the cases' `x`.
        about: the quantity of a model's ranges that the cases are about: one that never varied was not learned.
    """

    title: str
    curve: tuple[str, str] = ("", "")
    axis: str = ""
    about: str = ""


TIME = "time (s)"
SHIFT = (TIME, "largest shift (% of size)")
GROUPS = {
    "yaw": Group("the whole scene turned about the vertical", (TIME, "deviation (% of size)")),
    "overlap": Group("bodies that start inside each other", (TIME, "fastest body (m/s)")),
    "thin": Group("fast bodies of 20 cm and a plate of 1 cm", axis="speed (m/s)"),
    "rest": Group("bodies at rest on the floor", (TIME, "drift (% of size)")),
    "stack": Group("stacks, after 3 s", SHIFT, "cubes in the tower"),
    "mass": Group("a heavy cube on a light one", SHIFT, "mass ratio", "mass_ratio"),
    "bounce": Group(
        "balls dropped from about 1 m", (TIME, "height of its lowest point (m)"), "restitution e", "restitution"
    ),
    "slope": Group(
        "a box at rest on a slope", ("degrees beyond atan(mu)", "travelled in 2 s (m)"), "friction mu", "friction"
    ),
    "pile": Group("a pile in a bowl", (TIME, "energy (% of the start's)"), "bodies"),
    "energy": Group("random scenes: energy from nothing"),
    "precision": Group(
        "other arithmetic: time until motions are 10 % of a body's size apart", (TIME, "apart (% of size)")
    ),
}


# --- scenes ---


@cache
def box(*size: float) -> Shape:
    """A box with full extents m; one number makes a cube."""
    return analytic_shape("box", size=size if len(size) == 3 else size * 3)


@cache
def ball(diameter: float = 1.0) -> Shape:
    """A sphere."""
    return analytic_shape("sphere", radius=diameter / 2)


def body(name: str, shape: int, position: Sequence[float] | np.ndarray, **fields: Any) -> Body:
    """A dynamic body of 1 kg that does not move, unless `fields` say otherwise."""
    defaults: dict[str, Any] = {
        "motion": "dynamic",
        "scale": 1.0,
        "quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0]),
        "velocity": np.zeros(3),
        "angular_velocity": np.zeros(3),
        "mass": 1.0,
        "friction": FRICTION,
        "restitution": RESTITUTION,
    }
    return Body(name=name, shape=shape, position=np.asarray(position, dtype=np.float64), **(defaults | fields))


def on_floor(
    shapes: Sequence[Shape],
    bodies: Sequence[Body],
    *,
    tilt: float = 0.0,
    friction: float = FLOOR_FRICTION,
    restitution: float = FLOOR_RESTITUTION,
    sleep: bool = False,
) -> Scene:
    """Bodies above the plane z = 0, which is the last of them.

    Args:
        shapes: of the bodies.
        bodies: all but the floor.
        tilt: degrees; instead of the floor it is gravity that leans, towards +x, which is the same.
        friction, restitution: of the floor.
        sleep: whether bodies may fall asleep.
    """
    fields: Any = {"motion": "static", "mass": 0.0, "friction": friction, "restitution": restitution}
    floor = body("floor", len(shapes), [0, 0, 0], **fields)
    angle = np.radians(tilt)
    return Scene(
        shapes=(*shapes, analytic_shape("plane")),
        bodies=(*bodies, floor),
        gravity=G * np.array([np.sin(angle), 0.0, -np.cos(angle)]),
        duration=1.0,
        effects=Effects(sleep="on" if sleep else "off"),
    )


def nudged(scene: Scene, repeat: int) -> Scene:
    """The same scene started slightly off: bodies shifted sideways by up to `NUDGE` and turned about z by as much.

    Args:
        scene: as it is meant.
        repeat: the seed; 0 leaves the scene exactly as it is.
    """
    if repeat == 0:
        return scene
    rng = np.random.default_rng(repeat)
    return replace(scene, bodies=tuple(_nudge(b, rng) if b.motion == "dynamic" else b for b in scene.bodies))


def _nudge(one: Body, rng: np.random.Generator) -> Body:
    turn = Rotation.from_euler("z", rng.uniform(-NUDGE, NUDGE)) * Rotation.from_quat(one.quat_xyzw)
    shift = np.array([*rng.uniform(-NUDGE, NUDGE, 2), 0.0])
    return replace(one, position=one.position + shift, quat_xyzw=turn.as_quat())


def yawed(scene: Scene, degrees: float) -> Scene:
    """The whole scene turned about the z axis."""
    turn = Rotation.from_euler("z", degrees, degrees=True)
    return replace(
        scene,
        gravity=turn.apply(scene.gravity),
        bodies=tuple(
            replace(
                b,
                position=turn.apply(b.position),
                quat_xyzw=(turn * Rotation.from_quat(b.quat_xyzw)).as_quat(),
                velocity=turn.apply(b.velocity),
                angular_velocity=turn.apply(b.angular_velocity),
            )
            for b in scene.bodies
        ),
    )


def started_off(scene: Scene, speed: float) -> Scene:
    """The same with every dynamic body's velocity along x changed by `speed` m/s."""
    off = np.array([speed, 0.0, 0.0])
    return replace(
        scene,
        bodies=tuple(replace(b, velocity=b.velocity + off) if b.motion == "dynamic" else b for b in scene.bodies),
    )


def overlapping(first: Shape, second: Shape, apart: float) -> Scene:
    """Two bodies of 1 m at floor height, their centres `apart` m from each other."""
    return on_floor([first, second], [body("first", 0, [0, 0, 0.5]), body("second", 1, [apart, 0, 0.5])])


def sunk(shape: Shape) -> Scene:
    """A body whose centre is in the floor."""
    return on_floor([shape], [body("sunk", 0, [0, 0, 0])])


def thrown_at_plate(speed: float, repeat: int) -> Scene:
    """Eight boxes and eight balls of 20 cm, anyhow turned, flying at `speed` m/s down to a plate of 1 cm.

    There is no floor below: what passes the plate falls on.
    """
    rng = np.random.default_rng(repeat)
    thrown = []
    for k in range(16):
        place = np.array([0.6 * (k % 4) - 0.9, 0.6 * (k // 4) - 0.9, 0.5])
        turn = Rotation.random(rng=rng).as_quat()
        thrown.append(body(f"thrown[{k}]", k % 2, place, quat_xyzw=turn, velocity=-speed * UP))
    static: Any = {"motion": "static", "mass": 0.0, "friction": FLOOR_FRICTION, "restitution": FLOOR_RESTITUTION}
    plate = body("plate", 2, [0, 0, -PLATE / 2], **static)
    shapes = (box(0.2), ball(0.2), box(3.0, 3.0, PLATE))
    return Scene(shapes, (*thrown, plate), gravity=-G * UP, duration=1.0)


def resting(shape: Shape, *, sleep: bool) -> Scene:
    """One body at rest on the floor: on that of its steady faces which already looks down most, else as it is."""
    vertices = shape.mesh.vertices - shape.com
    faces = steady_faces(vertices)
    turn = Rotation.identity()
    if len(faces):
        turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], faces[faces[:, 2].argmin()][None])[0]
    low = turn.apply(shape.mesh.vertices)[:, 2].min()
    return on_floor([shape], [body("body", 0, [0, 0, -low], quat_xyzw=turn.as_quat())], sleep=sleep)


def tower(count: int) -> Scene:
    """`count` cubes of 1 m on top of each other."""
    return on_floor([box(1.0)], [body(f"block[{k}]", 0, [0, 0, 0.5 + k]) for k in range(count)])


def pyramid(layers: int = 4) -> Scene:
    """Cubes in a plane, one less in each layer, each over the gap between two."""
    places = [[1.05 * (i - (layers - k - 1) / 2), 0, 0.5 + k] for k in range(layers) for i in range(layers - k)]
    return on_floor([box(1.0)], [body(f"block[{n}]", 0, place) for n, place in enumerate(places)])


def wall(layers: int = 5, length: int = 4) -> Scene:
    """Bricks in running bond: every other layer is set off by half a brick, and has half a brick at either end."""
    long, deep, high = BRICK
    pitch = 1.01 * long  # sides do not touch
    bricks = []
    for k in range(layers):
        places = [(0, pitch * (i - (length - 1) / 2)) for i in range(length)]
        if k % 2:
            end = pitch * (length - 1) / 2 + long / 4
            places = [(1, -end), *((0, (a + b) / 2) for (_, a), (_, b) in pairwise(places)), (1, end)]
        for shape, x in places:
            mass = 0.5 if shape else 1.0
            bricks.append(body(f"brick[{len(bricks)}]", shape, [x, 0, high * (0.5 + k)], mass=mass))
    return on_floor([box(*BRICK), box(long / 2, deep, high)], bricks)


def card_house() -> Scene:
    """Two cards that lean against each other, upper edges touching over the middle."""
    thick, _, length = CARD
    angle = np.radians(LEAN)
    aside = 0.5 * (length * np.sin(angle) + thick * np.cos(angle))
    height = 0.5 * (length * np.cos(angle) + thick * np.sin(angle))
    cards = [
        body(
            name,
            0,
            [side * aside, 0, height],
            quat_xyzw=Rotation.from_euler("y", -side * LEAN, degrees=True).as_quat(),
        )
        for name, side in (("left", -1), ("right", 1))
    ]
    return on_floor([box(*CARD)], cards)


def heavy_on_light(ratio: float) -> Scene:
    """A cube of `ratio` kg on one of 1 kg."""
    return on_floor([box(1.0)], [body("light", 0, [0, 0, 0.5]), body("heavy", 0, [0, 0, 1.5], mass=ratio)])


def dropped(restitution: float, repeat: int) -> Scene:
    """Balls far from each other whose lowest points are 0.9 to 1.1 m above a floor of restitution 1.

    Not one height: how an engine bounces depends on how far above the floor a step happens to end.
    """
    heights = np.random.default_rng(repeat).uniform(0.9, 1.1, BALLS)
    balls = [
        body(f"ball[{k}]", 0, [4.0 * k, 0, 0.5 + height], restitution=restitution) for k, height in enumerate(heights)
    ]
    return on_floor([ball()], balls, restitution=1.0)


def slope(friction: float, degrees: float) -> Scene:
    """A flat box at rest on a slope; `friction` is the product of the two coefficients."""
    slab = body("slab", 0, [0, 0, 0.25], friction=friction / 0.8)
    return on_floor([box(1.0, 1.0, 0.5)], [slab], tilt=degrees, friction=0.8)


def bowl_radii(count: int) -> tuple[float, float]:
    """(inner, outer) radius m of a bowl with twice the room that `count` bodies take."""
    inner = BOWL_BALL * (2.0 * count / (4 * 0.6)) ** (1 / 3)
    return inner, inner / (1 - WALL)


def piled(count: int, repeat: int) -> Scene:
    """Balls and boxes in a loose lattice inside a bowl, and above it as far as they find no room."""
    rng = np.random.default_rng(repeat)
    inner, outer = bowl_radii(count)
    spacing = 1.2 * BOWL_BALL
    side = np.arange(-np.ceil(inner / spacing), np.ceil(inner / spacing) + 1) * spacing
    heights = np.arange(-np.floor(inner / spacing), 4 * len(side)) * spacing
    lattice = np.stack(np.meshgrid(side, side, heights), -1).reshape(-1, 3)
    reach = np.linalg.norm(np.minimum(lattice, [np.inf, np.inf, 0.0]), axis=1)
    free = lattice[reach < inner - 0.75 * BOWL_BALL]
    places = free[np.argsort(free[:, 2], kind="stable")][:count] + outer * UP
    places += rng.uniform(-0.02, 0.02, places.shape)
    turns = Rotation.random(count, rng=rng).as_quat()
    shapes = (ball(BOWL_BALL), box(0.6 * BOWL_BALL), shape_from_primitive("bowl", sdf="grid", name="bowl"))
    bodies = [body(f"piled[{k}]", k % 2, p, quat_xyzw=turns[k]) for k, p in enumerate(places)]
    static: Any = {"motion": "static", "mass": 0.0, "friction": FLOOR_FRICTION, "restitution": FLOOR_RESTITUTION}
    vessel = body("bowl", 2, [0, 0, outer], scale=2 * outer, **static)
    return on_floor(shapes, [*bodies, vessel])


def tossed(seed: Sequence[int]) -> Scene:
    """Three to eight boxes and balls of random size and material, thrown across each other as in MOVi."""
    rng = np.random.default_rng(seed)
    shapes = (ball(), *(box(*size) for size in BOXES))
    bodies: list[Body] = []
    places, radii = np.zeros((0, 3)), np.zeros(0)
    count = rng.integers(3, 9)
    while len(bodies) < count:
        index = 0 if rng.random() < 0.5 else int(rng.integers(1, len(shapes)))
        scale = rng.uniform(0.6, 1.2)
        radius = scale * float(np.linalg.norm(shapes[index].mesh.vertices, axis=1).max())
        place = rng.uniform([-2.5, -2.5, radius], [2.5, 2.5, 4.0])
        if (np.linalg.norm(places - place, axis=1) < radii + radius).any():
            continue
        places, radii = np.vstack([places, place]), np.append(radii, radius)
        aim = rng.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 0.0])
        fields = {
            "scale": scale,
            "quat_xyzw": Rotation.random(rng=rng).as_quat(),
            "velocity": aim - place * [1.0, 1.0, 0.0],
            "mass": shapes[index].volume * scale**3 * rng.uniform(1.0, 2.7),
            "friction": rng.uniform(0.4, 0.8),
            "restitution": rng.uniform(0.3, 0.7),
        }
        bodies.append(body(f"tossed[{len(bodies)}]", index, place, **fields))
    return on_floor(shapes, bodies)


# --- measures ---


def movers(scene: Scene) -> np.ndarray:
    """[M] indices of the dynamic bodies."""
    return np.array([k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"])


def size(scene: Scene) -> float:
    """m, the mean largest extent of the dynamic bodies."""
    return float(np.mean([largest_extent(scene.shapes[b.shape]) * b.scale for b in _dynamic(scene)]))


def energy(run: Run) -> np.ndarray:
    """[T+1] J: kinetic energy of the dynamic bodies, and their potential energy above the height 0."""
    scene, motion = run.scene, run.rollout
    total = np.zeros(len(motion.time))
    for k in movers(scene):
        body = scene.bodies[k]
        turn = Rotation.from_quat(motion.orientation[:, k])
        spin = turn.inv().apply(motion.angular_velocity[:, k])
        total += 0.5 * body.mass * np.square(motion.velocity[:, k]).sum(1)
        total += 0.5 * np.einsum("ti,ij,tj->t", spin, body_inertia(body, scene.shapes[body.shape]), spin)
        total -= body.mass * motion.position[:, k] @ scene.gravity
    return total


def ran_away(run: Run) -> str:
    """When a motion had more than `RUNAWAY` times the energy it started with; empty if never.

    The energy at the start counts from one size below the lowest body, so that it is not zero.
    """
    scene, motion = run.scene, run.rollout
    rows = movers(scene)
    mass = np.array([scene.bodies[k].mass for k in rows])
    strength = float(np.linalg.norm(scene.gravity))
    course = energy(run)
    lowest = (motion.position[0, rows] @ -scene.gravity).min() - strength * size(scene)
    at = np.flatnonzero(course - mass.sum() * lowest > RUNAWAY * (course[0] - mass.sum() * lowest))
    if not len(at):
        return ""
    return f"more than {RUNAWAY:g} times the energy of the start from {motion.time[at[0]]:.2f} s on"


def rest(runs: Sequence[Run], *, times: Sequence[float]) -> Measured:
    """How a body at rest behaves: drift after each of `times`, and speed, height and motion over the last second."""
    run = runs[0]
    motion, k, extent = run.rollout, movers(run.scene)[0], size(run.scene)
    path = motion.position[:, k]
    drift = 100 / extent * np.linalg.norm((path - path[0])[:, :2], axis=1)
    last = motion.time >= motion.time[-1] - 1.0
    moved = np.abs(path[last] - path[-1]).max() + np.abs(motion.orientation[last, k] - motion.orientation[-1, k]).max()
    seconds = max(float(np.ptp(motion.time[last])), 1e-9)
    figures = {f"drift {t:g} s": float(drift[min(np.searchsorted(motion.time, t), len(drift) - 1)]) for t in times}
    figures["speed"] = float(np.linalg.norm(np.diff(path[last], axis=0), axis=1).sum()) / seconds
    figures["height"] = 100 * abs(float(path[-1, 2] - path[0, 2])) / float(path[0, 2])
    figures["motion"] = float(moved)
    return figures, _curve(motion.time, drift)


def standing(runs: Sequence[Run]) -> Measured:
    """How many bodies of a stack have fallen, and how far the others have shifted sideways at most, % of size."""
    run = runs[0]
    motion, rows = run.rollout, movers(run.scene)
    path = motion.position[:, rows]
    sunk = (path[0, :, 2] - path[-1, :, 2]) / _heights(run.scene)
    shift = 100 / size(run.scene) * np.linalg.norm(path - path[0], axis=2)
    fallen = sunk > FALLEN
    figures = {"fallen": float(fallen.sum()), "shift": float(shift[-1, ~fallen].max(initial=0.0))}
    return figures, _curve(motion.time, shift.max(1))


def squeezed(runs: Sequence[Run]) -> Measured:
    """Penetration of a stack, % of size, and how many have fallen."""
    depth = rollout_penetration(runs[0].scene, runs[0].rollout)
    figures = {"worst depth": 100 * float(depth.max(initial=0.0)) / size(runs[0].scene)}
    stood, curve = standing(runs)
    return figures | {"fallen": stood["fallen"]}, curve


def separated(runs: Sequence[Run]) -> Measured:
    """Highest speed m/s of bodies that start in each other, and how deep they still are at the end, % of size."""
    run = runs[0]
    motion = run.rollout
    speed = np.linalg.norm(motion.velocity[:, movers(run.scene)], axis=2).max(1)
    left = (
        100
        * float(rollout_penetration(run.scene, run.rollout, every=len(motion) or 1).max(initial=0.0))
        / size(run.scene)
    )
    return {"exit speed": float(speed.max()), "depth left": left}, _curve(motion.time, speed)


def passed(runs: Sequence[Run]) -> Measured:
    """Share % of bodies thrown at a plate about the origin that have been below it while over its area."""
    shares = []
    for run in runs:
        plate = next(b for b in run.scene.bodies if b.motion == "static")
        half = run.scene.shapes[plate.shape].sdf.bounds[1]
        path = run.rollout.position[:, movers(run.scene)]
        over = (np.abs(path[..., :2]) < half[:2]).all(-1)
        below = path[..., 2] < plate.position[2] - 0.5 * size(run.scene)
        shares.append(100 * float((over & below).any(0).mean()))
    return {"through": float(np.mean(shares))}, NO_CURVE


def rebound(runs: Sequence[Run], *, restitution: float) -> Measured:
    """Height of the first rebound of balls dropped onto the floor, % of what they fell, against e^2.

    The mean over the balls of a scene; the curve is that of the first, its lowest point.
    """
    run = runs[0]
    motion, shares = run.rollout, []
    for k in movers(run.scene):
        radius = run.scene.shapes[run.scene.bodies[k].shape].sdf.bounds[1, 2]
        low, rate = motion.position[:, k, 2] - radius, motion.velocity[:, k, 2]
        hit = np.flatnonzero(rate[1:] > rate[:-1])  # what flies gets slower upwards with every step
        up = np.flatnonzero(rate[hit[0] + 1 :] > 0) if len(hit) else hit
        shares.append(100 * max(0.0, float(low[hit[0] + 1 + up[0] :].max())) / float(low[0]) if len(up) else 0.0)
    share = float(np.mean(shares))
    first = movers(run.scene)[0]
    radius = run.scene.shapes[run.scene.bodies[first].shape].sdf.bounds[1, 2]
    figures = {"rebound": share, "error": abs(share - 100 * restitution**2)}
    return figures, _curve(motion.time, motion.position[:, first, 2] - radius)


def slipped(runs: Sequence[Run], *, friction: float, offsets: Sequence[float]) -> Measured:
    """Where a body on a slope begins to slide, in degrees from atan(friction).

    The first of the angles tried at which it travels more than half of what it would slide two degrees beyond the
    critical one tells: from its distance we go back as far as Coulomb's law says that each degree adds.

    Args:
        runs: one an angle, rising, each from rest.
        friction: of the contact.
        offsets: of the angles, degrees from the critical one.
    """
    critical = float(np.degrees(np.arctan(friction)))
    travelled = np.array([np.linalg.norm(r.rollout.position[-1, 0] - r.rollout.position[0, 0]) for r in runs])
    seconds, gravity = float(runs[0].rollout.time[-1]), float(np.linalg.norm(runs[0].scene.gravity))
    a_degree = slide(friction, critical + 2.0, seconds, gravity) / 2.0
    over = np.flatnonzero(travelled > a_degree)
    begins = float(offsets[over[0]] - travelled[over[0]] / a_degree) if len(over) else float(offsets[-1])
    return {"slips at": begins, "error": abs(begins)}, np.array([offsets, travelled])


def slide(friction: float, degrees: float, seconds: float, gravity: float) -> float:
    """m that a body at rest slides on a slope in so many seconds, by Coulomb's law."""
    angle = np.radians(degrees)
    return 0.5 * gravity * max(0.0, float(np.sin(angle) - friction * np.cos(angle))) * seconds**2


def heaped(runs: Sequence[Run]) -> Measured:
    """A pile in a bowl: penetration, who left through the wall, and energy beyond that of the start."""
    run = runs[0]
    motion, rows, extent = run.rollout, movers(run.scene), size(run.scene)
    bowl = next(b for b in run.scene.bodies if b.name == "bowl")
    outer = 0.5 * bowl.scale
    middle = outer * (1 - 0.5 * WALL)
    from_centre = motion.position[:, rows] - bowl.position
    radius, under = np.linalg.norm(from_centre, axis=2), from_centre[..., 2] < 0
    out = (under[:-1] & under[1:] & (radius[:-1] < middle) & (radius[1:] >= middle)).any(0)
    course = energy(run)
    mass = np.array([run.scene.bodies[k].mass for k in rows])
    given = course[0] - float(mass.sum() * np.linalg.norm(run.scene.gravity) * (outer - middle))
    depth = rollout_penetration(run.scene, run.rollout, every=10)
    figures = {
        "depth 95 %": 100 * float(np.percentile(depth, 95)) / extent if len(depth) else 0.0,
        "through the wall": float(out.sum()),
        "energy gain": 100 * float((course - course[0]).max() / given),
    }
    return figures, _curve(motion.time, 100 * course / course[0])


def created(runs: Sequence[Run]) -> Measured:
    """Energy that came from nothing: share % of steps that add more than `GAIN` of the start's, and the worst, %."""
    gains = [np.diff(energy(run)) / energy(run)[0] for run in runs]
    every = np.concatenate(gains)
    worst = [float(gain.max(initial=0.0)) for gain in gains]
    figures = {"steps with gain": 100 * float((every > GAIN).mean()), "worst gain": 100 * max(worst)}
    return figures, NO_CURVE


def turned_back(runs: Sequence[Run], *, degrees: Sequence[float]) -> Measured:
    """Deviation % of size, at the end, of turned scenes from themselves; `degrees` is one group's, the first 0."""
    apart, curve = 0.0, NO_CURVE
    for start in range(0, len(runs), len(degrees)):
        reference = runs[start]
        for offset, angle in enumerate(degrees[1:], 1):
            back = Rotation.from_euler("z", -angle, degrees=True)
            distance = _apart(reference, runs[start + offset], back)
            if len(distance) and distance[-1] >= apart:
                apart = float(distance[-1])
                curve = _curve(reference.rollout.time[: len(distance)], distance)
    return {"deviation": apart}, curve


def diverged(runs: Sequence[Run]) -> Measured:
    """Mean time s until motions of the second half are 10 % of a size from the first half's; their length if never."""
    half = len(runs) // 2
    times, curves = [], []
    for one, other in zip(runs[:half], runs[half:], strict=True):
        distance = _apart(one, other, Rotation.identity())
        clock = one.rollout.time[: len(distance)]
        away = np.flatnonzero(distance > 100 * APART)
        times.append(float(clock[away[0]] if len(away) else clock[-1]))
        curves.append(_curve(clock, distance))
    return {"diverges after": float(np.mean(times))}, curves[int(np.argmin(times))]


def _apart(reference: Run, other: Run, back: Rotation) -> np.ndarray:
    """[T+1] % of size: root mean square over the bodies of how far they are from each other."""
    rows = movers(reference.scene)
    frames = min(len(reference.rollout.time), len(other.rollout.time))
    place = other.rollout.position[:frames, rows]
    returned = back.apply(place.reshape(-1, 3)).reshape(place.shape)
    distance = np.square(returned - reference.rollout.position[:frames, rows]).sum(2).mean(1) ** 0.5
    return 100 / size(reference.scene) * distance


def _heights(scene: Scene) -> np.ndarray:
    """[M] m, vertical extent of the dynamic bodies as they stand at the start."""
    tops = []
    for body in _dynamic(scene):
        level = Rotation.from_quat(body.quat_xyzw).apply(scene.shapes[body.shape].mesh.vertices) @ UP
        tops.append(float(np.ptp(level)) * body.scale)
    return np.array(tops)


def _dynamic(scene: Scene) -> list:
    return [b for b in scene.bodies if b.motion == "dynamic"]


def _curve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    kept = np.unique(np.linspace(0, len(x) - 1, min(len(x), CURVE)).astype(int))
    return np.array([x[kept], y[kept]])


# --- the cases ---


def cases(*, quick: bool = False, shapes: Path | None = None) -> list[Case]:
    """Every case, in the order of the table.

    Args:
        quick: fewer and shorter ones: two repetitions, no pile of 512, ten seconds of rest for sixty, a tenth of the
            random scenes.
        shapes: folder of meshes that are to rest on the floor too, each scaled to a largest extent of 1 m.

    Raises:
        SdfsimError: the folder holds no meshes, or one that cannot be used.
    """
    found = [
        *_yaw(quick),
        *_overlaps(),
        *_thin(),
        *_resting(quick, shapes),
        *_stacks(),
        *_bounces_and_slopes(quick),
        *_piles_and_tosses(quick),
        *_precision(quick),
    ]
    return [replace(case, repeats=min(case.repeats, FEWEST)) if quick else case for case in found]


def _nudged(scene: Scene) -> Callable[[int], list[Scene]]:
    return lambda repeat: [nudged(scene, repeat)]


def _yaw(quick: bool) -> list[Case]:
    yaws = YAWS[:2] if quick else YAWS

    def turned(repeat: int) -> list[Scene]:
        return [yawed(tossed((6, repeat, k)), yaw) for k in range(2) for yaw in yaws]

    figures = (Figure("deviation", "% of size", 5, largest=True),)
    measure = partial(turned_back, degrees=yaws)
    return [Case("yaw", "yaw", "random scenes, 50 steps", turned, measure, figures, steps=50)]


def _overlaps() -> list[Case]:
    cube, sphere = box(1.0), ball()
    built = {
        "overlap-boxes": ("two boxes, half in each other", overlapping(cube, cube, 0.5)),
        "overlap-balls": ("two balls, half in each other", overlapping(sphere, sphere, 0.5)),
        "coincident-boxes": ("two boxes in one place", overlapping(cube, cube, 0.0)),
        "coincident-balls": ("two balls in one place", overlapping(sphere, sphere, 0.0)),
        "coincident-both": ("a box and a ball in one place", overlapping(cube, sphere, 0.0)),
        "sunk-box": ("a box, half in the floor", sunk(cube)),
    }
    figures = (Figure("exit speed", "m/s", 2, limit=3.0), Figure("depth left", "% of size", 1))
    return [
        Case(name, "overlap", title, _nudged(scene), separated, figures, seconds=1.0)
        for name, (title, scene) in built.items()
    ]


def _thin() -> list[Case]:
    figures = (Figure("through", "%", 0, limit=0.0),)
    return [
        Case(f"thin-{v:g}", "thin", f"{v:g} m/s", lambda repeat, v=v: [thrown_at_plate(v, repeat)], passed, figures,
             seconds=0.6, x=v)
        for v in SPEEDS
    ]  # fmt: skip


def _resting(quick: bool, folder: Path | None) -> list[Case]:
    times = (10.0,) if quick else (10.0, 60.0)
    built = {"box": box(1.0), "ball": ball(), "knot": shape_from_primitive("torus_knot", sdf="grid", name="knot")}
    if folder:
        built |= _meshes(folder)
    drifts = tuple(Figure(f"drift {t:g} s", "% of size", 2, limit=1.0) for t in times)
    awake = (*drifts, Figure("speed", "m/s", 4, limit=0.01), Figure("height", "%", 2, limit=5.0))
    asleep = (Figure("motion", "m", 9, limit=0.0), drifts[0])
    found = []
    for name, shape in built.items():
        scene, measure = resting(shape, sleep=False), partial(rest, times=times)
        title = f"{name}, sleep"
        found.append(
            Case(f"rest-{name}", "rest", f"{title} off", _nudged(scene), measure, awake, seconds=times[-1], repeats=2)
        )
        scene, measure = resting(shape, sleep=True), partial(rest, times=times[:1])
        found.append(
            Case(f"rest-{name}-sleep", "rest", f"{title} on", _nudged(scene), measure, asleep, seconds=times[0],
                 repeats=2, teacher=False)
        )  # fmt: skip
    return found


def _meshes(folder: Path) -> dict[str, Shape]:
    files = sorted(f for f in folder.glob("*") if f.suffix.lower() in MESH_SUFFIXES)
    if not files:
        raise SdfsimError(f"{folder}: no meshes found", f"expected {', '.join(sorted(MESH_SUFFIXES))}")
    extents = {file: largest_extent(shape_from_mesh(file, sdf="mesh")) for file in files}
    return {file.stem: shape_from_mesh(file, sdf="grid", units=1.0 / extent) for file, extent in extents.items()}


def _stacks() -> list[Case]:
    fallen = Figure("fallen", "bodies", 1, limit=0.0)
    figures = (fallen, Figure("shift", "% of size", 1))
    built = {f"tower-{n}": (f"tower of {n}", tower(n), float(n)) for n in TOWERS} | {
        "pyramid": ("pyramid of 10 cubes", pyramid(), None),
        "wall": ("wall of 22 bricks", wall(), None),
        "cards": ("two cards that lean on each other", card_house(), None),
    }
    stacks = [
        Case(name, "stack", title, _nudged(scene), standing, figures, x=x) for name, (title, scene, x) in built.items()
    ]
    figures = (Figure("worst depth", "% of size", 1), fallen)
    return stacks + [
        Case(f"mass-{m:g}", "mass", f"{m:g} kg on 1 kg", _nudged(heavy_on_light(m)), squeezed, figures, x=m)
        for m in RATIOS
    ]


def _bounces_and_slopes(quick: bool) -> list[Case]:
    figures = (Figure("error", "% of drop", 1, limit=5.0), Figure("rebound", "% of drop", 1, judged=False))
    bounces = [
        Case(f"bounce-{e:g}", "bounce", f"e = {e:g}: {100 * e * e:.0f} % wanted", lambda k, e=e: [dropped(e, k)],
             partial(rebound, restitution=e), figures, seconds=1.3, x=e)
        for e in RESTITUTIONS
    ]  # fmt: skip
    figures = (Figure("error", "degrees", 1, limit=2.0), Figure("slips at", "degrees", 1, judged=False))
    offsets = OFFSETS[::2] if quick else OFFSETS
    slopes = []
    for mu in FRICTIONS:
        critical = degrees(atan(mu))
        built = [slope(mu, critical + offset) for offset in offsets]
        slopes.append(
            Case(f"slope-{mu:g}", "slope", f"mu = {mu:g}: atan(mu) = {critical:.1f} degrees",
                 lambda repeat, built=built: [nudged(scene, repeat) for scene in built],
                 partial(slipped, friction=mu, offsets=offsets), figures, seconds=2.0, repeats=2, x=mu)
        )  # fmt: skip
    return bounces + slopes


def _piles_and_tosses(quick: bool) -> list[Case]:
    figures = (
        Figure("depth 95 %", "% of size", 1),
        Figure("through the wall", "bodies", 1, limit=0.0),
        Figure("energy gain", "%", 1, limit=1.0),
    )
    piles = [
        Case(f"pile-{n}", "pile", f"{n} bodies", lambda repeat, n=n: [piled(n, repeat)], heaped, figures, seconds=2.0,
             repeats=repeats, x=n)
        for n, repeats in (((64, 2),) if quick else ((64, 2), (512, 1)))
    ]  # fmt: skip
    each, repeats = (10, FEWEST) if quick else (50, 4)
    figures = (Figure("steps with gain", "%", 2), Figure("worst gain", "% of start", 2, largest=True))
    tosses = Case(
        "energy", "energy", f"{repeats * each} scenes of 3 to 8 bodies",
        lambda repeat: [tossed((20, repeat, k)) for k in range(each)], created, figures, seconds=2.0, repeats=repeats,
    )  # fmt: skip
    return [*piles, tosses]


def _precision(quick: bool) -> list[Case]:
    def plain(repeat: int) -> list[Scene]:
        return [tossed((22, repeat, k)) for k in range(2 if quick else 4)]

    def off(repeat: int) -> list[Scene]:
        return [*plain(repeat), *(started_off(scene, 1e-6) for scene in plain(repeat))]

    figures = (Figure("diverges after", "s", 2, longer=True),)
    case = Case("start-off", "precision", "start 1e-6 m/s off", off, diverged, figures, repeats=2)
    return [case, replace(case, scenes=plain, teacher=False, name="cuda", title="on CUDA", cuda=True)]
