"""The mesh stage as a whole, on a field that is drawn by hand: textures, and how far surfaces can be trusted."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh  # noqa: TID253
from PIL import Image

from pipeline.cameras import Similarity, Sparse, View, load_views, save_views
from pipeline.field.training import Trained
from pipeline.inputs.photos import Photo, save_photos
from pipeline.mesh import meshing, photo_refining
from pipeline.mesh.extraction import sample_box
from pipeline.mesh.hollows import Hollow, hollow, hollow_line
from pipeline.mesh.meshing import make_meshes, read_parts, trust_meshes
from pipeline.mesh.photo_refining import GreyPhoto, refine
from pipeline.mesh.placement import load_placement
from pipeline.mesh.texture import Shots, shots_of, textured, unfold
from pipeline.mesh.trust import GUESSED, Evidence, evidence_of, information, next_photos, sigma_along, summary
from pipeline.mesh.visibility import Visibility, bilinear, look, to_bytes
from pipeline.options import Options, options_of
from pipeline.records import MeshReport, Proposal
from pipeline.report import improvements, mesh_notes, notes
from pipeline.scene_writer import skins_of
from sdfsim.apps.recording import Playback, save_reconstruction
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals, is_closed, joined, sample_surface
from sdfsim.geometry.mesh_io import load_mesh, read_attributes, read_glb, read_mesh, write_glb, write_ply
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import load_shape, scaled
from tests.helpers.balls import ring
from tests.helpers.runs import read
from tests.helpers.surfaces import TABLE, TOP, both, box, cube, look_at, plate
from tests.helpers.surfaces import ring as level_ring
from tests.pipeline import photo_sets
from tests.pipeline.photo_sets import orbit, still_life, studio

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
    views = [*level_ring(8, 0.4, 2.2), *level_ring(8, 2.4, 2.2)]
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


def round_about(height: float, count: int = 6, far: float = 2.2) -> list[View]:
    """Cameras that look at the origin from all around."""
    views = level_ring(count, height, far)
    return [replace(view, name=f"{height:g}-{k}.png", source=f"{k}.png") for k, view in enumerate(views)]


def on_surface(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Colours [P, 3] of a mesh at points [P, 3] of its surface: of its texture, else between its vertices."""
    caster = Caster(mesh)
    found = caster.scene.compute_closest_points(caster.tensor(points.astype(np.float32)))
    corners = mesh.faces[found["primitive_ids"].numpy().astype(int)]
    second, third = found["primitive_uvs"].numpy().T
    weights = np.stack([1 - second - third, second, third], 1)
    if mesh.uv is None or mesh.texture is None:
        return (mesh.colors[corners] * weights[..., None]).sum(1)
    uv = (mesh.uv[corners] * weights[..., None]).sum(1)
    return bilinear(mesh.texture.astype(float), uv * mesh.texture.shape[1::-1] - 0.5)


def in_colors(mesh: Mesh, shots: Shots) -> Mesh:
    found = look(Visibility(mesh, shots.lift, shots.blocking), shots.views, shots.folder)
    return replace(mesh, colors=to_bytes(found.color))


def test_a_pattern_finer_than_the_mesh_is_in_the_texture(tmp_path):
    ball = analytic_shape("sphere", radius=0.5).mesh
    views = round_about(0.5, 6) + round_about(-0.5, 6)
    shots = photograph(tmp_path, views, [ball], [pattern])
    colored = in_colors(ball, shots)
    made = textured(colored, shots)
    points, _ = sample_surface(ball, 4000, np.random.default_rng(0))
    points = points[np.abs(points[:, 2]) < 0.3]
    plain, error = (np.abs(on_surface(drawn, points) - pattern(points)).mean() for drawn in (colored, made))
    assert error < 5 and plain > 10 * error


def test_what_stands_in_front_does_not_print_itself_on_what_is_behind(tmp_path):
    floor, block = plate(20), cube(0.25, (0.0, 0.0, 0.3))
    views = round_about(1.2)
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
    views = round_about(1.2, count=2)
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


def test_recordings_show_the_texture(tmp_path):
    mesh = skin()
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


FLIP = np.diag([1.0, -1, -1])  # OpenGL camera axes to ours


def pair(baseline: float, away: float) -> list[View]:
    """Two cameras side by side, both looking straight down from a height."""
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    eyes = [np.array([x, 0, away]) for x in (-baseline / 2, baseline / 2)]
    return [replace(look_at(np.array([0.0, -1, 1])), rotation=down, translation=-down @ eye) for eye in eyes]


@pytest.mark.parametrize(("baseline", "away"), [(0.2, 2.0), (1.0, 3.0)])
def test_two_cameras_tell_depth_as_the_stereo_formula_says(baseline, away):
    """Depth = focal * baseline / disparity, and the disparity is off by the square root of two pixels."""
    views = pair(baseline, away)
    point, up, side = np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([[0.0, 1, 0]])
    total = information(views[0], point) + information(views[1], point)
    focal = views[0].focal
    assert sigma_along(total, up)[0] == pytest.approx(np.sqrt(2) * away**2 / (focal * baseline), rel=1e-9)
    # Across both lines of sight there are two measurements of one pixel each.
    assert sigma_along(total, side)[0] == pytest.approx(away / focal / np.sqrt(2), rel=1e-9)


def test_what_is_behind_something_is_guessed():
    floor = plate(20)
    wall = plate(4, z=0.5, half=0.2)
    views = [view for shift in (-0.2, 0.2) for view in pair(0.1 + abs(shift), 3.0)]
    found = evidence_of(Visibility(floor, 1e-3, Caster(joined([floor, wall]))), views)
    under = np.abs(floor.vertices[:, :2]).max(1) < 0.15
    beside = np.abs(floor.vertices[:, :2]).min(1) > 0.35
    assert np.isinf(found.uncertainty[under]).all() and (found.views[under] == 0).all()
    assert np.isfinite(found.uncertainty[beside]).all() and (found.views[beside] == 4).all()
    told = summary(floor, found)
    assert told.guessed == pytest.approx(0.2, abs=0.06)  # The wall's shadow is 0.48 m wide, and seen from two sides.
    assert sum(told.seen_by) == pytest.approx(1, abs=1e-3)


def test_the_guessed_part_of_a_body_is_reported():
    block = cube(0.4, (0, 0, 0.2))
    views = [look_at(np.array([2 * np.cos(a), 2 * np.sin(a), 1.2])) for a in np.arange(8) * np.pi / 4]
    found = evidence_of(Visibility(block, 1e-3, Caster(joined([block, plate(4)]))), views)
    told = summary(block, found)
    # A sixth, and a half of the lowest triangles around it.
    assert told.guessed == pytest.approx(1 / 6 + 1 / 24, abs=0.005)
    report = {"trust": {"scenery": told, "object1": told}, "weak": 0.0, "next_photos": []}
    lines = " / ".join(notes({"mesh": report}))
    assert "object1: 21% of its surface is guessed, fewer than two photos see it" in lines


def test_attributes_survive_and_other_programs_read_the_mesh(tmp_path):
    block = cube(0.4)
    block = replace(block, colors=np.full(block.vertices.shape, 90, np.uint8))
    sure = np.where(np.arange(len(block.vertices)) == 3, np.inf, 0.001).astype(np.float32)
    views, path = np.arange(len(sure), dtype=np.int32), tmp_path / "block.ply"
    path.write_bytes(write_ply(block, {"views": views, "uncertainty": sure}))
    found = read_attributes(path, ["views", "uncertainty"])
    assert np.array_equal(found[0], views) and np.array_equal(found[1], sure)
    theirs: Any = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_array_equal(theirs.vertices, block.vertices)
    with pytest.raises(SdfsimError, match="without weight"):
        read_attributes(path, ["weight"])


class Photographed:
    """The box on a floor within four walls of `photo_sets`, as photos from some poses show it."""

    def __init__(self, poses: list[np.ndarray]) -> None:
        make = studio()
        # The walls are sheets that photos show from one side; here the box and its floor are enough.
        parts = still_life(make, 1)
        box = Mesh(np.asarray(parts[0].vertices, float), np.asarray(parts[0].faces, np.int64))
        self.box = finer(box)
        ground = trimesh.creation.box((3.0, 3.0, 0.1)).apply_translation((0, 0, -0.05))
        self.meshes = {"scene": finer(Mesh(np.asarray(ground.vertices), np.asarray(ground.faces))), "box": self.box}
        whole = joined(list(self.meshes.values()))
        self.caster, self.sight = Caster(whole), Visibility(whole, 2e-3, None)
        self.views = [view_of(make, pose, number) for number, pose in enumerate(poses)]
        self.vertices = whole.vertices

    def evidence(self, more: list[View] | None = None) -> Evidence:
        return evidence_of(self.sight, [*self.views, *(more or [])])

    def advice(self) -> tuple[list[Proposal], list[View], float]:
        counted = self.vertices[:, 2] > -1e-3
        return next_photos(self.meshes, self.evidence(), self.sight, self.caster, self.views, counted)

    def unseen(self, more: list[View] | None = None) -> float:
        """Share of the box's vertices above the floor that fewer than two photos see."""
        own = slice(len(self.vertices) - len(self.box.vertices), None)
        above = self.vertices[own, 2] > 0.01
        return float((self.evidence(more).views[own][above] < 2).mean())


def finer(mesh: Mesh) -> Mesh:
    """The mesh in triangles of 7 cm at most."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.07)[:2]
    made = trimesh.Trimesh(vertices, faces, process=True)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64))


def view_of(make, pose: np.ndarray, number: int) -> View:
    rotation = FLIP @ pose[:3, :3].T
    name = f"{number:03d}.jpg"
    return View(name, name, make.WIDTH, make.HEIGHT, make.FOCAL, make.WIDTH / 2, make.HEIGHT / 2, 0.0, rotation,
                -rotation @ pose[:3, 3])  # fmt: skip


def test_photos_of_one_half_ask_for_the_other_half():
    """Photos from the side of +y alone: the proposals stand at -y, and with them little of the box is left unseen."""
    set_up = Photographed(orbit(12, span=180.0))
    photos, views, weak = set_up.advice()
    assert len(photos) == 3 and weak > 0.05
    places = np.array([view.center for view in views])
    assert (places[:, 1] < -0.3).all() and (places[:, 2] > 0.05).all()
    gains = [photo.gain for photo in photos]
    assert gains == sorted(gains, reverse=True) and 0.5 < sum(gains) <= 1
    before, after = set_up.unseen(), set_up.unseen(views)
    assert before > 0.2 and after < 0.5 * before
    for photo, view in zip(photos, views, strict=True):
        assert "stand where 0" in photo.words and "around the scene to your" in photo.words
        assert "looking at " in photo.words
        # The camera does look there.
        pixels, depth = view.project(np.array([photo.looking_at]))
        np.testing.assert_allclose(pixels[0], [view.cx, view.cy], atol=1e-6)
        assert depth[0] > 0
    text = " / ".join(improvements({
        "poses": {}, "photos": [], "psnr": None, "failed_checks": [],
        "stages": {"mesh": {"next_photos": photos}},
    }, Options()))  # fmt: skip
    assert photos[0].words in text and f"{places[0][0]:.2f}" in text


def test_where_all_is_photographed_nothing_is_asked_for():
    set_up = Photographed(orbit(36))
    photos, _, weak = set_up.advice()
    assert photos == []
    told = notes({"mesh": {"trust": {}, "weak": weak, "next_photos": []}})
    assert any("no single photo would help much" in line for line in told)


def turned(profile: Sequence[tuple[float, float]]) -> Mesh:
    """A solid of revolution with vertices every few millimetres along its profile."""
    corners = np.array(profile, float)
    line = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.linalg.norm(end - start) / 0.008))
        line.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    return Mesh(*photo_sets.studio().lathe(np.concatenate(line)))


CUP = turned([(0, 0), (0.08, 0), (0.08, 0.16), (0.062, 0.16), (0.062, 0.03), (0, 0.03)])
FILLED = turned([(0, 0), (0.08, 0), (0.08, 0.16), (0.062, 0.16), (0.062, 0.12), (0, 0.12)])


def seen(mesh: Mesh, elevation: float, count: int = 12) -> Evidence:
    views = ring(count, 1.0, elevation, 640, 480, 1500.0, (0, 0, 0.1))
    return evidence_of(Visibility(mesh, 1e-3), views)


def told(mesh: Mesh, *evidence: Evidence) -> tuple[Hollow, str]:
    found = hollow(mesh, 0.01, *evidence)
    return found, hollow_line("cup", found)


def test_a_cup_is_as_deep_and_as_thick_as_it_is():
    found, line = told(CUP, seen(CUP, 75))
    assert (found.depth, found.below) == (pytest.approx(0.13, abs=1e-3), pytest.approx(0.03, abs=1e-3))
    assert found.wall == pytest.approx(0.018, rel=0.02)
    start = "cup: hollow, 0.13 m deep below its rim, on a floor 0.03 m thick; "
    assert line.startswith(f"{start}{found.seen} photos see its bottom")


def test_whether_photos_see_the_bottom_is_a_matter_of_rays():
    """The opening is 0.124 m wide and the bottom 0.13 m below it: its middle is in sight from 64.5 degrees up."""
    assert told(CUP, seen(CUP, 72))[0].seen >= 6
    low, line = told(CUP, seen(CUP, 40))
    assert low.seen == 0 and "; no photo sees its bottom" in line
    assert told(CUP)[0].seen == 0


def test_what_is_below_a_shallow_hollow_is_solid_only_if_photos_see_its_bottom():
    steep, line = told(FILLED, seen(FILLED, 70))
    assert steep.depth == pytest.approx(0.04, abs=1e-3) and steep.seen >= 3
    assert "hollow to 0.04 m below its rim; " in line and "the 0.12 m below that are solid" in line
    flat, line = told(FILLED, seen(FILLED, 15))
    assert flat.seen == 0
    assert "0.04 m below its rim or deeper; no photo sees its bottom, the 0.12 m below are a guess" in line


def test_a_wall_is_as_thick_as_it_is_only_where_photos_see_both_its_sides():
    both = np.concatenate([seen(CUP, 60).views[None], seen(CUP, 15).views[None]]).sum(0)
    evidence = seen(CUP, 60)
    together = Evidence(evidence.vertices, evidence.normals, both, evidence.information)
    found, line = told(CUP, together)
    assert found.wall_seen > 0.5 and line.endswith("; its wall is 18 mm thick")
    found, line = told(CUP, seen(CUP, 10))
    assert found.wall_seen < 0.1 and "the thickness of its wall is unknown" in line


def test_what_holds_no_water_is_not_hollow():
    assert hollow(FILLED, 0.05) is None
    assert hollow(Mesh(*photo_sets.ring((0, 0, 0.05), 0.1, 0.04)), 0.01) is None


def test_a_small_hole_in_a_thin_floor_does_not_hide_the_hollow():
    """As where a field lost the floor of a vase: 32 mm of a bottom of 124 mm. A tube, open below, holds no water."""
    near = np.linalg.norm(CUP.vertices[:, :2], axis=1)[CUP.faces].max(1) < 0.018
    found, line = told(Mesh(CUP.vertices, CUP.faces[~(near & (CUP.vertices[CUP.faces][..., 2].max(1) < 0.031))]))
    assert found.depth == pytest.approx(0.13, abs=1e-3)
    assert found.holes == pytest.approx((16 / 62) ** 2, abs=0.015) and "% of its floor was not found" in line
    assert told(CUP)[0].holes == 0 and "hole" not in told(CUP)[1]
    tube = trimesh.creation.annulus(r_min=0.05, r_max=0.08, height=0.16)
    assert hollow(Mesh(np.asarray(tube.vertices), np.asarray(tube.faces, np.int64)), 0.01) is None
