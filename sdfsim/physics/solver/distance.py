"""Signed distances of all kinds of shapes, compiled: closed forms, and grids of bricks.

Lengths are at scale 1 of the shape, points are in its own frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sdfsim.physics.solver.convex import Convex
from sdfsim.physics.solver.tolerances import FIRST_FACE, GRID_CLOSE, GRID_OFF, NO_SLOPE
from sdfsim.physics.solver.triangles import Triangles, signed
from sdfsim.physics.solver.vectors import BARE, ENTRY, INLINED, along, dot, get, norm, put, scale

PLANE, SPHERE, CAPSULE, BOX, CYLINDER, CONE, TORUS, GRID = range(8)


# Columns of the table of shapes: kind; sizes (sphere: radius; capsule, cylinder and cone: radius and half height, for a
# capsule without its caps; torus: radii of its circle and its tube; box: half extents; else 0); thickness of the
# thinnest walls; for a grid its first sample, cell size, number of bricks along each side, and where its samples and
# brick numbers begin.
KIND, SIZE, THICKNESS, LOW, CELL, BRICKS, COARSE, BRICK = 0, 1, 4, 5, 8, 9, 12, 13
# And for a shape of several patches: the first labelled point, the distance between two, their number along each side,
# and where the labels begin; -1 if there is one patch only.
PATCH_LOW, PATCH_CELL, PATCHES, PATCH = 14, 17, 18, 21
# And for a shape with triangles how far its grid is off near the surface, else 0.
ERROR, FIELDS = 22, 23


class Shapes(NamedTuple):
    """S shapes; arrays whose length differs from shape to shape are stored end to end."""

    table: np.ndarray  # [S, FIELDS] float64
    brick: np.ndarray  # int64, where in `sample` the 9^3 distances of a brick begin; -1 for bricks far from the surface
    sample: np.ndarray  # float32 distances, at the corners of bricks and in bricks
    node: np.ndarray  # [K, 3] surface nodes, leaf by leaf
    cover: np.ndarray  # [K] radius of the part of the surface that is nearer to this node than to others
    leaf_node: np.ndarray  # [L + 1] int64, leaf l holds nodes leaf_node[l] : leaf_node[l + 1]
    leaf_ball: np.ndarray  # [L, 4] centre and radius of a ball around these
    clump_start: np.ndarray  # [S + 1] int64, shape s has clumps clump_start[s] : clump_start[s + 1]
    clump_leaf: np.ndarray  # [C + 1] int64, likewise the leaves of clumps
    clump_ball: np.ndarray  # [C, 4]
    leaf_patch: np.ndarray  # [L] int64, the patch of the surface to which a leaf's nodes belong
    label: np.ndarray  # int16, the nearest patch at points all over the shape
    solids: Convex  # the convex pieces of the shapes
    triangles: Triangles  # the true surfaces of shapes that a grid would round off


@njit(**BARE)
def distance(table, brick, sample, s, p):
    """Signed distance and unit gradient of shape s at p."""
    kind = table[s, KIND]
    if kind == GRID:
        return _grid(table, brick, sample, s, p)
    if kind == PLANE:
        return p[2], (0.0, 0.0, 1.0)
    a, b, c = table[s, SIZE], table[s, SIZE + 1], table[s, SIZE + 2]
    if kind == SPHERE:
        return _ball(p, a)
    if kind == CAPSULE:
        return _ball((p[0], p[1], p[2] - min(max(p[2], -b), b)), a)
    if kind == BOX:
        return _box(p, a, b, c)
    if kind == CYLINDER:
        return _cylinder(p, a, b)
    r = math.sqrt(p[0] * p[0] + p[1] * p[1])
    cx, cy = (p[0] / r, p[1] / r) if r > NO_SLOPE else (1.0, 0.0)
    if kind == TORUS:
        return _ball((p[0] - a * cx, p[1] - a * cy, p[2]), b)
    d, out, up = _cone(r, p[2], a, b)
    return d, (out * cx, out * cy, up)


@njit(**BARE)
def distance_alone(table, brick, sample, s, p):
    """Signed distance without the gradient; for a grid in two thirds of the time."""
    if table[s, KIND] == GRID:
        return _grid_alone(table, brick, sample, s, p)
    d, _ = distance(table, brick, sample, s, p)
    return d


@njit(**BARE)
def true_distance(shapes, s, p):
    """Signed distance and unit gradient of the true surface of shape s, where p is near it."""
    d, n = distance(shapes.table, shapes.brick, shapes.sample, s, p)
    if shapes.triangles.level[s] >= 0 and abs(d) <= GRID_CLOSE * shapes.table[s, CELL]:
        exact, normal, _ = signed(shapes.triangles, s, p, abs(d) + GRID_OFF * shapes.table[s, ERROR])
        # Where faces cross or are missing, the nearest feature may be wrong about the side, and the grid is right.
        if exact < math.inf and (exact * d > 0.0 or abs(d) <= shapes.table[s, ERROR]):
            return exact, normal
    return d, n


@njit(**ENTRY)
def distances(table, brick, sample, s, p):
    """Signed distances [P] and unit gradients [P, 3] of shape s at points [P, 3]."""
    d, n = np.empty(len(p)), np.empty((len(p), 3))
    for i in range(len(p)):
        d[i], normal = distance(table, brick, sample, s, get(p, i))
        put(n, i, normal)
    return d, n


@njit(**BARE)
def patch_of(table, label, s, p):
    """The patch of shape s that is nearest to p."""
    first = int(table[s, PATCH])
    if first < 0:
        return 0
    cell = table[s, PATCH_CELL]
    nx, ny, nz = int(table[s, PATCHES]), int(table[s, PATCHES + 1]), int(table[s, PATCHES + 2])
    i = min(max(int((p[0] - table[s, PATCH_LOW]) / cell + 0.5), 0), nx - 1)
    j = min(max(int((p[1] - table[s, PATCH_LOW + 1]) / cell + 0.5), 0), ny - 1)
    k = min(max(int((p[2] - table[s, PATCH_LOW + 2]) / cell + 0.5), 0), nz - 1)
    return int(label[first + (i * ny + j) * nz + k])


@njit(**BARE)
def _ball(p, radius):
    length = norm(p)
    if length < NO_SLOPE:
        return -radius, (0.0, 0.0, 1.0)
    return length - radius, (p[0] / length, p[1] / length, p[2] / length)


@njit(**BARE)
def _box(p, a, b, c):
    sx = -1.0 if p[0] < 0.0 else 1.0
    sy = -1.0 if p[1] < 0.0 else 1.0
    sz = -1.0 if p[2] < 0.0 else 1.0
    x, y, z = sx * p[0] - a, sy * p[1] - b, sz * p[2] - c
    out = (max(x, 0.0), max(y, 0.0), max(z, 0.0))
    length, even = norm(out), FIRST_FACE * (a + b + c)
    if length > even:
        return length, (sx * out[0] / length, sy * out[1] / length, sz * out[2] / length)
    if x >= y - even and x >= z - even:
        return x, (sx, 0.0, 0.0)
    if y >= z - even:
        return y, (0.0, sy, 0.0)
    return z, (0.0, 0.0, sz)


@njit(**BARE)
def _cylinder(p, radius, half):
    r = math.sqrt(p[0] * p[0] + p[1] * p[1])
    cx, cy = (p[0] / r, p[1] / r) if r > NO_SLOPE else (1.0, 0.0)
    sz = -1.0 if p[2] < 0.0 else 1.0
    x, z, even = r - radius, sz * p[2] - half, FIRST_FACE * (radius + half)
    if x > even and z > even:
        length = math.sqrt(x * x + z * z)
        return length, (cx * x / length, cy * x / length, sz * z / length)
    if x > z - even:
        return x, (cx, cy, 0.0)
    return z, (0.0, 0.0, sz)


@njit(**BARE)
def _cone(r, z, radius, half):
    """Distance of a point r from the axis, and its slope away from the axis and up."""
    slant = math.sqrt(radius * radius + 4.0 * half * half)
    x, z, sine, cosine = r - radius, z + half, radius / slant, 2.0 * half / slant  # from the rim
    side = cosine * x + sine * z
    if side <= 0.0 and z >= 0.0:
        return (side, cosine, sine) if side >= -z else (-z, 0.0, -1.0)
    along_side = min(max(cosine * z - sine * x, 0.0), slant)
    dx, dz, ex = x + sine * along_side, z - cosine * along_side, max(x, 0.0)
    d, e = math.sqrt(dx * dx + dz * dz), math.sqrt(ex * ex + z * z)
    if e < d:
        d, dx, dz = e, ex, z
    return (d, dx / d, dz / d) if d > FIRST_FACE * slant else (side, cosine, sine) if side > -z else (-z, 0.0, -1.0)


@njit(**INLINED)
def _grid(table, brick, sample, s, p):
    """Trilinear in the brick around p, or between the corners of bricks; outside the grid's box the distance to it is
    added."""
    corners, part, beyond = _around(table, brick, sample, s, p)
    d, slope = _trilinear(corners, part)
    length = norm(slope)
    normal = (0.0, 0.0, 1.0) if length < NO_SLOPE else scale(slope, 1.0 / length)
    far = dot(beyond, beyond)
    if far > 0.0:
        # The solid is within the box, which is convex, so it is at least this far away.
        d = max(d, 0.0)
        normal = along(beyond, normal, d)
        d = math.sqrt(far + d * d)
        normal = scale(normal, 1.0 / norm(normal))
    return d, normal


@njit(**BARE)
def _grid_alone(table, brick, sample, s, p):
    """The distance of `_grid` without the gradient."""
    corners, part, beyond = _around(table, brick, sample, s, p)
    d, _ = _trilinear(corners, part)
    far = dot(beyond, beyond)
    return d if far == 0.0 else math.sqrt(far + max(d, 0.0) ** 2)


@njit(**INLINED)
def _around(table, brick, sample, s, p):
    """The eight samples around p (or around the nearest point of the grid), the position between them, and the distance
    beyond the grid."""
    cell = table[s, CELL]
    nx, ny, nz = int(table[s, BRICKS]), int(table[s, BRICKS + 1]), int(table[s, BRICKS + 2])
    a = 1.0 / cell
    x, y, z = a * (p[0] - table[s, LOW]), a * (p[1] - table[s, LOW + 1]), a * (p[2] - table[s, LOW + 2])
    cx, cy, cz = min(max(x, 0.0), 8.0 * nx), min(max(y, 0.0), 8.0 * ny), min(max(z, 0.0), 8.0 * nz)
    beyond = ((x - cx) * cell, (y - cy) * cell, (z - cz) * cell)
    i, j, k = min(int(cx) >> 3, nx - 1), min(int(cy) >> 3, ny - 1), min(int(cz) >> 3, nz - 1)
    o = brick[int(table[s, BRICK]) + (i * ny + j) * nz + k]
    if o >= 0:
        u, v, w = cx - 8.0 * i, cy - 8.0 * j, cz - 8.0 * k
        i, j, k = min(int(u), 7), min(int(v), 7), min(int(w), 7)
        o += (i * 9 + j) * 9 + k
        e, f = 81, 9
    else:
        u, v, w = cx / 8.0, cy / 8.0, cz / 8.0
        o = int(table[s, COARSE]) + (i * (ny + 1) + j) * (nz + 1) + k
        e, f = (ny + 1) * (nz + 1), nz + 1
    corners = (
        np.float64(sample[o]), np.float64(sample[o + 1]), np.float64(sample[o + f]), np.float64(sample[o + f + 1]),
        np.float64(sample[o + e]), np.float64(sample[o + e + 1]), np.float64(sample[o + e + f]),
        np.float64(sample[o + e + f + 1]),
    )  # fmt: skip
    return corners, (u - i, v - j, w - k), beyond


@njit(**INLINED)
def _trilinear(corners, part):
    """The interpolant between eight corners, and its slope per cell."""
    a000, a001, a010, a011, a100, a101, a110, a111 = corners
    u, v, w = part
    a = a000 + w * (a001 - a000)
    b = a010 + w * (a011 - a010)
    c = a100 + w * (a101 - a100)
    d = a110 + w * (a111 - a110)
    ab = a + v * (b - a)
    cd = c + v * (d - c)
    z0 = (a001 - a000) + v * ((a011 - a010) - (a001 - a000))
    z1 = (a101 - a100) + v * ((a111 - a110) - (a101 - a100))
    return ab + u * (cd - ab), (cd - ab, (b - a) + u * ((d - c) - (b - a)), z0 + u * (z1 - z0))
