from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim.errors import SdfsimError
from sdfsim.shape import asset, plans, primitives
from sdfsim.shape.analytic import BoxSdf, PlaneSdf, SphereSdf
from sdfsim.shape.asset import (
    Shape,
    analytic_shape,
    load_shape,
    scaled,
    with_sdf,
)
from sdfsim.shape.cache import mesh_shape, shape_from_mesh, shape_from_primitive
from sdfsim.shape.exact import MeshSdf
from sdfsim.shape.grid import GridSdf
from sdfsim.shape.mass import mass_properties_of_sdf
from sdfsim.shape.mesh import Frame, Mesh
from sdfsim.shape.mlp import MlpSdf
from sdfsim.shape.storage import write_ply


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe of a second, for tests of what is around the fit."""
    plan = replace(plans.PLANS["default"], width=16, layers=4, steps=100, batch=256, pool=4000)
    monkeypatch.setitem(plans.PLANS, "default", plan)


def fitted() -> Shape:
    torch.manual_seed(0)
    weights = (torch.randn(8, 3), torch.randn(8, 8), torch.randn(1, 8))
    sdf = MlpSdf(
        weights,
        (torch.randn(8), torch.randn(8), torch.randn(1)),
        "wave",
        Frame(np.array([1.0, 2.0, 3.0]), 0.3),
        np.array([[0.9, 1.9, 2.85], [1.1, 2.1, 3.15]]),
    )
    mesh = primitives.torus(segments=8, sides=5)
    colors = np.arange(len(mesh.vertices) * 3, dtype=np.uint8).reshape(-1, 3)
    return Shape(
        name="ring",
        mesh=Mesh(mesh.vertices, mesh.faces, colors),
        sdf=sdf,
        nodes=np.random.default_rng(0).random((20, 3)),
        volume=0.125,
        com=np.array([0.1, 0.2, 0.3]),
        inertia=np.diag([1.0, 2.0, 3.0]) / 3,
        certificate={"passed": False, "reason": "thin walls", "error_in_box": 0.01},
        source={"file": "ring.obj"},
    )


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


def test_saving_again_replaces_and_leaves_nothing_behind(tmp_path: Path) -> None:
    fitted().save(tmp_path)
    replace(fitted(), name="other").save(tmp_path)
    assert load_shape(tmp_path).name == "other"
    assert len(list(tmp_path.iterdir())) == 3


def edit(folder: Path, **changes: object) -> None:
    record = json.loads((folder / "shape.json").read_text())
    (folder / "shape.json").write_text(json.dumps({**record, **changes}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "shape.json").unlink(), "shape.json is missing"),
        (lambda f: (f / "shape.safetensors").unlink(), "shape.safetensors is missing"),
        (lambda f: (f / "mesh.ply").write_bytes((f / "mesh.ply").read_bytes()[:300]), "mesh.ply: damaged"),
        (
            lambda f: (f / "shape.safetensors").write_bytes((f / "shape.safetensors").read_bytes()[:-50]),
            "shape.safetensors: damaged or cut short",
        ),
        (lambda f: (f / "shape.json").write_text("{"), "shape.json: cannot be read"),
        (lambda f: edit(f, version=99), "version 99"),
        (lambda f: edit(f, sdf={"kind": "magic"}), "unknown SDF kind"),
        (lambda f: edit(f, sdf={"kind": "mlp"}), "is missing"),
        (lambda f: edit(f, com=[1, 2]), "not a valid shape folder"),
        (lambda f: edit(f, volume="large"), "not a valid shape folder"),
    ],
)
def test_a_spoiled_folder_is_one_clear_line(tmp_path: Path, spoil, message: str) -> None:
    fitted().save(tmp_path / "ring")
    spoil(tmp_path / "ring")
    with pytest.raises(SdfsimError) as error:
        load_shape(tmp_path / "ring")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert str(tmp_path / "ring") in str(error.value)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    shape = fitted()
    assert isinstance(shape.sdf, MlpSdf)
    shape.sdf.weights[1][0, 0] = float("nan")
    shape.save(tmp_path)
    with pytest.raises(SdfsimError, match="not finite"):
        load_shape(tmp_path)


def test_no_folder_and_no_place_to_write(tmp_path: Path) -> None:
    with pytest.raises(SdfsimError, match="no such shape folder"):
        load_shape(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(SdfsimError, match="cannot write"):
        fitted().save(tmp_path / "file" / "ring")


def test_a_failed_write_leaves_no_complete_looking_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted().save(tmp_path)

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(asset, "write", full)
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


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("sphere", {}, "radius"),
        ("sphere", {"radius": -1.0}, "> 0"),
        ("box", {}, "size"),
        ("box", {"size": (1.0, 0.0, 1.0)}, "> 0"),
        ("blob", {}, "unknown"),
    ],
)
def test_bad_analytic_shapes_are_refused(kind, options: dict, message: str) -> None:
    with pytest.raises(SdfsimError, match=message):
        analytic_shape(kind, **options)


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
    with pytest.raises(SdfsimError, match="> 0"):
        scaled(shape, 0.0)


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

    from sdfsim.shape import fit

    monkeypatch.setattr(fit, "fit_mesh", lambda *args, **kwargs: pytest.fail("fitted again"))
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


def test_a_cache_that_cannot_be_written_does_not_lose_the_fit(
    tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    assert shape_from_primitive("box", 0.5, tmp_path / "file" / "cache").name == "box"
    assert "not kept" in caplog.text and len(caplog.records) == 1

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(asset, "write", full)
    assert shape_from_primitive("box", 0.5, tmp_path / "cache").name == "box"
    assert "No space left" in caplog.text
    assert list((tmp_path / "cache").iterdir()) == []


OTHERS = [("grid", GridSdf), ("mesh", MeshSdf)]


@pytest.mark.parametrize(("kind", "member"), OTHERS)
def test_another_sdf_of_the_same_shape_survives_saving_and_scaling(tmp_path: Path, kind, member: type) -> None:
    crate = analytic_shape("box", size=(0.4, 0.6, 0.2))
    assert fitted().certificate
    assert with_sdf(fitted(), kind, resolution=8).certificate == {}
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


def test_what_has_no_such_sdf_is_refused(tmp_path: Path) -> None:
    assert with_sdf(fitted(), "mlp").certificate == fitted().certificate
    with pytest.raises(SdfsimError, match="no SDF network"):
        with_sdf(analytic_shape("sphere", radius=1.0), "mlp")
    with pytest.raises(SdfsimError, match="plane"):
        with_sdf(analytic_shape("plane"), "grid")
    # The folder holds one mesh: an exact SDF of another one would silently become that one's.
    other = replace(fitted(), sdf=MeshSdf(primitives.box()))
    with pytest.raises(SdfsimError, match="another mesh"):
        other.save(tmp_path)


def test_a_spoiled_grid_is_one_clear_line(tmp_path: Path) -> None:
    shape = with_sdf(analytic_shape("sphere", radius=1.0), "grid", resolution=8)
    assert isinstance(shape.sdf, GridSdf)
    folder = shape.save(tmp_path)
    record = json.loads((folder / "shape.json").read_text())
    for sdf in ({**record["sdf"], "centre": [0.0]}, {**record["sdf"], "scale": None}, {"kind": "grid"}):
        edit(folder, sdf=sdf)
        with pytest.raises(SdfsimError, match="not a valid shape folder"):
            load_shape(folder)
    shape.sdf.values[3, 3, 3] = float("inf")
    shape.save(tmp_path)
    with pytest.raises(SdfsimError, match="grid is not finite"):
        load_shape(folder)


@pytest.mark.parametrize(("kind", "member"), OTHERS)
def test_a_mesh_has_a_shape_without_any_fit(kind, member: type) -> None:
    crate = primitives.box((0.4, 0.6, 0.2))
    shape = mesh_shape(crate, name="crate", kind=kind, resolution=43)
    assert isinstance(shape.sdf, member)
    assert shape.volume == pytest.approx(0.048)
    exact = BoxSdf((0.2, 0.3, 0.1))
    assert len(shape.nodes) == 128
    assert np.abs(exact(shape.nodes)[0]).max() < 0.006
    corners = {tuple(np.round(node, 9)) for node in shape.nodes[:8]}
    assert corners == {tuple(np.round(vertex, 9)) for vertex in crate.vertices}
    # What bounds no solid is refused, as a fit refuses it.
    with pytest.raises(SdfsimError, match="open"):
        mesh_shape(Mesh(crate.vertices, crate.faces[2:]), name="open", kind=kind)
    with pytest.raises(SdfsimError):
        mesh_shape(Mesh(crate.vertices, crate.faces[:0]), name="none", kind=kind)


def test_grids_are_cached_by_resolution_and_exact_meshes_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sdfsim.shape import fit

    monkeypatch.setattr(fit, "fit_mesh", lambda *args, **kwargs: pytest.fail("fitted"))
    sizes = {}
    for resolution in (8, 12):
        shape = shape_from_primitive("torus", 0.3, tmp_path, sdf="grid", resolution=resolution)
        assert isinstance(shape.sdf, GridSdf)
        sizes[resolution] = shape.sdf.resolution
    assert sizes == {8: 8, 12: 12}
    assert len(list(tmp_path.iterdir())) == 2
    path = tmp_path / "cup.ply"
    path.write_bytes(write_ply(primitives.cone(segments=12)))
    assert isinstance(shape_from_mesh(path, tmp_path / "none", units=0.01, sdf="mesh").sdf, MeshSdf)
    assert not (tmp_path / "none").exists()
    monkeypatch.setattr("sdfsim.shape.cache.mesh_shape", lambda *args, **kwargs: pytest.fail("sampled again"))
    assert shape_from_primitive("torus", 0.6, tmp_path, sdf="grid", resolution=8).volume > 0


def test_recorded_volume_matches_the_sdf(tmp_path: Path) -> None:
    crate = analytic_shape("box", size=(0.3, 0.2, 0.5))
    volume, _, inertia = mass_properties_of_sdf(crate.sdf)
    assert volume == pytest.approx(crate.volume, rel=0.01)
    np.testing.assert_allclose(inertia, crate.inertia, rtol=0.02, atol=1e-9)
