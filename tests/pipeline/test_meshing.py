"""The mesh stage as a whole, on a field that is drawn by hand: a table with a cup on it, and a speck in the air."""

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
from pipeline.mesh import meshing, photo_refining
from pipeline.mesh.extraction import sample_box
from pipeline.mesh.meshing import make_meshes, read_parts, trust_meshes
from pipeline.mesh.photo_refining import GreyPhoto, refine
from pipeline.mesh.placement import load_placement
from pipeline.mesh.trust import GUESSED
from pipeline.options import options_of
from pipeline.records import MeshReport
from pipeline.report import mesh_notes
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, face_normals, is_closed
from sdfsim.geometry.mesh_io import load_mesh, read_attributes, read_mesh
from tests.helpers.surfaces import TABLE, TOP, both, box, look_at

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
