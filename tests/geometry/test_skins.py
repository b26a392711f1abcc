"""Meshes keep their texture, whatever file they come from: judged by trimesh and Pillow, which wrote the files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh  # noqa: TID253
from PIL import Image
from trimesh.visual import TextureVisuals  # noqa: TID253
from trimesh.visual.material import PBRMaterial  # noqa: TID253

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
    material = PBRMaterial(baseColorTexture=image, baseColorFactor=[255, 255, 255, 255])
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def looked_at(mesh: Mesh, rows: np.ndarray) -> np.ndarray:
    """[F, R, 3] colours of a mesh's texture at barycentric places [R, 3] of each face."""
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


def test_parts_with_images_of_their_own_share_one_and_repeat_as_often_as_they_did(tmp_path: Path) -> None:
    red, blue = chessboard((250, 0, 0), (0, 0, 0)), chessboard((0, 0, 250), (0, 0, 0))
    one, two = sides(red, repeats=2.0), sides(blue)
    two.apply_translation([3.0, 0.0, 0.0])
    trimesh.Scene([one, two]).export(tmp_path / "both.glb")
    skin = load_textured(tmp_path / "both.glb").skin
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
    cube = trimesh.creation.box()
    uv, image = np.zeros((8, 2)), np.full((1, 1, 3), 90, np.uint8)
    skin = one_skin([Painted(np.array(cube.vertices), np.array(cube.faces)[:, ::-1], uv, image)])
    assert skin is not None and trimesh.Trimesh(skin.vertices, skin.faces).volume == pytest.approx(1.0)


COLORS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (255, 0, 255), (0, 255, 255)]


def wavefront_die(rows: str = "usemtl side {}", library: str = "mtllib die.mtl") -> str:
    """A cube of 1 m whose sides have the materials `side 0` to `side 5`, and fill the texture from its lower left."""
    die, lines = sides(chessboard()), [library]
    lines += ["v {} {} {}".format(*vertex) for vertex in die.vertices]
    lines += ["vt {} {}".format(*uv) for uv in die.visual.uv]
    for k in range(6):
        lines += [rows.format(k), "f " + " ".join(f"{c}/{c}" for c in range(4 * k + 1, 4 * k + 5))]
    return "\n".join(lines) + "\n"


def assert_six_colors(skin: Mesh | None) -> None:
    """Each side has its own colour, up to what JPEG changes."""
    rows = inside(5)
    got, points = looked_at(skin, rows).reshape(-1, 3), places(skin, rows).reshape(-1, 3)
    axis = np.abs(points).argmax(1)
    want = [COLORS[2 * a + int(p[a] > 0)] for a, p in zip(axis, points, strict=True)]
    assert np.abs(got - want).max() <= 3


@pytest.mark.parametrize("ending", ["obj", "glb", "ply", "glb with vertex colours"])
def test_a_die_keeps_six_colours_wherever_they_come_from(tmp_path: Path, ending: str) -> None:
    kind, die = ending.split()[0], sides(chessboard())
    file = tmp_path / f"die.{kind}"
    if kind == "obj":
        file.write_text(wavefront_die())
        text = "".join(f"newmtl side {k}\nKd {r / 255} {g / 255} {b / 255}\n" for k, (r, g, b) in enumerate(COLORS))
        (tmp_path / "die.mtl").write_text(text)
    elif kind == "ply":
        colors = np.repeat([(*color, 255) for color in COLORS], 2, axis=0)
        trimesh.Trimesh(die.vertices, die.faces, face_colors=colors).export(file)
    elif "vertex" in ending:
        colors = np.repeat([(*color, 255) for color in COLORS], 4, axis=0)
        trimesh.Trimesh(die.vertices, die.faces, vertex_colors=colors, process=False).export(file)
    else:
        scene = trimesh.Scene()
        for k, color in enumerate(COLORS):
            part = trimesh.Trimesh(die.vertices[4 * k : 4 * k + 4], die.faces[:2], process=False)
            part.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 255]))
            scene.add_geometry(part)
        scene.export(file)
    loaded = load_textured(file)
    assert len(loaded.mesh.vertices) == 8 and not [note for note in loaded.notes if "colour" in note]
    skin = loaded.skin
    if kind == "glb":  # back to y up
        skin = Mesh(skin.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0], skin.faces, None, skin.uv, skin.texture)
    assert_six_colors(skin)
    shape = shape_from_mesh(file, tmp_path / "cache", sdf="grid", resolution=16)
    shape.save(tmp_path / "shape")
    export(tmp_path / "shape", tmp_path / "out.glb")
    found: Any = next(iter(trimesh.load_scene(tmp_path / "out.glb", process=False).geometry.values()))
    shown = np.asarray(found.visual.to_color().vertex_colors)[:, :3].astype(int)
    assert len(np.unique(np.round(shown / 16), axis=0)) == 6


def test_smooth_colours_stay_colours_of_vertices(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2, 0.5)
    shades = np.round(127 * (1 + 2 * ball.vertices)).astype(np.uint8)
    ball.visual.vertex_colors = np.column_stack([shades, np.full(len(shades), 255, np.uint8)])
    ball.export(tmp_path / "ball.ply")
    loaded = load_textured(tmp_path / "ball.ply")
    assert loaded.skin is None and not loaded.notes
    got, want = loaded.mesh, np.round(127 * (1 + 2 * loaded.mesh.vertices))
    assert got.colors is not None and np.abs(got.colors - want).max() <= 1
    # Where two such balls touch in one vertex, its colour is a mixture, and this is said.
    other = ball.copy().apply_translation([1.0, 0.0, 0.0])
    top = int(ball.vertices[:, 0].argmax()), int(other.vertices[:, 0].argmin())
    other.vertices[top[1]] = ball.vertices[top[0]]
    trimesh.util.concatenate([ball, other]).export(tmp_path / "both.ply")
    both = load_textured(tmp_path / "both.ply")
    assert both.skin is None and both.notes == ("where its colours meet, they are mixed at the vertices",)


MAP = "newmtl side 0\nKd 1 1 1\nmap_Kd {}\n"


@pytest.mark.parametrize(
    ("library", "text", "file", "repeats"),
    [
        ("mtllib die.mtl", MAP.format("paint.png"), "paint.png", 1.0),
        ("mtllib die.mtl", MAP.format("-s 2 2 1 -bm 0.5 -clamp off paint.png"), "paint.png", 2.0),
        ("mtllib die.mtl", MAP.format("-o 1 -mm 0 1 my paint.png"), "my paint.png", 1.0),
        ("mtllib DIE.MTL", MAP.format("textures\\Paint.PNG"), "Textures/paint.png", 1.0),
        ("mtllib other.mtl die.mtl", MAP.format("C:\\Users\\me\\paint.tga"), "paint.tga", 1.0),
        ("mtllib die.mtl", "\tNEWMTL side 0\r\n\tmap_kd\tpaint.bmp\r\n", "paint.bmp", 1.0),
    ],
)
def test_an_obj_finds_its_texture_however_it_is_named(
    tmp_path, library: str, text: str, file: str, repeats: float
) -> None:
    image = chessboard()
    (tmp_path / file).parent.mkdir(exist_ok=True)
    image.save(tmp_path / file)
    (tmp_path / "die.mtl").write_bytes(text.encode())
    (tmp_path / "other.mtl").write_text("newmtl another\nKd 1 0 0\n")
    (tmp_path / "die.obj").write_text(wavefront_die("usemtl side 0", library))
    loaded = load_textured(tmp_path / "die.obj")
    assert loaded.skin is not None and not loaded.notes
    rows = inside(30)
    got = looked_at(loaded.skin, rows).reshape(-1, 3)
    want = expected(places(loaded.skin, rows).reshape(-1, 3), image, repeats)
    assert (np.abs(got - want).max(1) > 60).mean() < 0.02


@pytest.mark.parametrize(
    ("library", "text", "message", "color"),
    [
        ("mtllib die.mtl", "newmtl side 0\nKd 0 0.2 1\nmap_Kd gone.png\n", "texture gone.png is missing", (0, 51, 255)),
        ("mtllib die.mtl", "newmtl side 0\nmap_Kd die.obj\n", "texture die.obj cannot be read", None),
        ("mtllib die.mtl", "newmtl side 0\nmap_Kd ../die.png\n", "texture ../die.png lies outside its folder", None),
        ("mtllib gone.mtl", "", "material library gone.mtl is missing", None),
        ("mtllib die.mtl", "newmtl side 1\nKd 1 0 0\n", "material side 0 is not in die.mtl", None),
        ("", "", "no file that describes them (mtllib)", None),
        ("mtllib die.mtl", "newmtl side 0\nKd spectral a.rfl\n", "colour Kd spectral a.rfl", None),
        ("mtllib die.mtl", "newmtl side 0\nmap_Bump a.png\n", "not shown: normal maps", None),
        ("mtllib die.mtl", "newmtl side 0\nKd 0 0.2 1\nTr 0.4\n", "not shown: transparency", (0, 51, 255)),
        ("mtllib die.mtl", "newmtl side 0\nKd 0 0.2 1\nd 1.0\nTr 1.0\n", "", (0, 51, 255)),
    ],
)
def test_looks_that_are_lost_are_named(tmp_path, library: str, text: str, message: str, color) -> None:
    (tmp_path / "die.mtl").write_text(text)
    (tmp_path / "die.obj").write_text(wavefront_die("usemtl side 0", library))
    loaded = load_textured(tmp_path / "die.obj")
    assert loaded.skin is None and len(loaded.notes) == bool(message)
    assert message in "".join(loaded.notes)
    assert (loaded.mesh.colors is None) == (color is None)
    assert color is None or (loaded.mesh.colors == color).all()


def gltf_box(tmp_path: Path, change) -> Path:
    """The textured box of trimesh as .gltf, with its JSON changed."""
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(sides(chessboard()))).items():
        (tmp_path / name).write_bytes(data)
    tree = json.loads((tmp_path / "model.gltf").read_text())
    change(tree)
    (tmp_path / "model.gltf").write_text(json.dumps(tree))
    return tmp_path / "model.gltf"


def test_specular_and_glossiness_have_a_colour_too(tmp_path: Path) -> None:
    def change(tree: dict) -> None:
        texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        diffuse = {"diffuseTexture": texture, "diffuseFactor": [1.0, 0.0, 0.0, 1.0]}
        tree["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": diffuse}}]

    skin = load_textured(gltf_box(tmp_path, change)).skin
    got = looked_at(skin, inside(20)).reshape(-1, 3)
    assert got[:, 0].max() > 230 and (got[:, 1:] == 0).all() and (got[:, 0] > 128).mean() == pytest.approx(0.5, abs=0.1)


def test_a_gltf_whose_image_is_missing_is_read_without_it(tmp_path: Path) -> None:
    def change(tree: dict) -> None:
        tree["images"] = [{"uri": "textures/gone.png"}]
        tree["materials"][0] |= {"normalTexture": {"index": 0}, "alphaMode": "BLEND"}

    loaded = load_textured(gltf_box(tmp_path, change))
    assert loaded.skin is None and len(loaded.mesh.vertices) == 8
    assert loaded.notes == (
        "texture textures/gone.png is missing beside it: left out", "not shown: transparency", "not shown: normal maps",
    )  # fmt: skip


def test_a_texture_that_is_turned_lies_turned(tmp_path: Path) -> None:
    # A quarter counter-clockwise: what lay at (u, v) from the upper left is looked up at (v, -u).
    def change(tree: dict) -> None:
        texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        texture["extensions"] = {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0.0, 1.0]}}

    skin, plain = (
        load_textured(gltf_box(tmp_path, change)).skin,
        load_textured(gltf_box(tmp_path, lambda tree: None)).skin,
    )
    np.testing.assert_allclose(skin.uv, np.stack([plain.uv[:, 1], 1 - plain.uv[:, 0]], axis=1), atol=1e-6)


@pytest.mark.parametrize("textured", [True, False], ids=["texture", "plain"])
@pytest.mark.parametrize("mapped", [True, False], ids=["maps", "factors"])
def test_roughness_metal_and_normal_maps_come_in_and_go_out(tmp_path: Path, textured: bool, mapped: bool) -> None:
    """From a file over a shape folder to an export, as trimesh reads it."""
    import sdfsim

    cells = np.arange(CELLS * CELLS, dtype=np.uint8).reshape(CELLS, CELLS)
    gloss = Image.fromarray(np.repeat(np.repeat(np.stack([0 * cells, 3 * cells, 255 - 3 * cells], 2), 8, 0), 8, 1))
    bumps = Image.fromarray(np.repeat(np.repeat(np.stack([90 + cells, 160 - cells, 0 * cells + 240], 2), 8, 0), 8, 1))
    box = sides(chessboard())
    material: Any = box.visual.material
    material.baseColorTexture = chessboard() if textured else None
    material.roughnessFactor, material.metallicFactor = (1.0, 1.0) if mapped else (0.2, 0.6)
    if mapped:
        material.metallicRoughnessTexture, material.normalTexture = gloss, bumps
    box.export(tmp_path / "box.glb")
    loaded = load_textured(tmp_path / "box.glb")
    assert not loaded.notes and loaded.skin is not None
    shape = shape_from_mesh(tmp_path / "box.glb", tmp_path / "cache", sdf="grid", resolution=16)
    scene = SceneBuilder().add("box", asset=shape.save(tmp_path / "shape"), motion="static").load()
    sdfsim.export(scene, tmp_path / "out.glb")
    out = next(iter(trimesh.load(tmp_path / "out.glb", process=False).geometry.values())).visual.material
    if mapped:
        assert (out.roughnessFactor or 1.0, out.metallicFactor or 1.0) == (1.0, 1.0)
        for image, wanted, channels in (
            (out.metallicRoughnessTexture, gloss, [1, 2]),
            (out.normalTexture, bumps, [0, 1, 2]),
        ):
            seen = np.asarray(image.convert("RGB").resize(wanted.size, Image.Resampling.NEAREST))
            np.testing.assert_allclose(seen[..., channels].astype(int), np.asarray(wanted)[..., channels], atol=1)
    else:
        assert (out.roughnessFactor, out.metallicFactor) == pytest.approx((0.2, 0.6), abs=0.003)
        assert out.normalTexture is None and out.metallicRoughnessTexture is None
