"""Convex pieces of a solid, for an engine that collides nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from sdfsim.errors import SdfsimError
from sdfsim.files import write_text
from sdfsim.shape.mesh import Mesh, load_pieces

VHACD = {"resolution": 1_000_000, "concavity": 0.0025, "maxNumVerticesPerCH": 64}
# In a process of its own: it prints to stdout, and on an odd mesh it aborts, or takes all the memory there is.
VHACD_CALL = f"""
import resource, sys, pybullet
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
pybullet.vhacd(*sys.argv[1:], **{VHACD})
"""
VHACD_TIME = 600  # s


def decompose(mesh: Mesh, scratch: Path) -> list[Mesh]:
    """Convex pieces of a solid by V-HACD.

    Args:
        mesh: the boundary of a solid, metres.
        scratch: a path for its files, which are removed; gets endings.

    Raises:
        SdfsimError: V-HACD failed on it.
    """
    before, after, log = (scratch.with_name(f".{scratch.name}.{end}") for end in ("in.obj", "out.obj", "log"))
    try:
        write_text(before, wavefront([mesh]))
        command = [sys.executable, "-c", VHACD_CALL, before, after, log]
        quiet = subprocess.DEVNULL
        subprocess.run(command, stdout=quiet, stderr=quiet, check=True, timeout=VHACD_TIME)
        return load_pieces(after)
    except subprocess.SubprocessError as error:
        raise SdfsimError("V-HACD found no convex pieces", "give them in a NAME/ folder") from error
    finally:
        for file in (before, after, log):
            file.unlink(missing_ok=True)


def wavefront(pieces: list[Mesh]) -> str:
    """Wavefront OBJ with one `o` group a piece."""
    lines, before = [], 1
    for number, piece in enumerate(pieces):
        lines.append(f"o piece_{number}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in piece.vertices]
        lines += ["f {} {} {}".format(*(face + before)) for face in piece.faces]
        before += len(piece.vertices)
    return "\n".join(lines) + "\n"
