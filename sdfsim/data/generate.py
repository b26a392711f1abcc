"""Makes datasets with the teacher (PyBullet): first shapes, then trajectories on all cores."""

from functools import partial
from pathlib import Path

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import locked, write_json
from sdfsim.base.parallel import Progress, parallel, silent
from sdfsim.data.dataset import FLOOR, INFO, SPLITS, Trajectory, read_info
from sdfsim.data.public_shapes import public_folder
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, TEACHER_VERSION, Teacher, engine_settings, import_pybullet
from sdfsim.data.scenarios import RECIPES, Cast
from sdfsim.data.shape_assets import VHACD, Origin, fit_shapes, origins, prepare, split_of

GRAVITY = (0.0, 0.0, -10.0)  # m/s^2
STEPS = 100
REDRAWS = 1000  # redraws of a scene in which there was no room for a body


def make_dataset(
    recipe: str,
    out: Path,
    *,
    trajectories: int,
    shapes: Path | None = None,
    random_solids: int = 0,
    seed: int = 0,
    split: str = "train",
    on_progress: Progress = silent,
) -> dict:
    """Write `trajectories` files under `out/SPLIT/` and the Shape folders under `out/shapes/`; returns a report.

    Existing files are kept, so that an interrupted run continues. With the same shapes, trajectory k of a split depends
    only on (seed, split, k). Every recipe except movi-b draws the bodies of a split from that split's shapes (see
    `split_of`), so that shapes of validation and test are never trained on.

    `shapes` is a folder (see `origins`; movi-b takes NAME/ folders only) or the name of a public set; `random_solids`
    of PyBullet are added. Raises SdfsimError if the recipe does not take an option, if there
    are no usable shapes or they cannot be fetched, if PyBullet is not installed, or if `out` holds another dataset or
    another run is writing to it.
    """
    plan = RECIPES[recipe]
    engine = import_pybullet()
    given = _origins(recipe, shapes, random_solids, on_progress)
    info = {
        "recipe": recipe,
        "seed": seed,
        "teacher": TEACHER_VERSION,
        "engine": "pybullet",
        "engine_version": str(engine.getAPIVersion()),
        "engine_settings": engine_settings(DT, SUBSTEPS),
        "floor": {"friction": FLOOR[0], "restitution": FLOOR[1]},
        "made_from": {origin.name: {"pieces": origin.how, "sha256": origin.digest()} for origin in given},
    }
    with locked(out):
        # Before anything is written: engine files of another dataset's shapes must not change.
        _check_same(out, info)
        found, left_out = prepare(given, out / "shapes" / "engine", lambda f, m: on_progress(0.1 * f, m))
        info["shapes"] = [source.name for source in found]
        if not plan.kubasic:
            info |= {"left_out": left_out, "vhacd": VHACD}
        _check_same(out, info)
        scenery = {source.name: source for source in found if source.name in plan.scenery}
        drawn = [source for source in found if source.name not in scenery]
        mine = drawn if plan.kubasic else [source for source in drawn if split_of(source.name) == split]
        if not mine:
            raise SdfsimError(f"none of the {len(drawn)} shapes belongs to the {split} split", "give more shapes")
        fit_shapes([*mine, *scenery.values()], out / "shapes", lambda f, m: on_progress(0.1 + 0.4 * f, m))
        write_json(out / INFO, info)
        folder = out / split
        folder.mkdir(parents=True, exist_ok=True)
        files = [(k, folder / f"{k:05d}.npz") for k in range(trajectories)]
        todo = [job for job in files if not job[1].exists()]
        make_one = partial(_make_one, recipe, Cast(mine, scenery), [seed, SPLITS.index(split)])
        for done, _ in enumerate(parallel(make_one, todo), start=1):
            on_progress(0.5 + 0.5 * done / len(todo), f"trajectory {done} of {len(todo)}")
    return {
        "dataset": str(out),
        "split": split,
        "trajectories": trajectories,
        "made_now": len(todo),
        "shapes": len(mine),
        "left_out": left_out,
    }


def report_lines(report: dict) -> list[str]:
    return [
        f"{report['dataset']}: {report['trajectories']} {report['split']} trajectories, {report['made_now']} made now; "
        f"{report['shapes']} shapes to draw from",
        *(f"left out: {name}: {why}" for name, why in report["left_out"].items()),
    ]


def make_trajectory(recipe: str, rng: np.random.Generator, cast: Cast) -> Trajectory:
    """One trajectory of `STEPS` steps, with the velocities of the engine. Raises SdfsimError if
    none of `REDRAWS` scenes had room for its bodies."""
    for _ in range(REDRAWS):
        with Teacher(np.array(GRAVITY), FLOOR) as teacher:
            placed = RECIPES[recipe].spawn(teacher, rng, cast)
            if placed is None:
                continue
            motion = teacher.run(STEPS)
            inertia = np.array([teacher.inertia(i) for i in range(len(placed))])
        specs = [body for _, body in placed]
        mass = np.array([b.mass for b in specs])
        return Trajectory(
            **motion,
            shape=np.array([source.name for source, _ in placed]),
            scale=np.array([b.scale for b in specs]),
            mass=mass,
            inertia=inertia,
            friction=np.array([b.friction for b in specs]),
            restitution=np.array([b.restitution for b in specs]),
            static=mass == 0,
            dt=DT,
            gravity=np.array(GRAVITY),
        )
    raise SdfsimError(f"{recipe}: no room for the bodies in any of {REDRAWS:,} scenes", "are the meshes in metres?")


def _make_one(recipe: str, cast: Cast, seed: list[int], index: int, path: Path) -> None:
    make_trajectory(recipe, np.random.default_rng([*seed, index]), cast).save(path)


def _origins(recipe: str, shapes: Path | None, random_solids: int, on_progress: Progress) -> list[Origin]:
    """The origins of a recipe's shapes, its own scenery last. Raises SdfsimError for options that the recipe does not
    take."""
    plan = RECIPES[recipe]
    if random_solids and plan.kubasic:
        raise SdfsimError(f"{recipe} does not take --random-solids")
    if shapes is None and not random_solids:
        raise SdfsimError(f"{recipe} needs shapes", "give --shapes a folder, or kubasic or ycb")
    folder = shapes and public_folder(shapes, on_progress)
    found = origins(folder, random_solids, as_is=plan.kubasic)
    if taken := {o.name for o in found} & set(plan.scenery):
        raise SdfsimError(f"{shapes}: the recipe has a shape {min(taken)!r} of its own", "rename yours")
    return found + [Origin(name, primitive=kind) for name, kind in plan.scenery.items()]


def _check_same(out: Path, info: dict) -> None:
    """Raises SdfsimError if the folder holds a dataset that differs from `info`."""
    there = read_info(out) if (out / INFO).exists() else info
    if other := [key for key, value in info.items() if there.get(key) != value]:
        raise SdfsimError(f"{out} holds a dataset with another {other[0]}", "choose another -o")
