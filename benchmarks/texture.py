"""Vertex colours beside textures, on the surface of a reconstruction, against photos that neither was made from.

    python benchmarks/texture.py RUN -o DIR [--view PHOTO]

RUN is a folder of `sdfsim reconstruct` from at least 16 photos. Colours and textures are made once more without the
photos that were held out from training. Prints PSNR and detail where there is a surface, and writes `texture.jpg`: one
of these photos, the surface in vertex colours, and with its texture.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pipeline.cameras import View, load_views
from pipeline.field.rays import held_out
from pipeline.field.training import load_field
from pipeline.inputs.photos import load_photos
from pipeline.mesh.cleaning import joined
from pipeline.mesh.meshing import SCENERY, read_parts
from pipeline.mesh.placement import load_placement
from pipeline.mesh.texture import Shots, shots_of, texture_parts
from pipeline.mesh.visibility import Caster, Visibility, bilinear, look, to_bytes
from pipeline.stages import read_record
from sdfsim.errors import SdfsimError, run_main
from sdfsim.shape.mesh import Mesh, load_mesh, write_glb

WIDE = 1320  # px, of the picture


def parts_of(mesh_folder: Path) -> tuple[dict[str, Mesh], list[Mesh]]:
    """What is displayed of each part, in metres where it stands; and all that can be in the way of a view."""
    parts = read_parts(mesh_folder)
    bodies = {e["name"]: load_mesh(mesh_folder / "objects" / f"{e['name']}.ply") for e in parts["objects"]}
    if not parts["scenery"]:
        return bodies, list(bodies.values())
    scenery = {SCENERY: load_mesh(mesh_folder / "shown.ply")}
    return scenery | bodies, [load_mesh(mesh_folder / "solid.ply"), *bodies.values()]


class Surface:
    """Something to look at: meshes, and a colour wherever a ray hits them.

    Args:
        meshes: all with vertex colours, or all with textures.
    """

    def __init__(self, meshes: list[Mesh]) -> None:
        self.meshes, self.whole = meshes, joined(meshes)
        self.caster = Caster(self.whole)
        self.first = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])

    def seen(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Colours [H, W, 3] in 0..255, and where there is a surface [H, W]."""
        row, column = (axis.ravel() for axis in np.indices((view.height, view.width)))
        rays = view.rays(column + 0.5, row + 0.5)
        away, face = self.caster.hits(view.center, rays)
        hit, color = np.isfinite(away), np.full((len(away), 3), 255.0)
        points = view.center + np.where(hit, away, 0)[:, None] * rays
        for mesh, first, last in zip(self.meshes, self.first, self.first[1:], strict=False):
            own = np.flatnonzero(hit & (face >= first) & (face < last))
            corners = mesh.faces[face[own] - first]
            color[own] = _color(mesh, corners, _weights(mesh.vertices[corners], points[own]))
        return color.reshape(view.height, view.width, 3), hit.reshape(view.height, view.width)


def _weights(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric weights [P, 3] of points [P, 3] in triangles [P, 3, 3]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    parts = [
        (np.cross(corners[:, k - 1] - corners[:, k - 2], points - corners[:, k - 2]) * normal).sum(1) for k in range(3)
    ]
    weights = np.stack(parts, 1)
    return np.clip(weights / np.maximum(weights.sum(1, keepdims=True), 1e-30), 0, 1)


def _color(mesh: Mesh, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Colours [P, 3] of points given by the vertices [P, 3] around them and their weights [P, 3]."""
    if mesh.texture is None or mesh.uv is None:
        assert mesh.colors is not None
        return (mesh.colors[corners] * weights[..., None]).sum(1)
    at = (mesh.uv[corners] * weights[..., None]).sum(1) * mesh.texture.shape[1::-1]
    return bilinear(mesh.texture, at - 0.5)


def compare(surface: Surface, views: list[View], shots: Shots) -> tuple[float, float]:
    """PSNR, dB, over all pixels of photos that show the surface, and how much of the photos' detail is there.

    The latter is the mean step between neighbouring pixels as a share of the one in the photo.
    """
    error, steps = [], np.zeros(2)
    for view in views:
        color, hit = surface.seen(view)
        photo = shots.photo(view).astype(float)
        error.append((color - photo)[hit] ** 2)
        inner = hit[:, 1:] & hit[:, :-1]
        steps += [np.abs(np.diff(image, axis=1))[inner].sum() for image in (color, photo)]
    return float(10 * np.log10(255**2 / np.concatenate(error).mean())), float(steps[0] / steps[1])


def side_by_side(surfaces: list[Surface], view: View, shots: Shots) -> Image.Image:
    """A photo and how surfaces look from there, all cut to what there is of the surface."""
    seen = [surface.seen(view) for surface in surfaces]
    rows, columns = (np.flatnonzero(seen[0][1].any(axis)) for axis in (1, 0))
    images = [shots.photo(view), *(to_bytes(color) for color, _ in seen)]
    sheet = np.concatenate([image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] for image in images], 1)
    picture = Image.fromarray(sheet)
    picture.thumbnail((WIDE, WIDE))
    return picture


def main() -> None:
    """Bakes, measures, draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--view", metavar="PHOTO", help="held-out photo that is drawn; by default the first")
    chosen = parser.parse_args()
    run, out = chosen.run, chosen.out
    placed, to_unit = load_placement(run / "mesh").to_metres, load_field(run / "distill").to_unit
    views = [placed.view(to_unit.view(view)) for view in load_views(run / "poses")]
    test = [views[number] for number in held_out(len(views))]
    drawn = [view for view in test if chosen.view in (None, view.source)]
    record = read_record(run / "mesh")
    if record is None or not drawn:
        held = ", ".join(view.source for view in test) or "none: 16 photos are needed"
        raise SdfsimError(f"{run}: not finished, or {chosen.view} is no held-out photo", f"held out: {held}")
    train = [view for number, view in enumerate(views) if number not in held_out(len(views))]
    meshes, whole = parts_of(run / "mesh")
    cell = placed.scale * record["report"]["cell"]
    shots = shots_of(train, load_photos(run / "photos"), run / "photos", whole, cell)
    colored = {}
    for name, mesh in meshes.items():
        assert mesh.colors is not None
        found = look(Visibility(mesh, cell, shots.blocking), train, run / "photos")
        colored[name] = replace(mesh, colors=to_bytes(np.where(found.weight[:, None] > 0, found.color, mesh.colors)))
    start = time.perf_counter()
    textures = texture_parts(colored, shots)
    seconds = time.perf_counter() - start
    surfaces = {"vertex colours": Surface(list(colored.values())), "texture": Surface(list(textures.values()))}
    for name, surface in surfaces.items():
        psnr, detail = compare(surface, test, shots)
        faces = f"{len(surface.whole.faces)} faces"
        print(f"{name}: {psnr:.2f} dB, {100 * detail:.0f} % of the detail, {faces}, {len(test)} held-out photos")
    sizes = ", ".join(
        f"{name} {mesh.texture.shape[0]} px" for name, mesh in textures.items() if mesh.texture is not None
    )
    print(f"baked in {seconds:.1f} s from {len(train)} photos: {sizes}; {len(write_glb(textures)) / 1e6:.1f} MB as GLB")
    out.mkdir(parents=True, exist_ok=True)
    side_by_side(list(surfaces.values()), drawn[0], shots).save(out / "texture.jpg", quality=80)


if __name__ == "__main__":
    run_main(main)
