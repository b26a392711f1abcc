"""What stages report: written as JSON to `stage.json` and `report.json`, and read back from there."""

from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from pydantic import TypeAdapter

from sdfsim.base.console import plain

T = TypeVar("T")


@dataclass(frozen=True)
class PhotosReport:
    """Of the photos."""

    count: int = 0
    notes: list[str] = field(default_factory=list)
    masks: int = 0  # photos with a mask
    state: int = 0  # of two states of an object: the one, 0 or 1, from which the scene is made


@dataclass(frozen=True)
class Hollow:
    """The hollow of a body in its upright position."""

    depth: float  # m below its rim
    below: float  # m, thickness of the matter below the hollow
    seen: int  # photos that see its bottom: the median over it, by rays
    wall: float | None  # m, the median thickness of the wall around it; None if there is none
    wall_seen: float  # share of the wall, by vertices, of which photos see both sides
    holes: float = 0.0  # share of its bottom that is missing


@dataclass(frozen=True)
class Trust:
    """What photos show of a mesh, as shares of its area."""

    seen_by: list[float]  # by 0, 1, 2, and 3 or more photos
    guessed: float  # by fewer than two photos, or along parallel lines of sight
    uncertainty_m: float | None  # the median of the rest; None if all is guessed


@dataclass(frozen=True)
class Proposal:
    """A photo that would help."""

    position: list[float]  # [3] m of its camera
    looking_at: list[float]  # [3] m
    gain: float  # as a share of the gain of photos from all around
    words: str  # where to stand and where to look


@dataclass(frozen=True)
class MeshReport:
    """Of the surface and the bodies in it."""

    extent_m: list[float] = field(default_factory=list)  # [3] of what photos show
    size: str = ""  # source of the scale
    size_assumed: bool = False
    up_from: str = ""
    up_within_degrees: float = 0.0
    up_confidence: str = ""  # high, medium or low
    objects: list[str] = field(default_factory=list)  # names of the bodies
    smallest_object_m: float = 0.0  # lower pieces stay part of their support
    # names of two bodies, and "masks", "clicks" or "shape", which separated them
    touching: list[tuple[str, str, str]] = field(default_factory=list)
    masks_without_surface: list[str] = field(default_factory=list)  # names
    places_without_surface: list[str] = field(default_factory=list)  # names of clicked bodies
    unrefined: dict[str, str] = field(default_factory=dict)  # by body, why photos did not refine its surface
    # by body, the symmetry that completed what photos do not show, and the share of the surface that it guessed
    symmetries: dict[str, tuple[str, float]] = field(default_factory=dict)
    hollows: dict[str, Hollow] = field(default_factory=dict)  # by body
    left_out_m: list[float] = field(default_factory=list)  # longest sides of pieces
    completed_m2: list[float] = field(default_factory=list)  # areas of level surfaces
    trust: dict[str, Trust] = field(default_factory=dict)  # by mesh
    weak: float | None = None  # weak share of the surface that photos could show
    next_photos: list[Proposal] = field(default_factory=list)  # the best first


@dataclass(frozen=True)
class FitReport:
    """Of the shapes."""

    shapes: dict[str, dict[str, Any]] = field(default_factory=dict)  # certificates by name
    passed: bool = True  # all of them
    reason: str = ""
    caveats: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class BodyReport:
    """Of a body of the scene; density to mass only if it moves."""

    material: str
    friction: float
    restitution: float
    density: float | None = None  # kg/m^3
    wall: float | None = None  # m; None: solid
    volume: float | None = None  # m^3 with mass
    mass: float | None = None  # kg
    weighed: bool = False  # whether the user gave the mass


@dataclass(frozen=True)
class SceneReport:
    """Of the scene file."""

    objects: list[str] = field(default_factory=list)
    bodies: dict[str, BodyReport] = field(default_factory=dict)
    size: str = ""
    moved: dict[str, dict[str, Any]] = field(default_factory=dict)  # bodies that overlapped others
    drop: dict[str, Any] = field(default_factory=dict)  # what falls onto the scene, and where
    notes: list[str] = field(default_factory=list)
    scene_sha256: str = ""  # of the file as written
    joint: str | None = None  # in words


def read(kind: type[T], report: dict[str, Any] | None) -> T:
    """A report from JSON; its defaults if the stage has not run."""
    return TypeAdapter(kind).validate_python(report or {})


def written(report: Any) -> dict[str, Any]:
    """A report, or one that is a dictionary, as JSON types."""
    return plain(report if isinstance(report, dict) else asdict(report))
