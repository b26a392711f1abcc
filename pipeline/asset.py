"""Meshes -> a Shape folder with a compact SDF, and a scene that drops a body onto it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.placement import Placement
from sdfsim.errors import SdfsimError
from sdfsim.shape.mesh import Mesh, load_mesh

Progress = Callable[[float, str], None]

# Side of the dropped box, as a share of the scene's width.
BODY_SHARE = 0.09
BODY_DENSITY = 400.0  # kg/m^3, wood


@dataclass(frozen=True)
class Drop:
    """Where a body is dropped.

    Attributes:
        side: of the box, m.
        position: [3] m, centre of the box at the start.
        support: height of the surface under it, m.
        slope: of the path a ball would roll there, degrees.
        depth: of the hollow that it lies in, m.
    """

    side: float
    position: tuple[float, float, float]
    support: float
    slope: float
    depth: float


def write_mesh(mesh: Mesh, path: Path) -> None:
    """Writes a binary PLY with vertex colours, atomically."""
    import trimesh

    colors = None if mesh.colors is None else np.c_[mesh.colors, np.full(len(mesh.colors), 255, np.uint8)]
    made: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    temporary = Path(path).with_suffix(".part")
    temporary.write_bytes(made.export(file_type="ply"))
    os.replace(temporary, path)


def fit_scenery(mesh_folder: Path, out: Path, *, budget: float | None, recipe: str = "default", seed: int = 0,
                on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Fits the compact SDF to the closed solid and writes a Shape folder that shows the visible surface.

    The solid is closed (capped where the trained space ends), so the sign of its distance is right everywhere, also
    above the open scenery where bodies come from.

    Args:
        mesh_folder: of the mesh stage.
        out: Shape folder to write.
        budget: s of fitting.
        recipe: of the fit.
        seed: of the fit.
        on_progress: called with (fraction, message).

    Returns:
        The fit's certificate.

    Raises:
        SdfsimError: the mesh stage has not run, or its mesh cannot be used.
    """
    from sdfsim.shape.fit import fit_mesh

    solid = load_mesh(Path(mesh_folder) / "solid.ply")
    shown = load_mesh(Path(mesh_folder) / "mesh.ply")
    shape = fit_mesh(
        solid, name="scene", recipe=recipe, budget=budget, seed=seed,  # type: ignore[arg-type]
        on_progress=on_progress, checkpoint=Path(out) / "fit.checkpoint",
    )  # fmt: skip
    shape = replace(shape, mesh=shown)
    shape.save(out)
    (Path(out) / "fit.checkpoint").unlink(missing_ok=True)
    return shape.certificate


def heights_from_above(mesh: Mesh, at: np.ndarray) -> np.ndarray:
    """Height [P] of the topmost surface over the points `at` [P, 2], m; NaN where there is none."""
    import open3d as o3d

    tensor: Any = o3d.core.Tensor
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    top = mesh.vertices[:, 2].max() + 1.0
    ray = np.zeros((len(at), 6), np.float32)
    ray[:, :2], ray[:, 2], ray[:, 5] = at, top, -1
    distance = scene.cast_rays(tensor(ray))["t_hit"].numpy()
    return np.where(np.isfinite(distance), top - distance, np.nan)


def resting_map(height: np.ndarray, step: float, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a ball comes to lie on a height map.

    Args:
        height: [X, Y] m, -inf where there is nothing.
        step: distance of neighbouring cells, m.
        radius: of the ball, m.

    Returns:
        Height of the ball's lowest point when it touches the surface from above [X, Y]; the slope of that, degrees;
        and how far the ball would have to be lifted to roll off the surface [X, Y] m (0 outside hollows).
    """
    from scipy.ndimage import uniform_filter
    from skimage.morphology import reconstruction

    reach = int(radius / step)
    lowest = np.full_like(height, -np.inf)
    padded = np.pad(height, reach, constant_values=-np.inf)
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            away = step * np.hypot(i, j)
            if away <= radius:
                part = padded[reach + i : reach + i + height.shape[0], reach + j : reach + j + height.shape[1]]
                lowest = np.maximum(lowest, part + np.sqrt(radius**2 - away**2) - radius)
    bottom = lowest[np.isfinite(lowest)].min()
    # Where the surface ends under the middle of the ball, it rolls off.
    solid = np.where(np.isfinite(height), lowest, bottom - radius)
    smooth = uniform_filter(solid, 3)
    along_x, along_y = np.gradient(smooth, step)
    slope = np.degrees(np.arctan(np.hypot(along_x, along_y)))
    seed = np.full_like(solid, solid.max())
    edge = np.ones_like(seed, bool)
    edge[1:-1, 1:-1] = False
    edge |= ~np.isfinite(height)
    seed[edge] = solid[edge]
    return lowest, slope, reconstruction(seed, solid, method="erosion") - solid


def choose_drop(shown: Mesh, solid: Mesh, *, share: float = BODY_SHARE, cells: int = 10) -> Drop:
    """Chooses the place to drop a box: high, central, and level or hollow, so that it stays there.

    Args:
        shown: visible surface, metres, z up; the box has to land on it.
        solid: what must not be in the way.
        share: side of the box as a share of the widest side.
        cells: of the height map along the box's side.
    """
    from scipy.ndimage import binary_erosion, uniform_filter

    low, high = shown.vertices.min(0), shown.vertices.max(0)
    side = share * float((high - low).max())
    step = side / cells
    x, y = (np.arange(low[k], high[k] + step, step) for k in range(2))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    height = heights_from_above(shown, places.reshape(-1, 2)).reshape(places.shape[:2])
    top = heights_from_above(solid, places.reshape(-1, 2)).reshape(places.shape[:2])
    # Matter that no photo shows may be in the way: the box must not land on it.
    visible = np.isfinite(height) & ~(top > height + 0.2 * side)
    height = np.where(np.isnan(height), -np.inf, np.fmax(height, top))
    lowest, slope, depth = resting_map(height, step, 0.5 * side)
    middle = (low[:2] + high[:2]) / 2
    central = np.linalg.norm((places - middle) / np.maximum(high[:2] - low[:2], 1e-9), axis=-1)
    extent = max(float(high[2] - low[2]), 1e-9)
    hollow = np.clip(depth / side, 0, 0.5)
    score = (np.where(np.isfinite(height), lowest, low[2]) - low[2]) / extent - 1.2 * central
    # Level all over the box's footprint, or it tips over an edge; in a hollow the sides may be steep.
    around = uniform_filter(np.minimum(slope, 60.0), cells + 1)
    score += 1.5 * hollow - np.clip(slope - 3, 0, 40) / 12 - np.clip(around - 5, 0, 40) / 12 * (1 - 2 * hollow)
    # The whole box has to be over the surface.
    half = int(np.ceil(0.5 * side / step))
    covered = binary_erosion(visible, np.ones((2 * half + 1, 2 * half + 1)))
    usable = next(mask for mask in (covered, visible, np.isfinite(height)) if mask.any())
    score = np.where(usable, score, -np.inf)
    flat = int(np.argmax(score))
    best = (flat // score.shape[1], flat % score.shape[1])
    # The corners of a turned box reach farther than the ball: it starts above everything below them.
    wide = int(np.ceil(0.75 * side / step))
    window = tuple(slice(max(0, k - wide), k + wide + 1) for k in best)
    support = float(height[window].max())
    position = (float(places[best][0]), float(places[best][1]), support + 0.5 * side + 0.6 * side)
    return Drop(side, position, support, float(slope[best]), float(depth[best]))


def scene_text(placement: Placement, drop: Drop, *, asset: str = "assets/scene", seed: int = 0) -> str:
    """The text of scene.yaml: the scenery, a floor below it, and a box above it."""
    side, gap = f"{drop.side:.4f}", 1000 * (drop.position[2] - drop.support - drop.side / 2)
    x, y, z = (f"{value:.4f}" for value in drop.position)
    return f"""\
# Reconstructed from photos. Up from the {"dominant plane" if placement.up_from == "plane" else "cameras"}.
# Size {placement.size_from}{" (give --size for true metres)" if placement.size_from.startswith("assumed") else ""}.
version: 1
duration: 4.0                    # s
seed: {seed}
gravity: [0, 0, -9.81]           # m/s^2
shapes:
  scene: {{asset: {asset}}}
  box: {{box: {{size: [{side}, {side}, {side}]}}}}
bodies:
  - {{name: floor, motion: static, plane: {{normal: [0, 0, 1], offset: {placement.floor:g}}}}}
  - {{name: scene, shape: scene, motion: static, friction: 0.8, restitution: 0.2}}
  - name: box
    shape: box
    position: [{x}, {y}, {z}]     # m; {gap:.0f} mm above the surface
    density: {BODY_DENSITY:g}                 # kg/m^3
    friction: 0.8
    restitution: 0.2
"""


def write_scene(mesh_folder: Path, scene_file: Path, *, seed: int = 0) -> dict:
    """Writes scene.yaml for the meshes of a mesh folder; returns where the body is dropped.

    Raises:
        SdfsimError: the mesh stage has not run.
    """
    shown, solid = load_mesh(Path(mesh_folder) / "mesh.ply"), load_mesh(Path(mesh_folder) / "solid.ply")
    placement = load_placement(mesh_folder)
    drop = choose_drop(shown, solid)
    temporary = Path(scene_file).with_suffix(".part")
    temporary.write_text(scene_text(placement, drop, seed=seed), encoding="utf-8")
    os.replace(temporary, scene_file)
    return {"drop": asdict(drop), "body": f"box of {drop.side:.3f} m", "size": placement.size_from}


def load_placement(mesh_folder: Path) -> Placement:
    """Reads `placement.json`.

    Raises:
        SdfsimError: the mesh stage has not run.
    """
    try:
        return Placement.from_dict(json.loads((Path(mesh_folder) / "placement.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{mesh_folder}: no placement", "run the mesh stage first") from error
