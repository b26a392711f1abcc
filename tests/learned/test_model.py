"""Models on devices, their cards, and scenes outside of their training, which are flagged in the scene's own
units."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import BUNDLED, bundled_models, load_model
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


FOUR = 4 * 2**20  # bytes
META = "meta"  # stands in for a GPU


@pytest.mark.parametrize("kind", ["impulse", "sdf-sim"])
def test_a_model_that_goes_to_a_device_leaves_itself_behind(kind, dropped):
    model = random_model(kind)
    simulator = Simulator(dropped, model)
    there = model.to(META)
    assert {weight.device for weight in there.network.state_dict().values()} == {torch.device(META)}
    assert there.network.training is False and there.reach == model.reach
    simulator.run(steps=1)
    assert {weight.device.type for weight in model.network.state_dict().values()} == {"cpu"}


def test_a_model_of_an_earlier_version_ends_in_one_line():
    with pytest.raises(SdfsimError, match="'small' not found") as caught:
        load_model("small")
    assert caught.value.hint == "models are solver, gnn, sdf-sim; or give the path of a .safetensors"


@pytest.mark.parametrize("name", bundled_models())
def test_a_bundled_model_is_small_and_its_card_has_its_own_figures(name):
    """To the digits that the card has, of the errors that the file itself keeps."""
    file, card = BUNDLED / f"{name}.safetensors", (BUNDLED / f"{name}.md").read_text(encoding="utf-8")
    assert file.stat().st_size < FOUR
    model = load_model(name)
    parameters = sum(p.numel() for p in model.network.parameters())
    assert card.startswith(f"# {name}\n") and f"{parameters:,} parameters" in card
    row = next(line for line in card.splitlines() if line.startswith("| this model"))
    for errors in (model.card["errors"]["model"][steps] for steps in ("50", "100")):
        assert f" {errors['translation_rmse']:.3f} " in row
        assert "rotation_error" not in errors or f" {errors['rotation_error']:.1f} " in row
    if "curve" in model.card:
        last = model.card["curve"][-1]
        assert last[0] == model.card["optimiser_steps"]
        assert re.search(rf"^\| {last[0]:,} \| {last[1]:.4f} \|$", card, re.MULTILINE)


@pytest.mark.parametrize(("name", "deepest"), [("gnn", 0.1), ("sdf-sim", 0.8)])
def test_a_learned_simulator_runs_by_its_name(name, deepest, tmp_path):
    """A ball of MOVi-B's size and materials falls freely until it meets the floor, which holds it: at its surface, or,
    as the card of `sdf-sim` tells, only at its middle. Without the floor it would be 3.8 m below in the end."""
    (tmp_path / "scene.yaml").write_text(
        "version: 1\ngravity: [0, 0, -10]\nduration: 1\nshapes: {ball: {sphere: {radius: 0.7}}}\nbodies:\n"
        "  - {name: floor, plane: {}, friction: 0.3, restitution: 0.5}\n"
        "  - {name: ball, shape: ball, position: [0, 0, 1.2], mass: 1, friction: 0.8, restitution: 0.7}\n"
    )
    from sdfsim.scene.load import load_scene

    scene = load_scene(tmp_path / "scene.yaml")
    rollout = Simulator(scene, name).run(1.0)
    assert rollout.meta["model"] == name
    height = rollout.position[:, 1, 2]
    met = np.sqrt(2 * 0.5 / 10)
    flying = rollout.time < met - 0.05
    np.testing.assert_allclose(height[flying], 1.2 - 5 * rollout.time[flying] ** 2, atol=0.02)
    assert height.min() > 0.7 - deepest and height[rollout.time > met].max() < 1.2
