"""The dataset format: one `.npz` a trajectory, `shapes/` with a Shape folder a name, and `dataset.json`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.data.pybullet_sim import TEACHER_VERSION
from sdfsim.errors import SdfsimError
from sdfsim.files import read_arrays, read_json, write_arrays, write_json

if TYPE_CHECKING:
    from sdfsim.shape.shape import Shape


SPLITS = ("train", "validation", "test")
SOLID = "solid_"  # how the names of PyBullet's random solids begin
FLOOR = (0.3, 0.5)  # friction and restitution of the recipes' floor, the plane z = 0


def product_range(values: np.ndarray, floor: float) -> list[float]:
    """[low, high] of the products of two bodies' coefficients, or of a body's and the floor's."""
    low, high = float(values.min()), float(values.max())
    return [low * min(low, floor), high * max(high, floor)]


@dataclass(frozen=True)
class Trajectory:
    """T recorded frames of N bodies above the static floor z = 0 (which is not among the N).

    Attributes:
        position: [T, N, 3] m, body-frame origin = centre of mass.
        quat_xyzw: [T, N, 4].
        velocity: [T, N, 3] m/s, world, at the end of the step.
        angular_velocity: [T, N, 3] rad/s, world, at the end of the step.
        shape: [N] names of the Shape folders.
        scale: [N] uniform size factors.
        mass: [N] kg.
        inertia: [N, 3] kg m^2, principal, body axes.
        friction: [N].
        restitution: [N].
        static: [N] bool.
        dt: s.
        gravity: [3] m/s^2.
    """

    position: np.ndarray
    quat_xyzw: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    shape: np.ndarray
    scale: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    static: np.ndarray
    dt: float
    gravity: np.ndarray

    def save(self, path: Path) -> None:
        """Write the file."""
        write_arrays(path, {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read and check one file. Raises SdfsimError naming the file and the field that is wrong."""
        arrays: dict[str, Any] = read_arrays(path, "a trajectory")
        missing = [f.name for f in fields(cls) if f.name not in arrays]
        if missing:
            raise SdfsimError(f"{path}: missing field(s) {', '.join(missing)}")
        arrays = {f.name: _typed(path, f.name, arrays[f.name]) for f in fields(cls)}
        _check(path, arrays)
        arrays["dt"] = float(arrays["dt"])
        return cls(**arrays)


LONGEST_STEP = 10.0  # s
_NAME = re.compile(r"(?!\.)[\w. -]+")  # of a folder beside others, never a path
_TRAILING = {"position": (3,), "quat_xyzw": (4,), "velocity": (3,), "angular_velocity": (3,)}
_PER_BODY = {"scale": (), "mass": (), "inertia": (3,), "friction": (), "restitution": (), "static": (), "shape": ()}


def check_names(where: str, names: Iterable[str]) -> None:
    """Raises SdfsimError where one of the names cannot be that of a Shape folder of a dataset."""
    for name in names:
        if not _NAME.fullmatch(name):
            raise SdfsimError(f"{where}: {name!r} is no name of a Shape folder", "letters, digits, spaces, . _ - only")


def _typed(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """A field as the type that the rest of the code counts on."""
    try:
        if name == "shape":
            return values.astype(str)
        numbers = values.astype(np.float64, casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise SdfsimError(
            f"{path}: {name}: must be {'names' if name == 'shape' else 'real numbers'}: {error}"
        ) from error
    if name != "static":
        return numbers
    if not np.isin(numbers, (0.0, 1.0)).all():
        raise SdfsimError(f"{path}: static: must be true or false (or 1 or 0)")
    return numbers.astype(bool)


def _check(path: Path, arrays: dict) -> None:
    if arrays["position"].ndim != 3:
        raise SdfsimError(f"{path}: position: must be [T, N, 3] (got {list(arrays['position'].shape)})")
    frames, bodies = arrays["position"].shape[:2]
    expected = {k: (frames, bodies, *t) for k, t in _TRAILING.items()}
    expected |= {k: (bodies, *t) for k, t in _PER_BODY.items()} | {"gravity": (3,), "dt": ()}
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise SdfsimError(f"{path}: {name}: must be {list(shape)} (got {list(arrays[name].shape)})")
        if name not in ("shape", "static") and not np.isfinite(arrays[name]).all():
            raise SdfsimError(f"{path}: {name}: has values that are not finite")
    moving = ~arrays["static"]
    for name in ("mass", "inertia"):
        if not (arrays[name][moving] > 0).all():
            raise SdfsimError(f"{path}: {name}: must be > 0 for bodies that move")
    if frames < 2:
        raise SdfsimError(f"{path}: position: needs at least two frames (got {frames})")
    if np.abs(np.linalg.norm(arrays["quat_xyzw"], axis=-1) - 1.0).max(initial=0.0) > 1e-3:
        raise SdfsimError(f"{path}: quat_xyzw: must be unit quaternions")
    check_names(f"{path}: shape", arrays["shape"].tolist())
    if not (arrays["scale"] > 0).all() or not 0 < arrays["dt"] <= LONGEST_STEP:
        raise SdfsimError(f"{path}: scale must be > 0, dt > 0 and at most {LONGEST_STEP:g} s")
    if (arrays["friction"] < 0).any() or ((arrays["restitution"] < 0) | (arrays["restitution"] > 1)).any():
        raise SdfsimError(f"{path}: friction must be >= 0, restitution from 0 to 1")


def check_alike(where: str, trajectories: Iterable[Trajectory]) -> None:
    """Raises SdfsimError where trajectories that are used together differ in step or gravity."""
    if len({(t.dt, *t.gravity.tolist()) for t in trajectories}) > 1:
        raise SdfsimError(f"{where}: its trajectories differ in step or gravity", "give a dataset of one recipe")


def write_info(folder: Path, info: dict) -> None:
    """Write `dataset.json` (recipe, seed, version of the teacher, engine with version and settings)."""
    write_json(folder / "dataset.json", info)


def read_info(folder: Path) -> dict:
    """`dataset.json` of a dataset folder.

    Raises:
        SdfsimError: absent, not a JSON object, or of `sdfsim dataset` with another version of the teacher.
    """
    info = read_json(folder / "dataset.json", "a dataset folder is what `sdfsim dataset` writes")
    if not isinstance(info, dict):
        raise SdfsimError(f"{folder / 'dataset.json'}: must be a JSON object")
    ours = info.get("engine") == "pybullet" and {"recipe", "engine_settings"} <= set(info)
    if ours and info.get("teacher") != TEACHER_VERSION:
        raise SdfsimError(
            f"{folder}: made by an earlier teacher whose contacts acted before surfaces touched"
            if info.get("teacher", 1) == 1
            else f"{folder}: made by version {info['teacher']!r} of the teacher, not by {TEACHER_VERSION}",
            "make it again with `sdfsim dataset`",
        )
    return info


def home_of(data: Path) -> Path | None:
    """The folder with the `dataset.json` that tells of a dataset or of one of its splits; None without any."""
    return next((folder for folder in (data, data.parent) if (folder / "dataset.json").exists()), None)


def floor_of(info: dict) -> tuple[float, float]:
    """Friction and restitution of the floor that `dataset.json` tells, or the recipes' own.

    Raises:
        SdfsimError: what is told is neither.
    """
    told = info.get("floor") or {"friction": FLOOR[0], "restitution": FLOOR[1]}
    try:
        return float(told["friction"]), float(told["restitution"])
    except (KeyError, TypeError, ValueError) as error:
        raise SdfsimError(f"dataset.json: floor: must have friction and restitution (got {told!r})") from error


def trajectory_files(folder: Path, split: str) -> list[Path]:
    """Trajectory files of a dataset in name order: of `folder/split/`, or of `folder` where nothing is split.

    Raises:
        SdfsimError: when there are none, or the dataset has other splits but not this one.
    """
    split_up = [name for name in SPLITS if (folder / name).is_dir()]
    if split_up and split not in split_up:
        raise SdfsimError(f"{folder}: no {split} split here, only {', '.join(split_up)}")
    home = folder / split if split_up else folder
    files = sorted(p for p in home.glob("*.npz") if not p.name.startswith("."))
    if not files:
        raise SdfsimError(f"{home}: no trajectories (*.npz) here", "make some with `sdfsim dataset movi-b`")
    return files


def load_shapes(folder: Path, names: set[str]) -> dict[str, Shape]:
    """The Shape folders `shapes/NAME` of a dataset (its own, or its parent's for a split folder)."""
    # Here and not above: training from cached contact frames runs where only torch and numpy are installed.
    from sdfsim.shape.shape import load_shape

    home = shapes_folder(folder)
    return {name: load_shape(home / name) for name in sorted(names)}


def shapes_folder(folder: Path) -> Path:
    """Where the Shape folders of a dataset are: its own `shapes/`, or its parent's for a split folder."""
    return folder / "shapes" if (folder / "shapes").is_dir() else folder.parent / "shapes"
