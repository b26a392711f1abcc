"""Many trajectories as one set of bodies: contacts and rollouts of all of them in the same few calls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from sdfsim.data.dataset import FLOOR, Trajectory
from sdfsim.dynamics.bodies import Bodies, State, Units, from_scene
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.shape import Shape, analytic_shape

PLANE = analytic_shape("plane")


def merged(
    trajectories: list[Trajectory],
    frames: list[int],
    shapes: dict[str, Shape],
    units: Units,
    device: torch.device,
    floor: tuple[float, float] = FLOOR,
    plane: Shape = PLANE,
) -> tuple[Bodies, State]:
    """Bodies of all trajectories, each at its frame of [W], then one floor they share; worlds do not touch each other.

    Masses and inertias are relative to the mean mass of the bodies that move in the trajectory, as in `Simulator`:
    inverse masses are inputs of networks on surface nodes. Units are of length and time; their mass is to be 1.
    """
    means = [1.0 if t.static.all() else float(t.mass[~t.static].mean()) for t in trajectories]
    relative = [replace(t, mass=t.mass / m, inertia=t.inertia / m) for t, m in zip(trajectories, means, strict=True)]
    scene, world = scene_of(relative, frames, shapes, floor, plane)
    tensors, state = from_scene(scene, units, device)
    return replace(tensors, world=torch.tensor(world, device=device)), state


def scene_of(
    trajectories: list[Trajectory],
    frames: list[int],
    shapes: dict[str, Shape],
    floor: tuple[float, float] = FLOOR,
    plane: Shape = PLANE,
) -> tuple[Scene, list[int]]:
    """One scene of all trajectories, each at its frame, and the world of each of its bodies (-1, the floor: in all)."""
    names = sorted({str(n) for t in trajectories for n in t.shape})
    centred = [replace(shapes[n], com=np.zeros(3)) for n in names]
    bodies, world = [], []
    for w, (t, frame) in enumerate(zip(trajectories, frames, strict=True)):
        for i, name in enumerate(t.shape):
            body = Body(
                name=f"{w}/{i}",
                shape=names.index(str(name)),
                motion="static" if t.static[i] else "dynamic",
                scale=float(t.scale[i]),
                position=t.position[frame, i],
                quat_xyzw=t.quat_xyzw[frame, i],
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
    scene = Scene(shapes=(*centred, plane), bodies=tuple(bodies), gravity=trajectories[0].gravity, duration=1.0)
    return scene, [*world, -1]
