"""Contact frames: recorded steps in which bodies meet or nearly meet, with the points at which they do.

The points are searched once, from recorded states, so that training needs no signed distances, only torch and numpy.
They are searched from disturbed states as well, because in a rollout a network gets states that differ slightly from
recorded ones.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import digest, read_arrays, write_arrays
from sdfsim.base.parallel import Progress, parallel, silent
from sdfsim.data.dataset import (
    INFO,
    Trajectory,
    check_alike,
    conditions_of,
    home_of,
    load_shapes,
    shapes_folder,
    trajectory_files,
)
from sdfsim.learned.contact_graph import OF_BODIES, OF_EDGES
from sdfsim.physics import pose

if TYPE_CHECKING:
    from sdfsim.learned.inference import Edges
    from sdfsim.physics.bodies import Bodies, State
    from sdfsim.physics.options import Options

STEP = 0.02  # s, the step with which networks are trained
FRAMES_VERSION = 14  # increase it whenever frames of the same recordings come out differently
TOGETHER = 25  # trajectories that are taken side by side
ENDS = ("first", "second")


@dataclass(frozen=True)
class Disturbed:
    draws: int = 2  # times that every recording is taken: first its own states, then disturbed ones
    # shift, speed: m and m/s, standard deviations of the disturbance of a body's position and velocity, and, by
    # rotation and spin, of its surface. For each body it is multiplied by a factor, log-uniform from `least` to 1.
    shift: float = 0.003
    speed: float = 0.03
    least: float = 0.05
    # Share of the shapes of disturbed recordings that meet others by samples of their surface, although they have
    # convex pieces: shapes of photos and large meshes have none.
    sampled: float = 0.5


@dataclass(frozen=True)
class ContactFrames:
    """F frames with contact from many trajectories, flattened.

    Units are metres, seconds and kilograms if the step is `STEP`. Frames of other steps are in units in which the step
    has this length and gravity keeps its value (Froude scaling): to a network, which is trained with this step only,
    their bodies look larger or smaller.

    A frame holds all bodies of its trajectory (rows of `bodies`, `truth` and the fields after them) and its contact
    edges, in the form of a `ContactGraph`. `second` = -1 means the floor, which has no row.
    """

    # body_start, edge_start: [F + 1] int64, frame k owns rows body_start[k] : body_start[k + 1]
    body_start: np.ndarray
    edge_start: np.ndarray
    bodies: dict[str, np.ndarray]  # `OF_BODIES`, [B, ...]; masses are relative to one that changes from step to step
    edges: dict[str, np.ndarray]  # `OF_EDGES`, [E, ...]; `first` and `second`: [E] int16, bodies within the frame
    truth: dict[str, np.ndarray]  # fields of `Velocities`, [B, 3]: recorded values
    mass: np.ndarray  # [B] kg, 0 for static bodies; friction, restitution, size: [B]
    friction: np.ndarray
    restitution: np.ndarray
    size: np.ndarray
    floor: np.ndarray  # [F, 2] friction and restitution of each frame's floor
    gravity: np.ndarray  # [3] m/s^2
    trajectories: np.ndarray  # [K] int64, number of trajectories in each of the K sets that were joined

    def __len__(self) -> int:
        return len(self.edge_start) - 1

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays, by names in which a slash leads to the entries of a field."""
        flat: dict[str, np.ndarray] = {}
        for name, value in vars(self).items():
            flat |= {f"{name}/{of}": v for of, v in value.items()} if isinstance(value, dict) else {name: value}
        return flat

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray]) -> ContactFrames:
        """The reverse. Raises TypeError if a field is missing or unknown."""
        fields: dict[str, Any] = {}
        for name, value in arrays.items():
            of, _, inside = name.partition("/")
            if inside:
                fields.setdefault(of, {})[inside] = value
            else:
                fields[of] = value
        return cls(**fields)

    def save(self, path: Path) -> None:
        write_arrays(path, self.arrays(), compressed=False)

    @classmethod
    def load(cls, path: Path) -> ContactFrames:
        """Read a cache file. Raises SdfsimError if it does not hold contact frames of this version."""
        try:
            return cls.of_arrays(read_arrays(path, "contact frames", "delete it to have it made again"))
        except TypeError as error:
            raise SdfsimError(f"{path}: not contact frames: {error}", "delete it to have it made again") from error

    def digest(self) -> str:
        return digest({name: array for name, array in self.arrays().items() if name != "trajectories"})[:16]


def contact_frames(data: Path, split: str, how: Disturbed, *, on_progress: Progress = silent) -> ContactFrames:
    """The contact frames of a dataset split: from the cache file beside it, else made now and cached. Raises
    SdfsimError if there are no trajectories, if they are unreadable or differ in step or gravity, or if none has a
    contact."""
    folder = data / "frames"
    name = f"{split}-{how.draws}"
    files = trajectory_files(data, split)
    cached = folder / f"{name}-{_fingerprint(files, how)}.npz"
    if cached.exists():
        return ContactFrames.load(cached)
    check_alike(str(data / split), map(Trajectory.load, files))
    groups = [files[i : i + TOGETHER] for i in range(0, len(files), TOGETHER)]
    parts: list[list[ContactFrames]] = [[]] * len(groups)
    for done, (index, part) in enumerate(parallel(_searched, [(group, how) for group in groups]), start=1):
        parts[index] = part
        on_progress(done / len(groups), f"contacts of {split}, part {done} of {len(groups)}")
    steps = [step for part in parts for step in part]
    if not steps:
        raise SdfsimError(f"{data / split}: nothing touches anything in its trajectories")
    frames = replace(join_frames(steps), trajectories=np.array([len(files)]))
    folder.mkdir(exist_ok=True)
    for old in folder.glob(f"{name}-*.npz"):
        old.unlink()
    frames.save(cached)
    return frames


def join_frames(sets: list[ContactFrames]) -> ContactFrames:
    """Several sets of frames as one. Raises SdfsimError if they differ in gravity."""
    one = sets[0]
    if any(not np.allclose(one.gravity, other.gravity) for other in sets[1:]):
        raise SdfsimError("datasets that are trained on together must share gravity")
    whole = {"gravity": one.gravity}
    for name, first in one.arrays().items():
        arrays = [first, *(other.arrays()[name] for other in sets[1:])]
        if name.endswith("_start"):
            ends = np.cumsum([0] + [a[-1] for a in arrays[:-1]])
            arrays = [first[:1], *(a[1:] + end for a, end in zip(arrays, ends, strict=True))]
        whole.setdefault(name, np.concatenate(arrays))
    return ContactFrames.of_arrays(whole)


def _fingerprint(files: list[Path], how: Disturbed) -> str:
    """A hash that changes with the trajectories (names and sizes), the recipe, and the shapes."""
    info = [home / INFO] if (home := home_of(files[0].parent)) else []
    records = [*info, *sorted(shapes_folder(files[0].parent).glob("*/shape.json"))]
    contents = [record.read_text(encoding="utf-8") for record in records]
    return digest(FRAMES_VERSION, how, [[f.name, f.stat().st_size] for f in files], contents)[:12]


def _searched(files: list[Path], how: Disturbed) -> list[ContactFrames]:
    """The frames of each draw and step, for all trajectories of a group."""
    from sdfsim.data.batching import merged, state_at  # needs the SDFs, hence more than torch and numpy
    from sdfsim.physics.bodies import Units
    from sdfsim.physics.options import Options
    from sdfsim.physics.solver.prepare import Compiled, points_near

    floor = conditions_of(files[0].parent).floor
    group = [Trajectory.load(file) for file in files]
    shapes = load_shapes(files[0].parent, {str(n) for t in group for n in t.shape})
    options = Options(np.asarray(group[0].gravity, dtype=np.float64), group[0].dt)
    count = min(len(t.position) for t in group)
    parts = []
    for draw in range(how.draws):
        rng = np.random.default_rng([draw, int(hashlib.sha256(files[0].name.encode()).hexdigest()[:8], 16)])
        if draw:
            sampled = {name for name in sorted(shapes) if rng.random() < how.sampled}
            shapes = {name: replace(s, pieces=()) if name in sampled else s for name, s in shapes.items()}
        bodies, start = merged(group, [0] * len(group), shapes, Units(1.0, 1.0, 1.0), floor)
        scene = Compiled(bodies, start, grids=False)
        for now in range(count - 1):
            state = state_at(group, [now] * len(group), start)
            state = _disturbed(bodies, state, how, rng) if draw else state
            edges = points_near(scene, state, options)
            recorded = state_at(group, [now + 1] * len(group), start)
            parts += _of_step(bodies, state, edges, recorded, options, floor)
    return parts


def _disturbed(bodies: Bodies, state: State, how: Disturbed, rng: np.random.Generator) -> State:
    moves = bodies.moves[:, None]
    lever = 2.0 / np.minimum(bodies.size, 1e3)[:, None]
    part = how.least ** rng.random((len(bodies), 1)) * moves

    def draw(scale: float | np.ndarray) -> np.ndarray:
        return rng.standard_normal((len(bodies), 3)) * part * scale

    turn = pose.from_rotvec(draw(how.shift * lever))
    return replace(
        state,
        position=state.position + draw(how.shift),
        orientation=pose.normalise(pose.multiply(turn, state.orientation)),
        velocity=state.velocity + draw(how.speed),
        angular_velocity=state.angular_velocity + draw(how.speed * lever),
    )


def _of_step(
    bodies: Bodies, state: State, edges: Edges, recorded: State, options: Options, of_floor: tuple[float, float]
) -> list[ContactFrames]:
    """The frames of a step of several trajectories on one floor with this friction and restitution, in units in which
    the step is `STEP`; none if nothing is near anything."""
    from sdfsim.learned.inference import step_graph, velocities
    from sdfsim.physics.free_flight import fly

    pair, value = edges
    if not len(pair):
        return []
    world, floor = bodies.world, len(bodies) - 1
    order = np.argsort(world[pair[:, 0]], kind="stable")
    pair, value = pair[order], value[order]
    used, frame, count = np.unique(world[pair[:, 0]], return_inverse=True, return_counts=True)
    rows = np.flatnonzero(np.isin(world[:floor], used))
    begin = np.concatenate([[0], np.cumsum(np.bincount(world[rows])[used])])
    every, free = np.append(rows, floor), fly(bodies, state, options)
    graph = vars(step_graph(bodies, state, free, (pair, value), options, STEP, every))
    truth = vars(velocities(state, recorded, every, options.dt, STEP))
    ends = {name: graph[name].numpy() for name in ENDS}
    ends = {name: np.where(k == len(rows), -1, k - begin[frame]).astype(np.int16) for name, k in ends.items()}
    length = (options.dt / STEP) ** 2
    return [
        ContactFrames(
            body_start=begin,
            edge_start=np.concatenate([[0], np.cumsum(count)]),
            bodies={name: graph[name][:-1].float().numpy() for name in OF_BODIES},
            edges=ends | {name: graph[name].float().numpy() for name in OF_EDGES},
            truth={name: values[:-1].float().numpy() for name, values in truth.items()},
            mass=bodies.mass[rows].astype(np.float32),
            friction=bodies.friction[rows].astype(np.float32),
            restitution=bodies.restitution[rows].astype(np.float32),
            size=(bodies.size[rows] / length).astype(np.float32),
            floor=np.tile(np.array(of_floor, np.float32), (len(used), 1)),
            gravity=options.gravity,
            trajectories=np.zeros(1, dtype=np.int64),
        )
    ]
