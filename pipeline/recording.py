"""A rerun recording of a reconstruction: cameras with their photos, sparse points, and the surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.cameras import View, load_sparse, load_views
from pipeline.normalise import camera_up
from pipeline.report import current
from sdfsim.recording import PosedPhoto, save_reconstruction
from sdfsim.shape.mesh import load_mesh

NAME = "reconstruction.rrd"


def record(folder: Path) -> Path | None:
    """Write `reconstruction.rrd` from what the stages in `folder` have left there.

    Before the mesh stage it is in the units of the camera poses, from then on in metres with z up.

    Returns:
        Its path, or None before the poses stage.

    Raises:
        SdfsimError: a stage's folder is damaged, or the file cannot be written.
    """
    done = current(folder)
    if "poses" not in done:
        return None
    views, points, colors = in_place(folder, set(done))
    mesh = load_mesh(folder / "mesh" / "mesh.ply") if "mesh" in done else None
    photos = [
        PosedPhoto(
            name=view.source,
            image=_photo(folder / "photos", view.name),
            focal=view.focal,
            principal=(view.cx, view.cy),
            size=(view.width, view.height),
            rotation=view.rotation,
            translation=view.translation,
        )
        for view in views
    ]
    save_reconstruction(folder / NAME, photos, points, colors, mesh)
    return folder / NAME


def in_place(folder: Path, done: set[str]) -> tuple[list[View], np.ndarray, np.ndarray]:
    """Cameras, sparse points [P, 3] and their colours [P, 3]: in metres with z up once there is a mesh.

    Before the mesh stage they are in the units of the poses, turned so that z is up as far as the cameras tell.
    """
    views, sparse = load_views(folder / "poses"), load_sparse(folder / "poses")
    if "mesh" in done:
        from pipeline.distill import load_field
        from pipeline.placement import load_placement

        normalisation = load_field(folder / "distill").normalisation
        placement = load_placement(folder / "mesh")
        views = [placement.view(v) for v in normalisation.views(views)]
        return views, placement.points(normalisation.apply(sparse.xyz)), sparse.rgb
    up = camera_up(views).normal
    east = np.cross(views[0].rotation[2], up)
    east = east / np.linalg.norm(east) if np.linalg.norm(east) > 1e-6 else np.cross(up, np.eye(3)[np.abs(up).argmin()])
    turn = np.stack([east / np.linalg.norm(east), np.cross(up, east / np.linalg.norm(east)), up])
    return [view.transformed(1.0, turn, np.zeros(3)) for view in views], sparse.xyz @ turn.T, sparse.rgb


def _photo(folder: Path, name: str) -> Path | None:
    return next((p for p in (folder / name, folder / "images" / name) if p.is_file()), None)
