"""The `bodies` of a scene file: poses, masses, grids of copies, and the names they refer to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.scene.document import Section, Value, nearest
from sdfsim.scene.scene import Motion, Waypoints

DEFAULT_DENSITY = 1000.0  # kg/m^3, of a dynamic body that gives neither mass nor density
DEFAULT_FRICTION = 0.5
MOST_FRICTION = 1000.0
DEFAULT_RESTITUTION = 0.5
MOST_COPIES = 100_000
MOST_NAMED = 20  # in one message

_ROTATIONS = ("quat_xyzw", "quat_wxyz", "euler_xyz_deg")
_NOT_WITH_PLANE = (
    *("shape", "scale", "position", *_ROTATIONS, "velocity", "angular_velocity", "mass", "density"),
    *("count", "arrange"),
)
_NOT_WITH_PATH = ("position", *_ROTATIONS, "velocity", "angular_velocity", "mass", "density")
_KEYS = ("name", "plane", "motion", "path", *_NOT_WITH_PLANE, "friction", "restitution", "collides_with")


@dataclass
class BodySpec:
    """One entry of `bodies`, before `count` is expanded. SI units.

    Attributes:
        name: as in the file.
        place: where faults that show only later are reported.
        shape: key into `shapes`, or None for a body that is a plane of its own.
        mass: kg, or None where the density counts.
        density: kg/m^3.
        offsets: [C, 3] m, added to the position, one row a copy.
        grouped: there is a `count` or `arrange`, so that copies are numbered.
        collides_with: names of bodies or groups, or None for all.
        path: of a kinematic body.
    """

    name: str
    place: Value
    shape: str | None
    motion: Motion
    scale: float
    position: np.ndarray
    quat_xyzw: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mass: float | None
    density: float
    friction: float
    restitution: float
    offsets: np.ndarray
    grouped: bool
    collides_with: list[Value] | None
    path: Waypoints | None

    def names(self) -> list[str]:
        """The names of its copies: `balls[0]`, `balls[1]` ..., or its own name when it is one."""
        return [f"{self.name}[{i}]" for i in range(len(self.offsets))] if self.grouped else [self.name]


def read_bodies(value: Value, shapes: dict[str, str | None]) -> list[BodySpec]:
    """Read the list under `bodies`.

    Args:
        value: the list.
        shapes: kind of every shape of the file by name; None for one that is faulty itself.
    """
    items = value.items()
    if value.is_list() and not items:
        value.wrong("must hold at least one body (got 0)")
    bodies, copies = [], 0
    for item in items:
        bodies.append(_body(item, shapes))
        copies += len(bodies[-1].offsets)
        if copies > MOST_COPIES:
            item.wrong(f"one too many: a scene has at most {MOST_COPIES} bodies, copies included")
            return bodies
    seen: dict[str, int] = {}
    for body in bodies:
        for name in sorted({body.name, *body.names()} - {""}):
            if name in seen:
                body.place.wrong(f"two bodies are called {name!r} (the first on line {seen[name]})")
            seen.setdefault(name, body.place.line)
    for body in bodies:
        for place in body.collides_with or []:
            name = place.text()
            if name and name not in seen:
                place.wrong(f"no body is called {name!r}{nearest(name, seen)}")
    return bodies


def _body(item: Value, shapes: dict[str, str | None]) -> BodySpec:
    section = item.section(_KEYS)
    name = section.required("name")
    plane, shape = section.get("plane"), None
    if plane:
        for key in _NOT_WITH_PLANE:
            if key in section:
                section[key].wrong("does not go with plane: a plane is static and has its pose from normal and offset")
        position, quat = _plane_pose(plane)
    else:
        shape = _shape_of(section, shapes)
        position, quat = section.vector("position", "m"), _rotation(section)
        section.one_of(("mass", "density"), required=False)
    flat = plane is not None or (shape is not None and shapes.get(shape) == "plane")
    motion = section.get("motion")
    chosen = motion.choice(("static", "dynamic", "kinematic"), "dynamic") if motion else "static" if flat else "dynamic"
    if motion and flat and chosen != "static":
        motion.wrong("a plane must be static")
    path = _path(section, chosen)
    if path is not None:
        position, quat = path.position[0], path.quat_xyzw[0]
    velocity, spin = section.vector("velocity", "m/s"), section.vector("angular_velocity", "rad/s")
    for key, value in (("velocity", velocity), ("angular_velocity", spin)):
        if chosen == "static" and not plane and value.any():
            section[key].wrong("must be zero: a static body does not move")
    offsets, grouped = (np.zeros((1, 3)), False) if plane else _offsets(section)
    return BodySpec(
        name=name.text() if name else "",
        place=name or item,
        shape=shape,
        motion=cast(Motion, chosen),
        scale=section.number("scale", above=0, default=1.0),
        position=position,
        quat_xyzw=quat,
        velocity=velocity,
        angular_velocity=spin,
        mass=section.number("mass", "kg", above=0, default=1.0) if "mass" in section else None,
        density=section.number("density", "kg/m^3", above=0, default=DEFAULT_DENSITY),
        friction=section.number("friction", least=0, most=MOST_FRICTION, default=DEFAULT_FRICTION),
        restitution=section.number("restitution", least=0, most=1, default=DEFAULT_RESTITUTION),
        offsets=offsets,
        grouped=grouped,
        collides_with=_partners(section.get("collides_with")),
        path=path,
    )


def _path(section: Section, motion: str) -> Waypoints | None:
    """The timed poses of a kinematic body."""
    value = section.get("path")
    if motion != "kinematic":
        if value:
            value.wrong("goes with motion: kinematic only")
        return None
    for key in _NOT_WITH_PATH:
        if key in section:
            section[key].wrong("does not go with motion: kinematic: its path says where it is")
    if value is None:
        section.missing("path", "is required: a kinematic body follows timed poses")
        return None
    times, places, turns = [], [], []
    for item in value.items():
        pose = item.section(("time", "position", *_ROTATIONS))
        pose.required("time")
        pose.required("position")
        time = pose.number("time", "s", least=0, default=times[-1] + 1.0 if times else 0.0)
        if times and time <= times[-1]:
            item.wrong(f"must be later than the pose before it (got {time:g} s after {times[-1]:g} s)")
        times.append(time)
        places.append(pose.vector("position", "m"))
        turns.append(_rotation(pose))
    if not times:
        if value.is_list():
            value.wrong("must hold at least one pose (got 0)")
        return None
    return Waypoints(np.array(times), np.stack(places), np.stack(turns))


def _shape_of(section: Section, shapes: dict[str, str | None]) -> str | None:
    value = section.one_of(("shape", "plane"), required=True)
    if value is None:
        return None
    name = value.text()
    if name and name not in shapes:
        few = [*list(shapes)[:MOST_NAMED], *(["..."] if len(shapes) > MOST_NAMED else [])]
        there = f"; shapes are {', '.join(few)}" if shapes else "; the file has no shapes"
        value.wrong(f"no shape is called {name!r}{nearest(name, shapes) or there}")
    return name


def _rotation(section: Section) -> np.ndarray:
    """[4] unit quaternion xyzw from whichever key is given. Euler angles turn about the fixed x, then y, then z."""
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    value = section.one_of(_ROTATIONS, required=False)
    if value is None:
        return identity
    if value.path.endswith("euler_xyz_deg"):
        return Rotation.from_euler("xyz", value.vector(3, "degrees"), degrees=True).as_quat()
    wxyz = value.path.endswith("quat_wxyz")
    quat = value.vector(4, default=np.roll(identity, 1) if wxyz else identity)
    return _unit(np.roll(quat, -1) if wxyz else quat, value, "a quaternion has length 1", identity)


def _unit(vector: np.ndarray, place: Value, why: str, default: np.ndarray) -> np.ndarray:
    largest = np.abs(vector).max()
    if largest < 1e-9:
        place.wrong(f"must not be zero: {why}")
        return default
    vector = vector / largest  # first, so that the length of huge numbers does not overflow
    return vector / np.linalg.norm(vector)


def _plane_pose(value: Value) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] m and quaternion [4] xyzw that carry z = 0 onto `normal . x = offset`, the normal made a unit."""
    up = np.array([0.0, 0.0, 1.0])
    section = value.section(("normal", "offset"))
    normal = section.vector("normal", "", up)
    if "normal" in section:
        normal = _unit(normal, section["normal"], "it is the direction the plane faces", up)
    # The shortest turn from z; straight down has none of its own, so turn about x.
    quat = np.array([-normal[1], normal[0], 0.0, 1.0 + normal[2]])
    quat = np.array([1.0, 0.0, 0.0, 0.0]) if np.linalg.norm(quat) < 1e-9 else quat / np.linalg.norm(quat)
    return normal * section.number("offset", "m", default=0.0), quat


def _offsets(section: Section) -> tuple[np.ndarray, bool]:
    """[C, 3] m, a grid centred on the position in x and y with its lowest layer at the position; and if numbered."""
    alone = np.zeros((1, 3))
    count, arrange = section.get("count"), section.get("arrange")
    copies = count.integer(least=1, default=1) if count else None
    if arrange is None:
        if count and copies != 1:
            count.wrong(f"needs arrange: {{grid: [nx, ny, nz], spacing: metres}} (got {copies} at one place)")
        return alone, count is not None
    inner = arrange.section(("grid", "spacing"))
    grid = inner.required("grid")
    inner.required("spacing")
    spacing = inner.number("spacing", "m", above=0, default=1.0)
    sides = [n.integer(least=1, default=1) for n in grid.items()] if grid else []
    if len(sides) != 3:
        if grid and grid.is_list():
            grid.wrong(f"must be three whole numbers (got {len(sides)})")
        return alone, True
    nx, ny, nz = sides
    places = nx * ny * nz
    wanted = places if copies is None else copies
    if wanted > min(places, MOST_COPIES):
        limit = f"{places}, the places of the grid" if wanted > places else f"{MOST_COPIES}"
        (count or arrange).wrong(f"must be <= {limit} (got {wanted})")
        return alone, True
    index = np.arange(wanted)
    cells = np.stack([index % nx, index // nx % ny, index // (nx * ny)], axis=1).astype(np.float64)
    return (cells - [(nx - 1) / 2, (ny - 1) / 2, 0.0]) * spacing, True


def _partners(value: Value | None) -> list[Value] | None:
    if value is not None and value.is_list():
        return value.items()
    if value is not None:
        value.choice(("all",), "all")
    return None
