"""scene.yaml: its keys (pydantic models), its YAML with line numbers, and `load_scene`.

`python -m sdfsim.scene.scene_file` writes docs/scene.md, the reference of every key.
"""

from __future__ import annotations

import errno
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
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

from sdfsim.base.errors import SceneError, SdfsimError, nearest
from sdfsim.base.parallel import Progress, silent
from sdfsim.geometry.primitives import PRIMITIVES
from sdfsim.scene.scene import Body, Effects, Limits, Motion, Scene, Switch, Waypoints
from sdfsim.shape.make import analytic_shape, shape_from_mesh, shape_from_primitive
from sdfsim.shape.shape import (
    DEFAULT_RESOLUTION,
    MESH_FILE,
    RECORD_FILE,
    SKIN_FILE,
    WEIGHTS_FILE,
    SdfKind,
    Shape,
    load_shape,
    with_nodes,
    with_sdf,
    with_wall,
)

VERSION = 1
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
DEFAULT_DURATION = 4.0  # s
DEFAULT_GRAVITY = (0.0, 0.0, -9.81)  # m/s^2
MOST_COPIES = 100_000
MOST_BYTES = 16 * 2**20  # of a file
MOST_VALUES = 500_000  # of a file, each as often as an alias repeats it
LARGEST = 1e12  # of any number: beyond it powers and products of what is legal are no longer finite
_SHOWN = 40  # letters of a value in a message
_LEVELS = 8  # no key lies deeper
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_NULL = ("", "~", "null", "Null", "NULL")
_PLAIN_TAGS = {f"tag:yaml.org,2002:{t}" for t in ("str int float bool null map seq timestamp merge value".split())}

Loc = tuple[str | int, ...]  # keys and indices that lead to a value
Fault = tuple[Loc, str]  # where below a table, and what is wrong there


class Numeral(str):
    """A number without quotes, as the file writes it. YAML 1.1 guesses: `1:30` would become 90, and `1e-3` a text."""


NOTHING = object()  # what a key has that is followed by nothing, `~` or `null`


def _shown(value: Any) -> str:
    """What the file says, for a message."""
    if isinstance(value, str):
        text = str(value) if isinstance(value, Numeral) else repr(value)
        return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
    return "nothing" if value is NOTHING else "a list" if isinstance(value, list) else "a mapping"


def _problem(text: str) -> PydanticCustomError:
    return PydanticCustomError("value", "{text}", {"text": text})


def _told(error: Any, table: type[Table]) -> str:
    """What pydantic found in a table, in our words."""
    kind, known = error["type"], table.model_fields
    if kind == "value":
        return error["msg"]
    if kind == "missing":
        return "is required"
    key = error["loc"][0]
    if kind == "extra_forbidden":
        return f"unknown key{nearest(key, known) or '; known here: ' + (', '.join(known) or 'none')}"
    extra, limits = known[key].json_schema_extra, error.get("ctx", {})
    unit = extra.get("unit", "") if isinstance(extra, dict) else ""
    got, allowed = _shown(error["input"]), limits.get("expected", "").replace("'", "").replace(" or ", ", ")
    if kind.startswith("int_"):
        return f"must be a whole number (got {got})"
    texts = {
        "number": f"must be a number{unit and ' in '}{unit} (got {got})",
        "greater_than": f"must be > {limits.get('gt', 0):g} (got {got}{unit and ' '}{unit})",
        "greater_than_equal": f"must be >= {limits.get('ge', 0):g} (got {got}{unit and ' '}{unit})",
        "less_than_equal": f"must be <= {limits.get('le', 0):g} (got {got}{unit and ' '}{unit})",
        "too_short": f"must have a length of at least {limits.get('min_length')} (got {limits.get('actual_length')})",
        "too_long": f"must have a length of at most {limits.get('max_length')} (got {limits.get('actual_length')})",
        "literal_error": f"must be one of {allowed} (got {got})",
        "list_type": f"must be a list (got {got})",
        "dict_type": f"must be a mapping (got {got})",
    }
    return texts.get(kind, f"must be a text (got {got})")


def _numeral(value: Any) -> Any:
    if not isinstance(value, Numeral):
        raise PydanticCustomError("number", "not a number")
    return value


def _unit(values: list[float]) -> np.ndarray:
    """A direction, made one long."""
    largest = np.abs(values).max()
    if largest < 1e-9:
        raise _problem("must not be zero")
    made = np.array(values) / largest  # first, so that the length of huge numbers does not overflow
    return made / np.linalg.norm(made)


def _partners(value: Any, handler: Callable[[Any], list[str]]) -> list[str] | None:
    if not isinstance(value, list) and value != "all":
        raise _problem(f"must be all, or a list of names (got {_shown(value)})")
    return None if value == "all" else handler(value)


def _find(text: str, info: ValidationInfo) -> Path:
    """The place that a path of the file names, whether something is there or not."""
    context: Any = info.context
    home: Path = context["folder"]
    place = home / text
    try:
        # Where it leads when every link is followed; of a folder, also where the files of a shape lead.
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
    """An `asset` is a folder, a `mesh` a file."""
    place, what = _find(text, info), "folder" if info.field_name == "asset" else "file"
    if not (place.is_dir() if what == "folder" else place.is_file()):
        raise _problem(f"no such {what}: {place}")
    return str(place)


def _model(text: str, info: ValidationInfo) -> str:
    """A bundled model's name, or the path of a file, taken from the scene's folder."""
    return str(_find(text, info)) if text.endswith(".safetensors") else text


def _primitive(name: str) -> str:
    if name not in PRIMITIVES:
        raise _problem(f"no such primitive: {name!r}{nearest(name, PRIMITIVES)}; there are {', '.join(PRIMITIVES)}")
    return name


def _version(number: int) -> int:
    if number != VERSION:
        raise _problem(f"must be {VERSION} (got {number})")
    return number


def key(what: str, default: Any = ..., unit: str = "", **limits: float) -> Any:
    """A key of a table: what it says, its unit, and what is allowed."""
    return Field(default, description=what, json_schema_extra={"unit": unit}, **limits)  # type: ignore[arg-type]


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
            found += [(e["loc"], _told(e, cls)) for e in error.errors(include_url=False)]
        if found:
            details = [InitErrorDetails(type=_problem(text), loc=loc, input=None) for loc, text in found]
            raise ValidationError.from_exception_data(cls.__name__, details)
        return made

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        """Which keys go together; asked of what the file says, whether its values are right or not."""
        yield from ()

    def check_values(self) -> Iterator[Fault]:
        """Which values go together; asked once each is right by itself."""
        yield from ()


def _one_of(data: dict, keys: Iterable[str], *, required: bool = False) -> Iterator[Fault]:
    there = [key for key in data if key in keys]
    if len(there) > 1:
        yield (there[1],), f"give only one of {', '.join(keys)} (got {' and '.join(there)})"
    if not there and required:
        yield (), f"one of {', '.join(keys)} is required"


class EffectsTable(Table):
    """Which effects to compute; `auto` is on where it can change the motion, as `sdfsim plan` tells."""

    contact: Switch = key("bodies touch", "auto")
    friction: Switch = key("contacts hold sideways", "auto")
    restitution: Switch = key("contacts rebound", "auto")
    rotation: Switch = key("bodies turn", "auto")
    sleep: Switch = key("what rests is frozen until something disturbs it", "auto")


class LimitsTable(Table):
    """What a run must keep to."""

    memory_gib: Number | None = key(
        "memory that one step may take for distances and edges; no limit without it", None, "GiB", gt=0
    )


class Primitive(Table):
    """A procedural shape."""

    name: Annotated[Text, AfterValidator(_primitive)] = key(f"one of {', '.join(PRIMITIVES)}")
    size: Number = key("largest extent", 1.0, "m", gt=0)


class Sphere(Table):
    """An exact sphere about the origin."""

    radius: Number = key("radius", unit="m", gt=0)


class Upright(Table):
    """An exact capsule or cylinder along z, about the origin."""

    radius: Number = key("radius", unit="m", gt=0)
    height: Number = key("along z; of a capsule with its caps, so above twice the radius", unit="m", gt=0)


class Box(Table):
    """An exact box about the origin."""

    size: Annotated[list[Annotated[Number, Field(gt=0)]], _THREE] = key("extents along x, y, z", unit="m")


class PlaneShape(Table):
    """z = 0, infinite. It takes no keys: tilt it by the body's pose, or give the body its own `plane`."""


_KINDS = ("asset", "mesh", "primitive", "sphere", "capsule", "cylinder", "box", "plane")
_FITTED = ("mesh", "primitive")  # made on first use, which may take a minute
_WITH_SDF = ("asset", *_FITTED)  # the others have an exact SDF of their own


class ShapeTable(Table):
    """One shape: exactly one of `asset` to `plane`, and how its distances and surface nodes are made."""

    asset: Annotated[Text, AfterValidator(_there)] | None = key(
        "folder that `reconstruct` or `fit` has written, from the scene's folder", None
    )
    mesh: Annotated[Text, AfterValidator(_there)] | None = key(
        "mesh file, from the scene's folder; fitted on first use, then taken from a cache", None
    )
    primitive: Primitive | None = key("a procedural shape, fitted on first use", None)
    sphere: Sphere | None = key("an exact sphere", None)
    capsule: Upright | None = key("an exact capsule", None)
    cylinder: Upright | None = key("an exact cylinder", None)
    box: Box | None = key("an exact box", None)
    plane: PlaneShape | None = key("an infinite plane", None)
    units: Literal["m", "cm", "mm", "in"] = key("of the numbers in a mesh file", "m")
    cap: Literal["on", "off"] = key("close the openings of a mesh", "off")
    thicken: Number | None = key("thickness that an open sheet of a mesh gets", None, "m", gt=0)
    sdf: SdfKind | None = key(
        "where distances come from: a fitted network, samples on a grid, or the mesh itself; without it "
        "an asset keeps its own and others are fitted",
        None,
    )
    resolution: Whole = key("samples along each side, with `sdf: grid`", DEFAULT_RESOLUTION, ge=8, le=512)
    nodes: Whole | None = key(
        "N of the N^3 grid whose points become surface nodes; without it a shape keeps its own", None, ge=3, le=128
    )
    wall: Number | None = key(
        "makes the shape hollow: only what lies within this of its surface has mass", None, "m", gt=0
    )

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        yield from _one_of(data, _KINDS, required=True)
        kind = next((key for key in data if key in _KINDS), None)
        for key in ("units", "cap", "thicken"):
            if key in data and kind not in ("mesh", None):
                yield (key,), f"goes with mesh only (this is a {kind})"
        if "sdf" in data and kind not in (*_WITH_SDF, None):
            yield ("sdf",), f"goes with {', '.join(_WITH_SDF)} only (a {kind} has its exact SDF)"
        if "resolution" in data and data.get("sdf") in (None, "mlp", "mesh"):
            yield ("resolution",), "goes with sdf: grid only"
        for key in ("nodes", "wall"):
            if key in data and kind == "plane":
                yield (key,), "goes with bodies only (a plane has no nodes and no mass)"

    def check_values(self) -> Iterator[Fault]:
        if self.capsule and self.capsule.height <= 2 * self.capsule.radius:
            got = f"(got {self.capsule.height:g} m)"
            yield ("capsule", "height"), f"must be above twice the radius, its caps included {got}"

    @property
    def kind(self) -> str:
        """The one of `_KINDS` that is given."""
        return next(kind for kind in _KINDS if getattr(self, kind) is not None)


_ROTATIONS = ("quat_xyzw", "quat_wxyz", "euler_xyz_deg")


class Turned(Table):
    """What has an orientation, given by at most one of three keys."""

    quat_xyzw: Quaternion | None = key("orientation as a quaternion, scalar last; of any length", None)
    quat_wxyz: Quaternion | None = key("the same with its scalar first", None)
    euler_xyz_deg: Vector | None = key("the same as turns about the fixed x, then y, then z", None, "degrees")

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


class Waypoint(Turned):
    """One pose of a path. In between a body goes straight and turns evenly; before and after it rests."""

    time: Number = key("when; later than the pose before it", unit="s", ge=0)
    position: Vector = key("of the shape's own origin", unit="m")


class Plane(Table):
    """The points x with normal . x = offset, of a body without a shape."""

    normal: Direction = key("the direction it faces; of any length", (0.0, 0.0, 1.0))
    offset: Number = key("distance from the origin along the normal", 0.0, "m")

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position [3] m and quaternion [4] xyzw that carry z = 0 onto the plane."""
        normal = np.array(self.normal)
        # The shortest turn from z; straight down has none of its own, so turn about x.
        quat = np.array([-normal[1], normal[0], 0.0, 1.0 + normal[2]])
        quat = np.array([1.0, 0.0, 0.0, 0.0]) if np.linalg.norm(quat) < 1e-9 else quat / np.linalg.norm(quat)
        return normal * self.offset, quat


class Arrange(Table):
    """Copies on a grid, centred on the position in x and y, its lowest layer at the position."""

    grid: Annotated[list[Annotated[Whole, Field(ge=1)]], _THREE] = key("copies along x, y, z")
    spacing: Number = key("from one to the next", unit="m", gt=0)


_NOT_WITH_PATH = ("position", *_ROTATIONS, "velocity", "angular_velocity", "mass", "density")
_NOT_WITH_PLANE = ("shape", "scale", *_NOT_WITH_PATH, "count", "arrange")
_ORIGIN = (0.0, 0.0, 0.0)


class BodyTable(Turned):
    """One body, or many copies of it: either a `shape` or a `plane` of its own."""

    name: Text = key("unique; copies are called name[0], name[1], ...")
    shape: Text | None = key("a name under `shapes`", None)
    plane: Plane | None = key("makes it an infinite static plane", None)
    motion: Motion | None = key(
        "kinematic bodies follow their `path`, whatever they meet; dynamic without it, planes static", None
    )
    path: Annotated[list[Waypoint], Field(min_length=1)] | None = key("poses of a kinematic body", None)
    scale: Number = key("factor on the size of the shape", 1.0, gt=0)
    position: Vector = key("of the shape's own origin", _ORIGIN, "m")
    velocity: Vector = key("of the centre of mass", _ORIGIN, "m/s")
    angular_velocity: Vector = key("in world axes", _ORIGIN, "rad/s")
    mass: Number | None = key("without it the density counts", None, "kg", gt=0)
    density: Number = key("not together with mass", 1000.0, "kg/m^3", gt=0)
    friction: Number = key("Coulomb coefficient; two bodies' product counts", 0.5, ge=0, le=1000)
    restitution: Number = key("two bodies' product counts", 0.5, ge=0, le=1)
    collides_with: Annotated[list[Text] | None, WrapValidator(_partners)] = key(
        "`all`, or a list of names: two bodies touch where each lists the other", None
    )
    count: Whole | None = key("how many copies; without it, as many as the grid has places", None, ge=1)
    arrange: Arrange | None = key("where the copies are", None)

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        for key in _NOT_WITH_PLANE if "plane" in data else ():
            if key in data:
                yield (key,), "does not go with plane: a plane is static and has its pose from normal and offset"
        if "plane" in data and data.get("motion", "static") != "static":
            yield ("motion",), "a plane must be static"
        if "plane" not in data:
            yield from _one_of(data, ("shape", "plane"), required=True)
            yield from super().check_keys(data)
            yield from _one_of(data, ("mass", "density"))
        if data.get("motion") == "kinematic":
            for key in _NOT_WITH_PATH:
                if key in data:
                    yield (key,), "does not go with motion: kinematic: its path says where it is"
            if "path" not in data:
                yield ("path",), "is required: a kinematic body follows timed poses"
        elif "path" in data:
            yield ("path",), "goes with motion: kinematic only"

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
        """Of the grid, or the one of a body alone."""
        return 1 if self.arrange is None else math.prod(self.arrange.grid)

    @property
    def copies(self) -> int:
        """How many bodies it stands for."""
        return self.count or self.places

    def names(self) -> list[str]:
        """`balls[0]`, `balls[1]` ... where there is a count or a grid, be it of one; else its own name."""
        grouped = self.count is not None or self.arrange is not None
        return [f"{self.name}[{i}]" for i in range(self.copies)] if grouped else [self.name]

    def offsets(self) -> np.ndarray:
        """[copies, 3] m, added to the position."""
        if self.arrange is None:
            return np.zeros((1, 3))
        nx, ny, _ = self.arrange.grid
        index = np.arange(self.copies)
        cells = np.stack([index % nx, index // nx % ny, index // (nx * ny)], axis=1).astype(np.float64)
        return (cells - [(nx - 1) / 2, (ny - 1) / 2, 0.0]) * self.arrange.spacing


class SceneTable(Table):
    """The whole file."""

    version: Annotated[Whole, AfterValidator(_version)] = key(f"always {VERSION}")
    model: Annotated[Text, AfterValidator(_model)] | None = key(
        "bundled model, or a .safetensors file in the scene's folder; it owns its time step", None
    )
    duration: Number = key("simulated time", DEFAULT_DURATION, "s", gt=0)
    seed: Whole = key("of the run's random numbers", 0, ge=0)
    gravity: Vector = key("pull on every free body", DEFAULT_GRAVITY, "m/s^2")
    effects: EffectsTable = key("which effects to compute", EffectsTable())
    limits: LimitsTable = key("what a run must keep to", LimitsTable())
    shapes: dict[str, ShapeTable] = key("shapes by name", {})
    bodies: Annotated[list[BodyTable], Field(min_length=1)] = key("all bodies")

    @classmethod
    def check_keys(cls, data: dict) -> Iterator[Fault]:
        shapes = data["shapes"] if isinstance(data.get("shapes"), dict) else {}
        listed = data["bodies"] if isinstance(data.get("bodies"), list) else []
        first: dict[str, int] = {}
        for i, entry in enumerate(listed):
            said = [entry.get(key) for key in ("name", "shape")] if isinstance(entry, dict) else ["", ""]
            name, shape = (text if isinstance(text, str) else "" for text in said)  # else a fault of its own
            if name.strip() and first.setdefault(name, i) != i:
                yield ("bodies", i, "name"), f"two bodies are called {name!r} (the first is bodies[{first[name]}])"
            if shape.strip() and shape not in shapes:
                there = f"; shapes are {', '.join([*shapes][:20])}" if shapes else "; the file has no shapes"
                yield ("bodies", i, "shape"), f"no shape is called {shape!r}{nearest(shape, shapes) or there}"

    def check_values(self) -> Iterator[Fault]:
        first = {body.name: i for i, body in enumerate(self.bodies)}
        for i, copies in enumerate(itertools.accumulate(body.copies for body in self.bodies)):
            if copies > MOST_COPIES:
                yield ("bodies", i), f"one too many: a scene has at most {MOST_COPIES} bodies, copies included"
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
            for k, partner in enumerate(body.collides_with or []):
                if partner not in first and partner not in copies:
                    yield ("bodies", i, "collides_with", k), f"no body is called {partner!r}{nearest(partner, first)}"

    def flat(self, body: BodyTable) -> bool:
        """Whether it is a plane."""
        shape = self.shapes.get(body.shape or "")
        return body.plane is not None or (shape is not None and shape.plane is not None)

    def motion_of(self, body: BodyTable) -> Motion:
        """As it says, else static for planes and dynamic for others."""
        return body.motion or ("static" if self.flat(body) else "dynamic")


class Document:
    """The YAML of a file, and the faults found in it, each with its line.

    `data` are dicts, lists, texts and `Numeral`s; `NOTHING` where a key has no value. Raises SceneError where the file
    is missing, too large, not UTF-8, not YAML (with the line), or empty, or its aliases multiply it.
    """

    def __init__(self, path: Path, text: str | None = None) -> None:
        self._path = path
        self._line: dict[Loc, int] = {}  # of every key, and of every entry of a list
        self._found: dict[tuple[int, str], None] = {}  # in the order of the finding, each once
        root = _compose(path, _text_of(path) if text is None else text)
        self.data = self._read(root, (), root.start_mark.line + 1)

    def wrong(self, loc: Loc, text: str, line: int | None = None) -> None:
        """Note a fault of the value under `loc`, in its line or another."""
        if line is None:
            line = next(self._line[loc[:depth]] for depth in range(len(loc), -1, -1) if loc[:depth] in self._line)
        where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)[1:200]
        self._found[line, f"{self._path}:{line}: {where}: {text}" if loc else f"{self._path}:{line}: {text}"] = None

    def check(self) -> None:
        """Raise SceneError with every fault, in the order of the file, if there is any."""
        if self._found:
            raise SceneError([text for _, text in sorted(self._found, key=lambda entry: entry[0])])

    def _read(self, node: yaml.Node, loc: Loc, line: int) -> Any:
        self._line[loc] = line
        if len(self._line) > MOST_VALUES:
            raise SceneError([f"{self._path}:1: with its aliases it has more than {MOST_VALUES} values"])
        if node.tag not in _PLAIN_TAGS:
            self.wrong(loc, f"must be plain YAML without tags (got {node.tag!r})")
        if len(loc) > _LEVELS:
            return "..."
        if isinstance(node, yaml.SequenceNode):
            return [self._read(child, (*loc, i), child.start_mark.line + 1) for i, child in enumerate(node.value)]
        if isinstance(node, yaml.ScalarNode):
            if node.style is not None:
                return node.value
            return NOTHING if node.value in _NULL else (Numeral if _NUMBER.fullmatch(node.value) else str)(node.value)
        found: dict[str, Any] = {}
        for key_node, child in node.value:
            key, line = key_node.value, key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag not in _PLAIN_TAGS:
                self.wrong(loc, "a key must be a text without tags", line)
            elif key in found:
                self.wrong((*loc, key), f"the key appears twice (first on line {self._line[*loc, key]})", line)
            else:
                found[key] = self._read(child, (*loc, key), line)
        return found


def _text_of(path: Path) -> str:
    try:
        if path.exists() and not path.is_dir() and not path.is_file():
            raise OSError(errno.EINVAL, "not a file")  # a device or a pipe may have no end
        if path.is_file() and path.stat().st_size > MOST_BYTES:
            raise SceneError([f"{path}: too large for a scene (at most {MOST_BYTES // 2**20} MiB)"])
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
        raise SceneError([f"{path}: {why}"], "give the path of a scene.yaml") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError([f"{path}:{line}: not a text in UTF-8"], "a scene is a YAML text file") from error


def _compose(path: Path, text: str) -> yaml.Node:
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as error:
        mark, place = getattr(error, "problem_mark", None), getattr(error, "position", None)
        line = mark.line + 1 if mark else text[:place].count("\n") + 1 if place is not None else 1
        why = next((told for name in ("problem", "context", "reason") if (told := getattr(error, name, None))), "")
        raise SceneError([f"{path}:{line}: not valid YAML: {why or type(error).__name__}"]) from error
    if root is None:
        raise SceneError([f"{path}:1: the file is empty"], "a scene needs at least version and bodies")
    return root


def read_scene(path: Path, *, allow_outside: bool = False, text: str | None = None) -> tuple[SceneTable, Document]:
    """Read and check a scene file; nothing is loaded yet. Returns what it says, and its document, to tell of faults
    that show only later. Raises SceneError with every fault found."""
    document, context = Document(path, text), {"folder": path.parent, "allow_outside": allow_outside}
    try:
        table = SceneTable.model_validate(document.data, context=context)
    except ValidationError as error:
        for e in error.errors(include_url=False):
            document.wrong(e["loc"], e["msg"])
        document.check()
        raise
    document.check()
    return table, document


def load_scene(
    path: Path | str, on_progress: Progress = silent, *, allow_outside: bool = False, text: str | None = None
) -> Scene:
    """Read a scene file, and load or fit the shapes that its bodies use; the scene is in SI units.

    Paths inside the file are taken from its folder; unless `allow_outside`, they may not lead out of it. `text` is what
    is in the file, where it is not written yet. Raises SceneError with one line `FILE:LINE: FIELD: what is wrong` for
    every fault found.
    """
    path = Path(path)
    table, document = read_scene(path, allow_outside=allow_outside, text=text)
    shapes = _load_shapes(table, document, on_progress)
    order = {key: i for i, key in enumerate(shapes)}
    groups = {body.name: body.names() for body in table.bodies}
    bodies: list[Body] = []
    for i, entry in enumerate(table.bodies):
        made = _body(entry, order[entry.shape], table.motion_of(entry), groups)
        if made.motion == "dynamic":
            made = replace(made, mass=_mass(entry, shapes[entry.shape], partial(document.wrong, ("bodies", i, "name"))))
        for name, offset in zip(entry.names(), entry.offsets(), strict=True):
            way = made.path and replace(made.path, position=made.path.position + offset)
            bodies.append(replace(made, name=name, position=made.position + offset, path=way))
    document.check()
    loaded = [(of, shapes[key]) for key, of in table.shapes.items() if key in shapes]
    fitted = [shape for of, shape in loaded if of.kind in _FITTED or of.sdf == "grid"]
    return Scene(
        shapes=tuple(shapes.values()),
        bodies=tuple(bodies),
        gravity=np.array(table.gravity),
        duration=table.duration,
        seed=table.seed,
        model=table.model,
        effects=Effects(**dict(table.effects)),
        limits=Limits(**dict(table.limits)),
        path=path,
        missed=tuple(f"{s.name}: {s.certificate['reason']}" for s in fitted if s.certificate.get("reason")),
        notes=tuple(f"{s.name}: {note}" for of, s in loaded if of.mesh for note in s.source.get("notes", [])),
        caveats=tuple(f"{s.name}: {s.certificate['caveat']}" for s in fitted if s.certificate.get("caveat")),
    )


def _load_shapes(table: SceneTable, document: Document, on_progress: Progress) -> dict[str | None, Shape]:
    """Every shape in use, in the order of first use; None is the plane that all bodies with a `plane` share. What must
    be fitted or sampled waits until all else is known to be right: a fit takes a minute."""
    used = dict.fromkeys(body.shape for body in table.bodies)
    shapes: dict[str | None, Shape] = {None: analytic_shape("plane", name="plane")}
    slow = {key: s.kind in _FITTED or s.sdf == "grid" for key, s in table.shapes.items()}
    for now in (False, True):
        todo = [key for key in used if key is not None and slow[key] is now]
        for i, key in enumerate(todo):

            def report(fraction: float, message: str, i: int = i, count: int = len(todo)) -> None:
                on_progress((i + fraction) / count, message)

            try:
                shapes[key] = _load_shape(key, table.shapes[key], silent if on_progress is silent else report)
            except SdfsimError as error:
                hint = f" ({error.hint})" if error.hint else ""
                document.wrong(("shapes", key, table.shapes[key].kind), error.message + hint)
        document.check()
    return {key: shapes[key] for key in used}


def _load_shape(name: str, entry: ShapeTable, on_progress: Progress) -> Shape:
    kind: Any = entry.kind
    made: Any = {"sdf": entry.sdf or "mlp", "resolution": entry.resolution, "on_progress": on_progress, "name": name}
    if entry.asset:
        shape = load_shape(entry.asset)
        shape = with_sdf(shape, entry.sdf, resolution=entry.resolution) if entry.sdf else shape
    elif entry.mesh:
        units = UNITS[entry.units] if "units" in entry.model_fields_set else None
        made |= {"units": units, "cap": entry.cap == "on", "thicken": entry.thicken}
        shape = shape_from_mesh(entry.mesh, **made)
    elif entry.primitive:
        shape = shape_from_primitive(entry.primitive.name, entry.primitive.size, **made)
    else:
        shape = analytic_shape(kind, name=name, **dict(getattr(entry, kind)))
    shape = with_wall(shape, entry.wall) if entry.wall else shape
    return with_nodes(shape, entry.nodes) if entry.nodes else shape


def _body(entry: BodyTable, shape: int, motion: Motion, groups: dict[str, list[str]]) -> Body:
    """The first copy, without its mass."""
    partners, path = entry.collides_with, None
    position, quat = (np.array(entry.position), entry.rotation()) if entry.plane is None else entry.plane.pose()
    if entry.path:
        times, places, turns = zip(*((p.time, p.position, p.rotation()) for p in entry.path), strict=True)
        path = Waypoints(np.array(times), np.stack(places), np.stack(turns))
        position, quat = path.position[0], path.quat_xyzw[0]
    return Body(
        name=entry.name,
        shape=shape,
        motion=motion,
        scale=entry.scale,
        position=position,
        quat_xyzw=quat,
        velocity=np.array(entry.velocity),
        angular_velocity=np.array(entry.angular_velocity),
        mass=0.0,
        friction=entry.friction,
        restitution=entry.restitution,
        collides_with=None if partners is None else tuple(n for p in partners for n in groups.get(p, [p])),
        path=path,
    )


def _mass(entry: BodyTable, shape: Shape, wrong: Callable[[str], None]) -> float:
    """Of a dynamic body, kg; tells `wrong` why it cannot move, if so."""
    volume = shape.volume * entry.scale**3
    mass = entry.density * volume if entry.mass is None else entry.mass
    if not (np.isfinite(volume) and volume > 0):
        wrong(f"cannot move: its shape has a volume of {volume:g} m^3; close it, or make it static")
    elif not (np.isfinite(mass) and mass > 0):
        wrong(f"has no usable mass: density {entry.density:g} kg/m^3 times a volume of {volume:g} m^3; give mass in kg")
    elif not len(shape.nodes):
        wrong("cannot move: its shape has no surface nodes to touch others with; make it static")
    return mass


_SECTIONS: dict[str, type[Table]] = {
    "The file": SceneTable,
    "effects": EffectsTable,
    "limits": LimitsTable,
    "shapes: NAME": ShapeTable,
    "shapes: NAME: primitive": Primitive,
    "shapes: NAME: sphere": Sphere,
    "shapes: NAME: capsule, cylinder": Upright,
    "shapes: NAME: box": Box,
    "shapes: NAME: plane": PlaneShape,
    "bodies[]": BodyTable,
    "bodies[]: plane": Plane,
    "bodies[]: arrange": Arrange,
    "bodies[]: path[]": Waypoint,
}


def reference() -> str:
    """docs/scene.md: every key with its unit, what is allowed and its default."""
    lines = [
        "# Every key of scene.yaml",
        "",
        "Lengths are in metres, z is up. Unknown keys, keys that appear twice, NaN and infinity are refused.",
        "`python -m sdfsim.scene.scene_file > docs/scene.md` writes this page.",
    ]
    for title, table in _SECTIONS.items():
        schema = table.model_json_schema().get("properties", {})
        lines += ["", f"## {title}", "", table.__doc__ or ""]
        lines += ["", "| key | what | unit | allowed | default |", "| --- | --- | --- | --- | --- |"] if schema else []
        for key, field in table.model_fields.items():
            told = {**next(iter(schema[key].get("anyOf", [])), {}), **schema[key]}
            default = "required" if field.is_required() else told.get("default")
            default = "" if default is None or isinstance(default, dict) else str(default)
            cells = (f"`{key}`", told["description"], told["unit"], _allowed(told), default)
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _allowed(schema: dict) -> str:
    """The values that a schema allows; bounds that every number has are not told."""
    limits = []
    for sign, native, other in ((">", "exclusiveMinimum", "gt"), (">=", "minimum", "ge"), ("<=", "maximum", "le")):
        limit = schema.get(native, schema.get(other, np.inf))
        limits += [f"{sign} {limit:g}"] if abs(limit) < LARGEST else []
    if "maxItems" in schema:
        return ", each ".join(part for part in (f"{schema['maxItems']} numbers", _allowed(schema["items"])) if part)
    return ", ".join(schema.get("enum", [])) or " and ".join(limits)


if __name__ == "__main__":
    print(reference(), end="")
