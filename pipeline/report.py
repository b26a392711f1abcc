"""Which stages of a run are current, and the report made from their records."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from pipeline import record
from pipeline.options import Options
from sdfsim.files import write_json

STAGES = ("photos", "poses", "distill", "mesh", "fit", "scene")
# What a person looks for, and the stage that writes it.
RESULTS = {
    "scene": ("scene.yaml", "scene"), "shape": ("assets/scene", "fit"), "mesh": ("mesh/mesh.ply", "mesh"),
    "cameras": ("poses/cameras.json", "poses"),
}  # fmt: skip
NAMED = 10  # photos left out that are named one by one


def place_of(folder: Path, stage: str) -> Path:
    """Where a stage's result lies in the folder of a run."""
    return folder / ("assets/scene" if stage == "fit" else stage)


def current(folder: Path) -> dict[str, dict]:
    """Records by stage, up to the first stage that is missing or was made from another result of the one before."""
    found: dict[str, dict] = {}
    before = None
    for stage in STAGES:
        known = record.read(place_of(folder, stage))
        if known is None or (before is not None and known["inputs"] != before["fingerprint"]):
            break
        found[stage] = before = known
    return found


def write_report(folder: Path, options: Options) -> dict:
    """Writes report.json from the records of the current stages; returns it."""
    records = current(folder)
    stages = {stage: known["report"] for stage, known in records.items()}
    seconds = {stage: round(known["seconds"], 1) for stage, known in records.items()}
    fit = stages.get("fit", {})
    failed = [f"fit: {fit.get('reason') or 'certificate missed'}"] if fit.get("passed") is False else []
    report = {
        "version": 1, "options": asdict(options), "seconds": seconds, "seconds_total": round(sum(seconds.values()), 1),
        "psnr": stages.get("distill", {}).get("psnr"), "stages": stages, "notes": notes(stages),
        "failed_checks": failed,
        "paths": {
            name: str(folder / path) for name, (path, stage) in RESULTS.items()
            if stage in stages and (folder / path).exists()
        },
    }  # fmt: skip
    write_json(folder / "report.json", report)
    return report


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
    if str(mesh.get("size", "")).startswith("assumed"):
        lines.append(f"size {mesh['size']} (give --size)")
    return lines + stages.get("scene", {}).get("notes", [])
