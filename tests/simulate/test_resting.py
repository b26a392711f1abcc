"""What is dropped comes to rest and stays there: a fitted shape by the solve, and bodies by the network."""

from pathlib import Path

import numpy as np
import pytest

from sdfsim import Simulator, load_shape
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import make_body

EARTH = np.array([0.0, 0.0, -9.81])
DROP = 0.1  # m, for bodies of a metre
SETTLED = 6.0  # s, after which they are to stay where they are for SECONDS
SECONDS = 5.0
SHAPES = {
    "box": lambda: analytic_shape("box", size=(1.0, 1.0, 1.0)),
    "can": lambda: load_shape(Path(__file__).parents[2] / "samples" / "shapes" / "can"),
}


@pytest.mark.parametrize(
    ("model", "name"), [("solver", "can"), ("gnn", "box"), pytest.param("gnn", "can", marks=pytest.mark.slow)]
)
def test_what_falls_ten_centimetres_comes_to_rest_and_stays(model, name):
    shape = SHAPES[name]()
    size = np.ptp(shape.nodes, axis=0).max()
    lowest = (shape.nodes - shape.com)[:, 2].min()
    bodies = (make_body("floor", 0, [0, 0, 0], 0.0, motion="static"), make_body("it", 1, [0, 0, DROP * size - lowest]))
    scene = Scene((analytic_shape("plane"), shape), bodies, gravity=EARTH, duration=1.0)
    rollout = Simulator(scene, model).run(seconds=SETTLED + SECONDS)
    after = rollout.position[rollout.time >= SETTLED][:, 1]
    assert np.linalg.norm(after - after[0], axis=1).max() < 1e-12 * size
