"""The teacher against itself: a start that differs by next to nothing, closed forms where nothing is chaotic."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sdfsim.data.dataset import Trajectory, trajectory_files
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf
from sdfsim.evaluation.evaluate import evaluate
from tests.helpers.scenes import random_model


@pytest.fixture
def falling(cube_data, cube_meshes, tmp_path):
    """A dataset of one cube that falls freely for 2 s, spinning, beside a static one; as the teacher records it."""
    whole = Trajectory.load(trajectory_files(cube_data, "test")[0])
    of_bodies = ("scale", "mass", "friction", "restitution", "shape")
    two = replace(
        whole,
        **{name: getattr(whole, name)[[0, 0]] for name in of_bodies},
        **{name: getattr(whole, name)[:, [0, 0]].copy() for name in ("orientation", "velocity")},
        position=np.tile([[0.0, 0.0, 50.0], [5.0, 0.0, 0.5]], (101, 1, 1)),
        angular_velocity=np.tile([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], (101, 1, 1)),
        inertia=whole.inertia[[0, 0]],
        static=np.array([False, True]),
    )
    two.velocity[:, 1] = 0.0
    urdf = dataset_urdf(cube_data, "cube")
    for name in ("shapes", "test"):
        (tmp_path / name).mkdir()
    (tmp_path / "shapes" / "cube").symlink_to(cube_data / "shapes" / "cube")
    (tmp_path / "shapes" / "engine").symlink_to(cube_data / "shapes" / "engine")
    (tmp_path / "dataset.json").write_text((cube_data / "dataset.json").read_text())
    bullet(Start(two, {"cube": urdf}, (0.3, 0.5)), 100)[0].save(tmp_path / "test" / "0.npz")
    return tmp_path


def test_free_fall_keeps_a_perturbation_as_it_is(falling):
    """A start that is e m/s off is e t off at t: e dt sqrt(mean k^2) over the steps; scenery stays where it is."""
    report = evaluate(falling, model=random_model("impulse"), chaos_floor=True)
    expected = 0.02 * np.sqrt(np.mean(np.arange(1, 101) ** 2.0))
    runs = report["chaos_floor"]["perturbations"]
    for name, size in (("1e-3", 1e-3), ("1e-6", 1e-6)):
        assert runs[name]["100"]["translation_rmse"] == pytest.approx(size * expected, rel=1e-4)
        assert runs[name]["100"]["rotation_error"] < 1e-5
    assert runs["0"]["100"]["translation_rmse"] < 1e-9
    assert report["chaos_floor"]["median_farthest_unperturbed_m"] < 1e-9
    assert report["energy_gain"]["teacher"]["worst"] < 1e-9 and report["penetration"]["teacher"]["worst"] is None
    assert report["median_survival_s"]["teacher 1e-3"]["0.1"] is None


def test_the_recording_comes_back_before_chaos_grows(cube_data):
    """Only rounding differs (an orientation goes through a matrix and back), so the first second agrees closely."""
    report = evaluate(cube_data, model=random_model("impulse", push=0.02), steps=50, chaos_floor=True)
    assert report["chaos_floor"]["perturbations"]["0"]["50"]["translation_rmse"] < 1e-4
