"""How time and memory of a step grow with bodies and with nodes, on piles and bowls; the cost model comes from here."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.simulator import Simulator, pick_device
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, replacing, write_json
from sdfsim.studies.tradeoff_contenders import clock_of, peak_memory, time_simulator, weights_digest
from sdfsim.studies.tradeoff_cost import CostModel, Load, fit_cost, relative_errors
from sdfsim.studies.tradeoff_estimate import estimate, landings, roundness
from sdfsim.studies.tradeoff_growing import NAMES, Growing, build, scenes
from sdfsim.studies.tradeoff_knobs import Setting, threads_of

VERSION = 2
STEPS = 9  # of which the first is not timed
WITHIN = 0.3  # what a cost model may be off by on scenes that it was not fitted to
COURSE = 60  # steps of a whole run


COURSES = ((Growing("pile", 3), 0.0), (Growing("pile", 6), 1.5), (Growing("bowl", 5), 0.8), (Growing("pile", 2), 9.0))


def growth(
    out: Path, *, model: str | None, quick: bool, device: str, on_progress: Callable[[str, float, str], None]
) -> dict[str, Any]:
    """Time the scenes, fit the cost model to two of three and check it on the others; growth.png and growth.json.

    All of it runs in one thread, so that times tell of the work and not of how many cores share it.

    Args:
        out: folder to write; scenes that it holds already are not run again.
        model: bundled name or path.
        quick: fewer and smaller scenes.
        device: "cpu", "cuda" or "auto".
        on_progress: called with (stage, fraction, message).

    Returns:
        The content of growth.json: points, slopes, the cost model and its errors on scenes that it has not seen.
    """
    with threads_of(Setting()):
        return _growth(out, model, quick, str(pick_device(device)), on_progress)


def _growth(
    out: Path, model: str | None, quick: bool, device: str, on_progress: Callable[[str, float, str], None]
) -> dict[str, Any]:
    """See `growth`."""
    used = load_model(model)
    # What a process takes only once, the first thing it simulates must not be charged with.
    time_simulator(Simulator(build(Growing("pile", 2)), used, device), STEPS)
    points, chosen = [], scenes(quick=quick)
    for k, one in enumerate(chosen):
        on_progress("growth", k / len(chosen), f"{one.kind}, {one.bodies} bodies")
        points.append(_measured(one, out / "points" / "growth", model or used.name, device))
    on_progress("growth", 1.0, "measured")
    good = [p for p in points if not p["failed"]]
    loads, ms = [Load(**p["load"]) for p in good], [p["ms"] for p in good]
    held = [k for k in range(len(good)) if k % 3 == 1]
    kept = [k for k in range(len(good)) if k % 3 != 1]
    cost = fit_cost([loads[k] for k in kept], [ms[k] for k in kept])
    off = relative_errors(cost, [loads[k] for k in held], [ms[k] for k in held])
    on_progress("courses", 0.0, "whole runs against their estimates")
    off_course = {f"{c.key} from {h:g} m": course(c, h, cost, used, device) for c, h in COURSES}
    report = {
        "model": used.name,
        "kind": used.kind,
        "quick": quick,
        "points": points,
        "slopes": slopes(good),
        "cost": cost.to_json(),
        "held_out": {good[k]["key"]: float(e) for k, e in zip(held, off, strict=True)},
        "held_out_median": float(np.median(np.abs(off))),
        "held_out_within": float((np.abs(off) <= WITHIN).mean()),
        "courses": off_course,
        "folder": str(out),
    }
    write_json(out / "growth.json", report)
    draw(good, out / "growth.png")
    return report


def course(one: Growing, height: float, cost: CostModel, model: Model, device: str) -> float:
    """What `plan` would say of a scene dropped from `height` m, over what its run takes, less one."""
    scene = build(one)
    up = np.array([0.0, 0.0, height])
    bodies = [replace(b, position=b.position + up) if b.motion == "dynamic" else b for b in scene.bodies]
    simulator = Simulator(replace(scene, bodies=tuple(bodies)), model, device)
    landed = landings(simulator, COURSE)
    counters: dict[str, list[float]] = {"edges": [0.0], "active": [0.0], "step_ms": [0.0]}
    clock = clock_of(simulator.device)
    for _ in range(COURSE):
        began = clock()
        next(simulator.steps(1))
        counters["step_ms"].append(1e3 * (clock() - began))
        for name in ("edges", "active"):
            counters[name].append(simulator.memory.counts[name])
    trial = {name: np.array(values[:6]) for name, values in counters.items()}
    told = estimate(cost, simulator, trial, landed, COURSE)["step_ms"]
    return told / float(np.mean(counters["step_ms"][2:])) - 1.0


def _measured(one: Growing, folder: Path, model: str, device: str) -> dict[str, Any]:
    path = folder / f"{one.key}.json"
    mark = {"version": VERSION, "model": weights_digest(model), "machine": platform.node(), "device": device}
    mark |= asdict(one)
    if path.exists() and (point := read_json(path)).get("fingerprint") == mark and not point["failed"]:
        return point
    point = {"key": one.key, **asdict(one), "fingerprint": mark, "failed": ""}
    try:
        scene = build(one)
        with peak_memory() as memory:
            repeats = [time_simulator(Simulator(scene, model, device), STEPS) for _ in range(3)]
        counts = repeats[0].scenes[0]
        own = counts["nodes"] / max(1.0, counts["bodies"])
        touching = float(counts["edges"] > 0)
        point |= {
            # The least of three: what others do on the machine only adds.
            "ms": min(r.scenes[0]["ms"] for r in repeats),
            "mib": memory["mib"],
            "all_nodes": counts["nodes"],
            "load": asdict(
                Load(
                    counts["bodies"],
                    touching,
                    own * counts["active"],
                    counts["edges"],
                    roundness(Simulator(scene, model, device)),
                )
            ),
        }
    except (SdfsimError, RuntimeError, MemoryError) as error:
        point["failed"] = str(error).splitlines()[0]
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, point)
    return point


def slopes(points: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Exponents of time and memory against bodies and against nodes, of the last three points of each curve."""
    found = {}
    for name, axis, some in curves(points):
        last = some[-3:]
        if len(last) < 2:
            continue
        x = np.log([p[axis] for p in last])
        found[name] = {"time": float(np.polyfit(x, np.log([p["ms"] for p in last]), 1)[0])}
        if all(p["mib"] for p in last):
            found[name]["memory"] = float(np.polyfit(x, np.log([p["mib"] for p in last]), 1)[0])
    return found


def curves(points: Sequence[dict[str, Any]]) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """(name, axis, points in order) of every curve."""
    found = []
    for kind in NAMES:
        some = [p for p in points if p["kind"] == kind and not p["flying"]]
        by_bodies = sorted((p for p in some if p["nodes"] is None), key=lambda p: p["bodies"])
        by_nodes = sorted((p for p in some if p["nodes"] is not None), key=lambda p: p["all_nodes"])
        found += [(f"{kind}, bodies", "bodies", by_bodies), (f"{kind}, nodes", "all_nodes", by_nodes)]
    return [curve for curve in found if curve[2]]


def draw(points: Sequence[dict[str, Any]], path: Path) -> None:
    """Time and memory of a step against bodies and nodes, logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(10, 7), layout="constrained")
    found = slopes(points)
    for name, axis, some in curves(points):
        column = 0 if axis == "bodies" else 1
        for row, what in enumerate(("ms", "mib")):
            slope = found.get(name, {}).get("time" if what == "ms" else "memory")
            told = name.split(",")[0] + ("" if slope is None else f", slope at the end {slope:.2f}")
            shown = [p for p in some if p[what]]
            axes[row, column].loglog([p[axis] for p in shown], [p[what] for p in shown], "o-", ms=4, label=told)
    for column, what in enumerate(("bodies that move (98 or 128 nodes each)", "surface nodes of 16 bodies")):
        for row, measured in enumerate(("milliseconds a step", "memory of a run above the program's, MiB")):
            axes[row, column].set(xlabel=what, ylabel=measured)
            axes[row, column].grid(True, which="both", lw=0.3)
            if axes[row, column].lines:
                axes[row, column].legend(fontsize=8)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    pyplot.close(figure)


def told(report: dict[str, Any]) -> tuple[list[tuple[str, ...]], list[str]]:
    """The report of `growth` for people: a row a scene, then slopes and the cost model."""
    rows: list[tuple[str, ...]] = [("scene", "bodies", "nodes", "edges", "ms a step", "MiB")]
    for p in report["points"]:
        if p["failed"]:
            rows.append((f"{p['key']}: {p['failed']}", *[""] * 5))
        else:
            load, mib = p["load"], "-" if p["mib"] is None else f"{p['mib']:.1f}"
            numbers = (load["bodies"], p["all_nodes"], load["edges"])
            rows.append((p["key"], *(f"{v:.0f}" for v in numbers), f"{p['ms']:.2f}", mib))
    found = [f"{name}: " + ", ".join(f"{k} ~ x^{v:.2f}" for k, v in s.items()) for name, s in report["slopes"].items()]
    cost = ", ".join(f"{name} {value:.3g}" for name, value in report["cost"].items())
    return rows, [
        *found,
        f"cost model, ms: {cost}",
        f"on scenes that it was not fitted to: off by {report['held_out_median']:.0%} in the median, "
        f"{report['held_out_within']:.0%} of them within {WITHIN:.0%}",
        *(f"plan's estimate of a run of {name}: off by {e:+.0%}" for name, e in report["courses"].items()),
        f"wrote {report['folder']}",
    ]
