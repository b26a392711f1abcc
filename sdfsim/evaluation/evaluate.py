"""Rollouts against a recorded dataset: the numbers that models are compared by."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sdfsim.data import metrics
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import Trajectory, load_shapes, trajectory_files
from sdfsim.data.metrics import FRAMES, HORIZONS
from sdfsim.data.replay import batches, first_frames, model_units, roll_out
from sdfsim.data.velocities import at_instants, engine_substep
from sdfsim.dynamics.energy import Guard
from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.ranges import outside_training
from sdfsim.dynamics.simulator import pick_device
from sdfsim.dynamics.step import FreeFlight
from sdfsim.errors import SdfsimError
from sdfsim.evaluation import baselines
from sdfsim.evaluation.penetration import EVERY, Solid, exact_solids, penetration
from sdfsim.shape.shape import Shape
from sdfsim.training.contact_cache import inner_steps

LIMITS = (0.1, 0.25, 0.5)  # m, translation errors that a body survives
CURVE_EVERY = 5  # steps between two stored points of a survival curve

Progress = Callable[[float, str], None]
Motions = list[Trajectory]


@dataclass(frozen=True)
class Score:
    """One trajectory's errors.

    Attributes:
        bodies: how many bodies moved.
        squared: horizon -> mean squared distance m^2 over bodies and steps.
        angle: horizon -> mean rotation angle, degrees.
        there: horizon -> root mean squared distance m over bodies, in the last of these steps alone.
        turned: horizon -> mean rotation angle there, degrees.
    """

    bodies: int
    squared: dict[int, float]
    angle: dict[int, float]
    there: dict[int, float]
    turned: dict[int, float]


def evaluate(
    data: Path,
    *,
    model: str | Path | Model | None = None,
    steps: int = 100,
    split: str = "test",
    device: str = "cpu",
    free_flight: FreeFlight = "exact",
    guard: Guard = "none",
    chaos_floor: bool = False,
    errors_only: bool = False,
    on_progress: Progress | None = None,
) -> dict:
    """Roll a model out from the first frame of every trajectory and compare, beside the ballistic baseline.

    Args:
        data: a dataset folder (its `split`, else the trajectories in it).
        model: bundled name, path or `Model`.
        steps: how far; errors are reported at the horizons of `HORIZONS` and `FRAMES` up to there, and there.
        split: which part of the dataset.
        device: "cpu", "cuda" or "auto".
        free_flight: "exact" or (paper network) "learned".
        guard: "energy" holds back contact that makes energy.
        chaos_floor: also run the teacher again from starts that differ slightly (see `baselines.PERTURBATIONS`).
        errors_only: leave out penetration, energy and rest.
        on_progress: called with the fraction done and a message.

    Returns:
        A report; its errors are tables horizon -> seconds, translation_rmse m and rotation_error degrees over all
        bodies and steps, with 95 % intervals over trajectories; and `at_frame`, the same two in the last of these steps
        alone, translation as the mean over trajectories of the root mean square over bodies:
        "model", "ballistic": errors.
        "chaos_floor": "perturbations" -> name -> errors; or "left_out", why.
        "outside_training": what of the scenes the model has not seen, one line each.
        "survival", "median_survival_s": of all of them, by limit in m.
        "penetration" m, "energy_gain" (a fraction), "resting_speed" m/s: of the model and of the teacher's recording.
        "engine_substep": s, the recording engine's inner step; 0 where no dataset.json tells it.
        Further counts, and milliseconds a step.

    Raises:
        SdfsimError: no or unreadable trajectories or shapes; exit code 3 when a rollout is not finite.
    """
    tell = on_progress or (lambda fraction, message: None)
    used = (model if isinstance(model, Model) else load_model(model)).to(pick_device(device))
    if free_flight == "learned" and used.kind != "paper":
        raise SdfsimError("free_flight 'learned' exists for the paper network only", "give a model of that kind")
    recorded, shapes = _load(data, split)
    longest = min(steps, *(len(t.position) - 1 for t in recorded))
    recorded = [first_frames(t, longest + 1) for t in recorded]
    substep = engine_substep(data)
    contenders, seconds = _simulate(used, recorded, shapes, substep, device, free_flight, guard, tell)
    again, floor_report = {}, {}
    if chaos_floor:
        tell(0.8, "teacher, from starts that differ slightly")
        again, floor_report = _teacher_again(data, recorded)
    report = {
        "data": str(data),
        "split": split,
        "model_name": used.name,
        "free_flight": free_flight,
        "guard": guard,
        "trajectories": len(recorded),
        "bodies": int(sum(t.position.shape[1] for t in recorded)),
        "dt": recorded[0].dt,
        "steps": longest,
        "steps_asked": steps,
        "engine_substep": substep,
        "outside_training": _outside(used, recorded, shapes),
        "ms_per_step_per_trajectory": 1e3 * seconds / longest / len(recorded),
        **{who: _errors(motions, recorded) for who, motions in contenders.items()},
        **floor_report,
        **_survival(contenders | again, recorded),
    }
    if not errors_only:
        tell(0.9, "penetration, energy and rest")
        solids = exact_solids(data, shapes)
        # Energies compare at the instants of the positions; rest and penetration are told by positions alone.
        report |= _quality(contenders["model"], [at_instants(t, substep) for t in recorded], solids)
    tell(1.0, "done")
    return report


def _load(data: Path, split: str) -> tuple[Motions, dict[str, Shape]]:
    """Trajectories in which something moves, those that can run together side by side, and their shapes."""
    recorded = [Trajectory.load(f) for f in trajectory_files(data, split)]
    recorded = [t for group in batches(recorded) for t in group if not t.static.all()]
    if not recorded:
        raise SdfsimError(f"{data}: nothing moves in any trajectory")
    if len(steps := {t.dt for t in recorded}) > 1:
        raise SdfsimError(f"{data}: trajectories of different steps ({', '.join(f'{dt:g} s' for dt in sorted(steps))})")
    return recorded, load_shapes(data, {str(n) for t in recorded for n in t.shape})


def _simulate(
    model: Model,
    recorded: Motions,
    shapes: dict[str, Shape],
    substep: float,
    device: str,
    free_flight: FreeFlight,
    guard: Guard,
    tell: Progress,
) -> tuple[dict[str, Motions], float]:
    """The model's and the ballistic motions from the recorded starts, and the seconds that the model took."""
    known = {name: replace(shape, nodes=shape.nodes[: model.nodes]) for name, shape in shapes.items()}
    place, longest = pick_device(device), len(recorded[0].position) - 1
    motions: dict[str, Motions] = {"model": [], "ballistic": []}
    seconds = 0.0
    groups, inner = batches([at_instants(t, substep) for t in recorded]), inner_steps(recorded[0].dt, substep)
    for k, group in enumerate(groups):
        tell(0.8 * k / len(groups), f"{model.name}: batch {k + 1} of {len(groups)}, {longest} steps")
        started = time.perf_counter()
        motions["model"] += roll_out(
            model, group, known, longest, place, free_flight, guard=guard, substeps=inner, as_teacher=True
        )
        seconds += time.perf_counter() - started
        motions["ballistic"] += roll_out(model, group, known, longest, place, contact=False)
    return motions, seconds


def _outside(model: Model, recorded: Motions, shapes: dict[str, Shape]) -> list[str]:
    """What of the scenes the model has not seen in training, one line each."""
    scenes = [scene_of([t], [0], shapes)[0] for t in recorded]
    return outside_training(scenes, model, model_units(model, recorded[0]))


def _teacher_again(data: Path, recorded: Motions) -> tuple[dict[str, Motions], dict]:
    """The teacher's motions from perturbed starts by "teacher NAME", and what the report says of them."""
    try:
        again = baselines.chaos_floor(data, recorded, len(recorded[0].position) - 1)
    except SdfsimError as error:
        why = f"{error.message} ({error.hint})" if error.hint else error.message
        return {}, {"chaos_floor": {"left_out": why}}
    farthest = [float(_distance(one, truth).max()) for one, truth in zip(again["0"], recorded, strict=True)]
    report = {
        "perturbations": {name: _errors(motions, recorded) for name, motions in again.items()},
        "median_farthest_unperturbed_m": float(np.median(farthest)),
    }
    return {f"teacher {name}": motions for name, motions in again.items()}, {"chaos_floor": report}


def _errors(motions: Motions, recorded: Motions) -> dict[str, dict]:
    """Horizon in steps -> errors of all `motions` up to there."""
    longest = len(recorded[0].position) - 1
    horizons = sorted({h for h in (*HORIZONS, *FRAMES) if h <= longest} | {longest})
    scores = [score(motion, truth, horizons) for motion, truth in zip(motions, recorded, strict=True)]
    return {str(h): {"seconds": h * recorded[0].dt} | _summary(scores, h) for h in horizons}


def score(motion: Trajectory, truth: Trajectory, horizons: list[int]) -> Score:
    """Errors of a motion over the steps up to each horizon, and in the last of them, of the bodies that move."""
    moving = ~truth.static
    p, q = motion.position[1:, moving], motion.quat_xyzw[1:, moving]
    truth_p, truth_q = truth.position[1:, moving], truth.quat_xyzw[1:, moving]
    return Score(
        bodies=int(moving.sum()),
        squared={h: metrics.translation_rmse(p[:h], truth_p[:h]) ** 2 for h in horizons},
        angle={h: metrics.rotation_error(q[:h], truth_q[:h]) for h in horizons},
        there={h: metrics.translation_rmse(p[h - 1 : h], truth_p[h - 1 : h]) for h in horizons},
        turned={h: metrics.rotation_error(q[h - 1 : h], truth_q[h - 1 : h]) for h in horizons},
    )


def _summary(scores: list[Score], horizon: int) -> dict:
    """Errors over all bodies and steps, and 95 % intervals over trajectories."""
    bodies = np.array([s.bodies for s in scores])
    share = bodies / bodies.mean()
    squared = np.array([s.squared[horizon] for s in scores]) * share
    angle = np.array([s.angle[horizon] for s in scores]) * share
    there = np.array([s.there[horizon] for s in scores])
    turned = np.array([s.turned[horizon] for s in scores]) * share
    return {
        "translation_rmse": float(np.sqrt(squared.mean())),
        "translation_rmse_95": [float(np.sqrt(v)) for v in metrics.interval(squared)],
        "rotation_error": float(angle.mean()),
        "rotation_error_95": metrics.interval(angle),
        "at_frame": {
            "translation_rmse": float(there.mean()),
            "translation_rmse_95": metrics.interval(there),
            "rotation_error": float(turned.mean()),
            "rotation_error_95": metrics.interval(turned),
        },
    }


def _survival(contenders: dict[str, Motions], recorded: Motions) -> dict:
    """Shares of all bodies that stay near the recording, and the seconds until half of them have left it."""
    curves: dict[str, dict] = {}
    medians: dict[str, dict] = {}
    for who, motions in contenders.items():
        error = np.concatenate([_distance(m, t) for m, t in zip(motions, recorded, strict=True)], axis=1)
        shares = {str(limit): metrics.survival(error, limit) for limit in LIMITS}
        curves[who] = {limit: share[::CURVE_EVERY].tolist() for limit, share in shares.items()}
        medians[who] = {limit: metrics.median_survival(share, recorded[0].dt) for limit, share in shares.items()}
    steps = list(range(0, len(recorded[0].position), CURVE_EVERY))
    return {"survival": {"steps": steps, **curves}, "median_survival_s": medians}


def _distance(motion: Trajectory, truth: Trajectory) -> np.ndarray:
    """[T, N] m: translation errors of the bodies that move, the first frame included."""
    moving = ~truth.static
    return np.linalg.norm(motion.position[:, moving] - truth.position[:, moving], axis=-1)


def _quality(predicted: Motions, recorded: Motions, solids: dict[str, Solid]) -> dict:
    """Penetration, energy gain and resting speed of the model and of the teacher."""
    rest = [metrics.resting(t) for t in recorded]
    sides = {"model": predicted, "teacher": recorded}
    return {
        "penetration": {who: penetration(motions, solids) for who, motions in sides.items()}
        | {"geometry": {name: solid.kind for name, solid in solids.items()}, "every": EVERY},
        "energy_gain": {who: _gain(motions) for who, motions in sides.items()},
        "resting_speed": {who: _resting(motions, rest) for who, motions in sides.items()}
        | {"bodies": int(sum(r.sum() for r in rest))},
    }


def _gain(motions: Motions) -> dict[str, float | None]:
    gains = [gain for motion in motions if (gain := metrics.energy_gain(motion)) is not None]
    return {"mean": float(np.mean(gains)) if gains else None, "worst": max(gains) if gains else None}


def _resting(motions: Motions, rest: list[np.ndarray]) -> float | None:
    """Median speed m/s in the last steps of the bodies [N] that rest in the recording; None without any."""
    found = [metrics.speeds(motion)[:, r].ravel() for motion, r in zip(motions, rest, strict=True)]
    return float(np.median(np.concatenate(found))) if any(len(f) for f in found) else None
