"""Make toss.csv, a recording like that of a tracker: a box thrown onto a table, with noise, a gap and a jump.

    python samples/toss.py

The table lies 3 mm higher than in toss.yaml, and friction and restitution differ: `sdfsim identify samples/toss.csv
--scene samples/toss.yaml` finds them.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim import Simulator, load_scene

HERE = Path(__file__).resolve().parent
FRICTION, RESTITUTION, HIGHER = 0.25, 0.3, 0.003
RATE, SECONDS, NOISE = 120.0, 0.9, 2e-4  # Hz, s, m


def main() -> None:
    scene = load_scene(HERE / "toss.yaml")
    table, box = scene.bodies
    table = replace(table, position=table.position + np.array([0.0, 0.0, HIGHER]))
    box = replace(box, friction=FRICTION, restitution=RESTITUTION)
    rollout = Simulator(replace(scene, bodies=(table, box)), "solver", dt=1.0 / RATE).run(SECONDS)
    rng = np.random.default_rng(0)
    place = rollout.position[:, 1] + NOISE * rng.standard_normal((len(rollout.time), 3))
    place[12] += 0.05  # a jump
    with (HERE / "toss.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("time,body,x,y,z,qx,qy,qz,qw".split(","))
        for t, now in enumerate(rollout.time):
            if t != 20:  # a frame that is missing
                poses = [f"{value:.5f}" for value in (*place[t], *rollout.orientation[t, 1])]
                rows.writerow([f"{now:.5f}", "box", *poses])


if __name__ == "__main__":
    main()
