"""Meshes keep their texture, whatever file they come from: judged by trimesh and Pillow, which wrote the files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sdfsim.apps.export import export
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import load_textured
from sdfsim.geometry.skins import Painted, one_skin
from sdfsim.scene.builder import SceneBuilder
from sdfsim.shape.make import shape_from_mesh

CELLS, PIXELS = 8, 16


def chessboard(bright=(250, 250, 250), dark=(10, 10, 10)) -> Image.Image:
    field = np.indices((CELLS, CELLS)).sum(0) % 2
    cells = np.where(field[..., None] == 0, dark, bright).astype(np.uint8)
    return Image.fromarray(np.repeat(np.repeat(cells, PIXELS, 0), PIXELS, 1))


def sides(image: Image.Image, *, repeats: float = 1.0) -> Any:
    """A trimesh of a cube of 1 m whose six sides each show the whole image."""
    import trimesh

    vertices, faces, uv = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal, u = np.eye(3)[axis] * sign, np.eye(3)[(axis + 1) % 3]
            v = np.cross(normal, u)
            start = len(vertices)
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                vertices.append((normal + (2 * a - 1) * u + (2 * b - 1) * v) / 2)
                uv.append((repeats * a, repeats * b))
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    material = PBRMaterial(baseColorTexture=image, baseColorFactor=[255, 255, 255, 255])
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def looked_at(mesh: Mesh, rows: np.ndarray) -> np.ndarray:
    """[F, R, 3] colours of a mesh's texture at barycentric places [R, 3] of each face."""
    assert mesh.uv is not None and mesh.texture is not None
    at = np.einsum("rk,fkc->frc", rows, mesh.uv[mesh.faces]) * mesh.texture.shape[1::-1]
    x, y = np.moveaxis(at.astype(int), -1, 0)
    return mesh.texture[y, x].astype(int)


def places(mesh: Mesh, rows: np.ndarray) -> np.ndarray:
    return np.einsum("rk,fkc->frc", rows, mesh.vertices[mesh.faces])


def inside(count: int) -> np.ndarray:
    rows = np.random.default_rng(3).dirichlet((1.0, 1.0, 1.0), count)
    return rows


def expected(points: np.ndarray, image: Image.Image, repeats: float = 1.0) -> np.ndarray:
    """[N, 3] what the image shows at points [N, 3] of the cube `sides`, from how that is made."""
    pixels, (width, height) = np.asarray(image), image.size
    found = []
    for point in points:
        axis = int(np.abs(point).argmax())
        normal, u = np.eye(3)[axis] * np.sign(point[axis]), np.eye(3)[(axis + 1) % 3]
        a, b = (repeats * (point @ way + 0.5) % 1.0 for way in (u, np.cross(normal, u)))
        found.append(pixels[height - 1 - min(int(b * height), height - 1), min(int(a * width), width - 1)])
    return np.array(found).astype(int)


@pytest.mark.parametrize("ending", ["glb", "obj", "ply"])
def test_a_chessboard_on_a_box_stays_a_chessboard(tmp_path: Path, ending: str) -> None:
    image, file = chessboard(), tmp_path / f"box.{ending}"
    box = sides(image)
    if ending == "ply":
        image.save(tmp_path / "paint.png")
        rows = [(*v, *uv) for v, uv in zip(box.vertices, box.visual.uv, strict=True)]
        head = f"ply\nformat ascii 1.0\ncomment TextureFile paint.png\nelement vertex {len(rows)}\n"
        head += "".join(f"property float {key}\n" for key in "xyzst") + f"element face {len(box.faces)}\n"
        body = [" ".join(map(str, row)) for row in rows] + [" ".join(map(str, (3, *face))) for face in box.faces]
        file.write_text(head + "property list uchar int vertex_indices\nend_header\n" + "\n".join(body) + "\n")
    else:
        box.export(file)
    shape = shape_from_mesh(file, tmp_path / "cache", sdf="grid", resolution=16)
    assert shape.skin is not None
    shape.save(tmp_path / "shape")
    scene = SceneBuilder().add("box", asset=tmp_path / "shape", motion="static").load()
    seen = scene.shapes[0].shown
    rows = inside(40)
    points = places(seen, rows).reshape(-1, 3)
    if ending == "glb":  # z up back to the file's y up
        points = points[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    want = expected(points, image)
    got = looked_at(seen, rows).reshape(-1, 3)
    off = np.abs(got - want).max(1) > 60  # JPEG, and single precision at borders of cells
    assert off.mean() < 0.02
    assert (got.mean(1) > 128).mean() == pytest.approx(0.5, abs=0.1)


def test_an_exported_box_shows_its_texture_and_keeps_its_edges(tmp_path: Path) -> None:
    import trimesh

    sides(chessboard()).export(tmp_path / "box.glb")
    shape = shape_from_mesh(tmp_path / "box.glb", tmp_path / "cache", sdf="grid", resolution=16, units=0.01)
    shape.save(tmp_path / "shape")
    report = export(tmp_path / "shape", tmp_path / "out.glb")
    assert not any("texture" in line for line in report["left_out"])
    found = next(iter(trimesh.load_scene(tmp_path / "out.glb", process=False).geometry.values()))
    assert found.visual.material.baseColorTexture.size == (CELLS * PIXELS,) * 2
    np.testing.assert_allclose(np.ptp(found.vertices, axis=0), 0.01, rtol=1e-5)
    flat = np.abs(found.vertex_normals).max(1)
    np.testing.assert_allclose(flat, 1.0, atol=1e-5)


def test_parts_with_images_of_their_own_share_one_and_repeat_as_often_as_they_did(tmp_path: Path) -> None:
    import trimesh

    red, blue = chessboard((250, 0, 0), (0, 0, 0)), chessboard((0, 0, 250), (0, 0, 0))
    one, two = sides(red, repeats=2.0), sides(blue)
    two.apply_translation([3.0, 0.0, 0.0])
    trimesh.Scene([one, two]).export(tmp_path / "both.glb")
    skin = load_textured(tmp_path / "both.glb").skin
    assert skin is not None
    rows = inside(30)
    got, x = looked_at(skin, rows), places(skin, rows)[..., 0]
    assert (got[x > 2.0][:, 0] < 30).all() and (got[x < 2.0][:, 2] < 30).all()
    point = places(skin, rows)[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
    want = expected(point[x < 2.0], red, repeats=2.0)
    assert (np.abs(got[x < 2.0] - want).max(1) > 60).mean() < 0.06  # half a pixel narrower, of cells of 16


def test_what_cannot_be_kept_is_told(tmp_path: Path) -> None:
    sides(chessboard(), repeats=900.0).export(tmp_path / "box.glb")
    loaded = load_textured(tmp_path / "box.glb")
    assert loaded.skin is None and loaded.notes == ("its texture becomes colours of its vertices",)
    assert loaded.mesh.colors is not None
    sides(chessboard()).export(tmp_path / "thick.glb")
    thick = shape_from_mesh(tmp_path / "thick.glb", tmp_path / "cache", sdf="mesh", thicken=0.05)
    assert thick.skin is None and any("thicken" in note for note in thick.source["notes"])


def test_a_surface_that_is_inside_out_is_turned() -> None:
    import trimesh

    cube = trimesh.creation.box()
    uv, image = np.zeros((8, 2)), np.full((1, 1, 3), 90, np.uint8)
    skin = one_skin([Painted(np.array(cube.vertices), np.array(cube.faces)[:, ::-1], uv, image)])
    assert skin is not None and trimesh.Trimesh(skin.vertices, skin.faces).volume == pytest.approx(1.0)
