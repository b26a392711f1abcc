"""report.html: everything that a person needs to trust a reconstruction or to take better photos, in one file."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline import report_plots as plots
from pipeline.cameras import View
from sdfsim.files import write_text
from sdfsim.progress import duration
from sdfsim.shape.mesh import Mesh

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
    from pipeline.report import in_place

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


POINTS = 2500  # at most, in a plot
PLOT = 420  # px a side
TURNS, TURN_SIZE = 24, (360, 270)


def image_uri(source: Path | Image.Image, longest: int, kind: str = "JPEG") -> str:
    """A picture as a data URI, no larger than `longest` px; empty where the file cannot be read."""
    try:
        image = Image.open(source) if isinstance(source, Path) else source
        image = image.convert("RGB")
    except OSError:
        return ""
    image.thumbnail((longest, longest))
    data = io.BytesIO()
    image.save(data, kind, quality=80)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(data.getvalue()).decode()}"


def camera_plot(views: list[View], points: np.ndarray, colors: np.ndarray, held_out: set[str], *, top: bool) -> str:
    """An SVG of the cameras and the sparse points, from above or from the front.

    Args:
        views: z up.
        points: [P, 3].
        colors: [P, 3] uint8.
        held_out: names (sources) of photos that were not trained on.
        top: from above; otherwise from the front.
    """
    axes = (0, 1) if top else (0, 2)
    centers = np.array([view.center for view in views])
    middle = np.median(points, axis=0) if len(points) else centers.mean(0)
    reach = 1.15 * max(float(np.abs(centers - middle).max()), 1e-9)
    near = np.flatnonzero((np.abs(points - middle) < reach).all(1))
    if len(near) > POINTS:
        near = np.random.default_rng(0).choice(near, POINTS, replace=False)

    def place(xyz: np.ndarray) -> np.ndarray:
        flat = (xyz - middle)[..., axes] / reach * [1, -1]
        return (flat + 1) * PLOT / 2

    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.1" fill="#{r:02x}{g:02x}{b:02x}"/>'
        for (x, y), (r, g, b) in zip(place(points[near]), colors[near], strict=True)
    )
    length = 0.09 * reach
    marks = []
    for view in views:
        half = 0.5 * length * np.array([view.width, view.height]) / view.focal
        corners = np.array([[sx * half[0], sy * half[1], length] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        start, ends = place(view.center), place(view.center + corners @ view.rotation)
        path = " ".join(f"M{start[0]:.1f},{start[1]:.1f}L{x:.1f},{y:.1f}" for x, y in ends)
        loop = "M" + "L".join(f"{x:.1f},{y:.1f}" for x, y in ends) + "Z"
        kind = "camera held" if view.source in held_out else "camera"
        marks.append(f'<path class="{kind}" d="{path}{loop}"><title>{escape(view.source)}</title></path>')
    side = "from above" if top else "from the front"
    return (
        f'<figure><svg viewBox="0 0 {PLOT} {PLOT}" width="{PLOT}" role="img" aria-label="cameras {side}">'
        f"{dots}{''.join(marks)}</svg><figcaption>cameras and sparse points {side}</figcaption></figure>"
    )


def turntable_uri(mesh: Mesh) -> str:
    """A mesh (z up) turning once, as the data URI of an animated WebP."""
    from pipeline.mesh.visibility import Caster
    from sdfsim.shading import with_normals

    shaded, normals = with_normals(mesh)
    caster = Caster(shaded)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    middle, reach = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    colors = np.full((len(shaded.vertices), 3), 190.0) if shaded.colors is None else shaded.colors.astype(float)
    frames = [_frame(caster, shaded, normals, colors, middle, reach, 2 * np.pi * k / TURNS) for k in range(TURNS)]
    data = io.BytesIO()
    frames[0].save(data, "WEBP", save_all=True, append_images=frames[1:], duration=120, loop=0, quality=60)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}"


def _frame(caster, mesh: Mesh, normals: np.ndarray, colors: np.ndarray, middle: np.ndarray, reach: float,
           angle: float) -> Image.Image:  # fmt: skip
    """The mesh as a camera sees it from 25 degrees above, lit from over its shoulder."""
    width, height = TURN_SIZE
    back = np.array([np.cos(0.44) * np.sin(angle), -np.cos(0.44) * np.cos(angle), np.sin(0.44)])
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    row, column = np.indices((height, width)).reshape(2, -1) + 0.5
    x, y = (column - width / 2) / height, (height / 2 - row) / height
    direction = 0.8 * (x[:, None] * right + y[:, None] * up) - back
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    away, face = caster.hits(middle + 2.2 * reach * back, direction)
    hit = np.isfinite(away)
    corners = mesh.faces[face[hit]]
    normal, color = normals[corners].mean(1), colors[corners].mean(1)
    light = (back + 0.5 * up + 0.3 * right) / np.linalg.norm(back + 0.5 * up + 0.3 * right)
    shade = 0.45 + 0.55 * np.abs(normal @ light)
    picture = np.full((height * width, 3), 255.0)
    picture[hit] = np.clip(color * shade[:, None], 0, 255)
    return Image.fromarray(picture.reshape(height, width, 3).astype(np.uint8))
