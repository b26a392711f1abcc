"""Many trajectories at once: as one set of bodies, and as simulations by a model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.parallel import threads
from sdfsim.data.dataset import FLOOR, Trajectory
from sdfsim.learned.model import SOLVER, Model
from sdfsim.physics.bodies import Bodies, State, Units
from sdfsim.physics.motion import MOTION, Motion
from sdfsim.physics.options import SUBSTEPS, Options
from sdfsim.physics.steps import Frames
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape
from sdfsim.simulate.batch import placed, side_by_side
from sdfsim.simulate.steppers import FreeFlight, Stepper, stepper_of

if TYPE_CHECKING:
    from sdfsim.physics.solver.prepare import SharedShapes

BATCH = 50  # trajectories simulated side by side
PLANE = analytic_shape("plane")


def merged(
    trajectories: list[Trajectory],
    frames: list[int],
    shapes: dict[str, Shape],
    units: Units,
    floor: tuple[float, float] = FLOOR,
) -> tuple[Bodies, State]:
    """Bodies of all trajectories, each at its frame in `frames` [W], then one floor that they share; worlds do not
    touch each other.

    Masses and inertias are relative to the mean mass of the dynamic bodies of the trajectory, as in `Simulator`:
    inverse masses are inputs of networks on surface nodes. `units` must have a mass of 1.
    """
    means = [1.0 if t.static.all() else float(t.mass[~t.static].mean()) for t in trajectories]
    relative = [replace(t, mass=t.mass / m, inertia=t.inertia / m) for t, m in zip(trajectories, means, strict=True)]
    scene, world = scene_of(relative, frames, shapes, floor)
    return side_by_side(scene, world, units)


def scene_of(
    trajectories: list[Trajectory],
    frames: list[int],
    shapes: dict[str, Shape],
    floor: tuple[float, float] = FLOOR,
) -> tuple[Scene, list[int]]:
    """One scene with all trajectories, each at its frame, and the world of each of its bodies (-1: the floor, which is
    in all)."""
    names = sorted({str(n) for t in trajectories for n in t.shape})
    about = [centred(shapes[n]) for n in names]
    bodies, world = [], []
    for w, (t, frame) in enumerate(zip(trajectories, frames, strict=True)):
        for i, name in enumerate(t.shape):
            body = Body(
                name=f"{w}/{i}",
                shape=names.index(str(name)),
                motion="static" if t.static[i] else "dynamic",
                scale=float(t.scale[i]),
                position=t.position[frame, i],
                quat_xyzw=t.orientation[frame, i],
                velocity=t.velocity[frame, i],
                angular_velocity=t.angular_velocity[frame, i],
                mass=float(t.mass[i]),
                inertia=np.diag(t.inertia[i]),
                friction=float(t.friction[i]),
                restitution=float(t.restitution[i]),
            )
            bodies.append(body)
            world.append(w)
    zero, unturned = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    bodies.append(Body("floor", len(names), "static", 1.0, zero, unturned, zero, zero, 0.0, *floor))
    scene = Scene(shapes=(*about, PLANE), bodies=tuple(bodies), gravity=trajectories[0].gravity, duration=1.0)
    return scene, [*world, -1]


def centred(shape: Shape) -> Shape:
    """The shape with its centre of mass at the origin, as trajectories need it. It keeps its contact geometry, which
    does not depend on the centre of mass."""
    if not shape.com.any():
        return shape
    other = replace(shape, com=np.zeros(3))
    vars(other)["contact"] = shape.contact
    return other


def state_at(trajectories: list[Trajectory], frames: list[int], like: State) -> State:
    """The state of all trajectories, each at its frame; the floor, which comes last, as in `like`."""

    each = [[getattr(t, name)[k] for t, k in zip(trajectories, frames, strict=True)] for name in MOTION]
    return placed(like, *map(np.concatenate, each))


def roll_out(
    model: Model,
    group: list[Trajectory],
    shapes: dict[str, Shape],
    steps: int,
    free_flight: FreeFlight = "exact",
    *,
    contact: bool = True,
    substeps: int = SUBSTEPS,
    floor: tuple[float, float] = FLOOR,
) -> list[Trajectory]:
    """Simulate a batch of trajectories with the same step and gravity from their first frames. Returns the predicted
    motions, of steps + 1 frames.

    The solve makes `substeps` inner steps in a recorded one. "learned" free flight is for networks on surface nodes.
    Raises SdfsimError (exit code 3) for a state that is not finite.
    """
    from sdfsim.physics.solver.prepare import SharedShapes  # numba is slow to load

    stepper = stepper_of(model, contact=contact, free_flight=free_flight)
    units = model_units(stepper, group[0])
    gravity = np.asarray(group[0].gravity, dtype=np.float64) / units.acceleration
    options = Options(gravity, group[0].dt / units.time, substeps)
    known = {name: stepper.surface(shape) for name, shape in shapes.items()}
    # The solve is fastest with one trajectory at a time, on all cores; a network with all of them in one graph.
    alone = model.kind == SOLVER
    groups = [[t] for t in group] if alone else [group]
    shared = SharedShapes()
    jobs = [(some, known, units, stepper, options, steps, floor, shared) for some in groups]
    found = dict(threads(_rolled, jobs)) if alone else {0: _rolled(*jobs[0])}
    return [t for k in range(len(jobs)) for t in found[k]]


def _rolled(
    group: list[Trajectory], shapes: dict[str, Shape], units: Units, stepper: Stepper, options: Options,
    steps: int, floor: tuple[float, float], shared: SharedShapes,
) -> list[Trajectory]:  # fmt: skip
    """The predicted motions of trajectories that are simulated side by side."""
    bodies, start = merged(group, [0] * len(group), shapes, units, floor)
    start = stepper.began(start, bodies, options)
    made = stepper.advance(start, stepper.init(bodies, start, options, shared), steps, keep=True)
    frames = cast("Frames", made.frames)
    whole = Motion(*(np.concatenate([getattr(start, name)[None], getattr(frames, name)]) for name in MOTION))
    broken = (~np.isfinite(np.concatenate([whole.position, whole.orientation], -1)).all(-1)).sum(1)
    if broken.any():
        step = int((broken > 0).argmax())
        raise SdfsimError(f"step {step}: {broken[step]} bodies are not finite", exit_code=EXIT_QUALITY)
    moved, ends = units.in_si(whole), np.cumsum([t.position.shape[1] for t in group])
    return [
        replace(t, **{name: values[:, mine] for name, values in moved.items()})
        for t, mine in zip(group, map(slice, [0, *ends[:-1]], ends), strict=True)
    ]


def batches(trajectories: list[Trajectory]) -> list[list[Trajectory]]:
    """Batches of trajectories that share step and gravity, so that they run as one."""
    groups: dict[tuple, list[Trajectory]] = {}
    for t in trajectories:
        groups.setdefault((t.dt, *t.gravity), []).append(t)
    return [g[i : i + BATCH] for g in groups.values() for i in range(0, len(g), BATCH)]


def first_frames(trajectory: Trajectory, count: int) -> Trajectory:
    return replace(trajectory, **{name: getattr(trajectory, name)[:count] for name in MOTION})


def every(trajectory: Trajectory, stride: int) -> Trajectory:
    """Every `stride`-th frame, as a trajectory with longer steps."""
    frames = {name: getattr(trajectory, name)[::stride] for name in MOTION}
    return replace(trajectory, dt=trajectory.dt * stride, **frames)


def model_units(stepper: Stepper, like: Trajectory) -> Units:
    """Model units in which the recorded step is the model's own step; for models without a step, units of a metre."""
    model = stepper.model
    strength = float(np.linalg.norm(like.gravity)) or model.gravity
    if not stepper.on_surfaces:
        return Units(length=1.0, time=float(np.sqrt(model.gravity / strength)), mass=1.0)
    length = (like.dt / model.dt) ** 2 * strength / model.gravity
    return Units(length=length, time=like.dt / model.dt, mass=1.0)
