"""`centre: on` moves the origin of a mesh to its centre of mass."""

import logging

import numpy as np
import pytest

from sdfsim import load_scene
from sdfsim.base.errors import SceneError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape

FAR = np.array([300.0, -200.0, 40.0])


def scene_of(folder, more: str = "") -> Scene:
    block = primitives.box((0.2, 0.1, 0.3))
    (folder / "block.ply").write_bytes(write_ply(Mesh(block.vertices + FAR, block.faces)))
    shapes = f"{{it: {{mesh: block.ply, sdf: grid, resolution: 24{more}}}}}"
    bodies = "[{name: a, shape: it, position: [0, 0, 1], density: 500}]"
    (folder / "scene.yaml").write_text(f"version: 1\nshapes: {shapes}\nbodies: {bodies}\n")
    return load_scene(folder / "scene.yaml")


@pytest.mark.parametrize("more", ["", ", wall: 0.02", ", nodes: 12"])
def test_a_centred_mesh_is_where_its_body_is(tmp_path, more):
    scene = scene_of(tmp_path, f", centre: on{more}")
    shape, true = scene.shapes[0], analytic_shape("box", size=(0.2, 0.1, 0.3))
    assert shape.com == pytest.approx(np.zeros(3), abs=1e-12)
    np.testing.assert_allclose(shape.mesh.vertices.max(0), [0.1, 0.05, 0.15], atol=1e-4)
    np.testing.assert_allclose(np.abs(shape.nodes).max(0), [0.1, 0.05, 0.15], atol=2e-3)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    np.testing.assert_allclose(shape.sdf(points)[0], true.sdf(points)[0], atol=5e-3)
    if not more:
        np.testing.assert_allclose(shape.inertia, true.inertia, rtol=1e-3, atol=1e-8)
    assert not scene.notes


def test_an_origin_far_off_is_told(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        scene = scene_of(tmp_path)
    (told,) = scene.notes
    assert told.startswith("it: it lies ") and "centre: on moves it to the centre of mass" in told
    assert f"{np.linalg.norm(FAR):.3g} m from its origin" in told
    assert scene.shapes[0].com == pytest.approx(FAR)


def test_a_closed_form_is_about_its_centre_anyway(load):
    text = "version: 1\nshapes: {it: {sphere: {radius: 1}, centre: on}}\nbodies: [{name: a, shape: it}]\n"
    with pytest.raises(SceneError, match="centre: is for asset, mesh, primitive only"):
        load(text)
