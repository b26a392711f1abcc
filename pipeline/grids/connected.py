"""Connected parts of places in a grid."""

import numpy as np
from scipy import ndimage


def largest(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest connected part [X, Y, Z] bool of places [X, Y, Z] bool, and the number [X, Y, Z] of the part to which
    each belongs, 0 elsewhere. Places are connected along the axes."""
    part = np.zeros(places.shape, np.int32)
    ndimage.label(places, output=part)
    size = np.bincount(part.ravel())
    size[0] = 0
    return (part == np.argmax(size)) & places, part
