"""Shape folders: what is saved comes back, what is spoiled is told; grids and exact meshes in place of the network,
and the cache of fitted shapes."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import replacing
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.sdf.closed_forms import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.sdf.fit import train as fit_module
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape import make
from sdfsim.shape import shape as shape_module
from sdfsim.shape.make import analytic_shape, mesh_shape, shape_from_mesh, shape_from_primitive
from sdfsim.shape.shape import Shape, load_shape, scaled, with_sdf
from tests.helpers.shapes import fitted


def test_a_saved_shape_comes_back_bit_for_bit(tmp_path: Path) -> None:
    shape = fitted()
    shape.save(tmp_path / "deep" / "ring")
    back = load_shape(tmp_path / "deep" / "ring")
    assert sorted(p.name for p in (tmp_path / "deep" / "ring").iterdir()) == [
        "mesh.ply",
        "shape.json",
        "shape.safetensors",
    ]
    assert (back.name, back.volume, back.certificate, back.source) == (
        shape.name,
        shape.volume,
        shape.certificate,
        shape.source,
    )
    for key in ("nodes", "com", "inertia"):
        np.testing.assert_array_equal(getattr(back, key), getattr(shape, key))
    for key in ("vertices", "faces", "colors"):
        np.testing.assert_array_equal(getattr(back.mesh, key), getattr(shape.mesh, key))
    for piece, expected in zip(back.pieces, shape.pieces, strict=True):
        np.testing.assert_array_equal(piece, expected)
    np.testing.assert_array_equal(back.sdf.bounds, shape.sdf.bounds)
    points = torch.rand(50, 3, dtype=torch.float64) + torch.tensor([0.5, 1.5, 2.5])
    for one, other in zip(back.sdf(points), shape.sdf(points), strict=True):
        assert torch.equal(one, other)
    record = json.loads((tmp_path / "deep" / "ring" / "shape.json").read_text())
    assert record["units"] == "m"
    assert record["scale"] == 0.3


@pytest.mark.parametrize(
    "shape",
    [
        analytic_shape("plane"),
        analytic_shape("sphere", radius=0.2),
        analytic_shape("box", size=(1, 2, 3), name="crate"),
    ],
)
def test_analytic_shapes_have_folders_too(tmp_path: Path, shape: Shape) -> None:
    back = load_shape(shape.save(tmp_path / shape.name))
    assert type(back.sdf) is type(shape.sdf)
    points = np.random.default_rng(0).normal(size=(30, 3))
    np.testing.assert_array_equal(back.sdf(points)[0], shape.sdf(points)[0])
    np.testing.assert_array_equal(back.nodes, shape.nodes)
    np.testing.assert_array_equal(back.sdf.bounds, shape.sdf.bounds)


def test_a_failed_write_leaves_no_complete_looking_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted().save(tmp_path)

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shape_module, "write_bytes", full)
    with pytest.raises(SdfsimError, match="No space left"):
        fitted().save(tmp_path)
    with pytest.raises(SdfsimError, match=r"shape\.json is missing"):
        load_shape(tmp_path)


def test_analytic_mass_properties_and_nodes() -> None:
    ball = analytic_shape("sphere", radius=0.4)
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 0.064)
    np.testing.assert_allclose(ball.inertia, 0.4 * ball.volume * 0.16 * np.eye(3))
    assert ball.nodes.shape == (128, 3)
    np.testing.assert_allclose(np.linalg.norm(ball.nodes, axis=1), 0.4)
    np.testing.assert_allclose(ball.nodes.mean(0), 0, atol=2e-3)
    crate = analytic_shape("box", size=(0.2, 0.4, 1.0))
    assert crate.volume == pytest.approx(0.08)
    np.testing.assert_allclose(crate.inertia, 0.08 / 12 * np.diag([1.16, 1.04, 0.2]))
    assert len(crate.nodes) == 98
    assert isinstance(crate.sdf, BoxSdf)
    np.testing.assert_allclose(crate.sdf(crate.nodes)[0], 0, atol=1e-15)
    np.testing.assert_allclose(np.abs(crate.nodes[:8]), np.tile([0.1, 0.2, 0.5], (8, 1)))
    floor = analytic_shape("plane", name="floor")
    assert isinstance(floor.sdf, PlaneSdf)
    assert floor.nodes.shape == (0, 3)
    assert floor.name == "floor"


def test_scaling_scales_everything() -> None:
    small, large = analytic_shape("sphere", radius=0.1), scaled(analytic_shape("sphere", radius=0.1), 3.0)
    assert isinstance(large.sdf, SphereSdf)
    expected = analytic_shape("sphere", radius=0.3)
    assert large.volume == pytest.approx(expected.volume)
    np.testing.assert_allclose(large.inertia, expected.inertia)
    np.testing.assert_allclose(large.nodes, expected.nodes)
    assert scaled(small, 1.0) is small
    shape = fitted()
    twice = scaled(shape, 2.0)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.1 + [1, 2, 3]
    np.testing.assert_allclose(twice.sdf(2 * points)[0], 2 * shape.sdf(points)[0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(twice.sdf.bounds, 2 * shape.sdf.bounds)
    np.testing.assert_array_equal(twice.pieces[2], 2 * shape.pieces[2])
    with pytest.raises(SdfsimError, match="> 0"):
        scaled(shape, 0.0)


@pytest.mark.parametrize("layers", [0, -1, 1, 2, 4, 10**30, "3.5", None, [3], True])
def test_layers_that_are_not_there_are_reported(tmp_path: Path, layers) -> None:
    folder = fitted().save(tmp_path / "shape")
    record = json.loads((folder / "shape.json").read_text())
    record["sdf"]["layers"] = layers
    (folder / "shape.json").write_text(json.dumps(record))
    with pytest.raises(SdfsimError, match="shape: not a valid shape folder"):
        load_shape(folder)


@pytest.mark.parametrize("key", ["name", "sdf", "volume", "com", "inertia", "certificate", "source", "pieces"])
@pytest.mark.parametrize("value", [None, [], {}, 0, -1, "x", [[]], {"kind": []}, True])
def test_whatever_a_record_holds_is_read_or_reported(tmp_path: Path, key: str, value) -> None:
    folder = fitted().save(tmp_path / "shape")
    record = json.loads((folder / "shape.json").read_text()) | {key: value}
    (folder / "shape.json").write_text(json.dumps(record))
    try:
        load_shape(folder)
    except SdfsimError as error:
        assert "not a valid shape folder" in error.message


def test_threads_that_write_one_file_leave_it_whole(tmp_path: Path) -> None:
    """Each writes another content again and again; whoever reads finds one of them, and nothing else is left."""
    file = tmp_path / "file"

    def write(letter: str) -> None:
        for _ in range(50):
            with replacing(file) as partial:
                with partial.open("w") as handle:
                    for _ in range(20):
                        handle.write(letter * 50)
                        handle.flush()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, "abcdefgh"))
    content = file.read_text()
    assert len(content) == 1000 and len(set(content)) == 1 and list(tmp_path.iterdir()) == [file]


OTHERS = [("grid", GridSdf), ("mesh", MeshSdf)]


@pytest.mark.parametrize(("kind", "member"), OTHERS)
def test_another_sdf_of_the_same_shape_survives_saving_and_scaling(tmp_path: Path, kind, member: type) -> None:
    crate = analytic_shape("box", size=(0.4, 0.6, 0.2))
    assert fitted().certificate
    certificate = with_sdf(fitted(), kind, resolution=8).certificate
    assert certificate == ({} if kind == "mesh" else {"walls_lost": 0.0, "passed": True, "reason": "", "caveat": ""})
    shape = with_sdf(crate, kind, resolution=43)
    assert isinstance(shape.sdf, member)
    assert shape.source["sdf"] == kind
    np.testing.assert_array_equal(shape.nodes, crate.nodes)
    assert (shape.volume, shape.mesh) == (crate.volume, crate.mesh)
    np.testing.assert_allclose(shape.sdf.bounds, crate.sdf.bounds)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    np.testing.assert_allclose(shape.sdf(points)[0], crate.sdf(points)[0], atol=0.012)

    back = load_shape(shape.save(tmp_path / "crate"))
    assert type(back.sdf) is member
    assert back.source == shape.source
    for one, other in zip(back.sdf(points), shape.sdf(points), strict=True):
        np.testing.assert_array_equal(one, other)

    large = scaled(back, 3.0)
    np.testing.assert_allclose(large.sdf.bounds, 3 * crate.sdf.bounds)
    np.testing.assert_allclose(large.sdf(3 * points)[0], 3 * shape.sdf(points)[0], atol=1e-6)
    assert type(load_shape(large.save(tmp_path / "large")).sdf) is member


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (lambda folder: with_sdf(analytic_shape("sphere", radius=1.0), "mlp"), "no SDF network"),
        (lambda folder: with_sdf(analytic_shape("plane"), "grid"), "plane"),
        # The folder holds one mesh: an exact SDF of another one would silently become that one's.
        (lambda folder: replace(fitted(), sdf=MeshSdf(primitives.box())).save(folder), "another mesh"),
    ],
)
def test_what_has_no_such_sdf_is_refused(tmp_path: Path, act, told) -> None:
    assert with_sdf(fitted(), "mlp").certificate == fitted().certificate
    with pytest.raises(SdfsimError, match=told):
        act(tmp_path)


@pytest.mark.parametrize(("kind", "member"), OTHERS)
def test_a_mesh_has_a_shape_without_any_fit(kind, member: type) -> None:
    crate = primitives.box((0.4, 0.6, 0.2))
    shape = mesh_shape(crate, name="crate", kind=kind, resolution=43)
    assert isinstance(shape.sdf, member)
    assert shape.volume == pytest.approx(0.048)
    exact = BoxSdf((0.2, 0.3, 0.1))
    assert len(shape.nodes) == 512
    assert np.abs(exact(shape.nodes)[0]).max() < 0.006
    corners = {tuple(np.round(node, 9)) for node in shape.nodes[:8]}
    assert corners == {tuple(np.round(vertex, 9)) for vertex in crate.vertices}
    # What bounds no solid is refused, as a fit refuses it.
    with pytest.raises(SdfsimError, match="open"):
        mesh_shape(Mesh(crate.vertices, crate.faces[2:]), name="open", kind=kind)
    with pytest.raises(SdfsimError):
        mesh_shape(Mesh(crate.vertices, crate.faces[:0]), name="none", kind=kind)


def test_grids_are_cached_by_resolution_and_so_are_exact_meshes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make, "fit_mesh", lambda *args, **kwargs: pytest.fail("fitted"))
    sizes = {}
    for resolution in (8, 12):
        shape = shape_from_primitive("torus", 0.3, tmp_path, sdf="grid", resolution=resolution)
        assert isinstance(shape.sdf, GridSdf)
        sizes[resolution] = shape.sdf.resolution
    assert sizes == {8: 8, 12: 12}
    assert len(list(tmp_path.iterdir())) == 2
    path = tmp_path / "cup.ply"
    path.write_bytes(write_ply(primitives.cone(segments=12)))
    first = shape_from_mesh(path, tmp_path, units=0.01, sdf="mesh")
    monkeypatch.setattr("sdfsim.shape.make.mesh_shape", lambda *args, **kwargs: pytest.fail("sampled again"))
    assert shape_from_primitive("torus", 0.6, tmp_path, sdf="grid", resolution=8).volume > 0
    again = shape_from_mesh(path, tmp_path, units=0.01, sdf="mesh")
    assert isinstance(again.sdf, MeshSdf)
    assert again.volume == first.volume
    assert np.array_equal(again.sdf.mesh.vertices, first.sdf.mesh.vertices)
    assert np.array_equal(again.nodes, first.nodes)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe of a second, for tests of what is around the fit."""
    plan = replace(fit_module.RECIPES["default"], width=16, layers=4, steps=100, batch=256, pool=4000)
    monkeypatch.setitem(fit_module.RECIPES, "default", plan)


def test_a_mesh_is_fitted_once_whatever_it_is_called(
    tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "cup.ply", tmp_path / "mug.ply"
    for path in (first, second):
        path.write_bytes(write_ply(primitives.cone(segments=12)))
    told: list[float] = []
    one = shape_from_mesh(first, tmp_path / "cache", on_progress=lambda fraction, _: told.append(fraction))
    assert told[0] == 0.0
    assert told == sorted(told)
    assert told[-1] == 1.0

    monkeypatch.setattr(make, "fit_mesh", lambda *args, **kwargs: pytest.fail("fitted again"))
    two = shape_from_mesh(second, tmp_path / "cache", units=0.01, name="Mug")
    assert (one.name, two.name) == ("cup", "Mug")
    np.testing.assert_allclose(two.nodes, 0.01 * one.nodes)
    assert one.volume == pytest.approx(two.volume * 1e6)
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_a_damaged_cache_entry_is_fitted_again(tmp_path: Path, quick: None) -> None:
    shape_from_primitive("box", 0.5, tmp_path)
    (entry,) = tmp_path.iterdir()
    (entry / "shape.safetensors").write_bytes(b"short")
    shape = shape_from_primitive("box", 0.5, tmp_path)
    assert np.ptp(shape.mesh.vertices, axis=0).max() == pytest.approx(0.5)
    assert load_shape(entry).name == "box"
    with pytest.raises(SdfsimError, match="teapot"):
        shape_from_primitive("teapot", 0.5, tmp_path)


def test_what_the_cache_knows_a_mesh_by_is_all_that_it_describes(tmp_path: Path, quick: None) -> None:
    """A glTF keeps its vertices in a file beside it: its own bytes say little."""
    import trimesh

    path = tmp_path / "cup.gltf"
    for size in (1.0, 2.0):
        mesh = primitives.box((size, 1.0, 1.0))
        scene = trimesh.Trimesh(mesh.vertices, mesh.faces).scene()
        for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
            (path if name.endswith(".gltf") else tmp_path / name).write_bytes(content)
        shape = shape_from_mesh(path, tmp_path / "cache")
        assert np.ptp(shape.mesh.vertices, axis=0).max() == pytest.approx(size)
    cube = primitives.box()
    colors = np.zeros((len(cube.vertices), 3), dtype=np.uint8)
    digests = {cube.digest(), replace(cube, colors=colors).digest(), replace(cube, colors=colors + 1).digest()}
    assert len(digests) == 3
