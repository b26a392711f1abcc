"""Pictures of a report: photos as thumbnails, cameras with the sparse cloud from two sides, the surface turning."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.cameras import View
from sdfsim.shape.mesh import Mesh

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
    from pipeline.visibility import Caster
    from sdfsim.recording import with_normals

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
