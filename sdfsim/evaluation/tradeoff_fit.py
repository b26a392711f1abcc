"""What a fit costs: budgets in seconds against the certificate's errors."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, replacing, write_json, write_text
from sdfsim.shape.fit import FIT_VERSION, fit_mesh, training_share
from sdfsim.shape.fit_metrics import EXACT
from sdfsim.shape.mesh import Mesh, load_mesh

BUDGETS = (5.0, 10.0, 20.0, 40.0, 60.0, 120.0)  # s
QUICK_BUDGETS, QUICK_MESHES = (5.0, 10.0, 20.0), 2
ERRORS = tuple(name for name, _ in EXACT)


def fit_tradeoff(
    meshes: dict[str, Path], out: Path, *, quick: bool, on_progress: Callable[[str, float, str], None]
) -> dict[str, Any]:
    """Fit meshes with growing budgets; write fit.png, fit.csv and fit.json.

    Args:
        meshes: files by name.
        out: folder to write; fits that it holds already are not made again.
        quick: the first two meshes and three budgets only.
        on_progress: called with (stage, fraction, message).

    Returns:
        The content of fit.json: a point a fit, with the seconds that it took and the errors of its certificate.

    Raises:
        SdfsimError: a mesh that cannot be read, or nothing could be fitted.
    """
    budgets = QUICK_BUDGETS if quick else BUDGETS
    chosen = {name: load_mesh(file) for name, file in list(meshes.items())[: QUICK_MESHES if quick else None]}
    points: list[dict[str, Any]] = []
    for k, (name, mesh) in enumerate(chosen.items()):
        before = None
        for j, budget in enumerate(budgets):
            done = (k + j / len(budgets)) / len(chosen)
            on_progress("fit", done, f"{name}, {budget:g} s")
            before = _again(before, budget) or _fitted(name, mesh, budget, out / "points" / "fit")
            points.append(before)
    on_progress("fit", 1.0, "measured")
    if all(p["failed"] for p in points):
        raise SdfsimError(f"nothing could be fitted: {points[0]['failed']}")
    report = {"quick": quick, "points": points, "limits": dict(EXACT), "folder": str(out)}
    write_json(out / "fit.json", report)
    write_text(out / "fit.csv", table(points))
    draw(points, out / "fit.png")
    return report


def _again(before: dict[str, Any] | None, budget: float) -> dict[str, Any] | None:
    """The outcome of a larger budget where the fit before ended by itself, sooner than its training had to."""
    if before is None or before["failed"] or before["wall_s"] >= training_share(before["budget_s"]):
        return None
    return before | {"budget_s": budget, "ended_by_itself": True}


def _fitted(name: str, mesh: Mesh, budget: float, folder: Path) -> dict[str, Any]:
    path = folder / f"{name}__{budget:g}.json"
    mark = {"fit_version": FIT_VERSION, "mesh": mesh.digest(), "budget": budget}
    if path.exists() and (point := read_json(path)).get("fingerprint") == mark:
        return point
    point: dict[str, Any] = {"name": name, "budget_s": budget, "fingerprint": mark, "failed": ""}
    point["ended_by_itself"] = False
    wall, cpu = time.monotonic(), time.process_time()
    try:
        certificate = fit_mesh(mesh, name=name, budget=budget).certificate
        point |= {key: certificate[key] for key in (*ERRORS, "steps")}
        point["reason"] = certificate["reason"] or certificate["caveat"]
        point["passed"] = not point["reason"]
    except SdfsimError as error:
        point["failed"] = error.message
    point |= {"wall_s": time.monotonic() - wall, "cpu_s": time.process_time() - cpu}
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, point)
    return point


def table(points: list[dict[str, Any]]) -> str:
    """All points as CSV."""
    head = ["name", "budget_s", "wall_s", "cpu_s", "steps", "passed", "ended_by_itself", "failed", *ERRORS]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for p in points:
        cells = [p.get(name) for name in head]
        writer.writerow(["" if v is None else f"{v:.5g}" if isinstance(v, float) else v for v in cells])
    return text.getvalue()


def draw(points: list[dict[str, Any]], path: Path) -> None:
    """Errors against the processor's seconds; filled marks have met every limit of the certificate."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 5), layout="constrained")
    good = [p for p in points if not p["failed"] and not p["ended_by_itself"]]
    for plot, (key, limit) in zip(axes, (EXACT[0], EXACT[2]), strict=True):
        for name in dict.fromkeys(p["name"] for p in good):
            mine = [p for p in good if p["name"] == name and p[key]]
            (line,) = plot.loglog([p["cpu_s"] for p in mine], [p[key] for p in mine], "-", lw=1, label=name)
            for p in mine:
                fill = line.get_color() if p["passed"] else "white"
                plot.plot(p["cpu_s"], p[key], "o", ms=6, mec=line.get_color(), mfc=fill)
                plot.annotate(f"{p['budget_s']:g} s", (p["cpu_s"], p[key]), xytext=(4, 4), fontsize=7,
                              textcoords="offset points")  # fmt: skip
        plot.axhline(limit, color="#b00020", ls="--", lw=1)
        plot.set(xlabel="processor seconds", ylabel=f"{key.replace('_', ' ')}, of the largest extent")
        plot.grid(True, which="both", lw=0.3)
        plot.legend(fontsize=8)
    figure.suptitle("filled: every limit met; dashed: the limit; each mark names its budget", fontsize=9)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    pyplot.close(figure)


def told(report: dict[str, Any]) -> tuple[list[tuple[str, ...]], list[str]]:
    """The report for people: a row a fit, and where it is."""
    rows: list[tuple[str, ...]] = [("", "budget s", "took s", "steps", "within 0.01", "in box", "certificate")]
    for p in report["points"]:
        if p["failed"]:
            rows.append((p["name"], f"{p['budget_s']:g}", p["failed"], *[""] * 4))
            continue
        verdict = "met" if p["passed"] else f"missed: {p['reason']}"
        took = "ended by itself" if p["ended_by_itself"] else f"{p['cpu_s']:.0f}"
        errors = (f"{p[key]:.2g}" for key in ("error_within_0.01", "error_in_box"))
        rows.append((p["name"], f"{p['budget_s']:g}", took, str(p["steps"]), *errors, verdict))
    return rows, [f"wrote {report['folder']}"]
