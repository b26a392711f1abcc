"""glTF 2.0, written and read without trimesh: trimesh writes textures as JPEG of quality 75 and no motion, and misreads
normalised and sparse numbers, instances and fans.

glTF has y up and we have z up. In a file that we write, one node above all others turns it, so that meshes and motions
keep our own numbers. What we read is turned back, so our own files come back unchanged.
"""

import base64
import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from sdfsim.geometry.mesh import joined
from sdfsim.geometry.mesh_formats import TEXTURES, FileMesh, looked_up, read_image, side_file, strip
from sdfsim.geometry.skins import USUAL, Painted, plain_parts, resized

# From z up to glTF's y up: the first columns of a matrix [4, 4].
_Y_UP = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0]
_COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123}
_UNLIT = "KHR_materials_unlit"
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # the way back
INSTANCES = "EXT_mesh_gpu_instancing"
# Extensions that a file may require: those that are read here, and those for the look of surfaces, which do not change
# geometry.
VISIBILITY, GLOSS = "KHR_node_visibility", "KHR_materials_pbrSpecularGlossiness"
# Where a texture names its image: extensions come first, as the image beside them is for programs without them.
OF_IMAGES = ("EXT_texture_webp", "MSFT_texture_dds")
HONOURED = {"KHR_mesh_quantization", INSTANCES, "KHR_texture_transform", VISIBILITY, *OF_IMAGES}
OF_LOOKS = ("KHR_materials_", "EXT_materials_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6
MOST = 500_000_000  # vertices and corners
WHITE = [1.0, 1.0, 1.0]
# What is lost of a material, by the key that asks for it.
LOST = {"emissiveTexture": "glow maps"}
SPARSE = 2**24  # most rows of an accessor that has sparse values only
_OF_NODE = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}  # instances -> nodes


_VERTICES, _CORNERS = 34962, 34963  # what a buffer view is for, in glTF's numbers


class GltfWriter:
    """A file to be written: nodes, meshes, materials and animations, with glTF's own keys. All nodes are below one that
    turns z up to glTF's y up, and moves everything to `origin` [3] m. Arrays have single precision, so they should be
    near it."""

    def __init__(self) -> None:
        self.origin: np.ndarray = np.zeros(3)
        self.nodes: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = []
        self.animations: list[dict[str, Any]] = []
        self.extensions: dict[str, dict[str, Any]] = {}  # of the file
        self.aside: set[int] = set()  # nodes that are not part of the scene
        self._images: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._content = bytearray()

    def below(self, parent: int, node: dict[str, Any]) -> int:
        """Add a node below another one, or below the one above all (-1), and return its index."""
        self.nodes.append(node)
        if parent >= 0:
            self.nodes[parent].setdefault("children", []).append(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def _view(self, data: bytes) -> int:
        self._views.append({"buffer": 0, "byteOffset": len(self._content), "byteLength": len(data)})
        self._content.extend(data + bytes(-len(data) % 4))
        return len(self._views) - 1

    def array(self, values: np.ndarray, kind: str = "<f4") -> int:
        """Add an accessor for values [K] or [K, 2 to 4], and return its index; 16-bit integers are fractions of
        65535."""
        values = np.ascontiguousarray(values, kind)
        rows = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self._view(values.tobytes()),
            "componentType": _COMPONENTS[kind],
            "count": len(values),
        }
        accessor |= {"type": "SCALAR" if rows.shape[1] == 1 else f"VEC{rows.shape[1]}"}
        accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self._accessors.append(accessor | ({"normalized": True} if kind == "<u2" else {}))
        return len(self._accessors) - 1

    def material(
        self, name: str, color: np.ndarray, texture: np.ndarray | None = None, maps: np.ndarray | None = None, *,
        rough: float = 1.0, lit: bool = False,
    ) -> int:  # fmt: skip
        """Add a material with a colour [3] (linear light), or with a texture [H, W, 3] uint8 and the maps of `Mesh`.
        Textures from photos contain the light already, so they are shown unlit unless `lit` is set: then shadows fall
        on them too."""
        surface: dict[str, Any] = {"baseColorFactor": [*map(float, color), 1.0]}
        made: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
        surface |= {"metallicFactor": 0.0, "roughnessFactor": rough}
        if texture is not None:
            surface["baseColorTexture"] = self._image(texture, "JPEG", quality=92, subsampling=0)
            if not lit:
                made["extensions"] = {_UNLIT: {}}
        if maps is not None:
            gloss, bumps = maps[..., :2], maps[..., 2:]
            if np.ptp(gloss, axis=(0, 1)).any():
                surface |= {"roughnessFactor": 1.0, "metallicFactor": 1.0}
                surface["metallicRoughnessTexture"] = self._image(np.insert(gloss, 0, 255, axis=2), "PNG")
            else:
                surface |= dict(zip(("roughnessFactor", "metallicFactor"), (gloss[0, 0] / 255.0).tolist(), strict=True))
            if (bumps != USUAL[2:]).any():
                made["normalTexture"] = self._image(bumps, "PNG")
        self.materials.append(made)
        return len(self.materials) - 1

    def _image(self, pixels: np.ndarray, kind: str, **how: Any) -> dict[str, int]:
        """Add an image, as a texture."""
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, kind, **how)
        self._images.append({"bufferView": self._view(file.getvalue()), "mimeType": f"image/{kind.lower()}"})
        return {"index": len(self._images) - 1}

    def mesh(self, name: str, attributes: dict[str, int], corners: int, material: int | None = None) -> int:
        """Add a mesh from accessors: the attributes of its vertices, and the corners of its faces. One that is not
        drawn needs no material."""
        for accessors, target in ((attributes.values(), _VERTICES), ([corners], _CORNERS)):
            for accessor in accessors:
                self._views[self._accessors[accessor]["bufferView"]]["target"] = target
        drawn: dict[str, Any] = {"attributes": attributes, "indices": corners}
        drawn |= {} if material is None else {"material": material}
        self.meshes.append({"name": name, "primitives": [drawn]})
        return len(self.meshes) - 1

    def to_bytes(self) -> bytes:
        """The file."""
        count, (x, y, z) = len(self.nodes), self.origin.tolist()
        lists = {"meshes": self.meshes, "materials": self.materials, "images": self._images}
        lists |= {"accessors": self._accessors, "bufferViews": self._views, "animations": self.animations}
        lists |= {"textures": [{"source": k} for k in range(len(self._images))]}
        used = [_UNLIT] if any("extensions" in one for one in self.materials) else []
        lists |= {"extensionsUsed": [*used, *self.extensions], "extensions": self.extensions}
        under = self.aside.union(*(node.get("children", ()) for node in self.nodes))
        top = [k for k in range(count) if k not in under]
        header = {
            "asset": {"version": "2.0", "generator": "sdfsim"},
            "scene": 0,
            "scenes": [{"nodes": [count]}],
            "nodes": [*self.nodes, {"name": "root", "children": top, "matrix": [*_Y_UP, x, z, -y, 1]}],
            "buffers": [{"byteLength": len(self._content)}],
            **{name: entries for name, entries in lists.items() if entries},
        }
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        parts = struct.pack("<2I", len(text), 0x4E4F534A) + text
        parts += struct.pack("<2I", len(self._content), 0x004E4942) + self._content
        return struct.pack("<4s2I", b"glTF", 2, 12 + len(parts)) + parts


def light(srgb: np.ndarray) -> np.ndarray:
    """sRGB values from 0 to 255 as linear light from 0 to 1, which glTF and USD use."""
    value = np.asarray(srgb) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb(light: np.ndarray) -> np.ndarray:
    """Linear light from 0 to 1 as sRGB, uint8."""
    value = np.clip(light, 0.0, 1.0)
    value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(255.0 * value).astype(np.uint8)


def read_gltf(path: Path) -> FileMesh:
    """All triangles of the scene that a .gltf or .glb file shows, turned from glTF's y up to z up: the meshes of all
    nodes at the nodes' poses, or as the joints of their skins stand, with their colours. Raises ValueError if it is
    damaged, or needs an extension that is not supported."""
    file = _GltfReader(path)
    parts = [part for _, part in file.parts()]
    file.notes += [f"not shown: {what}" for what in file.lost]
    if not parts:
        return FileMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), notes=tuple(file.notes))
    whole, colors = joined(parts), None
    if any(part.colors is not None for part in parts):
        white = [np.full(part.vertices.shape, 255, np.uint8) if part.colors is None else part.colors for part in parts]
        colors = np.concatenate(white)
    painted = tuple(paint for part in parts for paint in part.painted) if file.textured else ()
    return FileMesh(whole.vertices, whole.faces, colors, painted=painted, notes=tuple(file.notes))


def read_painted(path: Path) -> dict[str, Painted]:
    """The parts of a file, each with its texture, by the names of their nodes. Raises ValueError if the file is
    damaged, or if a part has no readable texture."""
    file, found = _GltfReader(path), {}
    for name, part in file.parts():
        if not file.textured or part.painted[0] is None:
            raise ValueError(f"{name} has no readable texture")
        found[name], file.textured = part.painted[0], False
    return found


class _GltfReader:
    """A file to be read: its header, and its buffers as bytes. Raises ValueError if it is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        content = path.read_bytes()
        own = None
        if path.suffix.lower() == ".glb" or content[:4] == b"glTF":
            content, own = _chunks(content)
        self.header: dict[str, Any] = json.loads(content.decode("utf-8-sig"))
        version = str(self.header["asset"]["version"])
        if not version.startswith("2."):
            raise ValueError(f"glTF {version}, only 2.0 is read")
        for name in self.header.get("extensionsRequired", []):
            if name not in HONOURED and not str(name).startswith(OF_LOOKS):
                raise ValueError(f"it needs the extension {name}, which is not supported: export without it")
        self.buffers = [self._bytes(entry, own if k == 0 else None) for k, entry in enumerate(self._list("buffers"))]
        self._arrays: dict[int, np.ndarray] = {}
        self._images: dict[int, np.ndarray | None] = {}
        self._poses: dict[int, np.ndarray] = {}  # [4, 4] of nodes in the scene
        self._tinted: dict[tuple, np.ndarray] = {}  # images by their number (-1: plain colour) and colour factor
        self.textured = False  # whether any part has an image
        self.notes: list[str] = []  # what is lost
        self.lost: dict[str, None] = {}  # of the look of surfaces
        if self._list("animations"):
            self.notes.append("its animations are left out: it stands as it does before they begin")

    def _list(self, name: str) -> list[dict[str, Any]]:
        return self.header.get(name, [])

    def _bytes(self, entry: dict[str, Any], own: bytes | None = None) -> bytes | None:
        """The bytes of a buffer, or of an image without a view; None if there are none."""
        uri = entry.get("uri")
        if uri is None:
            return own
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return side_file(self.path, unquote(uri))

    def _view(self, number: int) -> bytes:
        view = self.header["bufferViews"][_index(number)]
        buffer = self.buffers[_index(view["buffer"])]
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if buffer is None:
            packed = next((name for name in view.get("extensions", {}) if "compression" in name), "")
            raise ValueError(
                f"it needs the extension {packed}: export without it" if packed else "a buffer has no data"
            )
        if start < 0 or not 0 < length <= len(buffer) - start:
            raise ValueError(f"cut short: a view of {length} bytes does not fit its buffer of {len(buffer)}")
        return buffer[start : start + length]

    def array(self, number: int) -> np.ndarray:
        """The rows [N, K] of an accessor: float64 fractions if it is normalised, else as stored."""
        if number not in self._arrays:
            self._arrays[number] = self._array(self.header["accessors"][_index(number)])
        return self._arrays[number]

    def _array(self, accessor: dict[str, Any]) -> np.ndarray:
        kind, width, count = np.dtype(TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            stride = self.header["bufferViews"][accessor["bufferView"]].get("byteStride")
            rows = self._rows(accessor, kind, width, count, stride)
        elif "sparse" in accessor:
            if not 0 < count <= SPARSE:
                raise ValueError(f"an accessor of {count} rows has no data")
            rows = np.zeros((count, width), kind)
        else:
            raise ValueError("an accessor has no data: compressed geometry is not supported, export without it")
        if "sparse" in accessor:
            few = accessor["sparse"]
            where = self._rows(few["indices"], np.dtype(TYPES[few["indices"]["componentType"]]), 1, few["count"])[:, 0]
            if where.max() >= count:
                raise ValueError("an index of a sparse accessor is out of range")
            rows = rows.copy()
            rows[where] = self._rows(few["values"], kind, width, few["count"])
        if accessor.get("normalized"):
            rows = np.maximum(rows / np.iinfo(kind).max, -1.0)
        return rows

    def _rows(
        self, place: dict[str, Any], kind: np.dtype, width: int, count: int, stride: int | None = None
    ) -> np.ndarray:
        data, start, row = self._view(place["bufferView"]), place.get("byteOffset", 0), width * kind.itemsize
        stride = row if stride is None else stride
        if count < 1 or start < 0 or not row <= stride <= 252 or start + (count - 1) * stride + row > len(data):
            raise ValueError("an accessor does not fit its buffer")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def placed(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Nodes with a mesh that is seen, and their poses [4, 4] in the scene."""
        nodes, found, hidden = self._list("nodes"), [], 0
        if scenes := self._list("scenes"):
            roots = scenes[_index(self.header.get("scene", 0))].get("nodes", [])
        else:
            roots = sorted(set(range(len(nodes))) - {child for node in nodes for child in node.get("children", [])})
        todo = [(_index(root), np.eye(4), True) for root in reversed(roots)]
        while todo:
            number, above, seen = todo.pop()
            if number in self._poses:
                raise ValueError(f"node {number} has two parents")
            node = nodes[number]
            self._poses[number] = matrix = above @ _matrix(node)
            seen = seen and node.get("extensions", {}).get(VISIBILITY, {}).get("visible", True)
            todo += [(_index(child), matrix, seen) for child in reversed(node.get("children", []))]
            if "mesh" in node and seen:
                found.append((node, matrix))
            hidden += "mesh" in node and not seen
        if hidden:
            self.notes.append(f"{hidden} hidden node{'s are' if hidden > 1 else ' is'} left out")
        return found

    def bent(self, skin: dict[str, Any], attributes: dict[str, int], vertices: np.ndarray) -> tuple[np.ndarray, bool]:
        """Vertices [V, 3] of a skin's mesh as its joints stand, in the scene: the mean, by weights, of where its joints
        carry a vertex from the pose in which it was bound. And whether they mirror it."""
        joints = [_index(joint) for joint in skin["joints"]]
        carried = np.array([self._pose(joint) for joint in joints])
        if "inverseBindMatrices" in skin:
            bound = self.array(skin["inverseBindMatrices"]).astype(np.float64)
            if bound.shape != (len(joints), 16):
                raise ValueError(f"a skin of {len(joints)} joints has {len(bound)} inverse bind matrices")
            carried = carried @ bound.reshape(-1, 4, 4).transpose(0, 2, 1)  # columns come first in the file
        sets = [k for k in range(len(attributes)) if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes]
        if not sets:
            raise ValueError("a mesh with a skin has no joints or no weights (JOINTS_0, WEIGHTS_0)")
        held = np.concatenate([self.array(attributes[f"JOINTS_{k}"]).astype(np.int64) for k in sets], axis=1)
        weight = np.concatenate([self.array(attributes[f"WEIGHTS_{k}"]).astype(np.float64) for k in sets], axis=1)
        held = np.where(weight > 0, held, 0)  # the others may name joints that do not exist
        if held.shape != weight.shape or len(held) != len(vertices) or held.max() >= len(joints):
            raise ValueError(f"the joints and weights of a skin of {len(joints)} joints do not fit its mesh")
        weight[weight.sum(1) <= 0, 0] = 1.0
        weight = np.maximum(weight, 0.0) / np.maximum(weight, 0.0).sum(1, keepdims=True)
        points, moved = np.column_stack([vertices, np.ones(len(vertices))]), np.zeros_like(vertices)
        for joint, share in zip(held.T, weight.T, strict=True):
            moved += share[:, None] * np.einsum("vij,vj->vi", carried[joint, :3], points)
        return moved, bool((np.linalg.det(carried[held[:, 0], :3, :3]) < 0).mean() > 0.5)

    def _pose(self, number: int) -> np.ndarray:
        """[4, 4] of a node, which need not be in the scene."""
        if number not in self._poses:
            above = next((k for k, node in enumerate(self._list("nodes")) if number in node.get("children", [])), None)
            self._poses[number] = np.eye(4)  # in a circle of nodes
            self._poses[number] = (np.eye(4) if above is None else self._pose(above)) @ _matrix(
                self.header["nodes"][number]
            )
        return self._poses[number]

    def copies(self, node: dict[str, Any], matrix: np.ndarray) -> Iterator[np.ndarray]:
        """The pose [4, 4] of each instance of a node's mesh."""
        instances = node.get("extensions", {}).get(INSTANCES)
        if instances is None:
            yield matrix
            return
        columns = {
            key: self.array(k).astype(np.float64) for key, k in instances["attributes"].items() if key in _OF_NODE
        }
        if len({len(column) for column in columns.values()}) != 1:
            raise ValueError(f"the attributes of {INSTANCES} do not have one length")
        for row in zip(*columns.values(), strict=True):
            yield matrix @ _matrix({_OF_NODE[key]: value for key, value in zip(columns, row, strict=True)})

    def parts(self) -> Iterator[tuple[str, FileMesh]]:
        """The triangles that the scene shows, z up, with the names of their nodes."""
        count = 0
        for node, matrix in self.placed():
            mesh = self.header["meshes"][_index(node["mesh"])]
            skin = self.header["skins"][_index(node["skin"])] if "skin" in node else None
            for primitive in mesh["primitives"]:
                if (part := self.part(primitive, node.get("weights", mesh.get("weights", [])), skin)) is None:
                    continue
                # With a skin it is where its joints are, wherever the node is.
                for place in self.copies(node, matrix) if skin is None else [np.eye(4)]:
                    count += len(part.vertices) + part.faces.size
                    if count > MOST:
                        raise ValueError(f"more than {MOST:,} vertices and corners, copies included")
                    moved = _moved(part, place)
                    painted = tuple(paint and _moved(paint, place) for paint in part.painted)
                    yield str(node.get("name")), moved._replace(painted=painted)

    def attribute(self, primitive: dict[str, Any], name: str, weights: list[float]) -> np.ndarray:
        """Rows [V, K] float64 of an attribute of a primitive, with its morph targets by their weights."""
        rows = self.array(primitive["attributes"][name]).astype(np.float64)
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            # A target without data moves nothing.
            if weight and name in target and {"bufferView", "sparse"} & self.header["accessors"][target[name]].keys():
                rows = rows + weight * self.array(target[name])
        return rows

    def part(self, primitive: dict[str, Any], weights: list[float], skin: dict[str, Any] | None) -> FileMesh | None:
        """The triangles of a primitive in its own frame, or with a skin in the scene; None for points and lines."""
        mode = primitive.get("mode", TRIANGLES)
        if mode in (0, 1, 2, 3):
            return None
        vertices = self.attribute(primitive, "POSITION", weights)
        if "indices" in primitive:
            corners = self.array(primitive["indices"])[:, 0].astype(np.int64)
            if corners.max() >= len(vertices):
                raise ValueError(f"face indices out of range (0 to {len(vertices) - 1} allowed)")
        else:
            corners = np.arange(len(vertices))
        if mode == TRIANGLES:
            if len(corners) % 3:
                raise ValueError(f"{len(corners)} corners do not make triangles")
            faces = corners.reshape(-1, 3)
        elif mode == TRIANGLE_STRIP:
            faces = strip(corners)
        elif mode == TRIANGLE_FAN:
            faces = np.stack([np.broadcast_to(corners[:1], len(corners[2:])), corners[1:-1], corners[2:]], axis=1)
        else:
            raise ValueError(f"a primitive of mode {mode}, which glTF does not have")
        if skin is not None:
            vertices, mirrored = self.bent(skin, primitive["attributes"], vertices)
            faces = faces[:, ::-1] if mirrored else faces
        colors, uv, image = self._surface(primitive, weights, len(vertices))
        if image is not None:
            return FileMesh(vertices, faces, colors, painted=(Painted(vertices, faces, uv, image),))
        own = None if colors is None else colors[faces]
        return FileMesh(vertices, faces, colors, painted=(None,) if own is None else plain_parts(vertices, faces, own))

    def _surface(
        self, primitive: dict[str, Any], weights: list[float], count: int
    ) -> tuple[np.ndarray | None, np.ndarray, np.ndarray | None]:
        """The product, in linear light, of texture, material colour and vertex colours: at the vertices [V, 3] uint8;
        and as places [V, 2] in an image, None if the vertices' own colours differ."""
        factors, tint, uv, number, maps = [], np.ones(3), np.zeros((count, 2)), -1, None
        if "material" in primitive:
            material = self.header["materials"][_index(primitive["material"])]
            surface = material.get("pbrMetallicRoughness", {})
            self.lost |= {what: None for key, what in LOST.items() if key in material or key in surface}
            self.lost |= {"transparency": None} if material.get("alphaMode", "OPAQUE") != "OPAQUE" else {}
            gloss = material.get("extensions", {}).get(GLOSS)  # what programs without it show is behind it
            base, layer = ("baseColor", surface) if gloss is None else ("diffuse", gloss)
            tint = np.array(layer.get(f"{base}Factor", WHITE), dtype=np.float64)[:3]
            if (tint != 1.0).any():
                factors.append(np.tile(tint, (count, 1)))
            gloss, bumps = surface.get("metallicRoughnessTexture", {}), material.get("normalTexture", {})
            texture = layer.get(f"{base}Texture", {})
            laid = texture or gloss or bumps  # places are those of the first
            moved, places = _places(laid)
            for other, what in ((gloss, "roughness and metal maps"), (bumps, "normal maps")):
                if other and (_places(other) != (moved, places) or self._image(other["index"]) is None):
                    self.lost[what] = None
                    other.clear()
            image = self._image(laid["index"]) if laid else None
            if image is not None and places not in primitive["attributes"]:
                self.notes.append(f"a texture is left out: its mesh has no {places}")
                gloss, bumps = {}, {}
            elif image is not None:
                uv = self.attribute(primitive, places, weights)[:, :2] * moved.get("scale", [1.0, 1.0])
                turn = moved.get("rotation", 0.0)  # counter-clockwise, seen with v pointing down
                across, down = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
                uv = np.stack([uv @ across, uv @ down], axis=1) + moved.get("offset", [0.0, 0.0])
                self.textured = True
                if texture:
                    number = texture["index"]
                    factors.append(light(looked_up(image, uv)))
            given = [surface.get(name) for name in ("roughnessFactor", "metallicFactor")]
            if _UNLIT not in material.get("extensions", {}) and (gloss or bumps or given != [None, None]):
                rough, metal = (1.0 if value is None else float(value) for value in given)
                maps = (rough, metal, gloss.get("index", -1), bumps.get("index", -1), float(bumps.get("scale", 1.0)))
                plain = [round(255 * rough), round(255 * metal), *maps[2:4]] == [*USUAL[:2], -1, -1]
                maps, self.textured = (None, self.textured) if plain else (maps, True)
        own = self.attribute(primitive, "COLOR_0", weights)[:, :3] if "COLOR_0" in primitive["attributes"] else None
        own = own if own is not None and own.shape == (count, 3) else None
        factors += [own] if own is not None else []
        factors = [factor for factor in factors if factor.shape == (count, 3)]
        colors = srgb(np.nan_to_num(np.prod(factors, axis=0))) if factors else None
        if own is not None:
            if np.ptp(own, axis=0).max() > 1e-6:
                return colors, uv, None
            tint = tint * own[0]
        return colors, uv, self._tint(number, tint, maps)

    def _tint(self, texture: int, tint: np.ndarray, maps: tuple[float, float, int, int, float] | None) -> np.ndarray:
        """[H, W, 3] uint8 of a texture (-1: one white pixel), its light multiplied by a factor [3]; or [H, W, 8] with
        maps: of factors for roughness and metal, their texture and a normal map (-1: none), and its scale."""
        key = (texture, *tint.tolist(), maps)
        if key not in self._tinted:
            image = self._image(texture) if texture >= 0 else None
            image = np.full((1, 1, 3), 255, np.uint8) if image is None else image
            if not (tint == 1.0).all():
                tables = srgb(light(np.arange(256))[:, None] * tint)  # [256, 3]
                image = np.stack([tables[image[..., k], k] for k in range(3)], axis=-1)
            if maps is not None:
                rough, metal, *numbers, scale = maps
                gloss, bumps = (self._image(number) if number >= 0 else None for number in numbers)
                gloss = np.full((1, 1, 3), 255, np.uint8) if gloss is None else gloss
                bumps = np.array([[USUAL[2:]]], np.uint8) if bumps is None else bumps
                gloss = np.round(gloss[..., 1:3] * np.clip([rough, metal], 0.0, 1.0)).astype(np.uint8)
                if scale != 1.0:
                    bumps = np.clip(np.round((bumps - 127.5) * [scale, scale, 1.0] + 127.5), 0, 255).astype(np.uint8)
                layers = [image, gloss, bumps]
                tall, wide = (max(layer.shape[axis] for layer in layers) for axis in (0, 1))
                image = np.dstack([resized(layer, wide, tall) for layer in layers])
            self._tinted[key] = image
        return self._tinted[key]

    def _image(self, texture: int) -> np.ndarray | None:
        """[H, W, 3] uint8 of a texture; None, and a note, if it is missing or its format is not supported."""
        entry = self.header["textures"][_index(texture)]
        named = entry.get("extensions", {})
        numbers = [named[name]["source"] for name in OF_IMAGES if "source" in named.get(name, {})]
        numbers += [entry["source"]] if "source" in entry else []
        if not numbers:
            self.notes.append(f"a texture that only {', '.join(named) or 'nothing'} describes is left out")
        for number in numbers:
            if number not in self._images:
                image, fault = self.header["images"][_index(number)], "has no data"
                try:
                    content = self._view(image["bufferView"]) if "bufferView" in image else self._bytes(image)
                except ValueError as error:
                    if "bufferView" in image:
                        raise
                    content, fault = None, str(error)
                found = self._images[number] = None if content is None else read_image(content)
                if found is None:
                    called = image.get("name") or image.get("uri", "")[:40] or f"number {number}"
                    fault = fault if content is None else f"{called} cannot be read (formats: {', '.join(TEXTURES)})"
                    self.notes.append(f"texture {fault}: left out")
            if (found := self._images[number]) is not None:
                return found
        return None


def _moved(part: Any, place: np.ndarray) -> Any:
    """A `FileMesh` or `Painted` at a pose [4, 4] of glTF, z up; a pose that mirrors it turns its faces over."""
    faces = part.faces[:, ::-1] if np.linalg.det(place[:3, :3]) < 0 else part.faces
    return part._replace(vertices=(part.vertices @ place[:3, :3].T + place[:3, 3]) @ Z_UP.T, faces=faces)


def _places(texture: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Where a texture lies: its KHR_texture_transform, and the attribute with its places."""
    moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
    return moved, f"TEXCOORD_{moved.get('texCoord', texture.get('texCoord', 0))}"


def _index(number: int) -> int:
    """An index into one of the header's lists. Negative ones are refused: Python would count from the end."""
    if not isinstance(number, int) or number < 0:
        raise ValueError(f"{number!r} is not an index")
    return number


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """[4, 4] of a node, in the frame of the one above it."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    from scipy.spatial.transform import Rotation  # slow to load

    turn = Rotation.from_quat(np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=np.float64)).as_matrix()
    matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """The JSON of a binary file, and its buffer if it has one."""
    if content[:4] != b"glTF":
        raise ValueError("it does not begin with glTF")
    if len(content) < 20:
        raise ValueError("cut short in its header")
    version, length = struct.unpack("<2I", content[4:12])
    if version != 2:
        raise ValueError(f"glTF {version}, only 2.0 is read")
    if len(content) < length:
        raise ValueError(f"cut short: {len(content)} of {length} bytes")
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = struct.unpack("<I4s", content[start : start + 8])
        if start + 8 + size > length:
            raise ValueError("cut short: a chunk reaches beyond the file")
        found.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in found:
        raise ValueError("it has no JSON")
    return found[b"JSON"], found.get(b"BIN\0")
