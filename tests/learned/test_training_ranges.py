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


def test_starts_inside_one_another_are_flagged_from_a_sixth_of_the_size_on(dropped):
    floor, low, _, high = dropped.bodies  # of 1 x 0.8 x 0.6 m, above one another
    flat = replace(low, quat_xyzw=np.array([0.0, 0.0, 0.0, 1.0]), velocity=np.zeros(3))

    def lines(height: float, apart: float, factor: float = 1.0) -> list[str]:
        bodies = (
            replace(flat, position=np.array([0.0, 0.0, height])),
            replace(high, position=np.array([apart, 0.0, 9.0])),
        )
        other = replace(high, name="other", position=np.array([0.0, 0.0, 9.0]))
        scaled = [replace(b, scale=factor * b.scale, position=factor * b.position) for b in (*bodies, other)]
        return flags(replace(dropped, bodies=(floor, *scaled)))

    assert lines(0.3, 1.0) == lines(0.15, 0.86) == lines(0.15, 0.86, 0.1) == []
    (line,) = lines(0.1, 0.8, 0.1)
    assert line.startswith("pairs that overlap at the start: 2 here") and "20%" in line and "0.02 m" in line
    (line,) = lines(-5.0, 1.0)
    assert "1 here, 'low' in 'floor' by 5.3 m, 530% of a body's size; trained on up to 16%" in line
    apart = replace(
        dropped, bodies=(replace(floor, collides_with=()), replace(flat, position=np.array([0.0, 0.0, -5.0])))
    )
    assert flags(apart) == []


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
