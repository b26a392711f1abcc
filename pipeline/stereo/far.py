"""The signed distance of what lies outside of the trained ball, from the depth maps of the photos.

The field describes the unit sphere only. Photos also show the floor, the walls and the furniture around it. Their depth
gives a coarse signed distance there, whose cells are as wide as a hundredth of the room. Everything here is in
normalised space.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.cameras import Similarity
from pipeline.stereo.depth import DepthMap
from pipeline.stereo.fusion import coarse_distance
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.base.parallel import Progress, silent

FILE = "surroundings.npz"  # in the folder of the field: the signed distance
SIDE = 96  # samples a side
FARTHEST = 10.0  # radii of the ball: what is farther away is not solid enough to be met
MOST = 0.98  # of the places outside of the ball lie within the sampled cube
LEAST = 0.02  # share of the photos' depth that lies outside: with less there is nothing to show
MARGIN = 1.02  # of the cube beyond them


@dataclass(frozen=True)
class Far:
    """Samples of the signed distance around the ball."""

    values: np.ndarray  # [SIDE, SIDE, SIDE] float32 (x, y, z)
    reach: float  # of the cube of the samples, to each side of the middle


def surrounding_distance(maps: Sequence[DepthMap], on_progress: Progress = silent) -> Far | None:
    """The signed distance outside of the ball, within the cube that holds nearly all that photos show there; None if
    they show hardly anything there."""
    away = np.linalg.norm(np.concatenate([one.points() for one in maps]), axis=1)
    if not len(away) or (away > 1).mean() < LEAST:
        return None
    reach = min(float(np.quantile(away[away > 1], MOST)), FARTHEST) * MARGIN
    shrink = Similarity(1 / reach, np.eye(3), np.zeros(3))
    # The same photos of a smaller world, which fits into the unit sphere.
    small = [replace(one, view=shrink.view(one.view), inverse=one.inverse * np.float32(reach)) for one in maps]
    coarse = coarse_distance(small, SIDE, on_progress)
    if coarse is None:
        return None
    return Far(reach * coarse.transpose(2, 1, 0), reach)


def save(far: Far, folder: Path) -> None:
    """Writes it to the folder of a field."""
    arrays = {"values": far.values.astype(np.float16), "reach": np.array(far.reach)}
    write_arrays(folder / FILE, arrays)


def load(folder: Path) -> Far | None:
    """The signed distance that the training has left; None if photos show nothing outside of the ball."""
    if not (folder / FILE).exists():
        return None
    kept = read_arrays(folder / FILE, "surroundings", "run the distill stage again")
    return Far(kept["values"].astype(np.float32), float(kept["reach"]))
