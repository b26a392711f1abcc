"""An M16 nut turns down its bolt by its weight alone, as there is no friction; with `--friction 0.2` it locks.

python samples/nut.py nut      # writes nut/bolt.ply, nut/nut.ply, nut/scene.yaml, the run in nut/run, and nut/nut.mp4
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import sdfsim
from sdfsim.base.errors import run_main
from sdfsim.evaluation.laws.assembly import threaded
from sdfsim.geometry.mesh_io import write_ply

PITCH, RADIUS = 2e-3, 8e-3  # m, of the thread (ISO 261)
ROOT = RADIUS - 5 / 8 * PITCH * 0.75**0.5  # m, where the flanks of 60 degrees end (ISO 68-1)
PLAY = 1e-4  # m, between the two, along the radius
AROUND = 240  # facets of a turn; each is a small impact, so that 96 would cost a sixth of the speed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--friction", type=float, default=0.0)
    parser.add_argument("--seconds", type=float, default=1.6)
    given = parser.parse_args()
    folder = given.folder
    folder.mkdir(parents=True, exist_ok=True)
    flanks = np.array([(0.0, RADIUS), (1 / 8, RADIUS), (7 / 16, ROOT), (11 / 16, ROOT)])
    bolt = threaded(flanks, PITCH, 14, 0.0, AROUND)
    nut = threaded(flanks + np.array([0.0, PLAY]), PITCH, 5, 12e-3, AROUND)
    built = sdfsim.Scene(duration=given.seconds)
    of = {
        "bolt": {"motion": "static", "friction": 1.0, "color": (150, 150, 160)},
        "nut": {"density": 7850, "friction": given.friction, "color": (200, 150, 60), "position": (0, 0, 8 * PITCH)},
    }
    for name, mesh in (("bolt", bolt), ("nut", nut)):
        (folder / f"{name}.ply").write_bytes(write_ply(mesh))
        built.add(name, mesh=str(folder / f"{name}.ply"), **of[name])
    built.save(folder / "scene.yaml")
    simulator = sdfsim.Simulator(built)
    with simulator.record() as run:
        simulator.run(given.seconds)
    sdfsim.save_run(simulator, run, folder / "run")
    turns = -np.trapezoid(run.rollout.angular_velocity[:, 1, 2], run.rollout.time) / (2 * np.pi)
    way = 1000 * (run.rollout.position[0, 1, 2] - run.rollout.position[-1, 1, 2])
    print(f"{turns:.2f} turns, {way:.2f} mm down")
    camera, look_at = (0.05, -0.07, 0.045), (0.0, 0.0, 0.014)
    sdfsim.render(
        simulator.scene, run.rollout, folder / "nut.mp4", camera=camera, look_at=look_at, fps=30, size=(480, 480)
    )


if __name__ == "__main__":
    run_main(main)
