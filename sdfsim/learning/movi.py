"""Dataset recipes: MOVi-B as Kubric makes it (Greff et al., 2022), on any folder of shapes with convex pieces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.errors import SdfsimError
from sdfsim.learning.dataset import FLOOR, SPLITS, Trajectory, read_info, write_info
from sdfsim.learning.teacher import DT, ENGINE_SETTINGS, SUBSTEP, Teacher, TeacherBody, import_pybullet, write_urdf
from sdfsim.parallel import parallel
from sdfsim.shape.fit import fit_pieces
from sdfsim.shape.mesh import load_mesh, load_pieces, mass_properties

GRAVITY = (0.0, 0.0, -10.0)  # m/s^2
REGION = ((-5.0, -5.0, 1.0), (5.0, 5.0, 5.0))  # m, holds every body's bounds at the start
SIZES = (0.7, 1.4)
MATERIALS = {"metal": (2.7, 0.4, 0.3), "rubber": (1.1, 0.8, 0.7)}  # density, friction, restitution
STEPS = 100
NODES = 512  # surface nodes a shape: the vertices and edges of the pieces first, since those are what really touches
TRIES = 100  # spawns of one body before the scene is drawn again
RECIPES = ("movi-b",)

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class ShapeSource:
    """One shape as the recipe needs it: engine file, volume m^3 and vertices [V, 3] m about the centre of mass."""

    name: str
    urdf: Path
    volume: float
    vertices: np.ndarray


def make_dataset(
    recipe: str,
    out: Path,
    *,
    shapes: Path,
    trajectories: int,
    seed: int = 0,
    split: str = "train",
    on_progress: Progress | None = None,
) -> dict:
    """Write `trajectories` files under `out/SPLIT/` and the Shape folders under `out/shapes/`.

    Files that exist are kept, so that an interrupted run goes on where it was. Trajectory k of a split
    depends on (seed, split, k) alone.

    Args:
        recipe: "movi-b".
        out: dataset folder.
        shapes: folder of NAME/ folders, each with `visual_geometry.obj` and `collision_geometry.obj`
            (one convex piece a group).
        trajectories: how many.
        seed: of the dataset.
        split: "train", "validation" or "test".
        on_progress: called with the fraction done and a message.

    Returns:
        A report: paths, counts.

    Raises:
        SdfsimError: unknown recipe or split, no usable shapes, PyBullet absent, another dataset in `out`.
    """
    if recipe not in RECIPES:
        raise SdfsimError(f"unknown recipe {recipe!r}", f"known: {', '.join(RECIPES)}")
    if split not in SPLITS:
        raise SdfsimError(f"unknown split {split!r}", f"known: {', '.join(SPLITS)}")
    if trajectories < 1:
        raise SdfsimError("--trajectories must be at least 1")
    tell = on_progress or (lambda fraction, message: None)
    engine = import_pybullet()
    folder = out / split
    folder.mkdir(parents=True, exist_ok=True)
    sources = find_shapes(shapes, out / "shapes" / "engine")
    info = {
        "recipe": recipe,
        "seed": seed,
        "engine": "pybullet",
        "engine_version": str(engine.getAPIVersion()),
        "engine_settings": ENGINE_SETTINGS | {"timeStep": SUBSTEP},
        "floor": {"friction": FLOOR[0], "restitution": FLOOR[1]},
        "shapes": [s.name for s in sources],
    }
    if (out / "dataset.json").exists() and read_info(out) != info:
        raise SdfsimError(f"{out} holds a dataset of another seed, engine or set of shapes", "choose another -o")
    fit_dataset_shapes(shapes, out / "shapes", [s.name for s in sources], lambda f, m: tell(0.5 * f, m))
    write_info(out, info)
    todo = [k for k in range(trajectories) if not (folder / f"{k:05d}.npz").exists()]
    jobs = [(k, seed, split, sources, folder / f"{k:05d}.npz") for k in todo]
    for done, _ in enumerate(parallel(_make_one, jobs), start=1):
        tell(0.5 + 0.5 * done / len(todo), f"trajectory {done} of {len(todo)}")
    return {"dataset": str(out), "split": split, "trajectories": trajectories, "made_now": len(todo)}


def find_shapes(shapes: Path, engine: Path) -> list[ShapeSource]:
    """Shapes in name order, their engine files written under `engine`.

    Raises:
        SdfsimError: when the folder holds none.
    """
    engine.mkdir(parents=True, exist_ok=True)
    found = []
    # `dome` is Kubric's scenery, not one of its eleven bodies: it has no visual geometry here.
    for folder in sorted(p.parent for p in shapes.glob("*/collision_geometry.obj") if _visual(p.parent).exists()):
        mesh = load_mesh(_visual(folder))
        volume = mass_properties(mesh)[0]
        # Kubric's assets have their centre of mass at the origin; their URDF says so and the engine takes it.
        urdf = write_urdf((folder / "collision_geometry.obj").resolve(), np.zeros(3), engine / f"{folder.name}.urdf")
        found.append(ShapeSource(folder.name, urdf, volume, mesh.vertices))
    if not found:
        raise SdfsimError(
            f"{shapes}: no shapes found", "expected NAME/visual_geometry.obj and NAME/collision_geometry.obj"
        )
    return found


def fit_dataset_shapes(shapes: Path, out: Path, names: list[str], on_progress: Progress) -> None:
    """Fit a Shape folder for every name that has none yet.

    The surface is that of the convex pieces, since that is what the teacher collides.
    """
    todo = [name for name in names if not (out / name / "shape.json").exists()]
    for done, (index, _) in enumerate(parallel(_fit_one, [(shapes / n, out / n) for n in todo]), start=1):
        on_progress(done / len(todo), f"shape {todo[index]} fitted, {done} of {len(todo)}")


def _fit_one(source: Path, out: Path) -> None:
    pieces = load_pieces(source / "collision_geometry.obj")
    fit_pieces(pieces, name=source.name, display=load_mesh(_visual(source)), nodes=NODES).save(out)


def _visual(folder: Path) -> Path:
    return folder / "visual_geometry.obj"


def _make_one(index: int, seed: int, split: str, sources: list[ShapeSource], path: Path) -> None:
    movi_b_trajectory(np.random.default_rng([seed, SPLITS.index(split), index]), sources).save(path)


def movi_b_trajectory(rng: np.random.Generator, sources: list[ShapeSource]) -> Trajectory:
    """One MOVi-B trajectory of `STEPS` steps (Kubric's `movi_ab_worker`, restated)."""
    while True:
        with Teacher(np.array(GRAVITY), FLOOR) as teacher:
            bodies = _spawn(teacher, rng, sources)
            if bodies is None:
                continue
            motion = teacher.run(STEPS)
            inertia = np.array([teacher.inertia(i) for i in range(len(bodies))])
        specs = [b for _, b in bodies]
        return Trajectory(
            **motion,
            shape=np.array([s.name for s, _ in bodies]),
            scale=np.array([b.scale for b in specs]),
            mass=np.array([b.mass for b in specs]),
            inertia=inertia,
            friction=np.array([b.friction for b in specs]),
            restitution=np.array([b.restitution for b in specs]),
            static=np.zeros(len(bodies), dtype=bool),
            dt=DT,
            gravity=np.array(GRAVITY),
        )


def _spawn(teacher: Teacher, rng: np.random.Generator, sources: list[ShapeSource]):
    """Place 3 to 10 random bodies without overlaps; None when one finds no room in `TRIES` tries."""
    bodies = []
    for _ in range(rng.integers(3, 11)):
        source = sources[rng.integers(len(sources))]
        scale = rng.uniform(*SIZES)
        density, friction, restitution = MATERIALS[str(rng.choice(list(MATERIALS)))]
        body = TeacherBody(source.urdf, scale, source.volume * density * scale**3, friction, restitution)
        position = _place(teacher, rng, source, body)
        if position is None:
            return None
        aim = rng.uniform((-4.0, -4.0, 0.0), (4.0, 4.0, 0.0))
        teacher.push(len(bodies), aim - position * (1.0, 1.0, 0.0), np.zeros(3))
        bodies.append((source, body))
    return bodies


def _place(teacher: Teacher, rng: np.random.Generator, source: ShapeSource, body: TeacherBody) -> np.ndarray | None:
    index = teacher.add(body, np.array([0.0, 0.0, -100.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    for _ in range(TRIES):
        rotation = Rotation.random(rng=rng)
        vertices = body.scale * rotation.apply(source.vertices)
        position = rng.uniform(REGION[0] - vertices.min(0), REGION[1] - vertices.max(0))
        teacher.place(index, position, rotation.as_quat())
        if not teacher.overlaps(index):
            return position
    return None
