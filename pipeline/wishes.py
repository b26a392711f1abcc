"""What a person asks of the meshes of a reconstruction."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sdfsim.errors import SdfsimError


@dataclass(frozen=True)
class Known:
    """A distance that a person knows.

    Attributes:
        start: `photo.jpg:x,y`, the point of the surface that this pixel shows; or `photo.jpg`, the camera itself.
        end: likewise.
        metres: between them.
    """

    start: str
    end: str
    metres: float

    def check(self) -> None:
        """Raises SdfsimError where it makes no sense."""
        if not 1e-4 <= self.metres <= 1e5:
            raise SdfsimError(f"distance: must be between 0.0001 and 100000 m (got {self.metres:g})")
        if self.start == self.end:
            raise SdfsimError(f"distance: both ends are {self.start}", "give two places that are some way apart")


@dataclass(frozen=True)
class Wishes:
    """What a person asks of the meshes.

    Attributes:
        size: widest side of the visible surface, m.
        distance: a distance known in the scene; with it `size` is not used.
        crop: [2, 3] m corners of the box outside which all is cut off, in the axes of the result.
        keep: pieces to keep that would be left out, by name.
    """

    size: float | None = None
    distance: Known | None = None
    crop: np.ndarray | None = None
    keep: Collection[str] = ()
