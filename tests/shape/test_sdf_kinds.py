"""Grids and exact meshes in place of the network."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.sdf.closed_forms import BoxSdf
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.shape.make import analytic_shape, mesh_shape, shape_from_mesh, shape_from_primitive
from sdfsim.shape.shape import load_shape, scaled, with_sdf
from tests.helpers.shapes import fitted

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
    from sdfsim.shape import make

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
