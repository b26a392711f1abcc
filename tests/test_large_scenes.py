"""The large scenes of the samples are what they say, and the measures of the benchmark are right."""

import sys
from pathlib import Path

import numpy as np
import pytest

from sdfsim import load_scene

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))

import large

from benchmarks.scale_parts import overlaps, page


def test_balls_start_inside_the_bowl_without_touching():
    inner = large.BALL * (large.ROOM * large.MOST_BALLS / (4 * large.PACKED)) ** (1 / 3)
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
    start = np.array([b.position for b in moving])[None]
    assert overlaps.depth(bowl, start).max() == 0.0
    monkeypatch.setitem(large.HEAPS, "heaps", large.Heap(("box", "sphere"), 380, 300, (0.25, 0.5), 6, 400))
    heap = load_scene(large.write_scene("heaps", tmp_path / "heap", 7))
    assert [heap.shapes[b.shape].name for b in heap.bodies[1:]] == ["box", "sphere"] * 3 + ["box"]
    assert {len(s.nodes) for s in heap.shapes if s.name != "plane"} == {300}
    resampled = load_scene(large.write_scene("heaps", tmp_path / "heap7", 2, None))
    assert 0 < len(resampled.shapes[1].nodes) <= 7**3


def test_depth_is_the_overlap_of_spheres_bowl_and_floor(tmp_path):
    scene = load_scene(large.write_scene("bowl", tmp_path, 2, 50))
    bowl = next(b for b in scene.bodies if b.name == "bowl")
    inner, radius = 0.5 * bowl.scale * (1 - overlaps.WALL), 0.26
    far, aside = bowl.position + np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.0, 0.0])
    apart = np.array([far, far + 6 * aside])
    overlapping = np.array([far, far + 5 * aside])
    in_wall = np.array([far, bowl.position - [0, 0, inner - radius + 0.03]])
    beside = np.array([far, [50.0, 0, 0.25]])
    got = overlaps.depth(scene, np.stack([apart, overlapping, in_wall, beside]))
    np.testing.assert_allclose(got, [0.0, 0.02, 0.03, 0.01], atol=1e-9)
    nearly = np.array([far, far + 5.24 * aside, far - 5.23 * aside])  # 4 and 3 mm apart: in contact, not deep
    np.testing.assert_array_equal(overlaps.overlaps(scene, nearly), [0.0, 0.0])
    assert not len(overlaps.overlaps(scene, apart))


def test_slopes_and_series():
    x = [1.0, 10.0, 100.0]
    assert page.slope(x, [3 * v**1.5 for v in x]) == pytest.approx(1.5)
    found = page.series({"growth_64_8": {"a": 1}, "growth_64_16": {"a": 2}, "growth_512_8": {}}, "growth_64")
    assert found == [(8, {"a": 1}), (16, {"a": 2})]


@pytest.mark.slow
@pytest.mark.parametrize("fitted", [False, True])
def test_memory_is_what_is_foreseen(tmp_path, fitted):
    """In a process of its own, its peak over the loaded scene within a fifth."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from benchmarks.scale_parts import ours
    from sdfsim.dynamics.memory import peak_bytes

    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        if fitted:
            scene = large.write_scene("bowl", tmp_path, 512, 64)
            got = pool.submit(ours.run, str(scene), 10).result()
        else:
            got = pool.submit(ours.run_apart, 2000, 5).result()
    points = got["counts"]["sdf_queries"] + got["counts"]["sdf_waiting"]
    edges = got["counts"]["edges"]
    counts = {"bodies": got["bodies"], "nodes": got["nodes"], "edges": edges, "points": points}
    foreseen = peak_bytes(**counts, fitted=fitted, rows=None)
    assert foreseen / 2**20 == pytest.approx(got["peak_mib"], rel=0.2)
