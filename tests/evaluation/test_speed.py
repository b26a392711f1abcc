"""The contact solve stays about as fast beside PyBullet, and beside itself, as it was."""

import numpy as np
import pytest

pytest.importorskip("pybullet")

from benchmarks.scale import apart
from samples.large import write_scene
from sdfsim.evaluation.engines import bullet, start_of_scene, timed
from sdfsim.evaluation.harness import one_thread
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator

pytestmark = pytest.mark.slow


def solved(scene: Scene, steps: int, *, sleep: bool = False, first: int = 0) -> float:
    """Milliseconds a step, after so many `first` ones."""
    simulator = Simulator(scene, "solver")
    simulator.options = simulator.options._replace(sleep=sleep)
    simulator.step(first + 1)
    return timed(simulator.step, steps).cpu_ms


@pytest.mark.parametrize(("count", "most"), [(16, 1.2), (512, 0.6)])  # 0.9 and 0.4 on 27 November 2026
def test_spheres_in_a_bowl_take_their_part_of_bullets_time(tmp_path, count, most):
    scene = load_scene(write_scene("bowl", tmp_path / "bowl", count))
    start = start_of_scene(scene, tmp_path / "engine", scene_units(scene))
    with one_thread():
        ratios = [solved(scene, 200) / bullet(start, 200)[1].cpu_ms for _ in range(5)]
    assert np.median(ratios) < most


def test_time_grows_with_bodies_and_ends_with_their_motion():
    with one_thread():
        grown = [solved(apart(512), 50) / solved(apart(256), 50) for _ in range(5)]
        slept = solved(apart(64), 100, sleep=True, first=60) / solved(apart(64), 100, first=60)
    assert np.median(grown) < 2.7 and slept < 0.07
