"""What photos do not show of a body is completed by its symmetry, and never against what they show."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.cameras import View
from pipeline.mesh.bodies import LevelPlane, emptied
from pipeline.mesh.extraction import sample_box
from pipeline.mesh.symmetry import MIRROR, REVOLUTION, Known, complete
from pipeline.mesh.trust import camera_at, evidence_of
from pipeline.mesh.visibility import Visibility
from sdfsim.geometry.bvh import Caster, ClosestPoint
from sdfsim.geometry.mesh import Mesh, signed_volume

CELL = 0.02
UP = np.array([0.0, 0.0, 1.0])
LENS = View("", "", 640, 480, 620.0, 320.0, 240.0, 0.0, np.eye(3), np.zeros(3))


def solid(distance) -> Mesh:
    """The mesh of a signed distance of points [P, 3] within half a metre around (0, 0, 0.3)."""
    return sample_box(distance, np.array([-0.5, -0.5, -0.1]), np.array([0.5, 0.5, 0.75]), CELL).mesh()


def box(points: np.ndarray, low: list[float], high: list[float]) -> np.ndarray:
    return np.maximum(np.array(low) - points, points - high).max(1)


def ring(count: int, first: float, last: float, height: float, away: float = 2.0) -> list[View]:
    """Cameras around the z axis, between two angles in degrees, at a height in m, that look at the middle."""
    angle = np.radians(np.linspace(first, last, count))
    places = np.stack([away * np.cos(angle), away * np.sin(angle), np.full(count, height)], 1)
    return [camera_at(place, np.array([0.0, 0.0, 0.25]), LENS) for place in places]


def known(mesh: Mesh, views: list[View]) -> Known:
    blocking = Caster(mesh)
    return Known(mesh, evidence_of(Visibility(mesh, 0.5 * CELL, blocking), views), views, blocking, CELL)


def inside(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    return ClosestPoint(mesh).odd(points)


FRONT = ring(14, -70, 70, 0.6) + ring(8, -60, 60, 1.2, 1.6)


def test_a_ball_whose_back_no_photo_shows_becomes_round():
    ball = lambda p: np.linalg.norm(p - [0, 0, 0.25], axis=1) - 0.25  # noqa: E731
    dented = solid(lambda p: np.maximum(ball(p), -0.15 - p[:, 0]))
    found = complete(known(dented, ring(14, -35, 35, 0.4) + ring(8, -30, 30, 1.0, 1.8)), UP)
    assert found is not None and found.symmetry.name == REVOLUTION
    right, before = 4 / 3 * np.pi * 0.25**3, signed_volume(dented)
    assert before < 0.96 * right and signed_volume(found.mesh) == pytest.approx(right, rel=0.03)
    assert 0.03 < found.guessed < 0.45


def test_the_belly_of_a_vase_that_no_photo_sees_is_as_thick_as_its_neck():
    """A jar, .2 m in radius with walls of 50 mm, whose neck of .09 m in radius hides all but the bottom's middle."""

    def outer(p: np.ndarray) -> np.ndarray:
        r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        belly = np.maximum(np.hypot(r, (z - 0.2) * 0.9) - 0.2, -z)
        neck = np.maximum(r - 0.14, np.maximum(z - 0.5, 0.2 - z))
        return np.minimum(belly, neck)

    def hollow(p: np.ndarray) -> np.ndarray:
        r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        belly = np.maximum(np.hypot(r, (z - 0.2) * 0.9) - 0.15, 0.05 - z)
        return np.minimum(belly, np.maximum(r - 0.09, np.maximum(0.2 - z, z - 0.6)))

    true = solid(lambda p: np.maximum(outer(p), -hollow(p)))
    views = ring(16, 0, 337, 0.7) + ring(16, 0, 337, 1.8, 1.2) + ring(5, 0, 200, 2.2, 0.35)
    whole = known(true, views)

    def carved(p: np.ndarray) -> np.ndarray:
        """What two photos do not see through stays solid."""
        value = np.maximum(outer(p), -hollow(p))
        index = np.flatnonzero((outer(p) < 0) & (value > 0))
        value[index[~whole.air(p[index])]] = -0.5 * CELL
        return value

    filled = solid(carved)
    found = complete(known(filled, views), UP)
    assert found is not None and found.symmetry.name == REVOLUTION
    points = np.random.default_rng(0).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.4], (20_000, 3))
    air = points[hollow(points) < -0.01]
    assert inside(filled, air).mean() > 0.15 and inside(found.mesh, air).mean() < 0.1
    right = signed_volume(true)
    assert signed_volume(filled) > 1.15 * right and signed_volume(found.mesh) == pytest.approx(right, rel=0.12)


def test_a_box_takes_its_back_from_its_front():
    right = 0.4 * 0.3 * 0.4
    bulged = solid(
        lambda p: np.minimum(
            box(p, [-0.2, -0.15, 0], [0.2, 0.15, 0.4]), np.linalg.norm(p - [-0.15, 0, 0.15], axis=1) - 0.12
        )
    )
    found = complete(known(bulged, FRONT), UP)
    assert found is not None and found.symmetry.name == MIRROR
    assert bulged.vertices[:, 0].min() < -0.25 and found.mesh.vertices[:, 0].min() > -0.2 - 0.5 * CELL
    assert signed_volume(found.mesh) == pytest.approx(right, rel=0.03)


@pytest.mark.parametrize("kind", ["corner", "wedge", "two"])
def test_a_body_without_symmetry_is_not_changed_where_photos_show_it(kind):
    shapes = {
        "corner": lambda p: np.minimum(
            box(p, [-0.3, -0.2, 0], [0.3, 0, 0.4]), box(p, [-0.3, -0.2, 0], [-0.1, 0.3, 0.25])
        ),
        "wedge": lambda p: np.maximum(box(p, [-0.3, -0.2, 0], [0.3, 0.2, 0.5]), (p @ [0.5, 0.3, 0.8]) - 0.25),
        "two": lambda p: np.minimum(
            np.linalg.norm(p - [0.1, 0.1, 0.2], axis=1) - 0.2, box(p, [-0.35, -0.3, 0], [0.0, 0.0, 0.3])
        ),
    }
    mesh = solid(shapes[kind])
    all_round = ring(20, 0, 342, 0.6) + ring(10, 0, 324, 1.6, 1.3)
    seen = known(mesh, all_round[:14] + all_round[20:26])
    found = complete(seen, UP)
    if found is not None:
        away = np.linalg.norm(mesh.vertices - ClosestPoint(found.mesh)(mesh.vertices)[0], axis=1)
        assert np.quantile(away[seen.seen], 0.95) < CELL


def test_a_handle_stays_and_gets_no_twin():
    """A cup that photos show from all sides but below: a body of revolution, if its handle were not there."""

    def cup(p: np.ndarray) -> np.ndarray:
        r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        wall = np.maximum(np.maximum(r - 0.2, np.maximum(-z, z - 0.4)), -np.maximum(r - 0.14, 0.06 - z))
        handle = np.hypot(np.hypot(p[:, 0] - 0.2, z - 0.2) - 0.11, p[:, 1]) - 0.035
        return np.minimum(wall, np.maximum(handle, 0.17 - p[:, 0]))

    mesh = solid(cup)
    found = complete(known(mesh, ring(20, 0, 342, 0.6) + ring(10, 0, 324, 1.6, 1.3)), UP)
    if found is not None:
        assert found.symmetry.name == MIRROR
        assert inside(found.mesh, np.array([[0.31, 0, 0.2]])).all()
        assert not inside(found.mesh, np.array([[-0.31, 0, 0.2], [0, 0.31, 0.2]])).any()


def test_a_body_that_photos_show_from_everywhere_stays_as_it_is():
    ball = solid(lambda p: np.linalg.norm(p - [0, 0, 0.25], axis=1) - 0.25)
    below = [camera_at(view.center * [1, 1, -1], np.array([0.0, 0, 0.25]), LENS) for view in ring(12, 0, 330, 1.5)]
    assert complete(known(ball, ring(16, 0, 337, 0.5) + ring(10, 0, 324, 1.8, 1.0) + below), UP) is None


def test_the_scenery_is_empty_where_a_completed_body_is():
    """A shard of the table stuck in a hole of the body's floor, which its completion has closed."""
    table = lambda p: np.maximum(p[:, 2], -0.08 - p[:, 2])  # noqa: E731
    shard = lambda p: box(p, [-0.05, -0.05, -0.02], [0.05, 0.05, 0.06])  # noqa: E731
    volume = sample_box(
        lambda p: np.minimum(table(p), shard(p)), np.array([-0.5, -0.5, -0.1]), np.array([0.5, 0.5, 0.5]), CELL
    )
    body = solid(lambda p: box(p, [-0.2, -0.2, 0.0], [0.2, 0.2, 0.3]))
    stands = SimpleNamespace(level=LevelPlane(UP, 0.0, 1.0))
    left = emptied(volume, [(stands, body)]).mesh()  # type: ignore[list-item]
    assert volume.mesh().vertices[:, 2].max() > 0.05 and left.vertices[:, 2].max() < 0.5 * CELL
    away = np.abs(volume.at(left.vertices))
    assert (away[np.abs(left.vertices[:, :2]).max(1) > 0.25] < 1e-3).all()
