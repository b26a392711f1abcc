"""What a dataset holds, in numbers, beside what is published of the same recipe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from sdfsim.data.batching import merged
from sdfsim.data.dataset import Trajectory, load_shapes, read_info, trajectory_files
from sdfsim.dynamics.bodies import Units
from sdfsim.dynamics.contacts import find_contacts
from sdfsim.shape.shape import Shape

REACH = 0.1  # m, contact radius at which contacts are counted
SAMPLE, STRIDE = 10, 5  # trajectories whose contacts are counted, and every which step of them
REST = 0.05  # m/s: slower bodies count as resting
# Rubanova et al. (2024): pairs of a node and another body within reach, and surface nodes, of test scenes.
PUBLISHED = {
    "movi-b": {"contacts_per_step": 201, "nodes_per_scene": 2897, "bodies": [3, 10]},
    "movi-c": {"contacts_per_step": 300, "nodes_per_scene": 3530, "bodies": [3, 10]},
}


def statistics(data: Path, split: str) -> dict:
    """Counts, sizes, masses, speeds and contacts of a split; every trajectory is read, and so checked.

    Args:
        data: dataset folder.
        split: "train", "validation" or "test".

    Returns:
        [lowest, mean, highest] over moving bodies of `bodies` (a scene), `extent_m`, `volume_m3`, `mass`, `friction`,
        `restitution`, `start_speed_m_s`, `speed_m_s` (all steps) and `mass_ratio` (of a scene); `static_bodies`; shares
        `resting_at_start` and `resting_at_end`; over the first `SAMPLE` trajectories `contacts_per_step` (nodes within
        `REACH` of another body or the floor), `share_in_contact` and `nodes_per_scene`; `published`, where known.

    Raises:
        SdfsimError: no trajectories, or unreadable ones.
    """
    trajectories = [Trajectory.load(file) for file in trajectory_files(data, split)]
    shapes = load_shapes(data, {str(name) for t in trajectories for name in t.shape})
    moving = [~t.static for t in trajectories]
    pairs = list(zip(trajectories, moving, strict=True))
    extents = {name: float(np.ptp(shape.sdf.bounds, axis=0).max()) for name, shape in shapes.items()}
    speed = [np.linalg.norm(t.velocity[:, m], axis=-1) for t, m in pairs]
    start, end = (np.concatenate([s[k] for s in speed]) for k in (0, -1))
    volumes = {name: shape.volume for name, shape in shapes.items()}
    report = {
        "trajectories": len(trajectories),
        "bodies": _spread(np.array([m.sum() for m in moving])),
        "static_bodies": int(sum((~m).sum() for m in moving)),
        "extent_m": _spread(np.concatenate([_each(t, extents)[m] * t.scale[m] for t, m in pairs])),
        "volume_m3": _spread(np.concatenate([_each(t, volumes)[m] * t.scale[m] ** 3 for t, m in pairs])),
        **{
            name: _spread(np.concatenate([getattr(t, name)[m] for t, m in pairs]))
            for name in ("mass", "friction", "restitution")
        },
        "mass_ratio": _spread(np.array([t.mass[m].max() / t.mass[m].min() for t, m in pairs])),
        "start_speed_m_s": _spread(start),
        "speed_m_s": _spread(np.concatenate([s.ravel() for s in speed])),
        "resting_at_start": float((start < REST).mean()),
        "resting_at_end": float((end < REST).mean()),
    }
    report |= _contacts(trajectories[:SAMPLE], shapes)
    published = PUBLISHED.get(read_info(data).get("recipe", ""))
    return report | ({"published": published} if published else {})


def statistics_lines(found: dict) -> list[str]:
    """The same for people."""
    lines = []
    for name, value in found.items():
        if isinstance(value, list):
            value = f"{value[0]:.4g} to {value[2]:.4g}, mean {value[1]:.4g}"
        elif isinstance(value, dict):
            value = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in value.items())
        elif isinstance(value, float):
            value = f"{value:.4g}"
        lines.append(f"  {name.replace('_', ' ')}: {value}")
    return lines


def _contacts(trajectories: list[Trajectory], shapes: dict[str, Shape]) -> dict:
    units, place = Units(1.0, 1.0, 1.0), torch.device("cpu")
    contacts, touching, nodes = [], [], []
    for t in trajectories:
        gravity = torch.zeros(3, dtype=torch.float64)
        for frame in range(0, len(t.position), STRIDE):
            bodies, state = merged([t], [frame], shapes, units, place)
            # At no time step nothing approaches: what is within reach is counted, as published.
            found = find_contacts(bodies, state, gravity, REACH, 0.0)
            met = torch.zeros(len(bodies), dtype=torch.bool)
            met[found.owner], met[found.body] = True, True
            contacts.append(len(found))
            touching.append(float(met[bodies.moves].double().mean()))
            nodes.append(len(bodies.node))
    return {
        "contacts_per_step": float(np.mean(contacts)),
        "share_in_contact": float(np.mean(touching)),
        "nodes_per_scene": float(np.mean(nodes)),
    }


def _each(t: Trajectory, values: dict[str, float]) -> np.ndarray:
    return np.array([values[str(name)] for name in t.shape])


def _spread(values: np.ndarray) -> list[float]:
    return [float(values.min()), float(values.mean()), float(values.max())]
