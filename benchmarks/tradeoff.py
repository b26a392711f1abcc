"""What accuracy costs in time: RESULTS.md, from the report of `sdfsim tradeoff`, whose results in DIR are kept.

    python -m benchmarks tradeoff DATA -o DIR

DATA is a dataset of recordings, such as the validation split of MOVi-B. An hour.
"""

import subprocess
import sys
from pathlib import Path

from benchmarks.records import Out, write_record
from sdfsim.base.files import read_json

TEACHER = "PyBullet 4 ms"  # made the recordings


def main(data: Path, *, out: Out) -> None:
    command = [sys.executable, "-c", "import cli; cli.app()", "tradeoff", str(data), "-o", str(out)]
    subprocess.run(command, check=True)
    report = read_json(out / "report.json")
    points = sorted((p for p in report["points"] if "ms" in p and p["label"] != TEACHER), key=lambda p: p["ms"])
    rows = [
        (p["label"], [p["translation_rmse"]["50"], *p["translation_rmse_95"]["50"]], p["rotation_error"]["50"],
         1e3 * p["penetration_p95"], p["ms"])
        for p in points
    ]  # fmt: skip
    measured = (
        f"Settings, and engines at other steps, on {report['trajectories']} trajectories over 50 steps on one core: "
        f"means with 95 % intervals over trajectories. {TEACHER} made the recordings."
    )
    columns = ("setting", "m", "degrees", "deepest 95 %, mm", "ms / s")
    write_record("tradeoff_validation", "python -m benchmarks tradeoff DATA -o DIR", measured, columns, rows)
