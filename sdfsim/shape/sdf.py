"""The signed-distance protocol that every shape's geometry speaks."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch


@runtime_checkable
class Sdf(Protocol):
    """A signed distance with its gradient: positive outside, negative inside, metres, the shape's own frame.

    Its members: `MlpSdf` (a fitted network), the closed forms `PlaneSdf`, `SphereSdf`,
    `CapsuleSdf`, `CylinderSdf` and `BoxSdf`, `GridSdf` (samples)
    and `MeshSdf` (the exact mesh); `SdfBank` asks many of them at once.

    Attributes:
        bounds: [2, 3] float64 m, the axis-aligned box that holds the solid (infinite for a plane).
    """

    @property
    def bounds(self) -> np.ndarray: ...

    def __call__(self, points: Any, /) -> tuple[Any, Any]:
        """Distance [P] m and gradient [P, 3] (unit length where the SDF is exact) at `points` [P, 3] m.

        The result has the dtype and device of `points`. Never NaN: where the gradient is undefined
        (medial axis, an edge) any valid one-sided gradient is returned. The implementations of this
        package also take a NumPy array, or what makes one, and then return NumPy arrays.
        """
        ...


def accepts_numpy(call: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> Callable[..., tuple[Any, Any]]:
    """Let an Sdf's `__call__` also take what makes a NumPy array [P, 3], and then answer in NumPy of the same dtype.

    Whole numbers become float64. An object with a `device` attribute is evaluated there; the answer comes back to the
    host.

    Raises:
        ValueError: (from the wrapped call) `points` is not [P, 3].
    """

    @wraps(call)
    def wrapper(self: Any, points: Any) -> tuple[Any, Any]:
        given = points if isinstance(points, torch.Tensor) else np.asarray(points)
        if given.ndim != 2 or given.shape[1] != 3:
            raise ValueError(f"points must be [P, 3], got {list(given.shape)}")
        if isinstance(given, torch.Tensor):
            return call(self, given)
        if not np.issubdtype(given.dtype, np.floating):
            given = given.astype(np.float64)
        tensor = torch.from_numpy(np.ascontiguousarray(given)).to(getattr(self, "device", "cpu"))
        distance, gradient = call(self, tensor)
        return distance.cpu().numpy(), gradient.cpu().numpy()

    return wrapper
