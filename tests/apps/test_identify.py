"""Coefficients and masses found again in motions that were made with known ones."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from sdfsim.apps.identify import COLUMNS, Windows, identify, load_recording
from sdfsim.base.errors import SdfsimError
from sdfsim.scene.load import load_scene
from sdfsim.simulate.simulator import Simulator

FLOOR = {"friction": 0.6, "restitution": 0.9}
BOX = {"friction": 0.7, "restitution": 0.4, "mass": 1.0}
BALL = {"friction": 0.3, "restitution": 0.8, "mass": 3.0}
UNKNOWN = {"friction": 0.5, "restitution": 0.5, "mass": 1.0}


def write_scene(path: Path, box: dict, ball: dict) -> Path:
    """A box that slides and tumbles into a ball that bounces."""
    bodies = [
        {"name": "floor", "motion": "static", "plane": {"normal": [0, 0, 1], "offset": 0.0}, **FLOOR},
        {"name": "box", "shape": "box", "position": [0, 0, 1], "velocity": [3, 0, 0]}
        | {"angular_velocity": [0.5, 2, 1], **box},
        {"name": "ball", "shape": "ball", "position": [2, 0, 1.2], "velocity": [-4, 0.1, 0], **ball},
    ]
    shapes = {"box": {"box": {"size": [1, 0.8, 0.6]}}, "ball": {"sphere": {"radius": 0.5}}}
    data = {"version": 1, "model": "solver", "duration": 3.0, "shapes": shapes, "bodies": bodies}
    path.write_text(yaml.safe_dump(data))
    return path


def write_poses(path: Path, rollout) -> Path:
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        for t, time in enumerate(rollout.time):
            for k, name in enumerate(rollout.names):
                rows.writerow([time, name, *rollout.position[t, k], *rollout.orientation[t, k]])
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the motion of known bodies, and the scene as one knows it who has only watched."""
    folder = tmp_path_factory.mktemp("recorded")
    rollout = Simulator(load_scene(write_scene(folder / "known.yaml", BOX, BALL)), "solver").run()
    rollout.save(folder / "rollout.npz")
    write_poses(folder / "poses.csv", rollout)
    write_scene(folder / "scene.yaml", UNKNOWN, UNKNOWN)
    return folder


@pytest.mark.parametrize(
    ("file", "exact"), [("rollout.npz", 0.01), pytest.param("poses.csv", 0.05, marks=pytest.mark.slow)]
)
def test_what_a_motion_was_made_with_is_found_again(recorded, file, exact):
    found = identify(*load_recording(recorded / file, recorded / "scene.yaml"))
    for kind in ("friction", "restitution"):
        own = {"box": BOX[kind], "ball": BALL[kind]}
        products = {"box / floor": own["box"] * FLOOR[kind], "ball / floor": own["ball"] * FLOOR[kind]}
        products["box / ball"] = own["box"] * own["ball"]
        for expected, estimates in ((own, found[f"own_{kind}"]), (products, found[kind])):
            assert set(estimates) == set(expected)
            for name, value in expected.items():
                assert estimates[name]["value"] == pytest.approx(value, abs=exact), (kind, name)
                low, high = estimates[name]["interval"]
                assert low <= estimates[name]["value"] <= high and high - low < 0.2
    assert found["mass"]["ball"]["value"] == pytest.approx(3.0, rel=exact)


def test_what_a_motion_does_not_show_is_not_made_up(recorded, tmp_path):
    """Up to 0.9 s the box has slid on the floor and met the ball, but these two never slid on each other for long."""
    Simulator(load_scene(recorded / "known.yaml"), "solver").run(0.9).save(tmp_path / "rollout.npz")
    found = identify(*load_recording(tmp_path / "rollout.npz", recorded / "scene.yaml"))
    assert found["friction"]["box / ball"] == {"value": None, "interval": None}
    assert found["own_friction"]["box"]["value"] == pytest.approx(BOX["friction"], abs=0.01)


def test_a_body_that_only_falls_shows_nothing(recorded, tmp_path):
    scene = load_scene(recorded / "known.yaml")
    up = np.array([0.0, 0.0, 50.0])
    high = tuple(replace(b, position=b.position + up, velocity=up) for b in scene.bodies[1:])
    Simulator(replace(scene, bodies=(scene.bodies[0], *high), duration=0.5), "solver").run().save(
        tmp_path / "rollout.npz"
    )
    with pytest.raises(SdfsimError, match="nothing touches"):
        identify(*load_recording(tmp_path / "rollout.npz", recorded / "scene.yaml"))


def test_a_fit_leaves_the_bodies_as_they_are(recorded):
    recording, scene = load_recording(recorded / "rollout.npz", recorded / "scene.yaml")
    windows = Windows(recording, scene)
    names = ("mass", "inverse_mass", "inertia", "friction", "restitution")
    before = {name: getattr(windows.bodies, name).copy() for name in names}
    usual = windows.errors(windows.start(0.5, 0.5))
    other = windows.start(0.1, 0.9)
    other[-1] = 0.7
    assert np.abs(windows.errors(other) - usual).max() > 0.1
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(windows.bodies, name), values, err_msg=name)
