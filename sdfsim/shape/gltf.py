"""Binary glTF 2.0, by hand: what trimesh writes has textures in JPEG of quality 75, and no motion."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np

# What z up is to the y up of glTF: columns of a matrix [4, 4].
_Y_UP = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]
_COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123}
_UNLIT = "KHR_materials_unlit"


class Gltf:
    """A file in the making: nodes, meshes, materials and animations with keys as glTF has them. Nodes hang below one
    that turns z up to glTF's y up."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        self.meshes: list[dict[str, Any]] = []
        self.materials: list[dict[str, Any]] = []
        self.animations: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._content = bytearray()

    def _view(self, data: bytes) -> int:
        self._views.append({"buffer": 0, "byteOffset": len(self._content), "byteLength": len(data)})
        self._content.extend(data + bytes(-len(data) % 4))
        return len(self._views) - 1

    def array(self, values: np.ndarray, kind: str = "<f4") -> int:
        """An accessor of values [K] or [K, 2 to 4]; whole numbers of 16 bits are fractions of 65535."""
        values = np.ascontiguousarray(values, kind)
        rows = values.reshape(len(values), -1)
        told = {"bufferView": self._view(values.tobytes()), "componentType": _COMPONENTS[kind], "count": len(values)}
        told |= {"type": "SCALAR" if rows.shape[1] == 1 else f"VEC{rows.shape[1]}"}
        told |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self._accessors.append(told | ({"normalized": True} if kind == "<u2" else {}))
        return len(self._accessors) - 1

    def material(self, name: str, color: np.ndarray, texture: np.ndarray | None = None, rough: float = 1.0) -> int:
        """A surface of a colour [3], as light, or with a texture [H, W, 3] uint8, which needs no other light."""
        surface: dict[str, Any] = {"baseColorFactor": [*map(float, color), 1.0]}
        made: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
        surface |= {"metallicFactor": 0.0, "roughnessFactor": rough}
        if texture is not None:
            from PIL import Image

            file = io.BytesIO()
            Image.fromarray(texture).save(file, "JPEG", quality=92, subsampling=0)
            self._images.append({"bufferView": self._view(file.getvalue()), "mimeType": "image/jpeg"})
            surface["baseColorTexture"] = {"index": len(self._images) - 1}
            made["extensions"] = {_UNLIT: {}}
        self.materials.append(made)
        return len(self.materials) - 1

    def mesh(self, name: str, attributes: dict[str, int], corners: int, material: int) -> int:
        """A mesh of accessors: attributes of its vertices, and the corners of its faces."""
        drawn = {"attributes": attributes, "indices": corners, "material": material}
        self.meshes.append({"name": name, "primitives": [drawn]})
        return len(self.meshes) - 1

    def to_bytes(self) -> bytes:
        """The file."""
        count = len(self.nodes)
        lists = {"meshes": self.meshes, "materials": self.materials, "images": self._images}
        lists |= {"accessors": self._accessors, "bufferViews": self._views, "animations": self.animations}
        lists |= {"textures": [{"source": k} for k in range(len(self._images))]}
        lists |= {"extensionsUsed": [_UNLIT] if self._images else []}
        header = {
            "asset": {"version": "2.0", "generator": "sdfsim"},
            "scene": 0,
            "scenes": [{"nodes": [count]}],
            "nodes": [*self.nodes, {"name": "root", "children": list(range(count)), "matrix": _Y_UP}],
            "buffers": [{"byteLength": len(self._content)}],
            **{name: entries for name, entries in lists.items() if entries},
        }
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        parts = struct.pack("<2I", len(text), 0x4E4F534A) + text
        parts += struct.pack("<2I", len(self._content), 0x004E4942) + self._content
        return struct.pack("<4s2I", b"glTF", 2, 12 + len(parts)) + parts
