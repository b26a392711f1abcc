"""The engines of all comparisons: called with a start, steps, and inner steps in a step (`sdfsim.evaluation.engines`).

A scene becomes a start by `start_of_scene`: files of its shapes, its bodies' poses, velocities and coefficients, and
the scene itself, which MuJoCo gets through `export`. What no file says is set by each engine's own API, here and in the
modules of this folder.
"""

from functools import partial

from benchmarks.engines.drake import drake
from benchmarks.engines.newton import newton
from benchmarks.engines.rapier import rapier
from sdfsim.apps.mujoco_world import MujocoWorld
from sdfsim.evaluation.engines import bullet, run_world

__all__ = ["bullet", "drake", "mujoco", "mujoco_sdf", "newton", "rapier"]

mujoco, mujoco_sdf = partial(run_world, MujocoWorld), partial(run_world, partial(MujocoWorld, collide="sdf"))
