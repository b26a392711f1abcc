"""The large scenes of the samples are what they say."""

import sys
from pathlib import Path

import numpy as np

from sdfsim import load_scene
from sdfsim.geometry.primitives import bowl_radii

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "samples"))

import large


def test_balls_start_inside_the_bowl_without_touching():
    inner, _ = bowl_radii(large.MOST_BALLS, large.BALL)
    places = large.ball_places(large.MOST_BALLS, inner)
    assert places.shape == (512, 3)
    below = places[places[:, 2] < 0]
    assert np.linalg.norm(below, axis=1).max() < inner - 0.5 * large.BALL
    assert np.hypot(*places[:, :2].T).max() < inner - 0.5 * large.BALL
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9 * np.eye(512)
    assert gaps.min() > large.BALL
    np.testing.assert_array_equal(large.ball_places(64, inner), places[:64])  # a smaller scene is part of a larger one


def test_scenes_have_the_bodies_and_nodes_they_say(tmp_path, monkeypatch):
    bowl = load_scene(large.write_scene("bowl", tmp_path / "bowl", 5, 50))
    moving = [b for b in bowl.bodies if b.motion == "dynamic"]
    assert len(moving) == 5 and {len(bowl.shapes[b.shape].nodes) for b in moving} == {50}
    assert {b.scale for b in moving} == {0.52}
    monkeypatch.setitem(large.HEAPS, "heaps", large.Heap(("box", "sphere"), 380, 300, (0.25, 0.5), 6, 400))
    heap = load_scene(large.write_scene("heaps", tmp_path / "heap", 7))
    assert [heap.shapes[b.shape].name for b in heap.bodies[1:]] == ["box", "sphere"] * 3 + ["box"]
    assert {len(s.nodes) for s in heap.shapes if s.name != "plane"} == {300}
    resampled = load_scene(large.write_scene("heaps", tmp_path / "heap7", 2, None))
    assert 0 < len(resampled.shapes[1].nodes) <= 7**3
