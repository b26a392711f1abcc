"""Shapes of a scene file: what is told of them, their centres, hollows and round forms, and SDFs of every kind."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sdfsim
from sdfsim import load_scene
from sdfsim.base.errors import SceneError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import wavefront, write_ply
from sdfsim.geometry.primitives import box
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import BoxSdf, CylinderSdf
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scene_files import problems_of


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


TURN, SHIFT = Rotation.from_euler("xyz", [90, 20, 0], degrees=True), np.array([0.02, 0.03, -0.01])


@pytest.fixture
def wheel(tmp_path):
    mesh = primitives.cylinder(0.1, 0.05, 32)
    file = tmp_path / "wheel.obj"
    file.write_text(wavefront([Mesh(TURN.apply(mesh.vertices) + SHIFT, mesh.faces)]))
    return file


def corners(scene, name: str, time: float | None = None) -> np.ndarray:
    """What is shown of a body, in the world."""
    body = scene.bodies[[b.name for b in scene.bodies].index(name)]
    turn, place = Rotation.from_quat(body.quat_xyzw), body.position
    if body.path is not None:
        turn, place = Rotation.from_quat(body.path.quat_xyzw[1]), body.path.position[1]
    return turn.apply(body.scale * scene.shapes[body.shape].shown.vertices) + place


def test_a_round_mesh_stays_where_it_is_placed(wheel) -> None:
    scenes = []
    for how in ("off", "auto"):
        made = SceneBuilder()
        pose = {"position": (0.1, 0.2, 1.0), "euler_xyz_deg": (10, 20, 30)}
        made.add("one", mesh=wheel, round=how, **pose, scale=2.0, count=2, arrange={"grid": (1, 1, 2), "spacing": 1})
        path = [{"time": 0, **pose}, {"time": 1, "position": (3, 2, 1), "euler_xyz_deg": (40, 0, 0)}]
        made.add("led", mesh=wheel, round=how, motion="kinematic", path=path)
        made.frame("hub", "one[1]", position=(0.1, 0, 0), euler_xyz_deg=(0, 0, 90))
        made.keyframe("up", bodies={"one[0]": {"position": (0, 0, 5), "euler_xyz_deg": (0, 90, 0)}})
        scenes.append(loaded(made))
    plain, exact = scenes
    assert isinstance(exact.shapes[0].sdf, CylinderSdf) and not isinstance(plain.shapes[0].sdf, CylinderSdf)
    assert "is a cylinder up to its facets (radius 0.1 m, height 0.05 m)" in exact.notes[0]
    for name in ("one[0]", "one[1]", "led"):
        one, other = corners(plain, name), corners(exact, name)
        order = [np.lexsort(np.round(places, 6).T) for places in (one, other)]
        np.testing.assert_allclose(one[order[0]], other[order[1]], atol=1e-6)
    masses = [[body.mass for body in scene.bodies] for scene in scenes]
    np.testing.assert_allclose(*masses, rtol=0.01)
    simulators = [Simulator(scene) for scene in scenes]
    hubs = [simulator.frame("hub") for simulator in simulators]
    np.testing.assert_allclose(hubs[0].position, hubs[1].position, atol=1e-9)
    np.testing.assert_allclose(np.abs(hubs[0].quat_xyzw @ hubs[1].quat_xyzw), 1.0, atol=1e-9)
    for simulator in simulators:
        simulator.reset(keyframe="up")
    mesh = simulators[1].frame("one[0]")  # that of the mesh
    assert mesh.position == pytest.approx((0, 0, 5), abs=1e-9)
    np.testing.assert_allclose(mesh.quat_xyzw, simulators[0]["one[0]"].quat_xyzw, atol=1e-9)


def test_a_round_mesh_may_be_hollow(wheel) -> None:
    """A tube with ends of 4 mm, whose mass is that of its wall."""
    scene = loaded(SceneBuilder().add("can", mesh=wheel, round="auto", wall=0.004, density=1000))
    assert scene.bodies[0].mass == pytest.approx(1000 * np.pi * (0.1**2 * 0.05 - 0.096**2 * 0.042), rel=0.01)


def test_what_is_not_round_says_so(tmp_path) -> None:
    (tmp_path / "box.obj").write_text(wavefront([primitives.box()]))
    scene = loaded(SceneBuilder().add("box", mesh=tmp_path / "box.obj", round="auto"))
    assert "no round solid: it collides as it is" in scene.notes[0]


def ball(radius: float) -> tuple[float, np.ndarray]:
    """Volume m^3 and inertia [3] m^5 of a solid one."""
    volume = 4 / 3 * np.pi * radius**3
    return volume, np.full(3, 0.4 * volume * radius**2)


def block(size) -> tuple[float, np.ndarray]:
    """The same of a block with sides of `size` [3] m."""
    squares = np.square(size)
    return np.prod(size), np.prod(size) / 12 * (squares.sum() - squares)


SIDES = np.array([0.2, 0.13, 0.31])
SHAPES = {
    "ball": ("sphere: {radius: 0.1}", lambda wall: ball(0.1 - wall)),
    "block": ("box: {size: [0.2, 0.13, 0.31]}", lambda wall: block(SIDES - 2 * wall)),
}


def with_wall(load, shape: str, scale: float = 1.0) -> Scene:
    body = f"{{name: it, shape: it, density: 500, scale: {scale}}}"
    return load(f"version: 1\nshapes:\n  it: {{{shape}}}\nbodies:\n  - {body}\n")


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize("name", SHAPES)
def test_mass_and_inertia_are_those_of_what_is_left_around_the_hollow(load, name, scale):
    shape, inside = SHAPES[name]
    (volume, inertia), (hollow, missing) = inside(0.0), inside(0.004)
    scene = with_wall(load, f"{shape}, wall: 0.004", scale)
    assert scene.bodies[0].mass == pytest.approx(500 * (volume - hollow) * scale**3, rel=0.01)
    bodies, _ = from_scene(scene, Units(1.0, 1.0, 1.0))
    wanted = 500 * np.diag(inertia - missing) * scale**5
    np.testing.assert_allclose(bodies.inertia[0], wanted, rtol=0.01, atol=1e-3 * wanted.max())
    np.testing.assert_allclose(bodies.com[0], 0, atol=1e-6)


def test_a_wall_thicker_than_the_shape_makes_it_solid(load):
    solid, walled = (with_wall(load, f"sphere: {{radius: 0.1}}{more}") for more in ("", ", wall: 0.2"))
    assert walled.bodies[0].mass == pytest.approx(solid.bodies[0].mass, rel=1e-3)


def test_a_wall_changes_nothing_outside(load):
    solid, walled = (with_wall(load, f"sphere: {{radius: 0.1}}{more}").shapes[0] for more in ("", ", wall: 0.004"))
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    np.testing.assert_array_equal(solid.sdf(points)[0], walled.sdf(points)[0])
    np.testing.assert_array_equal(solid.nodes, walled.nodes)


CRATE = {
    "box": "{box: {size: [0.4, 0.4, 0.4]}}",
    "grid": "{primitive: {name: box, size: 0.4}, sdf: grid, resolution: 64}",
    "asset": "{asset: crate, sdf: grid}",
    "file": "{mesh: crate.ply, units: cm, sdf: mesh}",
}


def falling_ball(crate: str) -> str:
    return f"""version: 1
shapes:
  crate: {crate}
  ball: {{sphere: {{radius: 0.1}}}}
bodies:
  - {{name: floor, plane: {{}}}}
  - {{name: crate, shape: crate, position: [0, 0, 0.2], mass: 1}}
  - {{name: ball, shape: ball, position: [0.03, 0.02, 0.52], velocity: [0, 0, -1], mass: 0.5}}
"""


def heights(scene: Scene) -> np.ndarray:
    """[15, 3, 3] m: where the bodies are, step by step."""
    simulator = Simulator(scene, model="solver")
    return np.stack([np.asarray(state.position) for state in simulator.steps(15)])


def test_a_ball_bounces_alike_off_a_box_a_grid_and_a_mesh(load, tmp_path, monkeypatch):
    monkeypatch.setattr("sdfsim.shape.make.fit_mesh", lambda *args, **kwargs: pytest.fail("fitted"))
    crate = analytic_shape("box", size=(0.4, 0.4, 0.4))
    crate.save(tmp_path / "crate")
    larger = replace(crate.mesh, vertices=100 * crate.mesh.vertices)
    (tmp_path / "crate.ply").write_bytes(write_ply(larger))
    scenes = {key: load(falling_ball(shape)) for key, shape in CRATE.items()}
    kinds = {key: type(scene.shapes[1].sdf) for key, scene in scenes.items()}
    assert kinds == {"box": BoxSdf, "grid": GridSdf, "asset": GridSdf, "file": MeshSdf}
    assert all(scene.missed == () for scene in scenes.values())
    expected = heights(scenes["box"])
    # Without the crate it would be half a metre lower by now.
    assert 0.49 < expected[-1, 2, 2] < 0.51
    # Samples round corners off by 0.4 mm, and the impact falls into one inner step or the next.
    for key, scene in scenes.items():
        np.testing.assert_allclose(heights(scene), expected, atol=0.02, err_msg=key)


def test_an_asset_keeps_its_own_sdf_unless_reported_and_cannot_grow_a_network(load, tmp_path):
    with_sdf(analytic_shape("box", size=(0.4, 0.4, 0.4)), "mesh").save(tmp_path / "crate")
    assert isinstance(load(falling_ball("{asset: crate}")).shapes[1].sdf, MeshSdf)
    (fault,) = problems_of(load, falling_ball("{asset: crate, sdf: mlp}"))
    assert fault == "scene.yaml:3: shapes.crate.asset: box: the shape has no SDF network (fit its mesh)"


def test_a_shape_of_parts_has_their_mass_and_rests_on_them(tmp_path):
    """A dumbbell of a bar and two boxes, with a lamp that is only shown; its box alone would tip over."""
    (tmp_path / "lamp.obj").write_text(wavefront([box((0.1, 0.1, 0.1))]))
    scene = sdfsim.Scene(duration=1.0, model="solver").add("floor", plane={}, restitution=0)
    parts = [
        {"box": {"size": (0.2, 0.2, 0.2)}, "position": (0.4, 0, 0), "color": (200, 0, 0)},
        {"box": {"size": (0.2, 0.2, 0.2)}, "position": (-0.4, 0, 0)},
        {"box": {"size": (0.6, 0.1, 0.1)}, "euler_xyz_deg": (0, 0, 0)},
        {"mesh": str(tmp_path / "lamp.obj"), "scale": 2.0, "position": (0, 0, 0.3), "use": "shown"},
        {"sphere": {"radius": 0.05}, "position": (0, 0, 0.05), "use": "touch"},
    ]
    scene.add("bell", parts=parts, position=(0, 0, 0.1), restitution=0, density=100)
    loaded = load_scene(scene.save(tmp_path / "scene.yaml"), allow_outside=True)
    shape, mass = loaded.shapes[1], loaded.bodies[1].mass
    # The bar is 0.6 m between the boxes; half of the sphere is above it.
    assert mass == pytest.approx(100 * (2 * 0.2**3 + 0.6 * 0.01 + 2 / 3 * np.pi * 0.05**3), rel=0.01)
    assert shape.skin is not None and shape.skin.vertices[:, 2].max() == pytest.approx(0.4)
    assert shape.mesh.vertices[:, 2].max() == pytest.approx(0.1, abs=1e-3)
    rollout = sdfsim.Simulator(loaded).run()
    assert rollout.position[-1, 1] == pytest.approx(rollout.position[0, 1], abs=2e-4)
    again = sdfsim.Scene.read(tmp_path / "scene.yaml", allow_outside=True).load()
    assert again.bodies[1].mass == pytest.approx(mass)
