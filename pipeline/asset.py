"""Meshes -> Shape folders with compact SDFs: one of the scenery, one of each body."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.meshing import SCENERY, read_parts
from sdfsim.shape.mesh import Mesh, load_mesh

Progress = Callable[[float, str], None]

# Of a budget the scenery gets as much as this many bodies: it has more to it.
SCENERY_SHARE = 2


def fit_parts(mesh_folder: Path, out: Path, *, budget: float | None, recipe: str = "default", seed: int = 0,
              device: str = "cpu", on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Fits a compact SDF to the scenery and to every body, each a Shape folder in `out` that goes by its name.

    The scenery's solid is closed (capped where the trained space ends), so the sign of its distance is right
    everywhere, also above the open scenery where bodies come from; what is shown of it is its visible surface. A body's
    origin is the middle of its base. Folders that are there already are kept.

    Args:
        mesh_folder: of the mesh stage.
        out: existing folder.
        budget: s of fitting, for all.
        recipe: of the fits.
        seed: of the fits.
        device: where to compute.
        on_progress: called with (fraction, message).

    Returns:
        `shapes`: a certificate each; `passed`, `reason` and `caveats` (a line each) for all of them.

    Raises:
        SdfsimError: the mesh stage has not run, or a mesh cannot be used.
    """
    from sdfsim.shape.shape import load_shape

    parts = read_parts(mesh_folder)
    weights = {SCENERY: SCENERY_SHARE} if parts["scenery"] else {}
    weights |= {entry["name"]: 1 for entry in parts["objects"]}
    shares = {name: weight / sum(weights.values()) for name, weight in weights.items()}
    certificates, done = {}, 0.0
    for name, share in shares.items():

        def tell(fraction: float, message: str, name: str = name, before: float = done, share: float = share) -> None:
            if on_progress:
                on_progress(before + share * fraction, f"{name}: {message}")

        done += share
        folder = out / name
        if (folder / "shape.json").exists():
            certificates[name] = load_shape(folder).certificate
            continue
        solid, shown = meshes_of(mesh_folder, name)
        certificates[name] = fit_one(
            solid, shown, out, name, budget=None if budget is None else budget * share, recipe=recipe, seed=seed,
            device=device, on_progress=tell,
        )  # fmt: skip
    missed = [f"{name}: {found['reason']}" for name, found in certificates.items() if not found["passed"]]
    caveats = [f"{name}: {found['caveat']}" for name, found in certificates.items() if found["caveat"]]
    return {"shapes": certificates, "passed": not missed, "reason": "; ".join(missed), "caveats": caveats}


def fit_one(solid: Mesh, shown: Mesh, out: Path, name: str, *, budget: float | None, recipe: str, seed: int,
            device: str, on_progress: Progress) -> dict:  # fmt: skip
    """Fits one shape, saves it as the folder `out`/`name`, and returns its certificate."""
    from sdfsim.shape.fit import fit_mesh

    shape = fit_mesh(
        solid, name=name, recipe=recipe, budget=budget, seed=seed, cap=True,  # type: ignore[arg-type]
        on_progress=on_progress, device=device,
    )  # fmt: skip
    # The folder appears complete or not at all: a run that goes on keeps those that are there.
    partial = out / f".{name}.part"
    shutil.rmtree(partial, ignore_errors=True)
    replace(shape, mesh=shown).save(partial)
    partial.rename(out / name)
    return shape.certificate


def meshes_of(mesh_folder: Path, name: str) -> tuple[Mesh, Mesh]:
    """The closed mesh of a part in its own frame, and what is displayed of it."""
    if name == SCENERY:
        return load_mesh(mesh_folder / "solid.ply"), load_mesh(mesh_folder / "shown.ply")
    mesh = load_mesh(mesh_folder / "objects" / f"{name}.ply")
    moved = replace(mesh, vertices=mesh.vertices - origin_of(mesh))
    return moved, moved


def origin_of(mesh: Mesh) -> np.ndarray:
    """A body's origin [3]: the middle of the base of its bounding box."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return np.array([*(low + high)[:2] / 2, low[2]])
