"""Rotations as unit quaternions (xyzw), batched over leading dimensions."""

import numpy as np


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of [..., 3] vectors; for the few of a scene twice as fast as NumPy's."""
    made = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        made[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return made


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product `a b` of [..., 4] quaternions: first turn by `b`, then by `a`."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + cross(av, bv)
    return np.concatenate([vector, aw * bw - (av * bv).sum(-1, keepdims=True)], -1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """The inverse rotation of a unit quaternion [..., 4]."""
    return q * (-1.0, -1.0, -1.0, 1.0)


def normalise(q: np.ndarray) -> np.ndarray:
    """The unit quaternion nearest to `q` [..., 4]."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors `v` [..., 3] turned by `q` [..., 4]."""
    t = 2.0 * cross(q[..., :3], v)
    return v + q[..., 3:] * t + cross(q[..., :3], t)


def to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    return np.ascontiguousarray(rotate(q[..., None, :], np.eye(3)).swapaxes(-1, -2))


def from_matrix(m: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotation matrices [..., 3, 3], by Bar-Itzhack's method: the eigenvector of the largest
    eigenvalue."""
    form = np.zeros((*m.shape[:-2], 4, 4))
    form[..., :3, :3] = m + m.swapaxes(-1, -2)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        form[..., i, i] = m[..., i, i] - m[..., j, j] - m[..., k, k]
        form[..., i, 3] = form[..., 3, i] = m[..., k, j] - m[..., j, k]
    form[..., 3, 3] = np.trace(m, axis1=-2, axis2=-1)
    return np.linalg.eigh(form)[1][..., -1]


def from_rotvec(r: np.ndarray) -> np.ndarray:
    """Unit quaternions of rotation vectors [..., 3] rad (axis times angle)."""
    half = 0.5 * np.linalg.norm(r, axis=-1, keepdims=True)
    # sinc(x) of NumPy is sin(pi x) / (pi x): smooth through zero.
    return np.concatenate([0.5 * np.sinc(half / np.pi) * r, np.cos(half)], -1)


def to_rotvec(q: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] rad, at most half a turn, of unit quaternions [..., 4]."""
    q = np.where(q[..., 3:] < 0, -q, q)
    s = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(s, q[..., 3:])
    return q[..., :3] * np.where(s < 1e-12, 2.0, angle / np.maximum(s, 1e-30))
