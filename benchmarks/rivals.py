"""Our solver and other engines on shapes that are hard for other engines: RESULTS.md.

    python -m benchmarks rivals shapes DATA -o DIR
    python -m benchmarks rivals turns DATA -o DIR
        ours and the engines on convex pieces in turn, each with the longest inner step at which `shapes` found bodies
        at most 1 % deep in each other: medians and ranges of 7 rounds

DATA is a MOVi-B dataset. Every engine simulates every case with inner steps of 10, 4, 2 and 1 ms (for bodies of a
metre; for smaller ones in proportion to the square root of their size), in processor time of one thread. No engine is
the reference for another: an error is the distance from the same engine's motion at 1 ms. Depth is measured on the
exact surfaces. Shapes without convex pieces get pieces by CoACD, with one setting for all. The making of pieces,
tetrahedra and kernels is not timed. Restitution is 0, friction the same for all. DIR keeps results.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.engines import bullet, drake, mujoco, mujoco_sdf, newton
from benchmarks.records import Cell, Out, in_turn, progress, spread, write_record
from samples.large import sample_shape, write_scene
from sdfsim.apps.export import convex_pieces
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.data.batching import scene_of
from sdfsim.data.dataset import conditions_of
from sdfsim.evaluation.engines import Engine, Ran, scene_rollout, start_of_scene, timed_rollout
from sdfsim.evaluation.evaluate import load_recorded
from sdfsim.evaluation.harness import Job, Results, measure, one_thread, peak_memory
from sdfsim.evaluation.instruments import depths
from sdfsim.evaluation.laws.hard_cases import ball, body, box, on_floor
from sdfsim.geometry.mesh import Mesh, clean
from sdfsim.geometry.mesh_io import load_pieces, wavefront
from sdfsim.physics.bodies import largest_extent
from sdfsim.physics.units import scene_units
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Effects, Scene
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.convex_pieces import convex_vertices
from sdfsim.shape.make import analytic_shape, mesh_shape, shape_from_mesh
from sdfsim.shape.shape import Shape, own_pieces
from sdfsim.simulate.simulator import Simulator

ENGINES: dict[str, Engine | None] = {
    "sdfsim": None,
    "PyBullet, pieces": bullet,
    "MuJoCo, pieces": mujoco,
    "MuJoCo, SDF": mujoco_sdf,
    "Drake, hydroelastic": drake,
    "Newton, XPBD": newton,
}
FAST = list(ENGINES)[:3]
INNER = (2, 5, 10, 20)  # inner steps in a step of 20 ms; the last is an engine's own reference
USUAL = 5
STEPS = 100
COMPARED = 25  # steps over which an engine is compared with itself: later, chaos dominates
MOVI_B = 5  # trajectories
DEEP = 0.01  # of the smallest body's size: "equal penetration"
FRICTION = 0.7  # of all bodies: 0.49 for a contact


# --- the cases ---


def implicit(
    name: str, field: Callable[[np.ndarray], np.ndarray], half: tuple[float, float, float], cell: float
) -> Mesh:
    """The surface where a field [P, 3] m -> [P] is 0, within a box of half-sizes m about the origin."""
    from skimage.measure import marching_cubes

    axes = [np.arange(-h - 2 * cell, h + 2.5 * cell, cell) for h in half]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = field(points.reshape(-1, 3)).reshape(points.shape[:3])
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(cell,) * 3)
    mesh = Mesh(vertices.astype(np.float64) + [axis[0] for axis in axes], faces.astype(np.int64))
    return clean(mesh, name=name)


def mug() -> Mesh:
    """A mug of 1 m without a base: open at the top, with a ring at +x as its handle."""

    def field(p: np.ndarray) -> np.ndarray:
        radius = np.hypot(p[:, 0], p[:, 1])
        outside = np.maximum(radius - 0.35, np.abs(p[:, 2]) - 0.5)
        inside = np.maximum(radius - 0.29, -0.44 - p[:, 2])
        ring = np.hypot(np.hypot(p[:, 0] - 0.36, p[:, 2]) - 0.24, p[:, 1]) - 0.05
        return np.minimum(np.maximum(outside, -inside), np.maximum(ring, 0.32 - radius))

    return implicit("mug", field, (0.66, 0.36, 0.51), 0.02)


def rugged() -> Mesh:
    """Ground 6 m wide of 200,000 triangles, instead of a scan: hills, an arch to fall through and noise of 2 mm."""
    rng = np.random.default_rng(0)
    waves = [(rng.uniform(1, 5, 2), rng.uniform(0, 6.3), rng.uniform(0.03, 0.12)) for _ in range(12)]

    def field(p: np.ndarray) -> np.ndarray:
        hills = sum(a * np.sin(p[:, 0] * k[0] + p[:, 1] * k[1] + phase) for k, phase, a in waves)
        ground = np.maximum(np.abs(p[:, :2]).max(1) - 3.0, np.maximum(p[:, 2] - 0.3 * hills, -0.9 - p[:, 2]))
        arch = np.hypot(np.hypot(p[:, 0], p[:, 2]) - 0.55, p[:, 1]) - 0.12
        return np.minimum(ground, arch) + rng.normal(0.0, 0.002, len(p))

    return implicit("ground", field, (3.0, 3.0, 1.0), 0.028)


def bowls(folder: Path) -> Scene:
    """Six bowls fall into each other."""
    rng = np.random.default_rng(1)
    places = [(*rng.uniform(-0.05, 0.05, 2), 0.5 + 0.6 * k) for k in range(6)]
    return on_floor([sample_shape("bowl")], [body(f"bowl{k}", 0, place) for k, place in enumerate(places)])


def mugs(folder: Path) -> Scene:
    """Four mugs hang by their handles on pegs that slope a little; each falls 4 cm and swings."""
    turned = Rotation.from_euler("x", 75, degrees=True).as_quat()  # a peg along z, tipped towards -y
    bodies = []
    for k in range(4):
        bodies.append(body(f"peg{k}", 1, (1.5 * k, 0.0, 2.0), motion="static", mass=0.0, quat_xyzw=turned))
        bodies.append(body(f"mug{k}", 0, (1.5 * k - 0.36, 0.0, 1.9), velocity=np.array([0.3 * k, 0.0, 0.0])))
    file = folder / "mug.obj"
    write_text(file, wavefront([mug()]))
    return on_floor([shape_from_mesh(file), analytic_shape("capsule", radius=0.05, height=0.9)], bodies)


def scan(folder: Path) -> Scene:
    """Ten bodies fall onto `rugged` ground, some onto its arch."""
    shapes = [sample_shape(name) for name in ("bowl", "cone", "ring")]
    shapes += [box(0.5), ball(0.5), mesh_shape(rugged(), name="ground", kind="mesh")]
    rng = np.random.default_rng(2)
    bodies = [
        body(
            f"b{k}", k % 5, (0.9 * (k % 4) - 1.35, 0.9 * (k // 4) - 0.9, 2.2), scale=0.6 if k % 5 < 3 else 1.0,
            quat_xyzw=Rotation.random(rng=rng).as_quat(),
        )
        for k in range(10)
    ]  # fmt: skip
    return on_floor(shapes, [*bodies, body("ground", 5, (0.0, 0.0, 1.0), motion="static", mass=0.0)])


def written(folder: Path, name: str, count: int) -> Scene:
    return load_scene(write_scene(name, folder / f"{name}{count}", count))


CASES: dict[str, Callable[[Path], Scene]] = {
    "bowls in bowls": bowls,
    "torus knots": partial(written, name="knots", count=12),
    "mugs on pegs": mugs,
    "scan of 200,000 triangles": scan,
    "16 spheres in a bowl": partial(written, name="bowl", count=16),
}
SHAPES = ["MOVi-B", *CASES]


def in_pieces(scene: Scene, folder: Path) -> Scene:
    """The scene with convex pieces for every shape except closed forms, kept in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = [isinstance(shape.sdf, ClosedForm) or bool(own_pieces(shape)) for shape in scene.shapes]
    shapes = [s if one else replace(s, pieces=cut(s, folder)) for s, one in zip(scene.shapes, whole, strict=True)]
    return replace(scene, shapes=tuple(shapes))


def cut(shape: Shape, folder: Path) -> tuple[np.ndarray, ...]:
    """The vertices of a shape if it is convex, else those of its pieces by CoACD."""
    if len(vertices := convex_vertices(shape.mesh)):
        return (vertices,)
    file = folder / f"{shape.mesh.digest()[:16]}.obj"
    if not file.exists():
        write_text(file, wavefront(convex_pieces(shape)))
    return tuple(piece.vertices for piece in load_pieces(file))


# --- measuring ---


def moved(name: str, scene: Scene, steps: int, inner: int, folder: Path) -> tuple[Ran, float, float]:
    """An engine's motion of a scene, its ms per simulated second, and the seconds that preparing took."""
    units = scene_units(scene)
    began = time.perf_counter()
    if run := ENGINES[name]:
        start = start_of_scene(in_pieces(scene, folder / "pieces"), folder / "engine", units)
        prepared = time.perf_counter() - began
        motion, timing = run(start, steps, inner)
        return Ran(scene, scene_rollout(scene, motion, units)), timing.cpu_ms / (0.02 * units.time), prepared
    simulator = Simulator(scene, "solver")
    simulator.options = simulator.options._replace(substeps=inner)
    next(simulator.frames(1))
    prepared = time.perf_counter() - began
    simulator.reset()
    rollout, timing = timed_rollout(simulator, steps)
    return Ran(scene, rollout), timing.cpu_ms / (0.02 * units.time), prepared


def scenes_of(case: str, data: Path, folder: Path) -> list[Scene]:
    """The scenes of a case, of equal friction and without restitution and sleep."""
    folder.mkdir(parents=True, exist_ok=True)
    if case == "MOVi-B":
        recorded, shapes = load_recorded(data, "test", most=MOVI_B)
        scenes = [scene_of([t], [0], shapes, conditions_of(data).floor)[0] for t in recorded]
    else:
        scenes = [CASES[case](folder)]
    for k, scene in enumerate(scenes):
        bodies = tuple(replace(b, friction=FRICTION, restitution=0.0) for b in scene.bodies)
        scenes[k] = replace(scene, bodies=bodies, effects=Effects(sleep="off"))
    return scenes


@one_thread()
def measured(name: str, case: str, data: Path, folder: Path) -> dict[str, Any]:
    """The cost of every inner step for an engine in a case.

    Returns:
        by inner steps: ms per simulated second; deep, the 95th percentile of the depth, and away, the distance from
        the engine's own finest motion, both over the smallest body's size; lost, bodies that are where they cannot be.
        prepare_s and mib once.
    """
    scenes = scenes_of(case, data, folder)
    size = [min(largest_extent(s.shapes[b.shape]) * b.scale for b in s.bodies if b.motion == "dynamic") for s in scenes]
    found: dict[int, dict[str, float]] = {}
    motions: dict[int, list[Ran]] = {}
    prepare, broken = 0.0, {}
    with peak_memory() as memory:
        for inner in INNER:
            try:
                runs = [moved(name, scene, STEPS, inner, folder) for scene in scenes]
            except SdfsimError as error:
                broken[inner] = error.message
                break  # finer steps take longer still
            motions[inner] = [motion for motion, _, _ in runs]
            prepare = max(prepare, *(one for _, _, one in runs))
            parts = zip(motions[inner], size, strict=True)
            deep = np.concatenate([depths(one.scene, one.rollout) / w for one, w in parts])
            found[inner] = {
                "ms": float(np.mean([ms for _, ms, _ in runs])),
                "deep": float(np.percentile(deep, 95)) if len(deep) else 0.0,
                "lost": sum(lost(case, motion, w) for motion, w in zip(motions[inner], size, strict=True)),
            }
    for inner, mine in motions.items():
        if INNER[-1] in motions and inner != INNER[-1]:
            gaps = [
                np.linalg.norm((one.path - best.path)[: COMPARED + 1], axis=-1).ravel() / w
                for one, best, w in zip(mine, motions[INNER[-1]], size, strict=True)
            ]
            found[inner]["away"] = float(np.sqrt(np.mean(np.concatenate(gaps) ** 2)))
    return {"inner": found, "broken": broken, "prepare_s": prepare, "mib": memory["mib"]}


def lost(case: str, run: Ran, size: float) -> int:
    """Bodies that fell off their pegs, through the floor, or flew off."""
    height, start = run.path[-1, :, 2], run.path[0, :, 2]
    gone = (height < -0.1 * size) | (height > start + 2.0 * size)
    return int((gone | (height < 1.2)).sum() if case == "mugs on pegs" else gone.sum())


def compared(data: Path, out: Out) -> Results:
    content = [INNER, STEPS, COMPARED, MOVI_B, FRICTION]
    jobs = [
        Job(case, name, content, measured, (name, case, data.resolve(), out / "scenes"))
        for case in SHAPES
        for name in ENGINES
    ]
    return measure(jobs, out / "results", where="fresh", on_progress=progress)


def shapes(data: Path, *, out: Out) -> None:
    """Hard shapes: a row for each case and engine at the usual inner step, with the time for equal depth."""
    columns = (
        "case", "engine", "ms per s at 4 ms", "depth, %", "away from itself at 1 ms, %", "lost",
        f"ms per s where depth is at most {100 * DEEP:g} %", "prepared in, s", "MiB",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for (case, name), result in compared(data, out).items():
        usual = result.get("inner", {}).get(str(USUAL))
        if usual is None:
            rows.append((case, name, result.get("failed") or "; ".join(result["broken"].values()), *[""] * 6))
            continue
        equal = [one["ms"] for one in result["inner"].values() if one["deep"] <= DEEP and not one["lost"]]
        rows.append((
            case, name, usual["ms"], 100 * usual["deep"], 100 * usual.get("away", np.nan), usual["lost"],
            min(equal, default="none"), result["prepare_s"], result["mib"],
        ))  # fmt: skip
    measured = f"{STEPS} steps of every engine with inner steps of 10, 4, 2 and 1 ms, in processor time of one thread."
    write_record("rivals", "python -m benchmarks rivals shapes DATA -o DIR", measured, columns, rows)


def enough(result: dict[str, Any]) -> int:
    """Inner steps per step: the fewest with which bodies are at most `DEEP` in each other and none is lost; the most
    that were tried if there is no such number."""
    tried = result["inner"]
    return next((n for n in INNER if tried[str(n)]["deep"] <= DEEP and not tried[str(n)]["lost"]), INNER[-1])


@one_thread()
def turns(data: Path, *, out: Out, rounds: int = 7) -> None:
    """The fast engines at equal depth in alternating runs, so that other work on the machine slows all of them
    alike."""
    rows: list[tuple[Cell, ...]] = []
    found = compared(data, out)
    for k, case in enumerate(SHAPES):
        scenes, inner = scenes_of(case, data, out / "scenes"), {name: enough(found[case, name]) for name in FAST}

        def mean(name: str, scenes: list[Scene] = scenes, inner: dict[str, int] = inner) -> float:
            return float(np.mean([moved(name, scene, STEPS, inner[name], out / "scenes")[1] for scene in scenes]))

        taken = in_turn([partial(mean, name) for name in FAST], rounds)
        progress((k + 1) / len(SHAPES), case)
        took = [cell for name, times in zip(FAST, taken.T, strict=True) for cell in (20 // inner[name], spread(times))]
        rows.append((case, *took, *map(spread, (taken[:, :1] / taken[:, 1:]).T)))
    columns = [f"{name}: {what}" for name in FAST for what in ("inner step, ms", "ms per s")]
    columns += [f"sdfsim / {name}" for name in FAST[1:]]
    measured = (
        f"ms per simulated second at equal depth: medians and ranges over {rounds} alternating rounds, and of the "
        "ratio in each round."
    )
    write_record("rivals_in_turn", "python -m benchmarks rivals turns DATA -o DIR", measured, ("case", *columns), rows)


COMMANDS = (shapes, turns)
