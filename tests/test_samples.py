"""Every bundled sample with every model: 200 steps, finite, rotations orthonormal, nothing under the floor."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim.dynamics.model import SOLVER, bundled_models, load_model, model_names

SAMPLES = sorted((Path(__file__).parent.parent / "samples").glob("*.yaml"))


LONG = {"tower", "pile", "spheres_in_bowl"}  # with a network


@pytest.mark.parametrize(
    ("path", "model"),
    [
        pytest.param(path, model, marks=[pytest.mark.slow] if path.stem in LONG and model != SOLVER else [])
        for path in SAMPLES
        for model in model_names()
    ],
    ids=lambda p: getattr(p, "stem", p),
)
def test_two_hundred_steps_hold_together(path, model):
    scene = sdfsim.load_scene(path)
    rollout = sdfsim.Simulator(scene, model).run(steps=200)
    assert len(rollout) == 200 and rollout.contact_count.sum() > 0
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        assert np.isfinite(getattr(rollout, name)).all(), name
    np.testing.assert_allclose(np.linalg.norm(rollout.orientation, axis=-1), 1.0, atol=1e-5)
    # No body's lowest node is under the floor by more than a tenth of the body's size, at any time.
    for k, body in enumerate(scene.bodies):
        shape = scene.shapes[body.shape]
        if body.motion == "static":
            continue
        nodes = (shape.nodes - shape.com) * body.scale
        size = np.ptp(nodes, axis=0).max()
        for frame in range(0, 201, 10):
            turned = Rotation.from_quat(rollout.orientation[frame, k]).apply(nodes)
            assert (rollout.position[frame, k] + turned)[:, 2].min() > -0.1 * size, (body.name, frame)


@pytest.mark.parametrize("model", [SOLVER, pytest.param("small", marks=pytest.mark.slow)])
def test_spheres_stay_in_the_bowl(model):
    scene = sdfsim.load_scene(Path(__file__).parent.parent / "samples" / "spheres_in_bowl.yaml")
    rollout = sdfsim.Simulator(scene, model).run(seconds=2.0)
    bowl = next(b for b in scene.bodies if b.name == "bowl")
    rim = np.ptp(scene.shapes[bowl.shape].sdf.bounds[:, 0]) * bowl.scale / 2
    moving = [k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"]
    away = np.linalg.norm(rollout.position[:, moving, :2] - bowl.position[:2], axis=-1)
    assert len(moving) >= 16 and away.max() < rim


@pytest.mark.parametrize("name", bundled_models())
def test_bundled_models_say_what_they_were_trained_on(name):
    model = load_model(name)
    assert model.card["errors"]["model"]["50"]["translation_rmse"] > 0
    assert set(model.ranges) == {"size", "speed", "mass_ratio", "friction", "restitution"}
