"""One self-contained page of a study: the diagram with what each point is under the pointer, and all numbers."""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

from sdfsim.evaluation.tradeoff_picture import STYLES, error, least_shown, ordered
from sdfsim.files import write_text

WIDTH, HEIGHT, MARGIN = 900, 520, 60  # px
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1000px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 13px } td, th { padding: 2px 9px; text-align: right }
td:first-child, th:first-child { text-align: left } tr:nth-child(even) { background: #f4f4f4 }
.front { font-weight: 700 }
.failed { color: #b00020 } svg text { font-size: 11px } circle:hover, rect:hover { stroke: #000; stroke-width: 2 }
"""
_COLUMNS = ("ms / s", "p95", "m", "degrees", "m at the end", "energy gain", "penetration m", "first step ms", "MiB")


def write_report(report: dict[str, Any], beaten: str, path: Path) -> None:
    """Write the page.

    Args:
        report: what `tradeoff` returns.
        beaten: what beats the default, in words.
        path: of the HTML file.
    """
    steps = str(report["horizon_steps"])
    told = report["claims"]
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Accuracy against time</title>",
        f"<style>{STYLE}</style><h1>Accuracy against time</h1>",
        f"<p>{html.escape(report['source'])}: {report['trajectories']} scenes, {report['bodies']} bodies, errors over",
        f"{steps} steps of {report['dt_s']:g} s against the teacher. Point at a mark to see its setting.</p>",
        _diagram(report, steps),
        f"<p>The default, {html.escape(told['default'])}, is beaten in both by",
        f"(* by more than the choice of scenes explains): {html.escape(beaten)}. The most",
        f"accurate of the front takes {told['slowest_over_fastest_of_front']:.1f} times as long as the fastest.</p>",
        "<h2>All points</h2>",
        _table(report, steps),
        f"<p>sdfsim {html.escape(report['sdfsim'])}. Bold: on the front of ours. One-thread times are the processor's,"
        " as the clock shows them on a free core.</p></html>",
    ]
    write_text(path, "\n".join(parts))


def _diagram(report: dict[str, Any], steps: str) -> str:
    """The points as inline SVG, logarithmic both ways."""
    shown = [(n, p) for n, p in ordered(report["points"]) if not p["failed"] and p["ms"]]
    xs = [math.log10(p["ms"]["median"]) for _, p in shown]
    lowest = least_shown(report["points"], steps)
    ys = [math.log10(max(error(p, steps), lowest)) for _, p in shown]
    floors = [p for p in report["points"] if p["kind"] == "floor" and not p["failed"]]
    left, right, low, high = min(xs) - 0.1, max(xs) + 0.1, min(ys) - 0.1, max(ys) + 0.1

    def at(x: float, y: float) -> tuple[float, float]:
        return (
            MARGIN + (x - left) / (right - left) * (WIDTH - 2 * MARGIN),
            HEIGHT - MARGIN - (y - low) / (high - low) * (HEIGHT - 2 * MARGIN),
        )

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role=img aria-label="error against time">']
    for power in range(math.floor(left), math.ceil(right) + 1):
        for digit in (1, 2, 5):
            x = power + math.log10(digit)
            if left <= x <= right:
                px = at(x, low)[0]
                parts.append(f'<line x1={px:.1f} x2={px:.1f} y1={MARGIN} y2={HEIGHT - MARGIN} stroke="#ddd"/>')
                parts.append(
                    f"<text x={px:.1f} y={HEIGHT - MARGIN + 16} text-anchor=middle>{digit * 10**power:g}</text>"
                )
    for power in range(math.floor(low), math.ceil(high) + 1):
        for digit in (1, 2, 5):
            y = power + math.log10(digit)
            if low <= y <= high:
                py = at(left, y)[1]
                parts.append(f'<line y1={py:.1f} y2={py:.1f} x1={MARGIN} x2={WIDTH - MARGIN} stroke="#ddd"/>')
                parts.append(f"<text x={MARGIN - 6} y={py + 4:.1f} text-anchor=end>{digit * 10**power:g}</text>")
    for floor in floors:
        py = at(left, math.log10(error(floor, steps)))[1]
        parts.append(
            f'<line y1={py:.1f} y2={py:.1f} x1={MARGIN} x2={WIDTH - MARGIN} stroke="#c2571a" stroke-dasharray=5>'
        )
        parts.append(f"<title>chaos floor: {html.escape(floor['label'])}</title></line>")
    by_key = {p["key"]: p for _, p in shown}
    line = [at(math.log10(p["ms"]["median"]), math.log10(error(p, steps))) for k in report["front"] if (p := by_key[k])]
    parts.append(
        f'<polyline fill=none stroke="#1f6fb4" opacity=0.5 points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in line)}"/>'
    )
    for number, p in shown:
        x, y = at(math.log10(p["ms"]["median"]), math.log10(max(error(p, steps), lowest)))
        told = f"{p['label']}: {p['ms']['median']:.3g} ms/s, {error(p, steps):.3g} m"
        mark = (
            f"<circle cx={x:.1f} cy={y:.1f} r=6"
            if p["kind"] == "ours"
            else f"<rect x={x - 5:.1f} y={y - 5:.1f} width=10 height=10"
        )
        colour = STYLES[p["kind"]]["color"]
        parts.append(f'{mark} fill="{colour}"><title>{html.escape(told)}</title></{mark[1:].split()[0]}>')
        parts.append(f"<text x={x + 7:.1f} y={y - 5:.1f}>{number}</text>")
    parts.append(f"<text x={WIDTH / 2} y={HEIGHT - 14} text-anchor=middle>milliseconds per simulated second</text>")
    parts.append(
        f'<text transform="translate(14 {HEIGHT / 2}) rotate(-90)" text-anchor=middle>translation RMSE, m</text>'
    )
    return "\n".join([*parts, "</svg>"])


def _table(report: dict[str, Any], steps: str) -> str:
    rows = ["<table><tr><th>" + "".join(f"<th>{name}" for name in _COLUMNS)]
    best = set(report["front"])
    for number, p in ordered(report["points"]):
        name = f"{number} {html.escape(p['label'])}"
        if p["failed"] or not p["ms"]:
            rows.append(
                f"<tr class=failed><td>{name}<td colspan={len(_COLUMNS)}>{html.escape(p['failed'] or 'not timed')}"
            )
            continue
        end = max(p["errors"], key=int)
        gain = p["energy_gain"][end]
        values = [
            p["ms"]["median"],
            p["ms"]["p95"],
            error(p, steps),
            p["errors"][steps]["rotation_error"],
            error(p, end),
        ]
        values += [gain["mean"] if gain else None, p["penetration_p95"], p["first_step_ms"], p["peak_mib"]]
        cells = "".join(f"<td>{'-' if v is None else f'{v:.3g}'}" for v in values)
        rows.append(f"<tr{' class=front' if p['key'] in best else ''}><td>{name}{cells}")
    return "\n".join([*rows, "</table>"])
