"""A rerun recording of a reconstruction: cameras with their photos, sparse points, and the surface."""

from __future__ import annotations

from pathlib import Path

from pipeline.cameras import load_sparse, load_views
from pipeline.report import current
from sdfsim.playback import PosedPhoto, save_reconstruction
from sdfsim.shape.mesh import load_mesh

NAME = "reconstruction.rrd"


def record(folder: Path) -> Path | None:
    """Write `reconstruction.rrd` from what the stages in `folder` have left there.

    Before the mesh stage it is in the units and axes of the camera poses, from then on in metres with z up.

    Returns:
        Its path, or None before the poses stage.

    Raises:
        SdfsimError: a stage's folder is damaged, or the file cannot be written.
    """
    done = current(folder)
    if "poses" not in done:
        return None
    poses, mesh_folder = folder / "poses", folder / "mesh"
    views, sparse = load_views(poses), load_sparse(poses)
    points, mesh = sparse.xyz, None
    if "mesh" in done:
        from pipeline.distill import load_field
        from pipeline.placement import load_placement

        normalisation = load_field(folder / "distill").normalisation
        placement = load_placement(mesh_folder)
        views = [placement.view(v) for v in normalisation.views(views)]
        points = placement.points(normalisation.apply(points))
        mesh = load_mesh(mesh_folder / "mesh.ply")
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
    save_reconstruction(folder / NAME, photos, points, sparse.rgb, mesh)
    return folder / NAME


def _photo(folder: Path, name: str) -> Path | None:
    return next((p for p in (folder / name, folder / "images" / name) if p.is_file()), None)
