"""What tests of several stages take: poses and sparse points that are made up."""

import numpy as np

from pipeline.cameras import PosedPhotos, Sparse


def sparse_of(points: np.ndarray) -> Sparse:
    """Sparse points [P, 3], black, exact, and seen by no view."""
    none = np.zeros(0, int)
    return Sparse(points, np.zeros((len(points), 3), np.uint8), np.zeros(len(points)), none, none)


NOTHING = PosedPhotos((), sparse_of(np.zeros((0, 3))))
