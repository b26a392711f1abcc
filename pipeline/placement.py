"""Normalised space -> metres with z up: which way gravity points, how large the scene is, where its floor lies."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipeline.cameras import View
from pipeline.cleaning import face_normals
from pipeline.normalise import camera_up, plane_up
from pipeline.scale import Scale
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
