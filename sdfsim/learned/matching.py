"""Shape matching: the rigid motion that best explains displaced nodes (Müller et al., 2005), as SDF-Sim uses it."""

from __future__ import annotations

import torch
from torch import Tensor

from sdfsim.learned.pose import to_matrix

# Weight of staying at `start`, over the nodes' spread. Far below what any extent beyond rounding weighs, it decides
# only about turns that the nodes leave open.
STAY = 1e-12


def match_shapes(rest: Tensor, moved: Tensor, owner: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Best rigid pose of every body from its nodes: position [N, 3] of the centres of mass and orientation [N, 4] xyzw,
    on the same side as `start`; NaN for a body with a node that is not finite.

    Nodes were at `rest` [M, 3] about each body's centre of mass, body axes; the network `moved` them, [M, 3] world.
    Turns that the nodes leave open (about a line of them, any of a single one) stay as in `start` [N, 4].

    Of all rotations q the one with the largest sum of moved . (q rest) is the main eigenvector of a symmetric matrix of
    four rows (Horn, 1987). So it is a rotation whatever the nodes are: flat, mirrored by noise, all in one place.
    """
    bodies = len(start)

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros(bodies, *values.shape[1:], dtype=values.dtype, device=values.device)
        return total.index_add_(0, owner, values) / count.reshape(-1, *[1] * (values.dim() - 1))

    count = torch.zeros(bodies, dtype=rest.dtype, device=rest.device).index_add_(0, owner, torch.ones_like(rest[:, 0]))
    count = count.clamp_min(1.0)
    rest_mean, moved_mean = mean(rest), mean(moved)
    spread = mean((moved - moved_mean[owner])[:, :, None] * (rest - rest_mean[owner])[:, None])
    orientation, rotation = _main_turn(spread, start)
    position = moved_mean - (rotation @ rest_mean[..., None])[..., 0]
    return position, orientation


def _main_turn(spread: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternion [N, 4] and matrix [N, 3, 3] of the rotation nearest to `spread` [N, 3, 3] (moved times rest)."""
    a, before = spread.double(), start.double()
    known = a.isfinite().all(-1).all(-1)
    a = torch.where(known[:, None, None], a, 0.0)  # the decomposition of a NaN is an exception, for all bodies at once
    a = a / a.norm(dim=(-2, -1), keepdim=True).clamp_min(torch.finfo(a.dtype).tiny)
    trace = a.diagonal(dim1=-2, dim2=-1).sum(-1)
    curl = torch.stack([a[:, 2, 1] - a[:, 1, 2], a[:, 0, 2] - a[:, 2, 0], a[:, 1, 0] - a[:, 0, 1]], -1)
    even = a + a.mT - trace[:, None, None] * torch.eye(3, dtype=a.dtype, device=a.device)
    upper = torch.cat([even, curl[..., None]], -1)
    lower = torch.cat([curl, trace[:, None]], -1)[:, None]
    stay = STAY * before[:, :, None] * before[:, None]
    best = torch.linalg.eigh(torch.cat([upper, lower], -2) + stay).eigenvectors[..., -1]
    best = torch.where((best * before).sum(-1, keepdim=True) < 0, -best, best)
    best = torch.where(known[:, None], best, torch.nan).to(start.dtype)
    return best, to_matrix(best).to(spread.dtype)
