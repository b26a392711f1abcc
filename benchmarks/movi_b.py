"""Errors on recorded MOVi-B scenes, with those of free flight and of PyBullet itself from changed starts: RESULTS.md.

    python -m benchmarks movi_b DATA
    python -m benchmarks movi_b DATA --contacts
    python -m benchmarks movi_b DATA --bundled

DATA is a MOVi-B dataset, with `--bundled` one of the MOVi-C recipe; its test split is rolled out. Results have the
form `error [95 % interval over trajectories]`. A second table has the steps nearest to the instants of HOPNet's errors.
Its recordings have 240 frames a second (`frame_rate` in samples/MOVi-B/*/metadata.json of
github.com/AmauryWEI/hopnet), so its frame 100 is 0.417 s.

`--contacts` measures instead which contacts differ: every recorded frame of DATA's test split is stepped once, so that
errors do not accumulate.

`--bundled` writes the errors of the solver and of all bundled models to the section MOVi-C of docs/paper.md.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.results import write_section
from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory, conditions_of, engine_substep
from sdfsim.evaluation.evaluate import evaluate, load_recorded
from sdfsim.evaluation.harness import markdown, number
from sdfsim.learned.model import load_model
from sdfsim.physics.motion import MOTION
from sdfsim.shape.shape import Shape
from sdfsim.training.contact_cache import inner_steps

COMMAND = "python -m benchmarks movi_b DATA"
STEPS = ("50", "100")
FLOWN = 1e-3  # m from free flight: a body farther off has touched something
# m/s, change of velocity by contacts in a step: above the first it is an impact, up to the second it is none
HIT, UNTOUCHED = 0.4, 1e-3
LESS = 0.25  # of an impact's change of velocity: a body with less has not had this impact in this step
RESTS = 0.05  # m/s: below this a touching body rests, above it slides or rolls
BESIDE = 0.02  # m between the bounding balls of two bodies, up to which they are neighbours
# HOPNet's frames -> its errors in metres and degrees on its own recordings, quoted by Dou et al. 2026 (arXiv
# 2605.09196)
RATE, HOPNET = 240, {50: (0.047, None), 75: (0.101, None), 100: (0.176, 17.9)}


def main(data: Path, *, contacts: bool = False, bundled: bool = False) -> None:
    if contacts or bundled:
        (differing if contacts else of_models)(data)
        return
    horizons(data)
    instants(data)


def of_models(data: Path) -> None:
    """Write the section: errors of the solver and of all bundled models, with exact free flight."""
    found = {}
    for model in ("solver", "small", "gnn", "sdf-sim"):
        report = evaluate(data, model=model, steps=100, chaos_floor=model == "solver", errors_only=True)
        found[f"`{model}`"] = report["model"]
        if model == "solver":
            found["all contact ignored"] = report["ballistic"]
            found["the engine again, starts 1e-3 m/s off"] = report["chaos_floor"]["perturbations"]["1e-3"]
    write_section("MOVi-C", f"{COMMAND} --bundled", table(found))


def horizons(data: Path) -> None:
    solver, small = (
        evaluate(data, model=model, steps=100, chaos_floor=model == "small", errors_only=True)
        for model in ("solver", "small")
    )
    found = {"`solver`": solver["model"], "`small`": small["model"], "all contact ignored": small["ballistic"]}
    for size, errors in small["chaos_floor"]["perturbations"].items():
        found[f"the engine again, starts {size} m/s off"] = errors
    write_section("MOVi-B", COMMAND, table(found))


def table(found: dict[str, dict]) -> str:
    """Errors at both horizons, a row for each motion."""
    rows: list[tuple[str, ...]] = [("", *(f"{unit}, {steps} steps" for steps in STEPS for unit in ("m", "degrees")))]
    for name, errors in found.items():
        cells = []
        for steps in STEPS:
            metres, low, high = map(number, (errors[steps]["translation_rmse"], *errors[steps]["translation_rmse_95"]))
            cells += [f"{metres} [{low}, {high}]", number(errors[steps]["rotation_error"])]
        rows.append((name, *cells))
    return markdown(rows)


def instants(data: Path) -> None:
    """Write the section: errors at single instants, and the share of bodies that have touched nothing by then."""
    recorded, _ = load_recorded(data, "test")
    columns: dict[str, dict[str, str]] = {}
    for frame, (metres, degrees) in HOPNET.items():
        step = round(frame / RATE / recorded[0].dt)
        solver, small = (
            evaluate(data, model=model, steps=step, chaos_floor=model == "small", errors_only=True)
            for model in ("solver", "small")
        )
        again = small["chaos_floor"]["perturbations"]["1e-3"]
        found = {"`solver`": solver["model"], "`small`": small["model"], "all contact ignored": small["ballistic"]}
        found["the engine again, starts 1e-3 m/s off"] = again
        cells = {name: cell(errors[str(step)]["at_frame"]) for name, errors in found.items()}
        cells["bodies that have met nothing yet"] = f"{100 * flying(recorded, step):.0f} %"
        published = f"{metres} m" + (f", {degrees} degrees" if degrees else "")
        cells["HOPNet, on its own recordings"] = f"{published}, at {frame / RATE:.3f} s"
        columns[f"at {step * recorded[0].dt:.2f} s"] = cells
    rows = [("", *columns), *((name, *(cells[name] for cells in columns.values())) for name in cells)]
    write_section("instants", COMMAND, markdown(rows))


def differing(data: Path) -> None:
    """Write the section: squared errors of velocities after one step from each recorded frame, by kinds of contact."""
    recorded, shapes = load_recorded(data, "test")
    conditions, model = conditions_of(data), load_model("solver")
    inner = inner_steps(recorded[0].dt, engine_substep(data))
    found: dict[str, list[np.ndarray]] = {}
    for t in recorded:
        starts = [replace(t, **{n: getattr(t, n)[k : k + 2] for n in MOTION}) for k in range(len(t.position) - 1)]
        ends = roll_out(
            model, starts, shapes, 1, substeps=inner, as_teacher=conditions.by_teacher, floor=conditions.floor
        )
        for start, end in zip(starts, ends, strict=True):
            kinds, errors = contact_kinds(start, end, shapes)
            for kind in set(kinds):
                found.setdefault(kind, []).append(errors[[k == kind for k in kinds]])
    errors = {kind: np.concatenate(some) for kind, some in found.items()}
    total = sum((np.square(some).sum(0) for some in errors.values()), np.zeros(2))
    count = sum(map(len, errors.values()))
    order = sorted(errors, key=lambda kind: -np.square(errors[kind][:, 0]).sum())
    rows: list[tuple[str, ...]] = [
        ("contacts of", "of all", "of the squared error, m/s", "rad/s", "root mean square, m/s", "rad/s")
    ]
    for kind in order:
        square = np.square(errors[kind])
        shares = (f"{100 * len(square) / count:.2g} %", *(f"{100 * s:.2g} %" for s in square.sum(0) / total))
        rows.append((kind, *shares, *(number(float(r)) for r in np.sqrt(square.mean(0)))))
    worst = np.sort(np.square(np.concatenate([some[:, 0] for some in errors.values()])))[::-1]
    share = worst[: len(worst) // 100].sum() / worst.sum()
    told = f"{count:,} contacts of {len(recorded)} trajectories; 1 % of them have {100 * share:.0f} % of the error."
    write_section("MOVi-B contacts", f"{COMMAND} --contacts", f"{markdown(rows)}\n{told}")


def contact_kinds(recorded: Trajectory, ours: Trajectory, shapes: dict[str, Shape]) -> tuple[list[str], np.ndarray]:
    """For one step [2 frames], the kind of contact of each body that touched something in either motion, and the errors
    of its velocities at the end, [B, 2] m/s and rad/s."""
    given = [np.linalg.norm(np.diff(t.velocity, axis=0)[0] - t.gravity * t.dt, axis=1) for t in (recorded, ours)]
    errors = np.stack(
        [
            np.linalg.norm(getattr(ours, n)[1] - getattr(recorded, n)[1], axis=1)
            for n in ("velocity", "angular_velocity")
        ],
        axis=1,
    )
    radius = np.array([np.linalg.norm(np.ptp(shapes[str(n)].sdf.bounds, axis=0)) / 2 for n in recorded.shape])
    radius = radius * recorded.scale
    away = np.linalg.norm(recorded.position[0][:, None] - recorded.position[0], axis=2) - radius[:, None] - radius
    np.fill_diagonal(away, np.inf)
    touched = np.flatnonzero(~recorded.static & (np.maximum(*given) > UNTOUCHED))
    kinds = []
    for b in touched:
        theirs, mine = given[0][b], given[1][b]
        if max(theirs, mine) <= HIT:
            slides = np.linalg.norm(recorded.velocity[0, b]) > RESTS
            what = "sliding or rolling" if slides else "resting"
        elif mine < LESS * theirs:
            what = "impact only in the recording"
        elif theirs < LESS * mine:
            what = "impact only in ours"
        else:
            what = "impact in both"
        body = "several pieces" if len(shapes[str(recorded.shape[b])].pieces) > 1 else "one hull"
        kinds.append(f"{body}, {'near another body' if away[b].min() < BESIDE else 'near only the floor'}: {what}")
    return kinds, errors[touched]


def cell(found: dict) -> str:
    metres, low, high = map(number, (found["translation_rmse"], *found["translation_rmse_95"]))
    return f"{metres} m [{low}, {high}], {number(found['rotation_error'])} degrees"


def flying(recorded: list[Trajectory], step: int) -> float:
    """Share of the moving bodies that are still in free flight, by their positions."""
    away = []
    for t in recorded:
        seconds = step * t.dt
        free = t.position[0] + t.velocity[0] * seconds + 0.5 * t.gravity * seconds**2
        away.append(np.linalg.norm(t.position[step] - free, axis=-1)[~t.static])
    return float((np.concatenate(away) < FLOWN).mean())
