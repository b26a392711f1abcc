"""The mesh stage: a trained field becomes meshes in metres, a picture with their names, and a list of them."""

import colorsys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from pipeline.cameras import PosedPhotos, Similarity, View, load_poses, save_views
from pipeline.field.training import load_field
from pipeline.inputs.captures import load_capture
from pipeline.inputs.photos import KNOWN_CAMERAS, load_photos, open_photo
from pipeline.materials import SCENERY, SURROUNDINGS
from pipeline.mesh.bodies import Parts, split
from pipeline.mesh.extraction import (
    Distance,
    FieldSurface,
    all_seen,
    ball,
    field_distance,
    sample_volume,
    surface_of,
)
from pipeline.mesh.hollows import hollow
from pipeline.mesh.joint import JOINT, PART, HeldPart, load_held
from pipeline.mesh.placement import GRAVITY, Placement, Scale, Up, given_up, located_bodies, measured_scale, place
from pipeline.mesh.supports import complete, on_any
from pipeline.mesh.surroundings import surroundings_of
from pipeline.mesh.texture import fewer, shots_of, texture_parts, textured
from pipeline.mesh.trust import Evidence, color_range, colors_of, evidence_of, next_photos, summary
from pipeline.mesh.visibility import Visibility, to_bytes
from pipeline.options import Options
from pipeline.records import MeshReport
from pipeline.stereo.fusion import load_far
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_bytes, write_json
from sdfsim.base.parallel import Progress, share_of, silent
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import read_attributes, read_mesh, write_glb, write_ply

TEXTURED, NEXT = "textured.glb", "next_photos.json"
SHOWN_AROUND, SOLID_AROUND = "surroundings.ply", "surroundings_solid.ply"
ROUGH = 8_000  # faces of the room around that bodies meet: it is no finer than its cells
RESOLUTION = {"quick": 256, "standard": 320}  # samples per side, by preset
# The picture of names: largest number of photos, their width while they are chosen and in the picture, px, and the
# tint.
PICTURES, THUMB, WIDE, TINT = 4, 80, 720, 0.45
AXIS = (255, 255, 0)  # colour of a joint's axis there


def make_meshes(
    distill: Path, poses: Path, photos: Path, out: Path, options: Options, *, device: str = "cpu",
    on_progress: Progress = silent,
) -> MeshReport:  # fmt: skip
    """Writes the files that docs/objects.md lists. Vertices in the PLY files have `views` and `uncertainty`, see
    `Evidence`. Raises SdfsimError (exit code 3) if there is hardly any surface, or (1) for a distance or box that makes
    no sense."""
    trained = load_field(distill)
    field, to_unit, alone = trained.field.to(device), trained.to_unit, bool(trained.report["masked"])
    posed, held = load_poses(poses).moved(to_unit), load_held(photos / JOINT)
    inner = field_distance(field)
    inside: Distance = lambda p: np.maximum(inner(p), ball(p))  # noqa: E731
    volume = sample_volume(inside, RESOLUTION[options.preset], on_progress=share_of(on_progress, 0.0, 0.25))
    surface = surface_of(volume, field, posed, photos, ball, on_progress=share_of(on_progress, 0.25, 0.2))
    placement = placed(surface, posed, to_unit, photos, options, held, alone=alone)
    if held is not None:
        held.moved(placement.to_metres.after(to_unit)).save(out / JOINT)
    clicked = located_bodies(options.body, posed.views, load_photos(photos), Caster(surface.raw))
    level, metres = placement.to_metres.rotation[2], placement.to_metres.scale
    on_progress(0.45, "looking for level surfaces without texture")
    completed = [] if alone else complete(surface, level, field.finest, posed, photos)
    for one in completed:
        volume, inside = one.filled(volume), one.within(inside)
    limit = edge = ball
    if alone:
        # What nobody sees below the lowest place in sight is as level as what carried it; a field makes a dome of it.
        limit = ground(placement, ball)
    if options.crop is not None:
        limit = edge = box_of(placement, np.reshape(options.crop, (2, 3)), limit)
    if limit is not ball or completed:
        volume = volume if limit is ball else volume.limited(limit)
        if not (volume.values < 0).any():
            raise SdfsimError("crop: the box holds nothing", "corners are in metres, in the axes of the mesh/mesh.ply "
                              "of a run without --crop")  # fmt: skip
        known = on_any(completed, volume.cell) if completed else None
        surface = surface_of(volume, field, posed, photos, edge, known=known,
                             on_progress=share_of(on_progress, 0.5, 0.2))  # fmt: skip
        # If the user has cropped the surroundings away, the rest is meant to move.
        alone = alone or (edge is not ball and bool((ball(surface.solid.vertices) < -2 * volume.cell).all()))
    surface = all_seen(surface, edge)
    on_progress(0.7, "looking for bodies")
    parts = split(surface, inside, field.finest, posed, photos, level, alone=alone, clicked=clicked)
    on_progress(0.8, "drawing objects.png")
    axis = axis_ends(parts, None if held is None else held.moved(to_unit))
    draw_names(parts, posed.views, photos, axis).save(out / "objects.png")
    closed, displayed = (
        {name: placement.mesh(mesh) for name, mesh in ({SCENERY: first} | parts.bodies).items() if mesh is not None}
        for first in (parts.solid, parts.shown)
    )
    around = None
    if not alone and options.crop is None and (far := load_far(distill)) is not None:
        on_progress(0.81, "looking at the room around")
        within = [mesh for mesh in (parts.solid, *parts.bodies.values()) if mesh is not None]
        around = surroundings_of(far, placement.height, within, posed.views, photos)
    whole = joined(list(closed.values()))
    views = posed.moved(placement.to_metres).views
    shots = shots_of(views, load_photos(photos), photos, list(closed.values()), surface.volume.cell * metres)
    on_progress(0.82, "computing how far each place can be trusted")
    sight = Visibility(whole, shots.lift, shots.blocking)
    evidence = evidence_of(sight, views)
    counted = np.abs(limit(placement.to_metres.inverse().points(whole.vertices))) > 1.5 * surface.volume.cell
    proposed, cameras, weak = next_photos(closed, evidence, sight, shots.blocking, views, counted)
    save_views(cameras, out / NEXT)
    write_parts(parts, surface.visible, placement, evidence, out, field.finest * metres, around is not None)
    skins = texture_parts(displayed, shots, share_of(on_progress, 0.87, 0.1))
    if around is not None:
        room = placement.mesh(around.shown)
        write_bytes(out / SHOWN_AROUND, write_ply(room))
        write_bytes(out / SOLID_AROUND, write_ply(fewer(placement.mesh(around.solid), ROUGH)))
        blocking = Caster(joined([whole, room]))
        lens = replace(shots, blocking=blocking, lift=around.cell * metres)
        skins[SURROUNDINGS] = textured(room, lens, share_of(on_progress, 0.97, 0.03))
    write_bytes(out / TEXTURED, write_glb(skins))
    deep = {name: hollow(closed[name], 2 * surface.volume.cell * metres, evidence) for name in parts.bodies}
    return MeshReport(
        extent_m=rounded(np.ptp(placement.mesh(surface.visible).vertices, axis=0)).tolist(),
        size=placement.size_from, size_assumed=placement.size_assumed, up_from=placement.up_from,
        up_within_degrees=round(placement.up_within, 2), up_confidence=placement.up_confidence,
        objects=list(parts.bodies), smallest_object_m=float(rounded(parts.smallest * metres)),
        touching=parts.touching, masks_without_surface=[] if clicked else parts.missing,
        places_without_surface=parts.missing if clicked else [], unrefined=parts.unrefined,
        symmetries=parts.symmetries,
        hollows={name: found for name, found in deep.items() if found is not None},
        left_out_m=[float(rounded(length * metres)) for length in (*surface.left_out, *parts.noise)],
        completed_m2=[float(rounded(one.area * metres**2)) for one in completed],
        trust={name: summary(mesh, evidence.nearest(mesh.vertices)) for name, mesh in displayed.items()},
        weak=round(weak, 4), next_photos=proposed,
    )  # fmt: skip


def placed(surface: FieldSurface, posed: PosedPhotos, to_unit: Similarity, photos: Path, options: Options,
           held: HeldPart | None, *, alone: bool) -> Placement:  # fmt: skip
    """The placement of a surface by the options, else by what the photos came with, else by the surface itself."""
    shown, views, scale, up = surface.visible, posed.views, None, None
    capture = load_capture(photos)
    if options.distance is not None:
        scale = measured_scale(options.distance, views, load_photos(photos), Caster(surface.raw))
    elif options.size is None and held is not None:
        scale = Scale(held.metres / to_unit.scale, held.size_from, held.size_assumed)
    elif options.size is None and capture is not None:
        scale = Scale(1 / to_unit.scale, f"metres of {capture.app}")
    if capture is not None and capture.up is not None:
        up = Up(to_unit.rotation @ capture.up, f"gravity of {capture.app}", GRAVITY)
    if options.up is not None:
        axes = to_unit.rotation
        if not (photos / KNOWN_CAMERAS).exists():
            axes = place(shown, views, up=up).to_metres.rotation.T
        up = given_up(options.up, axes, views, load_photos(photos), shown)
    return place(shown, views, scale, size=options.size, alone=alone, up=up)


def ground(placement: Placement, space: Distance) -> Distance:
    """Distance from the part of a `space` above z = 0 m."""
    to_metres = placement.to_metres
    return lambda points: np.maximum(space(points), -to_metres.points(points)[:, 2] / to_metres.scale)


def box_of(placement: Placement, corners: np.ndarray, space: Distance) -> Distance:
    """Distance from the space left after cropping: a `space` within a box with corners [2, 3] m."""
    middle, half = corners.mean(0), np.ptp(corners, axis=0) / 2

    def distance(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(placement.to_metres.points(points) - middle) - half
        return np.maximum(space(points), beyond.max(1) / placement.to_metres.scale)

    return distance


def rounded(values: ArrayLike) -> np.ndarray:
    """Values [...] to six digits of the largest: scenes are from a tenth of a millimetre to 100 km wide."""
    values = np.asarray(values, float)
    largest = np.abs(values).max()
    return values.round(5 - int(np.floor(np.log10(largest)))) if largest > 0 else values


def write_parts(
    parts: Parts, visible: Mesh, placement: Placement, evidence: Evidence, out: Path, cell: float, surrounded: bool
) -> None:  # fmt: skip
    """Writes meshes in metres with the photos' evidence for their vertices, `placement.json` and `parts.json`; the
    latter also holds the width of the field's cells, m, and whether the room around is there."""

    def write(name: str, mesh: Mesh) -> Mesh:
        moved = placement.mesh(mesh)
        write_bytes(out / name, write_ply(moved, evidence.nearest(moved.vertices).attributes()))
        return moved

    write("mesh.ply", visible)
    if parts.solid is not None and parts.shown is not None:
        write("solid.ply", parts.solid)
        write("shown.ply", parts.shown)
    (out / "objects").mkdir(exist_ok=True)
    objects = []
    for name, mesh in parts.bodies.items():
        moved = write(f"objects/{name}.ply", mesh)
        low, high = moved.vertices.min(0), moved.vertices.max(0)
        objects.append({"name": name, "low": rounded(low).tolist(), "high": rounded(high).tolist()})
    about = {"version": 1, "scenery": parts.solid is not None, "surroundings": surrounded, "cell": cell}
    write_json(out / "parts.json", about | {"objects": objects})
    placement.save(out)


def read_parts(mesh_folder: Path) -> dict:
    """The content of `parts.json` from `write_parts`. Raises SdfsimError if the mesh stage has not run."""
    return {"surroundings": False} | read_json(mesh_folder / "parts.json", "run the mesh stage first")


def closed_files(mesh_folder: Path) -> dict[str, Path]:
    """The files of the closed meshes of the scenery, if there is any, and of each body, by name."""
    known = read_parts(mesh_folder)
    files = {SCENERY: mesh_folder / "solid.ply"} if known["scenery"] else {}
    return files | {one["name"]: mesh_folder / "objects" / f"{one['name']}.ply" for one in known["objects"]}


def trust_meshes(mesh_folder: Path) -> dict[str, Mesh]:
    """The meshes of the scene, by name, coloured by their uncertainty (`colors_of`)."""
    files = closed_files(mesh_folder)
    meshes = {name: read_mesh(file) for name, file in files.items()}
    values = {name: read_attributes(file, ["uncertainty"])[0] for name, file in files.items()}
    limits = color_range(joined(list(meshes.values())), np.concatenate(list(values.values())))
    return {name: replace(mesh, colors=to_bytes(colors_of(values[name], limits))) for name, mesh in meshes.items()}


def axis_ends(parts: Parts, held: HeldPart | None) -> np.ndarray | None:
    """[2, 3] ends of a line that shows a joint, in normalised space: a hinge's axis along its part, or the path of a
    slider; None without a joint."""
    if held is None or PART not in parts.bodies:
        return None
    points = parts.bodies[PART].vertices @ held.turn.T + held.shift  # in the first state
    along = (points - held.anchor) @ held.axis
    if held.kind == "slider":
        along = along.max() + np.array([0.0, held.travel])
    return held.anchor + np.outer([along.min(), along.max()], held.axis)


def draw_names(
    parts: Parts, views: Sequence[View], photos_folder: Path, axis: np.ndarray | None = None
) -> Image.Image:  # fmt: skip
    """A picture of the photos that show bodies best, with each body tinted and named, and with the line [2, 3] of a
    joint."""
    meshes = list(parts.bodies.values())
    caster = Caster(joined(meshes if parts.solid is None else [*meshes, parts.solid]))
    borders = np.cumsum([len(mesh.faces) for mesh in meshes])

    def seen(view: View, longest: int) -> np.ndarray:
        """The body at each pixel [H, W]; the number of bodies stands for none."""
        scale = longest / max(view.width, view.height)
        size = max(1, round(view.height * scale)), max(1, round(view.width * scale))
        row, column = (axis.ravel() for axis in np.indices(size))
        away, face = caster.hits(view.center, view.rays((column + 0.5) / scale, (row + 0.5) / scale))
        number = np.searchsorted(borders, face, side="right")
        return np.where(np.isfinite(away), number, len(meshes)).reshape(size)

    pixels = np.array([np.bincount(seen(v, THUMB).ravel(), minlength=len(meshes) + 1)[:-1] for v in views])
    # For each body, the largest first, the photo that shows most of it.
    chosen = list(dict.fromkeys(pixels.argmax(0).tolist()))[:PICTURES] or [0]
    tiles = [_tile(views[k], seen(views[k], WIDE), list(parts.bodies), photos_folder, axis) for k in chosen]
    sheet = Image.new("RGB", (sum(t.width for t in tiles), max(t.height for t in tiles)), (255, 255, 255))
    for tile, right in zip(tiles, np.cumsum([t.width for t in tiles]).tolist(), strict=True):
        sheet.paste(tile, (right - tile.width, 0))
    return sheet


def _tile(
    view: View, seen: np.ndarray, names: list[str], photos_folder: Path, axis: np.ndarray | None
) -> Image.Image:  # fmt: skip
    pixels = np.array(open_photo(photos_folder, view).resize(seen.shape[::-1]), float)
    for number in range(len(names)):  # Hues a golden section apart, so that neighbours differ.
        color = 255 * np.array(colorsys.hsv_to_rgb(number * 0.618 % 1, 0.85, 1.0))
        pixels[seen == number] += TINT * (color - pixels[seen == number])
    tile = Image.fromarray(pixels.astype(np.uint8))
    draw = ImageDraw.Draw(tile)
    style = {"fill": (255, 255, 255), "stroke_width": 2, "stroke_fill": (0, 0, 0), "font": ImageFont.load_default(18)}
    for number, name in enumerate(names):
        rows, columns = np.nonzero(seen == number)
        if len(rows) >= 12:
            draw.text((float(np.median(columns)), float(np.median(rows))), name, anchor="mm", **style)
    if axis is not None:
        ends, depth = view.project(axis)
        if (depth > 0).all():
            draw.line([tuple(end) for end in (ends * seen.shape[1] / view.width).tolist()], fill=AXIS, width=4)
    draw.text((6, 4), view.source, **style)
    return tile
