"""The scene.yaml of a reconstruction: a floor, the scenery, the bodies found on it, and one dropped onto it."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml

from pipeline.asset import origin_of
from pipeline.cleaning import joined
from pipeline.drop import LEVEL, Drop, choose_drop
from pipeline.meshing import read_parts, rounded
from pipeline.placement import Placement, load_placement
from sdfsim.errors import SdfsimError
from sdfsim.files import write_text
from sdfsim.shape.mesh import load_mesh

DENSITY = 400.0  # kg/m^3, wood: no photo tells what a thing is made of
SURFACE = "friction: 0.8, restitution: 0.4"


@dataclass(frozen=True)
class Found:
    """A body as the scene file needs it.

    Attributes:
        name: also of its asset.
        origin: [3] m, where its shape's origin is.
        static: a person wants it to stay.
    """

    name: str
    origin: np.ndarray
    static: bool = False


def scene_text(placement: Placement, drop: Drop | None, *, scenery: bool = True, found: Sequence[Found] = (),
               shape: str = "box", seed: int = 0) -> str:  # fmt: skip
    """The text of scene.yaml: a floor, the scenery, bodies that were found, and one dropped from above.

    Args:
        placement: of the meshes.
        drop: where the last one starts; None leaves it out.
        scenery: whether there is any.
        found: bodies, with assets that go by their names.
        shape: of what is dropped, box or ball.
        seed: of the scene.
    """
    source = "the dominant plane" if placement.up_from == "plane" else "the cameras"
    assumed = " (give --size or --distance for true metres)" if placement.size_from.startswith("assumed") else ""
    lines = [
        f"# Reconstructed from photos. Up from {source}, within {placement.up_within:.1f} degrees "
        f"(confidence: {placement.up_confidence}).",
        f"# Size {placement.size_from}{assumed}.",
        "version: 1",
        "duration: 4.0                    # s",
        f"seed: {seed}",
        "gravity: [0, 0, -9.81]           # m/s^2",
        "shapes:",
    ]
    plane = {"normal": [0, 0, 1], "offset": float(rounded(placement.floor))}
    bodies = [f"  - {{name: floor, motion: static, plane: {_flow(plane)}}}"]
    if scenery:
        lines.append("  scene: {asset: assets/scene}")
        bodies.append(f"  - {{name: scene, shape: scene, motion: static, {SURFACE}}}")
    for body in found:
        lines.append(f"  {body.name}: {{asset: assets/{body.name}}}")
        moves = "motion: static" if body.static else f"density: {DENSITY:g}"
        position = _flow(rounded(body.origin).tolist())
        bodies.append(f"  - {{name: {body.name}, shape: {body.name}, position: {position}, {moves}, {SURFACE}}}")
    if drop is not None:
        box = {"box": {"size": rounded((drop.side, drop.side, drop.thickness)).tolist()}}
        ball = {"sphere": {"radius": float(rounded(drop.thickness / 2))}}
        lines.append(f"  {shape}: {_flow(box if shape == 'box' else ball)}")
        bodies += [
            f"  - name: {shape}",
            f"    shape: {shape}",
            f"    position: {_flow(rounded(drop.position).tolist())}     # m",
            f"    quat_xyzw: {_flow(rounded(drop.quat_xyzw).tolist())}  # level with the surface below",
            f"    density: {DENSITY:g}                 # kg/m^3",
            *(f"    {part}" for part in SURFACE.split(", ")),
        ]
    return "\n".join([*lines, "bodies:", *bodies, ""])


def _flow(content: dict | list) -> str:
    """One line of YAML. Its numbers are not Python's: 1e-05 would be read as a text."""
    return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, width=1000).strip()


def write_scene(mesh_folder: Path, scene_file: Path, *, shape: str = "box", static: Sequence[str] = (),
                written: str | None = None, seed: int = 0) -> dict:  # fmt: skip
    """Writes scene.yaml for the meshes of a mesh folder; returns where the body is dropped.

    A scene file that the user has changed is kept beside it as `scene.yaml.bak`.

    Args:
        mesh_folder: of the mesh stage.
        scene_file: to write.
        shape: of what is dropped: box, ball or none.
        static: bodies that are to stay where they are, by name.
        written: hash of the scene file as this function last wrote it; None where it never did.
        seed: of the scene.

    Raises:
        SdfsimError: the mesh stage has not run, or no body has a name in `static`.
    """
    mesh_folder = Path(mesh_folder)
    parts, placement = read_parts(mesh_folder), load_placement(mesh_folder)
    names = [entry["name"] for entry in parts["objects"]]
    wrong = sorted(set(static) - set(names))
    if wrong:
        there = f"found: {', '.join(names)} (see mesh/objects.png)" if names else "no separate bodies were found"
        raise SdfsimError(f"static: no body is called {', '.join(wrong)}", there)
    solids = [load_mesh(mesh_folder / "objects" / f"{name}.ply") for name in names]
    found = [Found(name, origin_of(mesh), name in static) for name, mesh in zip(names, solids, strict=True)]
    notes: list[str] = []
    drop = None
    if shape != "none":
        scenery = [load_mesh(mesh_folder / "solid.ply")] if parts["scenery"] else []
        shown = load_mesh(mesh_folder / "shown.ply") if parts["scenery"] else joined(solids)
        drop = choose_drop(shown, joined([*scenery, *solids]))
        if drop.slope > LEVEL:
            notes.append(f"no level place to drop a body onto: the flattest slopes by {drop.slope:.0f} degrees")
    text = scene_text(placement, drop, scenery=parts["scenery"], found=found, shape=shape, seed=seed)
    if scene_file.exists() and content_hash(scene_file.read_bytes()) not in (written, content_hash(text.encode())):
        kept = free_name(scene_file)
        os.replace(scene_file, kept)
        notes.append(f"{scene_file.name} had been changed by hand: kept as {kept.name}")
    write_text(scene_file, text)
    return {
        "objects": names, "static": sorted(static), "density_assumed": DENSITY, "size": placement.size_from,
        "drop": {"shape": shape, **(asdict(drop) if drop else {})}, "notes": notes,
        "scene_sha256": content_hash(text.encode()),
    }  # fmt: skip


def content_hash(content: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(content).hexdigest()


def free_name(path: Path) -> Path:
    """A name beside `path` that is not taken: with `.bak`, or `.bak2`, `.bak3` and so on, added."""
    numbers = itertools.chain([""], itertools.count(2))
    return next(p for p in (path.with_name(f"{path.name}.bak{n}") for n in numbers) if not p.exists())
