"""Textures, baked from photos of a pattern that is known exactly and finer than the mesh."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.cameras import View
from pipeline.inputs.photos import Photo
from pipeline.mesh import texture
from pipeline.mesh.texture import Shots, shots_of, textured, unfold
from pipeline.mesh.visibility import Visibility, bilinear, look, to_bytes
from pipeline.scene_writer import skins_of
from sdfsim.apps.recording import Playback, save_reconstruction
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, joined, sample_surface
from sdfsim.geometry.mesh_io import read_glb, write_glb, write_ply
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import load_shape, scaled
from tests.helpers.runs import read
from tests.helpers.surfaces import cube, look_at, plate

GREY, RED = np.array([90.0, 90, 90]), np.array([250.0, 20, 20])


def pattern(points: np.ndarray) -> np.ndarray:
    """Colours [P, 3] in 0..255: waves 8 cm long on all axes."""
    return 127 + 100 * np.sin(2 * np.pi * points / 0.08 + [0, 1, 2])


def photograph(folder: Path, views: list[View], meshes: list[Mesh], colors: list[Callable]) -> Shots:
    """Photos of meshes, each with the colours [P, 3] that a function gives at points [P, 3], as a stage leaves them."""
    (folder / "images").mkdir(exist_ok=True)
    caster = Caster(joined(meshes))
    first = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])
    for view in views:
        row, column = (axis.ravel() for axis in np.indices((view.height, view.width)))
        rays = view.rays(column + 0.5, row + 0.5)
        away, face = caster.hits(view.center, rays)
        hit, seen = np.isfinite(away), np.full((len(away), 3), 30.0)
        for number, color in enumerate(colors):
            own = hit & (face >= first[number]) & (face < first[number + 1])
            seen[own] = color(view.center + away[own, None] * rays[own])
        image = to_bytes(seen.reshape(view.height, view.width, 3))
        Image.fromarray(image).save(folder / "images" / view.name)
    photos = [
        Photo(v.name, v.source, v.width, v.height, (v.width, v.height), None, None, "", False, 0.4) for v in views
    ]
    return shots_of(views, photos, folder, meshes, 0.005)


def ring(height: float, count: int = 6, far: float = 2.2) -> list[View]:
    """Cameras that look at the origin from all around."""
    angles = 2 * np.pi * np.arange(count) / count
    views = [look_at(np.array([far * np.cos(a), far * np.sin(a), height])) for a in angles]
    return [replace(view, name=f"{height:g}-{k}.png", source=f"{k}.png") for k, view in enumerate(views)]


def on_surface(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Colours [P, 3] of a mesh at points [P, 3] of its surface: of its texture, else between its vertices."""
    caster = Caster(mesh)
    found = caster.scene.compute_closest_points(caster.tensor(points.astype(np.float32)))
    corners = mesh.faces[found["primitive_ids"].numpy().astype(int)]
    second, third = found["primitive_uvs"].numpy().T
    weights = np.stack([1 - second - third, second, third], 1)
    if mesh.uv is None or mesh.texture is None:
        assert mesh.colors is not None
        return (mesh.colors[corners] * weights[..., None]).sum(1)
    uv = (mesh.uv[corners] * weights[..., None]).sum(1)
    return bilinear(mesh.texture.astype(float), uv * mesh.texture.shape[1::-1] - 0.5)


def in_colors(mesh: Mesh, shots: Shots) -> Mesh:
    found = look(Visibility(mesh, shots.lift, shots.blocking), shots.views, shots.folder)
    return replace(mesh, colors=to_bytes(found.color))


def test_a_pattern_finer_than_the_mesh_is_in_the_texture(tmp_path):
    ball = analytic_shape("sphere", radius=0.5).mesh
    views = ring(0.5, 6) + ring(-0.5, 6)
    shots = photograph(tmp_path, views, [ball], [pattern])
    colored = in_colors(ball, shots)
    made = textured(colored, shots)
    points, _ = sample_surface(ball, 4000, np.random.default_rng(0))
    points = points[np.abs(points[:, 2]) < 0.3]
    plain, error = (np.abs(on_surface(drawn, points) - pattern(points)).mean() for drawn in (colored, made))
    assert error < 5 and plain > 10 * error


def test_what_stands_in_front_does_not_print_itself_on_what_is_behind(tmp_path):
    floor, block = plate(20), cube(0.25, (0.0, 0.0, 0.3))
    views = ring(1.2)
    red = lambda points: np.broadcast_to(RED, points.shape)  # noqa: E731
    grey = lambda points: np.broadcast_to(GREY, points.shape)  # noqa: E731
    shots = photograph(tmp_path, views, [floor, block], [grey, red])
    made = textured(replace(floor, colors=np.full(floor.vertices.shape, 90, np.uint8)), shots)
    assert made.texture is not None
    points = np.random.default_rng(0).uniform([-0.48, -0.48, 0], [0.48, 0.48, 0], (4000, 3))
    assert np.abs(on_surface(made, points) - GREY).max() < 12


def test_what_no_photo_shows_keeps_its_vertex_colours(tmp_path):
    floor = plate(20)
    view = replace(look_at(np.array([0.6, 0.0, 1.0])), name="a.png")
    narrow = replace(view, width=200, height=200, cx=100.0, cy=100.0)  # shows the middle of the plate alone
    shots = photograph(tmp_path, [narrow], [floor], [pattern])
    made = textured(replace(floor, colors=np.tile(np.array([10, 200, 60], np.uint8), (len(floor.vertices), 1))), shots)
    corners = np.array([[-0.45, y, 0.0] for y in np.linspace(-0.45, 0.45, 20)])
    assert np.abs(on_surface(made, corners) - [10, 200, 60]).max() < 4
    assert np.abs(on_surface(made, np.array([[0.0, 0, 0]])) - pattern(np.zeros((1, 3)))).max() < 25


def test_what_no_photo_shows_at_all_gets_a_small_texture(tmp_path):
    views = ring(1.2, count=2)
    mesh = cube(0.2, (0.0, 0.0, 9.0))
    shots = photograph(tmp_path, views, [mesh], [pattern])
    made = textured(replace(mesh, colors=np.full(mesh.vertices.shape, 77, np.uint8)), shots)
    assert made.texture is not None and max(made.texture.shape) < 100
    assert np.abs(made.texture.astype(int) - 77).max() <= 1


def skin() -> Mesh:
    flat, _, (rows, columns) = unfold(plate(2), 60.0)
    smooth = np.linspace(40, 200, rows * columns).reshape(rows, columns, 1)
    return replace(flat, colors=None, texture=to_bytes(np.repeat(smooth, 3, 2)))


def test_a_shape_folder_keeps_its_texture(tmp_path):
    shape = replace(analytic_shape("box", size=(1, 1, 1)), skin=skin())
    back = load_shape(shape.save(tmp_path / "s"))
    assert back.skin is not None and back.shown is back.skin and shape.skin is not None
    assert np.allclose(back.skin.vertices, shape.skin.vertices) and np.array_equal(back.skin.faces, shape.skin.faces)
    assert np.allclose(back.skin.uv, shape.skin.uv, atol=1e-6)  # type: ignore[arg-type]
    assert np.abs(back.skin.texture.astype(int) - shape.skin.texture).max() < 8  # type: ignore[union-attr, operator]
    assert np.allclose(scaled(back, 2.0).shown.vertices, 2 * back.skin.vertices)
    assert load_shape(replace(shape, skin=None).save(tmp_path / "s")).skin is None


def test_other_programs_read_the_glb_upright_with_texture_and_places(tmp_path):
    import trimesh

    mesh = skin()
    mesh = replace(mesh, vertices=mesh.vertices + np.array([0, 0, 0.7]))
    (tmp_path / "a.glb").write_bytes(write_glb({"scene": mesh, "object1": mesh}))
    scene = trimesh.load(tmp_path / "a.glb")
    assert isinstance(scene, trimesh.Scene) and set(scene.geometry) == {"scene", "object1"}
    assert np.allclose(scene.bounds[:, 1], 0.7)  # y is up in glTF
    visual = scene.geometry["object1"].visual
    image = np.asarray(visual.material.baseColorTexture.convert("RGB"), float)  # type: ignore[union-attr]
    assert mesh.texture is not None and mesh.uv is not None and image.shape == mesh.texture.shape
    assert np.abs(image - mesh.texture).max() < 8
    assert np.allclose(visual.uv, np.c_[mesh.uv[:, 0], 1 - mesh.uv[:, 1]], atol=1e-6)  # type: ignore[union-attr]
    assert set(read_glb(tmp_path / "a.glb")) == {"scene", "object1"}


def test_the_skin_of_a_body_stands_at_the_bodys_origin(tmp_path):
    (tmp_path / "objects").mkdir()
    body = cube(0.2, (0.3, 0.4, 0.5))
    (tmp_path / "objects" / "object1.ply").write_bytes(write_ply(body))
    assert skins_of(tmp_path) == {}
    flat, _, (rows, columns) = unfold(body, 60.0)
    flat = replace(flat, texture=np.zeros((rows, columns, 3), np.uint8))
    (tmp_path / "textured.glb").write_bytes(write_glb({"scenery": flat, "object1": flat}))
    skins = skins_of(tmp_path)
    assert np.allclose(skins["scenery"].vertices, flat.vertices, atol=1e-6)
    assert np.allclose(skins["object1"].vertices, flat.vertices - [0.3, 0.4, 0.4], atol=1e-6)


def test_the_best_view_gives_a_sharper_texture_than_the_mean(tmp_path, monkeypatch):
    """Where the mesh is off by a little, the photos do not agree."""
    true, mesh = plate(1), plate(20, z=0.012)
    shots = photograph(tmp_path, ring(1.2), [true], [pattern])
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.012], [0.3, 0.3, 0.012], (4000, 3))
    best = on_surface(textured(in_colors(mesh, shots), shots), points)[:, :2].std()
    monkeypatch.setattr(texture, "POWER", 1.0)
    assert best > 1.2 * on_surface(textured(in_colors(mesh, shots), shots), points)[:, :2].std()


def test_recordings_show_the_texture(tmp_path):
    mesh = skin()
    assert mesh.uv is not None and mesh.texture is not None
    save_reconstruction(tmp_path / "r.rrd", [], np.zeros((0, 3)), None, plate(2), {"scene": mesh, "object1": mesh})
    found = read(tmp_path / "r.rrd")
    assert "/world/surface!" not in found and "/world/surface/scene!" in found
    shown = found["/world/surface/object1!"]
    np.testing.assert_allclose(shown["Mesh3D:vertex_texcoords"][0], mesh.uv, atol=1e-6)
    assert len(shown["Mesh3D:albedo_texture_buffer"][0][0]) == mesh.texture.size
    assert "Mesh3D:vertex_colors" not in shown and "Mesh3D:albedo_factor" not in shown
    shape = replace(analytic_shape("box", size=(1, 1, 1)), skin=mesh)
    still, ahead = np.zeros(3), np.array([0.0, 0, 0, 1])
    body = Body("crate", 0, "dynamic", 2.0, np.array([0.0, 0, 1]), ahead, still, still, 1.0, 0.5, 0.5)
    playback = Playback(Scene((shape,), (body,), np.array([0.0, 0, -9.81]), 1.0))
    encoded = playback.stream.binary_stream()
    playback.log_static()
    (tmp_path / "p.rrd").write_bytes(encoded.read() or b"")
    shown = read(tmp_path / "p.rrd")["/world/crate/mesh!"]
    np.testing.assert_allclose(shown["Mesh3D:vertex_positions"][0], 2 * mesh.vertices, atol=1e-6)
    assert len(shown["Mesh3D:albedo_texture_buffer"][0][0]) == mesh.texture.size
