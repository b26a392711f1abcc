"""Compiled work of stereo per pixel: sweeps of planes, and the comparison of depth between photos.

Inverse depth is along the optical axis. Pixel centres are at whole numbers here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

NOISE = 4.0  # grey levels squared: variance of noise
NOTHING = -1.0  # score if no other photo shows a place


@njit(cache=True, nogil=True, fastmath=True)
def _warp(other: Any, turn: Any, shift: Any, base: Any, offset: Any, y: int, found: Any, inside: Any) -> None:
    """Writes the grey of another photo [h, w] at the points of row `y`, with inverse depth `base` [H, W] + `offset`, to
    `found` [W], and whether that photo shows them to `inside` [W]. A pixel (x, y) at inverse depth d lies at turn (x,
    y, 1) + d shift in homogeneous pixels of the other."""
    one, row, tiny = np.float32(1), np.float32(y), np.float32(1e-6)
    right, low = np.float32(other.shape[1] - 1.001), np.float32(other.shape[0] - 1.001)
    u0 = turn[0, 1] * row + turn[0, 2]
    v0 = turn[1, 1] * row + turn[1, 2]
    w0 = turn[2, 1] * row + turn[2, 2]
    for x in range(len(found)):
        column, depth = np.float32(x), base[y, x] + offset
        w = turn[2, 0] * column + w0 + depth * shift[2]
        inverse = one / max(w, tiny)
        u = (turn[0, 0] * column + u0 + depth * shift[0]) * inverse
        v = (turn[1, 0] * column + v0 + depth * shift[1]) * inverse
        a, b = min(max(u, np.float32(0)), right), min(max(v, np.float32(0)), low)
        inside[x] = (a == u) & (b == v) & (w > tiny) & (depth > np.float32(0))
        i, j = np.int32(a), np.int32(b)
        a, b = a - np.float32(i), b - np.float32(j)
        upper = other[j, i] + a * (other[j, i + 1] - other[j, i])
        lower = other[j + 1, i] + a * (other[j + 1, i + 1] - other[j + 1, i])
        found[x] = upper + b * (lower - upper)


@njit(cache=True, nogil=True, fastmath=True)
def _window(column: Any, half: int, total: Any) -> None:
    """Writes sums of `column` [W] over 2 half + 1 places to `total` [W - 2 half]."""
    for x in range(len(total)):
        total[x] = column[x]
    for k in range(1, 2 * half + 1):
        for x in range(len(total)):
            total[x] += column[x + k]


@njit(cache=True, nogil=True, fastmath=True)
def _alike(grey: Any, spread: Any, mean: Any, other: Any, turn: Any, shift: Any, base: Any, offset: Any, half: int,
           found: Any, inside: Any, score: Any) -> None:  # fmt: skip
    """Writes the correlation of windows around each pixel with another photo to `score` [H, W]. `mean` and `spread`
    [H, W] are those of the windows of `grey` [H, W] itself; `found` and `inside` [H, W] are work arrays."""
    rows, columns = grey.shape
    size = 2 * half + 1
    share, noise = np.float32(1 / size**2), np.float32(NOISE * size**2)
    one, two, both = np.zeros(columns, np.float32), np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    sum1, sum2 = np.empty(columns - size + 1, np.float32), np.empty(columns - size + 1, np.float32)
    sum12 = np.empty(columns - size + 1, np.float32)
    for y in range(rows):
        _warp(other, turn, shift, base, offset, y, found[y], inside[y])
        for x in range(columns):
            value = found[y, x]
            one[x] += value
            two[x] += value * value
            both[x] += value * grey[y, x]
        if y >= size:
            for x in range(columns):
                value = found[y - size, x]
                one[x] -= value
                two[x] -= value * value
                both[x] -= value * grey[y - size, x]
        if y >= size - 1:
            _window(one, half, sum1)
            _window(two, half, sum2)
            _window(both, half, sum12)
            middle = y - half
            for k in range(len(sum1)):
                x = k + half
                others = max(sum2[k] - sum1[k] * sum1[k] * share, np.float32(0)) + noise
                alike = (sum12[k] - sum1[k] * mean[middle, x]) / np.sqrt(others * spread[middle, x])
                score[middle, x] = alike if inside[middle, x] else np.float32(NOTHING)


@njit(cache=True, nogil=True, fastmath=True)
def _own(grey: Any, half: int) -> Any:
    """Mean and spread [H, W] of the windows of a photo itself, for `_alike`."""
    rows, columns = grey.shape
    size = 2 * half + 1
    mean, spread = np.zeros_like(grey), np.ones_like(grey)
    for y in range(half, rows - half):
        for x in range(half, columns - half):
            total, square = np.float32(0), np.float32(0)
            for j in range(y - half, y + half + 1):
                for i in range(x - half, x + half + 1):
                    total += grey[j, i]
                    square += grey[j, i] * grey[j, i]
            mean[y, x] = total / np.float32(size**2)
            spread[y, x] = max(square - total * mean[y, x], np.float32(0)) + np.float32(NOISE * size**2)
    return mean, spread


@njit(cache=True, nogil=True, fastmath=True)
def sweep(grey: Any, others: Any, sizes: Any, turns: Any, shifts: Any, base: Any, offsets: Any, half: int) -> Any:
    """Inverse depth [H, W] of the best of `offsets` [D] (evenly spaced) + `base` [H, W], and its score [H, W].

    The score is the mean correlation of windows with the two of the other photos [N, h, w] that agree best, so that an
    occlusion in one or two of them does no harm. `sizes` [N, 2] are their heights and widths, `turns` [N, 3, 3] and
    `shifts` [N, 3] map to their pixels, see `_warp`. All is float32, and grey levels have mean 0.
    """
    rows, columns = grey.shape
    mean, spread = _own(grey, half)
    found, inside = np.empty_like(grey), np.empty((rows, columns), np.bool_)
    score, first, second = np.full_like(grey, NOTHING), np.empty_like(grey), np.empty_like(grey)
    best, last = np.full_like(grey, 2 * NOTHING), np.full_like(grey, NOTHING)
    before, after = np.full_like(grey, NOTHING), np.full_like(grey, NOTHING)
    index, place = np.full((rows, columns), -9, np.int32), np.zeros_like(grey)
    for number in range(len(offsets)):
        first[:], second[:] = np.float32(NOTHING), np.float32(NOTHING)
        for n in range(len(others)):
            other = others[n, : sizes[n, 0], : sizes[n, 1]]
            _alike(grey, spread, mean, other, turns[n], shifts[n], base, offsets[number], half, found, inside, score)
            for y in range(rows):
                for x in range(columns):
                    second[y, x] = max(second[y, x], min(score[y, x], first[y, x]))
                    first[y, x] = max(first[y, x], score[y, x])
        for y in range(rows):
            for x in range(columns):
                here = np.float32(0.5) * (first[y, x] + second[y, x])
                if index[y, x] == number - 1:
                    after[y, x] = here
                if here > best[y, x]:
                    best[y, x], index[y, x], before[y, x], after[y, x] = here, number, last[y, x], np.float32(NOTHING)
                last[y, x] = here
    step = offsets[1] - offsets[0]
    for y in range(rows):
        for x in range(columns):
            bend = 2 * best[y, x] - before[y, x] - after[y, x]
            move = np.float32(0)
            if 0 < index[y, x] < len(offsets) - 1 and bend > 1e-6:
                move = np.float32(0.5) * (after[y, x] - before[y, x]) / bend
            place[y, x] = base[y, x] + offsets[index[y, x]] + step * min(max(move, np.float32(-0.5)), np.float32(0.5))
    return place, best


@njit(cache=True, nogil=True)
def agreeing(inverse: Any, others: Any, sizes: Any, turns: Any, shifts: Any, within: float) -> Any:
    """Number of other photos [H, W] uint8 with the same depth at the corresponding pixel: inverse depths [N, h, w] (0:
    none) that differ by less than a share `within`."""
    rows, columns = inverse.shape
    count = np.zeros((rows, columns), np.uint8)
    for n in range(len(others)):
        turn, shift = turns[n], shifts[n]
        for y in range(rows):
            for x in range(columns):
                depth = inverse[y, x]
                if depth <= 0:
                    continue
                w = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + depth * shift[2]
                if w <= 1e-6:
                    continue
                u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + depth * shift[0]) / w
                v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + depth * shift[1]) / w
                i, j = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
                if i < 0 or j < 0 or i >= sizes[n, 1] or j >= sizes[n, 0]:
                    continue
                # The place is w / depth away from the other camera, along its axis.
                if abs(others[n, j, i] * w / depth - 1) < within:
                    count[y, x] += 1
    return count


@njit(cache=True, nogil=True)
def paint(places: Any, colors: Any, inverse: Any, sizes: Any, trust: Any, lines: Any, within: float,
          total: Any, weight: Any) -> None:  # fmt: skip
    """Adds the colours of places [P, 3] in photos [N, h, w, 3] uint8 to sums [P, 3] and weights [P], if the places
    agree with the photos' depth maps to a distance `within`; the other arguments are those of `carve`."""
    for n in range(len(inverse)):
        line, height, width = lines[n], sizes[n, 0], sizes[n, 1]
        for p in range(len(places)):
            x, y, z = places[p, 0], places[p, 1], places[p, 2]
            depth = line[2, 0] * x + line[2, 1] * y + line[2, 2] * z + line[2, 3]
            if depth < 1e-6:
                continue
            u = (line[0, 0] * x + line[0, 1] * y + line[0, 2] * z + line[0, 3]) / depth
            v = (line[1, 0] * x + line[1, 1] * y + line[1, 2] * z + line[1, 3]) / depth
            if u < 0 or v < 0 or u >= width - 1 or v >= height - 1:
                continue
            there = inverse[n, int(v + 0.5), int(u + 0.5)]
            if there <= 0 or abs(1 / there - depth) > within:
                continue
            i, j = int(u), int(v)
            a, b = u - i, v - j
            # Near photos that look straight at a surface show more.
            share = (trust[n, int(v + 0.5), int(u + 0.5)] / depth) ** 2
            for c in range(3):
                low = colors[n, j, i, c] * (1 - a) + colors[n, j, i + 1, c] * a
                high = colors[n, j + 1, i, c] * (1 - a) + colors[n, j + 1, i + 1, c] * a
                total[p, c] += share * (low * (1 - b) + high * b)
            weight[p] += share


@njit(cache=True, nogil=True)
def carve(places: Any, inverse: Any, sizes: Any, slopes: Any, trust: Any, lines: Any, tilts: Any,
          back: float, total: Any, weight: Any, past: Any) -> None:  # fmt: skip
    """Adds the evidence of depth maps for places [P, 3] to the sums of distances and weights [P], and to the weights
    [P] of photos that see past a place.

    For the N photos `inverse` [N, h, w] is inverse depth (0: none), `slopes` [N, h, w, 2] its change from pixel to
    pixel, `tilts` [N, h, w] the distance from the surface's tangent plane per depth, and `trust` [N, h, w] a weight.
    `lines` [N, 3, 4] map places to homogeneous pixels. Distances count up to `back` in front of a surface, and with
    falling weight down to `back` behind it: farther behind is unknown.
    """
    for n in range(len(inverse)):
        line = lines[n]
        height, width = sizes[n, 0], sizes[n, 1]
        for p in range(len(places)):
            x, y, z = places[p, 0], places[p, 1], places[p, 2]
            depth = line[2, 0] * x + line[2, 1] * y + line[2, 2] * z + line[2, 3]
            if depth < 1e-6:
                continue
            u = (line[0, 0] * x + line[0, 1] * y + line[0, 2] * z + line[0, 3]) / depth
            v = (line[1, 0] * x + line[1, 1] * y + line[1, 2] * z + line[1, 3]) / depth
            i, j = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if i < 0 or j < 0 or i >= width or j >= height or inverse[n, j, i] <= 0:
                continue
            # Along a plane inverse depth is linear.
            there = inverse[n, j, i] + (u - i) * slopes[n, j, i, 0] + (v - j) * slopes[n, j, i, 1]
            if there <= 0:
                continue
            away = (1 / there - depth) * tilts[n, j, i]
            share = trust[n, j, i]
            if away > back:
                past[p] += share
            elif away > -back:
                share *= min(1, 1 + away / back)
                total[p] += share * away
                weight[p] += share
