"""The teacher and the MOVi-B recipe, on a cube: free fall, rest, ranges, repeatability; evaluation against it."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sdfsim.errors import SdfsimError
from sdfsim.learning.dataset import Trajectory, trajectory_files
from sdfsim.learning.evaluate import evaluate
from sdfsim.learning.generate import make_dataset, make_trajectory
from sdfsim.learning.recipes import MATERIALS, REGION, SIZES, Cast
from sdfsim.learning.shapes import find_shapes
from sdfsim.learning.teacher import DT, Teacher, TeacherBody
from tests.dynamics.conftest import random_model


def test_free_fall_is_symplectic_euler_and_rest_is_at_half_the_size(cube_meshes, tmp_path):
    source = find_shapes(cube_meshes, tmp_path)[0]
    assert source.volume == pytest.approx(1.0)
    with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
        teacher.add(TeacherBody(source.urdf, 1.0, 2.0, 0.5, 0.0), np.array([0.0, 0.0, 2.0]), np.array([0, 0, 0, 1.0]))
        motion = teacher.run(100)
    t, h = 10 * DT, DT / 5
    assert motion["position"][10, 0, 2] == pytest.approx(2.0 - 0.5 * 10 * t * (t + h), abs=1e-9)
    assert motion["position"][100, 0, 2] == pytest.approx(0.5, abs=0.01)
    assert np.abs(motion["velocity"][100]).max() < 0.02


def test_the_recipe_keeps_to_its_ranges(cube_meshes, tmp_path):
    sources = find_shapes(cube_meshes, tmp_path)
    t = make_trajectory("movi-b", np.random.default_rng(0), Cast(sources))
    assert len(t.position) == 101 and 3 <= t.position.shape[1] <= 10 and t.dt == pytest.approx(0.02)
    assert ((t.scale >= SIZES[0]) & (t.scale <= SIZES[1])).all()
    materials = {(friction, restitution): density for density, friction, restitution in MATERIALS.values()}
    for k, key in enumerate(zip(t.friction, t.restitution, strict=True)):
        assert t.mass[k] == pytest.approx(materials[key] * t.scale[k] ** 3)
    reach = 0.5 * np.sqrt(3) * t.scale[:, None]
    assert (t.position[0] >= np.array(REGION[0])).all() and (t.position[0] <= np.array(REGION[1])).all()
    aim = t.velocity[0] + t.position[0] * [1, 1, 0]
    assert (np.abs(aim[:, :2]) <= 4.0).all() and (t.velocity[0][:, 2] == 0).all()
    apart = np.linalg.norm(t.position[0][:, None] - t.position[0][None], axis=-1) + 10 * np.eye(len(reach))
    assert apart.min() > 0.5 * t.scale.min()
    assert (t.angular_velocity[0] == 0).all()


def test_a_dataset_repeats_and_goes_on_where_it_was(cube_data, cube_meshes):
    files = trajectory_files(cube_data, "test")
    before = [Trajectory.load(f).position for f in files]
    files[1].unlink()
    report = make_dataset("movi-b", cube_data, shapes=cube_meshes, trajectories=3, seed=1, split="test")
    assert report["made_now"] == 1
    for f, position in zip(files, before, strict=True):
        np.testing.assert_array_equal(Trajectory.load(f).position, position)
    with pytest.raises(SdfsimError, match="no shapes found"):
        find_shapes(cube_data / "test", cube_data)


def test_flying_on_equals_the_teacher_until_something_touches(cube_data, cube_meshes, tmp_path):
    """The baseline's error in free fall is rounding: the engine's staggered start velocity is understood."""
    source = find_shapes(cube_meshes, tmp_path)[0]
    with Teacher(np.array([0.0, 0.0, -10.0])) as teacher:
        teacher.add(TeacherBody(source.urdf, 1.0, 2.0, 0.5, 0.0), np.array([0.0, 0.0, 50.0]), np.array([0, 0, 0, 1.0]))
        teacher.push(0, np.array([3.0, -1.0, 2.0]), np.array([1.0, 2.0, 3.0]))
        motion = teacher.run(100)
    whole = Trajectory.load(trajectory_files(cube_data, "test")[0])
    of_bodies = ("shape", "scale", "mass", "inertia", "friction", "restitution", "static")
    one = replace(whole, **motion, **{name: getattr(whole, name)[:1] for name in of_bodies})
    one = replace(one, inertia=np.full((1, 3), 1 / 3))
    (tmp_path / "test").mkdir()
    (tmp_path / "shapes").symlink_to(cube_data / "shapes")
    (tmp_path / "dataset.json").write_text((cube_data / "dataset.json").read_text())
    one.save(tmp_path / "test" / "0.npz")
    report = evaluate(tmp_path, model=random_model("impulse"))
    assert report["ballistic"]["100"]["translation_rmse"] < 1e-6
    assert report["ballistic"]["100"]["rotation_error"] < 0.1
    assert report["model"] == report["ballistic"]


def test_side_by_side_equals_one_by_one(cube_data, tmp_path):
    """Trajectories that are evaluated in one batch do not feel each other."""
    model = random_model("impulse", push=0.05)
    together = evaluate(cube_data, model=model, steps=40)
    alone = []
    for k, f in enumerate(trajectory_files(cube_data, "test")):
        place = tmp_path / str(k)
        place.mkdir()
        (place / "shapes").symlink_to(cube_data / "shapes")
        (place / "dataset.json").write_text((cube_data / "dataset.json").read_text())
        (place / f.name).write_bytes(f.read_bytes())
        one = evaluate(place, model=model, steps=40)
        alone.append((one["bodies"], one["model"]["40"]["translation_rmse"]))
    squares = sum(n * e**2 for n, e in alone) / sum(n for n, _ in alone)
    assert together["model"]["40"]["translation_rmse"] == pytest.approx(np.sqrt(squares), rel=1e-3)
