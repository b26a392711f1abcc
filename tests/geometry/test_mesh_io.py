"""Mesh files as other programs write them, put together here byte by byte."""

import base64
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, clean, is_closed, signed_volume
from sdfsim.geometry.mesh_io import load_mesh, load_textured
from sdfsim.geometry.solidify import solidify

# A block of 1 x 2 x 3 whose lower corner is (10, 20, 30), so that turned or mirrored axes show.
PLACES = [(10 + x, 20 + 2 * y, 30 + 3 * z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7)]
MIXED = [*QUADS, (2, 0, 4), (2, 4, 6)]
TRIANGLES = [corners for q in MIXED for corners in zip([q[0]] * 9, q[1:], q[2:], strict=False)]
BOX = np.array([[10.0, 20.0, 30.0], [11.0, 22.0, 33.0]])
# An L of area 3 times 1 high whose polygons of six corners are not convex, with a corner in the middle of an edge.
L_OUTLINE = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
# A U of area 5, which no fan around one corner covers.
U_OUTLINE = [(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)]


def prism(outline: list[tuple[int, int]]) -> tuple[list[tuple[float, ...]], list[tuple[int, ...]]]:
    """Corners and polygons of a prism 1 high, with two polygons of all corners."""
    count = len(outline)
    places = [(float(x), float(y), float(z)) for z in (0, 1) for x, y in outline]
    walls = [(k, (k + 1) % count, count + (k + 1) % count, count + k) for k in range(count)]
    return places, [tuple(reversed(range(count))), tuple(range(count, 2 * count)), *walls]


def check_block(mesh: Mesh) -> None:
    np.testing.assert_allclose([mesh.vertices.min(0), mesh.vertices.max(0)], BOX, atol=1e-5)
    assert len(mesh.vertices) == 8 and len(mesh.faces) == 12
    assert is_closed(mesh) and signed_volume(mesh) == pytest.approx(6.0)


def binary_ply(order: str, *, texcoords: bool = True, edges: bool = True) -> bytes:
    """As Blender writes it, with normals, colours, places in a texture a corner, and loose edges behind the faces."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = [
        "ply",
        f"format {name} 1.0",
        "comment Created in Blender version 4.2.0",
        "obj_info some",
        "element vertex 8",
    ]
    header += [f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue", "alpha")]
    header += [f"element face {len(MIXED)}", "property list uchar uint vertex_indices"]
    header += ["property list uchar float texcoord", "property short flags"] if texcoords else []
    header += ["element edge 1", "property int vertex1", "property int vertex2"] if edges else []
    content = "\n".join([*header, "end_header", ""]).encode()
    for k, place in enumerate(PLACES):
        content += struct.pack(order + "6f4B", *place, 0, 0, 1, 10 * k, 100, 200, 255)
    for corners in MIXED:
        count = len(corners)
        content += struct.pack(f"{order}B{count}I", count, *corners)
        if texcoords:
            content += struct.pack(f"{order}B{2 * count}fh", 2 * count, *(2 * count * [0.5]), 7)
    return content + (struct.pack(order + "2i", 0, 1) if edges else b"")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("texcoords", [True, False])
def test_a_binary_ply_of_triangles_and_quads_is_read(tmp_path: Path, order: str, texcoords: bool) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(binary_ply(order, texcoords=texcoords))
    mesh = load_mesh(path)
    check_block(mesh)
    for vertex, color in zip(mesh.vertices, mesh.colors, strict=True):
        assert color.tolist() == [10 * PLACES.index(tuple(np.round(vertex).tolist())), 100, 200]


@pytest.mark.parametrize("cut", [1, 9, 40, 150, 300])
def test_a_ply_that_is_cut_short_says_where(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(binary_ply("<")[:-cut])
    with pytest.raises(SdfsimError, match=r"a\.ply: .*\b\d+ of \d\b.*\b(edge|face|vertex)\b"):
        load_mesh(path)


def text_ply(faces: str, count: int, more: str = "", colors: str = "float") -> str:
    header = "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
    header += "".join(f"property {colors} {channel}\n" for channel in ("red", "green", "blue"))
    rows = "".join(f"{x} {y} {z} 1 0.5 0\n" for x, y, z in PLACES)
    return f"{header}element face {count}\nproperty list uchar int vertex_index\n{more}end_header\n{rows}{faces}"


def test_a_text_ply_with_lists_of_unlike_lengths_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    places = [2 * len(c) * ["0.25"] if k % 2 else [] for k, c in enumerate(MIXED)]
    lists = [[str(len(c)), *map(str, c), str(len(p)), *p, "3"] for c, p in zip(MIXED, places, strict=True)]
    rows = "".join(" ".join(row) + "\n" for row in lists)
    path.write_text(text_ply(rows, len(MIXED), "property list uchar float texcoord\nproperty int material\n"))
    mesh = load_mesh(path)
    check_block(mesh)
    assert mesh.colors is not None and (mesh.colors == [255, 128, 0]).all()
    path.write_text(
        text_ply(rows.rsplit("\n", 2)[0], len(MIXED), "property list uchar float texcoord\nproperty int material\n")
    )
    with pytest.raises(SdfsimError, match=r"\b6 of 7\b.*\bface\b"):
        load_mesh(path)


def test_a_texture_that_a_ply_names_colours_its_vertices(tmp_path: Path) -> None:
    image = np.zeros((8, 8, 3), dtype=np.uint8)
    image[:4, :] = (250, 20, 30)  # the upper half, which PLY counts as v > 0.5
    Image.fromarray(image).save(tmp_path / "paint.png")
    rows = "".join(f"{len(c)} {' '.join(map(str, c))} {2 * len(c)} {' '.join(len(c) * ['0.5 0.9'])}\n" for c in MIXED)
    text = text_ply(rows, len(MIXED), "property list uchar float texcoord\n").replace(
        "element vertex", "comment TextureFile paint.png\ncomment TextureFile other.png\nelement vertex"
    )
    (tmp_path / "a.ply").write_text(text)
    loaded = load_textured(tmp_path / "a.ply")
    assert loaded.mesh.colors is not None and (loaded.mesh.colors == [250, 20, 30]).all()
    assert loaded.notes == ("it names 2 textures: only paint.png is used",)


@pytest.mark.parametrize(("outline", "area"), [(L_OUTLINE, 3.0), (U_OUTLINE, 5.0)])
@pytest.mark.parametrize("kind", ["ply", "off", "obj"])
def test_polygons_that_are_not_convex_bound_what_they_should(tmp_path: Path, outline, area: float, kind: str) -> None:
    places, polygons = prism(outline)
    head = {
        "ply": f"ply\nformat ascii 1.0\nelement vertex {len(places)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(polygons)}\nproperty list int int vertex_indices\nend_header\n",
        "off": f"OFF\n{len(places)} {len(polygons)} 0\n", "obj": "",
    }[kind]  # fmt: skip
    vertex, first = ("v {} {} {}\n", 1) if kind == "obj" else ("{} {} {}\n", 0)
    rows = [" ".join(str(k + first) for k in corners) for corners in polygons]
    body = [f"{'f' if kind == 'obj' else len(row.split())} {row}\n" for row in rows]
    (tmp_path / f"a.{kind}").write_text(head + "".join(vertex.format(*place) for place in places) + "".join(body))
    mesh = load_mesh(tmp_path / f"a.{kind}")
    assert is_closed(mesh) and signed_volume(mesh) == pytest.approx(area)
    solid = solidify(mesh)
    assert solid.simple and solid.mass_properties()[0] == pytest.approx(area)


def off_text(first: str, vertex: str = "{} {} {}", faces: list[tuple[int, ...]] = MIXED, tail: str = "") -> str:
    rows = [vertex.format(*place) for place in PLACES] + [" ".join(map(str, [len(c), *c])) + tail for c in faces]
    return "\n".join([first, *rows]) + "\n"


@pytest.mark.parametrize(
    ("text", "color"),
    [
        (off_text("OFF\n8 7 0"), None),
        (off_text("OFF 8 7 14"), None),
        (off_text("off\n8 7 0"), None),
        (off_text("OFF\n# made by hand\n\n8 7   # no edges", tail="  0.5 0.5 0.5"), None),
        (off_text("\ufeffOFF\r\n8 7 0", tail=" # a face"), None),
        (off_text("OFF\n8 5 0", faces=[*QUADS, (2, 0, 4, 6)]).replace("8 5 0", "8 6 0"), None),
        (off_text("COFF\n8 7 0", "{} {} {} 10 20 30 255"), [10, 20, 30]),
        (off_text("COFF\n8 7 0", "{} {} {} 1.0 0.5 0"), [255, 128, 0]),
        (off_text("NOFF\n8 7 0", "{} {} {} 0 0 1"), None),
        (off_text("CNOFF 8 7 0", "{} {} {} 0 0 1 10 20 30 255"), [10, 20, 30]),
        (off_text("STOFF\n8 7 0", "{} {} {} 0.5 0.5"), None),
    ],
)
def test_every_kind_of_off_is_read(tmp_path: Path, text: str, color) -> None:
    (tmp_path / "a.off").write_text(text)
    mesh = load_mesh(tmp_path / "a.off")
    check_block(mesh)
    assert (mesh.colors is None) == (color is None)
    assert color is None or (mesh.colors == color).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.off", "OFF\n5 0 0\n" + 5 * "0 1 2\n", "mesh has no faces"),
        ("a.off", "4OFF\n8 7 0\n", "4OFF"),
        ("a.off", "OFF BINARY\n8 7 0\n", "binary OFF"),
        ("a.off", off_text("OFF\n8 8 0"), "cut short: 7 of 8"),
        ("a.off", off_text("OFF\n8 7 0").replace("4 0 2 3 1", "4 0 2 3"), "cut short"),
        ("a.off", off_text("OFF\n8 7 0").replace("4 0 2 3 1", "4 0 2 3 8"), r"\b0 to 7\b"),
        ("a.ply", text_ply("", 0), "mesh has no faces"),
        ("a.ply", text_ply("", 0).split("element face")[0] + "end_header\n" + 8 * "0 1 2 0 0 0\n", "mesh has no faces"),
        ("a.ply", text_ply("3 0 1 8\n", 1), r"\b0 to 7\b"),
        ("a.ply", text_ply("3 0 1 -1\n", 1), r"\b0 to 7\b"),
        ("a.ply", "ply\nformat ascii 1.0\nelement a 1\nproperty quark x\nend_header\n0\n", "property quark x"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "mesh has no faces"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", r"line 4: .*-4\b.*\b3\b"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", r"line 4: .*\b0\b"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "line 4: a face has the index 9, there are 3 vertices"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n", "line 4: 'x' is not a number"),
        ("a.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.txt", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not a mesh file"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SdfsimError, match=message) as error:
        load_mesh(tmp_path / name)
    assert str(error.value).startswith(str(tmp_path / name)) and "\n" not in error.value.message
    assert "cut short" not in str(error.value) or "cut short" in message
    if message == "mesh has no faces":
        assert "point cloud" in error.value.hint


def obj(face: Callable[[tuple[int, ...]], str]) -> str:
    return "".join("v {} {} {}\n".format(*place) for place in PLACES) + "vt 0 0\nvn 0 0 1\n" + "".join(map(face, MIXED))


@pytest.mark.parametrize(
    "text",
    [
        obj(lambda c: f"f {' '.join(str(k - 8) for k in c)}\n"),
        obj(lambda c: f"f {' '.join(f'{k - 8}/-1/-1' for k in c)}\n"),
        obj(lambda c: f"f {' '.join(f'{k + 1}//-1' for k in c)}\n"),
        obj(lambda c: f"f {' '.join(str(k + 1) for k in c)} # group 0\n"),
        obj(lambda c: f"f {' '.join(str(k + 1) for k in c)}\n").upper(),
        obj(lambda c: f"  f {' '.join(str(k + 1) for k in c)}\t# 0 of -1\r\n"),
        # Indices count back from where they stand, not from the end.
        "".join(
            "".join("v {} {} {}\n".format(*PLACES[k]) for k in c)
            + f"f {' '.join(str(k - len(c)) for k in range(len(c)))}\n"
            for c in MIXED
        ),
    ],
)
def test_an_obj_may_count_back_and_have_comments(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    check_block(load_mesh(tmp_path / "a.obj"))


def stl() -> bytes:
    content = b"solid but binary".ljust(80) + struct.pack("<I", 12)
    for face in TRIANGLES:
        content += struct.pack("<12fH", 0, 0, 0, *(number for k in face for number in PLACES[k]), 0)
    return content


def test_a_binary_stl_may_have_a_tail(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    for content in (stl(), stl() + b"\n", stl() + b"COLOR=" + bytes(300), stl()[:-2]):
        path.write_bytes(content)
        check_block(load_mesh(path))
    for content, message in (
        (stl()[:-3], "cut short: 11 of 12"),
        (stl()[:300], "cut short: 4 of 12"),
        (stl()[:80] + bytes(4) + stl()[84:], r"\b600 bytes"),
        (stl()[:60], "STL"),
        (b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "endsolid"),
    ):
        path.write_bytes(content)
        with pytest.raises(SdfsimError, match=message):
            load_mesh(path)


@pytest.mark.parametrize("stray", [[(1e9, 0, 0)] * 3, [(1e6, 0, 0), (2e6, 0, 0), (3e6, 0, 0)], [(0, -1e11, 5)] * 3])
def test_a_face_without_area_far_away_changes_nothing(stray) -> None:
    cube = primitives.box()
    mesh = Mesh(
        np.concatenate([cube.vertices, np.array(stray, dtype=float)]), np.concatenate([cube.faces, [[8, 9, 10]]])
    )
    got = clean(mesh)
    np.testing.assert_array_equal(got.vertices, cube.vertices)
    assert is_closed(got) and signed_volume(got) == pytest.approx(1.0)


def test_a_face_without_area_still_joins_its_neighbours() -> None:
    # The top edge of one side has a corner in its middle, which a flat face joins to the other side's whole edge.
    cube = primitives.box()
    edge = {tuple(v) for v in cube.vertices.tolist() if v[1] == 0.5 and v[2] == 0.5}
    a, b = (int(k) for k in range(8) if tuple(cube.vertices[k].tolist()) in edge)
    faces, middle = [], 8
    for face in cube.faces.tolist():
        if {a, b} <= set(face) and cube.vertices[face][:, 2].min() == 0.5:
            k = next(k for k in range(3) if {face[k], face[(k + 1) % 3]} == {a, b})
            one, two, top = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            faces += [[one, middle, top], [middle, two, top], [one, two, middle]]
        else:
            faces.append(face)
    got = clean(Mesh(np.concatenate([cube.vertices, [[0.0, 0.5, 0.5]]]), np.array(faces)))
    assert len(got.faces) == 14 and is_closed(got)


# --- glTF ---


class Gltf:
    """A .gltf file in the making, with its buffer inside."""

    def __init__(self, **header) -> None:
        self.body = b""
        self.header: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], **header}

    def view(self, data: bytes, **more) -> int:
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data), **more})
        self.body += data + bytes(-len(data) % 4)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values, kind: str, **more) -> int:
        array = np.array(values, kind)
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}[kind[-2:]]
        shape = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[array.size // len(array)]
        told = {
            "bufferView": self.view(array.tobytes()),
            "componentType": component,
            "count": len(array),
            "type": shape,
        }
        self.header["accessors"].append(told | more)
        return len(self.header["accessors"]) - 1

    def write(self, path: Path) -> Path:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        path.write_text(json.dumps(self.header | {"buffers": [{"byteLength": len(self.body), "uri": uri}]}))
        return path


# In glTF the block stands with y up: what is x, y, z here is x, z, -y there.
Y_UP = [(x, z, -y) for x, y, z in PLACES]


def block(**header) -> Gltf:
    file = Gltf(**{"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], **header})
    attributes = {"POSITION": file.accessor(Y_UP, "<f4")}
    corners = file.accessor(np.ravel(TRIANGLES), "<u2")
    file.header["meshes"] = [{"primitives": [{"attributes": attributes, "indices": corners}]}]
    return file


def test_nodes_place_their_meshes(tmp_path: Path) -> None:
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 0.5])
    # By a matrix above, and by translation, rotation and scale below, the last of which mirrors.
    upper = np.eye(4)
    upper[:3, :3], upper[:3, 3] = 2.0 * turn.as_matrix(), (5.0, 6.0, 7.0)
    lower = {"translation": [1.0, 2.0, 3.0], "rotation": turn.inv().as_quat().tolist(), "scale": [0.5, 1.0, -1.5]}
    nodes = [{"matrix": upper.T.reshape(-1).tolist(), "children": [1]}, {"mesh": 0, **lower}, {"mesh": 0}]
    mesh = load_mesh(block(nodes=nodes).write(tmp_path / "a.gltf"))  # the third node is in no scene
    local = turn.inv().apply(np.array(Y_UP) * [0.5, 1.0, -1.5]) + np.array([1.0, 2.0, 3.0])
    x, y, z = (2.0 * turn.apply(local) + [5.0, 6.0, 7.0]).T
    expected = np.stack([x, -z, y], axis=1)
    np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(expected, axis=0), atol=1e-5)
    assert is_closed(mesh) and signed_volume(mesh) == pytest.approx(6.0 * 8 * 0.75, rel=1e-6)


@pytest.mark.parametrize(("kind", "steps"), [("<i2", 32767), ("i1", 127), ("<u2", 65535)])
def test_normalised_numbers_are_fractions(tmp_path: Path, kind: str, steps: int) -> None:
    # The block as fractions of its size about a corner (or its middle), put right by the node, as quantisers do.
    middle, half = ((10.5, 31.5, -21.0), (0.5, 1.5, 1.0)) if kind != "<u2" else ((10, 30, -22), (1, 3, 2))
    fractions = (np.array(Y_UP) - middle) / half
    file = block(
        extensionsRequired=["KHR_mesh_quantization"], nodes=[{"mesh": 0, "translation": middle, "scale": half}]
    )
    rows = np.round(steps * fractions).astype(kind)
    rows = np.concatenate([rows, np.zeros((8, 1), kind)], axis=1)  # rows begin at multiples of four bytes
    view = file.view(rows.tobytes(), byteStride=rows.strides[0] if rows.itemsize > 1 else 4)
    component = {"<i2": 5122, "i1": 5120, "<u2": 5123}[kind]
    told = {"bufferView": view, "componentType": component, "count": 8, "type": "VEC3", "normalized": True}
    file.header["accessors"][0] = told
    check_block(load_mesh(file.write(tmp_path / "a.gltf")))
    # Whole numbers that are not fractions are what they are.
    file = block()
    file.header["accessors"][0] = file.header["accessors"][file.accessor(Y_UP, "<i2")]
    check_block(load_mesh(file.write(tmp_path / "a.gltf")))


@pytest.mark.parametrize("required", [True, False])
def test_instances_are_all_there(tmp_path: Path, required: bool) -> None:
    header = {"extensionsUsed": ["EXT_mesh_gpu_instancing"]}
    header |= {"extensionsRequired": ["EXT_mesh_gpu_instancing"]} if required else {}
    file = block(nodes=[{"mesh": 0, "scale": [0.5] * 3, "children": [1]}, {"mesh": 0}], **header)
    turns = Rotation.from_euler("y", [[0], [90], [180]], degrees=True).as_quat()
    file.header["nodes"][0]["extensions"] = {
        "EXT_mesh_gpu_instancing": {
            "attributes": {
                "TRANSLATION": file.accessor([(100, 0, 0), (200, 0, 0), (300, 7, 0)], "<f4"),
                "ROTATION": file.accessor(np.round(32767 * turns), "<i2", normalized=True),
                "SCALE": file.accessor([(1, 1, 1), (2, 2, 2), (1, 1, 1)], "<f4"),
            }
        }
    }
    mesh = load_mesh(file.write(tmp_path / "a.gltf"))
    # Three copies, one of them twice as large, and the child, which is not repeated.
    assert len(mesh.faces) == 4 * 12
    assert signed_volume(mesh) == pytest.approx(6.0 / 8 * (1 + 8 + 1 + 1), rel=1e-4)
    # The last one half a turn about the vertical: x and depth change their signs.
    np.testing.assert_allclose(mesh.vertices.max(0)[0], 0.5 * (300 - 10), rtol=1e-4)


def test_fans_and_strips_are_triangles(tmp_path: Path) -> None:
    for mode in (6, 5):
        file = block()
        attributes = file.header["meshes"][0]["primitives"][0]["attributes"]
        walls = [list(q) if mode == 6 else [q[0], q[1], q[3], q[2]] for q in [*QUADS, (2, 0, 4, 6)]]
        file.header["meshes"][0]["primitives"] = [
            {"attributes": attributes, "indices": file.accessor(wall, "u1"), "mode": mode} for wall in walls
        ]
        mesh = load_mesh(file.write(tmp_path / "a.gltf"))
        check_block(mesh)
    # Six corners in one: a fan around the middle of a hexagon, and a strip whose every other triangle is turned.
    ring = [(np.cos(k * np.pi / 3), 0.0, -np.sin(k * np.pi / 3)) for k in range(7)]
    file = Gltf(scenes=[{"nodes": [0]}], nodes=[{"mesh": 0}])
    fan = {"attributes": {"POSITION": file.accessor([(0, 0, 0), *ring], "<f4")}, "mode": 6}
    points = {"attributes": fan["attributes"], "mode": 0}
    file.header["meshes"] = [{"primitives": [points, fan]}]
    mesh = load_mesh(file.write(tmp_path / "a.gltf"))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    np.testing.assert_allclose(normal, np.tile([0, 0, np.sin(np.pi / 3)], (6, 1)), atol=1e-6)


def test_sparse_numbers_are_filled_in(tmp_path: Path) -> None:
    for base in (True, False):
        file = block()
        first = file.header["accessors"][0]
        wrong = np.array(Y_UP) if base else np.zeros((8, 3))
        changed = [1, 6] if base else list(range(8))
        wrong[changed] = 0
        told = dict(first, bufferView=file.view(wrong.astype("<f4").tobytes())) if base else dict(first)
        if not base:
            del told["bufferView"]
        told["sparse"] = {
            "count": len(changed),
            "indices": {"bufferView": file.view(np.array(changed, "<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": file.view(np.array(Y_UP, "<f4")[changed].tobytes())},
        }
        file.header["accessors"][0] = told
        check_block(load_mesh(file.write(tmp_path / "a.gltf")))


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "VENDOR_unheard_of"])
def test_what_a_gltf_needs_and_is_not_read_is_named(tmp_path: Path, name: str) -> None:
    file = block(extensionsUsed=[name], extensionsRequired=["KHR_materials_unlit", name])
    with pytest.raises(SdfsimError, match=rf"a\.gltf: .*\b{name}\b"):
        load_mesh(file.write(tmp_path / "a.gltf"))
    file.header["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_transform"]
    check_block(load_mesh(file.write(tmp_path / "a.gltf")))  # turned from y up to z up


def test_a_buffer_that_only_an_extension_fills_is_reported(tmp_path: Path) -> None:
    file = block(extensionsUsed=["EXT_meshopt_compression"])
    file.header["bufferViews"][0] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    path = file.write(tmp_path / "a.gltf")
    written = json.loads(path.read_text())
    written["buffers"].append({"byteLength": 96})
    path.write_text(json.dumps(written))
    with pytest.raises(SdfsimError, match="EXT_meshopt_compression"):
        load_mesh(path)


def test_colours_of_a_gltf_are_multiplied_as_light(tmp_path: Path) -> None:
    image = np.zeros((2, 2, 3), dtype=np.uint8)
    image[0, 1] = (255, 255, 0)  # upper right
    png = io.BytesIO()
    Image.fromarray(image).save(png, "PNG")
    file = block()
    file.header["images"] = [{"bufferView": file.view(png.getvalue()), "mimeType": "image/png"}]
    file.header["textures"] = [{"source": 0}]
    file.header["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": [0.2140, 1.0, 1.0, 1.0], "baseColorTexture": {"index": 0}}}
    ]
    primitive = file.header["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    primitive["attributes"]["TEXCOORD_0"] = file.accessor(8 * [(0.75, 0.25)], "<f4")
    mesh = load_mesh(file.write(tmp_path / "a.gltf"))
    assert mesh.colors is not None and (mesh.colors == [127, 255, 0]).all()  # 0.214 of the light is half of the bytes


def test_a_skin_stands_as_its_joints_do(tmp_path: Path) -> None:
    # Bound in centimetres below an armature of 1/100, as Blender writes it: the upper side is carried by a joint that
    # has turned by 90 degrees since, the lower one by its parent, and one vertex by both.
    turn, hinge = Rotation.from_euler("y", 90, degrees=True), np.array([10.0, 20.0, 31.5])
    in_y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pivot, turned = in_y_up @ hinge, Rotation.from_matrix(in_y_up @ turn.as_matrix() @ in_y_up.T)
    upper = np.array([z > 30 for _, _, z in PLACES])
    weights = [[0.0, 2.0] if up else [2.0, 0.0] for up in upper]
    weights[0] = [0.25, 0.75]
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [500.0, 3.0, 1.0], "scale": [7.0, 7.0, 7.0]},  # does not count
        {"children": [2], "scale": [0.01] * 3},
        {"children": [3]},
        {"translation": (100 * pivot).tolist(), "rotation": turned.as_quat().tolist()},
    ]
    file = block(nodes=nodes, scenes=[{"nodes": [0, 1]}])
    primitive = file.header["meshes"][0]["primitives"][0]
    primitive["attributes"]["POSITION"] = file.accessor(100 * np.array(Y_UP), "<f4")
    # The joints are listed the other way round; a second set is only padding, with a joint that does not exist.
    for k, shares in enumerate((np.pad(weights, ((0, 0), (0, 2))), np.zeros((8, 4)))):
        held = file.accessor(np.tile([1, 0, 9, 9], (8, 1)), "u1")
        primitive["attributes"] |= {f"JOINTS_{k}": held, f"WEIGHTS_{k}": file.accessor(shares, "<f4")}
    bound = np.tile(np.eye(4), (2, 1, 1))
    bound[0, :3, 3] = -100 * pivot
    file.header["skins"] = [{"joints": [3, 2], "inverseBindMatrices": 0}]
    file.header["accessors"].append(
        {"bufferView": file.view(bound.transpose(0, 2, 1).astype("<f4").tobytes()), "componentType": 5126, "count": 2,
         "type": "MAT4"}
    )  # fmt: skip
    file.header["skins"][0]["inverseBindMatrices"] = len(file.header["accessors"]) - 1
    mesh = load_mesh(file.write(tmp_path / "a.gltf"))
    places = np.array(PLACES, float)
    carried = turn.apply(places - hinge) + hinge
    share = np.array([w[1] / sum(w) for w in weights])[:, None]
    expected = share * carried + (1 - share) * places
    assert len(mesh.vertices) == 8
    order, other = (np.lexsort(np.round(rows, 3).T) for rows in (mesh.vertices, expected))
    np.testing.assert_allclose(mesh.vertices[order], expected[other], atol=1e-5)
    # Without inverse bind matrices the mesh is bound in the joints' own frames.
    del file.header["skins"][0]["inverseBindMatrices"]
    primitive["attributes"]["WEIGHTS_0"] = file.accessor(np.tile([1.0, 0, 0, 0], (8, 1)), "<f4")
    check_block(load_mesh(file.write(tmp_path / "a.gltf")))
    file.header["skins"][0]["joints"] = [3]
    with pytest.raises(SdfsimError, match="skin of 1 joints"):
        load_mesh(file.write(tmp_path / "a.gltf"))


def test_morph_targets_count_by_their_weights(tmp_path: Path) -> None:
    # The upper side is lifted by 8 m and pulled by 6 m along x; a node's weights come before those of the mesh.
    file = block()
    up = np.array([z > 30 for _, _, z in PLACES])[:, None]
    targets = [{"POSITION": file.accessor(up * np.array([[0.0, 8, 0]]), "<f4")}]
    targets += [
        {"POSITION": file.accessor(up * np.array([[6.0, 0, 0]]), "<f4")},
        {"POSITION": len(file.header["accessors"])},
    ]
    file.header["accessors"].append({"componentType": 5126, "count": 8, "type": "VEC3"})  # without data: zeros
    file.header["meshes"][0]["primitives"][0]["targets"] = targets
    for of_mesh, of_node, (x, z) in (
        (None, None, (0, 0)), ([0.25, 0.5, 1], None, (3, 2)), ([1, 1, 1], [0.5, 0, 0], (0, 4)), ([0, 1], None, (6, 0)),
    ):  # fmt: skip
        for entry, weights in ((file.header["meshes"][0], of_mesh), (file.header["nodes"][0], of_node)):
            entry |= {"weights": weights} if weights else {}
        high = load_mesh(file.write(tmp_path / "a.gltf")).vertices
        low, high = high[high[:, 2] < 30.5], high[high[:, 2] > 30.5]
        np.testing.assert_allclose(low.min(0), [10, 20, 30], atol=1e-5)
        np.testing.assert_allclose(high.min(0), [10 + x, 20, 33 + z], atol=1e-5)
        file.header["nodes"][0].pop("weights", None)


def test_hidden_nodes_are_left_out_and_counted(tmp_path: Path) -> None:
    def seen(visible: bool) -> dict:
        return {"extensions": {"KHR_node_visibility": {"visible": visible}}}

    nodes = [{"mesh": 0, "children": [1], **seen(True)}, {"children": [2], **seen(False)}]
    nodes += [{"mesh": 0, "translation": [50, 0, 0], **seen(True)}]
    file = block(nodes=nodes, extensionsRequired=["KHR_node_visibility"])
    loaded = load_textured(file.write(tmp_path / "a.gltf"))
    check_block(loaded.mesh)
    assert loaded.notes == ("1 hidden node is left out",)
    file.header["animations"] = [{"channels": [], "samplers": []}]
    assert any("animations" in note for note in load_textured(file.write(tmp_path / "a.gltf")).notes)


# --- text as other programs write it ---


def stl_text() -> str:
    rows = ["solid part"]
    for face in TRIANGLES:
        rows += ["facet normal 0 0 0", " outer loop", *("  vertex {} {} {}".format(*PLACES[k]) for k in face)]
        rows += [" endloop", "endfacet"]
    return "\n".join([*rows, "endsolid part\n"])


@pytest.mark.parametrize(
    "change",
    [
        str.upper,
        lambda text: text.replace("endsolid", "end solid"),
        lambda text: text.replace("\n", "\r"),
        lambda text: "\ufeff" + text.replace("\n", "\r\n"),
        lambda text: text.replace("\n ", " "),
        lambda text: text.replace("facet normal 0 0 0", "facet").replace("endfacet", "end facet"),
        lambda text: text.upper().replace("ENDSOLID", "End Solid").replace("\n", "\r"),
    ],
)
def test_a_text_stl_is_read_however_it_is_written(tmp_path: Path, change: Callable[[str], str]) -> None:
    (tmp_path / "a.stl").write_bytes(change(stl_text()).encode())
    check_block(load_mesh(tmp_path / "a.stl"))
    (tmp_path / "a.stl").write_bytes(change(stl_text()).encode("utf-16"))
    check_block(load_mesh(tmp_path / "a.stl"))


@pytest.mark.parametrize("ends", [("\r\n", "\n"), ("\n", "\r\n"), ("\r", "\r"), ("\r\n", "\r\n")])
def test_lines_of_a_ply_header_may_end_in_several_ways(tmp_path: Path, ends: tuple[str, str]) -> None:
    for content in (binary_ply("<"), text_ply("3 0 1 2\n", 1).encode(), text_ply("3 0 1 2\n", 1).upper().encode()):
        content = content.replace(b"END_HEADER", b"end_header")
        head, tail = content.split(b"end_header\n")
        head = head.replace(b"\n", ends[0].encode()) + b"end_header" + ends[1].encode()
        (tmp_path / "a.ply").write_bytes(head + tail)
        mesh = load_mesh(tmp_path / "a.ply")
        assert len(mesh.faces) == (12 if content[:20].count(b"binary") else 1)


@pytest.mark.parametrize("kind", ["obj", "ply", "off", "stl"])
def test_a_decimal_comma_is_named_with_its_line(tmp_path: Path, kind: str) -> None:
    text = {
        "obj": obj(lambda c: f"f {' '.join(str(k + 1) for k in c)}\n"),
        "ply": text_ply("".join(f"{len(c)} {' '.join(map(str, c))}\n" for c in MIXED), len(MIXED)),
        "off": off_text("OFF\n8 7 0"),
        "stl": stl_text(),
    }[kind]
    (tmp_path / f"a.{kind}").write_text(text)
    check_block(load_mesh(tmp_path / f"a.{kind}"))
    lines = text.split("\n")
    row = next(k for k, line in enumerate(lines) if "11 22 33" in line)
    lines[row] = lines[row].replace("11 22 33", "11,25 22 33")
    (tmp_path / f"a.{kind}").write_text("\n".join(lines))
    with pytest.raises(SdfsimError, match=rf"line {row + 1}: '11,25' has a decimal comma") as error:
        load_mesh(tmp_path / f"a.{kind}")
    assert "\n" not in error.value.message
