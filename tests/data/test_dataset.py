"""The trajectory format: what is written comes back, and every fault is named."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.data.dataset import FLOOR, Trajectory, floor_of, home_of, read_info, trajectory_files, write_info
from sdfsim.data.pybullet_sim import TEACHER_VERSION
from sdfsim.errors import SdfsimError
from tests.recordings import trajectory


def test_round_trip(tmp_path):
    one = trajectory()
    one.save(tmp_path / "a.npz")
    two = Trajectory.load(tmp_path / "a.npz")
    assert two.dt == one.dt and list(two.shape) == ["cube", "spot"]
    np.testing.assert_array_equal(two.position, one.position)
    assert trajectory_files(tmp_path, "test") == [tmp_path / "a.npz"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mass": np.array([-1.0, 1.0])}, "mass: must be > 0"),
        ({"velocity": np.full((4, 2, 3), np.nan)}, "velocity: has values that are not finite"),
        ({"quat_xyzw": np.zeros((4, 2, 3))}, "quat_xyzw: must be [4, 2, 4]"),
        ({"dt": 0.0}, "dt > 0"),
        ({"dt": 1e9}, "dt > 0 and at most 10 s"),
        ({"friction": np.array([-0.1, 0.5])}, "friction must be >= 0"),
        ({"restitution": np.array([0.5, 50.0])}, "restitution from 0 to 1"),
        ({"shape": np.array(["cube", "../cube"])}, "shape: '../cube' is no name"),
        ({"shape": np.array(["/etc", "cube"])}, "shape: '/etc' is no name"),
    ],
)
def test_faults_are_named(tmp_path, change, complaint):
    replace(trajectory(), **change).save(tmp_path / "a.npz")
    with pytest.raises(SdfsimError) as error:
        Trajectory.load(tmp_path / "a.npz")
    assert complaint in error.value.message and "a.npz" in error.value.message


def test_missing_fields_truncation_and_empty_folders(tmp_path):
    np.savez(tmp_path / "part.npz", position=np.zeros((2, 1, 3)))
    with pytest.raises(SdfsimError, match="missing field"):
        Trajectory.load(tmp_path / "part.npz")
    trajectory().save(tmp_path / "whole.npz")
    (tmp_path / "torn.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:200])
    with pytest.raises(SdfsimError, match=r"torn\.npz: cannot be read"):
        Trajectory.load(tmp_path / "torn.npz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SdfsimError, match="no trajectories"):
        trajectory_files(tmp_path / "empty", "test")
    with pytest.raises(SdfsimError, match=r"dataset\.json"):
        read_info(tmp_path / "empty")


def test_whole_numbers_are_read_as_what_they_mean(tmp_path):
    """Also where a writer of its own has no booleans: 0 and 1 are not to be taken for indices."""
    whole = {"static": np.array([0, 1]), "mass": np.array([2, 0]), "inertia": np.ones((2, 3), dtype=np.int32)}
    replace(trajectory(), **whole, velocity=np.zeros((4, 2, 3), dtype=np.float32)).save(tmp_path / "a.npz")
    found = Trajectory.load(tmp_path / "a.npz")
    assert found.static.dtype == bool and found.mass[~found.static].tolist() == [2.0]
    assert {getattr(found, name).dtype for name in ("mass", "inertia", "velocity")} == {np.dtype(np.float64)}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"static": np.array([0, 2])}, "static: must be true or false"),
        ({"static": np.array(["yes", "no"])}, "static: must be real numbers"),
        ({"mass": np.array(["2", "1"])}, "mass: must be real numbers"),
        ({"friction": np.array([0.5, 0.5j])}, "friction: must be real numbers"),
        ({"dt": np.array([0.02, 0.02])}, "dt: must be []"),
        ({"dt": "soon"}, "dt: must be real numbers"),
        ({"shape": np.array([b"c\xff", b"b"])}, "shape: must be names"),
    ],
)
def test_fields_of_another_type_are_named(tmp_path, change, complaint):
    replace(trajectory(), **change).save(tmp_path / "a.npz")
    with pytest.raises(SdfsimError) as error:
        Trajectory.load(tmp_path / "a.npz")
    assert complaint in error.value.message and "a.npz" in error.value.message


def test_the_floor_is_what_the_dataset_says_else_the_recipes(tmp_path):
    assert floor_of({}) == floor_of({"floor": None}) == FLOOR
    assert floor_of({"floor": {"friction": 0.2, "restitution": 0}}) == (0.2, 0.0)
    for wrong in ({"friction": 0.2}, [0.2, 0.3], {"friction": "rough", "restitution": 0.1}):
        with pytest.raises(SdfsimError, match="floor: must have friction and restitution"):
            floor_of({"floor": wrong})
    assert home_of(tmp_path / "test") is None
    write_info(tmp_path, {"recipe": "balls"})
    assert home_of(tmp_path) == home_of(tmp_path / "test") == tmp_path


def test_datasets_of_another_version_of_the_teacher_are_refused_and_those_of_others_are_not(tmp_path):
    ours = {"recipe": "movi-b", "engine": "pybullet", "engine_settings": {"timeStep": 0.004}}
    for version, complaint in (({}, "an earlier teacher whose contacts acted before"), ({"teacher": 9}, "version 9")):
        write_info(tmp_path, ours | version)
        with pytest.raises(SdfsimError, match=complaint) as error:
            read_info(tmp_path)
        assert "sdfsim dataset" in error.value.hint and "\n" not in error.value.message
    for others in ({"recipe": "balls"}, {**ours, "engine": "mujoco"}, {"engine": "pybullet", "engine_settings": {}}):
        write_info(tmp_path, others)
        assert read_info(tmp_path) == others
    write_info(tmp_path, ours | {"teacher": TEACHER_VERSION})
    assert read_info(tmp_path)["teacher"] == 2
