"""What a body covers of a picture, against many samples."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sdfsim import Camera, Scene
from sdfsim.apps.film.drawing import Look, _covered
from sdfsim.apps.film.eye import Eye
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh

CAMERA = Camera((0.4, -1.1, 0.6), look_at=(0, 0, 0), fov=45, width=320, height=240)
EYE = Eye(CAMERA.rotation, -CAMERA.rotation @ np.array(CAMERA.position), CAMERA.lens[0, 0], 320, 240, np.zeros((7, 0)))


def sampled(around: np.ndarray, high: int, wide: int, often: int = 40) -> np.ndarray:
    """[high, wide] shares of pixels in a convex polygon, by samples."""
    x, y = (np.arange(n * often) + 0.5 for n in (wide, high))
    at = np.stack(np.meshgrid(x, y), -1) / often
    begin, end = around, np.roll(around, -1, 0)
    way, off = end - begin, at[..., None, :] - begin
    side = way[:, 0] * off[..., 1] - way[:, 1] * off[..., 0]
    inside = (side >= 0).all(-1) | (side <= 0).all(-1)
    return inside.reshape(high, often, wide, often).mean((1, 3))


@pytest.mark.parametrize("flat", [1.0, 0.02, 0.004])
def test_the_share_of_pixels_that_a_polygon_covers(flat: float):
    """Slivers too: a face that is nearly seen from its side covers hardly anything."""
    rng = np.random.default_rng(0)
    for angle in (0.0, 0.3, np.pi / 2, 2.0):
        points = rng.uniform(-8, 8, (7, 2)) * [1.0, flat]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        points = points[ConvexHull(points).vertices] @ turn.T + [12.3, 9.7]
        found = _covered(points, 20, 24)
        x, y = points.T
        area = 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
        assert found.sum() == pytest.approx(area, rel=0.03)
        if flat == 1.0:
            assert np.abs(found - sampled(points, 20, 24)).max() < 0.1


def test_a_polygon_that_reaches_beyond_the_picture():
    points = np.array([[-5.0, -4.0], [30.0, -4.0], [30.0, 4.5], [-5.0, 4.5]])
    found = _covered(points, 10, 8)
    assert found[:4] == pytest.approx(1.0)
    assert found[4] == pytest.approx(0.5)
    assert not found[5:].any()


def test_a_mesh_covers_what_rays_hit(tmp_path):
    """A cup, whose inside is seen through its opening; by Open3D's rays."""
    import trimesh

    profile = np.array([(0, 0), (0.04, 0), (0.05, 0.1), (0.046, 0.1), (0.036, 0.004), (0, 0.004)])
    mesh = trimesh.creation.revolve(profile, sections=64)
    mesh.export(tmp_path / "cup.obj")
    scene = Scene(model="solver").add("floor", plane={}).add("cup", mesh=str(tmp_path / "cup.obj"), mass=0.3).load()
    look, turn = Look(scene, scene.bodies[1]), np.array([0.0, 0.0, 0.0, 1.0])
    at = look.window(EYE, look.com, turn, 6.0)
    found = look.cover(EYE, look.com, turn, at).sum(0)
    often = 8
    x, y = np.meshgrid(*((np.arange(n * often) + 0.5) / often for n in found.shape[::-1]))
    rays = EYE.rays(at.left + x, at.top + y).reshape(-1, 3) @ EYE.rotation
    begin = np.tile(CAMERA.position, (len(rays), 1))
    depth, *_ = Caster(Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))).cast(
        np.c_[begin, rays].astype(np.float32)
    )
    wanted = np.isfinite(depth).reshape(found.shape[0], often, found.shape[1], often).mean((1, 3))
    assert np.abs(found - wanted).max() < 0.3  # 16 places in a pixel
    assert np.abs(found - wanted).mean() < 0.01
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.005)
