"""Meshes -> a Shape folder with a compact SDF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sdfsim.shape.mesh import load_mesh

Progress = Callable[[float, str], None]


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
        solid, name="scene", recipe=recipe, budget=budget, seed=seed, cap=True,  # type: ignore[arg-type]
        on_progress=on_progress, checkpoint=Path(out) / "fit.checkpoint",
    )  # fmt: skip
    shape = replace(shape, mesh=shown)
    shape.save(out)
    (Path(out) / "fit.checkpoint").unlink(missing_ok=True)
    return shape.certificate
