"""The shapes of a dataset: found, cut into convex pieces for the engine, split by name, and fitted."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.data.convex_pieces import VHACD, decompose, wavefront
from sdfsim.data.dataset import SOLID, check_names
from sdfsim.data.pybullet_sim import write_form_urdf, write_urdf
from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json, write_text
from sdfsim.parallel import parallel
from sdfsim.shape import primitives
from sdfsim.shape.distance import PiecesDistance
from sdfsim.shape.fit import fit_pieces
from sdfsim.shape.mass import mass_properties, mass_properties_of_sdf
from sdfsim.shape.mesh import MESH_SUFFIXES, Mesh, convex_hull, is_closed, load_mesh, load_pieces
from sdfsim.shape.shape import analytic_shape
from sdfsim.shape.watertight import solidify

NODES = 512  # surface nodes a shape: the vertices and edges of the pieces first, since those are what really touches
THINNEST = 0.02  # thickness over largest extent below which a mesh is left out: no fit resolves it
VISUAL, COLLISION = "visual_geometry.obj", "collision_geometry.obj"  # the two files of a NAME/ folder
SOLIDS = 1000  # in pybullet_data

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class ShapeSource:
    """One shape as recipes and the fit need it.

    Attributes:
        name: of the Shape folder.
        urdf: engine file, its base frame at the centre of mass.
        volume: m^3 at scale 1.
        vertices: [V, 3] m about the centre of mass, at scale 1.
        pieces: OBJ of the convex pieces, in the frame of the engine.
        display: mesh file to show, or None for the pieces' own boundary.
        com, size: the displayed mesh comes into the engine's frame by (vertex - com [3]) / size.
        sphere: the engine's body is an exact sphere of diameter 1 m, `pieces` a hull of points on it.
    """

    name: str
    urdf: Path
    volume: float
    vertices: np.ndarray
    pieces: Path
    display: Path | None
    com: np.ndarray
    size: float
    sphere: bool = False


@dataclass(frozen=True)
class Origin:
    """Where a shape comes from: files (`pieces` None: to be decomposed), or the name of a primitive."""

    name: str
    mesh: Path | None = None
    pieces: Path | None = None
    primitive: str = ""

    @property
    def how(self) -> str:
        """How its convex pieces come about."""
        return "primitive" if self.primitive else "own" if self.pieces else "vhacd"

    def digest(self) -> str:
        """Changes with the geometry and how it is cut."""
        digest = hashlib.sha256(f"{self.how} {self.primitive} {VHACD if self.how == 'vhacd' else ''}".encode())
        for file in (self.mesh, self.pieces):
            if file is not None:
                digest.update(file.read_bytes())
        return digest.hexdigest()[:16]


def split_of(name: str) -> str:
    """The split whose trajectories may hold a shape: eight names of ten train, one validates, one tests."""
    tenth = int(hashlib.sha256(name.encode()).hexdigest(), 16) % 10
    return {8: "validation", 9: "test"}.get(tenth, "train")


def find_shapes(shapes: Path, engine: Path) -> list[ShapeSource]:
    """MOVi-B's shapes as they are, in name order, their engine files written under `engine`.

    Raises:
        SdfsimError: when the folder holds none.
    """
    engine.mkdir(parents=True, exist_ok=True)
    found = []
    for origin in kubasic_origins(shapes):
        assert origin.mesh is not None and origin.pieces is not None
        mesh = load_mesh(origin.mesh)
        volume = mass_properties(mesh)[0]
        # Kubric's assets have their centre of mass at the origin; their URDF says so and the engine takes it.
        pieces = engine / f"{origin.name}.obj"
        write_text(pieces, origin.pieces.read_text(encoding="utf-8"))
        urdf = _engine_file(pieces)
        found.append(ShapeSource(origin.name, urdf, volume, mesh.vertices, pieces, origin.mesh, np.zeros(3), 1.0))
    return found


def kubasic_origins(shapes: Path) -> list[Origin]:
    """The NAME/ folders of a folder (see `find_shapes`), in name order.

    Raises:
        SdfsimError: there are none, or one of a name that no Shape folder can have.
    """
    found = [Origin(f.name, f / VISUAL, f / COLLISION) for f in _shape_folders(shapes)]
    if not found:
        raise SdfsimError(f"{shapes}: no shapes found", f"expected NAME/{VISUAL} and NAME/{COLLISION}")
    check_names(f"{shapes}", [origin.name for origin in found])
    return found


def origins(shapes: Path | None, random_solids: int = 0) -> list[Origin]:
    """Mesh files and NAME/ folders (see `find_shapes`) of a folder, then the first of PyBullet's random solids.

    Raises:
        SdfsimError: no shapes, more solids than there are, one name twice, or one that no Shape folder can have.
    """
    found = []
    if shapes is not None:
        found += [Origin(f.name, f / VISUAL, f / COLLISION) for f in _shape_folders(shapes)]
        found += [Origin(f.stem, f) for f in sorted(shapes.glob("*")) if f.suffix.lower() in MESH_SUFFIXES]
        if not found:
            raise SdfsimError(f"{shapes}: no shapes found", f"expected mesh files or NAME/{VISUAL} and {COLLISION}")
    if not 0 <= random_solids <= SOLIDS:
        raise SdfsimError(f"--random-solids must be 0 to {SOLIDS} (got {random_solids})")
    if random_solids:
        import pybullet_data

        home = Path(pybullet_data.getDataPath()) / "random_urdfs"
        found += [Origin(f"{SOLID}{k:03d}", pieces=home / f"{k:03d}" / f"{k:03d}.obj") for k in range(random_solids)]
    names = [origin.name for origin in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise SdfsimError(f"{shapes}: two shapes are called {min(twice)!r}", "rename one")
    check_names(f"{shapes}", names)
    return found


def made_from(found: list[Origin]) -> dict[str, dict[str, str]]:
    """Name -> how its pieces come about and what changes with its geometry: what `dataset.json` is to say."""
    return {origin.name: {"pieces": origin.how, "sha256": origin.digest()} for origin in found}


def prepare(found: list[Origin], engine: Path, on_progress: Progress) -> tuple[list[ShapeSource], dict]:
    """Engine files of all shapes, about their centres of mass and of largest extent 1 m; kept where they are there.

    Args:
        found: from `origins`, or primitives.
        engine: folder for NAME.obj (the pieces), NAME.urdf and NAME.json.
        on_progress: called with the fraction done and a message.

    Returns:
        The usable shapes in the order of `found`; and what `dataset.json` is to say: `shapes`, `left_out`
        (name -> why) and `vhacd`.
    """
    engine.mkdir(parents=True, exist_ok=True)
    records: list[dict[str, Any]] = [{}] * len(found)
    for done, (index, record) in enumerate(parallel(_prepare_one, [(o, engine) for o in found]), start=1):
        records[index] = record
        on_progress(done / len(found), f"pieces of {found[index].name}, {done} of {len(found)}")
    pairs = list(zip(found, records, strict=True))
    left_out = {o.name: r["left_out"] for o, r in pairs if "left_out" in r}
    kept = [(o, r) for o, r in pairs if "left_out" not in r]
    info = {
        "shapes": [o.name for o, _ in kept],
        "left_out": left_out,
        "vhacd": VHACD,
    }
    return [_source(o, r, engine) for o, r in kept], info


def fit_shapes(sources: list[ShapeSource], out: Path, on_progress: Progress) -> None:
    """Fit a Shape folder `out/NAME` for every shape that has none yet.

    The surface is that of the convex pieces, since that is what the teacher collides.
    """
    todo = [source for source in sources if not (out / source.name / "shape.json").exists()]
    for done, (index, _) in enumerate(parallel(_fit_one, [(s, out / s.name) for s in todo]), start=1):
        on_progress(done / len(todo), f"shape {todo[index].name} fitted, {done} of {len(todo)}")


def _shape_folders(shapes: Path) -> list[Path]:
    # `dome` is Kubric's scenery, not one of its eleven bodies: it has no visual geometry here.
    return sorted(p.parent for p in shapes.glob(f"*/{COLLISION}") if (p.parent / VISUAL).exists())


def _prepare_one(origin: Origin, engine: Path) -> dict:
    """Write one shape's engine files; its record."""
    file, digest = engine / f"{origin.name}.json", origin.digest()
    if file.exists() and (record := read_json(file)).get("sha256") == digest:
        return record
    try:
        pieces = _pieces(origin, engine)
        volume, com = _volume(pieces)
        size = float(np.ptp(np.concatenate([piece.vertices for piece in pieces]), axis=0).max())
    except SdfsimError as error:
        # A record is the same wherever the meshes lie.
        reason = error.message
        for path in (origin.mesh, origin.pieces):
            reason = reason.replace(str(path), path.name) if path else reason
        record: dict[str, Any] = {"sha256": digest, "left_out": reason}
    else:
        if origin.primitive == "sphere":
            volume, com, size = np.pi / 6.0, np.zeros(3), 1.0
        moved = [Mesh((piece.vertices - com) / size, piece.faces) for piece in pieces]
        write_text(engine / f"{origin.name}.obj", wavefront(moved))
        record = {"sha256": digest, "volume": volume / size**3, "com": com.tolist(), "size": size}
    write_json(file, record)
    return record


def _pieces(origin: Origin, engine: Path) -> list[Mesh]:
    if origin.primitive == "sphere":
        return [convex_hull(primitives.sphere().vertices)]
    if origin.primitive:
        return primitives.convex_pieces(origin.primitive)
    if origin.pieces is not None:
        return load_pieces(origin.pieces)
    assert origin.mesh is not None
    solid = solidify(load_mesh(origin.mesh), name=origin.name)
    extent = np.ptp(solid.surface.vertices, axis=0)
    if extent.min() < THINNEST * extent.max():
        raise SdfsimError(f"thinner than {THINNEST:g} of its largest extent")
    return decompose(solid.surface, engine / origin.name)


def _volume(pieces: list[Mesh]) -> tuple[float, np.ndarray]:
    """Volume m^3 and centre of mass [3] m of the union."""
    if len(pieces) == 1 and is_closed(pieces[0]):
        volume, com, _ = mass_properties(pieces[0])
    else:
        volume, com, _ = mass_properties_of_sdf(_Union(PiecesDistance(pieces)), cells=48)
    return volume, com


@dataclass(frozen=True)
class _Union:
    """Distances to a union of pieces as integrals over an SDF want them; without gradients."""

    oracle: PiecesDistance

    @property
    def bounds(self) -> np.ndarray:
        return self.oracle.bounds

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, None]:
        return self.oracle(points).distance, None


def _source(origin: Origin, record: dict, engine: Path) -> ShapeSource:
    pieces = engine / f"{origin.name}.obj"
    vertices = np.concatenate([piece.vertices for piece in load_pieces(pieces)])
    # A ball of facets would lose a third of its speed in 3 s of rolling.
    sphere = origin.primitive == "sphere"
    ball = '<sphere radius="0.5"/>'
    urdf = write_form_urdf(ball, pieces.with_suffix(".urdf")) if sphere else _engine_file(pieces)
    com = np.array(record["com"])
    return ShapeSource(origin.name, urdf, record["volume"], vertices, pieces, origin.mesh, com, record["size"], sphere)


def _engine_file(pieces: Path) -> Path:
    """Write NAME.urdf beside NAME.obj, the pieces about their centre of mass: a dataset can be moved."""
    # Not the bare name: the engine looks in the working directory first, where meshes of that name may well lie.
    mesh = Path("..", pieces.resolve().parent.name, pieces.name)
    return write_urdf(mesh, np.zeros(3), pieces.with_suffix(".urdf"))


def _fit_one(source: ShapeSource, out: Path) -> None:
    if source.sphere:
        analytic_shape("sphere", radius=0.5, name=source.name).save(out)
        return
    display = None
    if source.display is not None:
        mesh = load_mesh(source.display)
        display = Mesh((mesh.vertices - source.com) / source.size, mesh.faces, mesh.colors)
    fit_pieces(load_pieces(source.pieces), name=source.name, display=display, nodes=NODES).save(out)
