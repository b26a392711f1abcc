"""The engines that ours is compared with do what closed forms say, from recordings and from scenes of any size."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from benchmarks.engines import bullet, drake, mujoco, newton, rapier
from sdfsim.base.errors import SdfsimError
from sdfsim.evaluation.engines import start_of_scene
from sdfsim.evaluation.laws import hard_cases
from sdfsim.learned.model import load_model
from sdfsim.scene.load import load_scene
from sdfsim.simulate.steppers import stepper_of
from tests.helpers.scene_files import SCENE


def started(folder, text: str = SCENE):
    (folder / "scene.yaml").write_text(text)
    scene = load_scene(folder / "scene.yaml")
    units = stepper_of(load_model("gnn", weights=False)).units(scene)
    return start_of_scene(scene, folder / "engine", units), units


def test_a_scene_is_a_start_in_the_model_s_units(tmp_path):
    start, units = started(tmp_path)
    assert start.floor == (0.8, 0.5)
    motion = start.motion
    assert np.allclose(motion.gravity, [0, 0, -10])
    np.testing.assert_allclose(units.length * motion.position[0], [[0, 0, 0.0501], [3, 0, 8.5]])
    np.testing.assert_allclose(motion.velocity[0, 1], [1 / units.velocity, 0, 0])
    cube = motion.mass * (0.1 / units.length) ** 2 / 6
    np.testing.assert_allclose(motion.inertia, np.stack([cube] * 3, -1))


@pytest.mark.parametrize("substeps", [5, 2])
@pytest.mark.parametrize(
    ("run", "package"),
    [(bullet, "pybullet"), (mujoco, "mujoco"), (rapier, "rapier3d"), (drake, "pydrake"), (newton, "newton")],
)
def test_what_rests_stays_and_steps_are_timed(tmp_path, run, package, substeps):
    pytest.importorskip(package)
    start, units = started(tmp_path)
    steps = round(0.4 / units.time / 0.02)
    motion, timing = run(start, steps, substeps)
    assert np.abs(units.length * motion.position[:, 0] - [0, 0, 0.05]).max() < 0.002
    assert timing.cpu_ms > 0 and timing.first_ms > 0


def test_an_inertia_other_than_the_engine_s_is_refused_where_a_recording_has_it(tmp_path):
    start = start_of_scene(hard_cases.wall(2), tmp_path)
    bullet(replace(start, own_inertia=False), 2)
    doubled = replace(start.motion, inertia=2 * start.motion.inertia)
    bullet(replace(start, motion=doubled), 2)
    with pytest.raises(SdfsimError, match="inertia"):
        bullet(replace(start, motion=doubled, own_inertia=False), 2)
