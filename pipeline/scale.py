"""How large a reconstruction is in metres: from a distance that a person knows, or from what cameras wrote down."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import ExifTags

from pipeline.cameras import View
from pipeline.photo_file import opened
from pipeline.photos import Photo
from pipeline.visibility import Caster
from pipeline.wishes import Known
from sdfsim.errors import SdfsimError

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
