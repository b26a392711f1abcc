"""Scene files that are right become SI data."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.geometry.primitives import box
from sdfsim.scene.schema import reference
from tests.helpers.scene_files import HEAD, problems_of


def test_open_meshes_are_closed_as_the_file_says(load, tmp_path):
    cube = box((10.0, 20.0, 30.0))
    (tmp_path / "open.ply").write_bytes(write_ply(Mesh(cube.vertices, cube.faces[2:])))
    text = "version: 1\nshapes:\n  b: {mesh: open.ply, units: cm, sdf: mesh%s}\nbodies:\n  - {name: a, shape: b}\n"
    (problem,) = problems_of(load, text % "")
    assert "shapes.b" in problem and "open" in problem and "cap: on" in problem
    assert load(text % ", cap: on").shapes[0].volume == pytest.approx(0.1 * 0.2 * 0.3)
    # Two centimetres around the five sheets that are left: their outlines grow by one on either side.
    shell = load(text % ", thicken: 0.02").shapes[0]
    np.testing.assert_allclose(np.ptp(shell.sdf.bounds, axis=0), [0.12, 0.22, 0.32], atol=2e-3)
    assert 0.02 * 2 * (0.02 + 0.03 + 0.06) > shell.volume > 0.02 * (0.02 + 0.03 + 0.06)


def test_nodes_can_be_sampled_anew(load):
    text = "version: 1\nshapes:\n  b: {sphere: {radius: 0.2}%s}\nbodies:\n  - {name: a, shape: b}\n"
    counts = [len(load(text % key).shapes[0].nodes) for key in ("", ", nodes: 5", ", nodes: 7", ", nodes: 12")]
    assert counts[1] < counts[2] < counts[3] and counts[1] != counts[0]
    nodes = load(text % ", nodes: 7").shapes[0].nodes
    np.testing.assert_allclose(np.linalg.norm(nodes, axis=1), 0.2, rtol=1e-6)


def test_defaults_and_units(load):
    scene = load(HEAD + "  - {name: a, shape: ball, scale: 2}\n")
    body = scene.bodies[0]
    assert scene.duration == 4.0 and scene.seed == 0 and scene.model is None
    np.testing.assert_array_equal(scene.gravity, [0, 0, -9.81])
    assert body.motion == "dynamic" and body.friction == 0.5 and body.restitution == 0.5
    assert body.mass == pytest.approx(1000 * np.pi / 6 * 8, rel=0.01)  # 1000 kg/m^3 unless the file says otherwise
    assert body.collides_with is None


def test_numbers_are_read_from_their_text(load):
    scene = load(HEAD + "  - {name: a, shape: ball, mass: 1e-3, velocity: [+1, .5, 2.]}\n")
    assert scene.bodies[0].mass == 1e-3
    np.testing.assert_array_equal(scene.bodies[0].velocity, [1, 0.5, 2])


def test_the_three_ways_to_turn_a_body_agree(load):
    turn = Rotation.from_euler("xyz", [30, -40, 70], degrees=True)
    x, y, z, w = turn.as_quat()
    bodies = [f"quat_xyzw: [{x}, {y}, {z}, {w}]", f"quat_wxyz: [{2 * w}, {2 * x}, {2 * y}, {2 * z}]"]
    bodies.append("euler_xyz_deg: [30, -40, 70]")
    scene = load(HEAD + "".join(f"  - {{name: b{i}, shape: ball, {b}}}\n" for i, b in enumerate(bodies)))
    for body in scene.bodies:
        np.testing.assert_allclose(Rotation.from_quat(body.quat_xyzw).as_matrix(), turn.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -2], [1, 2, -3], [0, 1e-3, 0]])
def test_a_plane_has_its_pose_from_normal_and_offset(load, normal):
    scene = load(f"version: 1\nbodies:\n  - {{name: wall, plane: {{normal: {normal}, offset: 0.7}}}}\n")
    body, unit = scene.bodies[0], np.array(normal) / np.linalg.norm(normal)
    np.testing.assert_allclose(Rotation.from_quat(body.quat_xyzw).apply([0, 0, 1]), unit, atol=1e-12)
    assert body.position @ unit == pytest.approx(0.7)
    assert body.motion == "static" and body.mass == 0.0
    assert np.isinf(scene.shapes[body.shape].sdf.bounds).any()


def test_a_plane_does_not_move(load):
    bodies = "  - {name: a, plane: {}, motion: dynamic}\n  - {name: b, plane: {}, mass: 1}\n"
    first, second = problems_of(load, "version: 1\nbodies:\n" + bodies)
    assert first == "scene.yaml:3: bodies[0].motion: a plane must be static"
    assert second.startswith("scene.yaml:4: bodies[1].mass: cannot be given with plane")


def test_copies_fill_a_grid_from_the_bottom(load):
    scene = load(
        HEAD + "  - {name: b, shape: ball, count: 5, arrange: {grid: [2, 2, 2], spacing: 3}, position: [1, 0, 2]}\n"
        "  - {name: c, shape: ball, collides_with: [b]}\n"
    )
    assert [b.name for b in scene.bodies] == ["b[0]", "b[1]", "b[2]", "b[3]", "b[4]", "c"]
    np.testing.assert_allclose(scene.bodies[0].position, [-0.5, -1.5, 2])
    np.testing.assert_allclose(scene.bodies[1].position, [2.5, -1.5, 2])
    np.testing.assert_allclose(scene.bodies[4].position, [-0.5, -1.5, 5])
    assert scene.bodies[5].collides_with == ("b[0]", "b[1]", "b[2]", "b[3]", "b[4]")
    assert len(scene.shapes) == 1


def test_the_reference_of_keys_is_current():
    assert (Path(__file__).parents[2] / "docs" / "scene.md").read_text() == reference()
