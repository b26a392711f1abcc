"""Meshes -> a scene: Shape folders with compact SDFs, the scene.yaml, and a place to drop a body onto it."""

import hashlib
import itertools
import shutil
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from pipeline.clearing import Cleared, cleared
from pipeline.materials import SCENERY, SURROUNDINGS, Choice
from pipeline.mesh.bodies import LAYER
from pipeline.mesh.joint import JOINT, PART, HeldPart, load_held, scene_keys
from pipeline.mesh.meshing import SHOWN_AROUND, SOLID_AROUND, TEXTURED, read_parts, rounded
from pipeline.mesh.placement import LEVEL_NORMAL, MIN_FLOOR, Placement, load_placement
from pipeline.mesh.visibility import heights
from pipeline.records import BodyReport, FitReport, SceneReport
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError, nearest
from sdfsim.base.files import write_text
from sdfsim.base.parallel import Progress, share_of, silent
from sdfsim.geometry.bvh import ClosestPoint
from sdfsim.geometry.mesh import Mesh, face_normals, joined
from sdfsim.geometry.mesh_io import load_mesh, read_glb
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.sdf.far_field import BOX
from sdfsim.sdf.sdf import Sdf

SAMPLES, BLOCK = (65, 161), 4  # fewest and most along a side of a grid; cells per side of a block sampled at once
AROUND = 65  # samples a side of the room around, whose walls are flat
SCENERY_SHARE = 2  # The scenery gets the budget of this many bodies, because it has more detail.
SIDE = 0.06  # of the dropped slab, as a share of the scenery's widest side
THICKNESS = 0.5  # of the slab, as a share of its side; a cube tips over more easily
LEVEL = 10.0  # degrees; far below what friction holds, as learned contacts creep on slopes
BUMP = 0.06  # how far a level place may stick out of its plane, as a share of the side
BELOW = 0.001  # of the scenery's widest side: distance of the added floor below the scenery's own floor
OWN_FLOOR, DENTS = 0.01, 0.02  # of that side: largest distance of a floor from 0; share of it that may lie lower
UNSEEN = 0.1  # share of the slab's footprint that photos may leave out
ONTO, STEPS = 1.0, 4  # of a cell of the field: largest distance of a displayed vertex from the fit; steps to it
TOUCHES = 0.05  # of a part's surface that is near its holder
GAP = 0.3  # of the fall, as a share of the side


def fit_parts(mesh_folder: Path, out: Path, *, budget: float | None, recipe: str = "default",
              sdf: Literal["grid", "mlp"] = "mlp", seed: int = 0, device: str = "cpu",
              on_progress: Progress = silent) -> FitReport:  # fmt: skip
    """Fits a compact SDF to the scenery and to every body within the budget, s, or samples their distances on a grid;
    each is a Shape folder in `out`, named by `folder_of`, and existing ones are kept."""
    from sdfsim.sdf.baked_grid import grid_certificate
    from sdfsim.shape.make import fit_mesh, mesh_shape
    from sdfsim.shape.shape import load_shape

    parts, skins = read_parts(mesh_folder), skins_of(mesh_folder)
    weights = {SCENERY: SCENERY_SHARE} if parts["scenery"] else {}
    weights |= {entry["name"]: 1 for entry in parts["objects"]}
    weights |= {SURROUNDINGS: 1} if parts["surroundings"] else {}
    certificates, done = {}, 0.0
    for name, weight in weights.items():
        share = weight / sum(weights.values())
        report = share_of(lambda part, message, name=name: on_progress(part, f"{name}: {message}"), done, share)
        done += share
        folder, partial = out / folder_of(name), out / f".{folder_of(name)}.part"
        if (folder / "shape.json").exists():
            certificates[name] = load_shape(folder).certificate
            continue
        solid, shown = meshes_of(mesh_folder, name)
        if sdf == "grid" or name == SURROUNDINGS:
            side = AROUND if name == SURROUNDINGS else samples_of(solid, parts["cell"])
            shape = mesh_shape(
                solid, name=name, kind="grid", cap=True, resolution=side, coarse=BLOCK, on_progress=report
            )
        else:
            shape = fit_mesh(
                solid, name=name, recipe=recipe, seed=seed, cap=True,  # type: ignore[arg-type]
                budget=None if budget is None else budget * share, on_progress=report, device=device,
            )  # fmt: skip
        shape.certificate.update(grid_certificate(shape.sdf, shape.nodes))
        # The folder appears complete or not at all: a resumed run keeps existing folders.
        shutil.rmtree(partial, ignore_errors=True)
        if name == SCENERY:
            shown = onto(shape.sdf, shown, ONTO * parts["cell"])
        replace(shape, mesh=shown, skin=skins.get(name)).save(partial)
        partial.rename(folder)
        certificates[name] = shape.certificate
    missed = [f"{name}: {found['reason']}" for name, found in certificates.items() if not found["passed"]]
    caveats = [f"{name}: {found['caveat']}" for name, found in certificates.items() if found["caveat"]]
    return FitReport(certificates, not missed, "; ".join(missed), caveats)


def onto(sdf: Sdf, mesh: Mesh, reach: float) -> Mesh:
    """A mesh with its vertices moved to the surface of a fit, where that is within `reach` m. The mesh from photos has
    bumps finer than the fit of a scenery: without this, bodies would seem to overlap them."""
    vertices = mesh.vertices.copy()
    near = np.flatnonzero(np.abs(np.asarray(sdf(vertices)[0])) < reach)
    for _ in range(STEPS):
        distance, slope = (np.asarray(part) for part in sdf(vertices[near]))
        steep = np.maximum((slope**2).sum(1), 0.25)  # a grid is flat between surfaces that are close
        vertices[near] -= (distance / steep)[:, None] * slope
    # If the fit has no such surface, as for a thin wall, the mesh keeps the surface of the photos.
    lost = np.linalg.norm(vertices - mesh.vertices, axis=1) > reach
    return replace(mesh, vertices=np.where(lost[:, None], mesh.vertices, vertices))


def samples_of(mesh: Mesh, cell: float) -> int:
    """Samples along a side of the grid of a mesh from a field with cells of `cell` m: two per cell, within
    `SAMPLES`."""
    wide = 2 * BOX * float(np.ptp(mesh.vertices, axis=0).max())
    blocks = np.clip(np.ceil(2 * wide / cell / BLOCK), *((np.array(SAMPLES) - 1) // BLOCK))
    return int(blocks) * BLOCK + 1


def folder_of(name: str) -> str:
    """Name of the Shape folder of a part in `assets`."""
    return "scene" if name == SCENERY else name


def meshes_of(mesh_folder: Path, name: str) -> tuple[Mesh, Mesh]:
    """The closed mesh of a part in its own frame, and its displayed mesh."""
    if name == SCENERY:
        return load_mesh(mesh_folder / "solid.ply"), load_mesh(mesh_folder / "shown.ply")
    if name == SURROUNDINGS:
        return load_mesh(mesh_folder / SOLID_AROUND), load_mesh(mesh_folder / SHOWN_AROUND)
    mesh = load_mesh(mesh_folder / "objects" / f"{name}.ply")
    moved = replace(mesh, vertices=mesh.vertices - origin_of(mesh))
    return moved, moved


def skins_of(mesh_folder: Path) -> dict[str, Mesh]:
    """The textured mesh of each part in its own frame; empty if there are no textures."""
    skins = read_glb(mesh_folder / TEXTURED) if (mesh_folder / TEXTURED).exists() else {}
    bodies = [name for name in skins if name not in (SCENERY, SURROUNDINGS)]
    origins = {name: origin_of(load_mesh(mesh_folder / "objects" / f"{name}.ply")) for name in bodies}
    return {name: replace(skin, vertices=skin.vertices - origins.get(name, 0)) for name, skin in skins.items()}


def origin_of(mesh: Mesh) -> np.ndarray:
    """A body's origin [3]: the middle of the base of its bounding box."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return np.array([*(low + high)[:2] / 2, low[2]])


def write_scene(
    mesh_folder: Path, scene_file: Path, *, drop: str = "box", materials: dict[str, Choice] | None = None,
    written: str | None = None, seed: int = 0,
) -> SceneReport:  # fmt: skip
    """Writes scene.yaml for the meshes of a mesh folder and the shapes next to it.

    A file that the user has changed (its hash differs from `written`, the hash of this function's last output) is kept
    as `scene.yaml.bak`. Raises SdfsimError if a material names an unknown body.
    """
    parts, placement = read_parts(mesh_folder), load_placement(mesh_folder)
    names = [entry["name"] for entry in parts["objects"]]
    solids = everything = {name: load_mesh(mesh_folder / "objects" / f"{name}.ply") for name in names}
    shown = None
    if parts["scenery"]:
        solid, shown = meshes_of(mesh_folder, SCENERY)
        everything = {SCENERY: solid} | solids
    notes: list[str] = []
    origins = {name: origin_of(mesh) for name, mesh in solids.items()}
    closed = {name: replace(mesh, vertices=mesh.vertices - origins.get(name, 0)) for name, mesh in everything.items()}
    materials = materials or {}
    floor = 0.0 if shown is None else floor_height(shown)
    held = load_held(mesh_folder / JOINT)
    holder = None
    if held is not None:
        if PART not in solids:
            message = "joint: the part that moves could not be cut off the rest as a body of its own"
            raise SdfsimError(f"{message}; {held.line()}", "photograph it from more sides", exit_code=EXIT_QUALITY)
        holder = holder_of(solids[PART], {name: mesh for name, mesh in everything.items() if name != PART})
    text_of = partial(scene_text, placement, origins, scenery=parts["scenery"],
                      around=parts["surroundings"], drop=drop, materials=materials,
                      seed=seed, floor=floor, held=held, holder=holder)  # fmt: skip
    slab = None
    scene = load_scene(scene_file, text=text_of(None), allow_outside=True)
    moved = cleared(scene, closed)
    if drop != "none":  # onto bodies where they start
        shifts = {name: one.shift for name, one in moved.items()}
        whole = joined([replace(m, vertices=m.vertices + shifts.get(name, 0)) for name, m in everything.items()])
        slab = choose_slab(whole if shown is None else shown, whole)
        if slab.slope > LEVEL:
            notes.append(f"no level place to drop a body onto: the flattest slopes by {slab.slope:.0f} degrees")
        scene = load_scene(scene_file, text=text_of(slab, moved=moved), allow_outside=True)
        moved |= {name: one for name, one in cleared(scene, closed).items() if name == drop}
    text = text_of(slab, moved=moved)
    notes += [moved_line(name, one, LAYER * parts["cell"]) for name, one in moved.items()]
    names = [body.name for body in scene.bodies]
    for name in materials:
        if name not in names:
            message = f"material or mass: no body is called {name!r}{nearest(name, names)}"
            raise SdfsimError(message, "the bodies are " + ", ".join(names))
    made = hashlib.sha256(text.encode()).hexdigest()
    if scene_file.exists() and hashlib.sha256(scene_file.read_bytes()).hexdigest() not in (written, made):
        endings = itertools.chain([""], itertools.count(2))
        kept = next(p for n in endings if not (p := scene_file.with_name(f"{scene_file.name}.bak{n}")).exists())
        scene_file.rename(kept)
        notes.append(f"{scene_file.name} had been changed by hand: kept as {kept.name}")
    write_text(scene_file, text)
    overlaps = {name: {"by": one.shift.tolist(), "out_of": one.into, "left": one.left} for name, one in moved.items()}
    return SceneReport(
        list(solids), bodies_of(scene, materials), placement.size_from, overlaps,
        {"shape": drop, **(asdict(slab) if slab else {})}, notes, made, None if held is None else held.line(),
    )  # fmt: skip


def moved_line(name: str, one: Cleared, unsure: float) -> str:
    """The report's line on a body that overlapped others; photos do not resolve overlaps below `unsure` m."""
    there = " and ".join(one.into)
    if one.left:
        if one.held:
            return f"{name}: is {one.left:.2g} m deep in {there}, where its joint holds it: these do not touch"
        why = "because there is no short way out: it will probably be thrown out"
        return f"{name}: starts {one.left:.2g} m deep in {there}, {why}"
    away = float(np.linalg.norm(one.shift))
    line = f"{name}: moved {'up ' if one.shift[2] > 0.99 * away else ''}by {away:.2g} m, out of {there}"
    if away > unsure:
        line += f": more than the {unsure:.2g} m that photos cannot resolve, so look at mesh/objects.png"
    return line


def holder_of(part: Mesh, others: dict[str, Mesh]) -> str | None:
    """Name of the body from which a moving part was cut off; None if there is no other body."""

    def beside(mesh: Mesh) -> float:
        away = np.linalg.norm(ClosestPoint(mesh)(part.vertices)[0] - part.vertices, axis=1)
        return float(np.quantile(away, TOUCHES))

    return min(others, key=lambda name: beside(others[name]), default=None)


def floor_height(shown: Mesh) -> float:
    """Height, m, of the floor that is added to a scenery: 0, or just below the scenery's own level surface there,
    because in the same plane it would cover that surface."""
    normals, areas = face_normals(shown)
    height = shown.vertices[shown.faces][:, :, 2].mean(1)
    width = float(np.ptp(shown.vertices, axis=0).max())
    own = (normals[:, 2] > LEVEL_NORMAL) & (np.abs(height) < OWN_FLOOR * width)
    if areas[own].sum() < MIN_FLOOR * areas.sum():
        return 0.0
    lowest = np.quantile(height[own], DENTS, weights=areas[own], method="inverted_cdf")
    return min(float(lowest), 0.0) - BELOW * width


def bodies_of(scene: Scene, materials: dict[str, Choice]) -> dict[str, BodyReport]:
    """The report of each body that can move or has a material."""
    found = {}
    for body in scene.bodies:
        choice = materials.get(body.name, Choice())
        entry = BodyReport(choice.name, body.friction, body.restitution, weighed=choice.mass is not None)
        if body.motion == "dynamic":
            volume = scene.shapes[body.shape].volume
            entry = replace(entry, density=body.mass / volume, wall=choice.wall, volume=volume, mass=body.mass)
        if body.motion == "dynamic" or body.name in materials:
            found[body.name] = entry
    return found


def scene_text(placement: Placement, origins: dict[str, np.ndarray], slab: "Slab | None", *, scenery: bool = True,
               around: bool = False, drop: str = "box", materials: dict[str, Choice] | None = None,
               seed: int = 0, floor: float = 0.0,
               held: HeldPart | None = None, holder: str | None = None,
               moved: dict[str, Cleared] | None = None) -> str:  # fmt: skip
    """The text of scene.yaml: a floor at a height, m, the scenery, the room around, the bodies at their origins [3]
    m, and a body dropped from above if there is a slab. A part `held` by a joint starts in its first state, and its
    `holder` is static. Overlapping bodies are `moved`; bodies that the part overlaps do not touch it."""
    moved = moved or {}
    assumed = " (give --size or --distance for true metres)" if placement.size_assumed else ""
    made = materials or {}
    shapes: list[str] = []
    bodies: list[str] = []

    def add(name: str, keys: str, shape: dict | None = None) -> None:
        choice = made.get(name, Choice())
        density = ""
        if shape and name not in (SCENERY, SURROUNDINGS):
            weight = f"density: {choice.material.density:g}" if choice.mass is None else f"mass: {choice.mass:g}"
            density = f"{weight}, "
        surface = f"friction: {choice.material.friction:g}, restitution: {choice.material.restitution:g}"
        if shape:
            wall = {} if choice.wall is None else {"wall": float(rounded(choice.wall))}
            shapes.append(f"  {name}: {_flow(shape | wall)}")
            keys = f"shape: {name}, {keys}"
        thick = f", a wall of {1000 * choice.wall:g} mm" if choice.wall else ""
        weighed = "" if choice.mass is None else "weighed; the rest is "
        known = f"{weighed}{choice.name}{thick}. From: {choice.material.source}"
        bodies.append(f"  # {known if name in made else 'assumed: photos do not show the material (give --material)'}")
        bodies.append(f"  - {{name: {name}, {keys}, {density}{surface}}}")

    plane = f"motion: static, plane: {{normal: [0, 0, 1], offset: {float(rounded(floor)):g}}}"
    if floor:
        bodies.append("  # just below the floor that the photos show")
    if "floor" in made:
        add("floor", plane)
    else:
        bodies.append(f"  - {{name: floor, {plane}}}")
    if scenery:
        add(SCENERY, "motion: static", {"asset": f"assets/{folder_of(SCENERY)}"})
    if around:
        add(SURROUNDINGS, "motion: static", {"asset": f"assets/{folder_of(SURROUNDINGS)}"})
    for name, origin in origins.items():
        keys = f"position: {_flow(rounded(origin).tolist())}"
        if held is not None and name == PART:
            turned = Rotation.from_matrix(held.turn).as_quat()
            keys = f"position: {_flow(rounded(held.turn @ origin + held.shift).tolist())}"
            keys += f", quat_xyzw: {_flow(turned.round(9).tolist())}"
            if name in moved:
                bodies.append(f"  # where it starts it is in {' and '.join(moved[name].into)}")
                keys += f", avoids: {_flow([*moved[name].into])}"
        elif name == holder:
            bodies.append("  # stands still: the photos show no motion of it")
            keys = f"motion: static, {keys}"
        elif name in moved:
            keys = f"position: {_flow(rounded(origin + moved[name].shift).tolist())}"
            bodies.append(f"  # {moved_line(name, moved[name], np.inf).removeprefix(f'{name}: ')}")
        add(name, keys, {"asset": f"assets/{folder_of(name)}"})
    if slab is not None:
        box = {"box": {"size": rounded((slab.side, slab.side, slab.thickness)).tolist()}}
        ball = {"sphere": {"radius": float(rounded(slab.thickness / 2))}}
        shift = moved[drop].shift if drop in moved else np.zeros(3)
        add(drop, f"position: {_flow(rounded(slab.position + shift).tolist())}", box if drop == "box" else ball)
    joint = []
    if held is not None:
        keys = {name: np.round(value, 6).tolist() for name, value in scene_keys(held).items()}
        entry = {"name": PART, "type": held.kind, "bodies": [PART, holder or "world"], **keys}
        joint = ["joints:", f"  # {held.line()}", f"  - {_flow(entry)}"]
    return "\n".join([
        f"# Reconstructed from photos. Up from the {placement.up_from}, within {placement.up_within:.1f} degrees "
        f"(confidence: {placement.up_confidence}).",
        f"# Size {placement.size_from}{assumed}. Lengths in m, density in kg/m^3.",
        "version: 1",
        "duration: 4.0                    # s",
        f"seed: {seed}",
        "gravity: [0, 0, -9.81]           # m/s^2",
        "shapes:",
        *shapes,
        "bodies:",
        *bodies,
        *joint,
        "",
    ])  # fmt: skip


def _flow(content: dict | list) -> str:
    """One line of YAML. YAML reads Python's 1e-05 as text, so numbers get a different form."""
    return yaml.safe_dump(content, default_flow_style=True, sort_keys=False, width=1000).strip()


@dataclass(frozen=True)
class Slab:
    """A level slab above a place where it can rest."""

    side: float  # m
    thickness: float  # m
    position: tuple[float, float, float]  # [3] m, its centre at the start
    slope: float  # of the surface below, degrees


def choose_slab(shown: Mesh, solid: Mesh) -> Slab:
    """Chooses a place for a slab from geometry alone: level, flat, seen in the photos, high and central. Both meshes
    are in metres, z up; `solid` is closed. Raises SdfsimError (exit code 3) if there is no place at all."""
    low, high = shown.vertices.min(0), shown.vertices.max(0)
    side = SIDE * float((high - low).max())
    axes = [np.arange(low[k], high[k] + side / 4, side / 2) for k in range(2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    # Wider than the slab: neighbours must not be in its way as it falls.
    line = np.linspace(-0.75, 0.75, 13) * side
    around = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    under = (np.abs(around) <= 0.5 * side + 1e-9).all(1)
    visible = heights(shown, places[:, None] + around[under])
    top = heights(solid, places[:, None] + around)
    top[:, under] = np.fmax(top[:, under], visible)
    whole = np.isfinite(top[:, under]).all(1)
    if not whole.any():
        raise SdfsimError("scene: no place to drop a body onto", "look at mesh/mesh.ply", exit_code=EXIT_QUALITY)
    places, visible, top = places[whole], visible[whole], top[whole]
    design = np.c_[around[under], np.ones(under.sum())]
    plane = top[:, under] @ np.linalg.pinv(design).T  # [P, 3]: slopes along x and y, height of the middle
    slope = np.degrees(np.arctan(np.hypot(plane[:, 0], plane[:, 1])))
    bump = np.abs(top[:, under] - plane @ design.T).max(1) / side
    unseen = 1 - (visible > top[:, under] - 0.2 * side).mean(1)
    obstacle = (np.nanmax(top, 1) - top[:, under].max(1)) / side
    central = np.linalg.norm((places - (low + high)[:2] / 2) / np.maximum(high - low, 1e-9)[:2], axis=1)
    good = (plane[:, 2] - low[2]) / max(high[2] - low[2], side) - 1.2 * central
    good = good - slope / LEVEL - bump / BUMP - obstacle
    # Places that are not level, not flat, or not in the photos are used only if there are no others.
    bad = np.maximum(slope / LEVEL - 1, 0) + 10 * np.maximum(bump - BUMP, 0) + 10 * np.maximum(unseen - UNSEEN, 0)
    best = int((good - 100 * bad).argmax())
    thickness = THICKNESS * side
    height = float(np.nanmax(top[best])) + 0.5 * thickness + GAP * side
    return Slab(side, thickness, (float(places[best, 0]), float(places[best, 1]), height), float(slope[best]))
