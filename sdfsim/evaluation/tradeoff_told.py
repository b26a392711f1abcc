"""A sweep in words: the table for people, the file for programs, and what the claims come to."""

from __future__ import annotations

import csv
import io
from typing import Any

from sdfsim.evaluation.tradeoff_measure import Point

Rows = list[tuple[str, ...]]
BUSY = 1.2  # clock over processor time, above which a machine does something else as well


def table(points: list[Point]) -> str:
    """All points as CSV."""
    horizons = max((list(p.get("errors", {})) for p in points), key=len)
    head = ["key", "label", "kind", "failed", "ms_per_simulated_s", "p95", "spread", "clock_over_processor"]
    head += ["first_step_ms", "prepare_s", "fitted_s", "peak_mib", "penetration_p95_m"]
    for h in horizons:
        head += [f"translation_rmse_m_{h}", f"rotation_error_deg_{h}", f"energy_gain_mean_{h}"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for p in points:
        ms = p["ms"] or {}
        row = [
            p["key"],
            p["label"],
            p["kind"],
            p["failed"],
            ms.get("median"),
            ms.get("p95"),
            ms.get("spread"),
            p["busy"],
        ]
        row += [p.get(name) for name in ("first_step_ms", "prepare_s", "fitted_s", "peak_mib", "penetration_p95")]
        for h in horizons:
            error, gain = p.get("errors", {}).get(h, {}), (p.get("energy_gain") or {}).get(h) or {}
            row += [error.get("translation_rmse"), error.get("rotation_error"), gain.get("mean")]
        writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in row])
    return text.getvalue()


def told(report: dict[str, Any]) -> tuple[Rows, list[str]]:
    """The report of `tradeoff` for people: a row a point, by time, and the claims."""
    steps, best = str(report["horizon_steps"]), set(report["front"])
    rows: Rows = [("", "ms / s", "p95", "m", "degrees", "penetration m", "MiB")]
    for p in sorted(report["points"], key=lambda p: p["ms"]["median"] if p["ms"] else float("inf")):
        if p["failed"] or not p["ms"]:
            rows.append((f"{p['label']}: {p['failed'] or 'not timed'}", *[""] * 6))
            continue
        error = p["errors"][steps]
        numbers = (p["ms"]["median"], p["ms"]["p95"], error["translation_rmse"], error["rotation_error"])
        cells = [f"{v:.3g}" for v in numbers]
        cells += ["-" if p[name] is None else f"{p[name]:.2g}" for name in ("penetration_p95", "peak_mib")]
        rows.append((f"{p['label']} *" if p["key"] in best else p["label"], *cells))
    return rows, _notes(report)


def _notes(report: dict[str, Any]) -> list[str]:
    claimed = report["claims"]
    busy = max((p["busy"] for p in report["points"] if p["busy"]), default=1.0)
    found = [
        f"milliseconds per simulated second, errors over {report['horizon_steps']} steps; * is on the front of ours",
        "the default is beaten in both by (* by more than the choice of trajectories explains): " + beaten_by(claimed),
        f"the most accurate of the front takes {claimed['slowest_over_fastest_of_front']:.1f} times the fastest's time",
    ]
    if "resampled" in claimed:
        r = claimed["resampled"]
        found.append(
            f"7^3 against the meshes' vertices: {r['fewer_nodes']:.0%} fewer nodes, "
            f"{r['error_over_vertices']:.2f} times the error, {r['time_over_vertices']:.2f} times the time"
        )
    if busy > BUSY:
        found.append(f"the machine was busy: the clock showed up to {busy:.1f} times the processor's time")
    return [*found, f"wrote {report['folder']}"]


def beaten_by(told: dict[str, Any]) -> str:
    """What beats the default in both time and error; a star where that is more than chance."""
    clear = set(told["default_clearly_beaten_by"])
    return ", ".join(f"{key}{' *' if key in clear else ''}" for key in told["default_beaten_by"]) or "none of ours"
