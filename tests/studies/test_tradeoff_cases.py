"""What a study makes of a dataset's shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.shape.asset import analytic_shape, with_sdf
from sdfsim.shape.distance import PiecesDistance
from sdfsim.shape.mlp import MlpSdf
from sdfsim.shape.plans import PLANS
from sdfsim.shape.primitives import convex_pieces
from sdfsim.studies import tradeoff_cases
from sdfsim.studies.tradeoff_cases import refitted


def test_a_network_of_another_width_learns_the_pieces_and_is_kept(tmp_path, monkeypatch):
    monkeypatch.setitem(PLANS, "default", replace(PLANS["default"], steps=150, batch=1024, pool=20_000, goal=None))
    oracle = PiecesDistance(convex_pieces("box"))
    size = np.ptp(oracle.bounds, axis=0).max()
    shape = with_sdf(analytic_shape("box", size=(size, size, size)), "grid", resolution=24)
    shape = replace(shape, nodes=oracle.surface.vertices)
    made = refitted(shape, 16, oracle, tmp_path)
    assert isinstance(made.sdf, MlpSdf) and len(made.sdf.weights[0]) == 16 and made.source["fitted_s"] > 0
    np.testing.assert_array_equal(made.nodes, shape.nodes)
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 3)) * size
    assert np.abs(made.sdf(points)[0] - oracle(points).distance).mean() < 0.03 * size

    monkeypatch.setattr(tradeoff_cases, "train", lambda *args, **options: pytest.fail("fitted again"))
    np.testing.assert_array_equal(refitted(shape, 16, oracle, tmp_path).sdf(points)[0], made.sdf(points)[0])
