"""Mesh files as bytes."""

import json
import struct

import numpy as np


def _originals() -> dict[str, bytes]:
    """A ring of 16 sides with colours, in every format, as text and binary."""
    import trimesh

    ring = trimesh.creation.annulus(0.2, 0.5, 0.4, sections=16)
    ring.visual.vertex_colors = np.arange(4 * len(ring.vertices)).reshape(-1, 4).astype(np.uint8)
    made = {kind: ring.export(file_type=kind) for kind in ("obj", "stl", "glb", "off")}
    made["stl_text"] = ring.export(file_type="stl_ascii")
    made |= {"ply": ring.export(file_type="ply"), "ply_text": ring.export(file_type="ply", encoding="ascii")}
    return {name: data.encode() if isinstance(data, str) else data for name, data in made.items()}


ORIGINALS = _originals()


def glb(header: dict, body: bytes) -> bytes:
    """A binary glTF of a JSON header and one buffer."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def taken_apart(data: bytes) -> tuple[dict, bytes]:
    """Header and buffer of a binary glTF."""
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]
