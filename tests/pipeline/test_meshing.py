"""The mesh stage as a whole, on a field that is drawn by hand: a table with a cup on it, and a speck in the air;
textures."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.cameras import Similarity, Sparse, View, load_views, save_views
from pipeline.field.training import Trained
from pipeline.inputs.photos import Photo, save_photos
from pipeline.mesh import meshing, photo_refining, texture
from pipeline.mesh.extraction import sample_box
from pipeline.mesh.meshing import make_meshes, read_parts, trust_meshes
from pipeline.mesh.photo_refining import GreyPhoto, refine
from pipeline.mesh.placement import load_placement
from pipeline.mesh.texture import Shots, shots_of, textured, unfold
from pipeline.mesh.trust import GUESSED
from pipeline.mesh.visibility import Visibility, bilinear, look, to_bytes
from pipeline.options import options_of
from pipeline.records import MeshReport
from pipeline.report import mesh_notes
from pipeline.scene_writer import skins_of
from sdfsim.apps.recording import Playback, save_reconstruction
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals, is_closed, joined, sample_surface
from sdfsim.geometry.mesh_io import load_mesh, read_attributes, read_glb, read_mesh, write_glb, write_ply
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import load_shape, scaled
from tests.helpers.runs import read
from tests.helpers.surfaces import TABLE, TOP, both, box, cube, look_at, plate

WIDTH = 2 * TABLE[0]
SPECK = (-0.3, 0.2, 0.5)


class Drawn:
    """A field that is known exactly, and red where it is high."""

    finest = 2 / 63
    device = torch.device("cpu")

    def to(self, device: str) -> "Drawn":
        return self

    def sdf(self, points: torch.Tensor) -> torch.Tensor:
        p = points.double().numpy()
        return torch.from_numpy(np.minimum(both(p), box(p, SPECK, (0.03, 0.03, 0.03)))).float()

    def geometry_at(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return self.sdf(points), points, points

    def color_of(self, geometry: torch.Tensor, features: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(geometry)


def cameras() -> list[View]:
    """Two rings, so that the cup's inside and the table's sides are both seen."""
    angles = np.arange(8) * np.pi / 4
    eyes = [np.array([2.2 * np.cos(a), 2.2 * np.sin(a), z]) for z in (0.4, 2.4) for a in angles]
    views = [look_at(eye) for eye in eyes]
    return [replace(view, name=f"{k:04d}.jpg", source=f"{k}.jpg") for k, view in enumerate(views)]


def folders(folder: Path, surface: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Folders as the stages before leave them, with points on the surface of a distance."""
    for name in ("poses", "photos/images"):
        (folder / name).mkdir(parents=True)
    views = cameras()
    save_views(views, folder / "poses" / "cameras.json")
    rng = np.random.default_rng(0)
    xyz = rng.uniform([-0.6, -0.6, -0.5], [0.6, 0.6, 0.5], (4000, 3))
    xyz = xyz[np.abs(surface(xyz)) < 0.05]
    count = len(xyz)
    sparse = Sparse(xyz, np.zeros((count, 3), np.uint8), np.full(count, 0.3), np.arange(count), np.zeros(count, int))
    np.savez(folder / "poses" / "sparse.npz", **vars(sparse))
    prepared = [
        Photo(v.name, v.source, v.width, v.height, (v.width, v.height), None, None, "", False, 0.4) for v in views
    ]
    save_photos(prepared, folder / "photos")
    for view in views:
        Image.new("RGB", (view.width, view.height), (180, 90, 40)).save(folder / "photos" / "images" / view.name)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return folders(tmp_path_factory.mktemp("run"), both)


@pytest.fixture(scope="module")
def mesh(run: Path, tmp_path_factory) -> Iterator[Callable[..., tuple[MeshReport, Path]]]:
    """Runs the mesh stage with some options, once for all tests; gives its report and its folder."""
    trained = Trained(Drawn(), 0.01, Similarity(1.0, np.eye(3), np.zeros(3)), {"masked": False})  # type: ignore[arg-type]

    @cache
    def make(**options) -> tuple[MeshReport, Path]:
        places, folder = (run / "distill", run / "poses", run / "photos"), tmp_path_factory.mktemp("mesh")
        return make_meshes(*places, folder, options_of(preset="quick", **options)), folder

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshing, "load_field", lambda folder: trained)
        patch.setitem(meshing.RESOLUTION, "quick", 97)
        yield make


def test_a_cup_on_a_table_becomes_meshes_in_metres_with_names(mesh):
    corners = [np.array([x, 0.34, TOP]) for x in (-0.49, 0.49)]
    view = cameras()[10]
    places = [f"{view.source}:{u:.3f},{v:.3f}" for u, v in view.project(np.array(corners))[0]]
    report, folder = mesh(distance=(*places, 1.2 * 0.98))
    scale = load_placement(folder).to_metres.scale
    assert scale == pytest.approx(1.2 / WIDTH, rel=0.02)
    assert report.objects == ["object1"] and report.up_confidence == "high"
    assert report.size.startswith(f"given: {places[0]} to {places[1]}")
    cup, solid = load_mesh(folder / "objects" / "object1.ply"), load_mesh(folder / "solid.ply")
    assert is_closed(cup) and is_closed(solid)
    assert np.ptp(cup.vertices[:, 2]) == pytest.approx(0.3 * scale, rel=0.05)
    assert cup.vertices[:, 2].min() == pytest.approx((TOP + 0.5) * scale, abs=0.01 * scale)  # The floor is z = 0.
    assert cup.colors is not None
    assert np.abs(np.median(cup.colors, axis=0) - [180, 90, 40]).max() < 4  # As in the photos.
    picture = np.asarray(Image.open(folder / "objects.png"), float)
    assert (np.abs(picture - [180, 90, 40]).max(-1) > 40).mean() > 0.002  # The cup is tinted.


def test_the_files_tell_what_photos_see_of_each_vertex(mesh):
    report, folder = mesh(size=2.0)
    cup = read_mesh(folder / "objects" / "object1.ply")
    views, uncertainty = read_attributes(folder / "objects" / "object1.ply", ["views", "uncertainty"])
    below = cup.vertices[:, 2] < cup.vertices[:, 2].min() + 1e-3 * np.ptp(cup.vertices[:, 2])
    assert np.isinf(uncertainty[views < 2]).all() and np.isfinite(uncertainty[~below]).mean() > 0.5
    inner = below & (np.linalg.norm(cup.vertices[:, :2] - cup.vertices[below, :2].mean(0), axis=1) < 0.03)
    assert inner.any() and (views[inner] == 0).all()  # It stands on its table.
    colors = {name: part.colors for name, part in trust_meshes(folder).items()}
    assert list(colors) == ["scenery", "object1"] and (colors["object1"][views == 0] == GUESSED).all()
    assert len(load_views(folder / "next_photos.json")) == len(report.next_photos)
    scale = load_placement(folder).to_metres.scale
    assert report.left_out_m == pytest.approx([0.06 * scale], rel=0.2)  # the speck
    assert report.smallest_object_m == pytest.approx(4 * Drawn.finest * scale, rel=1e-4)


def test_cropping_leaves_the_frame_and_what_is_within(mesh):
    _, folder = mesh(size=2.0)
    whole = load_placement(folder)
    corners = np.sort(whole.to_metres.points(np.array([[-0.55, -0.4, 0.0], [0.55, 0.4, 0.45]])), axis=0)
    # Without the floor nothing reaches the end of the trained space: the table is what is left to move.
    report, folder = mesh(size=2.0, crop=tuple(corners.ravel()))
    assert load_placement(folder).to_metres.to_dict() == whole.to_metres.to_dict()
    assert not read_parts(folder)["scenery"] and report.objects == ["object1"]
    vertices = load_mesh(folder / "objects" / "object1.ply").vertices
    assert (vertices > corners[0] - 0.02).all() and (vertices < corners[1] + 0.02).all()
    with pytest.raises(SdfsimError, match="crop: "):
        mesh(crop=(5.0, 5, 5, 6, 6, 6))


class Disc(Drawn):
    """A disc of 0.4 about the axis, 0.12 high; as no photo sees it from below, the field has a cone there."""

    def sdf(self, points: torch.Tensor) -> torch.Tensor:
        p = points.double().numpy()
        r = np.hypot(p[:, 0], p[:, 1])
        return torch.from_numpy(np.maximum(np.maximum(r - 0.4, p[:, 2] - 0.12), 0.125 * (r - 0.4) - p[:, 2])).float()


def test_what_no_photo_sees_below_a_body_without_scenery_is_level(tmp_path, monkeypatch):
    """The cone is 0.05 deep, and its sides are in no sight: what carried the disc was level with its edge."""
    trained = Trained(Disc(), 0.01, Similarity(1.0, np.eye(3), np.zeros(3)), {"masked": True})  # type: ignore[arg-type]
    monkeypatch.setattr(meshing, "load_field", lambda folder: trained)
    monkeypatch.setitem(meshing.RESOLUTION, "quick", 97)
    run = folders(tmp_path, lambda p: trained.field.sdf(torch.from_numpy(p)).numpy())
    (tmp_path / "out").mkdir()
    options = options_of(preset="quick", size=0.8)
    report = make_meshes(run / "distill", run / "poses", run / "photos", run / "out", options)
    disc = load_mesh(run / "out" / "objects" / "object1.ply")
    assert report.objects == ["object1"] and is_closed(disc)
    height, cell = disc.vertices[:, 2], 2.04 / 96
    normals, areas = face_normals(disc)
    assert height.min() == pytest.approx(0.0, abs=1e-6) and np.ptp(height) == pytest.approx(0.12, abs=cell)
    level = (disc.vertices[disc.faces][..., 2] < 1e-6).all(1) & (normals[:, 2] < -0.999)
    assert areas[level].sum() > 0.8 * np.pi * 0.4**2  # marching cubes round its edge


@cache
def ball_and_photos(blocked: int = 0, thin: float = 1.0) -> tuple[Mesh, list[GreyPhoto]]:
    """A ball of radius 0.3 with a pattern of waves, as a mesh that is 2 % smaller, with bumps as large; and its photos.
    Before those cameras that look most from the side of +x stands a board with a pattern of its own. A `thin` ball is
    so many times as wide along y and z; its mesh is exact."""
    sides = np.array([1.0, thin, thin])
    rng = np.random.default_rng(0)
    waves, phases = rng.normal(0, 50, (24, 3)), rng.uniform(0, 7, 24)
    pictures = []
    for number, view in enumerate(sorted(cameras(), key=lambda view: -view.center[0] / np.linalg.norm(view.center))):
        row, column = np.mgrid[0 : view.height, 0 : view.width] + 0.5
        along = view.rays(column.ravel(), row.ravel())
        start, way = view.center / sides, along / sides
        steep = (way**2).sum(1)
        middle = -(way @ start) / steep
        root = middle**2 - (start @ start - 0.3**2) / steep
        hit = view.center + (middle - np.sqrt(root.clip(0)))[:, None] * along
        grey = 128 + 20 * np.sin(hit @ waves.T + phases).sum(1)
        grey = np.where(root > 0, grey, 0)
        if number < blocked:
            grey = 128 + 20 * np.sin((view.center + 0.3 * along) @ (4 * waves.T) + phases).sum(1)
        pictures.append(GreyPhoto(view, 1.0, grey.reshape(view.height, view.width).astype(np.float32)))

    def small(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=1) - 0.294 + 0.006 * np.sin(60 * points).prod(1)

    def spindle(points: np.ndarray) -> np.ndarray:
        return thin * (np.linalg.norm(points / sides, axis=1) - 0.3)

    shape, cell = (small, 0.014) if thin == 1 else (spindle, 0.008)
    return sample_box(shape, np.full(3, -0.32), np.full(3, 0.32), cell).mesh(), pictures


def off_the_ball(mesh: Mesh, where: np.ndarray) -> float:
    return float(np.median(np.abs(np.linalg.norm(mesh.vertices[where], axis=1) - 0.3)))


def test_a_body_that_came_out_too_small_and_bumpy_moves_to_where_the_photos_agree():
    body, pictures = ball_and_photos()
    found, why = refine(body, pictures, Caster(body), 0.005, 0.02, lambda points: points[:, 2] + 1, 0.03)
    assert not why
    up = body.vertices[:, 2] > -0.1  # No camera looks from below.
    before, after = off_the_ball(body, up), off_the_ball(found, up)
    assert before > 0.005 and after < 0.4 * before
    assert np.array_equal(found.faces, body.faces)


def test_the_tips_of_a_thin_body_stay_where_they_are():
    body, pictures = ball_and_photos(thin=0.25)
    found, why = refine(body, pictures, Caster(body), 0.005, 0.02, lambda points: points[:, 2] + 1, 0.03)
    assert not why
    assert np.ptp(found.vertices[:, 0]) == pytest.approx(0.6, abs=0.008)  # a sample


def test_photos_that_something_unknown_stands_before_do_not_count():
    body, pictures = ball_and_photos(blocked=3)
    found, why = refine(body, pictures, Caster(body), 0.005, 0.02, lambda points: points[:, 2] + 1, 0.03)
    assert not why
    side = (body.vertices[:, 0] > 0.15) & (body.vertices[:, 2] > -0.1)
    assert off_the_ball(found, side) < 0.6 * off_the_ball(body, side)


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("two photos", "only 2 photos"),
        ("blank photos", "nowhere do 3 photos"),
        ("hard equations", "not solved in 1 steps"),
    ],
)
def test_a_body_that_cannot_be_moved_stays_and_it_is_reported_why(case, words, monkeypatch):
    body, pictures = ball_and_photos()
    if case == "two photos":
        pictures = pictures[:2]
    elif case == "blank photos":
        pictures = [replace(picture, grey=np.full_like(picture.grey, 128)) for picture in pictures]
    else:
        monkeypatch.setattr(photo_refining, "STEPS", 1)
    found, why = refine(body, pictures, Caster(body), 0.005, 0.02, lambda points: points[:, 2] + 1, 0.03)
    assert words in why
    np.testing.assert_array_equal(found.vertices, body.vertices)
    assert f"ball: its surface was not fully refined by photos: {why}" in mesh_notes(
        MeshReport(unrefined={"ball": why})
    )


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
