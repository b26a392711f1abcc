"""The shapes of a dataset: finds them, cuts them into convex pieces for PyBullet, splits them by name, and fits
them."""

import hashlib
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, visible, write_json, write_text
from sdfsim.base.parallel import Progress, parallel
from sdfsim.data.dataset import SOLID, check_names
from sdfsim.data.pybullet_sim import write_urdf
from sdfsim.geometry import primitives
from sdfsim.geometry.mass import mass_properties, mass_properties_of_sdf
from sdfsim.geometry.mesh import Mesh, convex_hull, is_closed
from sdfsim.geometry.mesh_io import MESH_SUFFIXES, load_mesh, load_pieces, wavefront
from sdfsim.geometry.solidify import solidify
from sdfsim.sdf.reference import PiecesDistance
from sdfsim.shape.make import analytic_shape, fit_pieces

NODES = 512  # surface nodes per shape: the vertices and edges of the pieces first, since contacts happen there
THINNEST = 0.02  # thickness relative to the largest extent, below which a mesh is left out, as a fit cannot resolve it
VISUAL, COLLISION = "visual_geometry.obj", "collision_geometry.obj"  # the two files of a NAME/ folder
VHACD = {"resolution": 1_000_000, "concavity": 0.0025, "maxNumVerticesPerCH": 64}
# Runs in a process of its own: it prints to stdout, and on some meshes it aborts or takes all memory.
VHACD_CALL = f"""
import resource, sys, pybullet
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
pybullet.vhacd(*sys.argv[1:], **{VHACD})
"""
VHACD_TIME = 600  # s


@dataclass(frozen=True)
class Origin:
    """The origin of a shape: a mesh that V-HACD cuts, convex pieces with a mesh to show, or a primitive."""

    name: str  # name of the Shape folder
    mesh: Path | None = None  # file of the solid, which is also the mesh that is shown
    pieces: Path | None = None  # OBJ with one convex piece per group
    primitive: str = ""  # name of a primitive, in place of files
    as_is: bool = False  # keep size and origin of the files, as MOVi-B does; others get a largest extent of 1 m

    @property
    def how(self) -> str:
        """The source of its convex pieces."""
        return "primitive" if self.primitive else "own" if self.pieces else "vhacd"

    def digest(self) -> str:
        """A hash that changes with the geometry and the way it is cut."""
        digest = hashlib.sha256(f"{self.how} {self.primitive} {VHACD if self.how == 'vhacd' else ''}".encode())
        for file in (self.mesh, self.pieces):
            if file is not None:
                digest.update(file.read_bytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class ShapeSource:
    """One shape in the form that recipes and fits need."""

    name: str  # name of the Shape folder
    urdf: Path  # engine file, its base frame at the centre of mass
    volume: float  # m^3 at scale 1
    vertices: np.ndarray  # [V, 3] m about the centre of mass, at scale 1
    pieces: Path  # OBJ of the convex pieces, in the frame of the engine
    display: Path | None  # mesh file to show, or None for the pieces' own boundary
    # com, size: (vertex - com [3]) / size converts the displayed mesh to the engine's frame
    com: np.ndarray
    size: float
    sphere: bool = False  # the engine's body is an exact sphere of diameter 1 m, `pieces` a hull of points on it


def split_of(name: str) -> str:
    """The split whose trajectories may contain a shape: of ten names, eight are for training, one for validation, one
    for test."""
    tenth = int(hashlib.sha256(name.encode()).hexdigest(), 16) % 10
    return {8: "validation", 9: "test"}.get(tenth, "train")


def origins(shapes: Path | None, random_solids: int = 0, *, as_is: bool = False) -> list[Origin]:
    """Shapes in a folder (NAME/ folders with `visual_geometry.obj` and `collision_geometry.obj`, and mesh files), then
    the first `random_solids` of PyBullet's random solids.

    `as_is` takes only the NAME/ folders, in their own size (Kubric's assets have their centre of mass at 0). Raises
    SdfsimError if there are no shapes, if a name occurs twice, or if one is not valid for a Shape folder.
    """
    found = []
    if shapes is not None:
        # Kubric's `dome` is scenery, not one of the eleven bodies: it has no visual geometry.
        folders = sorted(p.parent for p in shapes.glob(f"*/{COLLISION}") if (p.parent / VISUAL).exists())
        found += [Origin(f.name, f / VISUAL, f / COLLISION, as_is=as_is) for f in folders]
        if not as_is and shapes.is_dir():
            found += [Origin(f.stem, f) for f in visible(shapes) if f.suffix.lower() in MESH_SUFFIXES]
        if not found:
            also = "" if as_is else ", or mesh files"
            raise SdfsimError(f"{shapes}: no shapes found", f"expected NAME/{VISUAL} and NAME/{COLLISION}{also}")
    if random_solids:
        import pybullet_data

        home = Path(pybullet_data.getDataPath()) / "random_urdfs"
        found += [Origin(f"{SOLID}{k:03d}", pieces=home / f"{k:03d}" / f"{k:03d}.obj") for k in range(random_solids)]
    names = [origin.name for origin in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise SdfsimError(f"{shapes}: two shapes are called {min(twice)!r}", "rename one")
    check_names(f"{shapes}", names)
    return found


def prepare(found: list[Origin], engine: Path, on_progress: Progress) -> tuple[list[ShapeSource], dict[str, str]]:
    """Write engine files of all shapes, about their centres of mass; existing files are kept.

    Returns the usable shapes in the order of `found`, and for the others name -> reason. Raises SdfsimError if a shape
    taken `as_is` cannot be used.
    """
    engine.mkdir(parents=True, exist_ok=True)
    records: dict[int, dict[str, Any]] = {}
    for index, record in parallel(_prepare_one, [(origin, engine) for origin in found]):
        records[index] = record
        on_progress(len(records) / len(found), f"pieces of {found[index].name}, {len(records)} of {len(found)}")
    left_out = {o.name: records[k]["left_out"] for k, o in enumerate(found) if "left_out" in records[k]}
    return [_source(o, records[k], engine) for k, o in enumerate(found) if o.name not in left_out], left_out


def _prepare_one(origin: Origin, engine: Path) -> dict[str, Any]:
    """Write the pieces of one shape, and return its record."""
    file, digest = engine / f"{origin.name}.json", origin.digest()
    if file.exists() and (record := read_json(file)).get("sha256") == digest:
        return record
    try:
        record = {"sha256": digest, **_write_pieces(origin, engine)}
    except SdfsimError as error:
        if origin.as_is:
            raise
        record = {"sha256": digest, "left_out": error.message}
    write_json(file, record)
    return record


def _write_pieces(origin: Origin, engine: Path) -> dict[str, Any]:
    """Write NAME.obj in the engine's frame. Returns the volume at scale 1, and centre of mass and size in the original
    frame."""
    file = engine / f"{origin.name}.obj"
    if origin.as_is:
        assert origin.mesh and origin.pieces
        write_text(file, origin.pieces.read_text(encoding="utf-8"))
        return {"volume": mass_properties(load_mesh(origin.mesh))[0], "com": [0.0, 0.0, 0.0], "size": 1.0}
    if origin.primitive == "sphere":
        write_text(file, wavefront([convex_hull(primitives.sphere().vertices)]))
        return {"volume": np.pi / 6.0, "com": [0.0, 0.0, 0.0], "size": 1.0}
    if origin.primitive:
        pieces = primitives.convex_pieces(origin.primitive)
    elif origin.pieces is not None:
        pieces = load_pieces(origin.pieces)
    else:
        assert origin.mesh
        solid = solidify(load_mesh(origin.mesh), name=origin.name)
        extent = np.ptp(solid.surface.vertices, axis=0)
        if extent.min() < THINNEST * extent.max():
            raise SdfsimError(f"thinner than {THINNEST:g} of its largest extent")
        pieces = decompose(solid.surface, engine / origin.name)
    if len(pieces) == 1 and is_closed(pieces[0]):
        volume, com, _ = mass_properties(pieces[0])
    else:
        union = PiecesDistance(pieces)
        volume, com, _ = mass_properties_of_sdf(union, union.bounds, cells=48)
    size = float(np.ptp(np.concatenate([piece.vertices for piece in pieces]), axis=0).max())
    write_text(file, wavefront([Mesh((piece.vertices - com) / size, piece.faces) for piece in pieces]))
    return {"volume": volume / size**3, "com": com.tolist(), "size": size}


def _source(origin: Origin, record: dict[str, Any], engine: Path) -> ShapeSource:
    pieces, urdf = engine / f"{origin.name}.obj", engine / f"{origin.name}.urdf"
    sphere = origin.primitive == "sphere"
    # A ball made of facets would lose a third of its speed in 3 s of rolling. Paths of pieces are relative to the URDF,
    # so that a dataset can be moved; but not bare names, which the engine would look for in the working directory
    # first.
    mesh = f'<mesh filename="../{pieces.resolve().parent.name}/{pieces.name}"/>'
    write_urdf('<sphere radius="0.5"/>' if sphere else mesh, urdf)
    loaded = [load_mesh(origin.mesh)] if origin.as_is and origin.mesh else load_pieces(pieces)
    vertices = np.concatenate([mesh.vertices for mesh in loaded])
    com = np.array(record["com"])
    return ShapeSource(origin.name, urdf, record["volume"], vertices, pieces, origin.mesh, com, record["size"], sphere)


def decompose(mesh: Mesh, scratch: Path) -> list[Mesh]:
    """Convex pieces of a solid, given by its boundary in metres, by V-HACD. Its files (`scratch` with endings) are
    removed. Raises SdfsimError if V-HACD failed."""
    before, after, log = (scratch.with_name(f".{scratch.name}.{end}") for end in ("in.obj", "out.obj", "log"))
    try:
        write_text(before, wavefront([mesh]))
        command = [sys.executable, "-c", VHACD_CALL, before, after, log]
        subprocess.run(command, capture_output=True, check=True, timeout=VHACD_TIME)
        return load_pieces(after)
    except subprocess.SubprocessError as error:
        raise SdfsimError("V-HACD found no convex pieces", "give them in a NAME/ folder") from error
    finally:
        for file in (before, after, log):
            file.unlink(missing_ok=True)


def fit_shapes(sources: list[ShapeSource], out: Path, on_progress: Progress) -> None:
    """Fit a Shape folder `out/NAME` for every shape that has none yet. The surface is that of the convex pieces, since
    PyBullet collides these."""
    todo = [source for source in sources if not (out / source.name / "shape.json").exists()]
    for done, (index, _) in enumerate(parallel(_fit_one, [(s, out / s.name) for s in todo]), start=1):
        on_progress(done / len(todo), f"shape {todo[index].name} fitted, {done} of {len(todo)}")


def _fit_one(source: ShapeSource, out: Path) -> None:
    if source.sphere:
        analytic_shape("sphere", radius=0.5, name=source.name).save(out)
        return
    display = load_mesh(source.display) if source.display else None
    if display:
        display = Mesh((display.vertices - source.com) / source.size, display.faces, display.colors)
    fit_pieces(load_pieces(source.pieces), name=source.name, display=display, nodes=NODES).save(out)
