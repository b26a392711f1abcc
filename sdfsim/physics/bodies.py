"""A scene as arrays in the model's units: the part that stays constant during a simulation, and the state that
changes."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.physics import joints as jointed
from sdfsim.physics import pose
from sdfsim.physics.joints import Joints
from sdfsim.physics.motion import MOTION, Motion, Rows
from sdfsim.scene.collision_filter import contact_groups
from sdfsim.scene.scene import Scene, Waypoints
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.contact_geometry import ContactGeometry
from sdfsim.shape.shape import Shape


@dataclass(frozen=True)
class Units:
    """Size of one model unit in metres, seconds and kilograms.

    Rigid contact does not change if lengths are scaled by `length`, times by sqrt(length / gravity) and masses by any
    factor (Froude scaling). So one trained model serves every size and every planet.
    """

    length: float
    time: float
    mass: float

    @property
    def velocity(self) -> float:
        """One model unit of velocity, m/s."""
        return self.length / self.time

    @property
    def acceleration(self) -> float:
        """One model unit of acceleration, m/s^2."""
        return self.length / self.time**2

    @property
    def energy(self) -> float:
        """One model unit of energy, J."""
        return self.mass * self.velocity**2

    def in_si(self, motion: Motion) -> dict[str, np.ndarray]:
        """The arrays of a motion, converted from model units to metres and seconds."""
        return {name: getattr(motion, name) * unit for name, unit in self.motion.items()}

    @property
    def motion(self) -> dict[str, float]:
        """One model unit of each array of a `Motion`, in metres and seconds."""
        return dict(zip(MOTION, (self.length, 1.0, self.velocity, 1.0 / self.time), strict=True))


@dataclass(frozen=True)
class Tracks:
    """The paths of K kinematic bodies with up to P poses each, model units."""

    body: np.ndarray  # [K] int64, the bodies that they move
    time: np.ndarray  # [K, P] float64, increasing; infinite beyond the last pose of a path
    origin: np.ndarray  # [K, P, 3] float64, of the shapes' own origins
    orientation: np.ndarray  # [K, P, 4] float64 xyzw
    com: np.ndarray  # [K, 3] float64, centre of mass from the shape's origin (shape axes)

    def at(self, time: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres of mass [..., K, 3] and orientations [..., K, 4] at times [...]."""
        time, row = np.asarray(time), np.arange(len(self.body))
        before = np.stack([np.searchsorted(known, time, side="right") for known in self.time], -1) - 1
        before = np.clip(before, 0, self.time.shape[1] - 2)
        start, stop = self.time[row, before], self.time[row, before + 1]
        share = np.clip((time[..., None] - start) / (stop - start), 0.0, 1.0)[..., None]
        origin = self.origin[row, before] + share * (self.origin[row, before + 1] - self.origin[row, before])
        first, last = self.orientation[row, before], self.orientation[row, before + 1]
        turn = pose.to_rotvec(pose.multiply(last, pose.conjugate(first)))
        orientation = pose.normalise(pose.multiply(pose.from_rotvec(share * turn), first))
        return origin + pose.rotate(orientation, np.broadcast_to(self.com, origin.shape)), orientation

    def velocity(self, time: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean velocity [K, 3] and angular velocity [K, 3] from `time` to `time + dt`: those that lead from pose to
        pose."""
        (place, turn), (later, turned) = self.at(time), self.at(time + dt)
        return (later - place) / dt, pose.to_rotvec(pose.multiply(turned, pose.conjugate(turn))) / dt


@dataclass(frozen=True)
class Bodies:
    """N bodies with M surface nodes; lengths, times and masses in model units."""

    shape: np.ndarray  # [N] int64 index into `sdfs`, -1 for a body that nothing may touch
    scale: np.ndarray  # [N] float64, shape metres -> model lengths
    com: np.ndarray  # [N, 3] float64, centre of mass from the shape's origin (shape axes, scaled)
    mass: np.ndarray  # [N] float64 (0 unless dynamic)
    inverse_mass: np.ndarray  # [N] float64, 0 unless dynamic
    inertia: np.ndarray  # [N, 3, 3] float64 about the centre of mass, shape axes (identity unless dynamic)
    # friction, restitution: [N] float64
    friction: np.ndarray
    restitution: np.ndarray
    # compliance (0 if rigid), damping: [N] float64, of contacts
    compliance: np.ndarray
    damping: np.ndarray
    moves: np.ndarray  # [N] bool, True for dynamic bodies: they fly, and contacts push them
    bounds: np.ndarray  # [N, 2, 3] float64, box of the solid about the centre of mass, shape axes, scaled
    size: np.ndarray  # [N] float64, largest side of `bounds` (infinite for a plane)
    radius: np.ndarray  # [N] float64, how far `bounds` reach from the centre of mass (infinite for a plane)
    node: np.ndarray  # [M, 3] float64, surface nodes about the centre of mass, shape axes, scaled
    node_start: np.ndarray  # [N + 1] int64, body k owns nodes node_start[k] : node_start[k + 1]
    group: np.ndarray  # [N] int64, the group of a body by its `collides_with`
    allowed: np.ndarray  # [G, G] bool, whether bodies of two groups may touch
    world: np.ndarray  # [N] int64: bodies of different worlds never meet; -1 is in all of them
    sdfs: tuple[Sdf, ...]  # signed distances of the shapes that may be touched
    contact: tuple[ContactGeometry, ...] = ()  # contact geometry of each of these
    tracks: Tracks | None = None  # the paths of kinematic bodies, None if there are none
    joints: Joints | None = None  # None if there are none

    def __len__(self) -> int:
        return len(self.shape)

    @cached_property
    def movers(self) -> np.ndarray:
        """[A] int64, the dynamic bodies."""
        return np.flatnonzero(self.moves)


@dataclass(frozen=True)
class Touch(Rows):
    """What the contact solve keeps about N bodies from one step to the next."""

    quiet: np.ndarray  # [N] int64, number of steps that a body in contact has stayed near its anchor
    anchor: np.ndarray  # [N, 14] float64, the pose that it has stayed near, and its pose half of that time later
    island: np.ndarray  # [N] int64, a number shared by the bodies that fell asleep together; -1 if awake
    pair: np.ndarray  # [P, 2] int64, bodies with contact points; count: [P] int64, their number for each pair
    count: np.ndarray
    # [P, POINTS, COLUMNS] float64, see `sdfsim.physics.solver.world`
    point: np.ndarray


@dataclass(frozen=True)
class Moment(Motion):
    """Poses and velocities of N bodies at one instant, in metres and seconds."""

    time: float = 0.0  # s, since the start


@dataclass(frozen=True)
class State(Motion):
    """Everything that is needed to continue a run, in model units: poses and velocities of N bodies at one instant,
    contacts, sleep, pulling forces and motors. A simulator's `options` and the scene are not part of it."""

    # [2, N, 3] and [2, N, 4], the two poses before (oldest first), for networks on surface nodes; None for other models
    earlier_position: np.ndarray | None = None
    earlier_orientation: np.ndarray | None = None
    touch: Touch | None = None  # contacts and sleep, for the contact solve; None before its first step
    # [N, 6] force at the centre of mass and torque that pull at a body, world axes; None if nothing pulls
    load: np.ndarray | None = None
    # [J, STATE] of the joints, see `sdfsim.physics.joint_columns`; None if there are none
    joints: np.ndarray | None = None
    # [J, NUMBERS] of the joints, if a user has changed numbers of one of them; else None
    drive: np.ndarray | None = None
    time: float = 0.0  # since the start

    def save(self, path: Path | str) -> Path:
        """Write an .npz file from which `read` restores the same state, bit by bit. Raises SdfsimError if it cannot be
        written."""
        path = Path(path)
        write_arrays(path, self.arrays(), compressed=False)
        return path

    @classmethod
    def read(cls, path: Path | str) -> "State":
        """Read a file of `save`. Raises SdfsimError if it is missing or not one of ours."""
        try:
            return cls.of_arrays(read_arrays(Path(path), "a state"))
        except (KeyError, TypeError, ValueError) as error:
            raise SdfsimError(f"{path}: not a state of this version ({error})") from error

    def arrays(self) -> dict[str, np.ndarray]:
        """Every array of the state and of its `touch`, by name."""
        found = {"time": np.array(self.time)}
        for prefix, part in (("", self), ("touch.", self.touch)):
            for f in fields(part) if part is not None else ():
                if isinstance(value := getattr(part, f.name), np.ndarray):
                    found[prefix + f.name] = value
        return found

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray]) -> "State":
        """The state with these `arrays`; unknown names are ignored."""

        def known(kind: type, prefix: str) -> dict[str, np.ndarray]:
            names = {f.name: prefix + f.name for f in fields(kind) if f.name != "time"}
            return {k: arrays[name] for k, name in names.items() if name in arrays}

        touch = known(Touch, "touch.")
        return cls(**known(cls, ""), touch=Touch(**touch) if touch else None, time=float(arrays["time"]))


def awake(bodies: Bodies, state: State) -> np.ndarray:
    """[A] int64, the dynamic bodies that are not asleep."""
    rows = bodies.movers
    return rows if state.touch is None else rows[state.touch.rows_of("island", rows) < 0]


def from_scene(scene: Scene, units: Units) -> tuple[Bodies, State]:
    """Bodies and initial state of a scene, in model units. Raises SdfsimError if a dynamic body has no mass or no
    surface nodes."""
    shapes = [scene.shapes[b.shape] for b in scene.bodies]
    for body, shape in zip(scene.bodies, shapes, strict=True):
        if body.motion == "dynamic" and (not body.mass > 0 or len(shape.nodes) == 0 or not shape.volume > 0):
            raise SdfsimError(f"body {body.name!r} moves: it needs a mass, a volume and surface nodes")
    scale = np.array([b.scale for b in scene.bodies]) / units.length
    moves = np.array([b.motion == "dynamic" for b in scene.bodies])
    mass = np.array([b.mass if m else 0.0 for b, m in zip(scene.bodies, moves, strict=True)]) / units.mass
    inertia = np.stack([_inertia(b, s, m) for b, s, m in zip(scene.bodies, shapes, moves, strict=True)])
    inertia[moves] /= units.mass * units.length**2
    com = np.stack([s.com for s in shapes]) * scale[:, None]
    bounds = np.stack([(s.sdf.bounds - s.com) * k for s, k in zip(shapes, scale, strict=True)])
    force = units.mass * units.length / units.time**2
    nodes = [(s.nodes - s.com) * k for s, k in zip(shapes, scale, strict=True)]
    node_start = np.concatenate([[0], np.cumsum([len(n) for n in nodes])])

    def array(values: Any, dtype: type = np.float64) -> np.ndarray:
        return np.ascontiguousarray(values, dtype=dtype)

    group, allowed = contact_groups(scene.bodies)
    touched = sorted({b.shape for b, g in zip(scene.bodies, group, strict=True) if allowed[g].any()})
    slot = {shape: k for k, shape in enumerate(touched)}
    paths = [(k, b.path) for k, b in enumerate(scene.bodies) if b.path is not None]
    bodies = Bodies(
        shape=array([slot.get(b.shape, -1) for b in scene.bodies], np.int64),
        scale=array(scale),
        com=array(com),
        mass=array(mass),
        inverse_mass=array(np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0)),
        inertia=array(inertia),
        friction=array([b.friction for b in scene.bodies]),
        restitution=array([b.restitution for b in scene.bodies]),
        compliance=array([force / units.length / b.stiffness for b in scene.bodies]),
        damping=array([b.damping / force * units.velocity for b in scene.bodies]),
        moves=array(moves, bool),
        bounds=array(bounds),
        size=array((bounds[:, 1] - bounds[:, 0]).max(-1)),
        radius=array(np.linalg.norm(np.abs(bounds).max(1), axis=-1)),
        node=array(np.concatenate(nodes).reshape(-1, 3)),
        node_start=array(node_start, np.int64),
        group=array(group, np.int64),
        allowed=array(allowed, bool),
        world=np.zeros(len(scene.bodies), dtype=np.int64),
        sdfs=tuple(scene.shapes[k].sdf for k in touched),
        contact=tuple(scene.shapes[k].contact for k in touched),
        tracks=_tracks(paths, com, length=units.length, time=units.time),
        joints=jointed.joints_of(
            scene.joints, com, scene.couplings, length=units.length, time=units.time, mass=units.mass
        )
        if scene.joints
        else None,
    )
    orientation = array([b.quat_xyzw for b in scene.bodies])
    origin = array([b.position for b in scene.bodies]) / units.length
    position = origin + pose.rotate(orientation, bodies.com)
    state = State(
        position=position,
        orientation=orientation,
        velocity=array([b.velocity for b in scene.bodies]) / units.velocity,
        angular_velocity=array([b.angular_velocity for b in scene.bodies]) * units.time,
    )
    return bodies, state if bodies.joints is None else replace(state, joints=jointed.initial(bodies.joints, state))


def _tracks(paths: Sequence[tuple[int, Waypoints]], com: np.ndarray, *, length: float, time: float) -> Tracks | None:
    """The tracks of a scene's paths (pairs of a body's number and its path in SI units); None if there are none. `com`
    [N, 3] are the centres of mass from the shapes' origins, in model units of `length` m and `time` s."""
    if not paths:
        return None
    most = 1 + max(len(path.time) for _, path in paths)

    def padded(values: np.ndarray, fill) -> np.ndarray:
        return np.concatenate([values, np.broadcast_to(fill, (most - len(values), *values.shape[1:]))])

    return Tracks(
        body=np.array([k for k, _ in paths]),
        time=np.stack([padded(p.time / time, np.inf) for _, p in paths]),
        origin=np.stack([padded(p.position / length, p.position[-1] / length) for _, p in paths]),
        orientation=np.stack([padded(p.quat_xyzw, p.quat_xyzw[-1]) for _, p in paths]),
        com=np.stack([com[k] for k, _ in paths]),
    )


def largest_extent(shape: Shape) -> float:
    """Longest side in m of the box around a shape at scale 1."""
    return float(np.ptp(shape.sdf.bounds, axis=0).max())


def _inertia(body, shape, moves: bool) -> np.ndarray:
    """[3, 3] kg m^2 in shape axes; the identity for a body that does not move (it is never used)."""
    if not moves:
        return np.eye(3)
    if body.inertia is not None:
        return np.asarray(body.inertia, dtype=np.float64)
    density = body.mass / (shape.volume * body.scale**3)
    return density * shape.inertia * body.scale**5
