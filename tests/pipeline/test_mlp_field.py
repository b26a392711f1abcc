"""The paper's field: starts as a sphere, learns, resumes, and is read back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.field.mlp_field import MlpField, MlpSize, encoded
from pipeline.field.rendering import sdf_cache
from pipeline.field.supervision import supervision_of
from pipeline.field.training import PRESETS, MlpTrainer, Trained, Trainer, load_field, save_field
from tests.helpers.fields import UNIT, assert_resumes, toy_rays
from tests.helpers.sparse import NOTHING

TINY = MlpSize(depth=4, width=32, frequencies=3, color_depth=2, view_frequencies=2, background=8)
VOLSDF = PRESETS["volsdf"]


def points(count: int = 2000) -> torch.Tensor:
    rng = torch.Generator().manual_seed(1)
    directions = torch.randn(count, 3, generator=rng)
    return directions / directions.norm(dim=1, keepdim=True) * torch.rand(count, 1, generator=rng)


@pytest.mark.parametrize("radius", [0.25, 0.6])
def test_the_papers_network_starts_as_a_sphere(radius):
    field = MlpField(MlpSize(), seed=3, start_radius=radius)
    p = points()
    sdf, _, more = field.geometry_at(p)
    outer = p.norm(dim=1) > 0.3
    with torch.no_grad():
        assert (sdf - (p.norm(dim=1) - radius)).abs().mean() < 0.07
        assert (sdf - (p.norm(dim=1) - radius)).mean().abs() < 0.01
        assert (more[outer, 3:].norm(dim=1) - 1).abs().mean() < 0.15
        cosine = torch.nn.functional.cosine_similarity(more[outer, 3:], p[outer])
        assert cosine.mean() > 0.95


def test_encoding_is_the_papers():
    p = torch.tensor([[0.3, -0.2, 0.7]], dtype=torch.float64)
    found = encoded(p, 2)[0]
    expected = [*p[0], *torch.sin(p[0]), *torch.cos(p[0]), *torch.sin(2 * p[0]), *torch.cos(2 * p[0])]
    assert found.tolist() == pytest.approx([float(v) for v in expected])


def test_gradients_are_those_of_differences():
    field = MlpField(TINY, seed=0).double()
    p = points(20).double()
    gradient = field.geometry_at(p)[2][:, 3:]
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    with torch.no_grad():
        slow = torch.stack([(field.sdf(p + s) - field.sdf(p - s)) / 2e-5 for s in step], 1)
    assert torch.allclose(gradient, slow, atol=1e-6)


def trainer(**changes) -> MlpTrainer:
    small = {"size": TINY, "rays": 32, "samples": 16, "surface_points": 64, "iterations": 40, "rate": 2e-3}
    settings = replace(VOLSDF, **{**small, **changes})
    supervision = supervision_of(NOTHING, TINY.finest)
    rays = toy_rays()
    # Without masks the background alone could paint both photos.
    rays = replace(rays, mask=((rays.rgb[:, 0] == 200) * 255).to(torch.uint8))
    return MlpTrainer(settings, rays, supervision, 0)


def falls(run: Trainer, steps: int, name: str, part: int) -> float:
    """A loss's mean over the last steps as a share of that over the first; the eikonal loss stays small."""
    losses = [run.step() for _ in range(steps)]
    assert np.mean([one["eikonal"] for one in losses[-part:]]) < 0.01
    return float(np.mean([one[name] for one in losses[-part:]]) / np.mean([one[name] for one in losses[:part]]))


def test_training_lowers_the_loss_and_keeps_a_distance():
    run = trainer()
    before = run.beta.item()
    assert falls(run, 60, "color", 8) < 0.4
    assert run.converged > 0.5 and 0 < run.beta.item() != before
    assert torch.isfinite(sdf_cache(run.field, 2 / 8)).all()


def test_a_resumed_run_ends_as_an_undisturbed_one(tmp_path, one_thread):
    assert_resumes(trainer, 3, tmp_path / "c.safetensors")


def test_the_field_is_read_back(tmp_path):
    field = MlpField(TINY, seed=5)
    save_field(Trained(field, 0.01, UNIT, {}), tmp_path)
    again = load_field(tmp_path)
    assert isinstance(again.field, MlpField) and again.field.finest == field.finest
    with torch.no_grad():
        assert torch.equal(field.sdf(points(50)), again.field.sdf(points(50)))
