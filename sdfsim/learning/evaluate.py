"""Rollouts against a recorded dataset: the table that models are compared by."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.dynamics.bodies import Bodies, State, Units
from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.simulator import pick_device, with_history
from sdfsim.dynamics.step import FreeFlight, Rules, step
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.learning.dataset import Trajectory, load_shapes, read_info, trajectory_files
from sdfsim.learning.merge import merged
from sdfsim.learning.metrics import interval, rotation_error, translation_rmse

HORIZONS = (50, 100)  # steps, as the paper reports
BATCH = 50  # trajectories simulated side by side

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Score:
    """One trajectory's errors.

    Attributes:
        bodies: how many bodies moved.
        squared: horizon -> mean squared distance m^2 over bodies and steps.
        angle: horizon -> mean rotation angle, degrees.
    """

    bodies: int
    squared: dict[int, float]
    angle: dict[int, float]


def evaluate(
    data: Path,
    *,
    model: str | Path | Model | None = None,
    steps: int = 100,
    split: str = "test",
    device: str = "cpu",
    free_flight: FreeFlight = "exact",
    on_progress: Progress | None = None,
) -> dict:
    """Roll a model out from the first frame of every trajectory and compare, beside the ballistic baseline.

    Args:
        data: a dataset folder (its `split`, else the trajectories in it).
        model: bundled name, path or `Model`.
        steps: how far; errors are reported at the horizons of `HORIZONS` up to there, and there.
        split: which part of the dataset.
        device: "cpu", "cuda" or "auto".
        free_flight: "exact" or (paper network) "learned".
        on_progress: called with the fraction done and a message.

    Returns:
        {"model", "ballistic"} -> horizon -> translation_rmse m and rotation_error degrees over all bodies and
        steps, with 95 % intervals over trajectories; counts; milliseconds a step.

    Raises:
        SdfsimError: no or unreadable trajectories or shapes; exit code 3 when a rollout is not finite.
    """
    tell = on_progress or (lambda fraction, message: None)
    place = pick_device(device)
    used = (model if isinstance(model, Model) else load_model(model)).to(place)
    if free_flight == "learned" and used.kind != "paper":
        raise SdfsimError("free_flight 'learned' exists for the paper network only", "give a model of that kind")
    trajectories = [Trajectory.load(f) for f in trajectory_files(data, split)]
    shapes = load_shapes(data, {str(n) for t in trajectories for n in t.shape})
    shapes = {name: replace(shape, nodes=shape.nodes[: used.nodes]) for name, shape in shapes.items()}
    longest = min(steps, *(len(t.position) - 1 for t in trajectories))
    substep = _substep(data)
    scores: dict[str, list[Score]] = {"model": [], "ballistic": []}
    seconds = 0.0
    groups = _alike(trajectories)
    for k, group in enumerate(groups):
        tell(k / len(groups), f"{used.name}: batch {k + 1} of {len(groups)}, {longest} steps")
        started = time.perf_counter()
        scores["model"] += _score(used, group, shapes, longest, substep, place, free_flight, contact=True)
        seconds += time.perf_counter() - started
        scores["ballistic"] += _score(used, group, shapes, longest, substep, place, "exact", contact=False)
    tell(1.0, "done")
    return {
        "data": str(data),
        "split": split,
        "model_name": used.name,
        "free_flight": free_flight,
        "trajectories": len(trajectories),
        "bodies": int(sum(t.position.shape[1] for t in trajectories)),
        "dt": trajectories[0].dt,
        "ms_per_step_per_trajectory": 1e3 * seconds / longest / len(trajectories),
        **{who: {str(h): _summary(rows, h) for h in _horizons(longest)} for who, rows in scores.items()},
    }


def _substep(data: Path) -> float:
    """The engine's inner step in s, where the dataset tells it (0 elsewhere)."""
    for folder in (data, data.parent):
        if (folder / "dataset.json").exists():
            settings = read_info(folder).get("engine_settings")
            step = settings.get("timeStep") if isinstance(settings, dict) else None
            return float(step) if isinstance(step, int | float) else 0.0
    return 0.0


def _alike(trajectories: list[Trajectory]) -> list[list[Trajectory]]:
    """Batches of trajectories that share step and gravity, so that they run as one."""
    groups: dict[tuple, list[Trajectory]] = {}
    for t in trajectories:
        groups.setdefault((t.dt, *t.gravity), []).append(t)
    return [g[i : i + BATCH] for g in groups.values() for i in range(0, len(g), BATCH)]


def _score(
    model: Model,
    group: list[Trajectory],
    shapes: dict,
    steps: int,
    substep: float,
    device: torch.device,
    free_flight: FreeFlight,
    *,
    contact: bool,
) -> list[Score]:
    """Roll one batch out; the errors of every trajectory."""
    units = _units(model, group[0])
    bodies, state = merged(group, [0] * len(group), shapes, units, device)
    gravity = torch.tensor(group[0].gravity / units.acceleration, dtype=torch.float64, device=device)
    # The recording engine's first position step already uses the new velocity (symplectic Euler): an exact parabola,
    # but of a body that started half an inner step of gravity faster. All start in free flight.
    nudge = 0.5 * (substep / units.time) * gravity * bodies.moves[:, None]
    state = replace(state, velocity=state.velocity + nudge)
    rules = Rules(gravity=gravity, dt=model.dt, contact=contact, free_flight=free_flight)
    if model.kind == "paper":
        state = with_history(state, bodies, rules)
    position, orientation = _roll(model, bodies, state, rules, steps)
    position = position * units.length
    results, at = [], 0
    for t in group:
        mine = slice(at, at + t.position.shape[1])
        at = mine.stop
        moving = ~t.static.astype(bool)
        p, q = position[:, mine][:, moving], orientation[:, mine][:, moving]
        truth_p, truth_q = t.position[1 : steps + 1][:, moving], t.quat_xyzw[1 : steps + 1][:, moving]
        horizons = _horizons(steps)
        results.append(
            Score(
                bodies=int(moving.sum()),
                squared={h: translation_rmse(p[:h], truth_p[:h]) ** 2 for h in horizons},
                angle={h: rotation_error(q[:h], truth_q[:h]) for h in horizons},
            )
        )
    return results


def _horizons(steps: int) -> list[int]:
    return sorted({h for h in HORIZONS if h <= steps} | {steps})


def _units(model: Model, like: Trajectory) -> Units:
    """Model units in which the recorded step is the model's own."""
    strength = float(np.linalg.norm(like.gravity)) or model.gravity
    length = (like.dt / model.dt) ** 2 * strength / model.gravity
    return Units(length=length, time=like.dt / model.dt, mass=length**3)  # the recipe's densities are the model's


def _roll(model: Model, bodies: Bodies, state: State, rules: Rules, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [steps, N, 3] (model units) and orientations [steps, N, 4]."""
    positions, orientations = [], []
    for _ in range(steps):
        state, _ = step(model, bodies, state, rules)
        broken = ~(state.position.isfinite().all(-1) & state.orientation.isfinite().all(-1))
        if broken.any():
            raise SdfsimError(
                f"step {len(positions) + 1}: {int(broken.sum())} bodies are not finite", exit_code=EXIT_QUALITY
            )
        positions.append(state.position.cpu().numpy())
        orientations.append(state.orientation.cpu().numpy())
    return np.stack(positions), np.stack(orientations)


def _summary(scores: list[Score], horizon: int) -> dict:
    """Errors over all bodies and steps, and 95 % intervals over trajectories."""
    bodies = np.array([s.bodies for s in scores])
    share = bodies / bodies.mean()
    squared = np.array([s.squared[horizon] for s in scores]) * share
    angle = np.array([s.angle[horizon] for s in scores]) * share
    return {
        "translation_rmse": float(np.sqrt(squared.mean())),
        "translation_rmse_95": [float(np.sqrt(v)) for v in interval(squared)],
        "rotation_error": float(angle.mean()),
        "rotation_error_95": interval(angle),
    }
