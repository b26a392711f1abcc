"""Volume, centre of mass and inertia, of closed meshes exactly and of any bounded SDF on a grid."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, is_closed, lattice


def mass_properties(mesh: Mesh) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume m^3, centre of mass [3] m, and inertia [3, 3] m^5 (per unit density) about it of a closed mesh, exactly,
    as a sum over signed tetrahedra. Raises SdfsimError if it is open (use `mass_properties_of_sdf`) or encloses
    nothing."""
    if not is_closed(mesh):
        raise SdfsimError("mesh is not closed, so it has no exact volume")
    return integrals(mesh)


def integrals(mesh: Mesh, weights: np.ndarray | float = 1.0) -> tuple[float, np.ndarray, np.ndarray]:
    """`mass_properties` of a surface that is closed except for cracks: edges need not match, as after cutting faces.
    `weights` [F] are 1 / n for n faces that lie on each other. Raises SdfsimError if it encloses nothing."""
    # Moments about the vertices' mean: far from the origin the products of large coordinates would cancel.
    shift = mesh.vertices.mean(0)
    corners = mesh.vertices[mesh.faces] - shift
    six = weights * np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volume = float(six.sum() / 6.0)
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    if volume <= 1e-9 * extent**3:
        raise SdfsimError("mesh encloses no volume")
    total = corners.sum(1)
    com = np.einsum("f,fi->i", six, total) / (24.0 * volume)
    # Integral of x x^T over a tetrahedron with one corner at the origin.
    second = np.einsum("f,fi,fj->ij", six, total, total) + np.einsum("f,fki,fkj->ij", six, corners, corners)
    second = second / 120.0 - volume * np.outer(com, com)
    return volume, com + shift, np.trace(second) * np.eye(3) - second


def mass_properties_of_sdf(
    distance: Callable[[np.ndarray], tuple[Any, ...]], bounds: np.ndarray, *, cells: int = 64, wall: float = np.inf
) -> tuple[float, np.ndarray, np.ndarray]:
    """The integrals of `mass_properties` on a grid, from the signed distance of a solid within `bounds` [2, 3] m (an
    Sdf or a `DistanceOracle`). With a `wall` in m only the layer of that thickness inside the surface counts.

    A cell at distance f from the surface counts with the fraction 0.5 - f / cell (clamped), so the error is of second
    order in the cell. Raises SdfsimError for bounds that are infinite, or a distance that is negative nowhere.
    """
    low, high = np.asarray(bounds, dtype=np.float64)
    if not np.isfinite([low, high]).all():
        raise SdfsimError("an unbounded shape has no mass properties")
    cell = float((high - low).max()) / cells
    counts = np.ceil((high - low) / cell).astype(int) + 2
    start = 0.5 * (low + high) - 0.5 * cell * (counts - 1)
    axes = [start[axis] + cell * np.arange(counts[axis]) for axis in range(3)]
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for x in axes[0]:
        points = lattice([x], axes[1], axes[2])
        depth = np.asarray(distance(points)[0])
        solid, hollow = (np.clip(0.5 - d / cell, 0.0, 1.0) for d in (depth, depth + wall))
        weight = (solid - hollow) * cell**3
        offset = points - start
        volume += float(weight.sum())
        first += weight @ offset
        second += np.einsum("p,pi,pj->ij", weight, offset, offset)
    if volume <= 0:
        raise SdfsimError("the shape encloses no volume")
    com = first / volume
    # A filled cell is a small cube, not a point: this adds its own second moment.
    second += np.eye(3) * volume * cell**2 / 12.0 - volume * np.outer(com, com)
    return volume, com + start, np.trace(second) * np.eye(3) - second
