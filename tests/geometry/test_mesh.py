from pathlib import Path

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties, mass_properties_of_sdf
from sdfsim.geometry.mesh import Mesh, clean, is_closed, signed_volume
from sdfsim.geometry.mesh_io import load_mesh, load_pieces, write_ply
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def test_what_is_missing_or_of_another_kind_comes_with_a_way_out(tmp_path: Path) -> None:
    (tmp_path / "vase.obj").write_text(TETRAHEDRON)
    with pytest.raises(SdfsimError, match=r"vaze\.obj: no such mesh file \(did you mean 'vase\.obj'\?\)") as error:
        load_mesh(tmp_path / "vaze.obj")
    assert str(tmp_path) in error.value.hint
    for name, kind in (("a.fbx", "FBX"), ("b.USDZ", "USD"), ("c.blend", "Blender")):
        (tmp_path / name).write_bytes(b"Kaydara")
        with pytest.raises(SdfsimError, match=f"{kind}.* is not supported") as error:
            load_mesh(tmp_path / name)
        assert "glb" in error.value.hint and "Blender" in error.value.hint


@pytest.mark.parametrize("suffix", ["obj", "stl", "glb", "ply"])
def test_every_format_gives_the_same_closed_solid(tmp_path: Path, suffix: str) -> None:
    import trimesh

    solid = primitives.torus(segments=16, sides=8)
    path = tmp_path / f"torus.{suffix}"
    if suffix == "ply":
        path.write_bytes(write_ply(solid))
    else:
        trimesh.Trimesh(solid.vertices, solid.faces, process=False).export(path)
    loaded = load_mesh(path)
    assert is_closed(loaded)
    assert len(loaded.vertices) == len(solid.vertices)
    assert mass_properties(loaded)[0] == pytest.approx(mass_properties(solid)[0], rel=1e-5)


def test_cleaning_merges_drops_and_turns_right_side_out() -> None:
    solid = primitives.box((1.0, 2.0, 3.0))
    soup = solid.vertices[solid.faces].reshape(-1, 3)
    faces = np.arange(len(soup)).reshape(-1, 3)[:, ::-1]
    faces = np.concatenate([faces, faces[:4], [[0, 0, 1]]])
    result = clean(Mesh(np.concatenate([soup, [[9.0, 9.0, 9.0]]]), faces))
    assert result.vertices.shape == (8, 3)
    assert result.faces.shape == (12, 3)
    assert is_closed(result)
    assert signed_volume(result) == pytest.approx(6.0)


def test_of_faces_back_to_back_a_wall_goes_and_a_double_sided_one_stays_once() -> None:
    half = primitives.box((0.5, 1.0, 1.0))
    halves = [Mesh(half.vertices + np.array([x, 0, 0]), half.faces) for x in (-0.25, 0.25)]
    cells = np.concatenate([mesh.vertices for mesh in halves])
    doubled = half.vertices + np.array([3.0, 0, 0])
    faces = [half.faces, half.faces + 8, half.faces + 16, half.faces[:, ::-1] + 16]
    result = clean(Mesh(np.concatenate([cells, doubled]), np.concatenate(faces)))
    assert is_closed(result)
    assert len(result.faces) == 20 + 12
    assert signed_volume(result) == pytest.approx(1.5)


def test_cleaning_keeps_colours_with_their_vertices() -> None:
    solid = primitives.box()
    colors = np.arange(24, dtype=np.uint8).reshape(8, 3)
    result = clean(Mesh(solid.vertices, solid.faces, colors))
    for vertex, color in zip(result.vertices, result.colors, strict=True):
        original = int(np.abs(solid.vertices - vertex).sum(1).argmin())
        assert (color == colors[original]).all()


def test_box_mass_properties_are_exact_wherever_it_is() -> None:
    size, turn, shift = np.array([0.3, 1.1, 2.0]), rotation(3), np.array([1e4, -2e3, 50.0])
    solid = primitives.box(tuple(size))
    volume, com, inertia = mass_properties(Mesh(solid.vertices @ turn.T + shift, solid.faces))
    expected = size.prod() / 12 * np.diag((size**2).sum() - size**2)
    assert volume == pytest.approx(size.prod(), rel=1e-9)
    np.testing.assert_allclose(com, shift, atol=1e-8)
    np.testing.assert_allclose(inertia, turn @ expected @ turn.T, atol=1e-8)


@pytest.mark.parametrize(
    ("sdf", "volume", "inertia"),
    [
        (SphereSdf(0.3), 4 / 3 * np.pi * 0.027, [0.4 * 0.09] * 3),
        (BoxSdf((0.1, 0.4, 0.2)), 0.064, np.array([0.2, 0.05, 0.17]) / 3),
    ],
)
def test_grid_integrals_agree_with_closed_forms(sdf, volume: float, inertia) -> None:
    got, com, moment = mass_properties_of_sdf(sdf, sdf.bounds)
    assert got == pytest.approx(volume, rel=5e-3)
    np.testing.assert_allclose(com, 0, atol=1e-9)
    np.testing.assert_allclose(moment, volume * np.diag(inertia), rtol=1e-2, atol=1e-9)


def test_pieces_are_the_hulls_of_the_groups(tmp_path: Path) -> None:
    cube = primitives.box().vertices
    lines = []
    for name, shift in (("a", 0.0), ("b", 5.0)):
        lines.append(f"o {name}")
        lines += [f"v {x + shift} {y} {z}" for x, y, z in [*cube, (0.0, 0.0, 0.0)]]
    path = tmp_path / "pieces.obj"
    path.write_text("\n".join(lines))
    pieces = load_pieces(path)
    assert len(pieces) == 2
    for piece, shift in zip(pieces, (0.0, 5.0), strict=True):
        volume, com, _ = mass_properties(piece)
        assert volume == pytest.approx(1.0)
        np.testing.assert_allclose(com, [shift, 0, 0], atol=1e-12)
