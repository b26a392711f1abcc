"""The engines that ours is compared with do what closed forms say, from recordings and from scenes of any size."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pybullet")

from benchmarks.engines import bullet, drake, mujoco, newton, rapier
from sdfsim.base.errors import SdfsimError
from sdfsim.evaluation.engines import by_engine, start_of_scene
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


def test_the_teacher_has_the_scenes_own_masses_and_starts(tmp_path):
    scene = hard_cases.tossed((3,))
    motion = by_engine(scene, 0.04, bullet, tmp_path).motion
    bodies = scene.bodies[:-1]
    assert motion.position.shape == (3, len(bodies), 3)
    np.testing.assert_allclose(motion.position[0], [b.position for b in bodies], atol=1e-12)
    np.testing.assert_allclose(motion.velocity[0], [b.velocity for b in bodies], atol=1e-6)
    high = [k for k, b in enumerate(bodies) if b.position[2] > 1.5]
    assert high
    fallen = np.array([bodies[k].velocity[2] for k in high]) - 10.0 * 0.04
    np.testing.assert_allclose(motion.velocity[-1, high, 2], fallen, atol=1e-6)


def test_an_inertia_other_than_the_engine_s_is_refused_where_a_recording_has_it(tmp_path):
    start = start_of_scene(hard_cases.wall(2), tmp_path)
    bullet(replace(start, own_inertia=False), 2)
    doubled = replace(start.motion, inertia=2 * start.motion.inertia)
    bullet(replace(start, motion=doubled), 2)
    with pytest.raises(SdfsimError, match="inertia"):
        bullet(replace(start, motion=doubled, own_inertia=False), 2)
