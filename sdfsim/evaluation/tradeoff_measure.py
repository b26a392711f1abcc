"""Measures contenders on the cases, one JSON file each, and goes on where an earlier call was cut off."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.data import metrics
from sdfsim.data.dataset import Trajectory
from sdfsim.data.replay import first_frames
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.evaluate import score
from sdfsim.evaluation.penetration import penetration
from sdfsim.evaluation.tradeoff_cases import Cases
from sdfsim.evaluation.tradeoff_contenders import Contender, Prepared, Timed, peak_memory
from sdfsim.evaluation.tradeoff_front import spread
from sdfsim.files import read_json, write_json

VERSION = 1  # counts up when what is measured changes, so that kept points are measured again
REPEATS = 5
EXPLODED = 1.0  # an energy gain of so many times the energy at the start is a motion that blew up
SAME = 1e-6  # m, by which the ends of two repeats may differ

Progress = Callable[[float, str], None]
Point = dict[str, Any]


def measure(contenders: Sequence[Contender], cases: Cases, folder: Path, on_progress: Progress) -> list[Point]:
    """Errors of all contenders first, then `REPEATS` timed rounds in which they take turns.

    Args:
        contenders: who takes part.
        cases: what they simulate.
        folder: of the points; those that are there and still hold are kept.
        on_progress: called with the fraction done and a message.

    Returns:
        A point a contender, `failed` saying what went wrong, if anything; see `summary` for the rest.
    """
    folder.mkdir(parents=True, exist_ok=True)
    points, ready = [], {}
    total = len(contenders) * (1 + REPEATS)
    for k, contender in enumerate(contenders):
        on_progress(k / total, f"errors of {contender.label}")
        points.append(_kept(contender, cases, folder) or _scored(contender, cases, folder, ready))
    for turn in range(REPEATS):
        for k, (contender, point) in enumerate(zip(contenders, points, strict=True)):
            done = len(contenders) * (1 + turn) + k
            on_progress(done / total, f"time of {contender.label}, repeat {turn + 1} of {REPEATS}")
            if not point["failed"] and len(point["repeats"]) <= turn:
                _timed(contender, point, cases, ready)
                write_json(folder / f"{contender.key}.json", point)
    on_progress(1.0, "measured")
    return [point | summary(point) for point in points]


def summary(point: Point) -> dict[str, Any]:
    """What the repeats of a point amount to: `ms`, milliseconds per simulated second, and where the time went."""
    if not point["repeats"]:
        return {"ms": None, "busy": None}
    wall = [1e3 * r["wall"] / r["simulated"] for r in point["repeats"]]
    cpu = [1e3 * r["cpu"] / r["simulated"] for r in point["repeats"]]
    return {
        # On a core of its own the clock shows what the processor does; on a shared one it shows what others do.
        "ms": spread(cpu if point["one_core"] else wall),
        "busy": float(np.median(np.array(wall) / np.array(cpu))),
        "first_step_ms": float(np.median([r["first_ms"] for r in point["repeats"]])),
    }


def _kept(contender: Contender, cases: Cases, folder: Path) -> Point | None:
    path = folder / f"{contender.key}.json"
    if not path.exists():
        return None
    point = read_json(path)
    # What failed may have lacked an engine or memory that is there by now.
    same = point.get("fingerprint") == _fingerprint(contender, cases)
    return point if same and not point["failed"] else None


def _fingerprint(contender: Contender, cases: Cases) -> dict[str, Any]:
    return {"version": VERSION, "cases": cases.digest(), "machine": platform.node(), **contender.describe()}


def _scored(contender: Contender, cases: Cases, folder: Path, ready: dict[str, Prepared]) -> Point:
    """Errors and quality of a contender's motions; a motion that breaks makes a point that says so."""
    point: Point = {
        "key": contender.key,
        "label": contender.label,
        "kind": contender.kind,
        "one_core": contender.one_core,
        "fingerprint": _fingerprint(contender, cases),
        "failed": "",
        "repeats": [],
    }
    try:
        with peak_memory() as memory:
            began = time.perf_counter()
            ready[contender.key] = contender.prepare(cases)
            point["prepare_s"] = time.perf_counter() - began
            point["fitted_s"] = ready[contender.key].fitted_s()
            motions = ready[contender.key].motions()
        point["peak_mib"] = memory["mib"]
        point |= judged(motions, cases)
    except (SdfsimError, RuntimeError, MemoryError) as error:
        point["failed"] = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    write_json(folder / f"{contender.key}.json", point)
    return point


def judged(motions: list[Trajectory], cases: Cases) -> dict[str, Any]:
    """Errors at the horizons, penetration and energy of motions; `failed` where they blew up."""
    horizons = sorted({h for h in metrics.HORIZONS if h <= cases.steps} | {cases.steps})
    if not all(np.isfinite(m.position).all() and np.isfinite(m.quat_xyzw).all() for m in motions):
        return {"failed": "a state is not finite"}
    scores = [score(motion, truth, horizons) for motion, truth in zip(motions, cases.recorded, strict=True)]
    bodies = np.array([s.bodies for s in scores])
    errors, gains = {}, {}
    for h in horizons:
        squared = np.array([s.squared[h] for s in scores]) * bodies / bodies.mean()
        errors[str(h)] = {
            "translation_rmse": cases.length * float(np.sqrt(squared.mean())),
            "translation_rmse_95": [cases.length * float(np.sqrt(v)) for v in metrics.interval(squared)],
            "squared_by_trajectory": (cases.length**2 * squared).tolist(),
            "rotation_error": float((np.array([s.angle[h] for s in scores]) * bodies / bodies.mean()).mean()),
        }
        gained = [metrics.energy_gain(first_frames(m, h + 1)) for m in motions]
        known = [g for g in gained if g is not None]
        gains[str(h)] = {"mean": float(np.mean(known)), "worst": float(max(known))} if known else None
    worst = gains[str(horizons[-1])]
    exploded = worst is not None and worst["worst"] > EXPLODED
    depth = penetration(motions, cases.solids)["percentile_95"]
    return {
        "failed": f"gains {worst['worst']:.1f} times its energy" if exploded and worst else "",
        "errors": errors,
        "energy_gain": gains,
        "penetration_p95": None if depth is None else cases.length * depth,
    }


def _timed(contender: Contender, point: Point, cases: Cases, ready: dict[str, Prepared]) -> None:
    """Add a repeat to a point, or what went wrong in it: only a state that is what it was before counts."""
    try:
        if contender.key not in ready:
            ready[contender.key] = contender.prepare(cases)
        repeat = ready[contender.key].timed()
    except (SdfsimError, RuntimeError, MemoryError) as error:
        point["failed"] = f"while timed: {error}".splitlines()[0]
        return
    if not np.isfinite(repeat.end).all():
        point["failed"] = "while timed: a state is not finite"
        return
    if "end" in point and (far := float(np.abs(repeat.end - np.array(point["end"])).max())) > SAME:
        point["failed"] = f"while timed: two repeats end {far:.2g} m apart"
        return
    point["end"] = repeat.end.tolist()
    point["scenes"] = repeat.scenes if "scenes" not in point else _faster(point["scenes"], repeat)
    taken = {name: getattr(repeat, name) for name in ("wall", "cpu", "first_ms")}
    point["repeats"].append(taken | {"simulated": repeat.simulated * cases.time})


def _faster(scenes: list[dict[str, float]], repeat: Timed) -> list[dict[str, float]]:
    """Of every scene the counts, and the least time of a step."""
    return [one | {"ms": min(one["ms"], new["ms"])} for one, new in zip(scenes, repeat.scenes, strict=True)]
