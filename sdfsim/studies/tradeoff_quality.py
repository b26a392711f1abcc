"""`--quality` and the estimate of `plan`: measured points and cost models, stored beside the bundled models.

`python -m sdfsim.studies.tradeoff_quality DIR` stores what `sdfsim tradeoff ... -o DIR` has measured.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sdfsim.dynamics.model import BUNDLED, Model, load_model
from sdfsim.errors import SdfsimError, run_main
from sdfsim.files import read_json, write_json
from sdfsim.scene.types import Scene
from sdfsim.studies.tradeoff_cost import COSTS_FILE
from sdfsim.studies.tradeoff_knobs import Setting, arranged_model, arranged_scene, setting_from

QUALITY_FILE = BUNDLED / "quality.json"
FIGURES = ("ms", "errors", "penetration_p95", "energy_gain", "peak_mib")
_MEASURE = "measure them: sdfsim tradeoff DATA -o DIR, then python -m sdfsim.studies.tradeoff_quality DIR"


def quality_setting(name: str, path: Path = QUALITY_FILE) -> Setting:
    """The measured setting that a quality stands for.

    Raises:
        SdfsimError: none was stored.
    """
    stored: dict[str, Any] = read_json(path, _MEASURE)["qualities"]
    if name not in stored:
        raise SdfsimError(f"{path}: no quality {name!r}, only {', '.join(stored)}", _MEASURE)
    return setting_from(stored[name]["setting"])


def at_quality(name: str, scene: Scene, model: str | Path | None, path: Path = QUALITY_FILE) -> tuple[Scene, Model]:
    """A scene and its model at a quality.

    Args:
        name: draft, standard or fine.
        scene: its shapes are sampled anew as the setting says.
        model: bundled name or path, instead of the scene's, or else the measured one.
        path: where qualities are stored.

    Raises:
        SdfsimError: no such quality, or the model is of a kind that it was not measured for.
    """
    setting = quality_setting(name, path)
    chosen = load_model(model or scene.model or setting.model)
    if chosen.kind != (measured := load_model(setting.model, weights=False)).kind:
        raise SdfsimError(
            f"quality {name} was measured with {setting.model}, an {measured.kind} network; {chosen.name} is a "
            f"{chosen.kind} one",
            "leave --quality away",
        )
    return arranged_scene(setting, scene), arranged_model(setting, chosen)


def store(folder: Path, qualities: Path = QUALITY_FILE, costs: Path = COSTS_FILE) -> list[str]:
    """Keep what a folder of `sdfsim tradeoff` holds for `--quality` (tradeoff.json) and `plan` (growth.json).

    Returns:
        A line for each file that was written.

    Raises:
        SdfsimError: the folder holds neither.
    """
    told = []
    if (file := folder / "tradeoff.json").exists():
        report = read_json(file)
        points = {p["key"]: p for p in report["points"]}
        entries = {
            name: {"label": points[key]["label"], "setting": points[key]["fingerprint"]["setting"]}
            | {figure: points[key][figure] for figure in FIGURES}
            for name, key in report["qualities"].items()
        }
        kept = {what: report[what] for what in ("quick", "trajectories", "bodies", "horizon_steps", "dt_s", "sdfsim")}
        write_json(qualities, {"measured_on": Path(report["source"]).name, **kept, "qualities": entries})
        told.append(f"wrote {qualities}")
    if (file := folder / "growth.json").exists():
        report = read_json(file)
        models = read_json(costs)["models"] if costs.exists() else {}
        models[report["model"]] = {
            "kind": report["kind"],
            "quick": report["quick"],
            "cost": report["cost"],
            "held_out_median": report["held_out_median"],
            "held_out_within": report["held_out_within"],
        }
        write_json(costs, {"models": models})
        told.append(f"wrote {costs}")
    if not told:
        raise SdfsimError(f"{folder}: no tradeoff.json and no growth.json here", _MEASURE)
    return told


def quality_note(name: str, model: str | Path | None, path: Path = QUALITY_FILE) -> str:
    """One line: what a quality is, and what was measured of it; also if `model` (None: the measured one) is another."""
    stored = read_json(path, _MEASURE)
    entry, steps = stored["qualities"][name], str(stored["horizon_steps"])
    error = entry["errors"][steps]["translation_rmse"]
    other = "" if model is None or str(model) == entry["setting"]["model"] else f"; {model} was not"
    scenes = f"{stored['trajectories']} scenes of {stored['measured_on']}{other}"
    return (
        f"quality {name}: {entry['label']} ({entry['ms']['median']:.0f} ms a simulated second and "
        f"{error:.3f} m after {steps} steps, measured on {scenes})"
    )


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    print("\n".join(store(parser.parse_args().folder)))


if __name__ == "__main__":
    run_main(main)
