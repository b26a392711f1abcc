"""Recorded velocities become those at the instants of positions, where bodies fly."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.data.velocities import at_instants, engine_substep
from sdfsim.errors import SdfsimError
from sdfsim.files import write_json
from tests.recordings import balls

SUBSTEP, DT, GRAVITY = 0.004, 0.02, np.array([0.0, 0.0, -10.0])


def symplectic(frames: int, speed: float):
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


def test_flights_are_parabolas_of_the_velocities_at_instants():
    motion = at_instants(symplectic(12, 3.0), SUBSTEP)
    for k in range(5):
        fallen = motion.position[k] + motion.velocity[k] * DT + 0.5 * GRAVITY * DT**2
        np.testing.assert_allclose(motion.position[k + 1], fallen, atol=1e-12)


def test_what_lies_keeps_its_velocity():
    recorded = symplectic(12, 3.0)
    motion = at_instants(recorded, SUBSTEP)
    np.testing.assert_array_equal(motion.velocity[7:], 0.0)
    assert (motion.velocity[:5, 0, 2] < recorded.velocity[:5, 0, 2]).all()


def test_static_bodies_do_not_fall():
    motion = at_instants(replace(symplectic(12, 3.0), static=np.array([True])), SUBSTEP)
    np.testing.assert_array_equal(motion.velocity, symplectic(12, 3.0).velocity)


@pytest.mark.parametrize("settings", ["x", {"timeStep": "abc"}, {"timeStep": -1}, {"timeStep": 1e9}])
def test_an_inner_step_that_is_none_is_named(tmp_path, settings):
    write_json(tmp_path / "dataset.json", {"engine_settings": settings})
    with pytest.raises(SdfsimError, match=r"dataset.json: engine_settings.timeStep: must be 0 \(unknown\) to 1 s"):
        engine_substep(tmp_path)


def test_an_inner_step_is_that_of_the_dataset_or_unknown(tmp_path):
    assert engine_substep(tmp_path) == 0.0
    write_json(tmp_path / "dataset.json", {"engine_settings": None})
    assert engine_substep(tmp_path) == 0.0
    write_json(tmp_path / "dataset.json", {"engine_settings": {"timeStep": 0.004}})
    (tmp_path / "test").mkdir()
    assert engine_substep(tmp_path) == engine_substep(tmp_path / "test") == 0.004
