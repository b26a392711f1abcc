"""Recorded trajectories simulated again by a model, many side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sdfsim.data.batching import PLANE, merged
from sdfsim.data.dataset import FLOOR, Trajectory
from sdfsim.data.pybullet_sim import MARGIN
from sdfsim.dynamics.bodies import Units
from sdfsim.dynamics.model import Model
from sdfsim.dynamics.models.contact_graph import SUBSTEPS
from sdfsim.dynamics.models.surfaces import with_history
from sdfsim.dynamics.run_memory import Memory
from sdfsim.dynamics.step import FreeFlight, StepOptions, step
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.shape.shape import Shape

BATCH = 50  # trajectories simulated side by side


def roll_out(
    model: Model,
    group: list[Trajectory],
    shapes: dict[str, Shape],
    steps: int,
    device: torch.device,
    free_flight: FreeFlight = "exact",
    *,
    contact: bool = True,
    substeps: int = SUBSTEPS,
    as_teacher: bool = False,
    floor: tuple[float, float] = FLOOR,
) -> list[Trajectory]:
    """Simulate one batch of trajectories of one step and one gravity from their first frames; the same bodies in the
    predicted motion, steps + 1 frames.

    The recording engine makes `substeps` inner steps in one. `as_teacher` the solver takes over two habits of the
    teacher: bodies are larger by `MARGIN` than their shapes, and what is pushed out adds to the speed of a rebound.
    "learned" free flight is for networks on surface nodes. Raises SdfsimError (exit code 3) for a state that is not
    finite.
    """
    units = model_units(model, group[0])
    known = {name: model.surface(shape) for name, shape in shapes.items()}
    bodies, state = merged(group, [0] * len(group), known, units, device, floor, model.surface(PLANE))
    gravity = torch.tensor(group[0].gravity / units.acceleration, dtype=torch.float64, device=device)
    rules = StepOptions(
        gravity, group[0].dt / units.time, model.inner or substeps, contact=contact, free_flight=free_flight,
        margin=MARGIN / units.length if as_teacher else 0.0, adds=as_teacher,
    )  # fmt: skip
    if model.on_surfaces:
        state = with_history(state, bodies, rules)
    states, memory = [state], Memory()
    for k in range(steps):
        state, _ = step(model, bodies, state, rules, memory)
        broken = ~(state.position.isfinite().all(-1) & state.orientation.isfinite().all(-1))
        if broken.any():
            raise SdfsimError(f"step {k + 1}: {int(broken.sum())} bodies are not finite", exit_code=EXIT_QUALITY)
        states.append(state)
    position, quat, velocity, angular = (
        np.stack([getattr(s, name).cpu().numpy() for s in states])
        for name in ("position", "orientation", "velocity", "angular_velocity")
    )
    ends = np.cumsum([t.position.shape[1] for t in group])
    return [
        replace(
            t,
            position=position[:, mine] * units.length,
            quat_xyzw=quat[:, mine],
            velocity=velocity[:, mine] * units.velocity,
            angular_velocity=angular[:, mine] / units.time,
        )
        for t, mine in zip(group, map(slice, [0, *ends[:-1]], ends), strict=True)
    ]


def batches(trajectories: list[Trajectory]) -> list[list[Trajectory]]:
    """Batches of trajectories that share step and gravity, so that they run as one."""
    groups: dict[tuple, list[Trajectory]] = {}
    for t in trajectories:
        groups.setdefault((t.dt, *t.gravity), []).append(t)
    return [g[i : i + BATCH] for g in groups.values() for i in range(0, len(g), BATCH)]


def first_frames(trajectory: Trajectory, count: int) -> Trajectory:
    """The first `count` frames."""
    names = ("position", "quat_xyzw", "velocity", "angular_velocity")
    return replace(trajectory, **{name: getattr(trajectory, name)[:count] for name in names})


def every(trajectory: Trajectory, stride: int) -> Trajectory:
    """Every so many-th frame, told as one of longer steps."""
    names = ("position", "quat_xyzw", "velocity", "angular_velocity")
    frames = {name: getattr(trajectory, name)[::stride] for name in names}
    return replace(trajectory, dt=trajectory.dt * stride, **frames)


def model_units(model: Model, like: Trajectory) -> Units:
    """Model units in which the recorded step is the model's own; for the solver those of its bodies of a metre."""
    strength = float(np.linalg.norm(like.gravity)) or model.gravity
    if not model.on_surfaces:  # the solve takes the inner steps that it is told
        return Units(length=1.0, time=float(np.sqrt(model.gravity / strength)), mass=1.0)
    length = (like.dt / model.dt) ** 2 * strength / model.gravity
    return Units(length=length, time=like.dt / model.dt, mass=1.0)
