"""The scene.yaml of a reconstruction: the scenery, a floor below it, and a body dropped onto it."""

from __future__ import annotations

import hashlib
import itertools
import os
from dataclasses import asdict
from pathlib import Path

from pipeline.drop import LEVEL, Drop, choose_drop
from pipeline.placement import Placement, load_placement
from sdfsim.files import write_text
from sdfsim.shape.mesh import load_mesh

BODY_DENSITY = 400.0  # kg/m^3, wood


def scene_text(placement: Placement, drop: Drop, *, asset: str = "assets/scene", seed: int = 0) -> str:
    """The text of scene.yaml: the scenery, a floor below it, and a flat box above it."""
    side, thickness = f"{drop.side:.4f}", f"{drop.thickness:.4f}"
    x, y, z = (f"{value:.4f}" for value in drop.position)
    quat = ", ".join(f"{value:.5f}" for value in drop.quat_xyzw)
    return f"""\
# Reconstructed from photos. Up from the {"dominant plane" if placement.up_from == "plane" else "cameras"}.
# Size {placement.size_from}{" (give --size for true metres)" if placement.size_from.startswith("assumed") else ""}.
version: 1
duration: 4.0                    # s
seed: {seed}
gravity: [0, 0, -9.81]           # m/s^2
shapes:
  scene: {{asset: {asset}}}
  box: {{box: {{size: [{side}, {side}, {thickness}]}}}}
bodies:
  - {{name: floor, motion: static, plane: {{normal: [0, 0, 1], offset: {placement.floor:g}}}}}
  - {{name: scene, shape: scene, motion: static, friction: 0.8, restitution: 0.4}}
  - name: box
    shape: box
    position: [{x}, {y}, {z}]     # m
    quat_xyzw: [{quat}]  # level with the surface below
    density: {BODY_DENSITY:g}                 # kg/m^3
    friction: 0.8
    restitution: 0.4
"""


def write_scene(mesh_folder: Path, scene_file: Path, *, written: str | None = None, seed: int = 0) -> dict:
    """Writes scene.yaml for the meshes of a mesh folder; returns where the body is dropped.

    A scene file that the user has changed is kept beside it as `scene.yaml.bak`.

    Args:
        mesh_folder: of the mesh stage.
        scene_file: to write.
        written: hash of the scene file as this function last wrote it; None where it never did.
        seed: of the scene.

    Raises:
        SdfsimError: the mesh stage has not run.
    """
    shown, solid = load_mesh(Path(mesh_folder) / "mesh.ply"), load_mesh(Path(mesh_folder) / "solid.ply")
    placement = load_placement(mesh_folder)
    drop = choose_drop(shown, solid)
    text = scene_text(placement, drop, seed=seed)
    notes = []
    if scene_file.exists() and content_hash(scene_file.read_bytes()) not in (written, content_hash(text.encode())):
        kept = free_name(scene_file)
        os.replace(scene_file, kept)
        notes.append(f"{scene_file.name} had been changed by hand: kept as {kept.name}")
    write_text(scene_file, text)
    body = f"box of {drop.side:.3g} x {drop.side:.3g} x {drop.thickness:.3g} m"
    if drop.slope > LEVEL:
        notes.append(f"no level place to drop a body onto: the flattest slopes by {drop.slope:.0f} degrees")
    return {
        "drop": asdict(drop), "body": body, "size": placement.size_from, "notes": notes,
        "scene_sha256": content_hash(text.encode()),
    }  # fmt: skip


def content_hash(content: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(content).hexdigest()


def free_name(path: Path) -> Path:
    """A name beside `path` that is not taken: with `.bak`, or `.bak2`, `.bak3` and so on, added."""
    numbers = itertools.chain([""], itertools.count(2))
    return next(p for p in (path.with_name(f"{path.name}.bak{n}") for n in numbers) if not p.exists())
