"""Shapes of meshes: fitted (or sampled) on first use, then taken from a cache keyed by content."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape.mesh import Mesh, load_mesh
from sdfsim.shape.shape import DEFAULT_RESOLUTION, FORMAT_VERSION, SdfKind, Shape, load_shape, scaled, sdf_of_mesh
from sdfsim.shape.surface_nodes import DEFAULT_COUNT

Progress = Callable[[float, str], None]

_log = logging.getLogger(__name__)


class Closing(NamedTuple):
    """What is done to a mesh that is open, as in `solidify`: openings closed, or a thickness in the mesh's units."""

    cap: bool = False
    thicken: float | None = None

    @property
    def variant(self) -> str:
        """For a cache key."""
        return ("-cap" if self.cap else "") + (f"-thick{self.thicken:g}" if self.thicken is not None else "")


AS_IT_IS = Closing()


def shape_from_mesh(
    path: str | Path,
    cache_dir: str | Path | None = None,
    *,
    name: str | None = None,
    units: float = 1.0,
    cap: bool = False,
    thicken: float | None = None,
    sdf: SdfKind = "mlp",
    resolution: int = DEFAULT_RESOLUTION,
    on_progress: Progress | None = None,
) -> Shape:
    """The shape of a mesh file: made on first use, then taken from a cache keyed by what the file describes.

    Args:
        path: a mesh file.
        cache_dir: where shapes are kept; by default `sdfsim/shapes` in the user's cache folder.
        name: by default the file's.
        units: metres per unit of the file.
        cap: close openings of any size.
        thicken: m; a thickness for an open sheet.
        sdf: "mlp" fits the network; "grid" and "mesh" fit nothing (see `mesh_shape`).
        resolution: of a grid, samples along each side.
        on_progress: called with (fraction done, message) while fitting or sampling.

    Raises:
        SdfsimError: the mesh cannot be used.
    """
    path = Path(path)
    mesh = load_mesh(path)
    # Not of the file's bytes: a glTF keeps its vertices, and an OBJ its colours, in files beside it.
    key = mesh.digest()
    closing = Closing(cap, None if thicken is None else thicken / units)
    shape = _cached(mesh, key, path.stem, closing, sdf, resolution, cache_dir, on_progress)
    shape = replace(shape, name=name or path.stem, source={**shape.source, "file": path.name, "sha256": key})
    return scaled(shape, units)


def shape_from_primitive(
    kind: str,
    size: float = 1.0,
    cache_dir: str | Path | None = None,
    *,
    name: str | None = None,
    sdf: SdfKind = "mlp",
    resolution: int = DEFAULT_RESOLUTION,
    on_progress: Progress | None = None,
) -> Shape:
    """The shape of a procedural mesh of `primitives.PRIMITIVES`, made on first use and cached.

    Args:
        kind: name in `PRIMITIVES`.
        size: its largest extent, m.
        cache_dir, name, sdf, resolution, on_progress: as for `shape_from_mesh`.

    Raises:
        SdfsimError: no such primitive.
    """
    from sdfsim.shape.primitives import PRIMITIVES

    if kind not in PRIMITIVES:
        raise SdfsimError(f"no primitive called {kind!r}", "there are " + ", ".join(PRIMITIVES))
    mesh = PRIMITIVES[kind]()
    unit = Mesh(mesh.vertices / float(np.ptp(mesh.vertices, axis=0).max()), mesh.faces)
    # Rounded, since sines and cosines differ in their last digit from machine to machine.
    key = Mesh(unit.vertices.round(9), unit.faces).digest()
    shape = _cached(unit, key, kind, AS_IT_IS, sdf, resolution, cache_dir, on_progress)
    return scaled(replace(shape, name=name or kind, source={**shape.source, "primitive": kind}), size)


def mesh_shape(
    mesh: Mesh,
    *,
    name: str,
    kind: Literal["grid", "mesh"],
    closing: Closing = AS_IT_IS,
    resolution: int = DEFAULT_RESOLUTION,
    on_progress: Progress | None = None,
) -> Shape:
    """The shape of a mesh without any fit: its exact SDF or a grid of it, nodes and mass properties as a fit has them.

    Args:
        mesh: metres.
        name: of the shape.
        kind: "mesh" (the exact distance) or "grid" (samples of it).
        closing: of an open mesh.
        resolution: of a grid, samples along each side.
        on_progress: called with (fraction done, message) while a grid is sampled.

    Raises:
        SdfsimError: the mesh cannot be used.
    """
    from sdfsim.shape.fit import surface_nodes
    from sdfsim.shape.watertight import solidify

    solid = solidify(mesh, name=name, cap=closing.cap, thicken=closing.thicken)
    sdf, note = sdf_of_mesh(solid.surface, kind, resolution, on_progress)
    nodes = surface_nodes(sdf, solid.surface, DEFAULT_COUNT)
    return Shape(name, solid.surface, sdf, nodes, *solid.mass_properties(), source={"kind": "mesh"} | note)


def _cached(
    mesh: Mesh,
    key: str,
    label: str,
    closing: Closing,
    kind: SdfKind,
    resolution: int,
    cache_dir: str | Path | None,
    on_progress: Progress | None,
) -> Shape:
    if kind == "mesh":  # made as fast as it is read
        return mesh_shape(mesh, name=label, kind=kind, closing=closing)
    # Only here is anything fitted: reading a shape folder needs no open3d and no optimiser.
    from sdfsim.shape.fit import FIT_VERSION, fit_mesh

    if cache_dir is None:
        cache_dir = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sdfsim" / "shapes"
    variant = closing.variant + (f"-grid{resolution}" if kind == "grid" else "")
    folder = Path(cache_dir) / f"{key[:24]}{variant}-{FIT_VERSION}.{FORMAT_VERSION}"
    if folder.is_dir():
        try:
            return load_shape(folder)
        except SdfsimError:
            shutil.rmtree(folder, ignore_errors=True)  # a damaged entry is only a cache miss
    if kind == "grid":
        shape = mesh_shape(mesh, name=label, kind=kind, closing=closing, resolution=resolution, on_progress=on_progress)
    else:
        shape = fit_mesh(mesh, name=label, cap=closing.cap, thicken=closing.thicken, on_progress=on_progress)
    # A folder of its own first, so that processes fitting the same mesh never see each other's half.
    partial = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    try:
        shape.save(partial)
        if not folder.is_dir():  # else another process was first: its entry is as good
            partial.rename(folder)
    except (SdfsimError, OSError) as error:
        _log.warning("the shape %s is not kept for the next time: %s", label, error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return shape
