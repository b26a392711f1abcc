"""Normalised space -> metres with z up: which way gravity points, how large the scene is, where its floor lies."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import ExifTags

from pipeline.cameras import View
from pipeline.inputs.images import opened
from pipeline.inputs.photos import Photo
from pipeline.mesh.cleaning import face_normals
from pipeline.mesh.visibility import Caster
from pipeline.options import Known
from pipeline.sfm.supervision import camera_up, plane_up
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json
from sdfsim.shape.mesh import Mesh


@dataclass(frozen=True)
class Placement:
    """x -> scale * R x + t.

    Attributes:
        scale: metres a normalised unit.
        rotation: [3, 3]; its last row is up in normalised space.
        translation: [3] m.
        up_from: "plane" or "cameras".
        size_from: where the scale comes from, in words.
        floor: z of the plane that things rest on when they leave the scene, m.
        up_within: degrees within which up can be trusted.
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    up_from: str
    size_from: str
    floor: float = 0.0
    up_within: float = 0.0

    @property
    def up_confidence(self) -> str:
        """high, medium or low: whether a ball would roll off a level table for a wrong gravity alone."""
        return next((word for word, most in CONFIDENT.items() if self.up_within <= most), "low")

    def points(self, points: np.ndarray) -> np.ndarray:
        """Normalised points [P, 3] -> metres."""
        return self.scale * points @ self.rotation.T + self.translation

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh moved to metres."""
        return Mesh(self.points(mesh.vertices), mesh.faces, mesh.colors)

    def view(self, view: View) -> View:
        """A camera moved to metres."""
        return view.transformed(self.scale, self.rotation, self.translation)

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {**asdict(self), "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    @staticmethod
    def from_dict(data: dict) -> Placement:
        """The inverse of `to_dict`."""
        return Placement(
            **{**data, "rotation": np.array(data["rotation"]), "translation": np.array(data["translation"])}
        )


@dataclass(frozen=True)
class Up:
    """Which way is up, in normalised space.

    Attributes:
        direction: [3] unit.
        source: "plane" or "cameras".
        within: degrees within which it can be trusted.
    """

    direction: np.ndarray
    source: str
    within: float


# Degrees up to which gravity is known well, or well enough to look right.
CONFIDENT = {"high": 2.0, "medium": 6.0}
FLOORS = 0.5  # degrees within which floors and tables are level


def find_up(shown: Mesh, views: list[View]) -> Up:
    """Up from the largest nearly level plane, else from the cameras; how far they disagree counts as doubt."""
    cameras = camera_up(views)
    normals, areas = face_normals(shown)
    centers = shown.vertices[shown.faces].mean(1)
    plane = plane_up(centers, normals, areas, cameras.normal, tolerance=0.02)
    if plane is None:
        return Up(cameras.normal, "cameras", cameras.within)
    within = float(np.hypot(FLOORS, plane.slope))
    apart = float(np.degrees(np.arccos(np.clip(plane.normal @ cameras.normal, -1, 1))))
    return Up(plane.normal, "plane", within if apart < 3 * cameras.within else max(within, apart))


def resting_height(mesh: Mesh, *, level: float = 0.95, share: float = 0.05) -> float:
    """Height of the lowest level surface with at least `share` of the mesh's area; without one, the mesh's lowest part.

    Args:
        mesh: z up.
        level: least z of a normal that counts as level.
        share: of all the area.
    """
    normals, areas = face_normals(mesh)
    height = mesh.vertices[mesh.faces][:, :, 2].mean(1)
    flat = normals[:, 2] > level
    size = float(np.ptp(mesh.vertices, axis=0).max())
    width = 0.01 * size
    if flat.any():
        low = height[flat].min()
        bins = ((height[flat] - low) / width).astype(int)
        area = np.bincount(bins, areas[flat])
        # A plane that lies across the border of two bins must not be missed.
        pair = area + np.append(area[1:], 0)
        enough = np.flatnonzero(pair > share * areas.sum())
        if len(enough):
            chosen = (bins == enough[0]) | (bins == enough[0] + 1)
            order = np.argsort(height[flat][chosen])
            total = np.cumsum(areas[flat][chosen][order])
            return float(height[flat][chosen][order][np.searchsorted(total, total[-1] / 2)])
    return float(np.quantile(mesh.vertices[:, 2], 0.002))


def level(shown: Mesh, views: list[View], up: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that turns up [3] to z and the front, which is towards the mean camera, to -y."""
    center = (shown.vertices.min(0) + shown.vertices.max(0)) / 2
    front = np.mean([v.center for v in views], axis=0) - center
    front -= up * (front @ up)
    if np.linalg.norm(front) < 0.2:  # Cameras all around have no front: take the first photo's side.
        front = views[0].center - center
        front -= up * (front @ up)
    if np.linalg.norm(front) < 1e-6:
        front = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    y = -front / np.linalg.norm(front)
    return np.stack([np.cross(y, up), y, up])


def place(shown: Mesh, views: list[View], scale: Scale | None = None, *, size: float | None = None,
          alone: bool = False) -> Placement:  # fmt: skip
    """Chooses up, scale and origin: the floor is z = 0 and the middle of the visible surface is over the origin.

    Args:
        shown: visible surface in normalised space.
        views: cameras in normalised space.
        scale: where it is known; else `size` sets it.
        size: widest side of the box around the visible surface, m; None means 1 m, and says so in `size_from`.
        alone: there is no scenery: the floor is where the lowest point is.
    """
    up = find_up(shown, views)
    rotation = level(shown, views, up.direction)
    turned = shown.vertices @ rotation.T
    if scale is None:
        metres = (1.0 if size is None else size) / float(np.ptp(turned, axis=0).max())
        source = "assumed: widest side = 1 m" if size is None else f"given: widest side = {size:g} m"
        scale = Scale(metres, source)
    in_metres = Mesh(scale.metres * turned, shown.faces)
    low, high = in_metres.vertices.min(0), in_metres.vertices.max(0)
    floor = low[2] if alone else resting_height(in_metres)
    translation = -np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, floor])
    return Placement(scale.metres, rotation, translation, up.source, scale.source, up_within=up.within)


def load_placement(mesh_folder: Path) -> Placement:
    """Reads `placement.json`.

    Raises:
        SdfsimError: the mesh stage has not run.
    """
    path = Path(mesh_folder) / "placement.json"
    content = read_json(path, "run the mesh stage first")
    try:
        return Placement.from_dict(content)
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the mesh stage again") from error


# Positions in EXIF are good to about this where the camera does not say; they have to be spread over several times it.
GPS_ERROR, GPS_SPREAD = 5.0, 4.0  # m, times
# Subject distances in EXIF may scatter by this share of their median.
SUBJECT_SCATTER = 0.2
# A pixel may miss what it is meant to show by these shares of the width; farther off by the factor is behind it.
NEARBY, BEHIND = (0.0, 0.008, 0.016, 0.024), 1.1
FEWEST = 3  # photos with EXIF distances or positions
EARTH = 6_371_000.0  # m

Named = TypeVar("Named", View, Photo)


@dataclass(frozen=True)
class Scale:
    """Metres a unit of normalised space, and where that comes from, in words."""

    metres: float
    source: str


def measured(known: Known, views: list[View], photos: list[Photo], surface: Caster) -> Scale:
    """The scale at which a known distance is what it should be.

    Args:
        known: the distance.
        views: cameras in normalised space.
        photos: what the views' photos were made of; pixels are those of the user's own photos.
        surface: in normalised space.

    Raises:
        SdfsimError: no such posed photo or several, a pixel outside it, or one that shows nothing of the surface.
    """
    start, end = (_locate(text, views, photos, surface) for text in (known.start, known.end))
    found = float(np.linalg.norm(end - start))
    if found < 1e-3:
        raise SdfsimError(f"distance: {known.start} and {known.end} are in the same place")
    return Scale(known.metres / found, f"given: {known.start} to {known.end} = {known.metres:g} m")


def check_places(known: Known, photos: list[Photo]) -> None:
    """What can be known of a distance's ends before there are poses.

    Raises:
        SdfsimError: no such photo or several, or a pixel outside it.
    """
    for text in (known.start, known.end):
        name, pixel = _parts(text)
        _check_pixel(text, pixel, _called(name, photos, "photo"))


def _locate(text: str, views: list[View], photos: list[Photo], surface: Caster) -> np.ndarray:
    """Position [3] of one end of a known distance."""
    name, pixel = _parts(text)
    view = _called(name, views, "posed photo")
    if pixel is None:
        return view.center
    photo = next(photo for photo in photos if photo.name == view.name)
    _check_pixel(text, pixel, photo)
    x, y = pixel
    turn = np.arange(8) * np.pi / 4
    around = np.concatenate([r * np.stack([np.cos(turn), np.sin(turn)], 1) for r in NEARBY]) * view.width
    spots = photo.prepared(np.array([[x, y]]), view) + around
    rays = view.rays(spots[:, 0], spots[:, 1])
    away = surface.hits(view.center, rays)[0]
    if not np.isfinite(away).any():
        raise SdfsimError(f"distance: {text} shows nothing of the surface", "choose a pixel on what was reconstructed")
    # People point at corners, which come out a little rounded, and just beside one is what lies far behind it: as far
    # away as the first pixel that shows none of that, but where they pointed.
    best = int((away < BEHIND * away.min()).argmax())
    return view.center + away[best] * rays[0]


def _parts(text: str) -> tuple[str, tuple[float, float] | None]:
    """The photo's name, and the pixel if one is given."""
    pixel = re.fullmatch(r"(.+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", text)
    return (pixel[1], (float(pixel[2]), float(pixel[3]))) if pixel else (text, None)


def _check_pixel(text: str, pixel: tuple[float, float] | None, photo: Photo) -> None:
    width, height = photo.original
    if pixel is not None and not (pixel[0] <= width and pixel[1] <= height):
        raise SdfsimError(f"distance: {text} lies outside the photo ({width} x {height} px)")


def _called(name: str, views: Sequence[Named], what: str) -> Named:
    """The one of `views` whose photo has this name, with or without its subfolder."""
    found = [v for v in views if v.source == name] or [v for v in views if Path(v.source).name == name]
    if len(found) == 1:
        return found[0]
    if found:
        raise SdfsimError(
            f"distance: {len(found)} {what}s are called {name!r}",
            f"write its folder as well: {', '.join(v.source for v in found[:3])}",
        )
    near = difflib.get_close_matches(name, [v.source for v in views], 3, 0.3) or [v.source for v in views[:3]]
    raise SdfsimError(
        f"distance: no {what} is called {name!r}",
        f"write PHOTO:X,Y for a pixel or PHOTO for the camera; photos: {', '.join(near)}, ...",
    )


def of_exif(views: list[View], photos: Path, surface: Caster, up: np.ndarray) -> Scale | None:
    """The scale from what cameras wrote into their photos: where they stood, or how far away their subject was.

    Args:
        views: cameras in normalised space.
        photos: the user's folder, see `Source.folder`.
        surface: in normalised space.
        up: [3] unit, in normalised space.

    Returns:
        The scale; None where too little is written down, or it does not agree with the poses.
    """
    notes = [_exif(photos / view.source) for view in views]
    return _from_positions(views, notes, up) or _from_subjects(views, notes, surface)


@dataclass(frozen=True)
class _Exif:
    """Latitude and longitude [2] in degrees and their error m; distance of the subject m; None where unknown."""

    position: np.ndarray | None = None
    error: float = GPS_ERROR
    subject: float | None = None


def _exif(path: Path) -> _Exif:
    try:
        with opened(path) as image:
            exif = image.getexif()
        subject = float(exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.SubjectDistance) or 0)
        gps, tag = exif.get_ifd(ExifTags.IFD.GPSInfo), ExifTags.GPS
        position = None
        if tag.GPSLatitude in gps and tag.GPSLongitude in gps:
            degrees = [
                sum(float(part) / 60**k for k, part in enumerate(gps[key]))
                for key in (tag.GPSLatitude, tag.GPSLongitude)
            ]
            signs = [-1 if gps.get(key) in ("S", "W") else 1 for key in (tag.GPSLatitudeRef, tag.GPSLongitudeRef)]
            position = np.array(degrees) * signs
        error = float(gps.get(tag.GPSHPositioningError) or GPS_ERROR)
        return _Exif(position, error, subject if 0 < subject < 1e4 else None)
    except (SdfsimError, OSError, SyntaxError, ValueError, TypeError, ZeroDivisionError, OverflowError):
        return _Exif()  # Broken EXIF is common and never worth failing for.


def _from_positions(views: list[View], notes: list[_Exif], up: np.ndarray) -> Scale | None:
    """Compares how far apart the cameras are on the map and in the reconstruction."""
    have = [(view.center, note) for view, note in zip(views, notes, strict=True) if note.position is not None]
    if len(have) < FEWEST:
        return None
    degrees = np.array([note.position for _, note in have])
    north = np.radians(degrees - degrees.mean(0)) * EARTH
    true = north[:, ::-1] * [math.cos(math.radians(degrees[0, 0])), 1.0]
    error = float(np.median([note.error for _, note in have]))
    if np.sqrt((true**2).sum(1).mean()) < GPS_SPREAD * error:
        return None
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    flat = np.array([center for center, _ in have]) @ np.stack([side, np.cross(up, side)], 1)
    a, b = (values[:, 0] + 1j * values[:, 1] for values in (flat - flat.mean(0), true))
    factor = (a.conj() * b).sum() / (a.conj() * a).sum().real  # Least-squares turn and scale of the plane.
    off = float(np.sqrt((np.abs(b - factor * a) ** 2).mean()))
    if off > 2 * error:
        return None
    within = 100 * off / float(np.sqrt((np.abs(b) ** 2).mean())) / math.sqrt(len(have))
    return Scale(abs(factor), f"EXIF positions of {len(have)} photos, within {max(within, 0.1):.1f} %")


def _from_subjects(views: list[View], notes: list[_Exif], surface: Caster) -> Scale | None:
    """Compares the distance to the subject with that to the surface in the middle of each photo."""
    ratios = []
    for view, note in zip(views, notes, strict=True):
        if note.subject is not None:
            ray = view.rays(np.array([view.width / 2]), np.array([view.height / 2]))
            ratios.append(note.subject / surface.hits(view.center, ray)[0][0])
    ratios = np.array(ratios)
    ratios = ratios[ratios > 0]
    if len(ratios) < FEWEST:
        return None
    middle = float(np.median(ratios))
    scatter = float(np.median(np.abs(ratios - middle))) / middle
    if scatter > SUBJECT_SCATTER:
        return None
    return Scale(middle, f"EXIF subject distances of {len(ratios)} photos, which scatter by {100 * scatter:.0f} %")
