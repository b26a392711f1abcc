"""Scenes of bodies in units of their size, what is measured on their motions, and checks: in what range it should be.

Lengths are in units of the size, times and speeds as at 10 cm (they scale by Froude's law). Everything is judged by
closed forms and by `sdfsim.evaluation.instruments`, never by values of the contact solve.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from math import cos, inf, pi, radians, sin, sqrt
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.evaluation import engines
from sdfsim.evaluation.engines import Runner, by_model
from sdfsim.evaluation.instruments import DEEP, MADE, Verdict, energies, judged, placed, solid_of
from sdfsim.evaluation.true_surfaces import gaps
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Body, Effects, Scene
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.shape.shape import Shape

G = 9.81  # m/s^2
UNIT = 0.1  # m, the size at which times and speeds are as written
SIZES = (0.02, 0.1, 1.0)  # m
KINDS = ("analytic", "mesh", "grid")
DENSITY = 500.0  # kg/m^3
JUDGED = 60  # frames of a run, evenly spaced, in which surfaces are measured
FACETS = 48  # number of facets of round meshes, by default
STILL = Rotation.identity()


@dataclass(frozen=True)
class Check:
    """A measured number, and the range in which it should be."""

    name: str
    measured: float
    low: float = -inf
    high: float = inf
    unit: str = ""
    digits: int = 2  # decimals shown in reports; smaller differences do not count
    better: int = -1  # -1: lower is better, 1: higher is better, 0: it only informs, such as the height of a rebound
    worst: bool = False  # the largest of several repetitions counts, not the mean

    @property
    def holds(self) -> bool:
        return bool(self.low <= self.measured <= self.high)

    @property
    def wanted(self) -> str:
        if self.low == -inf:
            return "" if self.high == inf else f"at most {self.high:.6g}"
        return f"at least {self.low:.6g}" if self.high == inf else f"{self.low:.6g} to {self.high:.6g}"

    def __str__(self) -> str:
        wanted = f" (wanted {self.wanted})" if self.wanted else ""
        return f"{'ok  ' if self.holds else 'FAIL'} {self.name}: {self.measured:.6g} {self.unit}{wanted}"


def near(name: str, measured: float, wanted: float, part: float, unit: str = "", slack: float = 0.0) -> Check:
    """A check within a `part` of the wanted value, plus `slack`."""
    off = abs(wanted) * part + slack
    return Check(name, float(measured), wanted - off, wanted + off, unit)


def most(name: str, measured: float, limit: float, unit: str = "") -> Check:
    return Check(name, float(measured), high=limit, unit=unit)


@dataclass(frozen=True)
class Setting:
    """How a row is run, and with which model or engine."""

    size: float = 0.1  # m
    yaw: float = 0.0  # degrees
    kind: str = "analytic"
    full: bool = False  # all random scenes and long runs
    by: Runner = by_model
    repeat: int = 0  # number of the repetition; 0 is the exact scene

    @property
    def time(self) -> float:
        """The factor on times."""
        return sqrt(self.size / UNIT)

    def box(self, x: float, y: float, z: float) -> Shape:
        return solid(self.kind, "box", x, y, z)

    def ball(self, radius: float) -> Shape:
        return solid(self.kind, "ball", radius)

    def cylinder(self, radius: float, height: float) -> Shape:
        return solid(self.kind, "cylinder", radius, height)

    def mesh(self, form: str, *dims: float) -> Shape:
        """A solid with facets: a mesh, or a grid of it."""
        return solid("mesh" if self.kind == "analytic" else self.kind, form, *dims)

    def __str__(self) -> str:
        return f"{self.size:g} m, {self.yaw:g} degrees, {self.kind}"


@dataclass(frozen=True)
class Law:
    """A row of the table: scenes of one kind, with checks on their motions."""

    name: str  # valid for a file
    group: str
    title: str
    checks: Callable[[Setting], Iterator[Check]]
    repeats: int = 1  # repetitions, with slightly different starts or other random scenes: their spread is the noise
    engines: bool = True  # whether engines can take part in `stress`
    x: float | None = None  # its x in the group's plot of the first check; None if it is not plotted
    counted: bool = False  # reports give the number of its checks that do not hold, not each of them


# --- solids, of unit size ---


@cache
def solid(kind: str, form: str, *dims: float) -> Shape:
    """A box (x, y, z), ball (radius), cylinder or capsule (radius, height) of a kind.

    As a mesh also a cylinder with a number of facets, a ball with a number of subdivisions, a tube (outer and inner
    radius, height), a torus (major, minor radius) and a stool (legs).
    """
    if kind != "analytic":
        return mesh_shape(_mesh(form, *dims), name=form, kind="grid" if kind == "grid" else "mesh")
    if form == "box":
        return analytic_shape("box", size=dims)
    if form == "ball":
        return analytic_shape("sphere", radius=dims[0])
    return analytic_shape("cylinder" if form == "cylinder" else "capsule", radius=dims[0], height=dims[1])


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
        return primitives.tube(dims[0], dims[1], dims[2], 96)
    assert form == "stool"
    return _stool(int(dims[0]))


LEG = (0.45, 0.04, 0.5)  # of a stool: distance of the legs from the axis, half their width, and their length


def _stool(legs: int) -> Mesh:
    """A round seat on thin legs at the distance `LEG`[0] from the axis."""
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
    at: Sequence[float] | np.ndarray
    turn: Rotation = STILL
    v: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)  # m/s
    w: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)  # rad/s
    mu: float = 0.5
    e: float = 0.0
    fixed: bool = False
    scale: float = 1.0
    dense: float = 1.0  # relative to `DENSITY`


def fixed(name: str, shape: Shape, at: Sequence[float] | np.ndarray, turn: Rotation = STILL) -> Put:
    """A static body with coefficients of 1, so that products are the other bodies' own."""
    return Put(name, shape, at, turn, fixed=True, mu=1.0, e=1.0)


def floor() -> Put:
    return fixed("floor", analytic_shape("plane"), [0, 0, 0])


@dataclass(frozen=True)
class Ran(engines.Ran):
    """A motion, turned back by the setting's yaw, and checks on it."""

    at: Setting = Setting()
    label: str = ""  # label of the scene

    def near(self, what: str, *numbers: Any) -> Check:
        return near(f"{self.label}: {what}", *numbers)

    def most(self, what: str, *numbers: Any) -> Check:
        return most(f"{self.label}: {what}", *numbers)

    def between(self, what: str, measured: float, low: float, high: float, unit: str) -> Check:
        return Check(f"{self.label}: {what}", float(measured), low, high, unit)

    def slid(self, name: str, put: Put, part: float) -> Check:
        """The distance that a body slides until it stops, to within half of its motion in the first step."""
        way, dt = put.v[0] ** 2 / (2 * put.mu * G) / UNIT, float(np.diff(self.seconds).mean())
        return self.near("way", self.moved(name)[-1, 0], way, part, "sizes", put.v[0] * dt / 2 / UNIT)

    def laws(self, deep: float = DEEP) -> Iterator[Check]:
        """Laws that hold for every scene; bodies may overlap by a part `deep` of the smaller thickness."""
        verdict = self.verdict
        overlap, floating = (100 * found.part if found else 0.0 for found in (verdict.overlap, verdict.floating))
        yield self.most("overlap", overlap, 100 * deep, "% of thickness")
        yield self.most("floating", floating, 0.0, "% of thickness")
        yield self.most("energy from nothing", 100 * verdict.energy.climb, 100 * MADE, "% of what is in play")
        if self.broke:
            yield self.most(self.broke, 1.0, 0.0)

    @cached_property
    def _back(self) -> Rotation:
        return Rotation.from_euler("z", -self.at.yaw, degrees=True)

    def _of(self, name: str, values: np.ndarray) -> np.ndarray:
        return self._back.apply(values[:, self.rollout.names.index(name)])

    def place(self, name: str) -> np.ndarray:
        """[T+1, 3] in units of the size."""
        return self._of(name, self.rollout.position) / self.at.size

    def moved(self, name: str) -> np.ndarray:
        """[T+1, 3] in sizes, since the start."""
        return self.place(name) - self.place(name)[0]

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
        """Distance between the true surfaces of two bodies in a frame, in sizes; negative if they overlap."""
        rows, at = (np.array([self.rollout.names.index(name)]) for name in (one, other)), np.array([frame])
        first, second = (placed(self.scene, self.rollout, at, row) for row in rows)
        found = gaps([solid_of(shape) for shape in self.scene.shapes], first, second, np.array([np.inf]))
        return float(found.apart[0]) / self.at.size

    def kinetic(self) -> np.ndarray:
        """[T+1] J."""
        return energies(self.scene, self.rollout)[0].sum(1)

    def energy(self) -> np.ndarray:
        """[T+1] J, kinetic and potential."""
        kinetic, potential, _ = energies(self.scene, self.rollout)
        return (kinetic + potential).sum(1)


def run(
    at: Setting, label: str, bodies: Sequence[Put], seconds: float, *, gravity: float = G, tilt: float = 0.0,
    sleep: bool = False,
) -> Ran:  # fmt: skip
    """Run a scene for `seconds` (as at 10 cm); gravity leans by `tilt` degrees to +x."""
    shapes: list[Shape] = []
    made, yaw = [], about("z", at.yaw)
    for put in bodies:
        index = next((k for k, shape in enumerate(shapes) if shape is put.shape), len(shapes))
        if index == len(shapes):
            shapes.append(put.shape)
        scale = put.scale * at.size
        motion = "static" if put.fixed else "dynamic"
        mass = 0.0 if put.fixed else put.dense * DENSITY * put.shape.volume * scale**3
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
    found = at.by(scene, seconds * at.time)
    return Ran(scene, found.rollout, found.broke, at, label)


def run_built(at: Setting, label: str, built: SceneBuilder, seconds: float) -> Ran:
    """Run a scene in SI, which the setting does not change."""
    scene = built.load()
    found = at.by(scene, seconds)
    return Ran(scene, found.rollout, found.broke, at, label)


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)
