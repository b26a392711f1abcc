"""Meshes -> Shape folders with compact SDFs: one of the scenery, one of each body."""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from pipeline.mesh.cleaning import joined
from pipeline.mesh.meshing import SCENERY, read_parts, rounded
from pipeline.mesh.placement import Placement, load_placement
from pipeline.mesh.visibility import Caster
from sdfsim.errors import EXIT_QUALITY, SdfsimError
from sdfsim.files import write_text
from sdfsim.shape.mesh import Mesh, load_mesh

Progress = Callable[[float, str], None]

# Of a budget the scenery gets as much as this many bodies: it has more to it.
SCENERY_SHARE = 2


def fit_parts(mesh_folder: Path, out: Path, *, budget: float | None, recipe: str = "default", seed: int = 0,
              device: str = "cpu", on_progress: Progress | None = None) -> dict:  # fmt: skip
    """Fits a compact SDF to the scenery and to every body, each a Shape folder in `out` that goes by its name.

    The scenery's solid is closed (capped where the trained space ends), so the sign of its distance is right
    everywhere, also above the open scenery where bodies come from; what is shown of it is its visible surface. A body's
    origin is the middle of its base. Folders that are there already are kept.

    Args:
        mesh_folder: of the mesh stage.
        out: existing folder.
        budget: s of fitting, for all.
        recipe: of the fits.
        seed: of the fits.
        device: where to compute.
        on_progress: called with (fraction, message).

    Returns:
        `shapes`: a certificate each; `passed`, `reason` and `caveats` (a line each) for all of them.

    Raises:
        SdfsimError: the mesh stage has not run, or a mesh cannot be used.
    """
    from sdfsim.shape.asset import load_shape

    parts = read_parts(mesh_folder)
    weights = {SCENERY: SCENERY_SHARE} if parts["scenery"] else {}
    weights |= {entry["name"]: 1 for entry in parts["objects"]}
    shares = {name: weight / sum(weights.values()) for name, weight in weights.items()}
    certificates, done = {}, 0.0
    for name, share in shares.items():

        def tell(fraction: float, message: str, name: str = name, before: float = done, share: float = share) -> None:
            if on_progress:
                on_progress(before + share * fraction, f"{name}: {message}")

        done += share
        folder = out / name
        if (folder / "shape.json").exists():
            checkpoint_of(out, name).unlink(missing_ok=True)
            certificates[name] = load_shape(folder).certificate
            continue
        solid, shown = meshes_of(mesh_folder, name)
        certificates[name] = fit_one(
            solid, shown, out, name, budget=None if budget is None else budget * share, recipe=recipe, seed=seed,
            device=device, on_progress=tell,
        )  # fmt: skip
    missed = [f"{name}: {found['reason']}" for name, found in certificates.items() if not found["passed"]]
    caveats = [f"{name}: {found['caveat']}" for name, found in certificates.items() if found["caveat"]]
    return {"shapes": certificates, "passed": not missed, "reason": "; ".join(missed), "caveats": caveats}


def fit_one(solid: Mesh, shown: Mesh, out: Path, name: str, *, budget: float | None, recipe: str, seed: int,
            device: str, on_progress: Progress) -> dict:  # fmt: skip
    """Fits one shape, saves it as the folder `out`/`name`, and returns its certificate."""
    from sdfsim.shape.fit import fit_mesh

    checkpoint = checkpoint_of(out, name)
    shape = fit_mesh(
        solid, name=name, recipe=recipe, budget=budget, seed=seed, cap=True,  # type: ignore[arg-type]
        on_progress=on_progress, checkpoint=checkpoint, device=device,
    )  # fmt: skip
    # The folder appears complete or not at all: a run that goes on keeps those that are there.
    partial = out / f".{name}.part"
    shutil.rmtree(partial, ignore_errors=True)
    replace(shape, mesh=shown).save(partial)
    partial.rename(out / name)
    checkpoint.unlink(missing_ok=True)
    return shape.certificate


def checkpoint_of(out: Path, name: str) -> Path:
    """Where the fit of a shape goes on from."""
    return out / f"{name}.checkpoint"


def meshes_of(mesh_folder: Path, name: str) -> tuple[Mesh, Mesh]:
    """The closed mesh of a part in its own frame, and what is displayed of it."""
    if name == SCENERY:
        return load_mesh(mesh_folder / "solid.ply"), load_mesh(mesh_folder / "shown.ply")
    mesh = load_mesh(mesh_folder / "objects" / f"{name}.ply")
    moved = replace(mesh, vertices=mesh.vertices - origin_of(mesh))
    return moved, moved


def origin_of(mesh: Mesh) -> np.ndarray:
    """A body's origin [3]: the middle of the base of its bounding box."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return np.array([*(low + high)[:2] / 2, low[2]])


DENSITY = 400.0  # kg/m^3, wood: no photo tells what a thing is made of
SURFACE = "friction: 0.8, restitution: 0.4"


@dataclass(frozen=True)
class Found:
    """A body as the scene file needs it.

    Attributes:
        name: also of its asset.
        origin: [3] m, where its shape's origin is.
        static: a person wants it to stay.
    """

    name: str
    origin: np.ndarray
    static: bool = False


def scene_text(placement: Placement, drop: Drop | None, *, scenery: bool = True, found: Sequence[Found] = (),
               shape: str = "box", seed: int = 0) -> str:  # fmt: skip
    """The text of scene.yaml: a floor, the scenery, bodies that were found, and one dropped from above.

    Args:
        placement: of the meshes.
        drop: where the last one starts; None leaves it out.
        scenery: whether there is any.
        found: bodies, with assets that go by their names.
        shape: of what is dropped, box or ball.
        seed: of the scene.
    """
    source = "the dominant plane" if placement.up_from == "plane" else "the cameras"
    assumed = " (give --size or --distance for true metres)" if placement.size_from.startswith("assumed") else ""
    lines = [
        f"# Reconstructed from photos. Up from {source}, within {placement.up_within:.1f} degrees "
        f"(confidence: {placement.up_confidence}).",
        f"# Size {placement.size_from}{assumed}.",
        "version: 1",
        "duration: 4.0                    # s",
        f"seed: {seed}",
        "gravity: [0, 0, -9.81]           # m/s^2",
        "shapes:",
    ]
    plane = {"normal": [0, 0, 1], "offset": float(rounded(placement.floor))}
    bodies = [f"  - {{name: floor, motion: static, plane: {_flow(plane)}}}"]
    if scenery:
        lines.append("  scene: {asset: assets/scene}")
        bodies.append(f"  - {{name: scene, shape: scene, motion: static, {SURFACE}}}")
    for body in found:
        lines.append(f"  {body.name}: {{asset: assets/{body.name}}}")
        moves = "motion: static" if body.static else f"density: {DENSITY:g}"
        position = _flow(rounded(body.origin).tolist())
        bodies.append(f"  - {{name: {body.name}, shape: {body.name}, position: {position}, {moves}, {SURFACE}}}")
    if drop is not None:
        box = {"box": {"size": rounded((drop.side, drop.side, drop.thickness)).tolist()}}
        ball = {"sphere": {"radius": float(rounded(drop.thickness / 2))}}
        lines.append(f"  {shape}: {_flow(box if shape == 'box' else ball)}")
        bodies += [
            f"  - name: {shape}",
            f"    shape: {shape}",
            f"    position: {_flow(rounded(drop.position).tolist())}     # m",
            f"    quat_xyzw: {_flow(rounded(drop.quat_xyzw).tolist())}  # level with the surface below",
            f"    density: {DENSITY:g}                 # kg/m^3",
            *(f"    {part}" for part in SURFACE.split(", ")),
        ]
    return "\n".join([*lines, "bodies:", *bodies, ""])


def _flow(content: dict | list) -> str:
    """One line of YAML. Its numbers are not Python's: 1e-05 would be read as a text."""
    return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, width=1000).strip()


def write_scene(mesh_folder: Path, scene_file: Path, *, shape: str = "box", static: Sequence[str] = (),
                written: str | None = None, seed: int = 0) -> dict:  # fmt: skip
    """Writes scene.yaml for the meshes of a mesh folder; returns where the body is dropped.

    A scene file that the user has changed is kept beside it as `scene.yaml.bak`.

    Args:
        mesh_folder: of the mesh stage.
        scene_file: to write.
        shape: of what is dropped: box, ball or none.
        static: bodies that are to stay where they are, by name.
        written: hash of the scene file as this function last wrote it; None where it never did.
        seed: of the scene.

    Raises:
        SdfsimError: the mesh stage has not run, or no body has a name in `static`.
    """
    mesh_folder = Path(mesh_folder)
    parts, placement = read_parts(mesh_folder), load_placement(mesh_folder)
    names = [entry["name"] for entry in parts["objects"]]
    wrong = sorted(set(static) - set(names))
    if wrong:
        there = f"found: {', '.join(names)} (see mesh/objects.png)" if names else "no separate bodies were found"
        raise SdfsimError(f"static: no body is called {', '.join(wrong)}", there)
    solids = [load_mesh(mesh_folder / "objects" / f"{name}.ply") for name in names]
    found = [Found(name, origin_of(mesh), name in static) for name, mesh in zip(names, solids, strict=True)]
    notes: list[str] = []
    drop = None
    if shape != "none":
        scenery = [load_mesh(mesh_folder / "solid.ply")] if parts["scenery"] else []
        shown = load_mesh(mesh_folder / "shown.ply") if parts["scenery"] else joined(solids)
        drop = choose_drop(shown, joined([*scenery, *solids]))
        if drop.slope > LEVEL:
            notes.append(f"no level place to drop a body onto: the flattest slopes by {drop.slope:.0f} degrees")
    text = scene_text(placement, drop, scenery=parts["scenery"], found=found, shape=shape, seed=seed)
    if scene_file.exists() and content_hash(scene_file.read_bytes()) not in (written, content_hash(text.encode())):
        kept = free_name(scene_file)
        os.replace(scene_file, kept)
        notes.append(f"{scene_file.name} had been changed by hand: kept as {kept.name}")
    write_text(scene_file, text)
    return {
        "objects": names, "static": sorted(static), "density_assumed": DENSITY, "size": placement.size_from,
        "drop": {"shape": shape, **(asdict(drop) if drop else {})}, "notes": notes,
        "scene_sha256": content_hash(text.encode()),
    }  # fmt: skip


def content_hash(content: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(content).hexdigest()


def free_name(path: Path) -> Path:
    """A name beside `path` that is not taken: with `.bak`, or `.bak2`, `.bak3` and so on, added."""
    numbers = itertools.chain([""], itertools.count(2))
    return next(p for p in (path.with_name(f"{path.name}.bak{n}") for n in numbers) if not p.exists())


# Sides of the dropped slab as shares of the scenery's widest side: the largest that finds a level place is taken.
BODY_SHARES = (0.09, 0.06, 0.045)
THICKNESS = 0.5  # of the slab, as a share of its side; a cube tips over more easily
LEVEL = 10.0  # degrees; far below what friction holds, as learned contacts creep on slopes
SEEN = 0.9  # share of the slab's footprint that photos must show
GAP = 0.3  # of the fall, as a share of the side
SAMPLES = 11  # points along the side of the footprint


@dataclass(frozen=True)
class Drop:
    """Where a slab is dropped.

    Attributes:
        side: of the slab, m.
        thickness: of the slab, m.
        position: [3] m, its centre at the start.
        quat_xyzw: [4] its orientation, already that in which it comes to rest.
        support: height at which the middle of its underside comes to rest, m.
        slope: of the steepest plane that it may settle into, degrees.
    """

    side: float
    thickness: float
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]
    support: float
    slope: float


@dataclass(frozen=True)
class Spot:
    """How a plate lies at a place.

    Attributes:
        at: [2] m, where its middle is.
        height: of its middle, m.
        normal: [3] of it.
        slope: of the steepest plane that it may settle into, degrees.
        obstacle: how far the surface around reaches above it, m.
        score: how good the place is; larger is better.
    """

    at: np.ndarray
    height: float
    normal: np.ndarray
    slope: float
    obstacle: float
    score: float


class Above:
    """Heights of a mesh's topmost surface."""

    def __init__(self, mesh: Mesh) -> None:
        self.caster = Caster(mesh)
        self.top = float(mesh.vertices[:, 2].max()) + 1.0

    def heights(self, at: np.ndarray) -> np.ndarray:
        """Heights [...] m over the points `at` [..., 2] m; NaN where there is no surface."""
        origin = np.full((at.size // 2, 3), self.top)
        origin[:, :2] = at.reshape(-1, 2)
        distance, _ = self.caster.hits(origin, np.tile([0.0, 0.0, -1.0], (len(origin), 1)))
        return np.where(np.isfinite(distance), self.top - distance, np.nan).reshape(at.shape[:-1])


def plate_on(points: np.ndarray, side: float) -> tuple[float, np.ndarray, float]:
    """How a square plate comes to lie on surface points.

    Lowered flat onto them, a plate ends up on the face of their upper convex hull that its middle is over: the corners
    of that face are what it touches.

    Args:
        points: [P, 3] m; x and y from the plate's middle.
        side: of the plate, m.

    Returns:
        Height of the plate's middle; its normal [3]; and the steepest slope, degrees, of the faces within a tenth of
        the side of the middle: those it may rock into.
    """
    from scipy.spatial import ConvexHull

    # One point far below gives the hull a body where all the others lie in one plane.
    below = np.array([[0, 0, points[:, 2].min() - 10 * side]])
    faces = ConvexHull(np.concatenate([points, below])).equations
    faces = faces[faces[:, 2] > 1e-9]
    turn = np.arange(8) * np.pi / 4
    near = np.concatenate([[[0, 0]], 0.1 * side * np.stack([np.cos(turn), np.sin(turn)], 1)])
    heights = -(near @ faces[:, :2].T + faces[:, 3]) / faces[:, 2]
    over = heights.argmin(1)
    slope = float(np.degrees(np.arccos(np.clip(faces[over, 2].min(), -1, 1))))
    return float(heights[0, over[0]]), faces[over[0], :3], slope


def find_spots(shown: Above, solid: Above, bounds: np.ndarray, side: float, seen: float) -> list[Spot]:
    """Every place where a plate finds a support, on a grid of a quarter of its side.

    Args:
        shown: the surface that photos show.
        solid: all of the surface, also what no photo shows.
        bounds: [2, 3] m of the surface that photos show.
        side: of the plate, m.
        seen: least share of the footprint that photos must show.
    """
    low, high = bounds
    axes = [np.arange(low[k], high[k] + side / 8, side / 4) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    # Wider than the plate: what stands beside it must not be in its way on the way down.
    line = np.linspace(-0.7, 0.7, SAMPLES + 4) * side
    around = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    under = (np.abs(around) <= 0.5 * side + 1e-9).all(1)
    visible = shown.heights(places[:, None] + around[under])
    top = solid.heights(places[:, None] + around)
    top[:, under] = np.fmax(top[:, under], visible)
    shares = (visible > top[:, under] - 0.2 * side).mean(1)
    extent, middle = np.maximum(high - low, 1e-9), (low + high) / 2
    found = []
    for at, share, heights in zip(places, shares, top, strict=True):
        there = np.isfinite(heights) & under
        if share < seen or there.sum() < 4:
            continue
        height, normal, slope = plate_on(np.c_[around[there], heights[there]], side)
        plane = height - (around @ normal[:2]) / normal[2]
        obstacle = max(0.0, float(np.nanmax(heights - plane)))
        central = float(np.linalg.norm((at - middle[:2]) / extent[:2]))
        score = (height - low[2]) / extent[2] - 1.2 * central - slope / LEVEL - obstacle / side
        found.append(Spot(at, height, normal, slope, obstacle, float(score)))
    return found


def choose_drop(shown: Mesh, solid: Mesh) -> Drop:
    """Chooses the body and the place: level, seen in the photos, high and central.

    Args:
        shown: visible surface, metres, z up; the body has to land on it.
        solid: closed surface, also what no photo shows.
    """
    bounds = np.stack([shown.vertices.min(0), shown.vertices.max(0)])
    widest = float((bounds[1] - bounds[0]).max())
    above, below = Above(shown), Above(solid)
    flattest: tuple[Spot, float] | None = None
    for seen in (SEEN, 0.5, 0.0):
        for side in (share * widest for share in BODY_SHARES):
            found = find_spots(above, below, bounds, side, seen)
            level = [spot for spot in found if spot.slope <= LEVEL]
            if level:
                return drop_at(max(level, key=lambda spot: spot.score), side)
            for spot in found:
                if flattest is None or spot.slope < flattest[0].slope:
                    flattest = spot, side
        if flattest is not None:
            return drop_at(*flattest)
    raise SdfsimError("scene: no place to drop a body onto", "look at mesh/mesh.ply", exit_code=EXIT_QUALITY)


def drop_at(spot: Spot, side: float) -> Drop:
    """The drop that ends with a slab lying at a spot."""
    normal, thickness = spot.normal, THICKNESS * side
    center = np.array([*spot.at, spot.height]) + 0.5 * thickness * normal
    center[2] += GAP * side + spot.obstacle
    turn = np.array([-normal[1], normal[0], 0.0, 1.0 + normal[2]])  # The shortest turn from z to the normal.
    x, y, z, w = (float(value) for value in turn / np.linalg.norm(turn))
    return Drop(side, thickness, (float(center[0]), float(center[1]), float(center[2])), (x, y, z, w),
                spot.height, spot.slope)  # fmt: skip
