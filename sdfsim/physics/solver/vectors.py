"""Vectors as tuples of three numbers: compiled, they live in registers and cost no allocation."""

from __future__ import annotations

import math

from numba import njit

# For functions that Python calls. Options that are not given here would be taken from the first caller.
ENTRY = {
    "cache": True, "fastmath": {"contract", "arcp", "nsz"}, "error_model": "numpy", "forceinline": False,
    "no_cfunc_wrapper": True,
}  # fmt: skip
# For functions that only compiled code calls: an entry point for Python takes as long to compile as most of them.
FAST = {**ENTRY, "no_cpython_wrapper": True, "_nrt": True}
# Likewise, for functions that make no arrays: without this each would count the references of all arrays that it gets,
# which takes longer than the work of most of them.
BARE = {**FAST, "_nrt": False}
# Likewise, for functions that few places call very often: a call copies all members of all arrays.
INLINED = {**BARE, "forceinline": True}
# `inline="always"` is for functions that are called in one place: they become part of the caller before it is compiled.
# A function is compiled together with everything that it calls, and again as part of its own caller: the fewer levels
# there are, the less there is to compile.


@njit(**BARE)
def get(array, i):
    """Row i of [N, 3] as a vector."""
    return array[i, 0], array[i, 1], array[i, 2]


@njit(**BARE)
def vector(array):
    """An array of three numbers as a vector."""
    return array[0], array[1], array[2]


@njit(**BARE)
def three(row, column):
    """Three numbers of an array, from a column on, as a vector."""
    return row[column], row[column + 1], row[column + 2]


@njit(**BARE)
def put(array, i, v):
    """Write a vector to row i of [N, 3]."""
    array[i, 0] = v[0]
    array[i, 1] = v[1]
    array[i, 2] = v[2]


@njit(**BARE)
def add(a, b):
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(**BARE)
def sub(a, b):
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(**BARE)
def scale(a, k):
    """k a."""
    return k * a[0], k * a[1], k * a[2]


@njit(**BARE)
def along(a, b, k):
    """a + k b."""
    return a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]


@njit(**BARE)
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**BARE)
def cross(a, b):
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(**BARE)
def norm(a):
    """|a|."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@njit(**BARE)
def turn(m, i, v):
    """m[i] v for matrices m [N, 3, 3]."""
    return (
        m[i, 0, 0] * v[0] + m[i, 0, 1] * v[1] + m[i, 0, 2] * v[2],
        m[i, 1, 0] * v[0] + m[i, 1, 1] * v[1] + m[i, 1, 2] * v[2],
        m[i, 2, 0] * v[0] + m[i, 2, 1] * v[1] + m[i, 2, 2] * v[2],
    )


@njit(**BARE)
def turn_back(m, i, v):
    """The transpose of m[i] times v."""
    return (
        m[i, 0, 0] * v[0] + m[i, 1, 0] * v[1] + m[i, 2, 0] * v[2],
        m[i, 0, 1] * v[0] + m[i, 1, 1] * v[1] + m[i, 2, 1] * v[2],
        m[i, 0, 2] * v[0] + m[i, 1, 2] * v[1] + m[i, 2, 2] * v[2],
    )


@njit(**BARE)
def rotated_matrix(m, tensor, i, out):
    """Write the tensor [N, 3, 3] of body i in its own axes, turned by m[i], to `out` [3, 3]."""
    for x in range(3):
        for y in range(3):
            total = 0.0
            for u in range(3):
                for w in range(3):
                    total += m[i, x, u] * tensor[i, u, w] * m[i, y, w]
            out[x, y] = total


@njit(**BARE)
def to_matrix(q, i, out):
    """Write the rotation matrix of quaternion q[i] (xyzw) to out[i]."""
    x, y, z, w = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
    out[i, 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[i, 0, 1] = 2.0 * (x * y - w * z)
    out[i, 0, 2] = 2.0 * (x * z + w * y)
    out[i, 1, 0] = 2.0 * (x * y + w * z)
    out[i, 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[i, 1, 2] = 2.0 * (y * z - w * x)
    out[i, 2, 0] = 2.0 * (x * z - w * y)
    out[i, 2, 1] = 2.0 * (y * z + w * x)
    out[i, 2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(**BARE)
def rotated(q, i, v, way):
    """v turned by quaternion q[i] (xyzw); back for `way` -1."""
    u, w = scale(get(q, i), way), q[i, 3]
    t = scale(cross(u, v), 2.0)
    return add(along(v, t, w), cross(u, t))


@njit(**BARE)
def turned_by(r, q, i):
    """Quaternion (4 numbers, unit length) of q[i] turned by the rotation vector r."""
    angle = norm(r)
    half = 0.5 * angle
    s = 0.5 - half * half / 12.0 if half < 1e-4 else math.sin(half) / angle
    x, y, z, w = s * r[0], s * r[1], s * r[2], math.cos(half)
    a, b, c, d = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
    n0 = w * a + x * d + y * c - z * b
    n1 = w * b + y * d + z * a - x * c
    n2 = w * c + z * d + x * b - y * a
    n3 = w * d - x * a - y * b - z * c
    k = 1.0 / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)
    return n0 * k, n1 * k, n2 * k, n3 * k
