"""Compiled work of refining: the grey levels of patches in photos. Pixel centres are at whole numbers here."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

NOISE = 4.0  # grey levels squared: variance that is no texture


@njit(cache=True, nogil=True, fastmath=True)
def read_patches(greys: Any, sizes: Any, cameras: Any, middles: Any, normals: Any, sides: Any, moves: Any,
                 numbers: Any, half: int, found: Any) -> None:  # fmt: skip
    """Writes the grey levels of patches, with mean 0 and length 1, to `found` [S, M, N, G].

    A patch has (2 half + 1)^2 = G points, `sides` [S, 2, 3] apart, around a middle [S, 3] that is moved by `moves` [M]
    along a normal [S, 3]. It is read in the photos with these `numbers` [N, S], -1 for none, of the grey photos
    `greys` [K, H, W] with `sizes` [K, 2]. A row of `cameras` [K, 16] has the rotation, row by row, and the translation
    to camera axes, the focal length and the optical axis in pixels, and the radial distortion.
    """
    count = (2 * half + 1) ** 2
    along = np.empty((4, 3))
    for s in range(len(middles)):
        for slot in range(len(numbers)):
            k = numbers[slot, s]
            if k < 0:
                continue
            camera, grey = cameras[k], greys[k]
            right, low = float(sizes[k, 1] - 1), float(sizes[k, 0] - 1)
            for c in range(3):
                x, y, z = camera[3 * c], camera[3 * c + 1], camera[3 * c + 2]
                along[0, c] = x * middles[s, 0] + y * middles[s, 1] + z * middles[s, 2] + camera[9 + c]
                along[1, c] = x * normals[s, 0] + y * normals[s, 1] + z * normals[s, 2]
                along[2, c] = x * sides[s, 0, 0] + y * sides[s, 0, 1] + z * sides[s, 0, 2]
                along[3, c] = x * sides[s, 1, 0] + y * sides[s, 1, 1] + z * sides[s, 1, 2]
            focal, cx, cy, bent = camera[12], camera[13], camera[14], camera[15]
            for m in range(len(moves)):
                total, square, g = 0.0, 0.0, 0
                for i in range(-half, half + 1):
                    for j in range(-half, half + 1):
                        depth = along[0, 2] + moves[m] * along[1, 2] + i * along[2, 2] + j * along[3, 2]
                        inverse = 1 / max(depth, 1e-12)
                        x = (along[0, 0] + moves[m] * along[1, 0] + i * along[2, 0] + j * along[3, 0]) * inverse
                        y = (along[0, 1] + moves[m] * along[1, 1] + i * along[2, 1] + j * along[3, 1]) * inverse
                        scale = focal * (1 + bent * (x * x + y * y))
                        u, v = min(max(scale * x + cx, 0.0), right), min(max(scale * y + cy, 0.0), low)
                        column, row = min(int(u), sizes[k, 1] - 2), min(int(v), sizes[k, 0] - 2)
                        a, b = u - column, v - row
                        upper = grey[row, column] + a * (grey[row, column + 1] - grey[row, column])
                        lower = grey[row + 1, column] + a * (grey[row + 1, column + 1] - grey[row + 1, column])
                        value = upper + b * (lower - upper)
                        found[s, m, slot, g] = value
                        total += value
                        square += value * value
                        g += 1
                mean = total / count
                length = 1 / np.sqrt(max(square - total * mean, 0.0) + NOISE * count)
                for g in range(count):
                    found[s, m, slot, g] = (found[s, m, slot, g] - mean) * length
