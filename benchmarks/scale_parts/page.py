"""What benchmarks/scale.py found, as markdown tables and one picture."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from sdfsim.files import write_text

Results = dict[str, dict]
NETWORKS = {"ours": "impulse", "paper": "paper, always on"}
_MARKS = ("<!-- tables -->", "<!-- end of tables -->")
ENGINES = {"bullet": "PyBullet, convex pieces", "bullet_concave": "PyBullet, mesh", "mujoco": "MuJoCo, convex pieces"}


def tables(results: Results) -> str:
    """Every part that has results, in markdown."""
    parts = (_growth, _phases, _nodes, _apart, _networks, _engines, _selection, _accuracy)
    return "\n\n".join(text for part in parts if (text := part(results))) + "\n"


def insert(text: str, path: Path) -> None:
    """Put the tables into a page, in place of those between its two marks."""
    before, rest = path.read_text(encoding="utf-8").split(_MARKS[0])
    after = rest.split(_MARKS[1])[1]
    write_text(path, f"{before}{_MARKS[0]}\n\n{text}\n{_MARKS[1]}{after}")


def slope(x: list[float], y: list[float]) -> float:
    """Of a straight line through the points in log-log, least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def series(results: Results, start: str) -> list[tuple[int, dict]]:
    """The cases `start`_NUMBER in order of the number."""
    found = [(re.fullmatch(rf"{start}_(\d+)", key), value) for key, value in results.items()]
    return sorted((int(match[1]), value) for match, value in found if match)


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _growth(results: Results) -> str:
    rows, notes = [], []
    for nodes in (64, 512):
        found = series(results, f"growth_{nodes}")
        for count, r in found:
            depth, overlap = (100 * r[k] / 0.52 for k in ("penetration_95", "overlap_95"))
            values = [f"{r['nodes']:,}", f"{r['contacts']:.0f}", f"{r['ms']:.1f}", f"{r['peak_mib']:.0f}"]
            values += [f"{overlap:.1f} %", f"{depth:.1f} %", str(r["lost"]), r["broken"] or ""]
            rows.append([str(count), str(nodes), *values])
        large = [(c, r) for c, r in found if c >= 16]
        if len(large) > 1:
            cost, memory = ([r[k] for _, r in large] for k in ("ms", "peak_mib"))
            contacts = [r["contacts"] for _, r in large]
            bodies = [float(c) for c, _ in large]
            notes.append(
                f"{nodes} nodes, {large[0][0]} to {large[-1][0]} spheres: time grows {cost[-1] / cost[0]:.1f} times "
                f"(slope {slope(bodies, cost):.2f} against bodies, {slope(contacts, cost):.2f} against contacts), "
                f"contacts {contacts[-1] / contacts[0]:.1f} times, memory slope {slope(bodies, memory):.2f}."
            )
    if not rows:
        return ""
    head = ["spheres", "nodes each", "nodes", "contacts", "ms a step", "MiB"]
    head += ["overlap 95 %", "deepest node 95 %", "lost", ""]
    return "### Growth\n\n" + _table(head, rows) + "\n\n" + "\n\n".join(notes)


def _phases(results: Results) -> str:
    rows = []
    for count, r in series(results, "growth_64"):
        total = sum(r["phases"].values())
        rows.append([str(count), *(f"{100 * v / total:.0f} %" for v in r["phases"].values())])
    if not rows:
        return ""
    names = ["broad phase", "distances", "flight", "network", "sleep"]
    return "### Phases\n\n" + _table(["spheres", *names], rows)


def _nodes(results: Results) -> str:
    rows = []
    for name in ("bowl", "knots"):
        before = None
        for nodes, r in series(results, f"nodes_{name}"):
            times = "" if before is None else f"{r['ms'] / before:.2f}"
            asked = f"{r['counts']['sdf_queries']:.0f}"
            rows.append([name, str(nodes), f"{r['contacts']:.0f}", asked, f"{r['ms']:.1f}", times])
            before = r["ms"]
    head = ["scene", "nodes a body", "contacts", "distances asked", "ms a step", "times the one above"]
    return "### Nodes\n\n" + _table(head, rows) if rows else ""


def _apart(results: Results) -> str:
    rows, before = [], None
    for count, r in series(results, "apart"):
        rows.append([str(count), f"{r['ms']:.1f}", "" if before is None else f"{r['ms'] / before:.2f}"])
        before = r["ms"]
    return "### Far apart\n\n" + _table(["bodies", "ms a step", "times the one above"], rows) if rows else ""


def _networks(results: Results) -> str:
    both = {kind: dict(series(results, f"network_{kind}")) for kind in NETWORKS}
    rows = []
    for count, mine in both["ours"].items():
        other = both["paper"].get(count)
        if other:
            ratio = f"{other['ms'] / mine['ms']:.1f}"
            memory = [f"{mine['peak_mib']:.0f}", f"{other['peak_mib']:.0f}"]
            rows.append([str(count), f"{mine['ms']:.1f}", f"{other['ms']:.0f}", ratio, *memory])
    head = ["spheres of 64 nodes", "impulse, ms", "paper always on, ms", "times", "impulse, MiB", "paper, MiB"]
    return "### Paper network\n\n" + _table(head, rows) if rows else ""


def _engines(results: Results) -> str:
    rows = []
    for scene, what, ours in (("bowl", "spheres", "growth_64"), ("knots", "knots", "")):
        mine = dict(series(results, ours)) if ours else {}
        for engine, name in ENGINES.items():
            for count, r in series(results, f"engine_{scene}_{engine}"):
                depths = [f"{1e3 * r[k]:.1f} mm" for k in ("overlap_95", "penetration_95")]
                fate = [str(r["below"]), "" if r["finite"] else "not finite"]
                values = [f"{r['ms']:.2f}", f"{r['peak_mib']:.0f}", f"{r['contacts']:.0f}", *depths, *fate]
                ratio = f"{mine[count]['ms'] / r['ms']:.1f}" if count in mine else ""
                rows.append([f"{count} {what}", name, *values[:1], ratio, *values[1:]])
    head = ["scene", "engine", "ms a step", "ours takes", "MiB", "contacts"]
    head += ["overlap 95 %", "deepest 95 %", "below the floor", ""]
    return "### Engines\n\n" + _table(head, rows) if rows else ""


def _selection(results: Results) -> str:
    rows = []
    for key, r in results.items():
        if key.startswith("selection_"):
            _, name, nodes = key.split("_")
            values = [str(r["edges"]), str(r["kept"]), f"{r['change']:.4f}", f"{r['error']:.4f}"]
            rows.append([f"64 bodies, {name}", nodes, *values, f"{100 * r['error'] / max(r['change'], 1e-12):.0f} %"])
    head = ["scene", "nodes a body", "edges", "kept", "contact changes velocities by, m/s", "difference, m/s", ""]
    return "### Edge selection\n\n" + _table(head, rows) if rows else ""


def _accuracy(results: Results) -> str:
    rows = []
    for kind in ("small", "paper"):
        for count, r in series(results, f"accuracy_{kind}"):
            values = []
            for step in (25, 50, 100):
                there = len(r["error"]) >= step
                values.append(f"{r['error'][step - 1]:.3f} / {r['floor'][step - 1]:.3f}" if there else "broke")
            depths = [f"{100 * np.percentile(r[k], 95) / r['diameter']:.1f} %" for k in ("depth", "teacher_depth")]
            rows.append([kind, str(count), *values, *depths])
    head = ["network", "spheres", "m at step 25", "step 50", "step 100", "penetration 95 %", "the teacher's"]
    return "### Accuracy\n\n" + _table(head, rows) if rows else ""


def draw(results: Results, path: Path) -> None:
    """Time and memory of a step against bodies, and time against contacts, log-log."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4))
    lines = [(f"growth_{n}", f"ours, {n} nodes each", "o-") for n in (64, 512)]
    lines += [("network_paper", "paper network, always on", "s--")]
    lines += [(f"engine_bowl_{engine}", name, ":") for engine, name in ENGINES.items()]
    for key, name, style in lines:
        found = series(results, key)
        for axis, x, y in zip(axes, ("bodies", "contacts", "bodies"), ("ms", "ms", "peak_mib"), strict=True):
            points = [(r[x], r[y]) for _, r in found if r.get(x, 0) > 0 and r.get(y, 0) > 0]
            if points:
                axis.loglog(*zip(*points, strict=True), style, label=name, markersize=4)
    labels = (("spheres", "CPU ms a step"), ("contact edges", "CPU ms a step"), ("spheres", "peak memory, MiB"))
    for axis, (x, y) in zip(axes, labels, strict=True):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(True, which="both", alpha=0.2)
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
