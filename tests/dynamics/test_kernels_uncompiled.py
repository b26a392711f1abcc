"""Compiled code does not check its indices; the same functions as plain Python do."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

SCENE = """
version: 1
model: solver
duration: 1.0
shapes:
  ring: {asset: %(shapes)s/ring}
  bowl: {asset: %(shapes)s/bowl}
  ball: {sphere: {radius: 0.1}}
  pill: {capsule: {radius: 0.05, height: 0.2}}
  brick: {box: {size: [0.2, 0.15, 0.1]}}
bodies:
  - {name: floor, motion: static, plane: {normal: [0, 0, 1], offset: 0.0}}
  - {name: bowl, shape: bowl, scale: 1.1, motion: static, position: [0, 0, 0.3]}
  - {name: ring, shape: ring, scale: 0.8, position: [0.02, 0, 0.9], velocity: [0, 0, -6], mass: 1}
  - {name: brick, shape: brick, position: [0, 0.05, 1.4], velocity: [0, 0, -9], mass: 1}
  - {name: ball, shape: ball, position: [1.5, 0, 0.09], velocity: [3, 0, 0], mass: 1}
  - {name: pill, shape: pill, position: [1.9, 0, 0.2], angular_velocity: [0, 5, 0], mass: 1}
"""
RUN = """
import json, sys
import sdfsim
simulator = sdfsim.Simulator(sdfsim.load_scene(sys.argv[1], allow_outside=True))
state = simulator.step(int(sys.argv[2]))
touching = sorted({name for point in simulator.contact_points() for name in (point.first, point.second)})
print(json.dumps([state.position.tolist(), state.velocity.tolist(), touching]))
"""


def ran(scene: Path, steps: int, **environment: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    found = subprocess.run(
        [sys.executable, "-c", RUN, str(scene), str(steps)],
        env=os.environ | environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    position, velocity, touching = json.loads(found.stdout.splitlines()[-1])
    return np.array(position), np.array(velocity), touching


def test_uncompiled_kernels_stay_within_their_arrays_and_come_to_the_same(tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE % {"shapes": Path(__file__).resolve().parents[2] / "samples" / "shapes"})
    compiled, plain = ran(scene, 40), ran(scene, 40, NUMBA_DISABLE_JIT="1")
    assert {"ring", "bowl"} <= set(compiled[2]) and plain[2] == compiled[2]
    np.testing.assert_allclose(plain[0], compiled[0], atol=1e-9)
    np.testing.assert_allclose(plain[1], compiled[1], atol=1e-7)
