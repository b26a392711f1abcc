"""Normalised space -> metres with z up: the direction of gravity, the size of the scene, and its floor."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipeline.cameras import CAREFUL, UNKNOWN, Similarity, Up, View, camera_up, frame_of
from pipeline.inputs.photos import Photo
from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.files import read_json, write_json
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals

# Degrees up to which gravity is known well, or well enough to look right: would a ball roll off a level table?
CONFIDENT = {"high": 2.0, "medium": 6.0}
GRAVITY = 1.0  # degrees, error of a phone's gravity
FLOORS = 0.5  # degrees, tilt of real floors and tables
# For the plane that gives up: largest angle (degrees) between its normal and the cameras' up, and least share of the
# area.
MAX_ANGLE, MIN_SHARE = 25.0, 0.08
# If all cameras look one way, which says nothing of how far down: these angles (degrees) from their image up towards
# them are tried for a floor; walls of things on a table face all ways alike, so this share of them faces the other.
PITCHES, BOTH_WAYS = (0.0, 25.0, 50.0), 0.5
# What they look at is below them, rather than a wall, if two of four hold: one plane across the view has this share;
# cameras move upwards in the picture by this share of how they move sideways; by more than sideways; and they move
# towards the plane by less than this share of the smaller of both. With three, up is known within some degrees.
ACROSS, UPWARDS, LEVELLED, PROBABLY = 0.25, 0.3, 0.2, 20.0
DRAWN, TRIALS = 2000, 200  # of the search for that plane: points, and planes that are tried
LEVEL_NORMAL = 0.95  # least cosine between up and the normal of a level face: 18 degrees
MIN_FLOOR = 0.05  # share of the area that a floor has
# A pixel may miss its target by these shares of the width; a point farther away by the factor is behind the target.
NEARBY, BEHIND = (0.0, 0.008, 0.016, 0.024), 1.1
# Of a place, by the option that takes it.
FORMS = {
    "distance": "PHOTO:X,Y or PHOTO", "body": "NAME=PHOTO:X,Y",
    "up": "PHOTO:X,Y on a level face, an axis such as z or -y, or view",
}  # fmt: skip
AXES = {f"{sign}{name}": float(f"{sign}1") * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "+", "-")}
BESIDE = 0.05  # normalised units: the face that is clicked is the surface within this


@dataclass(frozen=True)
class Placement:
    """The placement of a reconstruction in the world."""

    to_metres: Similarity  # from normalised space to metres, z up
    up_from: str  # "plane", "cameras", or its source in words
    size_from: str  # source of the scale, in words
    up_within: float = 0.0  # uncertainty of up, degrees
    size_assumed: bool = False  # whether the scale is a guess

    @property
    def up_confidence(self) -> str:
        """high, medium or low."""
        return next((word for word, most in CONFIDENT.items() if self.up_within <= most), "low")

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh moved to metres."""
        return Mesh(self.to_metres.points(mesh.vertices), mesh.faces, mesh.colors)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Heights [P] of points [P, 3], both in normalised space."""
        return self.to_metres.points(points)[:, 2] / self.to_metres.scale

    def save(self, mesh_folder: Path) -> None:
        """Writes `placement.json`."""
        write_json(mesh_folder / "placement.json", {**vars(self), "to_metres": self.to_metres.to_dict()})


def load_placement(mesh_folder: Path) -> Placement:
    """Reads `placement.json`. Raises SdfsimError if the mesh stage has not run."""
    path = mesh_folder / "placement.json"
    content = read_json(path, "run the mesh stage first")
    try:
        return Placement(**{**content, "to_metres": Similarity.from_dict(content["to_metres"])})
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run the mesh stage again") from error


class Scale(NamedTuple):
    """A known scale."""

    metres: float  # of a normalised unit
    source: str  # in words
    assumed: bool = False


def find_up(shown: Mesh, views: Sequence[View]) -> Up:
    """Up from the largest nearly level plane, else from the cameras; their disagreement adds to the uncertainty."""
    cameras = camera_up(views)
    if cameras.within >= UNKNOWN:
        return _up_one_way(shown, views, cameras)
    plane = plane_up(*samples_of(shown), cameras.direction, tolerance=0.02)
    if plane is None:
        return cameras
    apart = float(np.degrees(np.arccos(np.clip(plane.normal @ cameras.direction, -1, 1))))
    return Up(plane.normal, "plane", plane.within if apart < 3 * cameras.within else max(plane.within, apart))


def samples_of(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles [F, 3], unit normals [F, 3] and areas [F] of a mesh's faces."""
    return mesh.vertices[mesh.faces].mean(1), *face_normals(mesh)


def _up_one_way(shown: Mesh, views: Sequence[View], cameras: Up) -> Up:
    """Up if all cameras look one way: level, they are, but how far down they look is unknown. A floor that they see at
    an angle says it; else what they look at is a table top below them or a wall in front, as they moved."""
    right, down, view = (np.mean([v.rotation[k] for v in views], axis=0) for k in range(3))
    if min(np.linalg.norm(right), np.linalg.norm(view)) < 0.5:
        return cameras
    towards = -view / np.linalg.norm(view)
    upright = -down + (down @ towards) * towards
    upright /= np.linalg.norm(upright)
    points, normals, areas = samples_of(shown)
    floors = []
    for pitch in np.radians(PITCHES):
        guess = np.cos(pitch) * upright + np.sin(pitch) * towards
        if (plane := plane_up(points, normals, areas, guess, tolerance=0.02)) is not None:
            there, mirrored = (
                areas[normals @ way > np.cos(np.radians(MAX_ANGLE))].sum()
                for way in (plane.normal, 2 * (plane.normal @ towards) * towards - plane.normal)
            )
            if plane.normal @ towards < 0.9 and mirrored < BOTH_WAYS * there:
                floors.append(plane)
    if floors:
        floor = max(floors, key=lambda plane: plane.share)
        rolled = float(np.degrees(np.arcsin(min(abs(floor.normal @ right) / np.linalg.norm(right), 1.0))))
        return Up(floor.normal, "plane", floor.within if rolled < 3 * CAREFUL else max(floor.within, rolled))
    front = plane_up(points, normals, areas, towards, tolerance=0.02)
    if front is None:
        return cameras
    frame = np.stack([right, -down, front.normal]) / np.linalg.norm([right, down, front.normal], axis=1)[:, None]
    aside, up, ahead = np.std([v.center for v in views] @ frame.T, axis=0)
    votes = sum((front.share > ACROSS, up > UPWARDS * aside, up > aside, ahead < LEVELLED * min(aside, up)))
    if votes >= 2:
        return Up(front.normal, "plane", UNKNOWN if votes == 2 else max(front.within, PROBABLY))
    upright -= (upright @ front.normal) * front.normal
    return Up(upright / np.linalg.norm(upright), "cameras", UNKNOWN)


def given_up(text: str, axes: np.ndarray, views: Sequence[View], photos: list[Photo], visible: Mesh) -> Up:
    """Up as an option says it (see `Options`): an axis, of the columns of `axes` [3, 3]; `view`, against the cameras'
    mean view; or the normal of the visible surface at a place. Raises the SdfsimErrors of `_locate`."""
    if text in AXES:
        return Up(axes @ AXES[text], f"axis {text} that was given", FLOORS)
    if text == "view":
        view = np.mean([v.rotation[2] for v in views], axis=0)
        # Cameras that look down are held so to some degrees each.
        return Up(-view / np.linalg.norm(view), "view of the cameras, as given", 3 * CAREFUL / np.sqrt(len(views)))
    place = _locate(text, views, photos, Caster(visible), "up")
    points, normals, areas = samples_of(visible)
    near = np.linalg.norm(points - place, axis=1) < BESIDE
    normal = (areas[near, None] * normals[near]).sum(0)
    normal /= np.linalg.norm(normal)
    flat = np.abs((points - place) @ normal) < BESIDE
    plane = plane_up(points[flat], normals[flat], areas[flat], normal, tolerance=0.02)
    found = (normal, CONFIDENT["medium"]) if plane is None else (plane.normal, plane.within)
    return Up(found[0], f"face at {text}, as given", found[1])


def check_up(text: str, photos: list[Photo]) -> None:
    """Checks the option `up` as far as possible without poses. Raises the SdfsimErrors of `_end`, and one for a photo
    without a pixel."""
    if text not in AXES and text != "view" and _end(text, photos, "up")[1] is None:
        raise SdfsimError(f"up: {text} has no pixel", f"write {FORMS['up']}")


class LevelUp(NamedTuple):
    """A plane that gives up."""

    normal: np.ndarray  # [3] unit, upwards
    slope: float  # degrees that its unevenness amounts to
    share: float  # of the surface's area

    @property
    def within(self) -> float:
        """Uncertainty of its normal as up, degrees."""
        return float(np.hypot(FLOORS, self.slope))


def plane_up(
    points: np.ndarray, normals: np.ndarray, weights: np.ndarray, guess: np.ndarray, tolerance: float
) -> LevelUp | None:
    """The largest plane (RANSAC) among surface samples [P, 3] with unit normals [P, 3] and areas [P], whose normal is
    within `MAX_ANGLE` of a unit guess [3] and whose samples lie within `tolerance`; None if none is large enough."""
    near = normals @ guess > np.cos(np.radians(MAX_ANGLE))
    if near.sum() <= 10:
        return None
    p, n, w = points[near], normals[near], weights[near]
    import open3d as o3d

    # It counts points, so points are drawn in proportion to their area.
    drawn = p[np.random.default_rng(0).choice(len(p), DRAWN, p=w / w.sum())]
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(drawn))
    plane = cloud.segment_plane(tolerance, 3, TRIALS, 1.0)[0]  # a x + b y + c z + d = 0
    inside = (np.abs(p @ plane[:3] + plane[3]) < tolerance) & (np.abs(n @ plane[:3]) > 0.9)
    if w[inside].sum() < MIN_SHARE * weights.sum():
        return None
    for _ in range(3):
        center = np.average(p[inside], axis=0, weights=w[inside])
        offset = p[inside] - center
        spread, axes = np.linalg.eigh((offset * w[inside, None]).T @ offset)
        normal = axes[:, 0] * np.sign(axes[:, 0] @ guess)
        inside = (np.abs((p - center) @ normal) < tolerance) & (n @ normal > 0.9)
        if inside.sum() < 10:
            return None
    if normal @ guess < np.cos(np.radians(MAX_ANGLE)):
        return None
    slope = float(np.degrees(np.arctan(np.sqrt(max(spread[0], 0) / max(spread[1], 1e-30)))))
    return LevelUp(normal, slope, float(w[inside].sum() / weights.sum()))


def resting_height(mesh: Mesh) -> float:
    """Height of the lowest level surface of a mesh, z up, that counts by its area; without one, of its lowest part."""
    normals, areas = face_normals(mesh)
    height = mesh.vertices[mesh.faces][:, :, 2].mean(1)
    flat = normals[:, 2] > LEVEL_NORMAL
    if flat.any():
        width = 0.01 * float(np.ptp(mesh.vertices, axis=0).max())
        bins = ((height[flat] - height[flat].min()) / width).astype(int)
        area = np.bincount(bins, areas[flat])
        # A plane that lies across the border of two bins must not be missed.
        enough = np.flatnonzero(area + np.append(area[1:], 0) > MIN_FLOOR * areas.sum())
        if len(enough):
            chosen = (bins == enough[0]) | (bins == enough[0] + 1)
            weights = areas[flat][chosen]
            return float(np.quantile(height[flat][chosen], 0.5, weights=weights, method="inverted_cdf"))
    return float(np.quantile(mesh.vertices[:, 2], 0.002))


def upright_rotation(shown: Mesh, views: Sequence[View], up: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that turns up [3] to z and the front, which is towards the mean camera, to -y."""
    center = (shown.vertices.min(0) + shown.vertices.max(0)) / 2
    # Cameras all around have no front: use the first photo's side.
    for eye in (np.mean([v.center for v in views], axis=0), views[0].center):
        front = eye - center
        front -= up * (front @ up)
        if np.linalg.norm(front) > 0.2:
            y = -front / np.linalg.norm(front)
            return np.stack([np.cross(y, up), y, up])
    return frame_of(up)


def place(shown: Mesh, views: Sequence[View], scale: Scale | None = None, *, size: float | None = None,
          alone: bool = False, up: Up | None = None) -> Placement:  # fmt: skip
    """Chooses up, scale and origin: the floor is z = 0 and the middle of the visible surface is over the origin.

    Surface and views are in normalised space. Without a known `scale`, `size` m is the widest side, 1 m if it is None.
    `alone`: the floor is at the lowest point.
    """
    up = up or find_up(shown, views)
    rotation = upright_rotation(shown, views, up.direction)
    turned = shown.vertices @ rotation.T
    if scale is None:
        source = "assumed: widest side = 1 m" if size is None else f"given: widest side = {size:g} m"
        scale = Scale((size or 1.0) / float(np.ptp(turned, axis=0).max()), source, size is None)
    in_metres = Mesh(scale.metres * turned, shown.faces)
    low, high = in_metres.vertices.min(0), in_metres.vertices.max(0)
    floor = low[2] if alone else resting_height(in_metres)
    translation = -np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, floor])
    return Placement(Similarity(scale.metres, rotation, translation), up.source, scale.source, up.within, scale.assumed)


def measured_scale(distance: Sequence, views: Sequence[View], photos: list[Photo], surface: Caster) -> Scale:
    """The scale from a known distance (see `Options`). Pixels are those of the user's own photos. Raises the
    SdfsimErrors of `_end`, and one for a photo without a pose, or a pixel off the surface."""
    first, second, metres = distance
    start, end = (_locate(text, views, photos, surface) for text in (first, second))
    found = float(np.linalg.norm(end - start))
    if found < 1e-3:
        raise SdfsimError(f"distance: {first} and {second} are in the same place")
    return Scale(metres / found, f"given: {first} to {second} = {metres:g} m")


def check_distance(distance: Sequence, photos: list[Photo]) -> None:
    """Checks a distance's ends as far as possible without poses. Raises the SdfsimErrors of `_end`."""
    for text in distance[:2]:
        _end(text, photos)


def check_bodies(bodies: dict[str, list[str]], photos: list[Photo]) -> None:
    """Checks the places of bodies (see `Options`) as far as possible without poses. Raises the SdfsimErrors of `_end`,
    and one for a place without a pixel."""
    for text in (text for spots in bodies.values() for text in spots):
        if _end(text, photos, "body")[1] is None:
            raise SdfsimError(f"body: {text} has no pixel", "write PHOTO:X,Y")


def located_bodies(
    bodies: dict[str, list[str]], views: Sequence[View], photos: list[Photo], surface: Caster
) -> dict[str, np.ndarray]:
    """The points [K, 3] of the surface at the places of each body. Raises the SdfsimErrors of `measured_scale`."""
    check_bodies(bodies, photos)
    return {
        name: np.array([_locate(text, views, photos, surface, "body") for text in spots])
        for name, spots in bodies.items()
    }


def _locate(
    text: str, views: Sequence[View], photos: list[Photo], surface: Caster, option: str = "distance"
) -> np.ndarray:
    """Position [3] of one end of a known distance, or of another option's place."""
    photo, pixel = _end(text, photos, option)
    view = next((view for view in views if view.name == photo.name), None)
    if view is None:
        raise SdfsimError(f"{option}: {photo.source} has no pose", "choose a place in another photo")
    if pixel is None:
        return view.center
    turn = np.arange(8) * np.pi / 4
    around = np.concatenate([r * np.stack([np.cos(turn), np.sin(turn)], 1) for r in NEARBY]) * view.width
    spots = photo.prepared(np.array([pixel]), view) + around
    rays = view.rays(spots[:, 0], spots[:, 1])
    away = surface.hits(view.center, rays)[0]
    if not np.isfinite(away).any():
        raise SdfsimError(
            f"{option}: {text} shows nothing of the surface", "choose a pixel on the reconstructed surface"
        )
    if option != "distance":  # Users point at the middle of a body, or of a face.
        hit = int(np.isfinite(away).argmax())
        return view.center + away[hit] * rays[hit]
    # Users point at corners. A reconstructed corner is a little rounded, and a pixel just next to it shows a surface
    # far behind: take the depth of the nearest pixel that does not, at the user's pixel.
    best = int((away < BEHIND * away.min()).argmax())
    return view.center + away[best] * rays[0]


def _end(text: str, photos: list[Photo], option: str = "distance") -> tuple[Photo, tuple[float, float] | None]:
    """The photo that one end of a distance, or a place of another option, names, with or without its subfolder, and the
    pixel if one is given. Raises SdfsimError if no photo or several match, or if the pixel is outside."""
    match = re.fullmatch(r"(.+):(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", text)
    name, pixel = (match[1], (float(match[2]), float(match[3]))) if match else (text, None)
    name = Path(name).as_posix()  # with slashes, also on Windows
    found = [p for p in photos if p.source == name] or [p for p in photos if Path(p.source).name == name]
    if len(found) != 1:
        which = f"{len(found)} photos are" if found else "no photo is"
        such = ", ".join(photo.source for photo in (found or photos)[:3])
        meant = "" if found else nearest(name, [p.source for p in photos])
        raise SdfsimError(f"{option}: {which} called {name!r}{meant}", f"write {FORMS[option]}; photos: {such}, ...")
    width, height = found[0].original
    if pixel is not None and not (pixel[0] <= width and pixel[1] <= height):
        raise SdfsimError(f"{option}: {text} lies outside the photo ({width} x {height} px)")
    return found[0], pixel
