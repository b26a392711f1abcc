"""Knobs: names that differ, networks and shapes that are what a setting says."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sdfsim.dynamics.graph import EDGE_FEATURES
from sdfsim.dynamics.model import Model, new_network
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.tradeoff_knobs import (
    Setting,
    arranged_model,
    arranged_shape,
    setting_from,
    settings,
    threads_of,
)
from sdfsim.shape.shape import analytic_shape, with_sdf


@pytest.fixture(scope="module")
def model() -> Model:
    torch.manual_seed(0)
    return Model("untrained", "impulse", new_network("impulse", {"width": 8, "rounds": 3}), 0.02, 10.0, 1.4, 0.1)


@pytest.fixture(scope="module")
def box():
    return with_sdf(analytic_shape("box", size=(1.0, 0.6, 0.4)), "grid", resolution=48)


def test_every_setting_has_a_key_and_a_label_of_its_own():
    for quick in (False, True):
        chosen = settings(["small", "x/paper.safetensors"], ["x/paper.safetensors"], quick=quick, cuda=True)
        assert len({s.key for s in chosen}) == len({s.label for s in chosen}) == len(chosen)
        assert all(
            set(s.key) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_.") for s in chosen
        )
        assert chosen[0] == Setting(model="small") and setting_from(chosen[-1].to_json()) == chosen[-1]
    with pytest.raises(SdfsimError, match="not a setting"):
        setting_from({"unheard": 1})


def test_rounds_are_the_first_ones(model):
    short = arranged_model(Setting(rounds=2), model)
    assert [*short.network.rounds] != [*model.network.rounds] and len(short.network.rounds) == 2
    assert torch.equal(short.network.rounds[1].latent.weight, model.network.rounds[1].latent.weight)
    assert len(model.network.rounds) == 3
    with pytest.raises(SdfsimError, match="no 4 rounds"):
        arranged_model(Setting(rounds=4), model)


def test_bf16_rounds_products_and_nothing_else(model):
    rough = arranged_model(Setting(precision="bf16"), model).network
    x = torch.randn(64, EDGE_FEATURES, generator=torch.Generator().manual_seed(0))
    exact, near = model.network.encode(x), rough.encode(x)
    assert near.dtype == torch.float32 and not torch.equal(exact, near)
    assert (exact - near).abs().max() < 0.03 * exact.abs().max()


def test_nodes_are_as_many_and_where_a_setting_says(box):
    few = arranged_shape(Setting(nodes="thin 10"), box).nodes
    assert len(few) == 10 and {tuple(n) for n in few} <= {tuple(n) for n in box.nodes}
    # Outermost first: of a box, the eight corners are among them.
    assert (np.abs(np.abs(few) - [0.5, 0.3, 0.2]).max(1) < 1e-9).sum() == 8
    grid = arranged_shape(Setting(nodes="grid 6"), box).nodes
    assert 8 <= len(grid) <= 6**3 and np.abs(np.asarray(box.sdf(grid)[0])).max() < 0.01
    assert len(arranged_shape(Setting(nodes="vertices"), box).nodes) == len(box.mesh.vertices)


def test_distances_come_from_where_a_setting_says(box):
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    exact = analytic_shape("box", size=(1.0, 0.6, 0.4)).sdf(points)[0]
    coarse = arranged_shape(Setting(sdf="grid 8"), box)
    assert coarse.sdf.resolution == 8 and len(coarse.nodes) == len(box.nodes)
    errors = [
        np.abs(arranged_shape(Setting(sdf=s), box).sdf(points)[0] - exact).mean() for s in ("grid 8", "own", "exact")
    ]
    assert errors[0] > 2 * errors[1] > errors[2] and errors[2] < 1e-6
    plane, ball = analytic_shape("plane"), analytic_shape("sphere", radius=0.5)
    assert arranged_shape(Setting(nodes="grid 6", sdf="grid 8"), plane) is plane
    assert arranged_shape(Setting(sdf="grid 8"), ball).sdf is ball.sdf


def test_threads_are_given_back():
    before = torch.get_num_threads()
    with pytest.raises(ValueError), threads_of(Setting(threads=before + 1)):
        assert torch.get_num_threads() == before + 1
        raise ValueError
    assert torch.get_num_threads() == before
