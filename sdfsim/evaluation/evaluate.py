"""Rollouts compared with a recorded dataset: the measures of models, and their tables."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.console import columns
from sdfsim.base.devices import pick_device
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, parallel, silent
from sdfsim.data.batching import batches, centred, first_frames, model_units, roll_out, scene_of
from sdfsim.data.dataset import (
    Trajectory,
    conditions_of,
    engine_substep,
    floor_of,
    home_of,
    load_shapes,
    read_info,
    trajectory_files,
)
from sdfsim.data.pybullet_sim import engine_settings, import_pybullet, substeps_of
from sdfsim.evaluation import metrics
from sdfsim.evaluation.engines import Start, bullet, dataset_urdf, scene_rollout
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.metrics import Motions, energy_gain, errors
from sdfsim.learned.model import Model, load_model
from sdfsim.physics.options import STEP, SUBSTEPS
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.shape import Shape
from sdfsim.simulate.steppers import FreeFlight, stepper_of

EVERY = 10  # every how many frames overlaps are measured
SURVIVED = "0.25"  # m, the limit for which the median survival time is shown
NOTHING = "-"
# m/s; 0 shows the effect of state that a recording does not contain: an engine keeps more state than its recorded
# frames.
PERTURBATIONS = {"0": 0.0, "1e-6": 1e-6, "1e-3": 1e-3}

Rows = list[tuple[str, ...]]


def evaluate(
    data: Path,
    *,
    model: str | Path | Model | None = None,
    steps: int = 100,
    split: str = "test",
    device: str = "cpu",
    free_flight: FreeFlight = "exact",
    substeps: int | None = None,
    chaos_floor: bool = False,
    errors_only: bool = False,
    on_progress: Progress = silent,
) -> dict:
    """Roll a model out from the first frame of every trajectory, and compare it and the ballistic baseline with the
    recording.

    Args:
        model: bundled name, path or `Model`.
        steps: length of the rollouts; errors are reported at the horizons of `HORIZONS` up to it, and at it.
        free_flight: "exact" or (networks on surface nodes) "learned".
        substeps: inner steps of the solve in a step; None: those of `users_inner`.
        chaos_floor: also run PyBullet again from starts that differ slightly (see `PERTURBATIONS`).
        errors_only: leave out penetration, energy gain and resting speed.

    Returns:
        A report:
        "model", "ballistic": errors as `errors` gives them.
        "chaos_floor": "perturbations" -> name -> errors; "median_farthest_unperturbed_m".
        "outside_training": in what ways the scenes are outside the model's training, one line each.
        "median_survival_s": for all of them, by limit in m: time until half of the bodies are farther from the
        recording. "penetration" m, "energy_gain" (a fraction), "resting_speed" m/s: of the model and of the recording.
        "engine_substep": s, the recording engine's inner step; 0 if no dataset.json gives it. "floor": its "friction"
        and "restitution"; "told" is whether a dataset.json gives them. "inner_steps": number of inner
        steps of the solve in a step. Further counts, and "ms_per_step_per_trajectory".

    Raises:
        SdfsimError: missing or unreadable trajectories or shapes, or a `chaos_floor` that cannot be measured; with exit
            code 3 if a rollout is not finite.
    """
    used = (model if isinstance(model, Model) else load_model(model)).to(str(pick_device(device)))
    stepper = stepper_of(used, free_flight=free_flight)
    recorded, shapes = load_recorded(data, split)
    longest = min(steps, *(len(t.position) - 1 for t in recorded))
    recorded = [first_frames(t, longest + 1) for t in recorded]
    again: dict[str, Motions] = {}
    if chaos_floor:
        on_progress(0.0, "teacher, from starts that differ slightly")
        starts = load_recorded(data, split, as_recorded=True)[0]
        again = teacher_again(data, starts, longest)
    substep, conditions = engine_substep(data), conditions_of(data)
    friction, restitution = conditions.floor
    contenders: dict[str, Motions] = {"model": [], "ballistic": []}
    groups = batches(recorded)
    scenes, seconds = [scene_of([t], [0], shapes, conditions.floor)[0] for t in recorded], 0.0
    inner = substeps or (SUBSTEPS if stepper.network else users_inner(recorded[0].dt, scenes))
    for k, group in enumerate(groups):
        on_progress(0.8 * k / len(groups), f"{used.name}: batch {k + 1} of {len(groups)}, {longest} steps")
        common = (used, group, shapes, longest)
        started = time.perf_counter()
        contenders["model"] += roll_out(*common, free_flight, substeps=inner, floor=conditions.floor)
        seconds += time.perf_counter() - started
        contenders["ballistic"] += roll_out(*common, contact=False)
    report = {
        "data": str(data),
        "split": split,
        "model_name": used.name,
        "free_flight": free_flight,
        "trajectories": len(recorded),
        "bodies": int(sum(t.position.shape[1] for t in recorded)),
        "dt": recorded[0].dt,
        "steps": longest,
        "steps_asked": steps,
        "engine_substep": substep,
        "floor": {"friction": friction, "restitution": restitution, "told": conditions.floor_given},
        "inner_steps": inner,
        "outside_training": stepper.unknown(scenes, model_units(stepper, recorded[0])),
        "ms_per_step_per_trajectory": 1e3 * seconds / longest / len(recorded),
        **{who: errors(motions, recorded) for who, motions in contenders.items()},
        "median_survival_s": {who: metrics.survival(motions, recorded) for who, motions in contenders.items()},
    }
    for name, motions in again.items():
        report["median_survival_s"][f"teacher {name}"] = metrics.survival(motions, recorded)
    if again:
        farthest = [metrics.distance(one, truth).max() for one, truth in zip(again["0"], recorded, strict=True)]
        report["chaos_floor"] = {
            "perturbations": {name: errors(motions, recorded) for name, motions in again.items()},
            "median_farthest_unperturbed_m": float(np.median(farthest)),
        }
    if not errors_only:
        on_progress(0.9, "penetration, energy and rest")
        rest = [metrics.resting(t) for t in recorded]
        sides = {"model": contenders["model"], "teacher": recorded}
        geometry = {
            name: "closed form" if isinstance(shape.sdf, ClosedForm) else "pieces" if shape.pieces else "mesh"
            for name, shape in shapes.items()
        }
        depth = {who: penetration(motions, shapes) for who, motions in sides.items()}
        report["penetration"] = depth | {"geometry": geometry, "every": EVERY}
        report["energy_gain"] = {who: energy_gain(motions) for who, motions in sides.items()}
        resting: dict[str, float | None] = {"bodies": int(sum(r.sum() for r in rest))}
        for who, motions in sides.items():  # the median, in the last steps, over the bodies that rest in the recording
            last = [metrics.speeds(motion)[:, r].ravel() for motion, r in zip(motions, rest, strict=True)]
            speeds = np.concatenate(last)
            resting[who] = float(np.median(speeds)) if len(speeds) else None
        report["resting_speed"] = resting
    on_progress(1.0, "done")
    return report


def penetration(motions: Motions, shapes: dict[str, Shape]) -> dict[str, Any]:
    """Penetration in m over the frames of all `motions` in which something touches: percentile_95 and worst of a
    frame's deepest overlap (None if nothing touches), and steps_with_contact."""
    own, found = {name: centred(shape) for name, shape in shapes.items()}, []
    for motion in motions:
        scene = scene_of([motion], [0], own)[0]
        found.append(depths(scene, scene_rollout(scene, motion), EVERY))
    depth = np.concatenate(found)
    return {
        "percentile_95": float(np.percentile(depth, 95)) if len(depth) else None,
        "worst": float(depth.max()) if len(depth) else None,
        "steps_with_contact": len(depth),
    }


def users_inner(dt: float, scenes: list[Scene]) -> int:
    """Number of inner steps in a step of `dt` s, such that they are no longer than those of `Simulator` with the
    smallest body."""
    longest = min(scene_units(scene).time for scene in scenes) * STEP / SUBSTEPS
    return max(1, math.ceil(dt / longest - 0.01))


def load_recorded(
    data: Path, split: str, *, most: int | None = None, as_recorded: bool = False
) -> tuple[Motions, dict[str, Shape]]:
    """Trajectories in which something moves, in groups that can run side by side, and their shapes."""
    recorded = [Trajectory.load(f, as_recorded=as_recorded) for f in trajectory_files(data, split)[:most]]
    recorded = [t for group in batches(recorded) for t in group if not t.static.all()]
    if not recorded:
        raise SdfsimError(f"{data}: nothing moves in any trajectory")
    if len(steps := {t.dt for t in recorded}) > 1:
        raise SdfsimError(f"{data}: trajectories of different steps ({', '.join(f'{dt:g} s' for dt in sorted(steps))})")
    return recorded, load_shapes(data, {str(n) for t in recorded for n in t.shape})


# --- the teacher against itself ---


def teacher_again(data: Path, trajectories: Motions, steps: int, seed: int = 0) -> dict[str, Motions]:
    """Run PyBullet again from recorded starts (with velocities as recorded) of a dataset with a URDF for every shape.

    Returns, by the names of `PERTURBATIONS`, the motions (steps + 1 frames) after the velocity of each dynamic body was
    changed by that much in a random direction. Raises SdfsimError if PyBullet or an engine file is missing, or if the
    recording was not made with the teacher's settings.
    """
    import_pybullet()
    home = home_of(data) or data.parent
    info = read_info(home)
    floor, settings = floor_of(info, home), info.get("engine_settings")
    if info.get("engine") != "pybullet" or not isinstance(settings, dict):
        raise SdfsimError(
            f"recorded by {info.get('engine') or 'an unnamed engine'}, not by PyBullet with the teacher's settings"
        )
    ours = engine_settings(trajectories[0].dt, substeps_of(trajectories[0].dt))
    if other := [name for name, value in ours.items() if settings.get(name) != value]:
        raise SdfsimError(f"recorded with other engine settings ({', '.join(other)})")
    urdfs = {name: dataset_urdf(data, name) for name in {str(n) for t in trajectories for n in t.shape}}
    jobs = [
        (Start(perturbed(t, size, [seed, k]), urdfs, floor), steps)
        for size in PERTURBATIONS.values()
        for k, t in enumerate(trajectories)
    ]
    done = {index: motion for index, (motion, _) in parallel(bullet, jobs)}
    count = len(trajectories)
    return {name: [done[i * count + k] for k in range(count)] for i, name in enumerate(PERTURBATIONS)}


def perturbed(t: Trajectory, size: float, seed: list[int]) -> Trajectory:
    """The trajectory with velocities of its moving bodies changed by `size` m/s in random directions."""
    direction = np.random.default_rng(seed).normal(size=t.velocity[0].shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return replace(t, velocity=t.velocity + size * direction * ~t.static[:, None])


# --- tables ---


def report_lines(report: dict[str, Any]) -> list[str]:
    """The report as text: errors at every horizon, then the quality of the motion."""
    name = report["model_name"]
    return [
        "Translation RMSE and mean rotation error up to each horizon (95 % intervals over trajectories)",
        *columns(error_rows(report, name=name)),
        "",
        *columns(quality_rows(report, name=name)),
        "",
        *notes(report),
        f"{report['trajectories']} trajectories, {report['bodies']} bodies, "
        f"{report['ms_per_step_per_trajectory']:.2f} ms per step and trajectory",
    ]


def error_rows(report: dict[str, Any], *, name: str) -> Rows:
    """Errors up to every horizon, with their intervals; the header first. Rows are the model, PyBullet run again, and
    flight without contact."""
    again = {f"teacher, {size} m/s off": found for size, found in _perturbed(report).items()}
    spans = [f"{steps} steps = {found['seconds']:.3g} s" for steps, found in report["model"].items()]
    rows: Rows = [("", *(f"{unit}, {span}" for span in spans for unit in ("m", "degrees")))]
    for who, horizons in ({name: report["model"]} | again | {"ballistic": report["ballistic"]}).items():
        cells = []
        for found in horizons.values():
            for what, digits in (("translation_rmse", 3), ("rotation_error", 1)):
                low, high = (f"{end:.{digits}f}" for end in found[f"{what}_95"])
                cells.append(f"{found[what]:.{digits}f} ({low} to {high})")
        rows.append((who, *cells))
    return rows


def quality_rows(report: dict[str, Any], *, name: str) -> Rows:
    """Penetration, energy, rest and survival of the model and of the recording."""
    head = ("", "penetration 95 %", "worst", "energy gain", "worst", "resting speed", f"within {SURVIVED} m for")
    length = max(found["seconds"] for found in report["model"].values())

    def lasting(who: str) -> str:
        seconds = report["median_survival_s"][who][SURVIVED]
        return f"> {length:g} s" if seconds is None else f"{seconds:.2f} s"

    def quality(who: str) -> list[str]:
        depth, gain = report["penetration"][who], report["energy_gain"][who]
        shown = {
            "{:.4f} m": [depth["percentile_95"], depth["worst"]],
            "{:.2f} %": [value and 100 * value for value in (gain["mean"], gain["worst"])],
            "{:.4f} m/s": [report["resting_speed"][who]],
        }
        return [NOTHING if value is None else form.format(value) for form, values in shown.items() for value in values]

    others = {f"teacher, {size} m/s off": f"teacher {size}" for size in _perturbed(report)} | {"ballistic": "ballistic"}
    return [
        head,
        (name, *quality("model"), lasting("model")),
        ("teacher, recorded", *quality("teacher"), NOTHING),
        *((who, *[NOTHING] * (len(head) - 2), lasting(key)) for who, key in others.items()),
    ]


def notes(report: dict[str, Any]) -> list[str]:
    depth, floor, steps = report["penetration"], report.get("chaos_floor", {}), report["steps"]
    ground, source = report["floor"], "from dataset.json" if report["floor"]["told"] else "that of our recipes"
    lines = [
        f"Floor: friction {ground['friction']:g}, restitution {ground['restitution']:g}, {source}.",
        f"The solve makes {report['inner_steps']} inner steps in a recorded one, as in a user's run.",
        f"Penetration: the deepest overlap in every {depth['every']}th frame with contact.",
        "Energy gain: the largest over the energy at the start; mean and worst of the trajectories.",
        f"Resting speed: median of the {report['resting_speed']['bodies']} bodies that rest in the recording.",
        f"Within {SURVIVED} m: until half of the bodies have been farther from the recording.",
        *(f"Outside the model's training: {line}." for line in report["outside_training"]),
    ]
    if steps < report["steps_asked"]:
        lines.append(f"The shortest recording ends after {steps} steps; {report['steps_asked']} were asked for.")
    if not report["engine_substep"]:
        lines.append(
            "No dataset.json gives the engine's inner step: velocities are taken as those at the positions' instants."
        )
    if floor:
        farthest = f"{floor['median_farthest_unperturbed_m']:.1g} m (median of the trajectories)"
        lines.append(f"Run again without perturbation, PyBullet departs from its recording by up to {farthest}.")
    return lines


def _perturbed(report: dict[str, Any]) -> dict[str, dict]:
    """Errors of PyBullet run again, by perturbation, without the unperturbed run, which is reported as a note."""
    runs = report.get("chaos_floor", {}).get("perturbations", {})
    return {size: found for size, found in runs.items() if size != "0"}
