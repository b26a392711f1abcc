"""Scenes outside a model's training are flagged, in the scene's own units; scaled ones inside are not."""

from dataclasses import replace

import numpy as np

from sdfsim.dynamics.simulator import Simulator
from tests.dynamics.conftest import random_model

RANGES = {
    "size": [0.7, 2.1],
    "speed": [0.0, 10.0],
    "mass_ratio": [1.0, 60.0],
    "friction": [0.1, 0.7],
    "restitution": [0.05, 0.5],
}


def flags(scene) -> list[str]:
    return Simulator(scene, replace(random_model("impulse"), ranges=RANGES)).run(steps=1).meta["outside_training"]


def test_a_known_scene_has_no_flags_at_any_size(dropped):
    assert flags(dropped) == []
    tiny = tuple(
        replace(b, scale=b.scale * 0.01, position=b.position * 0.01, velocity=b.velocity * 0.1) for b in dropped.bodies
    )
    assert flags(replace(dropped, bodies=tiny)) == []


def test_every_quantity_is_flagged_with_its_values(dropped):
    floor, low, *rest = dropped.bodies
    odd = replace(low, mass=1e4, velocity=np.array([0.0, 0.0, -40.0]), friction=2.0, restitution=2.0, scale=0.1)
    lines = flags(replace(dropped, bodies=(floor, odd, *rest)))
    assert [line.split(":")[0] for line in lines] == [
        "largest side of a body, m",
        "speed at the start, m/s",
        "heaviest to lightest body",
        "friction of two bodies, multiplied",
        "restitution of two bodies, multiplied",
    ]
    assert "0.1 to 1 here" in lines[0] and "0 to 40 here" in lines[1]
