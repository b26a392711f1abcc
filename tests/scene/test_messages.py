"""What a scene file is told of its shapes: where they go, which resolution would do, and by which name they go."""

import logging

import numpy as np
import pytest

from sdfsim import load_scene
from sdfsim.base.errors import SceneError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.scene.builder import SceneBuilder


def write_box(path, size) -> None:
    path.write_bytes(write_ply(primitives.box(size)))


@pytest.mark.parametrize("entry", ["box: {size: [1, 1, 1]}", "mesh: a.obj", "sphere: {radius: 1}", "sdf: grid"])
def test_a_shape_in_a_body_is_told_where_it_goes(load, entry):
    with pytest.raises(SceneError) as error:
        load(f"version: 1\nbodies:\n  - name: a\n    {entry}\n")
    key = entry.partition(":")[0]
    (problem,) = error.value.problems
    assert f":4: bodies[0].{key}: belongs to a shape" in problem
    assert f"`shapes: {{NAME: {{{key}: ...}}}}`" in problem and "`shape: NAME`" in problem


@pytest.mark.parametrize(
    ("size", "grid"), [((0.085, 0.054, 0.0008), 64), ((0.3, 0.2, 0.004), 32), ((1, 0.1, 0.01), 48)]
)
def test_the_resolution_that_is_said_for_a_thin_card_does(tmp_path, size, grid):
    write_box(tmp_path / "card.ply", size)
    shape = "{{mesh: card.ply, sdf: grid, resolution: {0}}}"
    text = f"version: 1\nshapes: {{{{card: {shape}}}}}\nbodies: [{{{{name: a, shape: card}}}}]\n"
    file = tmp_path / "scene.yaml"
    file.write_text(text.format(grid))
    with pytest.raises(SceneError, match="no surface nodes: walls of about") as error:
        load_scene(file)
    said = int(str(error.value).partition("give resolution: ")[2].partition(",")[0])
    assert said == pytest.approx(2 * size[0] / size[2], rel=0.25)
    file.write_text(text.format(said))
    scene = load_scene(file)
    np.testing.assert_allclose(np.ptp(scene.shapes[0].nodes, axis=0)[:2], size[:2], rtol=0.05)


def test_a_card_that_is_too_thin_for_any_grid_is_told_so(tmp_path):
    write_box(tmp_path / "card.ply", (1, 1, 0.0005))
    shape = "{mesh: card.ply, sdf: grid}"
    (tmp_path / "scene.yaml").write_text(f"version: 1\nshapes: {{card: {shape}}}\nbodies: [{{name: a, shape: card}}]\n")
    with pytest.raises(SceneError, match="give sdf: mesh, which has none"):
        load_scene(tmp_path / "scene.yaml")


@pytest.mark.parametrize(
    ("scales", "told"),
    [((0.014,), False), ((1.0,), True), ((0.014, 1.0), True), ((0.00001,), True), ((0.1, 0.2), False)],
)
def test_units_are_hinted_at_only_if_a_body_has_an_odd_size(tmp_path, scales, told):
    write_box(tmp_path / "block.ply", (10.4, 8.0, 6.0))
    bodies = ", ".join(f"{{name: b{k}, shape: it, scale: {scale}}}" for k, scale in enumerate(scales))
    (tmp_path / "scene.yaml").write_text(
        f"version: 1\nshapes: {{it: {{mesh: block.ply, sdf: mesh}}}}\nbodies: [{bodies}]\n"
    )
    notes = load_scene(tmp_path / "scene.yaml").notes
    assert any("--units" in note for note in notes) == told


def test_a_shape_that_is_made_goes_by_the_name_of_its_body(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    scene = SceneBuilder()
    for k, name in enumerate(("cup", "mug")):
        (tmp_path / name).mkdir()
        box = primitives.box((0.1 + 0.01 * k, 0.1, 0.1))
        (tmp_path / name / "reoriented.ply").write_bytes(write_ply(Mesh(box.vertices, box.faces)))
        scene.add(name, mesh=tmp_path / name / "reoriented.ply", sdf="grid", resolution=16)
    with caplog.at_level(logging.WARNING):
        scene.load()
        scene.load()
    made = [line for line in caplog.messages if line.startswith("making the shape")]
    assert [line.split()[3] for line in made] == ["cup,", "mug,"]
