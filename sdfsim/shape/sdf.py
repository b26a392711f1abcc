"""The signed-distance protocol that every shape's geometry speaks."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import torch


@runtime_checkable
class Sdf(Protocol):
    """A signed distance with its gradient: positive outside, negative inside, metres, the shape's own frame.

    Attributes:
        bounds: [2, 3] float64 m, the axis-aligned box that holds the solid (infinite for a plane).
    """

    bounds: np.ndarray

    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] (unit length where the SDF is exact) at `points` [P, 3] m.

        The result has the dtype and device of `points`. Never NaN: where the gradient is undefined
        (medial axis, an edge) any valid one-sided gradient is returned.
        """
        ...
