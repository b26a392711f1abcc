"""Shape matching: the rigid motion that best explains displaced nodes (Müller et al., 2005; paper, section 3)."""

from __future__ import annotations

import torch
from torch import Tensor

from sdfsim.dynamics.pose import from_matrix


def match_shapes(rest: Tensor, moved: Tensor, owner: Tensor, bodies: int) -> tuple[Tensor, Tensor]:
    """Best rigid pose of every body from its nodes.

    Args:
        rest: [M, 3] nodes about each body's centre of mass, body axes.
        moved: [M, 3] where the network put them, world.
        owner: [M] int64.
        bodies: N.

    Returns:
        Position [N, 3] of the centres of mass and orientation [N, 4] xyzw. Always a proper rotation: a flat set of
        nodes leaves the reflection undecided and the sign of the smallest singular direction settles it.
    """

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros(bodies, *values.shape[1:], dtype=values.dtype, device=values.device)
        return total.index_add_(0, owner, values) / count.reshape(-1, *[1] * (values.dim() - 1))

    count = torch.zeros(bodies, dtype=rest.dtype, device=rest.device).index_add_(0, owner, torch.ones_like(rest[:, 0]))
    count = count.clamp_min(1.0)
    rest_mean, moved_mean = mean(rest), mean(moved)
    covariance = mean((moved - moved_mean[owner])[:, :, None] * (rest - rest_mean[owner])[:, None])
    u, _, vh = torch.linalg.svd(covariance)
    sign = torch.linalg.det(u @ vh)
    fix = torch.diag_embed(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1))
    rotation = u @ fix @ vh
    position = moved_mean - (rotation @ rest_mean[..., None])[..., 0]
    return position, from_matrix(rotation)
