"""Shared by tosses of a cube and of an elbow: how they are split and compared, and their simulations by ours and by
other engines."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation

from benchmarks.engines.drake import DrakeWorld
from benchmarks.engines.pybullet import BulletWorld
from sdfsim.apps.identify import repeated
from sdfsim.apps.mujoco_world import MujocoWorld
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays
from sdfsim.evaluation.engines import World
from sdfsim.evaluation.metrics import interval
from sdfsim.scene.scene import Scene

FRAMES = 75  # compared: half a second
FIT, TEST, SEED = 60, 100, 0
CLEAR = 0.005  # m: a body higher than this over z = 0 flies; the table is 1 to 6 mm lower
FLIGHT = 6  # frames at least, to fit a start to
INNER = 5  # inner steps of every engine in a frame
APART = np.array([20.0, 0.0, 0.0])  # m between tosses, which meet the table alone
IMPRATIO = 14.0  # MuJoCo: stiffness of friction relative to the normal
FAR = 30.0  # % and degrees: cap on the errors of a toss in the search for parameters
CROWD, ROUNDS = 25, 15  # of that search: points (rounded up to a power of two), and rounds
# Bounds of the engines' parameters, lower and upper. Sizes are in sides, heights in m, times in s, inertias relative to
# the published one.
BODY = {"friction": (0.05, 0.4), "height": (-0.006, 0.003), "side": (0.9, 1.02), "inertia": (0.8, 1.4)}
SOLID = BODY | {"restitution": (0.0, 0.5)}
SOFT = BODY | {"softness": (0.003, 0.04), "damping": (0.05, 1.2)}
Bounds = dict[str, tuple[float, float]]
One = TypeVar("One")


@dataclass(frozen=True)
class Start:
    """Pose and velocities at a first frame; for two links the arrays have a leading axis of two."""

    position: np.ndarray  # [3] m
    quat_xyzw: np.ndarray  # [4]
    velocity: np.ndarray  # [3] m/s
    angular_velocity: np.ndarray  # [3] rad/s, world

    @property
    def links(self) -> list[np.ndarray]:
        """The four of them, [1 or 2, *]."""
        return list(map(np.atleast_2d, (self.position, self.quat_xyzw, self.velocity, self.angular_velocity)))


class Motion(NamedTuple):
    """Poses of B tosses in the frames after their first; for two links the arrays have an axis of two before the
    last."""

    position: np.ndarray  # [B, T, 3] m
    quat_xyzw: np.ndarray  # [B, T, 4]


# Called with the scene of one thing on a table, inertia [3], starts, dt and values.
Engine = Callable[[Scene, np.ndarray, Sequence[Start], float, dict[str, float]], Motion]


def read_tosses(file: Path, *names: str) -> tuple[float, list[dict[str, np.ndarray]]]:
    """Frame spacing s, and of each toss in a file the arrays `names`. Raises SdfsimError if one is absent."""
    found = read_arrays(file, "recorded tosses", f"give the folder that holds {file.name}")
    if missing := {"start", "dt", *names} - set(found):
        raise SdfsimError(f"{file}: there is no array {min(missing)!r}", f"it has {', '.join(sorted(found))}")
    rows = [slice(a, b) for a, b in zip(found["start"][:-1], found["start"][1:], strict=True)]
    return float(found["dt"]), [{name: found[name][k].astype(np.float64) for name in names} for k in rows]


def drawn(usable: Sequence[One]) -> tuple[list[One], list[One], list[One]]:
    """Tosses for fitting parameters, others for testing, and the rest. Raises SdfsimError for too few."""
    if len(usable) < FIT + TEST:
        raise SdfsimError(f"{len(usable)} tosses are long enough (at least {FIT + TEST})")
    order = np.random.default_rng(SEED).permutation(len(usable))
    fit, test, rest = ([usable[k] for k in part] for part in np.split(order, [FIT, FIT + TEST]))
    return fit, test, rest


def recorded(tosses: Sequence[Any]) -> Motion:
    """The compared frames of recordings."""
    frames = slice(1, FRAMES + 1)
    return Motion(*(np.array([getattr(toss, name)[frames] for toss in tosses]) for name in Motion._fields))


def apart(found: Motion, truth: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Distances m and angles rad of poses, [B, T], or [B, T, 2] of links."""
    way = np.linalg.norm(found.position - truth.position, axis=-1)
    one, other = (Rotation.from_quat(motion.quat_xyzw.reshape(-1, 4)) for motion in (found, truth))
    return way, (one * other.inv()).magnitude().reshape(way.shape)


def cost(errors: Iterable[np.ndarray]) -> float:
    """Sum of the mean errors [B] of tosses, % and degrees. Errors are capped, because otherwise the few cubes that come
    to rest on another face by chance would dominate the fit."""
    return float(sum(np.minimum(error, FAR).mean() for error in errors))


def with_interval(errors: np.ndarray) -> list[float]:
    """The mean over tosses [B], and its 95 % interval."""
    return [float(errors.mean()), *interval(errors)]


def searched(loss: Callable[[dict[str, float]], float], bounds: Bounds, rounds: int = ROUNDS) -> dict[str, float]:
    """The values within bounds with the least loss. On sixty tosses the loss has many local minima, in which a simplex
    gets stuck."""
    found = differential_evolution(
        lambda point: loss(dict(zip(bounds, point, strict=True))), list(bounds.values()), maxiter=rounds - 1,
        popsize=CROWD // len(bounds), init="sobol", tol=0.0, polish=False, rng=SEED,
    )  # fmt: skip
    return dict(zip(bounds, found.x.tolist(), strict=True))


# --- engines ---


def ours(starts: Sequence[Start], dt: float, scene: Scene) -> Motion:
    """The motion of the scene that `sdfsim identify` wrote, from these starts."""
    begun = []
    for start in starts:
        place, turn, speed, spin = (np.broadcast_to(v, (FRAMES + 1, *v.shape)) for v in start.links)
        yes = np.ones(place.shape[:2], bool)
        begun.append(Recording("", dt, place, turn, speed, spin, yes[:, 0], ~yes, yes, (place, turn)))
    return Motion(*(poses[:, :, 0] if poses.shape[2] == 1 else poses for poses in repeated(begun, scene, FRAMES)))


def thrown(scene: Scene, starts: Sequence[Start], step: float, values: dict[str, float], inertia: np.ndarray) -> Scene:
    """The bodies of a scene at each start, far from each other on its table, with an engine's parameters.

    Engines with symplectic Euler follow the exact parabola if they start with the velocity of half a step ago.
    `inertia` [3] kg m2 is that of a body.
    """
    table, *things = scene.bodies
    bodies, joints = [replace(table, position=np.array([0.0, 0.0, values["height"]]))], []
    for k, start in enumerate(starts):
        for joint in scene.joints:
            one, other = (of + k * len(things) for of in joint.bodies)
            drag, damping = values["drag"], values["damping_of_hinge"]
            joints.append(replace(joint, name=f"joint{k}", bodies=(one, other), friction=drag, damping=damping))
        for body, place, quat, speed, spin in zip(things, *start.links, strict=True):
            bodies.append(replace(
                body, name=f"{body.name}{k}", position=place + k * APART, quat_xyzw=quat, angular_velocity=spin,
                velocity=speed - 0.5 * step * scene.gravity, scale=values["side"], friction=values["friction"],
                restitution=values.get("restitution", 0.0), inertia=np.diag(values["inertia"] * inertia),
            ))  # fmt: skip
    return replace(scene, bodies=tuple(bodies), joints=tuple(joints))


def moved(world: World, count: int) -> Motion:
    """The motion of `count` thrown things in an engine."""
    poses: list[tuple[np.ndarray, ...]] = []
    for _ in range(FRAMES):
        world.advance(INNER)
        poses.append(world.state()[:2])
    place, quat = (
        np.swapaxes(np.reshape(of, (FRAMES, count, -1, of[0].shape[-1])), 0, 1) for of in zip(*poses, strict=True)
    )
    place = place - APART * np.arange(count)[:, None, None, None]
    return Motion(*(poses[:, :, 0] if poses.shape[2] == 1 else poses for poses in (place, quat)))


def mujoco(
    scene: Scene, inertia: np.ndarray, starts: Sequence[Start], dt: float, values: dict[str, float], *,
    cone: Literal["elliptic", "pyramidal"] = "elliptic",
) -> Motion:  # fmt: skip
    """MuJoCo: contacts are damped springs with a time constant, s, and a damping ratio."""
    step, contact = dt / INNER, (values["softness"], values["damping"])
    world = MujocoWorld(
        thrown(scene, starts, step, values, inertia), step, cone=cone, contact=contact,
        impratio=IMPRATIO if cone == "elliptic" else 1.0,
    )  # fmt: skip
    return moved(world, len(starts))


def bullet(scene: Scene, inertia: np.ndarray, starts: Sequence[Start], dt: float, values: dict[str, float]) -> Motion:
    """PyBullet with default settings."""
    step = dt / INNER
    with BulletWorld(thrown(scene, starts, step, values, inertia), step) as world:
        return moved(world, len(starts))


def drake(scene: Scene, inertia: np.ndarray, starts: Sequence[Start], dt: float, values: dict[str, float]) -> Motion:
    """Drake with point contact."""
    step = dt / INNER
    thing = thrown(scene, starts, step, values, inertia)
    return moved(DrakeWorld(thing, step, 10.0 ** values["stiffness"], values["dissipation"]), len(starts))
