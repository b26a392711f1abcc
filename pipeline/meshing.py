"""The mesh stage: a trained field becomes meshes in metres, a picture with their names, and a list of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from pipeline.cameras import View, load_sparse, load_views
from pipeline.cleaning import keep_faces
from pipeline.distill import load_field
from pipeline.field import Field
from pipeline.parts import Parts, split
from pipeline.photos import load_photos
from pipeline.picture import Named, draw_names
from pipeline.placement import Placement, place
from pipeline.scale import Scale, measured, of_exif
from pipeline.surface import PRESET_RESOLUTION, Surface, ball, extract, field_distance, of_volume
from pipeline.visibility import Caster
from pipeline.volume import Distance
from pipeline.wishes import Wishes
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, replacing, write_json
from sdfsim.shape.mesh import Mesh, write_ply

Progress = Callable[[float, str], None]
SCENERY = "scene"


def make_meshes(distill: Path, poses: Path, photos: Path, source: Path, out: Path, *, preset: str, wishes: Wishes,
                device: str = "cpu", on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Extracts surfaces and writes them to `out`.

    Writes `mesh.ply` (all that photos show), of the scenery `solid.ply` (closed) and `shown.ply` (what is displayed),
    `objects/NAME.ply` (closed) of each body, `parts.json`, `placement.json`, and `objects.png`.

    Args:
        distill: folder of that stage.
        poses: folder of that stage.
        photos: folder of that stage.
        source: the user's photos, see `Source.folder`.
        out: an existing folder.
        preset: quick, standard or fine.
        wishes: what a person asks for.
        device: where the field is sampled.
        on_progress: called with (fraction, message).

    Returns:
        The stage's report.

    Raises:
        SdfsimError: (exit code 3) no surface worth the name; (exit code 1) wishes that cannot be met.
    """

    def tell(start: float, share: float) -> Progress:
        return lambda fraction, message: on_progress(start + share * fraction, message) if on_progress else None

    trained = load_field(distill)
    field = trained.field.to(device)
    views = trained.normalisation.views(load_views(poses))
    points = trained.normalisation.apply(load_sparse(poses).xyz)
    masked = bool(trained.report["masked"])
    surface = extract(field, views, points, photos, resolution=PRESET_RESOLUTION[preset], on_progress=tell(0.0, 0.5))
    placement = upright(surface, views, photos, source, wishes, masked=masked)
    limit = ball if wishes.crop is None else box_of(placement, wishes.crop)
    if wishes.crop is not None or wishes.keep:
        surface = again(surface, field, views, points, photos, wishes, limit, tell(0.5, 0.2))
    # Where a person has cut the surroundings away, what is left is what they want to move.
    alone = masked or (wishes.crop is not None and not surface.reaches_rim)
    if on_progress:
        on_progress(0.7, "looking for bodies")
    finest = field.finest
    up = placement.rotation[2]
    inner = field_distance(field)
    parts = split(surface, lambda p: np.maximum(inner(p), limit(p)), finest, views, photos, up, alone=alone)
    write_parts(parts, surface, placement, wishes, out)
    if on_progress:
        on_progress(0.95, "drawing objects.png")
    picture(parts, surface, placement, views, photos).save(out / "objects.png")
    shown = placement.mesh(surface.visible)
    return {
        **surface.report, "extent_m": rounded(np.ptp(shown.vertices, axis=0)).tolist(), "up_from": placement.up_from,
        "up_within_degrees": round(placement.up_within, 2), "up_confidence": placement.up_confidence,
        "size": placement.size_from, "objects": list(parts.bodies),
        "smallest_object_m": float(rounded(parts.smallest * placement.scale)),
        "crumbs": parts.crumbs,
        "left_out": [entry for entry in read_parts(out)["left_out"] if not entry["kept"]],
    }  # fmt: skip


def upright(
    surface: Surface, views: list[View], photos: Path, source: Path, wishes: Wishes, *, masked: bool
) -> Placement:
    """Up and scale: a known distance first, then a known size, then what EXIF says."""
    caster = Caster(surface.raw)
    scale: Scale | None = None
    if wishes.distance is not None:
        scale = measured(wishes.distance, views, load_photos(photos), caster)
    placement = place(surface.visible, views, scale, size=wishes.size, alone=masked)
    if scale is None and wishes.size is None:
        found = of_exif(views, source, caster, placement.rotation[2])
        if found is not None:
            return place(surface.visible, views, found, alone=masked)
    return placement


def box_of(placement: Placement, corners: np.ndarray) -> Distance:
    """Distance from what is left after cropping: the trained ball within a box with corners [2, 3] m."""
    middle, half = corners.mean(0), np.ptp(corners, axis=0) / 2

    def distance(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(placement.points(points) - middle) - half
        return np.maximum(ball(points), beyond.max(1) / placement.scale)

    return distance


def again(surface: Surface, field: Field, views: list[View], points: np.ndarray, photos: Path, wishes: Wishes,
          limit: Distance, on_progress: Progress) -> Surface:  # fmt: skip
    """The surface once more, within a limit and with the pieces that a person wants to keep."""
    volume = surface.volume.limited(limit)
    if not (volume.values < 0).any():
        raise SdfsimError(
            "crop: the box holds nothing", "corners are in metres, as in mesh/mesh.ply of a run without it"
        )
    return of_volume(volume, field, views, points, photos, limit, keep=wishes.keep, on_progress=on_progress)


def rounded(values: ArrayLike) -> np.ndarray:
    """Values [...] to six digits of the largest: scenes are from a tenth of a millimetre to 100 km wide."""
    values = np.asarray(values, float)
    largest = np.abs(values).max()
    return values.round(5 - int(np.floor(np.log10(largest)))) if largest > 0 else values


def write_parts(parts: Parts, surface: Surface, placement: Placement, wishes: Wishes, out: Path) -> None:
    """Writes meshes in metres, `placement.json` and `parts.json`."""

    def write(name: str, mesh: Mesh) -> Mesh:
        moved = placement.mesh(mesh)
        with replacing(out / name) as partial:
            partial.write_bytes(write_ply(moved))
        return moved

    write("mesh.ply", surface.visible)
    if parts.solid is not None and parts.shown is not None:
        write("solid.ply", parts.solid)
        write("shown.ply", parts.shown)
    (out / "objects").mkdir(exist_ok=True)
    objects = []
    for name, mesh in parts.bodies.items():
        moved = write(f"objects/{name}.ply", mesh)
        low, high = moved.vertices.min(0), moved.vertices.max(0)
        objects.append({"name": name, "low": rounded(low).tolist(), "high": rounded(high).tolist()})
    left = [
        {
            "name": piece.name, "size_m": float(rounded(piece.size * placement.scale)), "why": piece.why,
            "at": rounded(placement.points(piece.middle[None])[0]).tolist(),
            "kept": "all" in wishes.keep or piece.name in wishes.keep,
        }
        for piece in surface.pieces
    ]  # fmt: skip
    write_json(
        out / "parts.json",
        {"version": 1, "scenery": parts.solid is not None, "objects": objects, "left_out": left,
         "crumbs": parts.crumbs, "smallest_m": float(rounded(parts.smallest * placement.scale))},
    )  # fmt: skip
    write_json(out / "placement.json", placement.to_dict())


def read_parts(mesh_folder: Path) -> dict:
    """What `write_parts` wrote to `parts.json`.

    Raises:
        SdfsimError: the mesh stage has not run.
    """
    return read_json(Path(mesh_folder) / "parts.json", "run the mesh stage first")


def picture(parts: Parts, surface: Surface, placement: Placement, views: list[View], photos: Path) -> Image.Image:
    """The picture with the names of bodies and of what was left out."""
    items = [
        Named(name, f"{np.ptp(mesh.vertices, axis=0).max() * placement.scale:.2g} m", mesh)
        for name, mesh in parts.bodies.items()
    ]
    for piece in surface.pieces:
        chosen = np.zeros(len(surface.raw.faces), bool)
        chosen[piece.faces] = True
        items.append(Named(piece.name, piece.why, keep_faces(surface.raw, chosen), left_out=True))
    rest = parts.solid if parts.solid is not None else Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    return draw_names(items, rest, views, photos)
