"""Where a fit looks: points around a solid, with what is true there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sdfsim.shape.distance import DistanceOracle
from sdfsim.shape.far_field import BOX
from sdfsim.shape.fit import Plan
from sdfsim.shape.mesh import Frame, normal_frame, sample_surface

# Points are drawn from a little beyond the box that is used: at the very edge of its data a network's slope is poor.
MARGIN = 1.15
# A solid whose distances agree with their mirror images' to this, relative to its size, is fitted on one side only.
SAME = 1e-4
# A fit is checked on the way on this many points of three kinds: with these spreads around the surface, and in the box.
CHECKED = 4000
CHECKED_SIGMAS = (0.006, 0.06)


@dataclass(frozen=True)
class Pool:
    """Points of S shapes, P each, normalised.

    Attributes:
        points: [S, P, 3].
        distance: [S, P] signed.
        signed: [S, P] bool, whether the sign of the distance counts.
        direction: [S, P, 3] unit, from the surface outwards; zero on the surface itself.
    """

    points: torch.Tensor
    distance: torch.Tensor
    signed: torch.Tensor
    direction: torch.Tensor

    def rows(self, kept: torch.Tensor) -> Pool:
        """Those of the shapes `kept` [S'] only."""
        return Pool(self.points[kept], self.distance[kept], self.signed[kept], self.direction[kept])

    def to(self, device: torch.device) -> Pool:
        """The same on `device`."""
        return Pool(*(part.to(device) for part in (self.points, self.distance, self.signed, self.direction)))


def stack(pools: list[Pool]) -> Pool:
    """Pools of equal size as one."""
    return Pool(
        torch.cat([pool.points for pool in pools]),
        torch.cat([pool.distance for pool in pools]),
        torch.cat([pool.signed for pool in pools]),
        torch.cat([pool.direction for pool in pools]),
    )


class Subject:
    """One solid to be fitted: its frame, its mirror planes, and samples of it.

    Args:
        oracle: true distances, metres.
        plan: the recipe.
        seed: of the points.
    """

    def __init__(self, oracle: DistanceOracle, plan: Plan, seed: int) -> None:
        self.oracle, self._plan, self._seed = oracle, plan, seed
        self.frame = normal_frame(oracle.bounds)
        self.mirrors = _mirrors(oracle, self.frame) if plan.fold else (False, False, False)

    def pool(self, step: int = 0) -> Pool:
        """Points to learn from, of one shape, as drawn before update `step`."""
        plan = self._plan
        rng = np.random.default_rng([self._seed, 0, step] if step else [self._seed, 0])
        near = int(plan.pool * plan.near)
        low, high = np.log(plan.sigmas)
        sigma = np.exp(rng.uniform(low, high, (near, 1)))
        return self._sample(sigma, plan.pool - near, rng)

    def check(self) -> Pool:
        """Points to judge by on the way: `CHECKED` of each of three kinds."""
        sigma = np.repeat(CHECKED_SIGMAS, CHECKED)[:, None]
        return self._sample(sigma, CHECKED, np.random.default_rng([self._seed, 1]))

    def _sample(self, sigma: np.ndarray, elsewhere: int, rng: np.random.Generator) -> Pool:
        """Points with normal noise of `sigma` [N, 1] around the surface, then `elsewhere` points all over the box."""
        local = self.frame.inward(sample_surface(self.oracle.surface, len(sigma), rng)[0])
        around = local + sigma * rng.standard_normal((len(sigma), 3))
        local = np.concatenate([around, rng.uniform(-MARGIN * BOX, MARGIN * BOX, (elsewhere, 3))])
        local = np.clip(local, -MARGIN * BOX, MARGIN * BOX)
        truth = self.oracle(self.frame.outward(local))
        distance = truth.distance / self.frame.scale
        signed = truth.trusted | (self.oracle.closed and self._plan.sign_everywhere)
        # So close to the surface the direction from it is rounding.
        clear = np.abs(distance) > 1e-4
        offset = local - self.frame.inward(truth.closest)
        direction = np.where(clear[:, None], offset / np.where(clear, distance, 1.0)[:, None], 0.0)
        # What lies on the other side of a mirror plane is learned from its image.
        side = np.where(np.asarray(self.mirrors) & (local < 0), -1.0, 1.0)
        return Pool(
            torch.from_numpy(local * side).float()[None],
            torch.from_numpy(distance).float()[None],
            torch.from_numpy(signed)[None],
            torch.from_numpy(direction * side).float()[None],
        )


def _mirrors(oracle: DistanceOracle, frame: Frame) -> tuple[bool, bool, bool]:
    """Across which planes of its frame the solid is its own mirror image, as far as sampled distances tell."""
    rng = np.random.default_rng(0)
    local = frame.inward(sample_surface(oracle.surface, 2000, rng)[0])
    local = np.concatenate([local, local + rng.normal(0.0, 0.05, local.shape)])
    truth = oracle(frame.outward(local)).distance
    same = []
    for axis in range(3):
        image = local.copy()
        image[:, axis] *= -1.0
        same.append(bool(np.abs(oracle(frame.outward(image)).distance - truth).max() < SAME * frame.scale))
    return same[0], same[1], same[2]
