"""Where a body is dropped, and the scene file that says so."""

import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import yaml

from pipeline.cameras import Similarity
from pipeline.materials import ASSUMED, MATERIALS, materials_of
from pipeline.mesh.placement import Placement
from pipeline.mesh.visibility import heights
from pipeline.scene_writer import (
    LEVEL,
    choose_slab,
    fit_parts,
    floor_height,
    onto,
    samples_of,
    scene_text,
    write_scene,
)
from sdfsim.base.files import write_json
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.scene.load import load_scene
from sdfsim.sdf.grid import GridSdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape, load_shape
from tests.helpers.surfaces import cube, plate, scenery

PLACEMENT = Placement(Similarity(1.0, np.eye(3), np.zeros(3)), "plane", "assumed: widest side = 1 m", size_assumed=True)


def terrain(height) -> Mesh:
    """The surface z = height(x, y) over [-0.5, 0.5]^2, 1 cm apart."""
    flat = plate(100)
    x, y, _ = flat.vertices.T
    return Mesh(np.stack([x, y, height(x, y)], -1), flat.faces)


def test_drop_lands_on_the_block():
    mesh = scenery()
    drop = choose_slab(mesh, mesh)
    x, y, z = drop.position
    assert abs(x - 0.1) < 0.3 - 0.5 * drop.side and abs(y) < 0.3 - 0.5 * drop.side
    assert drop.slope < 1 and 0.4 < z - 0.5 * drop.thickness < 0.5
    assert drop.side == pytest.approx(0.12, rel=0.01)
    assert np.isnan(heights(mesh, np.array([[5.0, 5]]))).all()


def test_a_level_step_is_preferred_to_a_higher_slope():
    hill = terrain(lambda x, y: 0.6 * np.maximum(-x, 0) + 0.3 * np.maximum(np.abs(x - 0.3) - 0.15, 0))
    drop = choose_slab(hill, hill)
    assert drop.slope < LEVEL and 0.1 < drop.position[0] < 0.5


def test_a_flat_place_is_preferred_to_a_bumpy_one_in_the_middle():
    """Bumps of 1.5 mm, on which a slab of 6 cm would rest on its corners."""
    rough = terrain(lambda x, y: np.where(x < 0.05, 0.0015 * np.sin(300 * x) * np.sin(290 * y), 0.0))
    assert choose_slab(rough, rough).position[0] > 0.05 + 0.03


def test_matter_that_no_photo_shows_is_not_landed_on():
    import trimesh

    floor = terrain(lambda x, y: np.zeros_like(x))
    box = trimesh.creation.box((0.3, 0.3, 0.3))
    hidden = Mesh(
        np.concatenate([floor.vertices, np.asarray(box.vertices)]),
        np.concatenate([floor.faces, np.asarray(box.faces, np.int64) + len(floor.vertices)]),
    )
    drop = choose_slab(floor, hidden)
    assert max(abs(drop.position[0]), abs(drop.position[1])) > 0.15 and drop.position[2] < 0.25


def test_scene_text_is_valid_yaml_with_gravity_down():
    mesh = scenery()
    text = scene_text(PLACEMENT, {}, choose_slab(mesh, mesh))
    data = yaml.safe_load(text)
    assert data["gravity"] == [0, 0, -9.81] and data["shapes"]["scenery"] == {"asset": "assets/scene"}
    assert "assumed: widest side = 1 m" in text and "confidence: high" in text and "--distance" in text
    known = replace(PLACEMENT, size_from="given: widest side = 2 m", size_assumed=False)
    assert "--distance" not in scene_text(known, {}, None)
    assert [body["name"] for body in data["bodies"]] == ["floor", "scenery", "box"]


def test_bodies_found_can_move():
    mesh = scenery()
    origins = {"object1": np.array([0.1, 0.2, 0.4])}
    data = yaml.safe_load(scene_text(PLACEMENT, origins, choose_slab(mesh, mesh), drop="ball"))
    body = {body["name"]: body for body in data["bodies"]}["object1"]
    assert body["position"] == [0.1, 0.2, 0.4] and body["density"] == ASSUMED.density and "motion" not in body
    assert data["shapes"]["object1"] == {"asset": "assets/object1"} and "sphere" in data["shapes"]["ball"]
    alone = yaml.safe_load(scene_text(PLACEMENT, origins, None, scenery=False))
    assert [body["name"] for body in alone["bodies"]] == ["floor", "object1"]


def save_meshes(folder):
    """A mesh folder: a floor with a block of 0.6 m, and a cube that was found on the floor."""
    parts = {"scenery": True, "cell": 0.02, "objects": [{"name": "object1"}]}
    (folder / "objects").mkdir()
    for name in ("solid.ply", "shown.ply"):
        (folder / name).write_bytes(write_ply(scenery()))
    (folder / "objects" / "object1.ply").write_bytes(write_ply(cube(0.2, (-0.6, 0.5, 0.1))))
    PLACEMENT.save(folder)
    write_json(folder / "parts.json", {"version": 1, **parts})
    return folder


@pytest.fixture
def meshes(tmp_path):
    return save_meshes(tmp_path)


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    """The shapes of the fit stage for these."""
    folder = save_meshes(tmp_path_factory.mktemp("shapes"))
    fit_parts(folder, folder / "assets", budget=None, sdf="grid")
    return folder / "assets"


@pytest.fixture
def fitted(meshes, shapes):
    """The same with the shapes of the fit stage beside it."""
    shutil.copytree(shapes, meshes / "assets")
    return meshes


def test_a_scene_file_changed_by_hand_is_kept(fitted):
    scene = fitted / "scene.yaml"
    first = write_scene(fitted, scene)
    again = write_scene(fitted, scene, written=first.scene_sha256, seed=3)
    assert again.notes == [] and not (fitted / "scene.yaml.bak").exists()
    for kept in ("scene.yaml.bak", "scene.yaml.bak2"):
        scene.write_text("mine\n")
        report = write_scene(fitted, scene, written=again.scene_sha256)
        assert (fitted / kept).read_text() == "mine\n" and kept in report.notes[0]
        assert yaml.safe_load(scene.read_text())["version"] == 1


@pytest.mark.parametrize(("deep", "told"), [(0.0015, "moved up by 0.0015 m, out of scenery"),
                                            (0.04, "more than the 0.03 m that photos cannot resolve")])  # fmt: skip
def test_a_body_that_photos_put_into_the_floor_starts_on_it(fitted, deep, told):
    """A cell is 2 cm wide; surfaces that touch are told apart to one and a half."""
    (fitted / "objects" / "object1.ply").write_bytes(write_ply(cube(0.2, (-0.6, 0.5, 0.1 - deep))))
    report = write_scene(fitted, fitted / "scene.yaml")
    text = (fitted / "scene.yaml").read_text()
    body = next(body for body in yaml.safe_load(text)["bodies"] if body["name"] == "object1")
    np.testing.assert_allclose(body["position"], [-0.6, 0.5, 0.0], atol=1e-4)
    assert report.moved["object1"]["by"] == pytest.approx([0, 0, deep], abs=1e-4)
    assert "scenery" in report.moved["object1"]["out_of"] and any(told in note for note in report.notes)
    assert f"  # moved up by {deep:.2g} m, out of " in text


def test_the_box_falls_onto_a_body_where_it_starts_not_where_it_was_found(fitted):
    """A cube without scenery that reaches 0.15 m below the floor: it is moved up first."""
    parts = {"version": 1, "scenery": False, "cell": 0.02, "objects": [{"name": "object1"}]}
    write_json(fitted / "parts.json", parts)
    (fitted / "objects" / "object1.ply").write_bytes(write_ply(cube(0.2, (0, 0, -0.05))))
    report = write_scene(fitted, fitted / "scene.yaml")
    assert list(report.moved) == ["object1"]
    assert report.moved["object1"]["by"] == pytest.approx([0, 0, 0.15], abs=1e-3)
    at = {body["name"]: body["position"] for body in yaml.safe_load((fitted / "scene.yaml").read_text())["bodies"][1:]}
    assert at["object1"][2] == pytest.approx(0.0, abs=1e-4)
    under = at["box"][2] - 0.5 * report.drop["thickness"]
    assert 0.2 < under < 0.2 + 0.5 * report.drop["side"]


def test_every_part_is_fitted_in_its_own_frame_and_kept_when_killed(meshes, tmp_path, monkeypatch):
    fits = []

    def fit_mesh(solid: Mesh, *, name: str, **options) -> Shape:
        fits.append((name, solid, options["budget"]))
        certificate = {
            "passed": name != "object1",
            "reason": "too thin" if name == "object1" else "",
            "caveat": "rough",
        }
        return replace(analytic_shape("box", size=(0.2, 0.2, 0.2), name=name), mesh=solid, certificate=certificate)

    monkeypatch.setattr("sdfsim.shape.make.fit_mesh", fit_mesh)
    out = tmp_path / "assets"
    out.mkdir()
    report = fit_parts(meshes, out, budget=30.0)
    assert [(name, budget) for name, _, budget in fits] == [("scenery", 20.0), ("object1", 10.0)]
    np.testing.assert_allclose(fits[1][1].vertices.min(0), [-0.1, -0.1, 0.0], atol=1e-6)
    assert not report.passed and report.reason == "object1: too thin"
    assert report.caveats == ["scenery: rough", "object1: rough"]
    assert sorted(path.name for path in out.iterdir()) == ["object1", "scene"]
    assert fit_parts(meshes, out, budget=30.0) == report and len(fits) == 2


@pytest.mark.parametrize("scale", [1e-4, 1e5])
@pytest.mark.parametrize("shape", ["box", "ball"])
def test_a_scene_of_any_size_that_is_allowed_is_the_same_scene(tmp_path, scale, shape):
    """Lengths are those of the scene of 1 m times its size, to six digits, and the file can be loaded."""
    mesh = scenery()
    place, size = choose_slab(mesh, mesh), 2 * scale
    drop = replace(place, side=place.side * size, thickness=place.thickness * size,
                   position=tuple(size * v for v in place.position))  # fmt: skip
    origins = {"object1": size * np.array([0.1, -0.2, 1e-3])}
    text = scene_text(PLACEMENT, origins, drop, scenery=False, drop=shape)
    data = yaml.safe_load(text)
    bodies = {body["name"]: body for body in data["bodies"]}
    np.testing.assert_allclose(bodies["object1"]["position"], size * np.array([0.1, -0.2, 1e-3]), atol=1e-5 * size)
    np.testing.assert_allclose(bodies[shape]["position"], drop.position, rtol=1e-5, atol=1e-5 * size)
    if shape == "box":
        wanted = (drop.side, drop.side, drop.thickness)
        np.testing.assert_allclose(data["shapes"]["box"]["box"]["size"], wanted, rtol=1e-5)
    else:
        assert data["shapes"]["ball"]["sphere"]["radius"] == pytest.approx(drop.thickness / 2, rel=1e-5)
    analytic_shape("box", size=3 * [0.1 * size], name="object1").save(tmp_path / "assets" / "object1")
    (tmp_path / "scene.yaml").write_text(text)
    assert [body.name for body in load_scene(tmp_path / "scene.yaml").bodies] == ["floor", "object1", shape]


def test_bodies_weigh_what_their_materials_do(fitted):
    """A cube of 0.2 m: solid, and with a wall of 20 mm around a hollow of 0.16 m."""
    scene, solid, hollow = fitted / "scene.yaml", 0.2**3, 0.2**3 - 0.16**3
    for given, density, volume in (
        ({}, 400, solid), ({"object1": "glass"}, 2500, solid), ({"object1": "glass:2cm"}, 2500, hollow),
    ):  # fmt: skip
        report = write_scene(fitted, scene, drop="none", materials=materials_of(given | {"scenery": "rubber"}))
        bodies = {body.name: body for body in load_scene(scene).bodies}
        assert bodies["object1"].mass == pytest.approx(density * volume, rel=0.01)
        told = report.bodies["object1"]
        assert told.mass == bodies["object1"].mass and told.density == pytest.approx(density)
        assert told.volume == pytest.approx(volume, rel=0.01)
        assert bodies["scenery"].friction == MATERIALS["rubber"].friction and report.bodies["scenery"].mass is None


def test_a_weighed_body_has_its_mass_whatever_its_material(fitted):
    scene = fitted / "scene.yaml"
    for material in ({}, {"object1": "glass:2cm"}):
        report = write_scene(fitted, scene, drop="none", materials=materials_of(material, {"object1": 0.35}))
        body = next(body for body in load_scene(scene).bodies if body.name == "object1")
        assert body.mass == 0.35 and report.bodies["object1"].weighed and "weighed; the rest is" in scene.read_text()


def test_the_scene_file_names_the_source_of_every_number_and_what_is_assumed(fitted):
    materials = materials_of({"object1": "ceramic:4mm", "floor": "wood"})
    write_scene(fitted, fitted / "scene.yaml", materials=materials)
    lines = [line.strip() for line in (fitted / "scene.yaml").read_text().splitlines()]
    above = {line.split(",")[0]: before for before, line in pairwise(lines) if line.startswith("- {name")}
    assert above["- {name: object1"].startswith("# ceramic, a wall of 4 mm. From: density: CRC Handbook")
    assert above["- {name: floor"].startswith("# wood. From: density: CRC Handbook")
    assert all(above[f"- {{name: {name}"].startswith("# assumed") for name in ("scenery", "box"))


def test_shapes_without_a_fit_are_samples_of_their_meshes(meshes, tmp_path):
    """A cube of 0.2 m about the middle of its base: two samples for each of the field's cells of 2 cm, at least 65."""
    report = fit_parts(meshes, tmp_path / "assets", budget=None, sdf="grid")
    assert report.passed and set(report.shapes) == {"scenery", "object1"}
    shape = load_shape(tmp_path / "assets" / "object1")
    assert isinstance(shape.sdf, GridSdf) and shape.sdf.resolution == 65
    cell = 1.4 * 0.2 / 64
    points = np.random.default_rng(0).uniform([-0.13, -0.13, -0.03], [0.13, 0.13, 0.23], (4000, 3))
    off = np.abs(points - np.array([0, 0, 0.1])) - 0.1
    true = np.linalg.norm(np.maximum(off, 0), axis=1) + np.minimum(off.max(1), 0)
    away = np.abs(np.asarray(shape.sdf(points)[0]) - true)
    assert away[np.abs(true) < cell].max() < 0.5 * cell and away.max() < 2 * cell
    assert shape.volume == pytest.approx(0.2**3, rel=1e-6) and len(shape.nodes)
    block = load_shape(tmp_path / "assets" / "scene")
    assert isinstance(block.sdf, GridSdf) and block.sdf.resolution == samples_of(scenery(), 0.02)


def sheet(height: float, side: float = 1.0) -> Mesh:
    """A level square."""
    corners = np.array([[-side, -side, height], [side, -side, height], [side, side, height], [-side, side, height]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_what_is_shown_of_a_scenery_lies_on_what_is_simulated(shapes):
    """Bumps of 4 mm on a level floor, of which the fit has nothing; a wall of which it has nothing either stays."""
    rough, fit = terrain(lambda x, y: 0.004 * np.sin(300 * x) * np.sin(290 * y)), load_shape(shapes / "scene").sdf
    wall = Mesh(np.array([[-0.4, 0.4, 0.1], [-0.3, 0.4, 0.1], [-0.3, 0.4, 0.4]]), np.array([[0, 1, 2]]))
    place = [0.0, 0.6, 0.0]  # beside the block of `scenery`
    shown = onto(fit, joined([replace(rough, vertices=0.5 * rough.vertices + place), wall]), 0.02)
    assert np.abs(shown.vertices[:-3, 2]).max() < 0.05e-3
    assert (np.abs(shown.vertices[:-3] - 0.5 * rough.vertices - place) < 0.0025).all()
    np.testing.assert_array_equal(shown.vertices[-3:], wall.vertices)


def test_the_added_floor_lies_below_a_level_surface_that_the_photos_show():
    assert floor_height(sheet(0.001)) == pytest.approx(-0.002)  # 0.1 % of 2 m
    assert floor_height(sheet(-0.004)) == pytest.approx(-0.006)
    # A table whose floor is not in the photos, and a scrap at its height.
    assert floor_height(sheet(0.3)) == 0.0
    assert floor_height(joined([sheet(0.3), sheet(0.0, 0.1)])) == 0.0
    text = scene_text(PLACEMENT, {}, None, floor=-0.002)
    assert "just below the floor that the photos show" in text
    plane = yaml.safe_load(text)["bodies"][0]["plane"]
    assert plane == {"normal": [0, 0, 1], "offset": -0.002}
