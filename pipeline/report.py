"""Which stages of a run are current, and the report made from their records."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from pipeline import record
from pipeline.cameras import View, load_sparse, load_views
from pipeline.options import Options
from pipeline.sfm.supervision import camera_up
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json
from sdfsim.playback import PosedPhoto, save_reconstruction
from sdfsim.shape.mesh import load_mesh

STAGES = ("photos", "poses", "distill", "mesh", "fit", "scene")
# What a person looks for, and the stage that writes it.
RESULTS = {
    "scene": ("scene.yaml", "scene"), "shape": ("assets/scene", "fit"), "mesh": ("mesh/mesh.ply", "mesh"),
    "names": ("mesh/objects.png", "mesh"),
    "cameras": ("poses/cameras.json", "poses"), "report": ("report.html", "photos"),
}  # fmt: skip
NAMED = 10  # photos left out that are named one by one
FEW_PHOTOS, LOW_PSNR, HIGH_ERROR = 20, 20.0, 1.0


def place_of(folder: Path, stage: str) -> Path:
    """Where a stage's result lies in the folder of a run."""
    return folder / ("assets" if stage == "fit" else stage)


def current(folder: Path) -> dict[str, dict]:
    """Records by stage, up to the first stage that is missing or was made from another result of the one before."""
    found: dict[str, dict] = {}
    before = None
    for stage in STAGES:
        known = record.read(place_of(folder, stage))
        if known is None or (before is not None and known["inputs"] != before["made"]):
            break
        found[stage] = before = known
    return found


def write_report(folder: Path, options: Options, failed: tuple[str, SdfsimError] | None = None) -> dict:
    """Writes report.json from the records of the current stages; returns it.

    Args:
        folder: of the run.
        options: of the run.
        failed: the stage that ended in an error, and the error.
    """
    records = current(folder)
    stages = {stage: known["report"] for stage, known in records.items()}
    seconds = {stage: round(known["seconds"], 1) for stage, known in records.items()}
    fit = stages.get("fit", {})
    missed = [f"fit: {fit.get('reason') or 'certificate missed'}"] if fit.get("passed") is False else []
    poses = stages.get("poses") or (unfinished(folder, "poses", "verdict.json") if failed else {})
    report = {
        "version": 1, "options": asdict(options), "seconds": seconds, "seconds_total": round(sum(seconds.values()), 1),
        "psnr": stages.get("distill", {}).get("psnr"), "stages": stages, "poses": poses, "notes": notes(stages),
        "photos": photo_rows(folder, stages, poses), "failed_checks": missed,
        "paths": {
            name: str(folder / path) for name, (path, stage) in RESULTS.items()
            if stage in stages and (folder / path).exists()
        },
    }  # fmt: skip
    if failed:
        stage, error = failed
        report["error"] = {"stage": stage, "message": error.message, "hint": error.hint}
    if options.budget is not None and report["seconds_total"] > 1.1 * options.budget:
        report["notes"].append(
            f"it took {report['seconds_total']:.0f} s, more than the budget of {options.budget:.0f} s: poses, mesh and "
            "the shortest of fits take their time"
        )
    report["improve"] = improvements(report)
    write_json(folder / "report.json", report)
    return report


def unfinished(folder: Path, stage: str, name: str) -> dict:
    """A file that a stage left which did not finish; empty where there is none."""
    try:
        return read_json(folder / f".{stage}.part" / name)
    except SdfsimError:
        return {}


def photo_rows(folder: Path, stages: dict[str, dict], poses: dict) -> list[dict]:
    """Each photo with what became of it: posed, held out (with its PSNR), left out (and why), or not posed yet."""
    try:
        photos = read_json(folder / "photos" / "photos.json")["photos"] if "photos" in stages else []
    except (SdfsimError, KeyError):
        photos = []
    why = {entry["photo"]: entry["why"] for entry in poses.get("left_out", [])}
    distill = stages.get("distill", {})
    scores = distill.get("psnr_each", [])
    held = dict(zip(distill.get("held_out_photos", []), scores, strict=False)) if scores else {}
    rows = []
    for photo in photos:
        name = photo["source"]
        verdict = "left out" if name in why else "held out" if name in held else "posed" if poses else "prepared"
        rows.append({
            "photo": name, "file": photo["name"], "verdict": verdict, "why": why.get(name, ""),
            "fault": photo.get("fault", ""), "sharpness": photo["sharpness"], "mask": photo["mask"],
            "size": [photo["width"], photo["height"]], "focal_exif": photo["focal"], "psnr": held.get(name),
        })  # fmt: skip
    return rows


def improvements(report: dict) -> list[str]:
    """What to do for a better result, most useful first; one line each."""
    poses, stages = report["poses"], report["stages"]
    lines = [*poses.get("causes", [])]
    for fault in ("blurred", "too dark", "burnt out"):
        names = [photo["photo"] for photo in report["photos"] if photo["fault"] == fault]
        if names:
            lines.append(
                f"take again what is {fault}: {', '.join(names[:NAMED])}{' ...' if len(names) > NAMED else ''}"
            )
    if 0 < len(report["photos"]) < FEW_PHOTOS:
        lines.append(f"take more photos: {len(report['photos'])} are few, 20 to 60 are good")
    if poses and poses.get("span_degrees", 360) < 150 and not poses.get("failures"):
        lines.append("walk further around the object: what no photo shows is guessed")
    if poses.get("mean_error", 0) > HIGH_ERROR:
        lines.append("keep zoom and focus fixed, and nothing moving in view: the photos agree only within "
                     f"{poses['mean_error']:.1f} px")  # fmt: skip
    if report["psnr"] is not None and report["psnr"] < LOW_PSNR:
        lines.append(f"photos that were not trained on come out at {report['psnr']:.1f} dB only: train for longer "
                     "(--preset standard), and keep light and exposure the same in all photos")  # fmt: skip
    if str(stages.get("mesh", {}).get("size", "")).startswith("assumed"):
        lines.append("give --size or --distance: until then nobody knows how large the scene is")
    if report["failed_checks"]:
        lines.append("fit for longer (a larger --budget), or mend the mesh: a shape is not usable")
    return lines


def notes(stages: dict[str, dict]) -> list[str]:
    """What a person should know about a run: what was passed over, assumed or is uncertain; one line each."""
    poses, mesh = stages.get("poses", {}), stages.get("mesh", {})
    left = poses.get("left_out", [])
    lines = [*stages.get("photos", {}).get("notes", []), *poses.get("warnings", [])]
    lines += [f"left out: {entry['photo']}: {entry['why']}" for entry in left[:NAMED]]
    if len(left) > NAMED:
        lines.append(f"left out: {len(left) - NAMED} more")
    if mesh.get("up_from") == "cameras":
        lines.append("no level plane found: up is taken from the cameras and may be off by some degrees")
    if mesh.get("up_confidence") == "low":
        lines.append(f"up is uncertain, within {mesh['up_within_degrees']:.0f} degrees: check it before simulating")
    if str(mesh.get("size", "")).startswith("assumed"):
        lines.append(f"size {mesh['size']} (give --size or --distance)")
    if mesh.get("objects"):
        lines.append(f"bodies of their own: {', '.join(mesh['objects'])} (mesh/objects.png shows which is which)")
    if "smallest_object_m" in mesh:
        lines.append(f"what rises less than {mesh['smallest_object_m']:.2g} m stays part of what it stands on")
    if mesh.get("crumbs"):
        lines.append(f"{mesh['crumbs']} loose crumbs beside bodies were taken away with them")
    lines += [f"usable, not exact: {caveat}" for caveat in stages.get("fit", {}).get("caveats", [])]
    pieces = mesh.get("left_out", [])
    for piece in pieces[:NAMED]:
        name = piece["name"]
        lines.append(f"left out: {name}, {piece['size_m']:.2g} m long: {piece['why']} (--keep {name} keeps it)")
    if len(pieces) > NAMED:
        lines.append(f"left out: {len(pieces) - NAMED} smaller pieces (--keep all keeps them)")
    return lines + stages.get("scene", {}).get("notes", [])


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
        from pipeline.field.training import load_field
        from pipeline.mesh.placement import load_placement

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
