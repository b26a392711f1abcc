"""Contact frames: every recorded step in which something touches, with its contact edges found once.

Training then needs no signed distances: a small rigid disturbance of the bodies changes an edge's gap by the normal
component of the relative displacement, to first order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdfsim.data.dataset import Trajectory, check_alike, engine_substep, load_shapes, trajectory_files
from sdfsim.dynamics.freeflight import torque_free
from sdfsim.dynamics.graph import SUBSTEPS
from sdfsim.dynamics.pose import conjugate, multiply, to_rotvec
from sdfsim.errors import SdfsimError
from sdfsim.files import read_arrays, write_arrays
from sdfsim.parallel import parallel

STEP = 0.02  # s, the step that networks know
FRAMES_VERSION = 6  # counts up whenever frames of the same recordings come out differently


@dataclass(frozen=True)
class ContactFrames:
    """F frames with contact out of many trajectories, flattened.

    Units are metres and seconds where the recorded step is `STEP`. Recordings of other steps are told in units in which
    it is that long and gravity is what it is (Froude scaling): to a network, which knows no other step, their bodies
    are larger or smaller.

    A frame holds its trajectory's bodies that move or not, at the start of a step (rows of the body arrays), and
    its contact edges. `second` = -1 means the floor.

    Attributes:
        body_start, edge_start: [F + 1] int64, frame k owns rows body_start[k] : body_start[k + 1].
        orientation: [B, 4]; velocity, angular: [B, 3] at the start of the step.
        free_angular, mean_angular: [B, 3] rad/s in free flight, at the end of the step and as its mean.
        end_velocity, end_angular, moved, turned: [B, 3] recorded: velocities at the end of the step, and mean
            linear and angular velocity over it.
        mass: [B] kg, 0 for static bodies; inertia: [B, 3]; friction, restitution, size: [B].
        substeps: [F] uint8, inner steps of the engine in one step.
        first, second: [E] int16, bodies within the frame.
        arm: [E, 3] m, from the first body's centre of mass to the point of contact.
        other: [E, 3] m, what leads to there from the second's (from the floor's origin), less `arm`.
        normal: [E, 3]; gap: [E] m.
        dt: s, `STEP`; gravity: [3] m/s^2; reach: m, the contact radius used.
        trajectories: [K] int64, how many were searched, of each of the K sets that were joined; 0 where unknown.
    """

    body_start: np.ndarray
    edge_start: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular: np.ndarray
    free_angular: np.ndarray
    mean_angular: np.ndarray
    end_velocity: np.ndarray
    end_angular: np.ndarray
    moved: np.ndarray
    turned: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    friction: np.ndarray
    restitution: np.ndarray
    size: np.ndarray
    substeps: np.ndarray
    first: np.ndarray
    second: np.ndarray
    arm: np.ndarray
    other: np.ndarray
    normal: np.ndarray
    gap: np.ndarray
    dt: float
    gravity: np.ndarray
    reach: float
    trajectories: np.ndarray

    def __len__(self) -> int:
        return len(self.edge_start) - 1

    def save(self, path: Path) -> None:
        """Write the cache file."""
        arrays = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        write_arrays(path, arrays | {"version": np.array(FRAMES_VERSION)}, compressed=False)

    @classmethod
    def load(cls, path: Path, *, must_tell: bool = False) -> ContactFrames:
        """Read a cache file.

        Args:
            path: of the file.
            must_tell: refuse one that does not say that it is of this version (elsewhere its name proves it).

        Raises:
            SdfsimError: not contact frames, or not of this version.
        """
        arrays: dict[str, Any] = read_arrays(path, "contact frames", "delete it to have it made again")
        made_by = arrays.pop("version", None)  # those that lack it, and the counts, are older than both
        if must_tell and (made_by is None or int(made_by) != FRAMES_VERSION):
            said = "does not say by which version" if made_by is None else f"says by version {made_by}"
            raise SdfsimError(
                f"{path}: {said} its contacts were found (this is version {FRAMES_VERSION})",
                "where the trajectories are, delete it and train once: it is made again; then copy it here",
            )
        arrays.setdefault("trajectories", np.zeros(1, dtype=np.int64))
        if missing := [f.name for f in fields(cls) if f.name not in arrays]:
            raise SdfsimError(f"{path}: no {missing[0]} in it", "delete it to have it made again")
        arrays |= {name: float(arrays[name]) for name in ("dt", "reach")}
        return cls(**arrays)

    def digest(self) -> str:
        """Changes with what is trained on."""
        digest = hashlib.sha256(f"{self.dt} {self.reach}".encode())
        for field in fields(self):
            if field.name not in ("dt", "reach", "trajectories"):
                digest.update(np.ascontiguousarray(getattr(self, field.name)).data)
        return digest.hexdigest()[:16]


def contact_frames(
    data: Path, split: str, reach: float, *, on_progress: Callable[[float, str], None] | None = None
) -> ContactFrames:
    """The contact frames of a dataset split: from the cache file beside it, else found now and cached.

    Raises:
        SdfsimError: no trajectories, unreadable ones, or some that differ in step or gravity.
    """
    folder = data / "frames"
    if not (data / split).is_dir():
        # A machine that only trains may have been given nothing but the cache.
        made = list(folder.glob(f"{split}-{reach:g}-*.npz"))
        if len(made) == 1:
            return ContactFrames.load(made[0], must_tell=True)
    files = trajectory_files(data, split)
    cached = folder / f"{split}-{reach:g}-{_fingerprint(data, files)}.npz"
    if cached.exists():
        return ContactFrames.load(cached)
    check_alike(str(data / split), map(Trajectory.load, files))
    parts: list[dict[str, np.ndarray]] = [{}] * len(files)
    for done, (index, part) in enumerate(parallel(_of_file, [(f, reach) for f in files]), start=1):
        parts[index] = part
        if on_progress:
            on_progress(done / len(files), f"contacts of {split} trajectory {done} of {len(files)}")
    frames = _concatenate(parts, Trajectory.load(files[0]).gravity, reach)
    folder.mkdir(exist_ok=True)
    for old in folder.glob(f"{split}-{reach:g}-*.npz"):
        old.unlink()
    frames.save(cached)
    return frames


def join_frames(sets: list[ContactFrames]) -> ContactFrames:
    """Several sets of frames as one.

    Raises:
        SdfsimError: they differ in step, gravity or contact radius.
    """
    one = sets[0]
    for other in sets[1:]:
        if (one.dt, one.reach) != (other.dt, other.reach) or not np.allclose(one.gravity, other.gravity):
            raise SdfsimError("datasets that are trained on together must share step and gravity")
    whole: dict[str, Any] = {"dt": one.dt, "gravity": one.gravity, "reach": one.reach}
    for field in fields(ContactFrames):
        if field.name in whole:
            continue
        arrays = [getattr(s, field.name) for s in sets]
        if field.name.endswith("_start"):
            ends = np.cumsum([0] + [a[-1] for a in arrays[:-1]])
            arrays = [arrays[0][:1], *(a[1:] + end for a, end in zip(arrays, ends, strict=True))]
        whole[field.name] = np.concatenate(arrays)
    return ContactFrames(**whole)


def _fingerprint(data: Path, files: list[Path]) -> str:
    """Changes with the trajectories (names and sizes), the recipe, the shapes, and the way contacts are found."""
    digest = hashlib.sha256(f"{FRAMES_VERSION} {[(f.name, f.stat().st_size) for f in files]}".encode())
    for record in (data / "dataset.json", *sorted((data / "shapes").glob("*/shape.json"))):
        if record.exists():
            digest.update(record.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _shape(folder: Path, name: str):
    return load_shapes(folder, {name})[name]


def _of_file(path: Path, reach: float) -> dict[str, np.ndarray]:
    from sdfsim.data.batching import find_edges  # needs the SDFs, hence more than torch and numpy

    trajectory = Trajectory.load(path)
    substeps = inner_steps(trajectory.dt, engine_substep(path.parent))
    trajectory = in_steps_of(trajectory, STEP)
    shapes = {str(n): _shape(path.parent, str(n)) for n in trajectory.shape}
    return _of_trajectory(trajectory, find_edges(trajectory, shapes, reach), shapes, substeps)


def in_steps_of(t: Trajectory, dt: float) -> Trajectory:
    """The same motion in units of time in which its step is `dt`, and of length in which gravity stays what it is."""
    time = t.dt / dt
    length = time**2
    return replace(
        t,
        position=t.position / length,
        velocity=t.velocity / (length / time),
        angular_velocity=t.angular_velocity * time,
        scale=t.scale / length,
        inertia=t.inertia / length**2,
        dt=dt,
    )


def inner_steps(dt: float, substep: float) -> int:
    """Inner steps of `substep` s in a recorded step of `dt` s; what is not told (0) counts as in our own recordings.

    Raises:
        SdfsimError: more than a network knows of.
    """
    count = round(dt / substep) if substep > 0 else SUBSTEPS
    if not 1 <= count <= SUBSTEPS:
        raise SdfsimError(f"recorded steps of {dt:g} s hold {count} inner ones of the engine", f"at most {SUBSTEPS}")
    return count


def _of_trajectory(t: Trajectory, edges: dict[str, np.ndarray], shapes, substeps: int) -> dict[str, np.ndarray]:
    """One trajectory's part of the arrays. `edges` come sorted by frame, `frame` telling which."""
    count = np.bincount(edges["frame"], minlength=len(t.position) - 1)
    used = np.flatnonzero(count)
    bodies = t.position.shape[1]
    now, then = used, used + 1

    def rows(array: np.ndarray, when: np.ndarray) -> np.ndarray:
        return array[when].reshape(-1, array.shape[-1])

    def each(array: np.ndarray) -> np.ndarray:
        return np.tile(array, (len(used),) + (1,) * (array.ndim - 1))

    orientation, angular = rows(t.quat_xyzw, now), rows(t.angular_velocity, now)
    inertia = each(np.where(t.static[:, None], 1.0, t.inertia))
    tensor = torch.from_numpy
    start = tensor(orientation)
    free, free_angular = torque_free(start, tensor(angular), torch.diag_embed(tensor(inertia)), t.dt)
    turned = to_rotvec(multiply(tensor(rows(t.quat_xyzw, then)), conjugate(start))) / t.dt
    extent = np.array([np.ptp(shapes[str(n)].sdf.bounds, axis=0).max() for n in t.shape]) * t.scale
    return {
        "bodies": np.full(len(used), bodies),
        "edges": count[used],
        "orientation": orientation,
        "velocity": rows(t.velocity, now),
        "angular": angular,
        "free_angular": free_angular.numpy(),
        "mean_angular": (to_rotvec(multiply(free, conjugate(start))) / t.dt).numpy(),
        "end_velocity": rows(t.velocity, then),
        "end_angular": rows(t.angular_velocity, then),
        "moved": (rows(t.position, then) - rows(t.position, now)) / t.dt,
        "turned": turned.numpy(),
        "mass": each(np.where(t.static, 0.0, t.mass)),
        "inertia": inertia,
        "friction": each(t.friction),
        "restitution": each(t.restitution),
        "size": each(extent),
        "substeps": np.full(len(used), substeps),
    } | {k: edges[k] for k in ("first", "second", "arm", "other", "normal", "gap")}


def _concatenate(parts: list[dict[str, np.ndarray]], gravity: np.ndarray, reach: float) -> ContactFrames:
    joined = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    starts = {
        "body_start": np.concatenate([[0], np.cumsum(joined.pop("bodies"))]),
        "edge_start": np.concatenate([[0], np.cumsum(joined.pop("edges"))]),
    }
    kinds = {"first": np.int16, "second": np.int16, "substeps": np.uint8}
    small = {k: v.astype(kinds.get(k, np.float32)) for k, v in joined.items()}
    common = {"dt": STEP, "gravity": gravity, "reach": reach, "trajectories": np.array([len(parts)])}
    return ContactFrames(**starts, **small, **common)
