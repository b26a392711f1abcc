"""Many variants of one scene: other starts, masses, coefficients; on all cores, each as it would be alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sdfsim.dynamics.model import Model
from sdfsim.dynamics.rollout import Rollout
from sdfsim.errors import SdfsimError, nearest
from sdfsim.parallel import parallel
from sdfsim.scene.scene import Body, Scene

Variant = Mapping[str, Mapping[str, Any]]  # body -> field -> value
VECTORS = {"position": 3, "quat_xyzw": 4, "velocity": 3, "angular_velocity": 3}
NUMBERS = {"mass": np.inf, "friction": np.inf, "restitution": 1.0}  # with the most that each may be
CHUNKS = 16  # pieces that the variants are cut into at most, so that cores end together


def varied(scene: Scene, variant: Variant) -> Scene:
    """The scene with some values changed: body -> field -> value, of the fields of `VECTORS` and `NUMBERS` in SI units.
    An inertia of its own grows with the mass. Raises SdfsimError for no such body or field, or a value that it cannot
    have."""
    known = {body.name for body in scene.bodies}
    for name in variant:
        if name not in known:
            raise SdfsimError(f"variant: there is no body {name!r}{nearest(name, known)}")
    return replace(scene, bodies=tuple(_changed(body, variant.get(body.name, {})) for body in scene.bodies))


def rollouts(
    scene: Scene,
    variants: Sequence[Variant],
    model: Model,
    *,
    seconds: float | None,
    steps: int | None,
    dt: float | None,
) -> list[Rollout]:
    """One rollout for each variant, in their order; see `Simulator.rollouts`."""
    scenes = [varied(scene, variant) for variant in variants]
    pieces = np.array_split(np.arange(len(scenes)), min(CHUNKS, max(1, len(scenes))))
    jobs = [([scenes[k] for k in piece], model, seconds, steps, dt) for piece in pieces if len(piece)]
    found: list[list[Rollout]] = [[]] * len(jobs)
    for index, some in parallel(_run, jobs):
        found[index] = some
    return [rollout for some in found for rollout in some]


def _run(
    scenes: list[Scene], model: Model, seconds: float | None, steps: int | None, dt: float | None
) -> list[Rollout]:
    from sdfsim.dynamics.simulator import Simulator

    return [Simulator(scene, model, dt=dt).run(seconds, steps) for scene in scenes]


def _changed(body: Body, fields: Mapping[str, Any]) -> Body:
    new: dict[str, Any] = {}
    for name, value in fields.items():
        where = f"variant: body {body.name!r}: {name}"
        if name in VECTORS:
            new[name] = np.asarray(value, dtype=np.float64)
            if new[name].shape != (VECTORS[name],) or not np.isfinite(new[name]).all():
                raise SdfsimError(f"{where}: must be {VECTORS[name]} finite numbers (got {value!r})")
        elif name in NUMBERS:
            new[name] = float(value)
            if not 0.0 <= new[name] <= NUMBERS[name] or new[name] == np.inf:
                raise SdfsimError(f"{where}: must be 0 to {NUMBERS[name]:g} (got {value!r})")
        else:
            allowed = (*VECTORS, *NUMBERS)
            raise SdfsimError(f"{where}: no such field{nearest(name, allowed)}; there are {', '.join(allowed)}")
    if "quat_xyzw" in new:
        new["quat_xyzw"] = new["quat_xyzw"] / max(np.linalg.norm(new["quat_xyzw"]), 1e-300)
    if body.motion != "dynamic" and (moving := {"velocity", "angular_velocity", "mass"} & new.keys()):
        raise SdfsimError(f"variant: body {body.name!r}: is {body.motion}, so it has no {min(moving)}")
    if "mass" in new and not new["mass"] > 0:
        raise SdfsimError(f"variant: body {body.name!r}: mass: must be > 0")
    if "mass" in new and body.inertia is not None:
        new["inertia"] = body.inertia * (new["mass"] / body.mass)
    return replace(body, **new)
