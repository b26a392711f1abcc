"""Rotations as unit quaternions (xyzw) in torch, for networks: batched over leading dimensions, in the dtype of the
input. `sdfsim.physics.pose` is the same in NumPy, and has more."""

import torch
from torch import Tensor


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product `a b` of [..., 4] quaternions: first turn by `b`, then by `a`."""
    av, aw = a[..., :3], a[..., 3:]
    bv, bw = b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([vector, aw * bw - (av * bv).sum(-1, keepdim=True)], -1)


def conjugate(q: Tensor) -> Tensor:
    """The inverse rotation of a unit quaternion [..., 4]."""
    return torch.cat([-q[..., :3], q[..., 3:]], -1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors `v` [..., 3] turned by `q` [..., 4]."""
    t = 2.0 * torch.linalg.cross(q[..., :3], v)
    return v + q[..., 3:] * t + torch.linalg.cross(q[..., :3], t)


def apply(m: Tensor, v: Tensor) -> Tensor:
    """Products [..., 3] of matrices [..., 3, 3] and vectors [..., 3]."""
    return (m @ v[..., None])[..., 0]


def to_matrix(q: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    axes = torch.eye(3, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], 3, 3)
    return rotate(q[..., None, :], axes).mT


def to_rotvec(q: Tensor) -> Tensor:
    """Rotation vectors [..., 3] rad, at most half a turn, of unit quaternions [..., 4]."""
    q = torch.where(q[..., 3:] < 0, -q, q)
    s = q[..., :3].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(s, q[..., 3:])
    tiny = s < 1e-12
    return torch.where(tiny, 2.0 * q[..., :3], q[..., :3] * (angle / s.clamp_min(1e-30)))
