"""The engines that ours is compared with do what closed forms say; a scene file becomes a case in the model's units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.dynamics.model import load_model
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.tradeoff_contenders import Ours
from sdfsim.evaluation.tradeoff_engines import Engine
from sdfsim.evaluation.tradeoff_knobs import Setting
from sdfsim.evaluation.tradeoff_scene import cases_of_scene

SCENE = """
version: 1
duration: 0.4
shapes:
  box: {box: {size: [0.1, 0.1, 0.1]}}
bodies:
  - {name: floor, plane: {offset: 0.5}, friction: 0.8, restitution: 0.5}
  - {name: low, shape: box, position: [0, 0, 0.5501], mass: 1.0, friction: 0.5, restitution: 0.1}
  - {name: high, shape: box, position: [3, 0, 9], velocity: [1, 0, 0], angular_velocity: [0, 0, 2], mass: 2.0}
"""


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.yaml").write_text(SCENE)
    return cases_of_scene(folder / "scene.yaml", "small", folder / "scratch", quick=True, on_progress=lambda *_: None)


def flight(cases, motion):
    """Errors m of the free body against its parabola, scene units; and degrees turned in all."""
    t = np.arange(len(motion.position)) * motion.dt * cases.time
    path = np.array([3.0, 0.0, 8.5]) + np.outer(t, [1.0, 0, 0]) + 0.5 * np.outer(t * t, [0, 0, -9.81])
    turned = 2 * np.degrees(np.arctan2(motion.quat_xyzw[-1, 1, 2], motion.quat_xyzw[-1, 1, 3]))
    return np.linalg.norm(cases.length * motion.position[:, 1] - path, axis=-1).max(), turned, np.degrees(2.0 * t[-1])


def test_a_scene_becomes_a_case_in_the_model_s_units(cases):
    assert cases.length == pytest.approx(0.1 / load_model("small").length, rel=0.02)
    assert cases.time == pytest.approx(np.sqrt(cases.length * 10.0 / 9.81))
    assert cases.steps == min(50, round(0.4 / cases.time / 0.02))
    assert cases.floor == (0.8, 0.5) and np.allclose(cases.recorded[0].gravity, [0, 0, -10])
    far, turned, expected = flight(cases, cases.recorded[0])
    assert far < 1e-4 and turned == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("name", ["PyBullet", "MuJoCo"])
@pytest.mark.parametrize("substeps", [5, 2])
def test_engines_fly_freely_and_rest(cases, name, substeps):
    pytest.importorskip(name.lower())
    prepared = Engine(name, substeps).prepare(cases)
    (motion,) = prepared.motions()
    far, turned, expected = flight(cases, motion)
    # A symplectic step of h is off by g h t / 2 at most.
    slack = 0.5 * 9.81 * 0.4 * 0.02 / substeps * cases.time
    assert far < slack + 1e-4 and turned == pytest.approx(expected, abs=0.1)
    resting = cases.length * motion.position[:, 0]
    assert np.abs(resting - [0, 0, 0.05]).max() < 0.002
    timed = prepared.timed()
    assert timed.cpu > 0 and timed.simulated == pytest.approx(0.02 * (cases.timed_steps - 1))
    assert timed.scenes[0]["bodies"] == 2


def test_ours_flies_exactly_and_starts_where_the_scene_does(cases):
    (motion,) = Ours(Setting()).prepare(cases).motions()
    far, turned, expected = flight(cases, motion)
    assert far < 1e-9 and turned == pytest.approx(expected, abs=1e-6)
    timed = Ours(Setting()).prepare(cases).timed()
    assert np.allclose(timed.end[:2], motion.position[cases.timed_steps], atol=1e-4)


def test_other_steps_and_missing_pieces_are_told(cases):
    other = replace(cases, recorded=[replace(cases.recorded[0], dt=0.01)])
    with pytest.raises(SdfsimError, match="another step"):
        Engine("PyBullet", 5).prepare(other)
    with pytest.raises(SdfsimError, match="no engine file"):
        Engine("PyBullet", 5).prepare(replace(cases, urdfs={}))


@pytest.mark.parametrize(
    ("floor", "message"),
    [
        ("{name: floor, plane: {normal: [0, 1, 1]}}", "one level plane"),
        ("{name: b, shape: box, motion: static}", "0 planes"),
        ("{name: floor, plane: {}, collides_with: []}", "may not touch all others"),
    ],
)
def test_scenes_that_the_teacher_does_not_know_are_refused(tmp_path, floor, message):
    lines = SCENE.splitlines()
    lines[6] = f"  - {floor}"
    (tmp_path / "scene.yaml").write_text("\n".join(lines))
    with pytest.raises(SdfsimError, match=message):
        cases_of_scene(tmp_path / "scene.yaml", "small", tmp_path, quick=True, on_progress=lambda *_: None)


def test_effects_that_are_off_are_not_measured_as_if_they_were_on(tmp_path):
    (tmp_path / "scene.yaml").write_text(SCENE.replace("version: 1", "version: 1\neffects: {friction: off}"))
    with pytest.raises(SdfsimError, match="effects: friction is off"):
        cases_of_scene(tmp_path / "scene.yaml", "small", tmp_path, quick=True, on_progress=lambda *_: None)


def test_a_scene_in_which_nothing_moves_has_nothing_to_compare(tmp_path):
    (tmp_path / "scene.yaml").write_text("\n".join(line for line in SCENE.splitlines() if "shape: box" not in line))
    with pytest.raises(SdfsimError, match="nothing moves"):
        cases_of_scene(tmp_path / "scene.yaml", "small", tmp_path, quick=True, on_progress=lambda *_: None)
