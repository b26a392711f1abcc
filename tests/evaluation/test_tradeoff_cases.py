"""What a study makes of a dataset's shapes, and of what it depends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim.evaluation import tradeoff_shapes
from sdfsim.evaluation.tradeoff_cases import Cases
from sdfsim.evaluation.tradeoff_shapes import digest_of, refitted, sampled
from sdfsim.shape.distance import PiecesDistance
from sdfsim.shape.fit import PLANS
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.primitives import convex_pieces
from sdfsim.shape.sdf import GridSdf
from sdfsim.shape.shape import analytic_shape, with_sdf
from tests.recordings import trajectory


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

    monkeypatch.setattr(tradeoff_shapes, "train", lambda *args, **options: pytest.fail("fitted again"))
    np.testing.assert_array_equal(refitted(shape, 16, oracle, tmp_path).sdf(points)[0], made.sdf(points)[0])


def test_samples_are_kept_by_what_they_are_sampled_from_and_made_again_where_half_written(tmp_path, monkeypatch):
    small, large = (analytic_shape("box", size=(side,) * 3, name="0") for side in (1.0, 2.0))
    for shape in (small, large):  # another scene's shape of the same name
        assert sampled(shape, 16, tmp_path).sdf.bounds == pytest.approx(shape.sdf.bounds)
    (folder, _) = sorted((tmp_path / "grid-16").iterdir())
    (folder / "shape.json").unlink()  # a run was killed here
    for shape in (small, large):
        assert sampled(shape, 16, tmp_path).sdf.bounds == pytest.approx(shape.sdf.bounds)
    monkeypatch.setattr(tradeoff_shapes, "sample_grid", lambda *args: pytest.fail("sampled again"))
    sampled(small, 16, tmp_path)


def test_digests_change_with_whatever_a_measurement_depends_on():
    box = analytic_shape("box", size=(1.0, 1.0, 1.0))
    grid = with_sdf(box, "grid", resolution=8)
    assert isinstance(grid.sdf, GridSdf)
    other = replace(grid, sdf=replace(grid.sdf, values=grid.sdf.values + 1e-3))
    shapes = [box, grid, other, replace(grid, nodes=grid.nodes[:-1]), replace(grid, inertia=2 * grid.inertia)]
    assert len({digest_of(shape) for shape in shapes}) == len(shapes)
    start = trajectory()
    cases = Cases(Path(), Path(), [start], [start], {"cube": box}, {}, {"cube": []}, {}, (0.5, 0.5), [0], 3)
    changed = [{"length": 0.1}, {"time": 0.1}, {"shapes": {"cube": grid}}, {"pieces": {"cube": convex_pieces("box")}}]
    for name in ("gravity", "mass", "friction", "velocity", "quat_xyzw", "inertia"):
        changed.append({"starts": [replace(start, **{name: 0.5 * getattr(start, name)})]})
    assert len({cases.digest(), *(replace(cases, **change).digest() for change in changed)}) == len(changed) + 1
