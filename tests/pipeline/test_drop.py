"""Where a body is dropped, and the scene file that says so."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from pipeline.drop import LEVEL, Above, choose_drop, plate_on
from pipeline.placement import Placement
from pipeline.scene_file import scene_text, write_scene
from sdfsim.files import write_json
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.storage import write_ply
from tests.pipeline.test_surface import scenery

PLACEMENT = Placement(1.0, np.eye(3), np.zeros(3), "plane", "assumed: widest side = 1 m")


def terrain(height) -> Mesh:
    """The surface z = height(x, y) over [-0.5, 0.5]^2, 1 cm apart."""
    line = np.linspace(-0.5, 0.5, 101)
    x, y = np.meshgrid(line, line, indexing="ij")
    corner = (np.arange(100)[:, None] * 101 + np.arange(100)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 101, 102], corner[:, None] + [0, 102, 1]])
    return Mesh(np.stack([x, y, height(x, y)], -1).reshape(-1, 3), faces)


def test_drop_lands_on_the_block():
    mesh = scenery()
    drop = choose_drop(mesh, mesh)
    x, y, z = drop.position
    assert abs(x - 0.1) < 0.3 - 0.5 * drop.side and abs(y) < 0.3 - 0.5 * drop.side
    assert drop.support == pytest.approx(0.4, abs=1e-3) and drop.slope < 1
    assert z - 0.5 * drop.thickness > drop.support
    assert drop.side == pytest.approx(0.18, rel=0.01)
    assert np.isnan(Above(mesh).heights(np.array([[5.0, 5]]))).all()


def test_a_plate_lies_on_the_rim_of_a_bowl_and_on_the_side_of_a_roof():
    line = np.linspace(-0.5, 0.5, 11)
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    height, normal, slope = plate_on(np.c_[x, y, x**2 + y**2], 1.0)
    assert height == pytest.approx(0.5) and normal[2] == pytest.approx(1.0) and slope < 1e-3
    height, _, slope = plate_on(np.c_[x, y, -np.abs(x)], 1.0)
    assert height == pytest.approx(0.0) and slope == pytest.approx(45.0)  # On a ridge it tips to a side.
    _, normal, slope = plate_on(np.c_[x, y, 0.1 * x], 1.0)
    assert slope == pytest.approx(np.degrees(np.arctan(0.1))) and normal[0] < 0


def test_a_level_step_is_preferred_to_a_higher_slope():
    hill = terrain(lambda x, y: 0.6 * np.maximum(-x, 0) + 0.3 * np.maximum(np.abs(x - 0.3) - 0.15, 0))
    drop = choose_drop(hill, hill)
    assert drop.slope < LEVEL and 0.1 < drop.position[0] < 0.5


def test_where_nothing_is_level_the_flattest_place_is_taken():
    dome = terrain(lambda x, y: -2.0 * (x - 0.2) - 1.0 * y)
    drop = choose_drop(dome, dome)
    assert drop.slope == pytest.approx(np.degrees(np.arctan(np.hypot(2, 1))), abs=0.5)
    turned = np.array(drop.quat_xyzw)
    assert np.linalg.norm(turned) == pytest.approx(1.0)
    x, y, z, w = turned
    up = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(up, np.array([2, 1, 1]) / np.sqrt(6), atol=1e-3)


def test_matter_that_no_photo_shows_is_not_landed_on():
    import trimesh

    floor = terrain(lambda x, y: np.zeros_like(x))
    box = trimesh.creation.box((0.3, 0.3, 0.3))
    hidden = Mesh(
        np.concatenate([floor.vertices, np.asarray(box.vertices)]),
        np.concatenate([floor.faces, np.asarray(box.faces, np.int64) + len(floor.vertices)]),
    )
    drop = choose_drop(floor, hidden)
    assert max(abs(drop.position[0]), abs(drop.position[1])) > 0.15 and drop.support == pytest.approx(0.0, abs=1e-6)


def test_scene_text_is_valid_yaml_with_gravity_down():
    mesh = scenery()
    text = scene_text(PLACEMENT, choose_drop(mesh, mesh))
    data = yaml.safe_load(text)
    assert data["gravity"] == [0, 0, -9.81] and data["shapes"]["scene"] == {"asset": "assets/scene"}
    assert "assumed: widest side = 1 m" in text


def test_a_scene_file_changed_by_hand_is_kept(tmp_path):
    for name in ("mesh.ply", "solid.ply"):
        (tmp_path / name).write_bytes(write_ply(scenery()))
    write_json(tmp_path / "placement.json", PLACEMENT.to_dict())
    scene = tmp_path / "scene.yaml"
    first = write_scene(tmp_path, scene)
    again = write_scene(tmp_path, scene, written=first["scene_sha256"], seed=3)
    assert again["notes"] == [] and not (tmp_path / "scene.yaml.bak").exists()
    for kept in ("scene.yaml.bak", "scene.yaml.bak2"):
        scene.write_text("mine\n")
        report = write_scene(tmp_path, scene, written=again["scene_sha256"])
        assert (tmp_path / kept).read_text() == "mine\n" and kept in report["notes"][0]
        assert yaml.safe_load(scene.read_text())["version"] == 1
