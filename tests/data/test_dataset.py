"""The trajectory format: what is written comes back, faults are named, and velocities are those at the instants."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_json
from sdfsim.data.dataset import (
    FLOOR,
    Conditions,
    Trajectory,
    at_instants,
    conditions_of,
    engine_substep,
    floor_of,
    read_info,
    trajectory_files,
)
from sdfsim.data.pybullet_sim import TEACHER_VERSION, engine_settings
from tests.helpers.recordings import balls, trajectory

SUBSTEP, DT, GRAVITY = 0.004, 0.02, np.array([0.0, 0.0, -10.0])


def test_round_trip(tmp_path):
    one = trajectory()
    one.save(tmp_path / "a.npz")
    two = Trajectory.load(tmp_path / "a.npz")
    assert two.dt == one.dt and list(two.shape) == ["cube", "spot"]
    np.testing.assert_array_equal(two.position, one.position)
    np.testing.assert_array_equal(two.velocity, one.velocity)  # no dataset.json tells of an inner step
    assert trajectory_files(tmp_path, "test") == [tmp_path / "a.npz"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mass": np.array([-1.0, 1.0])}, "mass: must be > 0"),
        ({"orientation": np.zeros((4, 2, 3))}, "quat_xyzw: must be [4, 2, 4]"),
        ({"orientation": np.zeros((4, 2, 4))}, "quat_xyzw: must be unit quaternions"),
        ({"shape": np.array(["cube", "../cube"])}, "shape: '../cube'"),
        ({"static": np.array([0, 2])}, "static: must be true or false"),
    ],
)
def test_faults_are_named(tmp_path, change, complaint):
    replace(trajectory(), **change).save(tmp_path / "a.npz")
    with pytest.raises(SdfsimError) as error:
        Trajectory.load(tmp_path / "a.npz")
    assert complaint in error.value.message and "a.npz" in error.value.message


def test_whole_numbers_are_read_as_what_they_mean(tmp_path):
    """Also where a writer of its own has no booleans: 0 and 1 are not to be taken for indices."""
    whole = {"static": np.array([0, 1]), "mass": np.array([2, 0]), "inertia": np.ones((2, 3), dtype=np.int32)}
    replace(trajectory(), **whole, velocity=np.zeros((4, 2, 3), dtype=np.float32)).save(tmp_path / "a.npz")
    found = Trajectory.load(tmp_path / "a.npz")
    assert found.static.dtype == bool and found.mass[~found.static].tolist() == [2.0]
    assert {getattr(found, name).dtype for name in ("mass", "inertia", "velocity")} == {np.dtype(np.float64)}


def test_the_floor_is_what_the_dataset_says_else_the_recipes():
    assert floor_of({}) == floor_of({"floor": None}) == FLOOR
    assert floor_of({"floor": {"friction": 0.2, "restitution": 0}}) == (0.2, 0.0)
    wrong = [{}, [], 0, "ice", {"friction": 0.2}, {"friction": -0.1, "restitution": 0}]
    wrong += [{"friction": 0.2, "restitution": value} for value in (1.5, -0.1, float("nan"), "0.3", None, True)]
    wrong += [{"friction": float("inf"), "restitution": 0.1}]
    for told in wrong:
        with pytest.raises(SdfsimError, match=r"^data.dataset\.json: floor: "):
            floor_of({"floor": told}, Path("data"))


def test_a_split_is_recorded_as_its_dataset_says(tmp_path):
    (tmp_path / "test").mkdir()
    assert conditions_of(tmp_path / "test") == Conditions(FLOOR, floor_given=False)
    told = {"engine": "pybullet", "engine_settings": engine_settings(1 / 240, 1)}
    write_json(tmp_path / "dataset.json", told | {"floor": {"friction": 0.7, "restitution": 0.1}})
    found = conditions_of(tmp_path / "test")
    assert found == conditions_of(tmp_path) == Conditions((0.7, 0.1), floor_given=True)


def test_datasets_of_another_version_of_the_teacher_are_refused_and_those_of_others_are_not(tmp_path):
    ours = {"recipe": "movi-b", "engine": "pybullet", "engine_settings": {"timeStep": 0.004}}
    for version in ({}, {"teacher": 9}):
        write_json(tmp_path / "dataset.json", ours | version)
        with pytest.raises(SdfsimError, match=r"(?m)\bteacher\b.*\b2$"):
            read_info(tmp_path)
    for others in ({"recipe": "balls"}, {**ours, "engine": "mujoco"}, ours | {"teacher": TEACHER_VERSION}):
        write_json(tmp_path / "dataset.json", others)
        assert read_info(tmp_path) == others


def symplectic(frames: int = 12, speed: float = 3.0) -> Trajectory:
    """A ball that an engine throws by symplectic Euler and that lies still from frame 6 on."""
    position, velocity = np.zeros((frames, 1, 3)), np.zeros((frames, 1, 3))
    velocity[0, 0, 2] = speed
    for k in range(1, frames):
        v, x = velocity[k - 1].copy(), position[k - 1].copy()
        for _ in range(5):
            v = v + SUBSTEP * GRAVITY
            x = x + SUBSTEP * v
        velocity[k], position[k] = v, x
    position[6:], velocity[6:] = position[6], 0.0
    return replace(balls(position), velocity=velocity)


def test_flights_are_parabolas_of_the_velocities_at_instants_and_bodies_that_lie_keep_theirs():
    motion = at_instants(symplectic(), SUBSTEP)
    for k in range(5):
        fallen = motion.position[k] + motion.velocity[k] * DT + 0.5 * GRAVITY * DT**2
        np.testing.assert_allclose(motion.position[k + 1], fallen, atol=1e-12)
    np.testing.assert_array_equal(motion.velocity[7:], 0.0)
    static = at_instants(replace(symplectic(), static=np.array([True])), SUBSTEP)
    np.testing.assert_array_equal(static.velocity, symplectic().velocity)


def test_a_loaded_trajectory_has_the_velocities_at_instants_unless_asked_as_recorded(tmp_path):
    (tmp_path / "test").mkdir()
    file = tmp_path / "test" / "a.npz"
    symplectic().save(file)
    assert engine_substep(tmp_path) == 0.0  # no dataset.json
    np.testing.assert_array_equal(Trajectory.load(file).velocity, symplectic().velocity)
    write_json(tmp_path / "dataset.json", {"engine_settings": None})
    assert engine_substep(tmp_path) == 0.0
    write_json(tmp_path / "dataset.json", {"engine_settings": {"timeStep": SUBSTEP}})
    assert engine_substep(tmp_path) == engine_substep(tmp_path / "test") == SUBSTEP
    np.testing.assert_array_equal(Trajectory.load(file).velocity, at_instants(symplectic(), SUBSTEP).velocity)
    np.testing.assert_array_equal(Trajectory.load(file, as_recorded=True).velocity, symplectic().velocity)
    for settings in ("x", {"timeStep": -1}, {"timeStep": 1e9}):
        write_json(tmp_path / "dataset.json", {"engine_settings": settings})
        with pytest.raises(SdfsimError, match=r"engine_settings\.timeStep: .*\b1 s"):
            Trajectory.load(file)
