"""Time of an image of 128 x 128 px on one core, by `sdfsim.Camera`: docs/viewing.md.

    python -m benchmarks camera [--rounds 30]

Every image is of another state. Processor time estimates the time on an idle machine. The first image, which makes the
trees of the shapes, is a row of its own.
"""

import tempfile
from pathlib import Path
from time import process_time

import numpy as np

from benchmarks.records import ROOT, spread, write_record
from sdfsim.apps.import_robot import import_robot
from sdfsim.scene.load import load_scene
from sdfsim.simulate.camera import Camera
from sdfsim.simulate.simulator import Simulator


def main(*, rounds: int = 30) -> None:
    import pybullet_data

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / "scene.yaml"
        import_robot(Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf", robot, fixed=True, floor=True)
        for name, file in (("a Panda and its floor", robot), ("the sample pile", ROOT / "samples/pile.yaml")):
            simulator = Simulator(load_scene(file))
            camera, took = Camera.fit(simulator, width=128, height=128), []
            for _ in range(rounds + 1):
                simulator.step()
                began = process_time()
                camera.image(simulator)
                took.append(1000.0 * (process_time() - began))
            rows.append([name, len(simulator.scene.bodies), took[0], spread(np.array(took[1:]))])
    columns = ["scene", "bodies", "first image, ms", "each after it, ms"]
    data = f"images of 128 x 128 px of {rounds} successive states, on one core; median and range"
    write_record("camera", "python -m benchmarks camera", data, columns, rows)
