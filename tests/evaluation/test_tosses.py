"""Recorded tosses: which flights count, what errors are, and that every engine flies and meets the table as it
should."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import tosses as bench
from benchmarks.tosses import (
    A_CUBE,
    AN_ELBOW,
    ENGINES,
    FRAMES,
    OURS,
    SIDE,
    Motion,
    errors,
    ours,
    recorded,
)  # fmt: skip
from sdfsim.apps.observed import Recording
from sdfsim.data.public_tosses import CUBE, Links, links_of
from sdfsim.scene.load import load_scene

DT, GRAVITY = 1.0 / 148.0, 9.81
VALUES = {
    "friction": 0.2, "restitution": 0.1, "softness": 0.01, "damping": 1.0, "height": 0.0, "side": 1.0, "inertia": 1.0,
    "stiffness": 5.0, "dissipation": 1.0,
}  # fmt: skip
NAMES = [OURS, *(name for name in ENGINES if name != "Drake" or importlib.util.find_spec("pydrake"))]
SPIN = np.array([1.0, 2.0, 3.0])


def thrown(velocity, angular, *, frames: int = 100, height: float = 0.15) -> Links:
    """A flight in closed form that ends on the table, where the cube stops dead."""
    time = DT * np.arange(frames)[:, None]
    position = [0.1, -0.2, height] + time * velocity - 0.5 * time**2 * [0.0, 0.0, GRAVITY]
    turns = Rotation.from_rotvec(time * angular) * Rotation.from_rotvec([0.4, 1.9, -0.7])
    lowest = position[:, 2] - 0.5 * SIDE * np.abs(turns.as_matrix()[:, 2]).sum(1)
    landed, quat = int((lowest < 0.0).argmax()), turns.as_quat()
    position[landed:], quat[landed:] = position[landed], quat[landed]
    return Links(position[:, None], quat[:, None])


def started(toss: Links, velocity) -> Recording:
    """The first frame of a toss, with its true velocities."""
    speed, spin = np.array(velocity)[None, None], SPIN[None, None]
    yes = np.ones((1, 1), bool)
    place, quat = toss.position[:1], toss.quat_xyzw[:1]
    return Recording("", DT, place, quat, speed, spin, yes[:, 0], yes, yes, (place, quat))


def test_a_flight_gives_its_start(tmp_path):
    velocity = np.array([1.1, -0.4, 0.8])
    ((_, start),) = A_CUBE.begun([thrown(velocity, SPIN)], DT, A_CUBE.load(tmp_path))
    assert start.velocity[0, 0] == pytest.approx(velocity, abs=1e-3)
    assert start.angular_velocity[0, 0] == pytest.approx(SPIN, abs=1e-2)


def test_tosses_without_a_flight_or_with_few_frames_are_left_out(tmp_path):
    short, still = thrown([0.0, 0.0, 1.0], SPIN, frames=60), thrown(np.zeros(3), np.zeros(3), height=0.05)
    assert A_CUBE.flight(still) == 0
    assert not A_CUBE.begun([short, still], DT, A_CUBE.load(tmp_path))


def test_errors_are_those_of_a_shift_and_a_turn():
    toss = thrown(np.array([0.5, 0.0, 1.0]), SPIN)
    truth = recorded([toss, toss])
    assert truth.position.shape == (2, FRAMES, 1, 3)
    turned = Rotation.from_rotvec([0.0, 0.0, np.radians(10.0)]) * Rotation.from_quat(truth.quat_xyzw[1, :, 0])
    moved = Motion(truth.position.copy(), np.stack([truth.quat_xyzw[0], turned.as_quat()[:, None]]))
    moved.position[0] += [0.03 * SIDE, 0.0, 0.04 * SIDE]
    way, angle = errors(moved, truth, SIDE)
    assert way == pytest.approx([5.0, 0.0], abs=1e-9)
    assert angle == pytest.approx([0.0, 10.0], abs=1e-5)


def test_the_angle_of_a_hinge_has_its_own_error():
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (1, FRAMES, 2, 1))
    bent = quat.copy()
    bent[:, :, 1] = Rotation.from_euler("y", 10, degrees=True).as_quat()
    place = np.zeros((1, FRAMES, 2, 3))
    assert errors(Motion(place, bent), Motion(place, quat), 0.1)[:, 0] == pytest.approx([0.0, 5.0, 10.0])


def moved(name: str, starts: list[Recording], height: float, folder: Path) -> Motion:
    if name != OURS:
        return ENGINES[name][0](A_CUBE.load(folder), A_CUBE.inertia, starts, DT, VALUES | {"height": height})
    text = CUBE.format(gravity=-GRAVITY, factor=1.0)
    (folder / "scene.yaml").write_text(text.replace("plane: {}", f"plane: {{offset: {height}}}"))
    return ours(starts, DT, load_scene(folder / "scene.yaml"))


@pytest.mark.parametrize("name", NAMES)
def test_an_engine_flies_along_the_parabola(name, tmp_path):
    """Those that add gravity before they move start half a step earlier; else they are a millimetre low."""
    velocity = np.array([1.0, 0.2, 1.5])
    start = started(thrown(velocity, SPIN), velocity)
    found = moved(name, [start], -10.0, tmp_path)
    time = DT * np.arange(1, FRAMES + 1)[:, None]
    exact = start.position[0] + time * velocity - 0.5 * time**2 * [0.0, 0.0, GRAVITY]
    assert np.abs(found.position[0, :, 0] - exact).max() < 1e-6
    turned = Rotation.from_rotvec(time * SPIN) * Rotation.from_quat(start.orientation[0, 0])
    assert (Rotation.from_quat(found.quat_xyzw[0, :, 0]) * turned.inv()).magnitude().max() < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_tosses_side_by_side_meet_the_table_alone(name, tmp_path):
    """They begin in the same place, where cubes that met each other would be thrown apart."""
    starts = [started(thrown(v, SPIN), v) for v in (np.array([1.0, 0.2, up]) for up in (0.2, 0.3))]
    together = moved(name, starts, 0.0, tmp_path)
    alone = moved(name, starts[1:], 0.0, tmp_path)
    assert np.abs(together.position[1] - alone.position[0]).max() < 1e-6
    lies = 0.5 * SIDE * np.abs(Rotation.from_quat(alone.quat_xyzw[0, -1, 0]).as_matrix()[2]).sum()
    assert alone.position[0, -1, 0, 2] == pytest.approx(lies, abs=3e-3)  # it has come down


@pytest.mark.parametrize("world", [bench.BulletWorld, bench.MujocoWorld])
@pytest.mark.parametrize("angle", [-2.0, 0.9])
def test_a_bent_elbow_begins_as_it_was_tossed(world, angle, tmp_path):
    toss = links_of(np.array([[0.1, -0.2, 0.3]]), Rotation.from_rotvec([[0.4, 1.9, -0.7]]), np.array([angle]))
    still, yes = np.zeros((1, 2, 3)), np.ones((1, 2), bool)
    start = Recording("", DT, *toss, still, still, yes[:, 0], yes, yes, toss)
    values = VALUES | {"drag": 0.0, "damping_of_hinge": 0.0}
    scene = bench.thrown(AN_ELBOW.load(tmp_path), [start], DT, values, AN_ELBOW.inertia)
    place, quat = world(scene, DT).state()[:2]
    assert place == pytest.approx(toss.position[0], abs=1e-6)
    assert (Rotation.from_quat(quat) * Rotation.from_quat(toss.quat_xyzw[0]).inv()).magnitude().max() < 1e-6
