"""report.html: everything that a person needs to trust a reconstruction or to take better photos, in one file."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from pipeline import report_plots as plots
from sdfsim.console import duration
from sdfsim.files import write_text

NAME = "report.html"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: .25em .8em .25em 0; text-align: left; vertical-align: top; }
figure { display: inline-block; margin: 0 1em 1em 0; vertical-align: top; }
figcaption { color: #666; font-size: .85em; }
svg { background: #fafafa; } .camera { fill: none; stroke: #1565c0; stroke-width: .8; } .held { stroke: #e65100; }
.photos figure { width: 150px; } .photos img { width: 100%; } .bad { color: #b00020; } .good { color: #1b5e20; }
"""


def write_page(folder: Path, report: dict) -> None:
    """Writes report.html beside report.json, from the report and what the stages have left; needs no other file.

    Args:
        folder: of the run.
        report: as in report.json.
    """
    parts = [
        _verdict(report), _improve(report), _numbers(report), _held_out(folder, report), _surface(folder, report),
        _shapes(report), _cameras(folder, report), _photos(folder, report), _times(report), _options(report),
    ]  # fmt: skip
    title = f"Reconstruction of {Path(report['options']['photos']).name}"
    write_text(
        folder / NAME,
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>{''.join(parts)}</body></html>\n",
    )


def _section(title: str, body: str) -> str:
    return f"<h2>{escape(title)}</h2>{body}" if body else ""


def _list(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _table(rows: list[tuple[Any, ...]], head: tuple[str, ...] = ()) -> str:
    top = "<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>" if head else ""
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>{top}{body}</table>" if rows else ""


def _picture(uri: str, caption: str, width: int | None = None) -> str:
    wide = f' width="{width}"' if width else ""
    image = f'<img src="{uri}" alt="{escape(caption)}"{wide}>' if uri else ""
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _verdict(report: dict) -> str:
    error = report.get("error")
    if error:
        return (
            f'<p class="bad"><b>It stopped in the {escape(error["stage"])} stage:</b> {escape(error["message"])}</p>'
            f"<p>{escape(error['hint'])}</p>"
        )
    failed = report["failed_checks"]
    if failed:
        return f'<p class="bad"><b>It ran, but missed a check:</b> {escape("; ".join(failed))}</p>'
    done = list(report["stages"])
    return f'<p class="good"><b>Done: {escape(", ".join(done))}.</b></p>'


def _improve(report: dict) -> str:
    return _section("What to know", _list(report["notes"])) + _section("What to improve", _list(report["improve"]))


def _numbers(report: dict) -> str:
    stages, rows = report["stages"], []
    poses = report["poses"]
    if poses:
        rows += [
            ("photos with a pose", f"{poses['posed']} of {poses['photos']}"),
            ("mean reprojection error", f"{poses['mean_error']:.2f} px, {poses['points']} points"),
            ("field of view of the longer side", ", ".join(f"{fov:.1f}°" for fov in poses["field_of_view"])),
            (
                "viewing directions",
                f"up to {poses['spread_angle']:.0f}° apart, {poses.get('span_degrees', 0):.0f}° around",
            ),
            ("pairs of photos against the poses", f"{poses.get('contradictions', 0):.1%}"),
        ]
        rows += [(f"attempt: {t['name']}", "; ".join(t["failures"]) or f"good, {t['posed']} posed")
                 for t in poses.get("attempts", [])]  # fmt: skip
    if report.get("psnr") is not None:
        rows.append(("photos that were not trained on", f"PSNR {report['psnr']:.1f} dB"))
    mesh = stages.get("mesh", {})
    if mesh:
        rows += [
            ("extent", " x ".join(f"{side:.3g}" for side in mesh["extent_m"]) + " m"),
            ("scale", mesh["size"]),
            ("up", f"from the {mesh['up_from']}, within {mesh.get('up_within_degrees', 0):.1f}°"),
        ]
    return _section("Numbers", _table(rows))


def _held_out(folder: Path, report: dict) -> str:
    pictures = []
    by_name = {photo["photo"]: photo for photo in report["photos"]}
    for name, psnr in zip(
        report["stages"].get("distill", {}).get("held_out_photos", []),
        report["stages"].get("distill", {}).get("psnr_each", []), strict=False,
    ):  # fmt: skip
        file = by_name.get(name, {}).get("file", "")
        render = folder / "distill" / "held_out" / file
        if file and render.exists():
            pictures.append(
                _picture(plots.image_uri(folder / "photos" / "images" / file, 360), f"{name}: the photo", 360)
                + _picture(plots.image_uri(render, 360), f"rendered from the field, {psnr:.1f} dB", 360)
            )
    return _section("Photos that were not trained on", "<br>".join(pictures))


def _surface(folder: Path, report: dict) -> str:
    if "mesh" not in report["stages"]:
        return ""
    from sdfsim.shape.mesh import load_mesh

    body = _picture(plots.turntable_uri(load_mesh(folder / "mesh" / "mesh.ply")), "the surface that the photos show")
    names = folder / "mesh" / "objects.png"
    if names.exists():
        body += "<br>" + _picture(plots.image_uri(names, 1400), "what was found, by name", 900)
    return _section("Surface", body)


def _shapes(report: dict) -> str:
    """One row a fitted shape, with the numbers of its certificate as they are."""
    shapes = report["stages"].get("fit", {}).get("shapes", {})
    rows = [(name, _exactness(one), *(f"{one[key]:.2g}" for key in CERTIFICATE)) for name, one in shapes.items()]
    head = ("shape", "certificate", *(key.replace("_", " ") for key in CERTIFICATE))
    return _section("Signed distances", _table(rows, head))


def _exactness(certificate: dict) -> str:
    if not certificate["passed"]:
        return f"not usable: {certificate['reason']}"
    return f"usable, {certificate['caveat']}" if certificate["caveat"] else "exact"


CERTIFICATE = ("error_within_0.01", "error_within_0.1", "error_in_box", "sign_errors")


def _cameras(folder: Path, report: dict) -> str:
    if "poses" not in report["stages"]:
        return ""
    from pipeline.recording import in_place

    views, points, colors = in_place(folder, set(report["stages"]))
    held = {photo["photo"] for photo in report["photos"] if photo["verdict"] == "held out"}
    sides = [plots.camera_plot(views, points, colors, held, top=top) for top in (True, False)]
    more = "<p>Orange: not trained on. Names appear under the pointer.</p>" if held else ""
    return _section("Cameras", "".join(sides) + more)


def _photos(folder: Path, report: dict) -> str:
    body = []
    root = folder / ("photos" if "photos" in report["stages"] else ".photos.part")
    for photo in report["photos"]:
        caption = f"{photo['photo']}: {photo['verdict']}"
        caption += "".join(f"; {photo[key]}" for key in ("why", "fault") if photo[key])
        body.append(_picture(plots.image_uri(root / "images" / photo["file"], 150), caption))
    return _section("Photos", f'<div class="photos">{"".join(body)}</div>' if body else "")


def _times(report: dict) -> str:
    rows = [(stage, duration(seconds)) for stage, seconds in report["seconds"].items()]
    return _section("Time", _table([*rows, ("together", duration(report["seconds_total"]))]))


def _options(report: dict) -> str:
    rows = [(key, value) for key, value in report["options"].items() if value not in (None, [], "")]
    return _section("Options", _table(rows))
