"""Scenes outside a model's training are flagged, in the scene's own units; scaled ones inside are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.training_ranges import _products
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body, random_model

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
    floor, low, near, high = dropped.bodies
    beside = replace(near, position=np.array([1.7, 0.0, 0.7]))
    dropped = replace(dropped, bodies=(floor, low, beside, high))
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


@pytest.mark.parametrize("seed", range(40))
def test_products_reach_from_the_smallest_to_the_largest_of_all_pairs(box_shape, seed):
    """As many as there are bodies are never looked at, let alone pairs of them."""
    rng = np.random.default_rng(seed)
    values = rng.choice([0.0, 0.2, 0.5, 1.0, *rng.random(3)], rng.integers(0, 30) if seed % 2 else rng.integers(0, 4))
    motions = [str(m) for m in rng.choice(["dynamic", "static", "kinematic"], len(values))]
    bodies = [
        make_body(str(k), 0, [0, 0, 0], motion=motion, friction=float(value))
        for k, (motion, value) in enumerate(zip(motions, values, strict=True))
    ]
    everything = [
        one.friction * other.friction
        for k, one in enumerate(bodies)
        for other in bodies[:k]
        if "dynamic" in (one.motion, other.motion)
    ]
    found = _products(Scene((box_shape,), tuple(bodies), np.zeros(3), 1.0), "friction")
    assert len(found) <= 14
    assert len(found) == len(everything) == 0 or (min(found), max(found)) == (min(everything), max(everything))


@pytest.mark.parametrize("dt", [0.0, -0.01, np.nan, np.inf])
def test_steps_that_are_none_are_refused(dropped, dt):
    with pytest.raises(SdfsimError, match=r"^dt: .*> 0 s"):
        Simulator(dropped, random_model("impulse"), dt=dt)


@pytest.mark.parametrize(
    ("device", "says"),
    [("gpu", "device: 'gpu' is not auto, cpu or cuda"), ("cuda", "no CUDA"), ("cuda:3", "--device cuda:3: no CUDA")],
)
def test_devices_that_are_not_there_are_named(dropped, monkeypatch, device, says):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device == "cuda:3")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(SdfsimError, match=says):
        Simulator(dropped, random_model("impulse"), device)
