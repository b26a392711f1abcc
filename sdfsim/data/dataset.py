"""The dataset format: one `.npz` per trajectory, `shapes/` with one Shape folder per name, and `dataset.json`.

A file holds the velocities of the engine that recorded it. A loaded trajectory has velocities at the instants of its
positions, from which simulations start: see `at_instants`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, read_json, write_arrays
from sdfsim.data.pybullet_sim import TEACHER_VERSION
from sdfsim.physics.motion import Motion

if TYPE_CHECKING:
    from sdfsim.shape.shape import Shape

SPLITS = ("train", "validation", "test")
INFO = "dataset.json"
SOLID = "solid_"  # how the names of PyBullet's random solids begin
FLOOR = (0.3, 0.5)  # friction and restitution of the recipes' floor, the plane z = 0
LONGEST_STEP = 10.0  # s, between recorded frames
LONGEST_SUBSTEP = 1.0  # s, an engine's inner step
EXACTLY = 1e-3  # relative to the change of velocity by gravity in a step: largest deviation in free flight
_NAME = re.compile(r"(?!\.)[\w. -]+")  # name of a folder, never a path
IN_FILE = {"orientation": "quat_xyzw"}  # names of arrays that differ in files
_AXES = {  # T frames, N bodies
    "position": ("T", "N", 3), "quat_xyzw": ("T", "N", 4), "velocity": ("T", "N", 3), "angular_velocity": ("T", "N", 3),
    "shape": ("N",), "scale": ("N",), "mass": ("N",), "inertia": ("N", 3), "friction": ("N",), "restitution": ("N",),
    "static": ("N",), "dt": (), "gravity": (3,),
}  # fmt: skip


@dataclass(frozen=True)
class Trajectory(Motion):
    """T recorded frames of N bodies above the static floor z = 0 (which is not among the N), SI units; the origin of a
    body is its centre of mass."""

    shape: np.ndarray  # [N] names of the Shape folders
    scale: np.ndarray  # [N] uniform size factors
    mass: np.ndarray  # [N] kg
    inertia: np.ndarray  # [N, 3] kg m^2, principal, body axes
    friction: np.ndarray  # [N]
    restitution: np.ndarray  # [N]
    static: np.ndarray  # [N] bool
    dt: float  # s
    gravity: np.ndarray  # [3] m/s^2

    def save(self, path: Path) -> None:
        """Write the file. The velocities must be those that the engine recorded."""
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        write_arrays(path, {IN_FILE.get(name, name): array for name, array in arrays.items()})

    @classmethod
    def load(cls, path: Path, *, as_recorded: bool = False) -> Trajectory:
        """Read and check one file. The `dataset.json` beside it, or in the folder above, gives the engine's inner step.
        `as_recorded` keeps the velocities of the engine, from which the same engine continues. Raises SdfsimError with
        the file and the field that is wrong."""
        found = _checked(path, read_arrays(path, "a trajectory"))
        recorded = cls(**{name: found.pop(IN_FILE[name]) for name in IN_FILE}, **found)
        return recorded if as_recorded else at_instants(recorded, engine_substep(path.parent))


def at_instants(recorded: Trajectory, substep: float) -> Trajectory:
    """The trajectory with velocities at the instants of its positions.

    The recording engine's position step already uses the new velocity (symplectic Euler). Its flights are exact
    parabolas, but those of velocities that are ahead of the recorded ones by half an inner step (`substep` s) of
    gravity. Bodies that fly before or after an instant get the velocity of their parabola; bodies that lie or slide
    keep the recorded one.
    """
    added = np.diff(recorded.velocity, axis=0) - recorded.gravity * recorded.dt
    flies = np.linalg.norm(added, axis=-1) < EXACTLY * np.linalg.norm(recorded.gravity) * recorded.dt
    airborne = np.zeros(recorded.velocity.shape[:2], dtype=bool)
    airborne[:-1] |= flies
    airborne[1:] |= flies
    airborne &= ~recorded.static
    return replace(recorded, velocity=recorded.velocity + 0.5 * substep * recorded.gravity * airborne[..., None])


def engine_substep(data: Path) -> float:
    """The recording engine's inner step in s, from the `dataset.json` of a dataset folder or one of its splits; 0 if it
    is not given. Raises SdfsimError if it is invalid."""
    home = home_of(data)
    settings = (read_info(home).get("engine_settings") or {}) if home else {}
    found = settings.get("timeStep", 0.0) if isinstance(settings, dict) else settings
    if type(found) not in (int, float) or not 0.0 <= found <= LONGEST_SUBSTEP:
        where = f"{home}/{INFO}: engine_settings.timeStep"
        raise SdfsimError(f"{where}: must be 0 (unknown) to {LONGEST_SUBSTEP:g} s (got {found!r})")
    return float(found)


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The fields of a trajectory, checked, in the types that the rest of the code expects."""
    if missing := [name for name in _AXES if name not in arrays]:
        raise SdfsimError(f"{path}: missing field(s) {', '.join(missing)}")
    found: dict[str, Any] = {}
    sizes = dict(zip("TN", arrays["position"].shape, strict=False))
    for name, axes in _AXES.items():
        if arrays[name].shape != (wanted := tuple(sizes.get(str(axis), axis) for axis in axes)):
            raise SdfsimError(f"{path}: {name}: must be {list(wanted)} (got {list(arrays[name].shape)})")
        try:
            names = name == "shape"
            found[name] = arrays[name].astype(str) if names else arrays[name].astype(float, casting="same_kind")
        except (TypeError, ValueError) as error:
            raise SdfsimError(f"{path}: {name}: must be {'names' if names else 'real numbers'}: {error}") from error
        if not names and not np.isfinite(found[name]).all():
            raise SdfsimError(f"{path}: {name}: has values that are not finite")
    check_names(f"{path}: shape", found["shape"].tolist())
    moving = found["static"] == 0
    rules = {
        "position: must have at least two frames": np.array(len(found["position"]) >= 2),
        "static: must be true or false (or 1 or 0)": np.isin(found["static"], (0.0, 1.0)),
        "mass: must be > 0 for bodies that move": found["mass"][moving] > 0,
        "inertia: must be > 0 for bodies that move": found["inertia"][moving] > 0,
        "quat_xyzw: must be unit quaternions": np.abs(np.linalg.norm(found["quat_xyzw"], axis=-1) - 1.0) <= 1e-3,
        "scale: must be > 0": found["scale"] > 0,
        f"dt: must be > 0 and at most {LONGEST_STEP:g} s": (found["dt"] > 0) & (found["dt"] <= LONGEST_STEP),
        "friction: must be >= 0": found["friction"] >= 0,
        "restitution: must be 0 to 1": (found["restitution"] >= 0) & (found["restitution"] <= 1),
    }
    for rule, kept in rules.items():
        if not kept.all():
            raise SdfsimError(f"{path}: {rule}")
    return found | {"static": ~moving, "dt": float(found["dt"])}


def check_names(where: str, names: Iterable[str]) -> None:
    """Raises SdfsimError if one of the names is not valid for a Shape folder of a dataset."""
    for name in names:
        if not _NAME.fullmatch(name):
            raise SdfsimError(f"{where}: {name!r} cannot name a Shape folder", "use letters, digits, spaces, . _ -")


def check_alike(where: str, trajectories: Iterable[Trajectory]) -> None:
    """Raises SdfsimError if trajectories that are used together differ in step or gravity."""
    if len({(t.dt, *t.gravity.tolist()) for t in trajectories}) > 1:
        raise SdfsimError(f"{where}: its trajectories differ in step or gravity", "give a dataset of one recipe")


def read_info(folder: Path) -> dict:
    """`dataset.json` of a dataset folder. Raises SdfsimError if it is missing, not a JSON object, or if another version
    of `sdfsim dataset`'s teacher made it."""
    info = read_json(folder / INFO, "a dataset folder is what `sdfsim dataset` writes")
    if not isinstance(info, dict):
        raise SdfsimError(f"{folder / INFO}: must be a JSON object")
    ours = info.get("engine") == "pybullet" and {"recipe", "engine_settings"} <= set(info)
    if ours and (version := info.get("teacher", 1)) != TEACHER_VERSION:
        fault = f"{folder}: made by version {version!r} of the teacher, not by {TEACHER_VERSION}"
        raise SdfsimError(fault, "make it again with `sdfsim dataset`")
    return info


def home_of(data: Path) -> Path | None:
    """The folder with the `dataset.json` of a dataset or of one of its splits; None without any."""
    return next((folder for folder in (data, data.parent) if (folder / INFO).exists()), None)


@dataclass(frozen=True)
class Conditions:
    """How a dataset was recorded, by its `dataset.json`."""

    floor: tuple[float, float]  # the floor's friction and restitution
    floor_given: bool  # whether a dataset.json gives these; else they are those of the recipes' floor


def conditions_of(data: Path) -> Conditions:
    """How a dataset, a folder or one of its splits, was recorded. Raises SdfsimError if its `dataset.json` is not
    readable, or has an invalid floor."""
    home = home_of(data)
    info = read_info(home) if home else {}
    floor = floor_of(info, home or data)
    return Conditions(floor, floor_given=info.get("floor") is not None)


def floor_of(info: dict, folder: Path = Path()) -> tuple[float, float]:
    """Friction and restitution of the floor in the `dataset.json` of a folder, or of the recipes' floor if it has none.
    Raises SdfsimError if either is missing, negative or not a number, or if the restitution is above 1."""
    floor = info.get("floor")
    if floor is None:
        return FLOOR
    values: list[Any] = [floor.get(name) if isinstance(floor, dict) else None for name in ("friction", "restitution")]
    friction, restitution = (float(v) if type(v) in (int, float) else np.nan for v in values)
    if not (0.0 <= friction < np.inf and 0.0 <= restitution <= 1.0):
        where = f"{folder / INFO}: floor: must have friction and restitution, >= 0 and 0 to 1 (got {floor!r})"
        raise SdfsimError(where, "leave it out for the floor of the recipes, {:g} and {:g}".format(*FLOOR))
    return friction, restitution


def ranges_of(
    size: np.ndarray, speed: np.ndarray, mass_ratio: np.ndarray, friction: np.ndarray, restitution: np.ndarray,
    floor: np.ndarray,
) -> dict[str, list[float]]:  # fmt: skip
    """[low, high] of training data, SI units: sizes and speeds of dynamic bodies, mass ratios within a scene, and the
    products of two bodies' coefficients, or of a body's with those of a `floor` [F, 2]."""

    def products(values: np.ndarray, floors: np.ndarray) -> list[float]:
        low, high = float(values.min()), float(values.max())
        return [low * min(low, float(floors.min())), high * max(high, float(floors.max()))]

    return {
        "size": [float(size.min()), float(size.max())],
        "speed": [0.0, float(np.percentile(speed, 99.9))],
        "mass_ratio": [1.0, float(mass_ratio.max())],
        "friction": products(friction, floor[:, 0]),
        "restitution": products(restitution, floor[:, 1]),
    }


def trajectory_files(folder: Path, split: str) -> list[Path]:
    """Trajectory files of a dataset in name order: in `folder/split/`, or in `folder` if it has no splits. Raises
    SdfsimError if there are none, or if the folder has other splits but not this one."""
    split_up = [name for name in SPLITS if (folder / name).is_dir()]
    if split_up and split not in split_up:
        raise SdfsimError(f"{folder}: no {split} split here, only {', '.join(split_up)}")
    home = folder / split if split_up else folder
    files = sorted(p for p in home.glob("*.npz") if not p.name.startswith("."))
    if not files:
        raise SdfsimError(f"{home}: no trajectories (*.npz) here", "make some with `sdfsim dataset movi-b`")
    return files


def shapes_folder(folder: Path) -> Path:
    """The folder of a dataset's Shape folders: its own `shapes/`, or its parent's for a split folder."""
    return folder / "shapes" if (folder / "shapes").is_dir() else folder.parent / "shapes"


def load_shapes(folder: Path, names: set[str]) -> dict[str, Shape]:
    # Imported here, because training from cached contact frames also runs if only torch and numpy are installed.
    from sdfsim.shape.shape import load_shape

    return {name: load_shape(shapes_folder(folder) / name) for name in sorted(names)}
