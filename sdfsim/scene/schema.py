"""The keys of `scene.yaml`: a checked document becomes plain specifications, nothing loaded yet."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.scene.bodies import BodySpec, read_bodies
from sdfsim.scene.document import Problems, Section, Value, nearest
from sdfsim.scene.source import read_document
from sdfsim.scene.types import Effects, Limits
from sdfsim.shape.shape import DEFAULT_RESOLUTION, MESH_FILE, RECORD_FILE, WEIGHTS_FILE

VERSION = 1
DEFAULT_DURATION = 4.0  # s
DEFAULT_GRAVITY = (0.0, 0.0, -9.81)  # m/s^2
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

_TOP = ("version", "model", "duration", "seed", "gravity", "effects", "limits", "shapes", "bodies")
_SHAPE_KINDS = ("asset", "mesh", "primitive", "sphere", "capsule", "cylinder", "box", "plane")
_SDF_KINDS = ("mlp", "grid", "mesh")
FEWEST_NODES, MOST_NODES = 3, 128  # along each side of the sampling grid
_WITH_SDF = ("asset", "mesh", "primitive")  # the others have an exact SDF of their own
FEWEST_SAMPLES, MOST_SAMPLES = 8, 512  # along each side of a grid
_OUTSIDE_ADVICE = "copy it there, or allow it with --allow-outside, in Python allow_outside=True"
_PLANE_ADVICE = " (a plane shape takes none: tilt it by the body's pose, or give the body its own `plane:`)"


@dataclass
class ShapeSpec:
    """One entry of `shapes`, or the plane of a body.

    Attributes:
        name: its key.
        kind: asset, mesh, primitive, sphere, capsule, cylinder, box or plane.
        place: where faults of it are reported.
        path: of an asset or mesh, resolved against the scene's folder.
        units: metres per unit of the mesh file.
        cap: whether openings of the mesh are closed.
        thicken: m, the thickness that an open sheet gets, or None.
        sdf: mlp, grid or mesh; None where the file does not say (an asset then keeps its own, others are fitted).
        resolution: of a grid, samples along each side.
        nodes: N of the N^3 grid whose points become surface nodes; None keeps the shape's own nodes.
        options: radius, size, or what a primitive takes.
    """

    name: str
    kind: str
    place: Value
    path: Path | None = None
    units: float = 1.0
    cap: bool = False
    thicken: float | None = None
    sdf: str | None = None
    resolution: int = DEFAULT_RESOLUTION
    nodes: int | None = None
    options: dict = field(default_factory=dict)


@dataclass
class SceneSpec:
    """Everything a scene file says."""

    problems: Problems
    model: str | None
    duration: float
    seed: int
    gravity: np.ndarray
    effects: Effects
    limits: Limits
    shapes: dict[str, ShapeSpec | None]
    bodies: list[BodySpec]


@dataclass(frozen=True)
class Home:
    """Where the paths of a scene file start.

    Attributes:
        folder: the file's own.
        allow_outside: whether a path may lead out of it, by `..`, from the root or through a link.
    """

    folder: Path
    allow_outside: bool = False

    def find(self, value: Value) -> Path | None:
        """The place that a value names; None after reporting that it is none, or lies outside."""
        place = self.folder / value.text("?")
        try:
            if not self.allow_outside and not all(p.is_relative_to(self.folder.resolve()) for p in _ends(place)):
                value.wrong(f"leads out of the scene's folder: {place} ({_OUTSIDE_ADVICE})")
                return None
            place.stat()
        except (FileNotFoundError, NotADirectoryError):
            pass  # told in the words of whoever wants it
        except (OSError, RuntimeError, ValueError) as error:  # a loop of links, too long a name, a zero byte
            value.wrong(f"cannot be looked up: {place} ({getattr(error, 'strerror', None) or error})")
            return None
        return place


def _ends(place: Path) -> list[Path]:
    """Where a path leads when every link is followed; of a folder, also where the files of a shape lead."""
    inside = (WEIGHTS_FILE, MESH_FILE, RECORD_FILE) if place.is_dir() else ()
    return [place.resolve(), *((place / name).resolve() for name in inside)]


def read_scene(path: Path, *, allow_outside: bool = False) -> SceneSpec:
    """Read and check a scene file; faults are collected in `problems`, which the caller checks.

    Args:
        path: of the file.
        allow_outside: whether paths in it may lead out of its folder.

    Raises:
        SceneError: at once only when the file is missing or is not YAML.
    """
    root = read_document(path)
    top = root.section(_TOP)
    version = top.get("version")
    if version is None:
        top.missing("version", f"is required (must be {VERSION})")
    elif version.integer(least=1, default=VERSION) != VERSION:
        version.wrong(f"must be {VERSION} (got {version.shown()})")
    model, seed = top.get("model"), top.get("seed")
    home = Home(path.parent, allow_outside)
    shapes = _shapes(top.get("shapes"), home)
    bodies = top.required("bodies")
    return SceneSpec(
        problems=root.problems,
        model=_model(model, home) if model and not model.is_null() else None,
        duration=top.number("duration", "s", above=0, default=DEFAULT_DURATION),
        seed=seed.integer(least=0, default=0) if seed else 0,
        gravity=top.vector("gravity", "m/s^2", DEFAULT_GRAVITY),
        effects=_effects(top.get("effects")),
        limits=_limits(top.get("limits")),
        shapes=shapes,
        bodies=read_bodies(bodies, {name: s.kind if s else None for name, s in shapes.items()}) if bodies else [],
    )


def _model(value: Value, home: Home) -> str:
    """A bundled model's name, or the path of a file, taken from the scene's folder."""
    text = value.text()
    return str(home.find(value)) if text.endswith(".safetensors") else text


def _effects(value: Value | None) -> Effects:
    if value is None or value.is_null():
        return Effects()
    choices: dict[str, tuple[str, ...]] = {
        name: ("auto", "on", "off") for name in ("contact", "friction", "restitution", "rotation", "sleep")
    }
    chosen: dict[str, Any] = {key: item.choice(choices[key], choices[key][0]) for key, item in value.section(choices)}
    return Effects(**chosen)


def _limits(value: Value | None) -> Limits:
    if value is None or value.is_null():
        return Limits()
    section = value.section(("memory_gib",))
    return Limits(section.number("memory_gib", "GiB", above=0, default=1.0) if "memory_gib" in section else None)


def _shapes(value: Value | None, home: Home) -> dict[str, ShapeSpec | None]:
    """Every shape by name; None for one that is faulty, so that references to it are not faults as well."""
    shapes: dict[str, ShapeSpec | None] = {}
    if value is None or value.is_null():
        return shapes
    for name, item in value.section():
        before = len(item.problems)
        spec = _shape(name, item, home)
        shapes[name] = spec if len(item.problems) == before else None
    return shapes


def _shape(name: str, item: Value, home: Home) -> ShapeSpec | None:
    section = item.section((*_SHAPE_KINDS, "units", "cap", "thicken", "sdf", "resolution", "nodes"))
    kind = section.one_of(_SHAPE_KINDS, required=True)
    if kind is None:
        return None
    spec = ShapeSpec(name, kind.path.rsplit(".", 1)[-1], kind)
    if "units" in section:
        spec.units = UNITS[section["units"].choice(UNITS, "m")]
        if spec.kind != "mesh":
            section["units"].wrong(f"goes with mesh only (a shape given by {spec.kind} is in metres)")
    if "cap" in section:
        spec.cap = section["cap"].choice(("on", "off"), "off") == "on"
    if "thicken" in section:
        spec.thicken = section.number("thicken", "m", above=0, default=1.0)
    for key in ("cap", "thicken"):
        if key in section and spec.kind != "mesh":
            section[key].wrong(f"goes with mesh only (a {spec.kind} is closed)")
    _sdf(section, spec)
    if "nodes" in section:
        spec.nodes = section["nodes"].integer(least=FEWEST_NODES, default=FEWEST_NODES)
        if spec.nodes > MOST_NODES:
            section["nodes"].wrong(f"must be <= {MOST_NODES} (got {spec.nodes})")
        if spec.kind == "plane":
            section["nodes"].wrong("goes with bodies only (a plane has no nodes)")
    if spec.kind in ("asset", "mesh"):
        spec.path = home.find(kind)
        if spec.path and spec.kind == "asset" and not spec.path.is_dir():
            kind.wrong(f"no such folder: {spec.path}")
        if spec.path and spec.kind == "mesh" and not spec.path.is_file():
            kind.wrong(f"no such file: {spec.path}")
    elif spec.kind == "primitive":
        spec.options = _primitive(kind)
    elif spec.kind == "sphere":
        sphere = kind.section(["radius"])
        sphere.required("radius")
        spec.options = {"radius": sphere.number("radius", "m", above=0, default=1.0)}
    elif spec.kind in ("capsule", "cylinder"):
        spec.options = _upright(kind, spec.kind)
    elif spec.kind == "box":
        size = kind.section(["size"]).required("size")
        spec.options = {"size": _positive(size) if size else np.ones(3)}
    elif not kind.is_null():
        kind.section((), advice=_PLANE_ADVICE)
    return spec


def _upright(item: Value, kind: str) -> dict[str, float]:
    """`capsule: {radius: 0.1, height: 0.5}`, along z."""
    section = item.section(["radius", "height"])
    for key in ("radius", "height"):
        section.required(key)
    found = {key: section.number(key, "m", above=0, default=1.0) for key in ("radius", "height")}
    if kind == "capsule" and "height" in section and "radius" in section and found["height"] <= 2 * found["radius"]:
        section["height"].wrong(f"must be above twice the radius, its caps included (got {found['height']:g} m)")
    return found


def _sdf(section: Section, spec: ShapeSpec) -> None:
    """`sdf: grid` and `resolution: 64`: where the distances of a mesh come from."""
    if "sdf" in section:
        # A word that is no kind is a fault already; as a grid it makes none of its resolution.
        spec.sdf = section["sdf"].choice(_SDF_KINDS, "grid")
        if spec.kind not in _WITH_SDF:
            section["sdf"].wrong(f"goes with {', '.join(_WITH_SDF)} only (a {spec.kind} has its exact SDF)")
    if "resolution" in section:
        value = section["resolution"]
        spec.resolution = value.integer(least=FEWEST_SAMPLES, default=DEFAULT_RESOLUTION)
        if spec.resolution > MOST_SAMPLES:
            value.wrong(f"must be <= {MOST_SAMPLES} (got {spec.resolution})")
        if spec.sdf != "grid":
            value.wrong("goes with sdf: grid only")


def _primitive(value: Value) -> dict:
    """`{name: torus, size: 0.2}`: a procedural shape with its largest extent in metres."""
    from sdfsim.shape.primitives import PRIMITIVES

    section = value.section(("name", "size"))
    name = section.required("name")
    chosen = name.text() if name else ""
    if name and chosen not in PRIMITIVES:
        name.wrong(f"no such primitive: {chosen!r}{nearest(chosen, PRIMITIVES)}; there are {', '.join(PRIMITIVES)}")
    return {"name": chosen, "size": section.number("size", "m", above=0, default=1.0)}


def _positive(value: Value) -> np.ndarray:
    size = value.vector(3, "m", default=(1, 1, 1))
    for item, number in zip(value.items() if value.is_list() else [], size, strict=False):
        if number <= 0:
            item.wrong(f"must be > 0 (got {number:g} m)")
    return size
