"""The protocol of signed distances, and decorators that let them take NumPy arrays or tensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    import torch
else:
    from sdfsim.base.lazy import torch


@runtime_checkable
class Sdf(Protocol):
    """A signed distance with its gradient: positive outside, negative inside, metres, the shape's own frame.

    The implementations `MlpSdf`, the closed forms, `GridSdf` and `MeshSdf` also have `to(device)` and `scaled(factor)`.

    Attributes:
        bounds: [2, 3] float64 m, the axis-aligned box that holds the solid (infinite for a plane).
    """

    @property
    def bounds(self) -> np.ndarray: ...

    def __call__(self, points: Any, /) -> tuple[Any, Any]:
        """Distance [P] m and gradient [P, 3] (unit length where the SDF is exact) at `points` [P, 3] m.

        The result has the dtype and device of `points`. Never NaN: where the gradient is undefined (medial axis, an
        edge) any valid one-sided gradient is returned. The implementations also take a NumPy array, and then return
        NumPy arrays.
        """
        ...


def accepts_numpy(call: Callable[..., tuple[torch.Tensor, torch.Tensor]]) -> Callable[..., tuple[Any, Any]]:
    """Let an Sdf's `__call__` also take anything that converts to a NumPy array [P, 3] (integers become float64), and
    then return NumPy arrays. Raises ValueError for other shapes."""

    @wraps(call)
    def wrapper(self: Any, points: Any) -> tuple[Any, Any]:
        given = _checked(points)
        if isinstance(given, torch.Tensor):
            return call(self, given)
        tensor = torch.from_numpy(np.ascontiguousarray(given)).to(getattr(self, "device", "cpu"))
        distance, gradient = call(self, tensor)
        return distance.cpu().numpy(), gradient.cpu().numpy()

    return wrapper


def accepts_tensors(call: Callable[..., tuple[np.ndarray, np.ndarray]]) -> Callable[..., tuple[Any, Any]]:
    """The same for an Sdf that computes in NumPy: it also takes a tensor, and then returns tensors."""

    @wraps(call)
    def wrapper(self: Any, points: Any) -> tuple[Any, Any]:
        given = _checked(points)
        if isinstance(given, np.ndarray):
            return call(self, given)
        distance, gradient = call(self, given.detach().cpu().numpy())
        return torch.from_numpy(distance).to(given), torch.from_numpy(gradient).to(given)

    return wrapper


def _checked(points: Any) -> Any:
    given = points if hasattr(points, "detach") else np.asarray(points)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ValueError(f"points must be [P, 3], got {list(given.shape)}")
    whole = isinstance(given, np.ndarray) and not np.issubdtype(given.dtype, np.floating)
    return given.astype(np.float64) if whole else given
