"""The results of `sdfsim tradeoff` on MOVi-B, with its picture: RESULTS.md.

    python -m benchmarks tradeoff DATA -o DIR

DATA is a MOVi-B dataset; DIR keeps the results of the command, which this script continues.
"""

import shutil
from pathlib import Path

from benchmarks.engines import mujoco, mujoco_sdf
from benchmarks.records import ROOT, Out, progress, write_record
from sdfsim.evaluation import tradeoff as study


def main(data: Path, *, out: Out) -> None:
    report = study.tradeoff(
        data, out, engines={"MuJoCo": mujoco, "MuJoCo mesh SDF": mujoco_sdf},
        on_progress=lambda _, fraction, message: progress(fraction, message),
    )  # fmt: skip
    rows, notes = study.report_table(report)
    shutil.copyfile(out / "tradeoff.png", ROOT / "docs" / "images" / "tradeoff.png")
    measured = f"{report['trajectories']} test trajectories of MOVi-B."
    write_record("tradeoff", "python -m benchmarks tradeoff DATA -o DIR", measured, rows[0], rows[1:], [f"{notes[0]}."])
