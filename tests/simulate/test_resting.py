"""What solve and network must hold: what is dropped comes to rest and stays there, and a tower stands."""

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


def on_floor(shape, heights) -> Scene:
    floor = make_body("floor", 0, [0, 0, 0], 0.0, motion="static")
    bodies = (floor, *(make_body(str(k), 1, [0, 0, z]) for k, z in enumerate(heights)))
    return Scene((analytic_shape("plane"), shape), bodies, gravity=EARTH, duration=1.0)


SHAPES = {
    "box": lambda: analytic_shape("box", size=(1.0, 1.0, 1.0)),
    "sphere": lambda: analytic_shape("sphere", radius=0.5),
    "can": lambda: load_shape(Path(__file__).parents[2] / "samples" / "shapes" / "can"),
}


def creep(model: str, name: str, drop: float) -> float:
    """How far the shape goes in SECONDS once it should rest, over its size, when dropped from `drop` times DROP."""
    shape = SHAPES[name]()
    size = np.ptp(shape.nodes, axis=0).max()
    lowest = (shape.nodes - shape.com)[:, 2].min()
    rollout = Simulator(on_floor(shape, [drop * DROP * size - lowest]), model).run(seconds=SETTLED + SECONDS)
    after = rollout.position[rollout.time >= SETTLED][:, 1]
    return float(np.linalg.norm(after - after[0], axis=1).max() / size)


@pytest.mark.parametrize("model", ["solver", "gnn"])
@pytest.mark.parametrize("name", ["box", "can"])
def test_what_falls_ten_centimetres_comes_to_rest_and_stays(model, name):
    assert creep(model, name, 1.0) < 1e-12


def test_a_sphere_comes_to_rest_and_stays_too():
    """From whichever height, since a sphere that was once set rolling rolls on."""
    assert max(creep("solver", "sphere", drop) for drop in (1.0, 1.02, 1.03)) < 1e-12


def test_a_tower_of_three_boxes_stands_three_seconds():
    rollout = Simulator(on_floor(SHAPES["box"](), [0.5, 1.5, 2.5])).run(seconds=3.0)
    moved = np.linalg.norm(rollout.position[:, 1:] - rollout.position[0, 1:], axis=2)
    assert moved.max() < 0.001
