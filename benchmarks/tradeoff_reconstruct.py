"""Question: what does the time that a reconstruction may take buy?

    python benchmarks/tradeoff_reconstruct.py -o runs/tradeoff_reconstruct

Poses the rendered photo set once, then trains a field for each preset and budget, and measures the surface against the
truth and the held-out views. Poses come on top of the budget. Writes reconstruct.png, reconstruct.csv and
reconstruct.json; points that are there are kept.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.reconstruct import evaluate
from pipeline.stages import reconstruct
from sdfsim.errors import SdfsimError, run_main
from sdfsim.files import read_json, replacing, write_json

ROOT = Path(__file__).resolve().parent.parent
PHOTOS = ROOT / "samples" / "photos" / "table_vase"
BUDGETS = {"quick": (1, 2, 4, 8), "standard": (8, 16)}  # minutes; with more, a preset stops at its number of steps
ERRORS = ("psnr", "surface_median", "surface_p90", "missing_median")
COLUMNS = ("preset", "minutes", "steps", "wall_s", "cpu_s", *ERRORS, "failed")


def measured(minutes: float, preset: str, posed: Path, out: Path) -> dict:
    """One budget: `psnr` dB of held-out views, surface errors in percent of the table's width; `failed` if it did."""
    folder, kept = out / f"{preset}_{minutes:g}m", out / "points" / f"{preset}_{minutes:g}m.json"
    if kept.exists():
        return read_json(kept)
    if not folder.exists():
        partial = folder.with_name(f".{folder.name}.part")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(posed, partial).rename(folder)
    point: dict = dict.fromkeys(COLUMNS) | {"preset": preset, "minutes": minutes, "failed": ""}
    wall, cpu = time.monotonic(), time.process_time()
    try:
        report = reconstruct(PHOTOS, folder, preset=preset, budget=60 * minutes, until_stage="mesh")
        point |= {"psnr": report["psnr"], "steps": report["stages"]["distill"]["iterations"]}
        surface = evaluate(folder, PHOTOS)["surface_percent_of_table_width"]
        point |= {"surface_median": surface["surface"]["median"], "surface_p90": surface["surface"]["p90"]}
        point["missing_median"] = surface["missing"]["median"]
    except SdfsimError as error:
        point["failed"] = error.message
    point |= {"wall_s": time.monotonic() - wall, "cpu_s": time.process_time() - cpu}
    kept.parent.mkdir(parents=True, exist_ok=True)
    write_json(kept, point)
    return point


def draw(points: list[dict], path: Path) -> None:
    """Surface error and PSNR against the budget; a style of line for each preset."""
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    for preset, style in zip(BUDGETS, ("o-", "s--"), strict=True):
        good = [p for p in points if not p["failed"] and p["preset"] == preset]
        minutes = [p["minutes"] for p in good]
        what = {"surface_median": "median", "surface_p90": "90th percentile", "missing_median": "missing"}
        for number, (key, name) in enumerate(what.items()):
            left.loglog(minutes, [p[key] for p in good], style, color=f"C{number}", label=f"{preset}: {name}")
        right.semilogx(minutes, [p["psnr"] for p in good], style, color="C3", label=preset)
    left.set(xlabel="budget, minutes", ylabel="surface error, % of the table's width")
    right.set(xlabel="budget, minutes", ylabel="PSNR of held-out views, dB")
    ticks = sorted({p["minutes"] for p in points})
    for axes in (left, right):
        axes.legend(fontsize="small")
        axes.grid(True, which="both", lw=0.3)
        axes.set_xticks(ticks, [f"{minutes:g}" for minutes in ticks])
        axes.minorticks_off()
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    chosen = parser.parse_args()
    posed = chosen.out / "posed"
    reconstruct(PHOTOS, posed, preset=next(iter(BUDGETS)), until_stage="poses")
    points = [measured(m, preset, posed, chosen.out) for preset, budgets in BUDGETS.items() for m in budgets]
    write_json(chosen.out / "reconstruct.json", points)
    with replacing(chosen.out / "reconstruct.csv") as partial, open(partial, "w", newline="") as handle:
        writer = csv.DictWriter(handle, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(points)
    draw(points, chosen.out / "reconstruct.png")
    for p in points:
        print({key: p[key] for key in COLUMNS})


if __name__ == "__main__":
    run_main(main)
