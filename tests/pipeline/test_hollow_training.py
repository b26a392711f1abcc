"""A cup and a crate from photos: training starts from fused depth, and hollows that photos see into stay."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.field import training
from pipeline.field.grid_field import FieldSize
from pipeline.field.training import PRESETS, train
from pipeline.inputs.photos import save_photos
from tests.helpers.balls import Distance, crate, cup, ring, shoot
from tests.helpers.photos import photo

SIZE = FieldSize((8, 16, 32, 56), (2, 2, 2, 2), 32, 16, finer_channels=(2,))


@dataclass(frozen=True)
class Hollow:
    """A hollow thing that stands on the ground, about the z axis."""

    distance: Distance
    wide: float  # m, from the axis to its farthest outside
    inside: float  # m, from the axis, where its floor is looked at
    height: float  # m, of its rim
    depth: float  # m, halfway up its wall from its rim down: where the wall is looked at


HOLLOWS = {
    "cup": Hollow(cup(0.3, 0.07, 0.38, 0.5), 0.3, 0.1, 0.5, 0.19),
    "crate": Hollow(crate((0.7, 0.5), 0.08, 0.3, 0.4), 0.44, 0.12, 0.4, 0.15),
}


@dataclass(frozen=True)
class Made:
    """A hollow thing, and the field that its photos gave."""

    of: Hollow
    found: training.Trained

    def distance(self, points: np.ndarray) -> np.ndarray:
        """The field's [...] at points [..., 3] m, in normalised units."""
        local = self.found.to_unit.points(points.reshape(-1, 3))
        with torch.no_grad():
            return self.found.field.sdf(torch.tensor(local, dtype=torch.float32)).numpy().reshape(points.shape[:-1])


@pytest.fixture(scope="module", params=["cup", pytest.param("crate", marks=pytest.mark.slow)])
def made(request, tmp_path_factory) -> Made:
    hollow = HOLLOWS[request.param]
    folder: Path = tmp_path_factory.mktemp(request.param)
    rings = [(8, 25), (8, 45), (8, 68)]
    middle = (0.0, 0.0, hollow.height / 2)
    views = [view for k, (count, up) in enumerate(rings)
             for view in ring(count, 2.2, up, 200, 150, 260.0, middle, start=k * 8 + k)]  # fmt: skip
    views = [replace(view, name=f"{n:03d}.png") for n, view in enumerate(views)]
    poses = shoot(views, hollow.distance, folder)
    save_photos([replace(photo(k, 200, 150), name=view.name) for k, view in enumerate(views)], folder)
    settings = replace(
        PRESETS["quick"], size=SIZE, rays=256, samples=24, iterations=150, surface_points=128, long_side=200, stereo=200
    )
    return Made(hollow, train(poses, folder, folder, settings=settings, threads=1))


def around(count: int, start: float = 0.0) -> np.ndarray:
    """Directions [count, 2] about the z axis."""
    turn = start + np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn)], 1)


def tops(distance: Distance, at: np.ndarray, height: float) -> np.ndarray:
    """Height [P] m at which a line straight down from above meets the surface at places [P, 2]."""
    heights = np.linspace(height + 0.1, -0.1, 400)
    points = np.concatenate([np.repeat(at, len(heights), 0), np.tile(heights, len(at))[:, None]], 1)
    return heights[(distance(points).reshape(len(at), -1) < 0).argmax(1)]


def thickness(distance: Distance, hollow: Hollow) -> np.ndarray:
    """Widths [12] m of its wall along level lines from its axis."""
    away = np.linspace(0, hollow.wide + 0.1, 400)
    flat = (around(12, 0.1)[:, None] * away[:, None]).reshape(-1, 2)
    points = np.concatenate([flat, np.full((len(flat), 1), hollow.height - hollow.depth)], 1)
    return (distance(points).reshape(12, -1) < 0).sum(1) * (away[1] - away[0])


def test_a_hollow_is_as_deep_as_photos_see(made):
    """Within a tenth of its depth; the ground beside it is where it should be too."""
    assert made.found.report["stereo"]["fused"]
    hollow, places = made.of, np.concatenate([0.4 * made.of.inside * around(8), made.of.inside * around(8)])
    deep, wanted = (hollow.height - tops(one, places, hollow.height) for one in (made.distance, hollow.distance))
    assert np.median(np.abs(deep / wanted - 1)) < 0.1
    assert np.abs(tops(made.distance, (hollow.wide + 0.15) * around(8), hollow.height)).max() < 0.02


def test_a_rim_is_as_high_as_it_is(made):
    hollow = made.of
    away = np.linspace(0, hollow.wide, 100)
    places = (around(12, 0.1)[:, None] * away[:, None]).reshape(-1, 2)
    found, wanted = (tops(one, places, hollow.height) for one in (made.distance, hollow.distance))
    assert np.median(found[wanted > hollow.height - 0.01]) == pytest.approx(hollow.height, abs=0.02)


def test_walls_are_as_thick_as_they_are(made):
    """Halfway down, where photos see both sides."""
    found, wanted = (thickness(one, made.of) for one in (made.distance, made.of.distance))
    assert np.median(np.abs(found / wanted - 1)) < 0.3
