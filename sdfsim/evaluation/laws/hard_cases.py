"""The hard cases: scenes on which models are compared with engines, and the limits of what is measured there.

Single bodies and stacks of cubes have laws in closed form instead (`textbook.py`). Scenes have metre-sized boxes and
balls on a floor, with the gravity of the training data. Unless a case is about coefficients, the products of those of
bodies and floor are within the models' training ranges. Checks without a limit have PyBullet as their only standard.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import visible
from sdfsim.data.scenarios import steady_faces
from sdfsim.evaluation.engines import Ran
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.laws.scenes import Check, Law, Setting
from sdfsim.evaluation.metrics import energy
from sdfsim.geometry.mesh_io import MESH_SUFFIXES
from sdfsim.geometry.primitives import BOWL_WALL, bowl_radii
from sdfsim.physics.bodies import largest_extent
from sdfsim.scene.scene import Body, Effects, Scene
from sdfsim.shape.make import analytic_shape, shape_from_mesh, shape_from_primitive
from sdfsim.shape.shape import Shape

G = 10.0  # m/s^2
FRICTION, RESTITUTION = 0.8, 0.5  # coefficients of a body
FLOOR_FRICTION, FLOOR_RESTITUTION = 0.5, 0.5
FIXED: dict[str, Any] = {"motion": "static", "mass": 0.0, "friction": FLOOR_FRICTION, "restitution": FLOOR_RESTITUTION}
NUDGE = 1e-3  # m and rad: how far repetitions of a case start from the exact one
PLATE = 0.01  # m, thickness of the plate at which fast bodies are thrown
BRICK = (1.0, 0.5, 0.4)  # m
CARD = (0.06, 0.6, 1.0)  # m, thickness along x, standing
LEAN = 20.0  # degrees from upright
BOXES = ((1.0, 1.0, 1.0), (1.0, 0.7, 0.5), (1.0, 0.5, 0.5), (0.4, 1.0, 0.8))  # m, sizes of tossed boxes
BOWL_BALL = 0.5  # m, size of the bodies that are piled into the bowl
UP = np.array([0.0, 0.0, 1.0])

FALLEN = 0.25  # relative to a body's height at the start: a body that has sunk by more has fallen
GAIN = 0.01  # relative to the energy at the start: steps that add more are counted
APART = 0.1  # relative to a body's size: motions farther from each other than this have diverged
RUNAWAY = 10.0  # times the energy at the start: beyond it, motions are not measured

Measure = Callable[[Sequence[Ran]], Iterator[Check]]  # of the motions of a case's scenes, in their order

# --- scenes ---


@cache
def box(*size: float) -> Shape:
    """A box with full extents m; one number makes a cube."""
    return analytic_shape("box", size=size if len(size) == 3 else size * 3)


@cache
def ball(diameter: float = 1.0) -> Shape:
    return analytic_shape("sphere", radius=diameter / 2)


@cache
def bowl() -> Shape:
    return shape_from_primitive("bowl", sdf="grid", name="bowl")


@cache
def knot() -> Shape:
    return shape_from_primitive("torus_knot", sdf="grid", name="knot")


def body(name: str, shape: int, position: Sequence[float] | np.ndarray, **fields: Any) -> Body:
    """A dynamic body of 1 kg at rest, unless `fields` say otherwise."""
    still: dict[str, Any] = {"quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0])}
    still |= {"velocity": np.zeros(3), "angular_velocity": np.zeros(3)}
    usual = {"motion": "dynamic", "scale": 1.0, "mass": 1.0, "friction": FRICTION, "restitution": RESTITUTION}
    return Body(name=name, shape=shape, position=np.asarray(position, dtype=np.float64), **(still | usual | fields))


def on_floor(
    shapes: Sequence[Shape], bodies: Sequence[Body], *, tilt: float = 0.0, sleep: bool = False, **material: float
) -> Scene:
    """Bodies above the plane z = 0, which is the last body; `material` is the floor's friction and restitution.

    A `tilt` in degrees leans gravity towards +x in place of the floor, which is equivalent.
    """
    floor, angle = body("floor", len(shapes), [0, 0, 0], **FIXED | material), np.radians(tilt)
    gravity = G * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    effects = Effects(sleep="on" if sleep else "off")
    return Scene((*shapes, analytic_shape("plane")), (*bodies, floor), gravity=gravity, duration=1.0, effects=effects)


def nudged(scene: Scene, repeat: int) -> Scene:
    """The same scene started slightly off: bodies shifted sideways by up to `NUDGE` and turned about z by as much.

    Repetition 0 is the scene exactly as it is.
    """
    if repeat == 0:
        return scene
    rng = np.random.default_rng(repeat)

    def nudge(one: Body) -> Body:
        turn = Rotation.from_euler("z", rng.uniform(-NUDGE, NUDGE)) * Rotation.from_quat(one.quat_xyzw)
        shift = np.array([*rng.uniform(-NUDGE, NUDGE, 2), 0.0])
        return replace(one, position=one.position + shift, quat_xyzw=turn.as_quat())

    return _moved(scene, nudge)


def _moved(scene: Scene, change: Callable[[Body], Body]) -> Scene:
    return replace(scene, bodies=tuple(change(b) if b.motion == "dynamic" else b for b in scene.bodies))


def yawed(scene: Scene, degrees: float) -> Scene:
    turn = Rotation.from_euler("z", degrees, degrees=True)

    def turned(b: Body) -> Body:
        vectors = {name: turn.apply(getattr(b, name)) for name in ("position", "velocity", "angular_velocity")}
        return replace(b, **vectors, quat_xyzw=(turn * Rotation.from_quat(b.quat_xyzw)).as_quat())

    return replace(scene, gravity=turn.apply(scene.gravity), bodies=tuple(map(turned, scene.bodies)))


def overlapping(first: Shape, second: Shape, apart: float) -> Scene:
    """Two bodies of 1 m at floor height, with centres `apart` m from each other."""
    return on_floor([first, second], [body("first", 0, [0, 0, 0.5]), body("second", 1, [apart, 0, 0.5])])


def thrown_at_plate(speed: float, repeat: int) -> Scene:
    """Eight boxes and eight balls of 20 cm in random orientations that fly down at a plate of 1 cm with `speed` m/s.

    There is no floor: bodies that pass the plate fall on.
    """
    rng = np.random.default_rng(repeat)
    thrown = []
    for k in range(16):
        place = np.array([0.6 * (k % 4) - 0.9, 0.6 * (k // 4) - 0.9, 0.5])
        turn = Rotation.random(rng=rng).as_quat()
        thrown.append(body(f"thrown[{k}]", k % 2, place, quat_xyzw=turn, velocity=-speed * UP))
    plate = body("plate", 2, [0, 0, -PLATE / 2], **FIXED)
    shapes = (box(0.2), ball(0.2), box(3.0, 3.0, PLATE))
    return Scene(shapes, (*thrown, plate), gravity=-G * UP, duration=1.0)


def resting(shape: Shape, *, sleep: bool) -> Scene:
    """One body at rest on the floor, on its stable face that points down most; if it has no such face, as it is."""
    vertices = shape.mesh.vertices - shape.com
    faces = steady_faces(vertices)
    turn = Rotation.identity()
    if len(faces):
        turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], faces[faces[:, 2].argmin()][None])[0]
    low = turn.apply(shape.mesh.vertices)[:, 2].min()
    return on_floor([shape], [body("body", 0, [0, 0, -low], quat_xyzw=turn.as_quat())], sleep=sleep)


def wall(layers: int = 5, length: int = 4) -> Scene:
    """Bricks in running bond: every other layer is shifted by half a brick, and has half a brick at either end."""
    long, deep, high = BRICK
    pitch = 1.01 * long  # sides do not touch
    bricks = []
    for k in range(layers):
        places = [(0, pitch * (i - (length - 1) / 2)) for i in range(length)]
        if k % 2:
            end = pitch * (length - 1) / 2 + long / 4
            places = [(1, -end), *((0, (a + b) / 2) for (_, a), (_, b) in pairwise(places)), (1, end)]
        for shape, x in places:
            place, mass = [x, 0, high * (0.5 + k)], 0.5 if shape else 1.0
            bricks.append(body(f"brick[{len(bricks)}]", shape, place, mass=mass))
    return on_floor([box(*BRICK), box(long / 2, deep, high)], bricks)


def slab_on_bowl() -> Scene:
    """A slab of 2 cm that lies across the rim of a bowl, a mesh."""
    vessel = bowl()
    rim = float(vessel.mesh.vertices[:, 2].max())
    still = body("bowl", 1, [0, 0, 0.5], **FIXED)
    return on_floor([box(1.2, 1.2, 0.02), vessel], [body("slab", 0, [0, 0, 0.5 + rim + 0.01]), still])


def card_house() -> Scene:
    """Two cards that lean against each other, upper edges touching over the middle."""
    thick, _, length = CARD
    angle = np.radians(LEAN)
    aside = 0.5 * (length * np.sin(angle) + thick * np.cos(angle))
    height = 0.5 * (length * np.cos(angle) + thick * np.sin(angle))

    def card(name: str, side: int) -> Body:
        turn = Rotation.from_euler("y", -side * LEAN, degrees=True)
        return body(name, 0, [side * aside, 0, height], quat_xyzw=turn.as_quat())

    return on_floor([box(*CARD)], [card("left", -1), card("right", 1)])


def piled(count: int, repeat: int) -> Scene:
    """Balls and boxes in a loose lattice inside a bowl, and above it if there is no room inside."""
    rng = np.random.default_rng(repeat)
    inner, outer = bowl_radii(count, BOWL_BALL)
    spacing = 1.2 * BOWL_BALL
    side = np.arange(-np.ceil(inner / spacing), np.ceil(inner / spacing) + 1) * spacing
    heights = np.arange(-np.floor(inner / spacing), 4 * len(side)) * spacing
    lattice = np.stack(np.meshgrid(side, side, heights), -1).reshape(-1, 3)
    reach = np.linalg.norm(np.minimum(lattice, [np.inf, np.inf, 0.0]), axis=1)
    free = lattice[reach < inner - 0.75 * BOWL_BALL]
    places = free[np.argsort(free[:, 2], kind="stable")][:count] + outer * UP
    places += rng.uniform(-0.02, 0.02, places.shape)
    turns = Rotation.random(count, rng=rng).as_quat()
    shapes = (ball(BOWL_BALL), box(0.6 * BOWL_BALL), bowl())
    bodies = [body(f"piled[{k}]", k % 2, p, quat_xyzw=turns[k]) for k, p in enumerate(places)]
    vessel = body("bowl", 2, [0, 0, outer], scale=2 * outer, **FIXED)
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


# --- measures: checks on the motions of a case's scenes; sizes are mean largest extents ---


def size(scene: Scene) -> float:
    """m, the mean largest extent of the dynamic bodies."""
    return float(np.mean([largest_extent(scene.shapes[b.shape]) * b.scale for b in _dynamic(scene)]))


def ran_away(trial: Ran) -> str:
    """A text that says when a motion had more than `RUNAWAY` times the energy at its start; empty if never.

    The energy at the start is relative to one size below the lowest body, so that it is not zero.
    """
    course, strength = energy(trial.motion), float(np.linalg.norm(trial.scene.gravity))
    lowest = (trial.path[0] @ -trial.scene.gravity).min() - strength * size(trial.scene)
    given = course - trial.motion.mass[~trial.motion.static].sum() * lowest
    at = np.flatnonzero(given > RUNAWAY * given[0])
    return f"more than {RUNAWAY:g} times the energy of the start from {trial.time[at[0]]:.2f} s on" if len(at) else ""


def rest(trials: Sequence[Ran], *, times: Sequence[float]) -> Iterator[Check]:
    """Behaviour of a body at rest: drift after each of `times`, and speed and height over the last second; with sleep
    also the motion in that second, which is none."""
    trial = trials[0]
    path, turn = trial.path[:, 0], trial.motion.orientation[:, ~trial.motion.static][:, 0]
    drift = 100 / size(trial.scene) * np.linalg.norm((path - path[0])[:, :2], axis=1)
    last = trial.time >= trial.time[-1] - 1.0
    seconds = max(float(np.ptp(trial.time[last])), 1e-9)
    if trial.scene.effects.sleep == "on":
        motion = np.abs(path[last] - path[-1]).max() + np.abs(turn[last] - turn[-1]).max()
        yield Check("motion", float(motion), high=0.0, unit="m", digits=9)
    for t in times:
        moved = float(drift[min(np.searchsorted(trial.time, t), len(drift) - 1)])
        yield Check(f"drift {t:g} s", moved, high=1.0, unit="% of size")
    if trial.scene.effects.sleep != "on":
        speed = float(np.linalg.norm(np.diff(path[last], axis=0), axis=1).sum()) / seconds
        yield Check("speed", speed, high=0.01, unit="m/s", digits=4)
        yield Check("height", 100 * abs(float(path[-1, 2] - path[0, 2])) / float(path[0, 2]), high=5.0, unit="%")


def standing(trials: Sequence[Ran]) -> Iterator[Check]:
    """Number of bodies of a stack that have fallen, and the largest shift of the others."""
    path, scene = trials[0].path, trials[0].scene
    heights = []
    for body in _dynamic(scene):
        level = Rotation.from_quat(body.quat_xyzw).apply(scene.shapes[body.shape].mesh.vertices) @ UP
        heights.append(float(np.ptp(level)) * body.scale)
    fallen = path[0, :, 2] - path[-1, :, 2] > FALLEN * np.array(heights)
    yield Check("fallen", float(fallen.sum()), high=0.0, unit="bodies", digits=1)
    shift = 100 / size(scene) * np.linalg.norm(path[-1] - path[0], axis=1)
    yield Check("shift", float(shift[~fallen].max(initial=0.0)), unit="% of size", digits=1)


def separated(trials: Sequence[Ran]) -> Iterator[Check]:
    """Highest speed of bodies that overlap at the start, and their overlap at the end."""
    scene, motion = trials[0].scene, trials[0].motion
    speed = np.linalg.norm(motion.velocity[:, ~motion.static], axis=2)
    yield Check("exit speed", float(speed.max()), high=3.0, unit="m/s")
    left = depths(scene, trials[0].rollout, every=max(1, len(motion.position) - 1)).max(initial=0.0)
    yield Check("depth left", 100 * float(left) / size(scene), unit="% of size", digits=1)


def passed(trials: Sequence[Ran]) -> Iterator[Check]:
    """Share of bodies, thrown at a plate about the origin, that have been below it within its area."""
    shares = []
    for trial in trials:
        plate = next(b for b in trial.scene.bodies if b.motion == "static")
        half = trial.scene.shapes[plate.shape].sdf.bounds[1]
        over = (np.abs(trial.path[..., :2]) < half[:2]).all(-1)
        below = trial.path[..., 2] < plate.position[2] - 0.5 * size(trial.scene)
        shares.append(100 * float((over & below).any(0).mean()))
    yield Check("through", float(np.mean(shares)), high=0.0, unit="%", digits=0)


def heaped(trials: Sequence[Ran]) -> Iterator[Check]:
    """A pile in a bowl: overlap, number of bodies that left through the wall, and energy beyond that of the start."""
    scene, motion = trials[0].scene, trials[0].motion
    bowl = next(b for b in scene.bodies if b.name == "bowl")
    outer = 0.5 * bowl.scale
    middle = outer * (1 - 0.5 * BOWL_WALL)
    from_centre = trials[0].path - bowl.position
    radius, under = np.linalg.norm(from_centre, axis=2), from_centre[..., 2] < 0
    out = (under[:-1] & under[1:] & (radius[:-1] < middle) & (radius[1:] >= middle)).any(0)
    course, weight = energy(motion), motion.mass[~motion.static].sum() * np.linalg.norm(scene.gravity)
    depth = depths(scene, trials[0].rollout, every=10)
    deep = 100 * float(np.percentile(depth, 95)) / size(scene) if len(depth) else 0.0
    gain = 100 * float((course - course[0]).max() / (course[0] - weight * (outer - middle)))
    yield Check("depth 95 %", deep, unit="% of size", digits=1)
    yield Check("through the wall", float(out.sum()), high=0.0, unit="bodies", digits=1)
    yield Check("energy gain", gain, high=1.0, unit="%", digits=1)


def created(trials: Sequence[Ran]) -> Iterator[Check]:
    """Energy from nothing: share of steps that add more than `GAIN` of the energy at the start, and the worst."""
    courses = [energy(trial.motion) for trial in trials]
    gains = np.concatenate([np.diff(course) / course[0] for course in courses])
    yield Check("steps with gain", 100 * float((gains > GAIN).mean()), unit="%")
    yield Check("worst gain", 100 * float(gains.max(initial=0.0)), unit="% of start", worst=True)


def turned_back(trials: Sequence[Ran], *, degrees: Sequence[float]) -> Iterator[Check]:
    """Deviation at the end of turned scenes from the unturned one; `degrees` are those of one group, the first 0."""
    apart = 0.0
    for start in range(0, len(trials), len(degrees)):
        for offset, angle in enumerate(degrees[1:], 1):
            back = Rotation.from_euler("z", -angle, degrees=True)
            apart = max(apart, float(_apart(trials[start], trials[start + offset], back)[-1]))
    yield Check("deviation", apart, unit="% of size", digits=5, worst=True)


def diverged(trials: Sequence[Ran]) -> Iterator[Check]:
    """Mean time until motions of the second half are 10 % of a size from those of the first half; their length if
    never."""
    half, times = len(trials) // 2, []
    for one, other in zip(trials[:half], trials[half:], strict=True):
        distance = _apart(one, other, Rotation.identity())
        away = np.flatnonzero(distance > 100 * APART)
        times.append(float(one.time[away[0] if len(away) else len(distance) - 1]))
    yield Check("diverges after", float(np.mean(times)), unit="s", better=1)


def _apart(reference: Ran, other: Ran, back: Rotation) -> np.ndarray:
    """[T] % of size: root mean square distance over the bodies."""
    frames = min(len(reference.path), len(other.path))
    returned = back.apply(other.path[:frames].reshape(-1, 3)).reshape(frames, -1, 3)
    return 100 / size(reference.scene) * np.square(returned - reference.path[:frames]).sum(2).mean(1) ** 0.5


def _dynamic(scene: Scene) -> list[Body]:
    return [b for b in scene.bodies if b.motion == "dynamic"]


# --- the cases ---


def hard_cases(*, quick: bool = False, shapes: Mapping[str, Shape] | None = None) -> list[Law]:
    """Every case, in the order of the table.

    Args:
        quick: fewer and shorter cases: two repetitions, no pile of 512, ten seconds of rest in place of sixty, a tenth
            of the random scenes.
        shapes: more shapes to rest on the floor, by name.
    """
    found: list[Law] = []

    def add(
        group: str, name: str, title: str, scenes: Any, measure: Measure, *, seconds: float = 3.0, repeats: int = 3,
        **more: Any,
    ) -> None:  # fmt: skip
        """Add a case of `scenes`: a function of the repetition, or scenes that repetitions nudge."""

        def checks(at: Setting) -> Iterator[Check]:
            made = [nudged(one, at.repeat) for one in scenes] if isinstance(scenes, list) else scenes(at.repeat)
            return measure([at.by(one, seconds) for one in made])

        repeats = min(repeats, 2) if quick else repeats  # a single repetition has no spread
        found.append(Law(name, group, title, checks, repeats, **more))

    yaws = (0.0, 37.0) if quick else (0.0, 37.0, 121.0, 245.0)  # degrees

    def turned(repeat: int) -> list[Scene]:
        return [yawed(tossed((6, repeat, k)), yaw) for k in range(2) for yaw in yaws]

    add("yaw", "yaw", "random scenes, 1 s", turned, partial(turned_back, degrees=yaws), seconds=1.0)

    cube, sphere = box(1.0), ball()
    overlaps = {
        "overlap-boxes": ("two boxes, half in each other", overlapping(cube, cube, 0.5)),
        "overlap-balls": ("two balls, half in each other", overlapping(sphere, sphere, 0.5)),
        "coincident-boxes": ("two boxes in one place", overlapping(cube, cube, 0.0)),
        "coincident-balls": ("two balls in one place", overlapping(sphere, sphere, 0.0)),
        "coincident-both": ("a box and a ball in one place", overlapping(cube, sphere, 0.0)),
        "sunk-box": ("a box, half in the floor", on_floor([cube], [body("sunk", 0, [0, 0, 0])])),
    }
    for name, (title, scene) in overlaps.items():
        add("overlap", name, title, [scene], separated, seconds=1.0)

    for v in (1.0, 5.0, 20.0, 50.0):  # m/s
        throw = lambda repeat, v=v: [thrown_at_plate(v, repeat)]  # noqa: E731
        add("thin", f"thin-{v:g}", f"{v:g} m/s", throw, passed, seconds=0.6, x=v)

    times = (10.0,) if quick else (10.0, 60.0)
    resters = {"box": lambda: cube, "ball": lambda: sphere, "knot": knot}  # meshes are sampled when they are needed
    long, short = (partial(rest, times=t) for t in (times, times[:1]))
    for name, shape in (resters | {name: lambda shape=shape: shape for name, shape in (shapes or {}).items()}).items():
        awake, asleep = (
            lambda repeat, shape=shape, sleep=sleep: [nudged(resting(shape(), sleep=sleep), repeat)]
            for sleep in (False, True)
        )
        add("rest", f"rest-{name}", f"{name}, sleep off", awake, long, seconds=times[-1], repeats=2)
        add("rest", f"rest-{name}-sleep", f"{name}, sleep on", asleep, short, seconds=times[0], repeats=2,
            engines=False)  # fmt: skip
    add("rest", "rest-slab", "slab of 2 cm on a bowl, a mesh, sleep off",
        lambda repeat: [nudged(slab_on_bowl(), repeat)], short, seconds=times[0], repeats=2)  # fmt: skip

    add("stack", "wall", "wall of 22 bricks", [wall()], standing)
    add("stack", "cards", "two cards that lean on each other", [card_house()], standing)
    for n, repeats in ((64, 2),) if quick else ((64, 2), (512, 1)):
        pile = lambda repeat, n=n: [piled(n, repeat)]  # noqa: E731
        add("pile", f"pile-{n}", f"{n} bodies", pile, heaped, seconds=2.0, repeats=repeats, x=float(n))
    each, repeats = (10, 2) if quick else (50, 4)
    toss = lambda repeat: [tossed((20, repeat, k)) for k in range(each)]  # noqa: E731
    add("energy", "energy", f"{repeats * each} scenes of 3 to 8 bodies", toss, created, seconds=2.0, repeats=repeats)

    def off(repeat: int) -> list[Scene]:
        plain = [tossed((22, repeat, k)) for k in range(2 if quick else 4)]
        faster = np.array([1e-6, 0.0, 0.0])
        return [*plain, *(_moved(scene, lambda b: replace(b, velocity=b.velocity + faster)) for scene in plain)]

    add("precision", "start-off", "start 1e-6 m/s off", off, diverged, repeats=2)
    return found


def meshes(folder: Path) -> dict[str, Shape]:
    """The meshes in a folder, each scaled to a largest extent of 1 m. Raises SdfsimError if there are none, or one that
    cannot be used."""
    files = [f for f in visible(folder) if f.suffix.lower() in MESH_SUFFIXES] if folder.is_dir() else []
    if not files:
        raise SdfsimError(f"{folder}: no meshes found", f"expected {', '.join(sorted(MESH_SUFFIXES))}")
    extents = {file: largest_extent(shape_from_mesh(file, sdf="mesh")) for file in files}
    return {file.stem: shape_from_mesh(file, sdf="grid", units=1.0 / extent) for file, extent in extents.items()}
