"""Meshes: read, cleaned, measured, and made solids, whatever their faces; winding numbers and primitives."""

import time
from pathlib import Path

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.bvh import Around
from sdfsim.geometry.mass import mass_properties, mass_properties_of_sdf
from sdfsim.geometry.mesh import Mesh, clean, is_closed, joined, sample_surface, signed_volume
from sdfsim.geometry.mesh_io import load_mesh, load_pieces, write_ply
from sdfsim.geometry.primitives import PRIMITIVES, convex_pieces, sphere
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.sdf.reference import MeshDistance, PiecesDistance
from tests.helpers.surfaces import cube

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


CUBE = primitives.box()
BALL = primitives.sphere(0.5, subdivisions=4)


def moved(mesh: Mesh, *shift: float) -> Mesh:
    return Mesh(mesh.vertices + np.array(shift), mesh.faces)


def inverted(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1])


def both(*meshes: Mesh) -> Mesh:
    return joined(list(meshes))


def sheet(*corners: tuple[float, float, float]) -> Mesh:
    return Mesh(np.array(corners, dtype=float), np.array([[0, 1, 2], [0, 2, 3]]))


def flipped(mesh: Mesh, fraction: float) -> Mesh:
    chosen = np.random.default_rng(1).random(len(mesh.faces)) < fraction
    return Mesh(mesh.vertices, np.where(chosen[:, None], mesh.faces[:, ::-1], mesh.faces))


def without_lid(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[~(mesh.vertices[mesh.faces][:, :, 2] > 0.49).all(1)])


def lid_of(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[(mesh.vertices[mesh.faces][:, :, 2] > 0.49).all(1)])


def finer_cube(count: int) -> Mesh:
    """The same cube with a grid of faces on each side, and no vertex shared between sides."""
    axis = np.linspace(-0.5, 0.5, count + 1)
    u, v = (grid.reshape(-1) for grid in np.meshgrid(axis, axis, indexing="ij"))
    index = np.arange(len(u)).reshape(count + 1, count + 1)
    a, b, c, d = (index[i : count + i, j : count + j].reshape(-1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    sides = []
    for axis_ in range(3):
        for sign in (1, -1):
            side = np.roll(np.stack([u, v, np.full(len(u), 0.5 * sign)], 1), axis_, axis=1)
            sides.append(Mesh(side, faces if sign == 1 else faces[:, ::-1]))
    return joined(sides)


def box_distance(points: np.ndarray, half=(0.5, 0.5, 0.5), centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    return BoxSdf(half)(points - np.array(centre))[0]


def query(half: float = 0.9, count: int = 4000) -> np.ndarray:
    return np.random.default_rng(5).uniform(-half, half, (count, 3))


CUBES = {
    "plain": CUBE,
    "faces turned at random": flipped(CUBE, 0.4),
    "all inverted": inverted(CUBE),
    "every face twice, vertices not shared": both(CUBE, CUBE),
    "drawn from both sides": both(CUBE, inverted(CUBE)),
    "twice, with other triangles": both(CUBE, finer_cube(3)),
    "sides that do not share vertices": finer_cube(4),
    "a lid that meets the sides in cracks": both(without_lid(CUBE), lid_of(finer_cube(7))),
    "two touching halves": both(*(moved(primitives.box((0.5, 1, 1)), x, 0, 0) for x in (-0.25, 0.25))),
    "halves of unlike triangles": both(
        moved(Mesh(finer_cube(5).vertices * [0.5, 1, 1], finer_cube(5).faces), -0.25, 0, 0),
        moved(primitives.box((0.5, 1, 1)), 0.25, 0, 0),
    ),
    "coplanar overlap": both(*(moved(primitives.box((0.7, 1, 1)), x, 0, 0) for x in (-0.15, 0.15))),
    "a shell inside": both(CUBE, primitives.box((0.4, 0.5, 0.6))),
}


@pytest.mark.parametrize(
    ("kind", "scale", "shift"),
    [*((kind, 1.0, 0.0) for kind in CUBES), ("coplanar overlap", 1e-3, 0.0), ("coplanar overlap", 1.0, 1e4)],
)
def test_whatever_its_faces_a_cube_is_a_cube(kind: str, scale: float, shift: float) -> None:
    mesh = Mesh(CUBES[kind].vertices * scale + shift, CUBES[kind].faces)
    solid = solidify(mesh, name=kind)
    points = query()
    got = MeshDistance(solid)(points * scale + shift)
    np.testing.assert_allclose(got.distance / scale, box_distance(points), atol=1e-5)
    foot = np.linalg.norm(points * scale + shift - got.closest, axis=1)
    np.testing.assert_allclose(foot / scale, np.abs(box_distance(points)), atol=1e-5)
    volume, com, inertia = solid.mass_properties()
    # Where faces were cut, along the seam of the parts that lie on each other.
    near = 1e-3 if kind == "coplanar overlap" else 1e-6
    assert volume / scale**3 == pytest.approx(1.0, rel=near)
    np.testing.assert_allclose((com - shift) / scale, 0, atol=near)
    np.testing.assert_allclose(inertia / scale**5, np.eye(3) / 6, atol=near)


def test_overlapping_cubes_are_their_union() -> None:
    shift = (0.5, 0.3, 0.2)
    solid = solidify(both(CUBE, moved(CUBE, *shift)))
    points = query(1.3)
    truth = np.minimum(box_distance(points), box_distance(points, centre=shift))
    got = MeshDistance(solid)(points).distance
    np.testing.assert_array_equal(got < 0, truth < 0)
    np.testing.assert_allclose(got[truth > 0], truth[truth > 0], atol=5e-3)
    assert np.abs(got - truth)[truth > 0].mean() < 1e-4
    # Within, the smaller of the two depths is only a lower bound for that of the union.
    assert (got[truth < 0] < truth[truth < 0] + 5e-3).all()
    volume, com, _ = solid.mass_properties()
    assert volume == pytest.approx(2 - 0.5 * 0.7 * 0.8, rel=1e-3)
    np.testing.assert_allclose(com, np.array(shift) / 2, atol=1e-3)
    assert "left out" in solid.notes[-1]


@pytest.mark.parametrize("whole", [False, True])
def test_a_shell_wound_the_other_way_is_a_cavity(whole: bool) -> None:
    hollow = both(CUBE, inverted(primitives.box((0.8, 0.8, 0.8))))
    solid = solidify(inverted(hollow) if whole else hollow)
    points = query()
    truth = np.maximum(box_distance(points), -box_distance(points, (0.4, 0.4, 0.4)))
    got = MeshDistance(solid)(points).distance
    np.testing.assert_array_equal(got < 0, truth < 0)
    np.testing.assert_allclose(got[truth < 0], truth[truth < 0], atol=1e-6)
    assert solid.mass_properties()[0] == pytest.approx(1 - 0.8**3)


def test_separate_bodies_are_turned_outwards_each() -> None:
    solid = solidify(both(moved(CUBE, -1, 0, 0), inverted(moved(CUBE, 1, 0, 0))))
    points = query(1.8)
    truth = np.minimum(box_distance(points, centre=(-1, 0, 0)), box_distance(points, centre=(1, 0, 0)))
    np.testing.assert_allclose(MeshDistance(solid)(points).distance, truth, atol=2e-6)
    assert solid.notes == ("12 of 24 faces turned over, so that all are wound outwards",)


def test_a_crack_all_around_leaves_doubt_only_beside_it() -> None:
    lid = lid_of(finer_cube(7))
    loose = Mesh(lid.vertices * [0.998, 0.998, 1.0], lid.faces)
    solid = solidify(both(without_lid(CUBE), loose))
    assert not solid.closed
    points = query()
    got, truth = MeshDistance(solid)(points), box_distance(points)
    np.testing.assert_array_equal(got.distance < 0, truth < 0)
    np.testing.assert_allclose(got.distance, truth, atol=2e-3)
    assert solid.mass_properties()[0] == pytest.approx(1.0, rel=2e-3)
    at_the_crack = MeshDistance(solid)(np.array([[0.4995, 0.0, 0.5]]))
    assert not at_the_crack.trusted[0]


def test_a_mesh_as_it_is_is_neither_repaired_nor_refused() -> None:
    oracle = MeshDistance(without_lid(CUBE))
    assert not oracle.closed
    got = oracle(np.array([[0.0, 0.0, -0.4], [0.0, 0.0, 0.45], [0.0, 0.0, -0.7]]))
    # At the opening winding numbers are near a half: no side is told.
    assert got.trusted.tolist() == [True, False, True]
    assert (got.distance < 0).tolist()[::2] == [True, False]


def test_a_thin_wall_keeps_its_inside() -> None:
    # 1/200 of the size thick, and a hollow box with such walls.
    for solid, inside in (
        (solidify(primitives.box((1, 1, 0.005))), [0.2, 0.1, 0.0]),
        (solidify(both(CUBE, inverted(primitives.box((0.99, 0.99, 0.99))))), [0.4975, 0.1, 0.2]),
    ):
        assert MeshDistance(solid)(np.array([inside])).distance[0] == pytest.approx(-0.0025, abs=1e-6)


def test_signs_hold_down_to_the_surface() -> None:
    for mesh in (both(CUBE, CUBE, finer_cube(2)), primitives.torus(0.35, 0.15)):
        solid = solidify(mesh)
        points, normals = sample_surface(solid.surface, 3000, np.random.default_rng(0))
        oracle = MeshDistance(solid)
        for step in (1e-3, 1e-4):
            assert np.mean(oracle(points - step * normals).distance < 0) > 0.999
            assert np.mean(oracle(points + step * normals).distance < 0) < 0.001


def test_pinholes_are_closed_and_said() -> None:
    rng = np.random.default_rng(2)
    some = rng.choice(len(BALL.faces), 20, replace=False)
    solid = solidify(flipped(Mesh(BALL.vertices, np.delete(BALL.faces, some, axis=0)), 0.3))
    assert is_closed(solid.surface)
    assert signed_volume(solid.surface) == pytest.approx(signed_volume(BALL), rel=1e-3)
    assert any("small holes closed (0." in note for note in solid.notes)
    assert any("turned over" in note for note in solid.notes)


def test_colours_go_with_what_is_added_and_cut() -> None:
    mesh = both(CUBE, moved(CUBE, 0.5, 0.3, 0.2))
    colors = np.repeat(np.array([[200, 10, 30], [0, 90, 250]], dtype=np.uint8), 8, axis=0)
    surface = solidify(Mesh(mesh.vertices, mesh.faces, colors)).surface
    assert surface.colors is not None and surface.colors.shape == surface.vertices.shape
    assert {tuple(color) for color in surface.colors} == {(200, 10, 30), (0, 90, 250)}


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (without_lid(CUBE), "an opening 1 m across"),
        (sheet((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)), "not a solid"),
        (both(*(sheet((0, 0, z), (1, 0, z), (1, 1, z), (0, 1, z)) for z in (0.0, 0.1))), "2 openings"),
    ],
)
def test_what_is_open_is_refused_in_one_line_with_the_way_out(mesh: Mesh, message: str) -> None:
    with pytest.raises(SdfsimError, match=message) as error:
        solidify(mesh, name="thing")
    assert str(error.value).startswith("thing: ") and "\n" not in error.value.message
    assert "--thicken" in error.value.hint
    # No cap makes a solid of a flat sheet.
    assert ("--cap" in error.value.hint) == ("opening" in message)
    if "opening" not in message:
        with pytest.raises(SdfsimError) as error:
            solidify(mesh, name="thing", cap=True)
        assert "--thicken" in error.value.hint and "--cap" not in error.value.hint


def test_capping_gives_exactly_the_closed_solid() -> None:
    solid = solidify(without_lid(CUBE), cap=True)
    points = query()
    np.testing.assert_allclose(MeshDistance(solid)(points).distance, box_distance(points), atol=1e-6)
    assert solid.mass_properties()[0] == pytest.approx(1.0)
    assert solid.notes == ("1 opening closed (20.0% of the surface, the largest about 1.13 m across)",)


def test_a_cap_over_a_winding_loop_covers_just_the_loop() -> None:
    # A U-shaped prism without its top: its middle is outside, so the fan lies over itself.
    outline = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]]) / 3.0
    floor = np.array([[0, 4, 1], [0, 5, 4], [0, 7, 6], [0, 6, 5], [1, 4, 2], [4, 3, 2]])
    ring = np.arange(8)
    after = np.roll(ring, -1)
    walls = [np.stack([ring, after, after + 8], 1), np.stack([ring, after + 8, ring + 8], 1)]
    vertices = np.concatenate([np.c_[outline, np.zeros(8)], np.c_[outline, np.full(8, 0.3)]])
    solid = solidify(Mesh(vertices, np.concatenate([floor, *walls])), cap=True)
    assert solid.mass_properties()[0] == pytest.approx(0.3 * 7 / 9, rel=3e-3)
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.2, -0.2, -0.2], [1.2, 1.2, 0.5], (3000, 3))
    middle = np.array([0.5, 0.5, 0.15])
    notch = box_distance(points, (1 / 6, 0.5, 1.0), (0.5, 5 / 6, 0.15))
    truth = np.maximum(box_distance(points, (0.5, 0.5, 0.15), tuple(middle)), -notch)
    np.testing.assert_array_equal(MeshDistance(solid)(points).distance < 0, truth < 0)


def test_a_thickened_sheet_is_all_within_half_its_thickness() -> None:
    flat, thickness = sheet((0, 0, 0), (1, 0, 0), (1, 0.5, 0), (0, 0.5, 0)), 0.04
    solid = solidify(flat, thicken=thickness)
    oracle = MeshDistance(solid)
    points = query(1.2)
    truth = np.linalg.norm(points - np.clip(points, [0, 0, 0], [1, 0.5, 0]), axis=1) - thickness / 2
    got = oracle(points)
    np.testing.assert_allclose(got.distance, truth, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(points - got.closest, axis=1), np.abs(truth), atol=1e-6)
    np.testing.assert_allclose(oracle(got.closest).distance, 0, atol=1e-6)
    assert is_closed(solid.surface) and oracle.closed
    np.testing.assert_allclose(oracle(solid.surface.vertices).distance, 0, atol=1e-6)
    radius = thickness / 2
    expected = 0.5 * thickness + 3.0 * np.pi * radius**2 / 2 + 4 / 3 * np.pi * radius**3
    assert solid.mass_properties()[0] == pytest.approx(expected, rel=5e-3)
    on_the_sheet = oracle(np.array([[0.5, 0.25, 0.0]]))
    assert on_the_sheet.distance[0] == pytest.approx(-radius)
    assert np.abs(on_the_sheet.closest[0, 2]) == pytest.approx(radius)


@pytest.mark.parametrize("thickness", [0.001, float("nan"), float("inf")])
def test_a_thickness_that_no_fit_resolves_is_refused(thickness: float) -> None:
    with pytest.raises(SdfsimError, match="thickness"):
        solidify(sheet((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)), thicken=thickness)


def test_long_thin_triangles_take_no_time() -> None:
    sides = 255
    mesh = primitives.cylinder(0.5, 1.0, sides)
    solidify(primitives.cylinder(0.5, 1.0, 8))  # loads what is slow to load
    began = time.process_time()
    solid = solidify(mesh)
    assert time.process_time() - began < 2.0
    assert solid.simple and solid.notes == ()
    assert solid.mass_properties()[0] == pytest.approx(sides / 8 * np.sin(2 * np.pi / sides))
    # Two that cross, of which each is one surface with the other: as much as both, less what both hold.
    other = primitives.cylinder(0.25, 1.0, sides // 4)
    turned = Mesh(np.roll(other.vertices, 1, axis=1) * [1.5, 1.0, 1.0], other.faces)
    began = time.process_time()
    union = solidify(both(mesh, turned))
    assert time.process_time() - began < 6.0
    # A stub of radius r that sticks out of a cylinder of radius R by what its length has over the cylinder's.
    y = np.linspace(-0.25, 0.25, 20001)[1:-1]
    stub = np.trapezoid(2 * np.sqrt(0.0625 - y**2) * 2 * (0.75 - np.sqrt(0.25 - y**2)), y)
    assert union.mass_properties()[0] == pytest.approx(np.pi / 4 + stub, rel=3e-3)
    assert not union.simple and any("left out" in note for note in union.notes)


@pytest.mark.parametrize(
    ("file", "solid"), [("cow", True), ("cheburashka", True), ("alligator", False), ("woody", False), ("beetle", False)]
)
def test_meshes_from_the_field(file: str, solid: bool, data_dir: Path) -> None:
    mesh = load_mesh(data_dir / "meshes" / f"{file}.obj")
    if solid:
        assert solidify(mesh, name=file).mass_properties()[0] > 0
        return
    with pytest.raises(SdfsimError, match="not a solid"):
        solidify(mesh, name=file)
    thick = solidify(mesh, name=file, thicken=0.03 * float(np.ptp(mesh.vertices, axis=0).max()))
    assert is_closed(thick.surface)


# Side, middle of each box, by case: the last two are one box in the same place.
CASES = {
    "crossing": ((1.0, (0, 0, 0)), (0.6, (0.4, 0.3, 0.2))),
    "flush": ((1.0, (0, 0, 0)), (0.5, (0.75, 0.1, 0.0)), (0.5, (0.0, 0.25, 0.75))),
    "one inside the other": ((1.0, (0, 0, 0)), (0.5, (0.1, 0.0, 0.0))),
    "twice in one place": ((1.0, (0, 0, 0)), (1.0, (0, 0, 0))),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (300.0, -200.0, 50.0)])
def test_winding_numbers_count_the_boxes_around_a_point(case, middle):
    boxes = [(side, np.add(at, middle)) for side, at in CASES[case]]
    mesh = joined([Mesh(cube(side).vertices + at, cube(side).faces) for side, at in boxes])
    points = np.random.default_rng(0).uniform(-1, 1.2, (20_000, 3)) + middle
    off = np.array([np.abs(points - at).max(1) - side / 2 for side, at in boxes])  # signed, but beyond edges
    clear = np.abs(off).min(0) > 1e-4
    np.testing.assert_allclose(Around(mesh)(points[clear]), (off[:, clear] < 0).sum(0), atol=0.05)


# Handles of each solid (its genus): V - E + F = 2 - 2 * handles.
HANDLES = {
    "box": 0,
    "sphere": 0,
    "cylinder": 0,
    "cone": 0,
    "torus": 1,
    "gear": 1,
    "torus_knot": 1,
    "bowl": 0,
    "shoe": 0,
}


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_every_primitive_is_a_closed_outward_solid_near_a_metre(kind: str) -> None:
    mesh = PRIMITIVES[kind]()
    assert is_closed(mesh)
    assert signed_volume(mesh) > 0
    assert 0.85 < np.ptp(mesh.vertices, axis=0).max() <= 1.0 + 1e-9
    if kind in HANDLES:
        euler = len(mesh.vertices) - len(mesh.faces) // 2
        assert euler == 2 - 2 * HANDLES[kind]


@pytest.mark.parametrize(
    ("kind", "empty"), [("torus", [0, 0, 0]), ("gear", [0, 0, 0]), ("bowl", [0, 0, -0.2]), ("shoe", [-0.2, 0, 0.05])]
)
def test_holes_are_open(kind: str, empty: list[float]) -> None:
    assert MeshDistance(PRIMITIVES[kind]())(np.array([empty], dtype=float)).distance[0] > 0.02


@pytest.mark.parametrize("kind", [kind for kind in PRIMITIVES if kind != "shoe"])
def test_convex_pieces_fill_the_solid(kind: str) -> None:
    mesh, pieces = PRIMITIVES[kind](), convex_pieces(kind)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    inside = MeshDistance(mesh)(points).distance < 0
    filled = PiecesDistance(pieces).inside(points)
    # Facets of round walls are coarser in the pieces.
    assert (filled & inside).sum() > 0.88 * (filled | inside).sum()


def test_no_pieces_where_there_is_no_simple_way() -> None:
    assert convex_pieces("shoe") == []


def test_sphere_vertices_are_on_the_sphere() -> None:
    mesh = sphere(0.25, subdivisions=2)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.25)
    assert len(mesh.faces) == 320
    assert mass_properties(mesh)[0] < 4 / 3 * np.pi * 0.25**3
