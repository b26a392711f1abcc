"""What tests of several stages take: poses and sparse points that are made up."""

import numpy as np

from pipeline.cameras import PosedPhotos, Sparse


def sparse_of(points: np.ndarray, views: int = 0) -> Sparse:
    """Sparse points [P, 3], black, exact, and seen by so many views."""
    point_of, view_of = np.repeat(np.arange(len(points)), views), np.tile(np.arange(views), len(points))
    return Sparse(points, np.zeros((len(points), 3), np.uint8), np.zeros(len(points)), point_of, view_of)


NOTHING = PosedPhotos((), sparse_of(np.zeros((0, 3))))
