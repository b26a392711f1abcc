"""A scene run by a model of ours or by another engine: both give the same record."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import DT
from sdfsim.evaluation.engines import (
    SI,
    Engine,
    NotInstalled,
    Timing,
    TooSlow,
    solid_bodies,
    start_motion,
    start_of_scene,
    timed,
)
from sdfsim.learned.model import SOLVER, Model
from sdfsim.physics.bodies import Units
from sdfsim.physics.motion import MOTION
from sdfsim.physics.rollout import Rollout, join
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import PlaneSdf
from sdfsim.simulate.simulator import SimulationError, Simulator


@dataclass(frozen=True)
class Ran:
    """A motion of a scene, up to its last good state."""

    scene: Scene
    rollout: Rollout  # SI units; an engine's has no contacts and no counters
    broke: str = ""  # why it ended early

    @property
    def time(self) -> np.ndarray:
        """[T] s."""
        return self.rollout.time

    @cached_property
    def motion(self) -> Trajectory:
        """The bodies that are not planes as a recording; shapes are named by their index in the scene."""
        solid = solid_bodies(self.scene)
        frames = {name: getattr(self.rollout, name)[:, solid] for name in MOTION}
        return replace(start_motion(self.scene), **frames, dt=float(self.rollout.meta["dt"]))

    @property
    def path(self) -> np.ndarray:
        """[T, M, 3] m, positions of the dynamic bodies."""
        return self.motion.position[:, ~self.motion.static]


Runner = Callable[[Scene, float], Ran]  # runs a scene for so many seconds


def by_model(scene: Scene, seconds: float, model: str | Model = SOLVER, device: str = "cpu") -> Ran:
    try:
        return Ran(scene, Simulator(scene, model, device).run(seconds))
    except SimulationError as error:
        return Ran(scene, error.rollout, error.message)


def by_engine(scene: Scene, seconds: float, engine: Engine, folder: Path, units: Units = SI) -> Ran:
    """An engine's motion of a scene, which it runs in `units`, with its files in `folder`; its bodies never sleep.
    Where the motion fails they stay where they started.

    Raises:
        SdfsimError: see `start_of_scene`. NotInstalled, TooSlow.
    """
    start = start_of_scene(scene, folder, units)
    try:
        motion, _ = engine(start, max(1, round(seconds / (DT * units.time))))
    except (NotInstalled, TooSlow):
        raise
    except SdfsimError as error:
        return still(scene, seconds, error.message)
    if not (np.isfinite(motion.position).all() and np.isfinite(motion.velocity).all()):
        return still(scene, seconds, "a position is not finite")
    return Ran(scene, scene_rollout(scene, motion, units))


def still(scene: Scene, seconds: float, broke: str = "") -> Ran:
    """A run in which all bodies stay where they started: what is judged where there is no motion."""
    first = Simulator(scene, SOLVER).initial_rollout()
    return Ran(scene, join([first, replace(first, time=first.time + seconds)]), broke)


def scene_rollout(scene: Scene, motion: Trajectory, units: Units = SI) -> Rollout:
    """An engine's motion from a `start_of_scene` in `units` as a rollout of the scene in SI units, without contacts."""
    steps, solid = len(motion.position), solid_bodies(scene)
    arrays: dict[str, Any] = {}
    planes = [b for b in scene.bodies if isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    for name, values in units.in_si(motion).items():
        arrays[name] = np.zeros((steps, len(solid), values.shape[2]))
        arrays[name][:, solid] = values
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


def timed_rollout(simulator: Simulator, steps: int) -> tuple[Rollout, Timing]:
    frames: list[Rollout] = []
    timing = timed(lambda count: frames.extend(simulator.frames(count)), steps)
    return join(frames), timing
