"""Everyday scenes with our solver and with other engines, with the same checks: RESULTS.md.

    python -m benchmarks everyday -o DIR [--full]
    python -m benchmarks everyday -o DIR --group assembly    # meshes that fit into each other

The scenes and checks are those of `python -m sdfsim.evaluation.laws.table` at 10 cm, with closed forms for shapes that
have one. Engines use inner steps of 4 ms (for bodies of a metre; for smaller ones in proportion to the square root of
their size), ours its default, which is the same. Closed forms are native to each engine; meshes that are not convex
become pieces by CoACD (tetrahedra in Drake). Newton has triangles for all but spheres and boxes. Engines do not sleep.
Scenes that an engine cannot express, or that take longer than a minute, are not run, and their checks do not count.
DIR keeps results.

In assembly each engine's cell also has the deepest overlap, in % of the smallest body, and the time of all motions on
one core, without the making of pieces. Scenes with joints run in MuJoCo only.
"""

import importlib.util
import inspect
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engines import bullet, drake, mujoco, mujoco_sdf, newton, rapier
from benchmarks.records import Out, progress, write_record
from benchmarks.rivals import in_pieces
from sdfsim.apps import mujoco_world
from sdfsim.base.errors import SdfsimError
from sdfsim.data.pybullet_sim import SUBSTEPS
from sdfsim.evaluation import engines
from sdfsim.evaluation.engines import LONGEST, SI, Engine, Ran, Runner, TooSlow, by_engine, by_model, still
from sdfsim.evaluation.harness import Job, Results, measure, one_thread
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.laws import assembly, everyday, scenes
from sdfsim.evaluation.laws.scenes import Check, Setting
from sdfsim.evaluation.laws.table import ROWS, checks
from sdfsim.physics.bodies import largest_extent
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Scene

JUDGED = 40  # frames of a run, evenly spaced, in which overlaps are measured
OURS, DRAKE, NEWTON = "sdfsim", "Drake", "Newton"
ENGINES: dict[str, tuple[str, Engine | None]] = {  # package and runner of each
    OURS: ("sdfsim", None),
    "PyBullet": ("pybullet", bullet),
    "MuJoCo": ("mujoco", mujoco),
    "MuJoCo, SDF": ("mujoco", mujoco_sdf),
    "Rapier": ("rapier3d", rapier),
    DRAKE: ("pydrake", drake),
    NEWTON: ("newton", newton),
}
GROUPS = {
    "everyday": [OURS, "PyBullet", "MuJoCo", "Rapier", DRAKE, NEWTON],
    "assembly": [OURS, "PyBullet", "MuJoCo", "MuJoCo, SDF", NEWTON],
}

OTHERS = drake, newton, rapier  # with modules of their own


class NotRun(SdfsimError):
    """A scene that an engine cannot express, or takes too long for."""


# --- running ---


def runner(name: str, folder: Path, costs: list[tuple[float, float]] | None = None) -> Runner:
    """Runs scenes with an engine, with its files in `folder`; raises NotRun if it cannot. To `costs` each run adds its
    seconds of one core and the deepest overlap relative to the smallest body."""

    def run(scene: Scene, seconds: float) -> Ran:
        engine = ENGINES[name][1]
        if why := unknown_to(name, scene):
            raise NotRun(why)
        try:
            parts = scene if engine is None else in_pieces(scene, folder / "pieces")
            began = time.process_time()
            if engine is None:
                found = by_model(scene, seconds)
            else:
                units = SI if scene.joints else scene_units(scene)
                found = by_engine(parts, seconds, engine, folder / "engine", units)
        except SdfsimError as error:
            raise NotRun("too slow" if isinstance(error, TooSlow) else error.message) from error
        took = time.process_time() - began
        if took > LONGEST:
            raise NotRun("too slow")
        if costs is not None:
            sizes = [largest_extent(scene.shapes[b.shape]) * b.scale for b in scene.bodies if b.motion == "dynamic"]
            every = -(-len(found.rollout) // JUDGED)
            costs.append((took, depths(scene, found.rollout, every).max(initial=0.0) / min(sizes)))
        return found

    return run


def unknown_to(name: str, scene: Scene) -> str:
    """The coefficients of a scene that an engine cannot express; empty if there are none."""
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    others = [b for b in scene.bodies if b.motion == "static"]
    if name != OURS and any(b.stiffness < np.inf for b in scene.bodies):
        return "materials of a given stiffness"
    if scene.joints and name != OURS and not name.startswith("MuJoCo"):
        return "joints"
    alike = len({(b.friction, b.restitution) for b in moving}) <= 1
    if not alike and (name.startswith("MuJoCo") or name in (DRAKE, NEWTON)):
        return "coefficients of pairs of several materials"
    bounces = [one.restitution * other.restitution for one in moving[:1] for other in (*others, *moving[1:])]
    if name in (DRAKE, NEWTON) and any(bounces):
        return "restitution"
    # The harmonic mean of two coefficients is less than twice the smaller one, the mean more than half the larger one.
    apart = name == DRAKE and len(moving) > 1 and any(b.friction > 2.0 * moving[0].friction for b in others)
    if apart or (name == NEWTON and any(2.0 * b.friction < one.friction for b in others for one in moving)):
        return "friction of two materials that are so different"
    return ""


# --- judging ---


def judged(row: str, at: Setting, run: Runner) -> Iterator[tuple[str, Check, str, str]]:
    """Every check of a row with its full name; the reason if one of its scenes was not run, and the reason if one
    failed."""
    absent: list[str] = []
    broken: list[str] = []
    seen = False

    def watched(scene: Scene, seconds: float) -> Ran:
        nonlocal seen
        if seen:  # a check belongs to the scenes that were run since the previous check
            seen = False
            absent.clear()
            broken.clear()
        try:
            found = run(scene, seconds)
        except NotRun as error:
            absent.append(error.message)
            return still(scene, seconds)
        broken.extend([found.broke] if found.broke else [])
        return found

    for name, check in checks(ROWS[row], replace(at, by=watched)):
        seen = True
        yield name, check, "".join(absent[:1]), "".join(broken[:1])


@one_thread()
def counted(row: str, at: Setting, name: str, folder: Path) -> dict[str, Any]:
    """For an engine and a row: the names of checks that hold and of those that do not, and the number not run by
    reason; in assembly also what its runs cost. If a motion fails, none of its checks hold."""
    held, missed, absent = [], [], Counter()
    costs: list[tuple[float, float]] | None = [] if ROWS[row].group == "assembly" else None
    began = time.process_time()
    for full, check, why, broke in judged(row, at, runner(name, folder, costs)):
        if why:
            absent[why] += 1
        else:
            (held if check.holds and not broke else missed).append(full)
    found = {"held": held, "missed": missed, "not_run": dict(absent), "s": time.process_time() - began}
    return found | ({"cost": [sum(s for s, _ in costs), max(deep for _, deep in costs)]} if costs else {})


def is_installed(name: str) -> bool:
    return importlib.util.find_spec(ENGINES[name][0]) is not None


# --- the table ---


def cell(result: dict[str, Any] | None) -> str:
    if result is None:
        return "not installed here"
    if "failed" in result:
        return result["failed"]
    run, absent = len(result["held"]) + len(result["missed"]), sum(result["not_run"].values())
    shown = f"{len(result['held'])} / {run}" if run else ""
    cost = "{:.3g} s, {:.2g} %".format(result["cost"][0], 100 * result["cost"][1]) if "cost" in result else ""
    return ", ".join(filter(None, [shown, f"{absent} not run" if absent else "", cost]))


def table(results: Results, names: list[str]) -> tuple[list[tuple[str, ...]], list[str]]:
    """Rows with their head first: one for each kind of scene, and their sum; and lines on the checks that ours misses,
    and on those not run."""
    rows = [row for row in ROWS if (row, OURS) in results]
    lines = [("checks that hold, of those run", *names)]
    lines += [(f"`{row}`", *(cell(results.get((row, name))) for name in names)) for row in rows]
    sums: dict[str, dict[str, Any]] = {}
    for name in names:
        mine = [found for row in rows if "held" in (found := results.get((row, name)) or {})]
        if mine:
            kept = {key: [one for found in mine for one in found[key]] for key in ("held", "missed")}
            sums[name] = kept | {"not_run": sum((Counter(found["not_run"]) for found in mine), Counter())}
    lines.append(("all", *(cell(sums.get(name)) for name in names)))
    lost = [f"- {check.rpartition(' [')[0]}" for check in sums.get(OURS, {"missed": ()})["missed"]]
    notes = ["Checks that sdfsim misses:", "", *(lost or ["- nothing"])]
    absent = [f"- {name}: {why}, {n} checks" for name, one in sums.items() for why, n in one["not_run"].items()]
    return lines, [*notes, *(["", "Not run:", "", *absent] if absent else [])]


def compared(group: str, at: Setting, out: Path) -> Results:
    tables = everyday if group == "everyday" else assembly
    content = [at.full, str(at), SUBSTEPS, LONGEST, inspect.getsource(tables), inspect.getsource(scenes)]
    how = [inspect.getsource(module) for module in (engines, mujoco_world, *map(inspect.getmodule, OTHERS)) if module]
    jobs = [
        Job(row, name, [content, "" if name == OURS else how], counted, (row, at, name, out / "scenes"))
        for name in GROUPS[group]
        if is_installed(name)
        for row, law in ROWS.items()
        if law.group == group
    ]
    return measure(jobs, out / "results", on_progress=progress)


def main(*, out: Out, full: bool = False, group: str = "everyday") -> None:
    results = compared(group, Setting(full=full), out)
    for name in GROUPS[group]:
        took = sum(found.get("s", 0.0) for (_, other), found in results.items() if other == name)
        print(f"{name}: {took:.0f} s of the processor")
    (columns, *rows), notes = table(results, GROUPS[group])
    command = f"python -m benchmarks everyday -o DIR{' --full' if full else ''}"
    measured = "Checks that hold, of those run, on everyday scenes at 10 cm."
    if group == "assembly":
        command += " --group assembly"
        measured = "Checks that hold, of those run; seconds of one core for all motions, and the deepest overlap."
    write_record(group, command, measured, columns, rows, notes)
