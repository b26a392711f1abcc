"""Everyday scenes that any rigid-body simulator has to get right, each with a closed form of the right answer.

    python -m sdfsim.evaluation.everyday [ROW ...] [--size 0.1] [--yaw 0] [--kind analytic] [--full]

prints a line a check: what was measured, what is wanted, and whether it holds. A row is a kind of scene; `--size` is
its unit of length (that of the smallest bodies), `--yaw` turns the whole scene about the vertical, and `--kind` is what
solids are made of: closed forms, the exact distance of a mesh, or samples of it on a grid. Lengths below are in units
of the size, times and speeds as at 10 cm (they scale by Froude's law). Everything is judged by closed forms and by the
instruments of `sdfsim.physics.instruments`, never by what the contact solve says of itself.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import cos, hypot, inf, pi, radians, sin, sqrt
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.files import write_text
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.learned.model import SOLVER, Model
from sdfsim.physics.instruments import DEEP, MADE, Verdict, energies, judged, placed, solid_of
from sdfsim.physics.rollout import Rollout
from sdfsim.physics.true_surfaces import gaps
from sdfsim.scene.scene import Body, Effects, Scene
from sdfsim.shape.make import analytic_shape, mesh_shape, shape_from_primitive
from sdfsim.shape.shape import Shape
from sdfsim.simulate.simulator import SimulationError, Simulator

G = 9.81  # m/s^2
UNIT = 0.1  # m, at which times and speeds are as they are written
SIZES = (0.02, 0.1, 1.0)  # m
YAWS = (0.0, 37.0, 121.0)  # degrees
KINDS = ("analytic", "mesh", "grid")
DENSITY = 500.0  # kg/m^3
Runner = Callable[[Scene, float], tuple[Rollout, str]]  # a scene, s -> its motion, and why that broke, if it did
JUDGED = 60  # frames of a run, evenly spaced, in which surfaces are measured
FACETS = 48  # of round meshes by default
STILL = Rotation.identity()


def solved(scene: Scene, seconds: float, model: str | Model = SOLVER) -> tuple[Rollout, str]:
    """Our motion of a scene: see `Runner`."""
    try:
        return Simulator(scene, model).run(seconds), ""
    except SimulationError as error:
        return error.rollout, error.message


@dataclass(frozen=True)
class Setting:
    """How a row is run, and by whom."""

    size: float = 0.1  # m
    yaw: float = 0.0  # degrees
    kind: str = "analytic"
    full: bool = False  # all random scenes and long runs
    by: Runner = solved

    @property
    def time(self) -> float:
        """What times are multiplied by."""
        return sqrt(self.size / UNIT)

    def __str__(self) -> str:
        return f"{self.size:g} m, {self.yaw:g} degrees, {self.kind}"


@dataclass(frozen=True)
class Check:
    """One number, and between what it has to lie."""

    name: str
    measured: float
    low: float
    high: float
    unit: str = ""

    @property
    def holds(self) -> bool:
        return bool(self.low <= self.measured <= self.high)

    @property
    def close(self) -> bool:
        """Whether another machine's rounding may decide: within a tenth of a limit, or of the range between two."""
        finite = [limit for limit in (self.low, self.high) if np.isfinite(limit)]
        width = self.high - self.low if len(finite) == 2 else abs(finite[0])
        return any(abs(self.measured - limit) < 0.1 * width for limit in finite)

    def __str__(self) -> str:
        wanted = f"{self.low:.6g} to {self.high:.6g}"
        if self.low == -inf:
            wanted = f"at most {self.high:.6g}"
        elif self.high == inf:
            wanted = f"at least {self.low:.6g}"
        return f"{'ok  ' if self.holds else 'FAIL'} {self.name}: {self.measured:.6g} {self.unit} (wanted {wanted})"


def near(name: str, measured: float, wanted: float, part: float, unit: str = "", slack: float = 0.0) -> Check:
    """A check within a `part` of the wanted value, plus `slack`."""
    off = abs(wanted) * part + slack
    return Check(name, float(measured), wanted - off, wanted + off, unit)


def most(name: str, measured: float, limit: float, unit: str = "") -> Check:
    return Check(name, float(measured), -inf, limit, unit)


# --- solids, of unit size ---


@cache
def solid(kind: str, form: str, *dims: float) -> Shape:
    """A box (x, y, z), ball (radius), cylinder or capsule (radius, height) of a kind."""
    if kind == "analytic":
        if form == "box":
            return analytic_shape("box", size=dims)
        if form == "ball":
            return analytic_shape("sphere", radius=dims[0])
        return analytic_shape("cylinder" if form == "cylinder" else "capsule", radius=dims[0], height=dims[1])
    return of_mesh(kind, form, *dims)


@cache
def of_mesh(kind: str, form: str, *dims: float) -> Shape:
    """The same and others as a mesh: cylinder (radius, height, facets), ball (radius, subdivisions), tube (outer and
    inner radius, height), torus (major, minor), stool (legs)."""
    return mesh_shape(_mesh(form, *dims), name=form, kind="grid" if kind == "grid" else "mesh")


def _mesh(form: str, *dims: float) -> Mesh:
    if form == "box":
        return primitives.box((dims[0], dims[1], dims[2]))
    if form == "ball":
        return primitives.sphere(dims[0], int(dims[1]) if len(dims) > 1 else 3)
    if form == "cylinder":
        return primitives.cylinder(dims[0], dims[1], int(dims[2]) if len(dims) > 2 else FACETS)
    if form == "torus":
        return primitives.torus(dims[0], dims[1], 96, 48)
    if form == "capsule":
        around = 2 * pi * np.arange(FACETS) / FACETS
        rings = []
        for tilt in np.linspace(-pi / 2, pi / 2, 18):
            half = np.copysign(0.5 * dims[1] - dims[0], tilt)
            r, z = dims[0] * cos(tilt), half + dims[0] * sin(tilt)
            rings.append(np.column_stack([r * np.cos(around), r * np.sin(around), np.full(FACETS, z)]))
        return convex_hull(np.concatenate(rings))
    if form == "tube":
        return _tube(dims[0], dims[1], dims[2])
    assert form == "stool"
    return _stool(int(dims[0]))


def _tube(outer: float, inner: float, height: float, around: int = 96) -> Mesh:
    """A tube about z."""
    turn = 2 * pi * np.arange(around) / around
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    rings = [(outer, -height / 2), (outer, height / 2), (inner, height / 2), (inner, -height / 2)]
    vertices = np.concatenate([np.column_stack([r * circle, np.full(around, z)]) for r, z in rings])
    faces, k = [], np.arange(around)
    after = (k + 1) % around
    for ring in range(4):
        a, b = ring * around, (ring + 1) % 4 * around
        faces += [np.column_stack([a + k, a + after, b + after]), np.column_stack([a + k, b + after, b + k])]
    return Mesh(vertices, np.concatenate(faces))


LEG = (0.45, 0.04, 0.5)  # how far out legs stand, half their width, and their length, of a stool


def _stool(legs: int) -> Mesh:
    """A round seat on thin legs, whose feet stand `LEG`[0] from the axis."""
    out, half, length = LEG
    parts = [primitives.cylinder(0.5, 0.1, FACETS)]
    for k in range(legs):
        leg = primitives.box((2 * half, 2 * half, length))
        turn = Rotation.from_euler("z", 2 * pi * k / legs)
        parts.append(Mesh(turn.apply(leg.vertices + np.array([out - half, 0.0, -0.5 * length])), leg.faces))
    return joined(parts)


# --- scenes ---


@dataclass(frozen=True)
class Put:
    """A body, lengths in units of the size; `v` and `w` as at 10 cm."""

    name: str
    shape: Shape
    at: Sequence[float]
    turn: Rotation = STILL
    v: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)  # m/s
    w: Sequence[float] = (0.0, 0.0, 0.0)  # rad/s
    mu: float = 0.5
    e: float = 0.0
    fixed: bool = False
    scale: float = 1.0


def fixed(name: str, shape: Shape, at: Sequence[float], turn: Rotation = STILL) -> Put:
    """Scenery with coefficients of 1, so that products are the bodies' own."""
    return Put(name, shape, at, turn, fixed=True, mu=1.0, e=1.0)


def floor() -> Put:
    return fixed("floor", analytic_shape("plane"), [0, 0, 0])


@dataclass(frozen=True)
class Ran:
    """A motion, turned back by the setting's yaw; metres and seconds."""

    at: Setting
    scene: Scene
    rollout: Rollout
    broke: str = ""

    @property
    def time(self) -> np.ndarray:
        return self.rollout.time

    @cached_property
    def _back(self) -> Rotation:
        return Rotation.from_euler("z", -self.at.yaw, degrees=True)

    def _of(self, name: str, values: np.ndarray) -> np.ndarray:
        return self._back.apply(values[:, self.rollout.names.index(name)])

    def place(self, name: str) -> np.ndarray:
        """[T+1, 3] in units of the size."""
        return self._of(name, self.rollout.position) / self.at.size

    def v(self, name: str) -> np.ndarray:
        """[T+1, 3] m/s as at 10 cm."""
        return self._of(name, self.rollout.velocity) / self.at.time

    def w(self, name: str) -> np.ndarray:
        """[T+1, 3] rad/s as at 10 cm."""
        return self._of(name, self.rollout.angular_velocity) * self.at.time

    def turn(self, name: str) -> Rotation:
        return self._back * Rotation.from_quat(self.rollout.orientation[:, self.rollout.names.index(name)])

    def turned(self, name: str) -> np.ndarray:
        """[T+1, 3] rad, the rotation since the start."""
        turn = self.turn(name)
        return (turn * turn[0].inv()).as_rotvec()

    def tilt(self, name: str) -> np.ndarray:
        """[T+1] degrees between what was up at the start, and up."""
        turn = self.turn(name)
        up = (turn * turn[0].inv()).apply([0.0, 0.0, 1.0])
        return np.degrees(np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2]))

    @property
    def seconds(self) -> np.ndarray:
        """[T+1] s as at 10 cm."""
        return self.time / self.at.time

    def when(self, seconds: float) -> int:
        """The frame at a time (as at 10 cm)."""
        return int(np.abs(self.seconds - seconds).argmin())

    @cached_property
    def verdict(self) -> Verdict:
        return judged(self.scene, self.rollout, every=-(-len(self.rollout) // JUDGED) or 1)

    def gap(self, one: str, other: str, frame: int) -> float:
        """Between the true surfaces of two bodies in a frame, in sizes; negative where they are in each other."""
        rows, at = (np.array([self.rollout.names.index(name)]) for name in (one, other)), np.array([frame])
        first, second = (placed(self.scene, self.rollout, at, row) for row in rows)
        found = gaps([solid_of(shape) for shape in self.scene.shapes], first, second, np.array([np.inf]))
        return float(found.apart[0]) / self.at.size

    def energy(self) -> np.ndarray:
        """[T+1] J."""
        kinetic, potential, _ = energies(self.scene, self.rollout)
        return (kinetic + potential).sum(1)


def run(
    at: Setting, bodies: Sequence[Put], seconds: float, *, gravity: float = G, tilt: float = 0.0, sleep: bool = False
) -> Ran:
    """Run a scene for `seconds` (as at 10 cm); gravity leans by `tilt` degrees to +x."""
    shapes: list[Shape] = []
    made, yaw = [], about("z", at.yaw)
    for put in bodies:
        index = next((k for k, shape in enumerate(shapes) if shape is put.shape), len(shapes))
        if index == len(shapes):
            shapes.append(put.shape)
        scale = put.scale * at.size
        motion = "static" if put.fixed else "dynamic"
        mass = 0.0 if put.fixed else DENSITY * put.shape.volume * scale**3
        made.append(
            Body(
                name=put.name,
                shape=index,
                motion=motion,
                scale=scale,
                position=yaw.apply(at.size * np.asarray(put.at, float)),
                quat_xyzw=(yaw * put.turn).as_quat(),
                velocity=yaw.apply(at.time * np.asarray(put.v, float)),
                angular_velocity=yaw.apply(np.asarray(put.w, float) / at.time),
                mass=mass,
                friction=put.mu,
                restitution=put.e,
            )
        )
    pull = yaw.apply(gravity * np.array([sin(radians(tilt)), 0.0, -cos(radians(tilt))]))
    scene = Scene(tuple(shapes), tuple(made), pull, 1.0, effects=Effects(sleep="on" if sleep else "off"))
    rollout, broke = at.by(scene, seconds * at.time)
    return Ran(at, scene, rollout, broke)


def laws(ran: Ran, name: str, *, deep: float = DEEP) -> Iterator[Check]:
    """Laws of every scene; bodies may overlap by a part `deep` of the smaller thickness."""
    verdict = ran.verdict
    yield most(f"{name}: overlap", 100 * verdict.overlap.part if verdict.overlap else 0.0, 100 * deep, "% of thickness")
    yield most(f"{name}: floating", 100 * verdict.floating.part if verdict.floating else 0.0, 0.0, "% of thickness")
    yield most(f"{name}: energy from nothing", 100 * verdict.energy.climb, 100 * MADE, "% of what is in play")
    if ran.broke:
        yield most(f"{name}: {ran.broke}", 1.0, 0.0)


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


# --- rows: each yields checks ---


def slender(at: Setting) -> Iterator[Check]:
    """Sticks that cross: their deepest overlap stays below a hundredth of the thinner one's width."""
    beam = solid(at.kind, "box", 10, 0.5, 0.5)
    top = Put("top", beam, [1, -0.3, 3.52], about("z", 90))
    ran = run(at, [fixed("beam", beam, [0, 0, 3]), top], 1.0)
    # Its centre lies 5 mm outside the edge of the beam: in 0.12 s it turns by 1/2 (m g .005 / (m / 12)) t^2 = 0.24
    # degrees, and its centre stays at the height of the faces, 3.5, to 0.02.
    yield near("one beam on another: height at 0.12 s", ran.place("top")[ran.when(0.12), 2], 3.5, 0.0, "sizes", 0.02)
    yield from laws(ran, "one beam on another")

    rng = np.random.default_rng(1)
    passed, worst, count = 0, 0.0, 200 if at.full else 10
    for _ in range(count):
        sticks = []
        for name in ("lower", "upper"):
            aspect = float(np.exp(rng.uniform(np.log(5), np.log(50 if at.kind == "analytic" else 20))))
            width = 10 / round(aspect)
            form = ("box", "cylinder", "capsule")[rng.integers(3)]
            dims = (10.0, width, width) if form == "box" else (width / 2, 10.0)
            sticks.append((name, solid(at.kind, form, *dims), STILL if form == "box" else about("y", 90), width))
        (_, lower, lay, w1), (_, upper, lie, w2) = sticks
        across = about("z", rng.uniform(30, 150))
        place = [*rng.uniform(-2, 2, 2), 3 + (w1 + w2) / 2 + 0.02 * min(w1, w2)]
        pair = [fixed("lower", lower, [0, 0, 3], lay), Put("upper", upper, place, across * lie)]
        ran = run(at, pair, 0.4)
        part = ran.verdict.overlap.part if ran.verdict.overlap else 0.0
        passed += part > DEEP
        worst = max(worst, part)
    yield most(f"{count} random crossings: in each other", passed, 0)
    yield most(f"{count} random crossings: worst overlap", 100 * worst, 100 * DEEP, "% of width")


def heaps(at: Setting) -> Iterator[Check]:
    """A heap of 24 sticks, a log cabin, a plank on rails, a pencil over the rim of a bowl."""
    rng = np.random.default_rng(2)
    stick = solid(at.kind, "box", 10, 0.5, 0.5)
    bodies = [
        Put(f"stick {k}", stick, [*rng.uniform(-2, 2, 2), 1 + 0.7 * k], about("z", rng.uniform(0, 180)))
        for k in range(24)
    ]
    ran = run(at, [*bodies, floor()], 6.0 if at.full else 3.0)
    yield from laws(ran, "heap of 24 sticks")

    log = solid(at.kind, "cylinder", 0.25, 6.0) if at.kind == "analytic" else solid(at.kind, "box", 6, 0.5, 0.5)
    lie = about("y", 90) if at.kind == "analytic" else STILL
    logs = []
    for k in range(16):
        layer, side = k // 2, 2 * (k % 2) - 1
        turn = about("z", 90) if layer % 2 else STILL
        place = turn.apply([0, 2.4 * side, 0]) + np.array([0, 0, 0.25 + 0.5 * layer])
        logs.append(Put(f"log {k}", log, place, turn * lie, mu=0.7))
    ran = run(at, [*logs, floor()], 2.0)
    moved = max(float(np.abs(ran.place(p.name)[-1] - p.at).max()) for p in logs)
    yield most("log cabin of 16: moved", moved, 0.05, "sizes")
    yield from laws(ran, "log cabin of 16")

    rail, plank = solid(at.kind, "box", 10, 0.3, 0.3), solid(at.kind, "box", 6, 2, 0.2)
    rails = [fixed(f"rail {k}", rail, [2 * k, 0.13, 0], about("z", 90)) for k in (-1, 1)]
    ran = run(at, [*rails, Put("plank", plank, [0.3, 0.2, 0.25])], 2.0)
    yield near("plank on rails: height", ran.place("plank")[-1, 2], 0.25, 0.0, "sizes", 0.002)
    yield most("plank on rails: speed", np.abs(ran.v("plank")[-1]).max(), 1e-3, "m/s")
    yield from laws(ran, "plank on rails")

    bowl = shape_from_primitive("bowl", 4.0, sdf="mesh" if at.kind == "mesh" else "grid", name="bowl")
    rim = float(bowl.mesh.vertices[:, 2].max())
    pencil = solid(at.kind, "cylinder", 0.1, 6.0)
    put = Put("pencil", pencil, [0.2, 0.6, rim + 0.101], about("y", 90))
    ran = run(at, [fixed("bowl", bowl, [0, 0, 0]), put], 1.0)
    yield near("pencil over a bowl: height", ran.place("pencil")[-1, 2], rim + 0.1, 0.0, "sizes", 0.01)
    yield from laws(ran, "pencil over a bowl")


def seams(at: Setting) -> Iterator[Check]:
    """Seams between flush tiles do not disturb a sliding body; only gravity acts at a step down."""
    forms = {
        "cube": (solid(at.kind, "box", 1, 1, 1), 0.5),
        "slab": (solid(at.kind, "box", 2, 2, 0.5), 0.25),
        "can": (solid(at.kind, "cylinder", 0.5, 1.0), 0.5),
    }
    tile, small = solid(at.kind, "box", 5, 10, 1), solid(at.kind, "box", 1, 10, 1)

    def tiles(gap: float = 0.0, down: float = 0.0) -> list[Put]:
        return [fixed("left", tile, [-2.5 - gap / 2, 0, -0.5]), fixed("right", tile, [2.5 + gap / 2, 0, -0.5 - down])]

    for name, (shape, height) in forms.items():
        for speed in (0.3, 2.0):
            seconds = 0.4 / speed if speed > 1 else 0.8
            ran = run(at, [*tiles(), Put("it", shape, [-1.2, 0.17, height], v=[speed, 0, 0], mu=0)], seconds)
            label = f"{name} at {speed:g} m/s without friction"
            yield near(f"{label}: speed", ran.v("it")[-1, 0], speed, 0.01, "m/s")
            yield most(f"{label}: tilt", ran.tilt("it").max(), 1.0, "degrees")
            yield from laws(ran, label)
        mu, speed = 0.5, 1.5
        ran = run(at, [*tiles(), Put("it", shape, [-1.2, 0.17, height], v=[speed, 0, 0], mu=mu)], 0.6)
        way, dt = speed**2 / (2 * mu * G) / UNIT, float(np.diff(ran.seconds).mean())
        label = f"{name} with friction"
        yield near(f"{label}: way", ran.place("it")[-1, 0] + 1.2, way, 0.03, "sizes", speed * dt / 2 / UNIT)
        yield from laws(ran, label)
        ran = run(at, [*tiles(), Put("it", shape, [0.2, 0.1, height])], 2.0)
        moved = np.abs(ran.place("it") - ran.place("it")[0])[:, :2].max()
        yield most(f"{name} at rest over a seam: moved", moved, 1e-3, "sizes")
        yield from laws(ran, f"{name} at rest over a seam")
    shape, height = forms["cube"]
    ran = run(at, [*tiles(gap=0.01), Put("it", shape, [-1.2, 0.17, height], v=[0.3, 0, 0], mu=0)], 0.8)
    yield near("cube over a gap of a hundredth: speed", ran.v("it")[-1, 0], 0.3, 0.01, "m/s")
    yield from laws(ran, "cube over a gap of a hundredth")
    ran = run(at, [*tiles(down=0.01), Put("it", shape, [-1.2, 0.17, height], v=[0.3, 0, 0], mu=0)], 0.8)
    # It may keep as speed what it falls, and tips a little in between; a wall would stop it.
    high = sqrt(0.3**2 + 2 * G * 0.01 * UNIT)
    yield Check("cube down a step of a hundredth: speed", float(ran.v("it")[-1, 0]), 0.3 * 0.97, high, "m/s")
    row = [fixed(f"tile {k}", small, [k, 0, -0.5]) for k in range(-4, 12)]
    ran = run(at, [*row, Put("it", shape, [-1.3, 0.17, height], about("z", 20), v=[1.0, 0, 0], mu=0)], 0.8)
    yield near("turned cube over eight seams: speed", ran.v("it")[-1, 0], 1.0, 0.01, "m/s")
    yield most("turned cube over eight seams: turned", np.degrees(np.abs(ran.turned("it"))).max(), 1.0, "degrees")


def thin_floors(at: Setting) -> Iterator[Check]:
    """A wide thin box carries as a plane does."""
    cube = solid(at.kind, "box", 1, 1, 1)
    sheets = {"1000 x 1000 x 1": (1000, 1000, 1), "10 x 10 x 0.02": (10, 10, 0.02)}
    for name, size in sheets.items():
        # No grid resolves a sheet of half a millimetre that is 10 m wide.
        sheet = solid("analytic" if at.kind == "grid" else at.kind, "box", *size)
        ground = fixed("ground", sheet, [0, 0, -size[2] / 2])
        deep = DEEP / size[2]  # a hundredth of the cube
        for place in ((0.0, 0.0), (0.3, 0.2)):
            ran = run(at, [ground, Put("cube", cube, [*place, 0.5])], 2.0)
            label = f"at rest on {name} at {place}"
            yield near(f"{label}: height", ran.place("cube")[-1, 2], 0.5, 0.01, "sizes")
            yield most(f"{label}: speed", np.abs(ran.v("cube")).max(), 0.01, "m/s")
            yield from laws(ran, label, deep=deep)
        ran = run(at, [ground, Put("cube", cube, [0.3, 0.2, 1.5], e=0.0)], 1.5)
        yield near(f"dropped on {name}: height", ran.place("cube")[-1, 2], 0.5, 0.01, "sizes")
        yield from laws(ran, f"dropped on {name}", deep=deep)
        ran = run(at, [ground, Put("cube", cube, [-2.0, 0.2, 0.5], v=[1.5, 0, 0], mu=0.5)], 1.0)
        way, dt = 1.5**2 / G / UNIT, float(np.diff(ran.seconds).mean())
        yield near(f"sliding on {name}: way", ran.place("cube")[-1, 0] + 2, way, 0.01, "sizes", 1.5 * dt / 2 / UNIT)


def rolling(at: Setting) -> Iterator[Check]:
    """Round bodies keep rolling, and go down a slope with g sin a / (1 + k^2): a cylinder has k^2 = 1/2, a tube
    (1 + (inner / outer)^2) / 2."""
    lie = about("x", 90)
    tube_k = (1 + (0.45 / 0.5) ** 2) / 2
    forms = {
        "can": (solid(at.kind, "cylinder", 0.5, 1.0), 0.5, 0.5),
        "disc": (solid(at.kind, "cylinder", 0.5, 0.1), 0.5, 0.5),
        "rod": (solid(at.kind, "cylinder", 0.1, 3.0), 0.1, 0.5),
    }
    if at.kind != "analytic":
        forms["hoop"] = (of_mesh(at.kind, "tube", 0.5, 0.45, 0.4), 0.5, tube_k)
    grounds = {"plane": floor()}
    if at.full or at.kind != "analytic":
        grounds["box"] = fixed("box", solid("analytic", "box", 200, 20, 1), [80, 0, -0.5])
    seconds = 10.0 if at.full else 4.0
    for name, (shape, radius, k2) in forms.items():
        for under, ground in grounds.items():
            for speed in (0.01, 0.1, 1.0, 3.0):
                put = Put("it", shape, [0, 0, radius], lie, v=[speed, 0, 0], w=[0, speed / (radius * UNIT), 0], mu=1.0)
                ran = run(at, [put, ground], seconds if speed < 2 else 2.0)
                label = f"{name} at {speed:g} m/s on a {under}"
                last = hypot(*ran.v("it")[-1, :2]) / speed
                # A facet may stop it from rolling, or make it lose; what stands on an edge falls on a facet, and
                # nothing else may make it faster.
                low = 99.0 if at.kind == "analytic" else -inf
                fall = 0.0 if at.kind == "analytic" else 2 * G * radius * UNIT * (1 - cos(pi / FACETS)) / (1 + k2)
                yield Check(f"{label}: speed", 100 * last, low, 100.1 * sqrt(1 + fall / speed**2), "%")
                yield from laws(ran, label)
        for slope in (0.1, 0.5, 5.0, 10.0):
            if at.kind != "analytic" and slope < 5:
                continue
            ran = run(at, [Put("it", shape, [0, 0, radius], lie, mu=1.0), floor()], 2.0, tilt=slope)
            wanted = 0.5 * G * sin(radians(slope)) / (1 + k2) * ran.seconds[-1] ** 2 / UNIT
            least = 0.98 * wanted
            if at.kind != "analytic":
                # Less one facet: it may stand on one at first.
                rolled = _over_facets(slope, radius * UNIT, k2, ran.seconds[-1]) / UNIT
                least = 0.98 * rolled - 2 * radius * sin(pi / FACETS)
            way = ran.place("it")[-1, 0]
            yield Check(f"{name} down {slope:g} degrees: way", way, least, 1.02 * wanted, "sizes")
            yield from laws(ran, f"{name} down {slope:g} degrees")


def _over_facets(slope: float, radius: float, k2: float, seconds: float) -> float:
    """m that a polygon of `FACETS` corners rolls down a slope from rest if each facet that hits is dead: about the
    corner that hits next its angular momentum is what it was."""
    turn, side = 2 * pi / FACETS, 2 * radius * sin(pi / FACETS)
    kept, pull = (k2 + cos(turn)) / (k2 + 1), G * sin(radians(slope)) / (1 + k2)
    way = speed = 0.0
    while seconds > 0:
        faster = sqrt(speed**2 + 2 * pull * side)
        seconds -= 2 * side / (speed + faster)
        way, speed = way + side, kept * faster
    return way


def facets(at: Setting) -> Iterator[Check]:
    """Faceted cylinders and icospheres never gain, lose no more than a polygon with dead impacts, and rest on slopes
    below half the angle of a facet."""
    kind = "mesh" if at.kind == "analytic" else at.kind
    for count in (16, 32):
        can = of_mesh(kind, "cylinder", 0.5, 1.0, count)
        # Turned so that it stands on a facet: its centre is at the apothem's height.
        low = 0.5 * cos(pi / count)
        lie = about("x", 90) * about("z", 180 / count)
        speed = 1.0
        put = Put("can", can, [0, 0, low], lie, v=[speed, 0, 0], w=[0, speed / (0.5 * UNIT), 0], mu=1.0)
        ran = run(at, [put, floor()], 1.0)
        kinetic = ran.energy() - ran.energy()[0]
        first = energies(ran.scene, ran.rollout)[0].sum(1)[0]
        turned = abs(ran.place("can")[-1, 0]) / (2 * pi * 0.5) * count
        # A polygon of k^2 = 1/2 whose facets hit dead keeps (1/2 + cos(2 pi / N)) / (3/2) of its speed at each: about
        # the corner that hits next its angular momentum is what it was.
        dead = 1 - (1 - 2 / 3 * (1 - cos(2 * pi / count))) ** (2 * turned + 4)
        rise = 9.81 * (0.5 - low) * UNIT / (0.75 * speed**2)
        yield Check(
            f"{count} facets at 1 m/s: energy lost", -100 * kinetic[-1] / first, -0.1, 100 * (dead + rise), "% of start"
        )
        yield from laws(ran, f"{count} facets at 1 m/s")
        slope = 0.5 * 180 / count
        ran = run(at, [Put("can", can, [0, 0, low], lie, mu=1.0), floor()], 2.0, tilt=slope)
        moved = np.abs(ran.place("can")[-1] - ran.place("can")[0]).max()
        yield most(f"{count} facets on {slope:.3g} degrees: moved", moved, 0.01, "sizes")
    ball = of_mesh(kind, "ball", 0.5, 2)
    put = Put("ball", ball, [0, 0, 0.5], v=[1, 0, 0], w=[0, 1 / (0.5 * UNIT), 0], mu=1.0)
    ran = run(at, [put, floor()], 2.0)
    gained = energies(ran.scene, ran.rollout)[0].sum(1)
    yield most("icosphere at 1 m/s: energy", 100 * gained[-1] / gained[0], 100.1, "% of start")
    yield from laws(ran, "icosphere at 1 m/s")


def round_on_meshes(at: Setting) -> Iterator[Check]:
    """Balls and capsules on meshes: at rest the gap is below 0.2 % of the smaller body, and nothing pushes before."""
    kind = "mesh" if at.kind == "analytic" else at.kind
    unders = {
        "slab": (of_mesh(kind, "box", 8, 8, 0.4), 0.2),
        "cube": (of_mesh(kind, "box", 2, 2, 2), 1.0),
        "icosphere": (of_mesh(kind, "ball", 1.0, 4), 1.0),
    }
    for name, (shape, top) in unders.items():
        for radius in (0.05, 0.25, 1.0, 2.0):
            ball = solid("analytic", "ball", radius)
            # From the top of the icosphere a small ball rolls off, along its surface.
            low = top if name != "icosphere" else float(shape.mesh.vertices[:, 2].max())
            ran = run(
                at, [fixed("under", shape, [0, 0, 0]), Put("ball", ball, [0, 0, low + 1.02 * radius], mu=1.0)], 0.5
            )
            gap = ran.gap("under", "ball", ran.when(0.4))
            label = f"ball of radius {radius:g} on a {name}"
            smaller = min(2 * radius, {"slab": 0.4, "cube": 2.0, "icosphere": 2.0}[name])
            yield Check(f"{label}: gap", 100 * gap / smaller, -1.0, 0.2, "% of the smaller body")
            yield from laws(ran, label)
    capsule = solid("analytic", "capsule", 0.3, 2.0)
    ran = run(
        at, [fixed("under", unders["slab"][0], [0, 0, 0]), Put("it", capsule, [0.3, 0.2, 0.51], about("y", 90))], 0.5
    )
    gap = ran.gap("under", "it", -1)
    yield Check("capsule on a slab: gap", 100 * gap / 0.4, -1.0, 0.2, "% of the smaller body")
    yield from laws(ran, "capsule on a slab")
    # A groove of two boxes at right angles, open upwards: a ball of radius r touches both when its centre is r sqrt 2
    # above the edge where their faces meet.
    wall = of_mesh(kind, "box", 4, 4, 4)
    walls = []
    for side in (-1, 1):
        walls.append(fixed(f"wall {side}", wall, [side * 2 * sqrt(2), 0, 0], about("y", 45)))
    radius = 0.5
    ran = run(at, [*walls, Put("ball", solid("analytic", "ball", radius), [0, 0.1, radius * sqrt(2) + 0.02])], 0.6)
    gap = max(ran.gap(f"wall {side}", "ball", -1) for side in (-1, 1))
    yield Check("ball in a groove: gap", 100 * gap / (2 * radius), -1.0, 0.2, "% of the smaller body")
    yield from laws(ran, "ball in a groove")


def flat_drops(at: Setting) -> Iterator[Check]:
    """Bodies that are dropped flat land flat."""
    forms = {"brick": (2, 1.5, 0.3), "plate": (3, 3, 0.1), "cube": (1, 1, 1)}
    grounds = {
        "plane": floor(),
        "box": fixed("box", solid("analytic", "box", 10, 10, 1), [0, 0, -0.5]),
        "mesh": fixed("mesh", of_mesh("mesh", "box", 10, 10, 1), [0, 0, -0.5]),
    }
    if not at.full:
        grounds = {k: grounds[k] for k in (("plane", "box") if at.kind == "analytic" else ("plane", "mesh"))}
    for name, size in forms.items():
        shape = solid(at.kind, "box", *size)
        for under, ground in grounds.items():
            for e in (0.0, 0.3, 0.6):
                ran = run(at, [Put("it", shape, [0.13, 0.07, 1 + size[2] / 2], e=e), ground], 1.0)
                label = f"{name} dropped on a {under}, e = {e:g}"
                yield most(f"{label}: tilt", ran.tilt("it").max(), 0.1, "degrees")
                yield most(f"{label}: spin", np.abs(ran.w("it")).max(), 0.05, "rad/s")
                aside = np.abs(ran.place("it") - ran.place("it")[0])[:, :2].max()
                yield most(f"{label}: aside", aside, 0.005, "sizes")
                yield from laws(ran, label)


def slabs(at: Setting) -> Iterator[Check]:
    """A sliding slab does not turn: the centre of pressure lies ahead, on the line of motion."""
    forms = {"2:1:0.3": (2, 1, 0.3), "1:1:0.1": (1, 1, 0.1), "4:1:0.2": (4, 1, 0.2)}
    grounds = {"plane": floor(), "box": fixed("box", solid(at.kind, "box", 40, 20, 1), [10, 0, -0.5])}
    for name, size in forms.items():
        shape = solid(at.kind, "box", *size)
        for under, ground in grounds.items():
            for yaw in (0, 20, 45):
                ran = run(at, [Put("it", shape, [0, 0, size[2] / 2], about("z", yaw), v=[2, 0, 0], mu=0.3), ground], 1)
                way, dt = 2**2 / (2 * 0.3 * G) / UNIT, float(np.diff(ran.seconds).mean())
                label = f"slab {name}, yaw {yaw}, on a {under}"
                yield most(f"{label}: turned", np.degrees(np.abs(ran.turned("it"))).max(), 1.0, "degrees")
                yield near(f"{label}: way", ran.place("it")[-1, 0], way, 0.02, "sizes", 2 * dt / 2 / UNIT)
                yield from laws(ran, label)


def spins(at: Setting) -> Iterator[Check]:
    """Spin about the vertical stops after w I / (mu m g R), where all that touches is R from the axis; on filled faces
    between even pressure (2/3 R of a disc, 0.3826 a of a square of side a, L/4 of a thin bar) and all at the rim."""
    kind = "mesh" if at.kind == "analytic" else at.kind
    mu, w = 0.3, 10.0
    length = LEG[2]

    def stop(shape: Shape, height: float) -> tuple[float, Ran]:
        inertia, mass = shape.inertia[2, 2], shape.volume
        ran = run(at, [Put("it", shape, [0, 0, height], w=[0, 0, w], mu=mu), floor()], 2.5)
        spin = np.abs(ran.w("it")[:, 2])
        over = np.flatnonzero(spin < 0.02 * w)
        at_s = inf
        if len(over):  # between two frames as a line between their spins has it
            k = int(over[0])
            share = (spin[k - 1] - 0.02 * w) / (spin[k - 1] - spin[k])
            at_s = float(ran.seconds[k - 1] + share * (ran.seconds[k] - ran.seconds[k - 1]))
        # The arm R that makes this time: w I UNIT^2 / (mu m g t).
        return w * 0.98 * inertia / mass * UNIT**2 / (mu * G * at_s) / UNIT, ran

    # A leg's foot is a square of 0.08: its four corners and its middle are 0.371 to 0.452 from the axis, 0.41 +- 0.013
    # on average under even pressure.
    for legs in (3, 4):
        arm, ran = stop(of_mesh(kind, "stool", legs), length)
        yield Check(f"stool of {legs} legs: arm", arm, 0.41 * 0.94, 0.41 * 1.06, "sizes")
        yield from laws(ran, f"stool of {legs} legs")
    tube = of_mesh(kind, "tube", 0.5, 0.46, 0.5)
    arm, ran = stop(tube, 0.25)
    yield Check("tube: arm", arm, 0.48 * 0.95, 0.48 * 1.05, "sizes")
    yield from laws(ran, "tube")
    ring = of_mesh(kind, "torus", 0.5, 0.1)
    arm, ran = stop(ring, 0.1)
    yield near("ring: arm", arm, 0.5, 0.05, "sizes")
    yield from laws(ran, "ring")
    filled = {
        "disc": (solid(at.kind, "cylinder", 0.5, 0.3), 0.15, 2 / 3 * 0.5, 0.5),
        "square": (solid(at.kind, "box", 1, 1, 0.3), 0.15, 0.3826, sqrt(0.5)),
        "bar": (solid(at.kind, "box", 2, 0.1, 0.1), 0.05, 0.5, 1.0),
    }
    for name, (shape, height, even, rim) in filled.items():
        arm, ran = stop(shape, height)
        yield Check(f"{name}: arm", arm, 0.98 * even, 1.02 * rim, "sizes")
        yield from laws(ran, name)


def gentle(at: Setting) -> Iterator[Check]:
    """Sleep on changes nothing before forces balance: gentle slopes, turning points."""
    ball, cube = solid(at.kind, "ball", 0.5), solid(at.kind, "box", 1, 1, 1)
    if at.kind == "analytic":
        for slope in (0.05, 0.1, 0.5):
            ran = run(at, [Put("ball", ball, [0, 0, 0.5], mu=1.0), floor()], 3.0, tilt=slope, sleep=True)
            wanted = 0.5 * 5 / 7 * G * sin(radians(slope)) * ran.seconds[-1] ** 2 / UNIT
            yield near(f"ball down {slope:g} degrees: way", ran.place("ball")[-1, 0], wanted, 0.02, "sizes")
        for slope in (0.1, 0.3):
            a = 5 / 7 * G * sin(radians(slope))
            speed = 0.5 * a * 1.5  # turns after 0.75 s, and is back after 1.5 s
            put = Put("ball", ball, [0, 0, 0.5], v=[-speed, 0, 0], w=[0, -speed / (0.5 * UNIT), 0], mu=1.0)
            ran = run(at, [put, floor()], 3.0, tilt=slope, sleep=True)
            t = ran.seconds[-1]
            wanted = (-speed * t + 0.5 * a * t * t) / UNIT
            yield near(f"ball up {slope:g} degrees and back: way", ran.place("ball")[-1, 0], wanted, 0.02, "sizes")
    for slope in (0.05, 0.2, 0.5):
        ran = run(at, [Put("cube", cube, [0, 0, 0.5], mu=0.0), floor()], 3.0, tilt=slope, sleep=True)
        wanted = 0.5 * G * sin(radians(slope)) * ran.seconds[-1] ** 2 / UNIT
        way = ran.place("cube")[-1, 0]
        yield near(f"cube without friction down {slope:g} degrees: way", way, wanted, 0.02, "sizes")
    ran = run(at, [Put("cube", cube, [0, 0, 0.5], mu=0.5), floor()], 4.0, tilt=10.0, sleep=True)
    moved = np.abs(ran.place("cube")[-1] - ran.place("cube")[0]).max()
    yield most("cube that friction holds: moved", moved, 1e-3, "sizes")


def edges(at: Setting) -> Iterator[Check]:
    """Cubes edge on edge, and edge on face: where they first touch. Each edge is sqrt(1/2) from its cube's centre."""
    cube = solid(at.kind, "box", 1, 1, 1)
    lower = about("y", 45)
    for place in ((0.0, 0.0), (0.125, 0.0), (0.125, -0.125), (0.31, 0.22)):
        upper = about("x", 45)
        # The lower edge runs along y, the upper along x; they cross at (0, y) and (x, 0).
        put = Put("upper", cube, [*place, 2 * sqrt(0.5) + 0.002], upper)
        # Soon after they touch, 6 ms after the start. An edge off the middle then topples the cube about the place
        # where they cross, r aside of and sqrt(1/2) below its centre, which keeps r^2 / (r^2 + 1/2 + 1/6) of its fall.
        ran = run(at, [fixed("lower", cube, [0, 0, 0], lower), put], 0.03)
        k = ran.when(0.02)
        since = ran.seconds[k] - sqrt(2 * 0.002 * UNIT / G)
        kept = place[0] ** 2 / (place[0] ** 2 + 1 / 2 + 1 / 6)
        sunk = kept * (sqrt(2 * G * 0.002 * UNIT) * since + 0.5 * G * since**2) / UNIT
        yield near(f"edge on edge at {place}: height", ran.place("upper")[k, 2], sqrt(2) - sunk, 0.0, "sizes", 0.002)
        yield from laws(ran, f"edge on edge at {place}")
    ran = run(at, [floor(), Put("upper", cube, [0, 0, sqrt(0.5) + 0.002], about("x", 45))], 0.06)
    yield near("edge on a plane: height", ran.place("upper")[ran.when(0.05), 2], sqrt(0.5), 0.0, "sizes", 0.002)
    slab = solid(at.kind, "box", 3, 3, 0.5)
    put = Put("upper", cube, [0.2, 0.1, sqrt(0.5) + 0.002], about("x", 45))
    ran = run(at, [fixed("slab", slab, [0, 0, -0.25]), put], 0.06)
    yield near("edge on a face: height", ran.place("upper")[ran.when(0.05), 2], sqrt(0.5), 0.0, "sizes", 0.002)
    yield from laws(ran, "edge on a face")


def elastic(at: Setting) -> Iterator[Check]:
    """Frictionless hits with e = 1 keep energy, momentum and angular momentum."""
    rng = np.random.default_rng(3)
    forms = {"cube": (1, 1, 1), "stick": (3, 0.3, 0.3), "plate": (2, 2, 0.2), "brick": (2, 1, 0.5)}
    shapes = [solid(at.kind, "box", *size) for size in forms.values()]
    count = 300 if at.full else 24
    change, push, turn = [], [], []
    for _ in range(count):
        two = [shapes[rng.integers(len(shapes))] for _ in range(2)]
        turns = Rotation.random(2, rng=rng)
        spins = rng.uniform(-5, 5, (2, 3))
        aside = rng.uniform(-0.5, 0.5, 2)
        bodies = [
            Put("a", two[0], [-1.9, 0, 0], turns[0], v=[1, 0, 0], w=spins[0], mu=0, e=1),
            Put("b", two[1], [1.9, *aside], turns[1], v=[-1, 0, 0], w=spins[1], mu=0, e=1),
        ]
        ran = run(at, bodies, 0.5, gravity=0.0)
        energy = ran.energy()
        momentum, angular = _momenta(ran)
        if np.abs(ran.v("a")[-1] - ran.v("a")[0]).max() < 1e-6:
            continue  # they missed
        change.append(energy[-1] / energy[0] - 1)
        push.append(np.abs(momentum[-1] - momentum[0]).max())
        turn.append(np.abs(angular[-1] - angular[0]).max())
    label = f"{count} throws"
    yield Check(f"{label}: hits", len(change), count / 4, count)
    missed = [inf]  # where no throw hits, nothing is known
    yield Check(f"{label}: energy on average", 100 * float(np.mean(change or missed)), -0.1, 0.1, "%")
    yield most(f"{label}: energy at worst", 100 * float(np.abs(change or missed).max()), 2.0, "%")
    yield most(f"{label}: momentum", max(push or missed), 1e-9)
    yield most(f"{label}: angular momentum", max(turn or missed), 1e-6)
    if at.full:
        wall = solid("analytic", "box", 20, 20, 2)
        walls = []
        for axis in range(3):
            for side in (-1, 1):
                place = [0.0, 0.0, 0.0]
                place[axis] = 7.0 * side
                lean = (about("y", 90), about("x", 90), STILL)[axis]
                walls.append(fixed(f"wall {axis} {side}", wall, place, lean))
        grid = [(x, y, z) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-4.5, -1.5, 1.5, 4.5) for z in (-4, 0, 4)]
        gas = [
            Put(f"box {k}", shapes[0], place, Rotation.random(rng=rng), v=rng.uniform(-1, 1, 3), mu=0, e=1)
            for k, place in enumerate(grid)
        ]
        ran = run(at, [*gas, *walls], 10.0, gravity=0.0)
        energy = ran.energy()
        yield near("48 boxes in a closed box for 10 s: energy", 100 * energy[-1] / energy[0], 100.0, 0.05, "% of start")
        inside = max(float(np.abs(ran.place(p.name)).max()) for p in gas)
        yield most("48 boxes in a closed box: farthest centre", inside, 6.0, "sizes")


def _momenta(ran: Ran) -> tuple[np.ndarray, np.ndarray]:
    """[T+1, 3] momentum and angular momentum about the origin, as parts of what the two bodies had at the start
    without regard to directions."""
    push, turn = np.zeros((len(ran.time), 3)), np.zeros((len(ran.time), 3))
    had, had_turn = 0.0, 0.0
    for k, body in enumerate(ran.scene.bodies):
        shape, r = ran.scene.shapes[body.shape], ran.rollout
        inertia = shape.inertia * (body.mass / shape.volume * body.scale**2)
        axes = Rotation.from_quat(r.orientation[:, k])
        spin = axes.apply(axes.inv().apply(r.angular_velocity[:, k]) @ inertia)
        p = body.mass * r.velocity[:, k]
        arm = np.cross(r.position[:, k], p)
        push, turn = push + p, turn + spin + arm
        had += float(np.linalg.norm(p[0]))
        had_turn += float(np.linalg.norm(spin[0]) + np.linalg.norm(arm[0]))
    return push / had, turn / had_turn


def bullets(at: Setting) -> Iterator[Check]:
    """Small turned cubes against a plate of a sixth of their size: none passes."""
    rng = np.random.default_rng(4)
    cube = solid(at.kind, "box", 0.12, 0.12, 0.12)
    plate = solid("mesh" if at.kind == "grid" else at.kind, "box", 6, 6, 0.02)
    for speed in (20.0, 50.0, 200.0):
        for name, tilt in (("level", STILL), ("tilted", about("x", 20) * about("y", 10))):
            count = 36 if at.full else 12
            fly = []
            for k in range(count):
                place = [0.8 * (k % 6 - 2.5), 0.8 * (k // 6 - 0.5), 2.5]
                fly.append(Put(f"it {k}", cube, place, Rotation.random(rng=rng), v=[0, 0, -speed], e=0.3))
            ran = run(at, [fixed("plate", plate, [0, 0, 0], tilt), *fly], 0.5 / speed * 2)
            normal = tilt.apply([0.0, 0.0, 1.0])
            through = sum(bool((ran.place(p.name)[-1] @ normal) < -0.01) for p in fly)
            yield most(f"cubes at {speed:g} m/s on a {name} plate: passed of {count}", through, 0)


def before_touch(at: Setting) -> Iterator[Check]:
    """Nothing is pushed before it touches."""
    kind = "mesh" if at.kind == "analytic" else at.kind
    small, large = of_mesh(kind, "ball", 1.0, 4), solid("analytic", "ball", 2.1)
    bodies = [fixed("small", small, [0, 0, 0]), Put("large", large, [-3.6, 0, 0], v=[0.2, 0, 0], mu=0.0)]
    ran = run(at, bodies, 0.6, gravity=0.0)
    # A frictionless ball without restitution stops when it hits a fixed one centrally. The nearest corner of the mesh
    # is up to 0.05 rad aside, which leaves 0.01 m/s, and as much again at the next corner.
    yield most("ball on a mesh ball: speed after", float(np.linalg.norm(ran.v("large")[-1])), 0.015, "m/s")
    yield from laws(ran, "ball on a mesh ball")
    ring = of_mesh(kind, "torus", 0.5, 0.1)  # a hole of radius 0.4
    rod = solid("analytic", "capsule", 0.32, 20.0)
    ran = run(at, [fixed("rod", rod, [0, 0, 0]), Put("ring", ring, [0, 0, 5.0])], 0.2)
    wanted = 0.5 * G * ran.seconds[-1] ** 2 / UNIT
    yield near("ring around a rod with clearance: fall", 5.0 - ran.place("ring")[-1, 2], wanted, 0.01, "sizes")
    yield from laws(ran, "ring around a rod with clearance")


ROWS: dict[str, Callable[[Setting], Iterator[Check]]] = {
    row.__name__: row
    for row in (
        slender, heaps, seams, thin_floors, rolling, facets, round_on_meshes, flat_drops, slabs, spins, gentle, edges,
        elastic, bullets, before_touch,
    )
}  # fmt: skip


def checks(row: str, at: Setting) -> Iterator[tuple[str, Check]]:
    """Every check of a row with its full name, as lists have it."""
    for check in ROWS[row](at):
        yield f"{row}: {check.name} [{at}]", check


def failures(row: str, settings: Sequence[Setting]) -> dict[str, float]:
    """How many checks of a row do not hold, and how many there are."""
    found = [check for at in settings for _, check in checks(row, at)]
    return {"fail": float(sum(not check.holds for check in found)), "checks": float(len(found))}


def changed(found: Sequence[tuple[str, Check]], listed: Sequence[str]) -> list[str]:
    """The clear differences between checks that were run and the listed names of checks that hold, a line each."""
    lines = []
    for name, check in found:
        if check.close or check.holds == (name in listed):
            continue
        lines.append(
            f"{'holds, and is not listed' if check.holds else 'is listed, and does not hold'}: {name}: {check}"
        )
    settings = {name.split(":")[0] + name[name.rindex(" [") :] for name, _ in found}
    ran = {name for name, _ in found}
    mine = (name for name in listed if name.split(":")[0] + name[name.rindex(" [") :] in settings)
    return lines + [f"is listed, and there is no such check: {name}" for name in mine if name not in ran]


def update(file: Path, found: Sequence[tuple[str, Check]]) -> None:
    """Update the list of checks that hold with those that were run; others stay."""
    listed = set(file.read_text(encoding="utf-8").splitlines()) if file.exists() else set()
    settings = {name.split(":")[0] + name[name.rindex(" [") :] for name, _ in found}
    listed = {name for name in listed if name.split(":")[0] + name[name.rindex(" [") :] not in settings}
    write_text(file, "\n".join(sorted(listed | {name for name, check in found if check.holds})) + "\n")


def main(arguments: Iterable[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sdfsim.evaluation.everyday", description=__doc__)
    parser.add_argument("row", nargs="*", help=f"of {', '.join(ROWS)}; none for all")
    parser.add_argument("--size", type=float, nargs="*", default=[0.1])
    parser.add_argument("--yaw", type=float, nargs="*", default=[0.0])
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=["analytic"])
    parser.add_argument("--full", action="store_true", help="all random scenes and long runs")
    parser.add_argument("--failed", action="store_true", help="print what does not hold only")
    parser.add_argument("--update", type=Path, metavar="FILE", help="the list of what holds, to be brought up to date")
    given = parser.parse_args(None if arguments is None else list(arguments))
    held = total = 0
    for row in given.row or ROWS:
        for size in given.size:
            for yaw in given.yaw:
                for kind in given.kind:
                    at = replace(Setting(), size=size, yaw=yaw, kind=kind, full=given.full)
                    print(f"--- {row} [{at}]", flush=True)
                    found = []
                    for name, check in checks(row, at):
                        found.append((name, check))
                        held, total = held + check.holds, total + 1
                        if not (given.failed and check.holds):
                            print(check, flush=True)
                    if given.update:
                        update(given.update, found)
    print(f"{held} of {total} hold")
    return 0 if held == total else 1


if __name__ == "__main__":
    raise SystemExit(main())
