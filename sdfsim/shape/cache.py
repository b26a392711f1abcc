"""Shapes fitted on first use, then taken from a cache keyed by content."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.shape.asset import Shape, load_shape, scaled
from sdfsim.shape.mesh import Mesh, load_mesh
from sdfsim.shape.storage import FORMAT_VERSION

_log = logging.getLogger(__name__)


def shape_from_mesh(
    path: str | Path,
    cache_dir: str | Path | None = None,
    *,
    name: str | None = None,
    units: float = 1.0,
    on_progress: Callable[[float, str], None] | None = None,
) -> Shape:
    """The shape of a mesh file: fitted on first use, then taken from a cache keyed by what the file describes.

    Args:
        path: a mesh file.
        cache_dir: where fitted shapes are kept; by default `sdfsim/shapes` in the user's cache folder.
        name: by default the file's.
        units: metres per unit of the file.
        on_progress: called with (fraction done, message) while fitting.

    Raises:
        SdfsimError: the mesh cannot be used.
    """
    path = Path(path)
    mesh = load_mesh(path)
    # Not of the file's bytes: a glTF keeps its vertices, and an OBJ its colours, in files beside it.
    key = mesh.digest()
    shape = _cached(mesh, key, path.stem, cache_dir, on_progress)
    shape = replace(shape, name=name or path.stem, source={**shape.source, "file": path.name, "sha256": key})
    return scaled(shape, units)


def shape_from_primitive(
    kind: str,
    size: float = 1.0,
    cache_dir: str | Path | None = None,
    *,
    name: str | None = None,
    on_progress: Callable[[float, str], None] | None = None,
) -> Shape:
    """The shape of a procedural mesh of `primitives.PRIMITIVES`, fitted on first use and cached.

    Args:
        kind: name in `PRIMITIVES`.
        size: its largest extent, m.
        cache_dir, name, on_progress: as for `shape_from_mesh`.

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
    shape = _cached(unit, key, kind, cache_dir, on_progress)
    return scaled(replace(shape, name=name or kind, source={**shape.source, "primitive": kind}), size)


def _cached(
    mesh: Mesh,
    key: str,
    label: str,
    cache_dir: str | Path | None,
    on_progress: Callable[[float, str], None] | None,
) -> Shape:
    # Only here is anything fitted: reading a shape folder needs no open3d and no optimiser.
    from sdfsim.shape.fit import FIT_VERSION, fit_mesh

    if cache_dir is None:
        cache_dir = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sdfsim" / "shapes"
    folder = Path(cache_dir) / f"{key[:24]}-{FIT_VERSION}.{FORMAT_VERSION}"
    if folder.is_dir():
        try:
            return load_shape(folder)
        except SdfsimError:
            shutil.rmtree(folder, ignore_errors=True)  # a damaged entry is only a cache miss
    shape = fit_mesh(mesh, name=label, on_progress=on_progress)
    # A folder of its own first, so that processes fitting the same mesh never see each other's half.
    partial = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    try:
        shape.save(partial)
        if not folder.is_dir():  # else another process was first: its entry is as good
            partial.rename(folder)
    except (SdfsimError, OSError) as error:
        _log.warning("the fitted shape %s is not kept for the next time: %s", label, error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return shape
