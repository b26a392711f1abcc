"""Recorded tosses: the start that a flight is fitted with, by closed form, by the rest of the flight, and by the
velocities that the recording's own authors give."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.reality import (
    EACH,
    ENGINES,
    GRAVITY,
    OURS,
    SIDE,
    Toss,
    cube,
    errors,
    fall,
    fitted_start,
    flight,
    load_tosses,
    split,
)  # fmt: skip
from benchmarks.tosses import FIT, FRAMES, TEST, Motion, Start, cost, ours, recorded, searched
from sdfsim.base.errors import SdfsimError
from sdfsim.data.public_tosses import CUBE
from sdfsim.scene.load import load_scene

DT = 1.0 / 148.0
VALUES = {
    "friction": 0.2, "restitution": 0.1, "softness": 0.01, "damping": 1.0, "height": 0.0, "side": 1.0, "inertia": 1.0,
    "stiffness": 5.0, "dissipation": 1.0,
}  # fmt: skip
NAMES = [OURS, *(name for name in ENGINES if name != "Drake" or importlib.util.find_spec("pydrake"))]


@pytest.fixture(scope="module")
def folder(data_dir) -> Path:
    if not (data_dir / "tosses" / "cube.npz").is_file():
        pytest.skip(f"recorded tosses are not at {data_dir / 'tosses'} (set SDFSIM_DATA)")
    return data_dir / "tosses"


def thrown(velocity, angular, *, frames: int = 60, noise: float = 0.0, height: float = 0.15) -> Toss:
    """A flight in closed form that ends on the table, where the cube stops dead. Quaternions change sign at will, as
    trackers' do."""
    rng, time = np.random.default_rng(3), DT * np.arange(frames)[:, None]
    position = [0.1, -0.2, height] + time * velocity - 0.5 * time**2 * [0.0, 0.0, GRAVITY]
    turns = Rotation.from_rotvec(time * angular) * Rotation.from_rotvec([0.4, 1.9, -0.7])
    lowest = position[:, 2] - 0.5 * SIDE * np.abs(turns.as_matrix()[:, 2]).sum(1)
    landed = int((lowest < 0.0).argmax())
    position[landed:] = position[landed]
    quat = turns.as_quat() * rng.choice([-1.0, 1.0], size=(frames, 1))
    quat[landed:] = quat[landed]
    return Toss(DT, position + noise * rng.standard_normal(position.shape), quat)


@pytest.mark.parametrize("angular", [(0.0, 0.0, 0.0), (2.0, -5.0, 9.0), (30.0, 10.0, -60.0)])
def test_a_flight_gives_its_start(angular):
    velocity = np.array([1.1, -0.4, 0.3])
    toss = thrown(velocity, np.array(angular))
    start = fitted_start(toss)
    assert 6 <= start.flight < len(toss.position)  # what comes after the impact would be far off
    assert start.velocity == pytest.approx(velocity, abs=1e-9)
    assert start.angular_velocity == pytest.approx(angular, abs=1e-6)
    assert start.position == pytest.approx([0.1, -0.2, 0.15], abs=1e-9)
    turned = Rotation.from_quat(start.quat_xyzw) * Rotation.from_rotvec([0.4, 1.9, -0.7]).inv()
    assert turned.magnitude() < 1e-8
    assert start.off < 1e-9 and start.turned_off < 1e-8


def test_noise_is_averaged_out():
    """Of a millimetre of noise a raw difference makes 0.2 m/s."""
    toss = thrown(np.array([0.5, 0.0, 1.0]), np.zeros(3), noise=1e-3)
    start = fitted_start(toss)
    raw = (toss.position[1] - toss.position[0]) / DT
    assert np.linalg.norm(start.velocity - [0.5, 0.0, 1.0]) < 0.05 < np.linalg.norm(raw - [0.5, 0.0, 1.0])
    assert start.off == pytest.approx(np.sqrt(3.0) * 1e-3, rel=0.2)


def test_the_acceleration_of_falling_is_found():
    tosses = [thrown(np.array([0.5, 0.0, v]), np.zeros(3), noise=1e-4) for v in (0.6, 0.8, 1.0)]
    found, sure = fall(tosses)
    assert found == pytest.approx(GRAVITY, abs=0.1)
    assert 0.0 < sure < 0.1


def test_a_toss_that_begins_on_the_table_has_no_start():
    with pytest.raises(SdfsimError, match="0 frames before its first impact"):
        fitted_start(thrown(np.zeros(3), np.zeros(3), height=0.05))


def test_errors_are_those_of_a_shift_and_a_turn():
    toss = thrown(np.array([0.5, 0.0, 1.0]), np.array([1.0, 2.0, 3.0]), frames=100)
    truth = recorded([toss, toss])
    assert truth.position.shape == (2, FRAMES, 3)
    turned = Rotation.from_rotvec([0.0, 0.0, np.radians(10.0)]) * Rotation.from_quat(truth.quat_xyzw[1])
    moved = Motion(truth.position.copy(), np.stack([truth.quat_xyzw[0], turned.as_quat()]))
    moved.position[0] += [0.03 * SIDE, 0.0, 0.04 * SIDE]
    way, angle = errors(moved, truth)
    assert way == pytest.approx([5.0, 0.0], abs=1e-9)
    assert angle == pytest.approx([0.0, 10.0], abs=1e-5)


def moved(name: str, starts: list[Start], height: float, folder: Path) -> Motion:
    if name != OURS:
        return ENGINES[name][0](cube(GRAVITY, folder), EACH, starts, DT, VALUES | {"height": height})
    text = CUBE.format(gravity=-GRAVITY, factor=1.0)
    (folder / "scene.yaml").write_text(text.replace("plane: {}", f"plane: {{offset: {height}}}"))
    return ours(starts, DT, load_scene(folder / "scene.yaml"))


@pytest.mark.parametrize("name", NAMES)
def test_an_engine_flies_along_the_parabola(name, tmp_path):
    """Those that add gravity before they move start half a step earlier; else they are a millimetre low."""
    start = fitted_start(thrown(np.array([1.0, 0.2, 1.5]), np.array([1.0, 2.0, 3.0]), frames=100))
    found = moved(name, [start], -10.0, tmp_path)
    time = DT * np.arange(1, FRAMES + 1)[:, None]
    exact = start.position + time * start.velocity - 0.5 * time**2 * [0.0, 0.0, GRAVITY]
    assert np.abs(found.position[0] - exact).max() < 1e-6
    turned = Rotation.from_rotvec(time * start.angular_velocity) * Rotation.from_quat(start.quat_xyzw)
    assert (Rotation.from_quat(found.quat_xyzw[0]) * turned.inv()).magnitude().max() < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_tosses_side_by_side_meet_the_table_alone(name, tmp_path):
    """They begin in the same place, where cubes that met each other would be thrown apart."""
    starts = [
        fitted_start(thrown(np.array([1.0, 0.2, up]), np.array([1.0, 2.0, 3.0]), frames=100)) for up in (0.2, 0.3)
    ]
    together = moved(name, starts, 0.0, tmp_path)
    alone = moved(name, starts[1:], 0.0, tmp_path)
    assert np.abs(together.position[1] - alone.position[0]).max() < 1e-9
    lies = 0.5 * SIDE * np.abs(Rotation.from_quat(alone.quat_xyzw[0, -1]).as_matrix()[2]).sum()
    assert alone.position[0, -1, 2] == pytest.approx(lies, abs=3e-3)  # it has come down


def test_the_search_finds_a_minimum_within_bounds():
    bounds = {"friction": (0.0, 1.0), "side": (0.9, 1.1)}
    found = searched(lambda v: (v["friction"] - 0.3) ** 2 + 100.0 * (v["side"] - 1.02) ** 2, bounds)
    assert found == pytest.approx({"friction": 0.3, "side": 1.02}, abs=0.02)
    found = searched(lambda v: v["friction"] - 5.0 * v["side"], bounds)
    assert found == pytest.approx({"friction": 0.0, "side": 1.1}, abs=0.05)
    assert all(low <= found[name] <= high for name, (low, high) in bounds.items())


def test_a_toss_that_ends_on_another_face_counts_as_far():
    truth = Motion(np.zeros((2, FRAMES, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, FRAMES, 1)))
    turned = truth.quat_xyzw.copy()
    turned[1] = Rotation.from_euler("x", 90, degrees=True).as_quat()
    assert cost(errors(Motion(truth.position, turned), truth)) == pytest.approx(15.0)
    turned[1] = Rotation.from_euler("x", 20, degrees=True).as_quat()
    assert cost(errors(Motion(truth.position, turned), truth)) == pytest.approx(10.0)


def test_no_recordings_are_told(tmp_path):
    with pytest.raises(SdfsimError, match=r"cube\.npz: no such file"):
        load_tosses(tmp_path)
    np.savez(tmp_path / "cube.npz", start=[0, 3], dt=DT, position=np.zeros((3, 3)))
    with pytest.raises(SdfsimError, match=r"cube\.npz: there is no array 'quat_xyzw'"):
        load_tosses(tmp_path)


def test_recorded_tosses_fly_as_fitted(folder):
    tosses = [toss for toss in load_tosses(folder) if flight(toss) >= 12]
    starts = [fitted_start(toss) for toss in tosses]
    assert len(tosses) > 300
    assert np.median([start.off for start in starts]) < 2e-4
    assert np.median([start.turned_off for start in starts]) < np.radians(0.06)
    # The first two thirds of a flight tell where it goes.
    ahead = []
    for toss, start in zip(tosses, starts, strict=True):
        known = 2 * start.flight // 3
        begun = fitted_start(Toss(toss.dt, toss.position[:known], toss.quat_xyzw[:known]))
        time = toss.dt * (start.flight - 1)
        there = begun.position + time * begun.velocity - [0.0, 0.0, 0.5 * GRAVITY * time**2]
        ahead.append(np.linalg.norm(there - toss.position[start.flight - 1]))
    assert np.median(ahead) < 2e-3


def test_recorded_tosses_have_the_velocities_of_their_authors(folder):
    """Theirs are smoothed differences, in the world's frame."""
    with np.load(folder / "cube.npz") as told:
        first = told["start"][:-1]
        velocity, angular = told["velocity"][first + 3], told["angular_velocity"][first + 3]
    tosses = load_tosses(folder)
    rows = [k for k, toss in enumerate(tosses) if flight(toss) >= 12]
    starts = [fitted_start(tosses[k]) for k in rows]
    then = np.array([start.velocity - [0.0, 0.0, 3 * DT * GRAVITY] for start in starts])
    turning = np.array([start.angular_velocity for start in starts])
    assert np.median(np.linalg.norm(then - velocity[rows], axis=1)) < 0.03
    assert np.median(np.linalg.norm(turning - angular[rows], axis=1)) < 0.3
    assert np.median(np.linalg.norm(turning, axis=1)) > 3.0


def test_tosses_are_split_apart(folder):
    fit, test, rest = split(load_tosses(folder))
    assert (len(fit), len(test)) == (FIT, TEST)
    every = [*fit, *test, *rest]
    assert len({toss.position.tobytes() for toss in every}) == len(every)
    assert min(len(toss.position) for toss in every) > FRAMES
