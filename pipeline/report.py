"""The reports of a run: report.json, the same for people in report.md, and a rerun recording of cameras and surface."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cameras import Similarity, camera_up, frame_of, load_poses, load_views
from pipeline.inputs.photos import load_photos
from pipeline.materials import SCENERY
from pipeline.mesh.hollows import hollow_line
from pipeline.options import Options
from pipeline.records import BodyReport, FitReport, MeshReport, PhotosReport, SceneReport, read
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_json, write_text

# What users look for, and the stage that writes it.
RESULTS = {
    "scene": ("scene.yaml", "scene"), "shape": ("assets/scene", "fit"), "mesh": ("mesh/mesh.ply", "mesh"),
    "textured": ("mesh/textured.glb", "mesh"),
    "names": ("mesh/objects.png", "mesh"), "cameras": ("poses/cameras.json", "poses"),
    "report": ("report.md", "photos"),
}  # fmt: skip
RECORDING = "reconstruction.rrd"
NAMED = 10  # photos left out that the notes name; the page has them all
PROPOSED = (255, 40, 200)  # RGB of the cameras that are proposed
FEW_PHOTOS, LOW_PSNR, HIGH_ERROR = 20, 20.0, 1.0
GUESSED_SHARE = 0.01  # of a body's surface: from here on a note reports it


def write_report(
    folder: Path, options: Options, records: Mapping[str, Any], failed: tuple[str, SdfsimError] | None = None
) -> dict:
    """Writes report.json and report.md from the stages' `Record`s; returns the former. `failed` is the stage that ended
    in an error, with the error."""
    stages = {stage: known.report for stage, known in records.items()}
    seconds = {stage: round(known.seconds, 1) for stage, known in records.items()}
    fit = read(FitReport, stages.get("fit"))
    poses = stages.get("poses", {})
    if failed and not poses:
        with suppress(SdfsimError):
            poses = read_json(folder / ".poses.part" / "checks.json")
    report: dict[str, Any] = {
        "version": 1, "options": options.model_dump(mode="json"), "seconds": seconds,
        "seconds_total": round(sum(seconds.values()), 1),
        "psnr": stages.get("distill", {}).get("psnr"), "stages": stages, "poses": poses, "notes": notes(stages),
        "photos": photo_rows(folder, stages, poses),
        "failed_checks": [] if fit.passed else [f"fit: {fit.reason or 'certificate missed'}"],
    }  # fmt: skip
    if failed:
        stage, error = failed
        report["error"] = {"stage": stage, "message": error.message, "hint": error.hint}
    if options.budget is not None and report["seconds_total"] > 1.1 * options.budget:
        report["notes"].append(f"it took {report['seconds_total']:.0f} s, the budget was {options.budget:.0f} s")
    report["improve"] = improvements(report, options)
    write_text(folder / "report.md", page(report, folder))
    report["paths"] = {
        name: str(folder / path) for name, (path, stage) in RESULTS.items()
        if stage in stages and (folder / path).exists()
    }  # fmt: skip
    write_json(folder / "report.json", report)
    return report


def photo_rows(folder: Path, stages: dict[str, dict], poses: dict) -> list[dict]:
    """Each photo with its outcome: posed, held out, left out (and why), or not posed yet."""
    photos = []
    if "photos" in stages:
        with suppress(SdfsimError):
            photos = load_photos(folder / "photos")
    why = {entry["photo"]: entry["why"] for entry in poses.get("left_out", [])}
    held = stages.get("distill", {}).get("held_out_photos", [])
    rows = []
    for photo in photos:
        name = photo.source
        state = "left out" if name in why else "held out" if name in held else "posed" if poses else "prepared"
        rows.append({"photo": name, "file": photo.name, "state": state, "why": why.get(name, photo.fault)})
    return rows


def improvements(report: dict, options: Options) -> list[str]:
    """Advice for a better result, most useful first; one line each."""
    poses, stages = report["poses"], report["stages"]
    lines = [*poses.get("causes", [])]
    if 0 < len(report["photos"]) < FEW_PHOTOS:
        lines.append(f"take more photos: {len(report['photos'])} are few, 20 to 60 are good")
    if poses.get("mean_error", 0) > HIGH_ERROR:
        lines.append("keep zoom and focus fixed, and nothing moving in view: the photos agree only within "
                     f"{poses['mean_error']:.1f} px")  # fmt: skip
    if report["psnr"] is not None and report["psnr"] < LOW_PSNR:
        lines.append(f"held-out photos have a PSNR of only {report['psnr']:.1f} dB: {options.longer()}, "
                     "and keep light and exposure the same in all photos")  # fmt: skip
    for number, photo in enumerate(read(MeshReport, stages.get("mesh")).next_photos, start=1):
        place, target = (", ".join(f"{x:.2f}" for x in at) for at in (photo.position, photo.looking_at))
        lines.append(f"{number}. of the photos that would help most: {photo.words} (camera at {place} m, aimed at "
                     f"{target} m); it improves {photo.gain:.0%} of the weak surface")  # fmt: skip
    if report["failed_checks"]:
        lines.append("fit for longer (a larger --budget), or repair the mesh: a shape is not usable")
    return lines


def notes(stages: dict[str, dict]) -> list[str]:
    """Notes for users about a run: what was skipped, assumed or is uncertain; one line each."""
    poses, scene = stages.get("poses", {}), read(SceneReport, stages.get("scene"))
    lines = [*read(PhotosReport, stages.get("photos")).notes, *poses.get("warnings", [])]
    lines += [f"left out: {entry['photo']}: {entry['why']}" for entry in poses.get("left_out", [])[:NAMED]]
    lines += stages.get("distill", {}).get("notes", [])
    lines += mesh_notes(read(MeshReport, stages["mesh"])) if "mesh" in stages else []
    lines += [f"usable, not exact: {caveat}" for caveat in read(FitReport, stages.get("fit")).caveats]
    lines += [f"{name}: {material_line(body)}" for name, body in scene.bodies.items()]
    moving = {name: body for name, body in scene.bodies.items() if body.mass is not None}
    if guessed := [name for name, body in moving.items() if body.material == "assumed" and not body.weighed]:
        lines.append(f"{', '.join(guessed)}: the mass is assumed. A wrong mass changes how bodies push each other and "
                     "the forces, not how one falls or slides on the scenery (give --material or --mass)")  # fmt: skip
    return [f"joint: {scene.joint}"] * bool(scene.joint) + lines + scene.notes


def mesh_notes(mesh: MeshReport) -> list[str]:
    """The notes of the mesh stage."""
    lines = []
    if mesh.up_from == "cameras":
        lines.append("no level plane found: up comes from the cameras and may be off by some degrees")
    if mesh.up_confidence == "low":
        lines.append(f"up is uncertain, within {mesh.up_within_degrees:.0f} degrees: check it before simulating")
    if mesh.size_assumed:
        lines.append(f"size {mesh.size} (give --size or --distance)")
    if mesh.objects:
        lines.append(f"separate bodies: {', '.join(mesh.objects)} (mesh/objects.png shows which is which)")
    how = {
        "masks": "split where their masks end",
        "clicks": "split where photos show a border between your places",
        "shape": "split along a seam by shape; give masks to be sure",
    }
    lines += [f"{first} and {second} touch; {how[by]}" for first, second, by in mesh.touching]
    lines += [f"no body was found for {name}, which masks name" for name in mesh.masks_without_surface]
    lines += [f"no body was found for {name}, which places name" for name in mesh.places_without_surface]
    lines += [f"{name}: its surface was not fully refined by photos: {why}" for name, why in mesh.unrefined.items()]
    lines += [f"{name}: the {share:.0%} that photos do not show well were completed as {kind}, with which all that "
              "they show agrees: a guess" for name, (kind, share) in mesh.symmetries.items()]  # fmt: skip
    lines += [hollow_line(name, found) for name, found in mesh.hollows.items()]
    if mesh.smallest_object_m:
        lines.append(f"pieces lower than {mesh.smallest_object_m:.2g} m stay part of their support")
    lines += [f"{area:.2g} m^2 of a level surface without texture were completed as a plane from the visible surface "
              "around: nothing measured its height there" for area in mesh.completed_m2]  # fmt: skip
    if mesh.left_out_m:
        largest = max(mesh.left_out_m)
        lines.append(f"{len(mesh.left_out_m)} loose pieces were left out, the largest {largest:.2g} m long")
    lines += [f"{name}: {part.guessed:.0%} of its surface is guessed, fewer than two photos see it"
              for name, part in mesh.trust.items() if part.guessed > GUESSED_SHARE and name != SCENERY]  # fmt: skip
    if mesh.weak is not None:
        more = "" if mesh.next_photos else "; no single photo would help much"
        lines.append(f"{mesh.weak:.1%} of the surface that photos could show is weak: fewer than three photos see "
                     f"it, or all from nearly one direction{more}")  # fmt: skip
    return lines


def material_line(body: BodyReport) -> str:
    """A line with a body's material and mass."""
    line = f"{body.material}, friction {body.friction:g}, restitution {body.restitution:g}"
    if body.mass is None:
        return line
    thick = f" in a wall of {1000 * body.wall:g} mm" if body.wall else ""
    known = ", weighed" if body.weighed else ""
    return f"{line}, {body.mass:.3g} kg{known} ({body.volume:.3g} m^3{thick}, {body.density:g} kg/m^3)"


def page(report: dict, folder: Path) -> str:
    """The report as Markdown; its pictures are files of the run."""
    poses, stages = report["poses"], report["stages"]
    lines = [f"# Reconstruction of {Path(report['options']['photos']).name}", ""]
    if "error" in report:
        error = report["error"]
        lines += [f"**It stopped in the {error['stage']} stage:** {error['message']}", "", error["hint"], ""]
    elif report["failed_checks"]:
        lines += [f"**It ran, but missed a check:** {'; '.join(report['failed_checks'])}", ""]
    else:
        lines += [f"**Done:** {', '.join(stages)}", ""]
    for title, entries in (("What to know", report["notes"]), ("What to improve", report["improve"])):
        if entries:
            lines += [f"## {title}", "", *(f"- {entry}" for entry in entries), ""]
    rows: list[tuple[str, object]] = []
    if poses:
        rows += [
            ("photos with a pose", f"{poses['posed']} of {poses['photos']}"),
            ("mean reprojection error", f"{poses['mean_error']:.2f} px, {poses['points']} points"),
        ]
        rows += [(f"attempt: {one['name']}", "; ".join(one["failures"]) or f"good, {one['posed']} posed")
                 for one in poses.get("attempts", [])]  # fmt: skip
    if report["psnr"] is not None:
        side = stages["distill"].get("psnr_px", "a third of the trained")  # absent in older runs
        rows.append(("photos that were not trained on", f"PSNR {report['psnr']:.1f} dB at {side} px"))
    if "mesh" in stages:
        mesh = read(MeshReport, stages["mesh"])
        rows += [
            ("extent", " x ".join(f"{side:.3g}" for side in mesh.extent_m) + " m"), ("scale", mesh.size),
            ("up", f"from the {mesh.up_from}, within {mesh.up_within_degrees:.1f}°"),
        ]  # fmt: skip
        for name, part in mesh.trust.items():
            seen = " / ".join(f"{share:.1%}" for share in part.seen_by)
            sure = part.uncertainty_m
            middle = "all guessed" if sure is None else f"median uncertainty {1000 * sure:.2g} mm"
            rows.append((f"{name}: seen by 0 / 1 / 2 / 3 or more photos", f"{seen}; {middle}"))
    for name, certificate in read(FitReport, stages.get("fit")).shapes.items():
        bad = f"not usable: {certificate['reason']}"
        rows.append((f"shape {name}", certificate["caveat"] or "exact" if certificate["passed"] else bad))
    rows += [(f"seconds: {stage}", seconds) for stage, seconds in report["seconds"].items()]
    lines += ["## Numbers", "", "| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows), ""]
    if (folder / "mesh" / "objects.png").exists() and "mesh" in stages:
        lines += ["## What was found", "", "![bodies by name](mesh/objects.png)", ""]
    held = [photo for photo in report["photos"] if photo["state"] == "held out"]
    if held:
        lines += ["## Photos that were not trained on: photo and render", ""]
        lines += [f"![{photo['photo']}](photos/images/{photo['file']}) ![render](distill/held_out/{photo['file']})"
                  for photo in held]  # fmt: skip
    lines += ["", "## Photos", "", "| photo | | |", "| --- | --- | --- |"]
    lines += [f"| {row['photo']} | {row['state']} | {row['why']} |" for row in report["photos"]]
    return "\n".join(lines) + "\n"


def write_recording(folder: Path, done: Collection[str]) -> Path | None:
    """Writes `reconstruction.rrd`: cameras with their photos, sparse points, the surface, how far it can be trusted.

    Before the mesh stage it is in the units of the camera poses, with z up according to the cameras; later in metres.
    Returns its path, or None before the poses stage.
    """
    from pipeline.field.training import load_field
    from pipeline.mesh.meshing import NEXT, TEXTURED, trust_meshes
    from pipeline.mesh.placement import load_placement
    from sdfsim.apps.recording import PosedPhoto, save_reconstruction
    from sdfsim.geometry.mesh_io import load_mesh, read_glb
    from sdfsim.simulate.camera import Camera

    if "poses" not in done:
        return None
    poses, place = load_poses(folder / "poses"), folder / "mesh"
    mesh, skins, trust, proposed = None, {}, {}, []
    if "mesh" in done:
        poses = poses.moved(load_field(folder / "distill").to_unit).moved(load_placement(place).to_metres)
        mesh, skins = load_mesh(place / "mesh.ply"), read_glb(place / TEXTURED)
        trust, proposed = trust_meshes(place), load_views(place / NEXT)
    else:
        poses = poses.moved(Similarity(1.0, frame_of(camera_up(poses.views).direction), np.zeros(3)))
    photos = []
    for view in [*poses.views, *proposed]:
        image = folder / "photos" / "images" / view.name
        known = image.is_file()
        lens = (view.focal, view.focal), view.width, view.height, (view.cx, view.cy)
        camera = Camera.posed(view.rotation, view.translation, *lens)
        photos.append(PosedPhoto(view.source, image if known else None, camera, None if known else PROPOSED))
    save_reconstruction(folder / RECORDING, photos, poses.sparse.xyz, poses.sparse.rgb, mesh, skins, trust)
    return folder / RECORDING
