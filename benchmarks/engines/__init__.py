"""What only comparisons need of engines: ours timed like the others, their motions in our units, Drake and Newton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sdfsim.data.dataset import Trajectory
from sdfsim.evaluation.engines import SI, Timing, solid_bodies, timed
from sdfsim.physics.bodies import Units
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import PlaneSdf
from sdfsim.simulate.simulator import Simulator, join


def ours(simulator: Simulator, steps: int) -> tuple[Rollout, Timing]:
    """Our motion, and its time."""
    frames: list[Rollout] = []
    timing = timed(lambda count: frames.extend(simulator.frames(count)), steps)
    return join(frames), timing


def motion_rollout(scene: Scene, motion: Trajectory, units: Units = SI) -> Rollout:
    """An engine's motion from a `start_of_scene` in `units` as a rollout of the scene in SI units, without contacts."""
    steps, solid = len(motion.position), solid_bodies(scene)
    arrays = {name: np.zeros((steps, len(solid), 4 if name == "orientation" else 3)) for name in MOTION}
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    own = {"position": units.length, "velocity": units.velocity, "angular_velocity": 1.0 / units.time}
    for name, values in arrays.items():
        values[:, solid] = own.get(name, 1.0) * getattr(motion, name)
    for k, plane in zip(np.flatnonzero(~solid), planes, strict=True):
        arrays["position"][:, k], arrays["orientation"][:, k] = plane.position, plane.quat_xyzw
        arrays["position"][:, solid, 2] += plane.position[2]
    dt = float(motion.dt) * units.time
    return Rollout(
        time=dt * np.arange(steps),
        **arrays,
        contact_count=np.zeros(steps, np.int64),
        contact_point=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), np.int64),
        names=tuple(b.name for b in scene.bodies),
        meta={"dt": dt},
    )


def in_metres(motion: Trajectory, units: Units) -> Trajectory:
    """An engine's motion from a `start_of_scene` in `units`, with positions, scales and velocities in m and m/s."""
    lengths = {"position": units.length, "scale": units.length, "velocity": units.velocity}
    return replace(motion, **{name: factor * getattr(motion, name) for name, factor in lengths.items()})
