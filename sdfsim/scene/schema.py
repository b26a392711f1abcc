"""The keys of scene.yaml as pydantic models. `python -m sdfsim.scene.schema` writes docs/scene.md, their reference."""

import itertools
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    WrapValidator,
)
from pydantic import model_validator as validator_of_model
from pydantic_core import InitErrorDetails, PydanticCustomError

from sdfsim.base.errors import nearest
from sdfsim.geometry.primitives import PRIMITIVES
from sdfsim.scene.document import NOTHING, Loc, Numeral
from sdfsim.scene.scene import WORLD, JointKind, Motion, Switch
from sdfsim.shape.shape import DEFAULT_RESOLUTION, FINEST_GRID, MESH_FILE, RECORD_FILE, SKIN_FILE, WEIGHTS_FILE, SdfKind

VERSION = 1
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
DEFAULT_DURATION = 4.0  # s
DEFAULT_GRAVITY = (0.0, 0.0, -9.81)  # m/s^2
MOST_COPIES = 100_000
LARGEST = 1e12  # largest number allowed: powers and products of larger ones may not be finite
_SHOWN = 40  # characters of a value that a message shows

Fault = tuple[Loc, str]  # the place below a table, and what is wrong there


def _shown(value: Any) -> str:
    """A value of the file, for a message."""
    if isinstance(value, str):
        text = str(value) if isinstance(value, Numeral) else repr(value)
        return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
    if isinstance(value, int | float):
        return repr(value)
    return "nothing" if value in (NOTHING, None) else "a list" if isinstance(value, list) else "a mapping"


def _holds(table: "type[Table]", name: str) -> str:
    """How many entries a list of a table has, for a message."""
    known = _schema(table, name)
    what = "names" if known.get("items", {}).get("type") == "string" else "numbers"
    return (
        f"be {known['maxItems']} {what}" if "maxItems" in known else f"have at least {known.get('minItems', 0)} entry"
    )


def _schema(table: "type[Table]", name: str) -> dict[str, Any]:
    """The JSON schema of a key; of one that may be left out, that of its values."""
    known = table.model_json_schema()["properties"][name]
    return {**next(iter(known.get("anyOf", [])), {}), **known}


# Keys of other programs, and their names here.
_TURNS = "quat_xyzw, quat_wxyz or euler_xyz_deg"
_MEANT = {
    "rotation": _TURNS, "orientation": _TURNS, "quat": _TURNS, "quaternion": _TURNS, "euler": _TURNS, "rpy": _TURNS,
    "pose": "position, and " + _TURNS, "pos": "position", "xyz": "position", "origin": "position", "mu": "friction",
    "weight": "mass", "fixed": "motion: static", "static": "motion: static", "kinematic": "motion: kinematic",
    "bounce": "restitution", "file": "mesh", "effort": "max_force", "target": "position, position_deg or speed",
    "parent": "bodies", "child": "bodies", "limit": "limits or limits_deg", "range": "limits or limits_deg",
}  # fmt: skip


def meant(name: str, known: Iterable[str]) -> str:
    """A suggestion for an unknown key, for a message; an empty string if there is none."""
    known = list(known)
    hint = _MEANT.get(name.lower(), "")
    return f" (give {hint})" if any(key in known for key in re.findall(r"\w+", hint)) else nearest(name, known)


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("value", "{text}", {"text": text})


def _message(error: Any, table: "type[Table]") -> str:
    """A message in our words for what pydantic found in a table."""
    kind, known = error["type"], table.model_fields
    if kind == "value":
        return error["msg"]
    if kind == "missing":
        return "is required"
    key = error["loc"][0]
    if kind == "extra_forbidden":
        if place := table.elsewhere(str(key)):
            return place
        return f"unknown key{meant(key, known) or '; known here: ' + (', '.join(known) or 'none')}"
    extra, limits = known[key].json_schema_extra, error.get("ctx", {})
    unit = extra.get("unit", "") if isinstance(extra, dict) else ""
    got, allowed = _shown(error["input"]), limits.get("expected", "").replace("'", "").replace(" or ", ", ")
    if kind.startswith("int_"):
        return f"must be a whole number (got {got})"
    holds = _holds(table, str(key)) if kind in ("too_short", "too_long", "list_type") else ""
    texts = {
        "number": f"must be a number{unit and ' in '}{unit} (got {got})",
        "greater_than": f"must be > {limits.get('gt', 0):g} (got {got}{unit and ' '}{unit})",
        "greater_than_equal": f"must be >= {limits.get('ge', 0):g} (got {got}{unit and ' '}{unit})",
        "less_than_equal": f"must be <= {limits.get('le', 0):g} (got {got}{unit and ' '}{unit})",
        "too_short": f"must {holds} (got {limits.get('actual_length')})",
        "too_long": f"must {holds} (got {limits.get('actual_length')})",
        "literal_error": f"must be one of {allowed} (got {got})",
        "list_type": f"must {holds if holds.startswith('be') else 'be a list'} (got {got})",
        "dict_type": f"must be a mapping (got {got})",
    }
    return texts.get(kind, f"must be a text (got {got})")


def _numeral(value: Any) -> Any:
    if not isinstance(value, Numeral) and not (type(value) in (int, float) and math.isfinite(value)):
        raise PydanticCustomError("number", "not a number")
    return value


def _unit(values: list[float]) -> np.ndarray:
    """A direction as a unit vector."""
    largest = np.abs(values).max()
    if largest < 1e-9:
        raise _problem("must not be zero")
    made = np.array(values) / largest  # scaled first, so that the length of huge numbers does not overflow
    return made / np.linalg.norm(made)


def _partners(value: Any, handler: Callable[[Any], list[str]]) -> list[str] | None:
    if not isinstance(value, list) and value != "all":
        raise _problem(f"must be all, or a list of names (got {_shown(value)})")
    return None if value == "all" else handler(value)


def _find(text: str, info: ValidationInfo) -> Path:
    """The place that a path in the file names, whether or not something is there."""
    context: Any = info.context
    home: Path = context["folder"]
    place = home / text
    if "\\" in text and not os.path.lexists(place):  # written on Windows
        place = home / text.replace("\\", "/")
    try:
        # Where it leads when all links are followed; for a folder, also where the files of a shape lead.
        inside = (WEIGHTS_FILE, MESH_FILE, RECORD_FILE, SKIN_FILE) if place.is_dir() else ()
        ends = [place.resolve(), *((place / name).resolve() for name in inside)]
        outside = not all(end.is_relative_to(home.resolve()) for end in ends)
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, too long a name, a zero byte
        raise _problem(f"cannot be looked up: {place} ({getattr(error, 'strerror', None) or error})") from None
    if outside and not context["allow_outside"]:
        advice = "copy it there, or allow it with --allow-outside, in Python allow_outside=True"
        raise _problem(f"leads out of the scene's folder: {place} ({advice})")
    return place


def _there(text: str, info: ValidationInfo) -> str:
    """Check that an `asset` is a folder and a `mesh` a file."""
    place, what = _find(text, info), "folder" if info.field_name == "asset" else "file"
    if not (place.is_dir() if what == "folder" else place.is_file()):
        raise _problem(f"no such {what}: {place}")
    return str(place)


def _model(text: str, info: ValidationInfo) -> str:
    """The name of a bundled model, or the path of a file relative to the scene's folder."""
    return str(_find(text, info)) if text.endswith(".safetensors") else text


def _primitive(name: str) -> str:
    if name not in PRIMITIVES:
        raise _problem(
            f"no such primitive: {name!r}{nearest(name, PRIMITIVES)}; primitives are {', '.join(PRIMITIVES)}"
        )
    return name


def _version(number: int) -> int:
    if number != VERSION:
        raise _problem(f"must be {VERSION} (got {number})")
    return number


def key(what: str, default: Any = ..., unit: str = "", of: str = "", **limits: Any) -> Any:
    """A key of a table: its meaning, default, unit, the kinds of entries that have it (if not all), and limits."""
    extra: dict[str, Any] = {"unit": unit, "of": of}
    return Field(default, description=what, json_schema_extra=extra, **limits)


_THREE = Field(min_length=3, max_length=3)
Text = Annotated[str, Field(pattern=r"\S")]
Number = Annotated[float, BeforeValidator(_numeral), Field(ge=-LARGEST, le=LARGEST)]
Whole = Annotated[int, BeforeValidator(_numeral), Field(le=10**18)]
Vector = Annotated[list[Number], _THREE]
Direction = Annotated[Vector, AfterValidator(_unit)]
Quaternion = Annotated[list[Number], Field(min_length=4, max_length=4), AfterValidator(_unit)]


class Table(BaseModel):
    """A mapping of the file. All of its faults are found at once."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True, extra="forbid")

    @validator_of_model(mode="wrap")
    @classmethod
    def _find_all(cls, data: Any, handler: Any) -> Any:
        data = {} if data is NOTHING else data
        if not isinstance(data, dict):
            raise _problem(f"must be a mapping (got {_shown(data)})")
        found, made = list(cls.check_keys(data)), None
        try:
            made = handler(data)
            found += made.check_values()
        except ValidationError as error:
            found += [(e["loc"], _message(e, cls)) for e in error.errors(include_url=False)]
        if found:
            details = [InitErrorDetails(type=_problem(text), loc=loc, input=None) for loc, text in found]
            raise ValidationError.from_exception_data(cls.__name__, details)
        return made

    @classmethod
    def elsewhere(cls, key: str) -> str:
        """Where a key that this table does not know belongs, for a message; empty if nowhere."""
        return ""

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        """Faults in the combination of keys; checked even if values are wrong."""
        yield from ()

    def check_values(self) -> Iterator[Fault]:
        """Faults in values that do not fit each other; checked once each value is valid."""
        yield from ()


def _one_of(data: dict, keys: Iterable[str], *, required: bool = False) -> Iterator[Fault]:
    there = [key for key in data if key in keys]
    if len(there) > 1:
        yield (there[1],), f"give only one of {', '.join(keys)} (got {' and '.join(there)})"
    if not there and required:
        yield (), f"one of {', '.join(keys)} is required"


class EffectsTable(Table):
    """Which effects to compute; `auto` is on if it can change the motion. `sdfsim plan` shows the decisions."""

    contact: Switch = key("bodies touch", "auto")
    friction: Switch = key("contacts have friction", "auto")
    restitution: Switch = key("contacts rebound", "auto")
    rotation: Switch = key("bodies turn", "auto")
    sleep: Switch = key("bodies at rest are frozen until something disturbs them", "auto")
    joints: Switch = key("joints hold bodies", "auto")


class Primitive(Table):
    """A procedural shape."""

    name: Annotated[Text, AfterValidator(_primitive)] = key(f"one of {', '.join(PRIMITIVES)}")
    size: Number = key("largest extent", 1.0, "m", gt=0)


class Sphere(Table):
    """An exact sphere about the origin."""

    radius: Number = key("radius", unit="m", gt=0)


class Upright(Table):
    """An exact cylinder along z, about the origin."""

    radius: Number = key("radius", unit="m", gt=0)
    height: Number = key("along z; for a capsule above twice the radius, because it includes the caps", unit="m", gt=0)


class Capsule(Upright):
    """An exact capsule along z, about the origin."""

    def check_values(self) -> Iterator[Fault]:
        if self.height <= 2 * self.radius:
            yield ("height",), f"must be above twice the radius, its caps included (got {self.height:g} m)"


class Box(Table):
    """An exact box about the origin."""

    size: Annotated[list[Annotated[Number, Field(gt=0)]], _THREE] = key("extents along x, y, z", unit="m")


class Cone(Table):
    """An exact cone along z, its tip up, the middle of its height at the origin."""

    radius: Number = key("radius of its base", unit="m", gt=0)
    height: Number = key("along z", unit="m", gt=0)


class Torus(Table):
    """An exact ring around z, about the origin."""

    radius: Number = key("radius of the circle in the middle of its tube", unit="m", gt=0)
    tube: Number = key("radius of its tube, below that of the circle", unit="m", gt=0)

    def check_values(self) -> Iterator[Fault]:
        if self.tube >= self.radius:
            yield ("tube",), f"must be below the radius of the circle (got {self.tube:g} m)"


class PlaneShape(Table):
    """z = 0, infinite. It takes no keys: tilt it by the body's pose, or give the body its own `plane`."""


_KINDS = ("asset", "mesh", "primitive", "sphere", "capsule", "cylinder", "box", "cone", "torus", "plane", "parts")
OF_PART = ("mesh", "sphere", "capsule", "cylinder", "box")
FITTED = ("mesh", "primitive")  # made on first use, which may take a minute
_WITH_SDF = ("asset", *FITTED)  # the other kinds have an exact SDF


_ROTATIONS = ("quat_xyzw", "quat_wxyz", "euler_xyz_deg")


class Turned(Table):
    """An entry with an orientation, given by at most one of three keys."""

    quat_xyzw: Quaternion | None = key("orientation as a quaternion, scalar last; of any length", None)
    quat_wxyz: Quaternion | None = key("the same, scalar first", None)
    euler_xyz_deg: Vector | None = key("orientation as turns about the fixed axes x, then y, then z", None, "degrees")

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        yield from _one_of(data, _ROTATIONS)

    def rotation(self) -> np.ndarray:
        """[4] unit quaternion xyzw."""
        if self.quat_wxyz is not None:
            return np.roll(self.quat_wxyz, -1)
        if self.euler_xyz_deg is not None:
            from scipy.spatial.transform import Rotation  # slow to import

            return Rotation.from_euler("xyz", self.euler_xyz_deg, degrees=True).as_quat()
        return np.array([0.0, 0.0, 0.0, 1.0] if self.quat_xyzw is None else self.quat_xyzw)


class PartTable(Turned):
    """One part of a shape: exactly one of `mesh` to `box`, and its pose in the shape. Where parts overlap, they count
    once in the mass."""

    mesh: Annotated[Text, AfterValidator(_there)] | None = key("mesh file, relative to the scene's folder", None)
    sphere: Sphere | None = key("a sphere", None)
    capsule: Capsule | None = key("a capsule", None)
    cylinder: Upright | None = key("a cylinder", None)
    box: Box | None = key("a box", None)
    scale: Number = key("factor on the size of a mesh", 1.0, gt=0)
    position: Vector = key("its middle, or the origin of its mesh, from the shape's origin", (0.0, 0.0, 0.0), "m")
    color: Annotated[list[Annotated[Number, Field(ge=0, le=255)]], _THREE] | None = key(
        "red, green and blue (sRGB, 0 to 255); by default those of the mesh, or grey", None
    )
    use: Literal["both", "touch", "shown"] = key(
        "whether it touches others and has mass (`touch`), is only shown, or both; meshes that touch are solids", "both"
    )

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        yield from _one_of(data, OF_PART, required=True)
        yield from super().check_keys(data)
        if "scale" in data and "mesh" not in data:
            yield ("scale",), "is for a mesh only: give other parts their size"


class ShapeTable(Table):
    """One shape: exactly one of `asset` to `parts`, and how its distances and surface nodes are made."""

    asset: Annotated[Text, AfterValidator(_there)] | None = key(
        "folder that `reconstruct` or `fit` has written, relative to the scene's folder", None
    )
    mesh: Annotated[Text, AfterValidator(_there)] | None = key("mesh file, relative to the scene's folder", None)
    primitive: Primitive | None = key("a procedural shape", None)
    sphere: Sphere | None = key("an exact sphere", None)
    capsule: Capsule | None = key("an exact capsule", None)
    cylinder: Upright | None = key("an exact cylinder", None)
    box: Box | None = key("an exact box", None)
    cone: Cone | None = key("an exact cone", None)
    torus: Torus | None = key("an exact ring", None)
    plane: PlaneShape | None = key("an infinite plane", None)
    parts: Annotated[list[PartTable], Field(min_length=1)] | None = key("several of these as one body", None)
    units: Literal["m", "cm", "mm", "in"] = key("unit of the numbers in a mesh file", "m")
    cap: Literal["on", "off"] = key("close the openings of a mesh", "off")
    thicken: Number | None = key("thickness that an open sheet of a mesh gets", None, "m", gt=0)
    sdf: SdfKind | None = key(
        "where distances come from: a fitted network, samples on a grid, or the mesh itself; by default an asset keeps "
        "its own, and others are the mesh itself, or fitted if the scene's `model` is a network",
        None,
    )
    resolution: Whole = key(
        "samples along the longest side, with `sdf: grid`", DEFAULT_RESOLUTION, ge=8, le=FINEST_GRID
    )
    nodes: Whole | None = key(
        "N of the N^3 grid whose points become surface nodes; by default a shape keeps its own", None, ge=3, le=128
    )
    centre: Literal["on", "off"] = key("moves the origin of an asset or a mesh to its centre of mass", "off")
    round: Literal["auto", "off"] = key(
        "whether a mesh that is a sphere, cylinder, capsule, cone or ring up to its facets collides as one; the body's "
        "frame is then that of the round shape, and a frame of its name that of the mesh",
        "off",
    )
    wall: Number | None = key(
        "makes the shape hollow: only the layer of this thickness below its surface has mass", None, "m", gt=0
    )

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        yield from _one_of(data, _KINDS, required=True)
        kind = next((key for key in data if key in _KINDS), None)
        for key in ("units", "cap", "thicken", "round"):
            if key in data and kind not in ("mesh", None):
                yield (key,), f"is for mesh only (this is a {kind})"
        if "centre" in data and kind not in (*_WITH_SDF, "parts", None):
            yield ("centre",), f"is for {', '.join(_WITH_SDF)} only (a {kind} is about its centre)"
        if "sdf" in data and kind not in (*_WITH_SDF, None):
            yield ("sdf",), f"is for {', '.join(_WITH_SDF)} only (a {kind} has its exact SDF)"
        parts = data["parts"] if isinstance(data.get("parts"), list) else []
        if parts and all(isinstance(part, dict) and part.get("use") == "shown" for part in parts):
            yield ("parts",), "one part must not be use: shown; a body that touches nothing has collides_with: []"
        if "resolution" in data and data.get("sdf") in (None, "mlp", "mesh"):
            yield ("resolution",), "is for sdf: grid only"
        for key in ("nodes", "wall"):
            if key in data and kind == "plane":
                yield (key,), "is not for a plane, which has no nodes and no mass"

    @property
    def kind(self) -> str:
        """Which of `_KINDS` is given."""
        return next(kind for kind in _KINDS if getattr(self, kind) is not None)


class Waypoint(Turned):
    """One pose of a path. Between poses a body moves straight and turns evenly; before the first and after the last it
    rests."""

    time: Number = key("time of the pose; later than the pose before it", unit="s", ge=0)
    position: Vector = key("position of the shape's own origin", unit="m")


class Plane(Table):
    """The points x with normal . x = offset, for a body without a shape."""

    normal: Direction = key("direction in which it faces; of any length", (0.0, 0.0, 1.0))
    offset: Number = key("distance from the origin along the normal", 0.0, "m")

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position [3] m and quaternion [4] xyzw that carry z = 0 onto the plane."""
        normal = np.array(self.normal)
        # The shortest turn from z. Straight down it is not unique, so turn about x.
        quat = np.array([-normal[1], normal[0], 0.0, 1.0 + normal[2]])
        quat = np.array([1.0, 0.0, 0.0, 0.0]) if np.linalg.norm(quat) < 1e-9 else quat / np.linalg.norm(quat)
        return normal * self.offset, quat


class Arrange(Table):
    """Copies on a grid that is centred on the position in x and y, with its lowest layer at the position."""

    grid: Annotated[list[Annotated[Whole, Field(ge=1)]], _THREE] = key("copies along x, y, z")
    spacing: Number = key("distance from one copy to the next", unit="m", gt=0)


_NOT_WITH_PATH = ("position", *_ROTATIONS, "velocity", "angular_velocity", "mass", "density", "inertia_factor")
_NOT_WITH_PLANE = ("shape", "scale", *_NOT_WITH_PATH, "count", "arrange")
_ORIGIN = (0.0, 0.0, 0.0)


class BodyTable(Turned):
    """One body, or many copies of it: either a `shape` or a `plane` of its own."""

    name: Text = key("unique; copies are called NAME[0], NAME[1], ...")
    shape: Text | None = key("a name under `shapes`", None)
    plane: Plane | None = key("makes it an infinite static plane", None)
    motion: Motion | None = key(
        "kinematic bodies follow their `path`, whatever they meet; by default dynamic, for planes static", None
    )
    path: Annotated[list[Waypoint], Field(min_length=1)] | None = key(
        "poses of a kinematic body, in place of a position and an orientation", None
    )
    scale: Number = key("factor on the size of the shape", 1.0, gt=0)
    position: Vector = key("position of the shape's own origin", _ORIGIN, "m")
    velocity: Vector = key("velocity of the centre of mass", _ORIGIN, "m/s")
    angular_velocity: Vector = key("angular velocity in world axes", _ORIGIN, "rad/s")
    mass: Number | None = key("by default density times volume", None, "kg", gt=0)
    density: Number = key("give it or `mass`, not both", 1000.0, "kg/m^3", gt=0)
    inertia_factor: Number = key("factor on the inertia of this mass spread evenly in the shape", 1.0, gt=0, le=100)
    friction: Number = key(
        "Coulomb coefficient; a contact has the product of both bodies', 0.25 by default", 0.5, ge=0, le=1000
    )
    restitution: Number = key(
        "coefficient of restitution; a contact has the product of both bodies', 0.25 by default", 0.5, ge=0, le=1
    )
    stiffness: Number | None = key(
        "of soft material such as rubber or foam: its contacts give way by the force divided by it, and rebound by "
        "it; those of two bodies act in series; by default rigid", None, "N/m", gt=0,
    )  # fmt: skip
    damping: Number = key("of the contacts of soft material", 0.0, "N s/m", ge=0)
    collides_with: Annotated[list[Text] | None, WrapValidator(_partners)] = key(
        "`all`, or a list of names: two bodies touch where each lists the other", None
    )
    avoids: list[Text] = key("names of bodies that it never touches, whatever `collides_with` says", [])
    color: Annotated[list[Annotated[Number, Field(ge=0, le=255)]], _THREE] | None = key(
        "red, green and blue (sRGB, 0 to 255) where its mesh has no colours; by default grey if it never moves", None
    )
    count: Whole | None = key("number of copies; by default as many as the grid has places", None, ge=1)
    arrange: Arrange | None = key("places of the copies", None)

    @classmethod
    def elsewhere(cls, key: str) -> str:
        if key in cls.model_fields or key not in ShapeTable.model_fields:
            return ""
        return f"belongs to a shape: give `shapes: {{NAME: {{{key}: ...}}}}` beside `bodies`, and here `shape: NAME`"

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        for key in _NOT_WITH_PLANE if "plane" in data else ():
            if key in data:
                yield (key,), "cannot be given with plane: a plane is static and has its pose from normal and offset"
        if "plane" in data and data.get("motion", "static") != "static":
            yield ("motion",), "a plane must be static"
        if "plane" not in data:
            misplaced = any(map(cls.elsewhere, map(str, data)))  # those faults say where it belongs
            yield from _one_of(data, ("shape", "plane"), required=not misplaced)
            yield from super().check_keys(data)
            yield from _one_of(data, ("mass", "density"))
        if data.get("motion") == "kinematic":
            for key in _NOT_WITH_PATH:
                if key in data:
                    yield (key,), "cannot be given with motion: kinematic, as the path decides where the body is"
            if "path" not in data:
                yield ("path",), "is required: a kinematic body follows timed poses"
        elif "path" in data:
            yield ("path",), "is for motion: kinematic only"

    def check_values(self) -> Iterator[Fault]:
        for i, (before, pose) in enumerate(itertools.pairwise(self.path or []), 1):
            if pose.time <= before.time:
                got = f"(got {pose.time:g} s after {before.time:g} s)"
                yield ("path", i), f"must be later than the pose before it {got}"
        if self.arrange is None and self.copies > 1:
            advice = "needs arrange: {grid: [nx, ny, nz], spacing: metres}"
            yield ("count",), f"{advice} (got {self.copies} at one place)"
        elif self.copies > self.places:
            yield ("count",), f"must be <= {self.places}, the places of the grid (got {self.copies})"

    @property
    def places(self) -> int:
        """The number of places of the grid, or 1 for a single body."""
        return 1 if self.arrange is None else math.prod(self.arrange.grid)

    @property
    def copies(self) -> int:
        """The number of bodies that the entry stands for."""
        return self.count or self.places

    def names(self) -> list[str]:
        """`balls[0]`, `balls[1]` ... if there is a count or a grid, even of one; else the name itself."""
        grouped = self.count is not None or self.arrange is not None
        return [f"{self.name}[{i}]" for i in range(self.copies)] if grouped else [self.name]

    def offsets(self) -> np.ndarray:
        """[copies, 3] m, offsets of the copies from the position."""
        if self.arrange is None:
            return np.zeros((1, 3))
        nx, ny, _ = self.arrange.grid
        index = np.arange(self.copies)
        cells = np.stack([index % nx, index // nx % ny, index // (nx * ny)], axis=1).astype(np.float64)
        return (cells - [(nx - 1) / 2, (ny - 1) / 2, 0.0]) * self.arrange.spacing


class SpringTable(Table):
    """A linear spring of a hinge, a slider or a distance."""

    stiffness: Number = key("in N m/rad for a hinge, else in N/m", unit="", gt=0)
    rest: Number = key("position at which a slider, or length at which a distance, is at rest", 0.0, "m")
    rest_deg: Number = key("angle at which a hinge is at rest", 0.0, "degrees")


class MotorTable(Table):
    """A motor of a hinge or a slider. It keeps a speed, or goes to a position and stays there, as far as its strength
    allows. Without either it does nothing until Python sets `simulator.joint(NAME).target` or `effort`."""

    speed: Number | None = key(
        "speed of the first body relative to the second; in rad/s for a hinge, else in m/s", None
    )
    position: Number | None = key("target position of a slider", None, "m")
    position_deg: Number | None = key("target angle of a hinge", None, "degrees")
    max_force: Number = key("largest torque of a hinge in N m, or largest force of a slider in N", gt=0)
    time: Number = key(
        "time in which the distance to the target shrinks by a factor e; not with `speed`", 0.1, "s", ge=0
    )
    gain: Number | None = key(
        "torque or force is `gain` times (target - `time` times the rate of change - now), or times (speed - now); in "
        "N m/rad or N m s/rad for a hinge, else in N/m or N s/m; by default as much as the target takes",
        None, gt=0,
    )  # fmt: skip

    @validator_of_model(mode="before")
    @classmethod
    def _earlier_name(cls, data: Any) -> Any:
        return {"max_force" if key == "most" else key: data[key] for key in data} if isinstance(data, dict) else data

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        yield from _one_of(data, ("speed", "position", "position_deg"))
        if "time" in data and "speed" in data:
            yield ("time",), "cannot be given with speed"


class BreaksTable(Table):
    """The load that a joint can bear; more breaks it for good."""

    force: Number | None = key("largest force", None, "N", gt=0)
    torque: Number | None = key("largest torque", None, "N m", gt=0)

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        if not {"force", "torque"} & data.keys():
            yield (), "force or torque is required"


_NEEDED = {"hinge": ("anchor", "axis"), "slider": ("axis",), "ball": ("anchor",), "distance": ("anchor", "to")}


def _ordered(ends: list[float]) -> list[float]:
    if ends[1] < ends[0]:
        raise _problem(f"must not be below the first (got {ends[0]:g} to {ends[1]:g})")
    return ends


Ends = Annotated[list[Number], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class JointTable(Table):
    """Holds two bodies together, or one body to the `world`. Angles and positions are those of the first body relative
    to the second, right-handed about the axis."""

    name: Text = key("unique among joints")
    type: JointKind = key(
        "`hinge` turns about an axis, `slider` moves along one, `ball` turns about a point, `fixed` allows no motion, "
        "`distance` keeps two points apart: by a `rod`, a `rope` or a `spring`"
    )
    bodies: Annotated[list[Text], Field(min_length=2, max_length=2)] = key(
        f"names of two bodies; the second may be `{WORLD}`"
    )
    anchor: Vector | None = key(
        "the point that both share, or the end of a distance at the first body; required for hinges, balls, distances, "
        "for others by default the first body's origin", None, "m",
    )  # fmt: skip
    to: Vector | None = key("end of a distance at the second body", None, "m", of="distance")
    axis: Direction | None = key(
        "axis of a hinge, a slider or the cone of a ball; of any length", None, of="hinge slider ball"
    )
    frame: Text = key(
        f"frame of anchor, to and axis: `{WORLD}`, with bodies as they are at the start, or the name of one of the two "
        "bodies: relative to its shape's origin, along its axes",
        WORLD,
    )
    start: Number = key("position of a slider at the start", 0.0, "m", of="slider")
    start_deg: Number = key("angle of a hinge at the start", 0.0, "degrees", of="hinge")
    limits: Ends | None = key("lowest and highest position of a slider", None, "m", of="slider")
    limits_deg: Ends | None = key("lowest and highest angle of a hinge; full turns add up", None, "degrees", of="hinge")
    cone_deg: Number | None = key(
        "for a ball: largest angle between the axes of the two bodies", None, "degrees", ge=0, le=180, of="ball"
    )
    rod: Number | None = key(
        "the distance that the points keep; it must be that at the start", None, "m", gt=0, of="distance"
    )
    rope: Number | None = key("the largest distance of the points", None, "m", gt=0, of="distance")
    restitution: Number = key(
        "coefficient with which limits and ropes rebound", 0.0, ge=0, le=1, of="hinge slider ball distance"
    )
    damping: Number = key(
        "in N m s/rad for hinges and balls, else in N s/m", 0.0, ge=0, of="hinge slider ball distance"
    )
    friction: Number = key(
        "torque in N m for hinges and balls, force in N for sliders", 0.0, ge=0, of="hinge slider ball"
    )
    armature: Number = key(
        "inertia of a motor's rotor, as the joint feels it, in kg m^2 for hinges and balls, in kg for sliders",
        0.0, ge=0, of="hinge slider ball",
    )  # fmt: skip
    spring: SpringTable | None = key("a spring that pulls back", None, of="hinge slider distance")
    motor: MotorTable | None = key("a motor that drives it", None, of="hinge slider")
    breaks_at: BreaksTable | None = key("load at which it breaks", None)
    collide: Literal["on", "off"] = key("whether the two bodies may touch each other", "off")

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        kind, extra = str(data.get("type")), {name: field.json_schema_extra for name, field in cls.model_fields.items()}
        if kind not in get_args(JointKind):
            return
        fit = {name: str(own["of"]).split() for name, own in extra.items() if isinstance(own, dict) and own["of"]}
        for name in data:
            if kind not in fit.get(name, [kind]):
                other = name.removesuffix("_deg") if name.endswith("_deg") else f"{name}_deg"
                other = f"; give {other}" if kind in fit.get(other, ()) else ""
                yield (name,), f"is for {', '.join(fit[name])} only (this is a {kind}{other})"
        for name in _NEEDED.get(kind, ()):
            if name not in data:
                yield (name,), f"is required: this is a {kind}"
        if kind == "distance":
            yield from _one_of(data, ("rod", "rope"))
            yield from _one_of(data, ("rod", "spring"))
            if not {"rod", "rope", "spring"} & data.keys():
                yield (), "one of rod, rope, spring is required: this is a distance"
        if "cone_deg" in data and "axis" not in data:
            yield ("axis",), "is required: cone_deg is measured from it"
        if "restitution" in data and not {"limits", "limits_deg", "cone_deg", "rope"} & data.keys():
            yield ("restitution",), "is for limits or a rope only"
        if kind == "distance" and "damping" in data and "rod" in data:
            yield ("damping",), "cannot be given with rod: the distance of its ends does not change"
        for table, wrong in (("spring", ("rest", "rest_deg")), ("motor", ("position", "position_deg"))):
            inner = data.get(table)
            name = wrong[0 if kind == "hinge" else 1]
            if isinstance(inner, dict) and name in inner and kind in fit[table]:
                yield (table, name), f"is not for a {kind}: give {wrong[1 if kind == 'hinge' else 0]}"

    def check_values(self) -> Iterator[Fault]:
        if self.frame not in (WORLD, *self.bodies):
            fault = f"must be {WORLD}, {self.bodies[0]} or {self.bodies[1]} (got {self.frame!r})"
            yield ("frame",), fault
        for ends, start, name, unit in (
            (self.limits, self.start, "start", "m"), (self.limits_deg, self.start_deg, "start_deg", "degrees"),
        ):  # fmt: skip
            if ends is not None and not ends[0] <= start <= ends[1]:
                fault = f"is beyond the limits, {ends[0]:g} to {ends[1]:g} {unit} (got {start:g} {unit})"
                yield (name if name in self.model_fields_set else f"limits{name[5:]}",), fault
            goal = getattr(self.motor, f"position{name[5:]}", None)
            if ends is not None and goal is not None and not ends[0] <= goal <= ends[1]:
                fault = f"is beyond the limits, {ends[0]:g} to {ends[1]:g} {unit} (got {goal:g} {unit})"
                yield ("motor", f"position{name[5:]}"), fault


class FrameTable(Turned):
    """A named pose that moves with a body: `simulator.frame(NAME)`."""

    name: Text = key("unique among frames")
    body: Text = key(f"name of a body, or `{WORLD}`")
    position: Vector = key("its origin from the origin of the body's shape, along the body's axes", _ORIGIN, "m")


class Pose(Turned):
    """Where a keyframe has a body."""

    position: Vector = key("position of the shape's own origin", unit="m")
    velocity: Vector = key("velocity of the centre of mass", _ORIGIN, "m/s")
    angular_velocity: Vector = key("angular velocity in world axes", _ORIGIN, "rad/s")


class KeyframeTable(Table):
    """A pose of all joints by its name, for `simulator.reset(keyframe=NAME)`. What it gives no speed is at rest, and
    motors that go to a position aim at it. Joints and bodies that it leaves out stay as at the start."""

    angles_deg: dict[str, Number] = key("angles of hinges, by their names", {}, "degrees")
    positions: dict[str, Number] = key("positions of sliders", {}, "m")
    quats_xyzw: dict[str, Quaternion] = key("rotations of balls, scalar last, from their start", {})
    speeds: dict[str, Number] = key("speeds of hinges in rad/s, of sliders in m/s", {})
    spins: dict[str, Vector] = key(
        "angular velocities of balls: of the first body relative to the second, in its axes, which are those of the "
        "world at the start; with a cone, x is its axis", {}, "rad/s",
    )  # fmt: skip
    targets: dict[str, Number] = key(
        "targets of motors, in place of the position: rad or m, or rad/s or m/s for those that keep a speed", {}
    )
    bodies: dict[str, Pose] = key("poses of bodies that no joint holds", {})


class CouplingTable(Table):
    """Couples two hinges or sliders, as gears do: the first is at `ratio` times the second plus an offset."""

    joints: Annotated[list[Text], Field(min_length=2, max_length=2)] = key("names of two joints")
    ratio: Number = key("radians or metres of the first for each radian or metre of the second", 1.0)
    offset: Number = key("offset of a slider", 0.0, "m")
    offset_deg: Number = key("offset of a hinge", 0.0, "degrees")


def _named(bodies: list, joints: Any, frames: Any) -> Iterator[tuple[Loc, str]]:
    """The places where bodies, joints and frames name bodies, and the names, as far as these are lists."""
    for i, entry in enumerate(frames if isinstance(frames, list) else ()):
        if isinstance(entry, dict) and isinstance(name := entry.get("body"), str) and name.strip():
            yield ("frames", i, "body"), name
    named = ("bodies", bodies, "collides_with"), ("bodies", bodies, "avoids"), ("joints", joints, "bodies")
    for of, entries, key in named:
        for i, entry in enumerate(entries if isinstance(entries, list) else ()):
            names = entry.get(key) if isinstance(entry, dict) else None
            for k, name in enumerate(names if isinstance(names, list) else ()):
                if isinstance(name, str) and name.strip():
                    yield (of, i, key, k), name


def _no_body(name: str, known: Iterable[str]) -> str:
    there = [*known][:20]
    return f"no body is called {name!r}{nearest(name, known) or '; bodies are ' + ', '.join(there)}"


class SceneTable(Table):
    """The whole file."""

    version: Annotated[Whole, AfterValidator(_version)] = key(f"always {VERSION}")
    model: Annotated[Text, AfterValidator(_model)] | None = key(
        "bundled model, or a .safetensors file in the scene's folder; the model sets the time step", None
    )
    duration: Number = key("simulated time", DEFAULT_DURATION, "s", gt=0)
    step: Number | None = key("time step; by default it follows the size of what moves", None, "s", gt=0)
    seed: Whole = key("seed of the run's random numbers", 0, ge=0)
    gravity: Vector = key("acceleration of free fall", DEFAULT_GRAVITY, "m/s^2")
    effects: EffectsTable = key("which effects to compute", EffectsTable())
    shapes: dict[str, ShapeTable] = key("shapes by name", {})
    bodies: Annotated[list[BodyTable], Field(min_length=1)] = key("all bodies")
    joints: list[JointTable] = key("joints between bodies", [])
    frames: list[FrameTable] = key("named poses on bodies", [])
    keyframes: dict[str, KeyframeTable] = key("poses of all joints by name", {})
    couplings: list[CouplingTable] = key("joints that follow others", [])

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        shapes = data["shapes"] if isinstance(data.get("shapes"), dict) else {}
        listed = data["bodies"] if isinstance(data.get("bodies"), list) else []
        first: dict[str, int] = {}
        for i, entry in enumerate(listed):
            texts = [entry.get(key) for key in ("name", "shape")] if isinstance(entry, dict) else ["", ""]
            name, shape = (text if isinstance(text, str) else "" for text in texts)  # else a fault of its own
            if name.strip() and first.setdefault(name, i) != i:
                yield ("bodies", i, "name"), f"two bodies are called {name!r} (the first is bodies[{first[name]}])"
            if shape.strip() and shape not in shapes:
                there = f"; shapes are {', '.join([*shapes][:20])}" if shapes else "; the file has no shapes"
                yield ("bodies", i, "shape"), f"no shape is called {shape!r}{nearest(shape, shapes) or there}"
        grouped = {entry["name"] for entry in listed if isinstance(entry, dict) and isinstance(entry.get("name"), str)
                   and {"count", "arrange"} & entry.keys()}  # fmt: skip
        for where, name in _named(listed, data.get("joints"), data.get("frames")):
            if name not in first and name != WORLD and name.partition("[")[0] not in grouped:
                yield where, _no_body(name, first)

    def check_values(self) -> Iterator[Fault]:
        first = {body.name: i for i, body in enumerate(self.bodies)}
        for i, copies in enumerate(itertools.accumulate(body.copies for body in self.bodies)):
            if copies > MOST_COPIES:
                yield ("bodies", i), f"too many bodies: a scene has at most {MOST_COPIES} bodies, copies included"
                return
        copies = {name: i for i, body in enumerate(self.bodies) for name in body.names() if name != body.name}
        for name in copies.keys() & first.keys():
            yield ("bodies", first[name], "name"), f"two bodies are called {name!r} (see bodies[{copies[name]}])"
        for i, body in enumerate(self.bodies):
            if body.shape and self.flat(body) and body.motion not in (None, "static"):
                yield ("bodies", i, "motion"), "a plane must be static"
            for key in ("velocity", "angular_velocity") if self.motion_of(body) == "static" else ():
                if np.any(getattr(body, key)):
                    yield ("bodies", i, key), "must be zero: a static body does not move"
            for key in ("collides_with", "avoids"):
                for k, partner in enumerate(getattr(body, key) or []):
                    if partner not in first and partner not in copies and "[" in partner:
                        yield ("bodies", i, key, k), _no_body(partner, copies)
        yield from self._joint_faults()
        yield from self._pose_faults()

    def _pose_faults(self) -> Iterator[Fault]:
        """Faults in frames, keyframes and couplings."""
        kinds = {joint.name: joint.type for joint in self.joints}
        bodies = {name for body in self.bodies for name in body.names()}
        first: dict[str, int] = {}
        for i, frame in enumerate(self.frames):
            if first.setdefault(frame.name, i) != i:
                yield (
                    ("frames", i, "name"),
                    f"two frames are called {frame.name!r} (the first is frames[{first[frame.name]}])",
                )
            if frame.body not in bodies | {WORLD}:
                yield ("frames", i, "body"), _no_body(frame.body, bodies)

        def fits(loc: Loc, name: str, *allowed: str) -> Iterator[Fault]:
            if name not in kinds:
                there = f"; joints are {', '.join([*kinds][:20])}" if kinds else "; the file has no joints"
                yield loc, f"no joint is called {name!r}{nearest(name, kinds) or there}"
            elif kinds[name] not in allowed:
                yield loc, f"must be a {' or '.join(allowed)} (got {name!r}, a {kinds[name]})"

        moving, driven = ("hinge", "slider"), {joint.name for joint in self.joints if joint.motor}
        of = {"angles_deg": moving[:1], "positions": moving[1:], "quats_xyzw": ("ball",), "speeds": moving,
              "spins": ("ball",)}  # fmt: skip
        for key, frame in self.keyframes.items():
            for what, allowed in {**of, "targets": moving}.items():
                for name in getattr(frame, what):
                    yield from fits(("keyframes", key, what, name), name, *allowed)
            for name in frame.targets.keys() & kinds.keys() - driven:
                yield ("keyframes", key, "targets", name), f"joint {name!r} has no motor"
            for name in frame.bodies.keys() - bodies:
                yield ("keyframes", key, "bodies", name), _no_body(name, bodies)
        for i, coupling in enumerate(self.couplings):
            for k, name in enumerate(coupling.joints):
                yield from fits(("couplings", i, "joints", k), name, "hinge", "slider")
            if len({*coupling.joints}) == 1:
                yield ("couplings", i, "joints"), f"{coupling.joints[0]!r} cannot follow itself"

    def _joint_faults(self) -> Iterator[Fault]:
        motion = {name: self.motion_of(body) for body in self.bodies for name in body.names()}
        copies = {body.name: body.copies for body in self.bodies if body.name not in motion}
        first: dict[str, int] = {}
        for i, joint in enumerate(self.joints):
            if first.setdefault(joint.name, i) != i:
                fault = f"two joints are called {joint.name!r} (the first is joints[{first[joint.name]}])"
                yield ("joints", i, "name"), fault
            known = True
            for k, name in enumerate(joint.bodies):
                where, known = ("joints", i, "bodies", k), known and (name in motion or (k == 1 and name == WORLD))
                if name == WORLD and name in motion:
                    yield where, f"a body is called {WORLD!r} too: give it another name"
                elif name == WORLD and k == 0:
                    yield where, f"{WORLD} must be the second: it holds the first"
                elif name in copies:
                    yield where, f"there are {copies[name]} bodies {name!r}: give one, such as {name}[0]"
                elif name not in motion and name != WORLD and "[" in name:
                    yield where, _no_body(name, motion)
            if known and joint.bodies[0] == joint.bodies[1]:
                yield ("joints", i, "bodies"), f"must be two (got {joint.bodies[0]!r} twice)"
            elif known and "dynamic" not in (motion.get(name) for name in joint.bodies):
                yield ("joints", i, "bodies"), "holds nothing: one of the two must be dynamic"

    def flat(self, body: BodyTable) -> bool:
        """Whether a body is a plane."""
        shape = self.shapes.get(body.shape or "")
        return body.plane is not None or (shape is not None and shape.plane is not None)

    def motion_of(self, body: BodyTable) -> Motion:
        """The motion of a body; by default planes are static and other bodies dynamic."""
        return body.motion or ("static" if self.flat(body) else "dynamic")


# A section's tables: its own keys, and those of small tables in it, after the key that holds them.
_SECTIONS: dict[str, dict[str, type[Table]]] = {
    "The file": {"": SceneTable, "effects": EffectsTable},
    "shapes: NAME": {
        "": ShapeTable, "primitive": Primitive, "sphere": Sphere, "capsule": Capsule, "cylinder": Upright, "box": Box,
        "cone": Cone, "torus": Torus, "plane": PlaneShape, "parts[]": PartTable,
    },
    "bodies[]": {"": BodyTable, "plane": Plane, "arrange": Arrange, "path[]": Waypoint},
    "joints[]": {"": JointTable, "spring": SpringTable, "motor": MotorTable, "breaks_at": BreaksTable},
    "frames[], keyframes and couplings[]": {
        "frames[]": FrameTable, "keyframes.NAME": KeyframeTable, "keyframes.NAME.bodies.NAME": Pose,
        "couplings[]": CouplingTable,
    },
}  # fmt: skip


def reference() -> str:
    """docs/scene.md: every key with its unit, what is allowed and its default."""
    lines = [
        "# Every key of scene.yaml",
        "",
        "Lengths are in metres, z is up. Unknown keys, keys that appear twice, NaN and infinity are refused. Paths are "
        "relative to the folder",
        "of the file and must stay inside it, unless you give `--allow-outside`. `python -m sdfsim.scene.schema > "
        "docs/scene.md` writes this page.",
    ]
    for title, tables in _SECTIONS.items():
        lines += ["", f"## {title}", ""]
        said = {name: " ".join((table.__doc__ or "").split()) for name, table in tables.items()}
        lines.append(" ".join(f"`{name}`: {text}" if name else text for name, text in said.items()))
        lines += ["", "| key | what | unit | allowed | default |", "| --- | --- | --- | --- | --- |"]
        lines += [row for name, table in tables.items() for row in _rows(f"{name}." if name else "", table)]
    return "\n".join(lines) + "\n"


def _rows(prefix: str, table: type[Table]) -> Iterator[str]:
    for key, field in table.model_fields.items():
        known = _schema(table, key)
        default = "required" if field.is_required() else known.get("default")
        default = "" if default is None or isinstance(default, dict) else str(default)
        cells = (f"`{prefix}{key}`", known["description"], known["unit"], _allowed(known), default)
        if table is BodyTable or key not in Turned.model_fields:
            yield "| " + " | ".join(cells) + " |"
        elif key == "quat_xyzw":
            yield f"| `{prefix}quat_xyzw`, `quat_wxyz`, `euler_xyz_deg` | orientation, as of a body |  |  |  |"


def _allowed(schema: dict) -> str:
    """The values that a schema allows; bounds that all numbers share are left out."""
    limits = []
    for sign, native, other in ((">", "exclusiveMinimum", "gt"), (">=", "minimum", "ge"), ("<=", "maximum", "le")):
        limit = schema.get(native, schema.get(other, np.inf))
        limits += [f"{sign} {limit:g}"] if abs(limit) < LARGEST else []
    if "maxItems" in schema:
        items = "names" if schema["items"].get("type") == "string" else "numbers"
        return ", each ".join(part for part in (f"{schema['maxItems']} {items}", _allowed(schema["items"])) if part)
    return ", ".join(schema.get("enum", [])) or " and ".join(limits)


if __name__ == "__main__":
    print(reference(), end="")
