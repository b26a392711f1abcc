"""Shared by tosses of a cube and of an elbow: how they are split and compared, and simulations of a box, or two on a
hinge, by ours, MuJoCo and PyBullet."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation

from sdfsim.apps.identify import repeated
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays
from sdfsim.base.lazy import optional
from sdfsim.data.public_tosses import ARM, PIVOT, links_of
from sdfsim.data.pybullet_sim import import_pybullet
from sdfsim.evaluation.metrics import interval
from sdfsim.scene.scene import Scene

FRAMES = 75  # compared: half a second
FIT, TEST, SEED = 60, 100, 0
CLEAR = 0.005  # m: a body higher than this over z = 0 flies; the table is 1 to 6 mm lower
FLIGHT = 6  # frames at least, to fit a start to
INNER = 5  # inner steps of every engine in a frame
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
class Thing:
    """The thrown object: a box, or two on a hinge, from `links_of`."""

    sides: np.ndarray  # [3] m, of a box
    mass: float  # kg, of a box
    inertia: np.ndarray  # [3] kg m2, of a box
    hinged: bool = False


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


Engine = Callable[[Sequence[Start], float, np.ndarray, dict[str, float]], Motion]  # starts, dt, gravity [3], values


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


def half_a_step_ago(start: Start, step: float, gravity: np.ndarray) -> np.ndarray:
    """The velocity [3] of the first link with which engines with symplectic Euler follow the exact parabola."""
    return start.links[2][0] - 0.5 * step * gravity


def _hinge(start: Start) -> tuple[float, float]:
    """Angle rad and rate rad/s of a hinge at a start."""
    _, quat, _, spin = start.links
    turns = Rotation.from_quat(quat)
    angle = (turns[0].inv() * turns[1]).as_rotvec()[1]
    return float(angle), float((spin[1] - spin[0]) @ turns[0].apply([0.0, 1.0, 0.0]))


def _moved(place: np.ndarray, quat: np.ndarray, angle: np.ndarray | None) -> Motion:
    """The motion from the poses [B, T, *] of the first link, and the angles [B, T] of the hinge, if there is one."""
    if angle is None:
        return Motion(place, quat)
    count = place.shape[:2]
    links = links_of(place.reshape(-1, 3), Rotation.from_quat(quat.reshape(-1, 4)), angle.reshape(-1))
    return Motion(*(poses.reshape(*count, *poses.shape[1:]) for poses in links))


def mujoco(
    thing: Thing, starts: Sequence[Start], dt: float, gravity: np.ndarray, values: dict[str, float], *,
    elliptic: bool = True,
) -> Motion:  # fmt: skip
    """MuJoCo: contacts are damped springs with a time constant, s, and a damping ratio; its friction cone is elliptic
    or a pyramid."""
    engine, rollout = (optional(name, "MuJoCo", "bench") for name in ("mujoco", "mujoco.rollout"))
    spec, step = engine.MjSpec(), dt / INNER
    spec.option.timestep, spec.option.gravity = step, gravity
    spec.option.cone = engine.mjtCone.mjCONE_ELLIPTIC if elliptic else engine.mjtCone.mjCONE_PYRAMIDAL
    spec.option.impratio = IMPRATIO if elliptic else 1.0
    table = spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0], pos=[0, 0, values["height"]])
    table.contype, table.conaffinity = 1, 2
    own = {"mass": thing.mass, "inertia": (values["inertia"] * thing.inertia).tolist(), "explicitinertial": True}
    one = spec.worldbody.add_body(**own)
    one.add_freejoint()
    boxes = [(one, np.zeros(3))]
    if thing.hinged:
        two = one.add_body(pos=PIVOT, ipos=ARM, **own)
        hinge = two.add_joint(type=engine.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], frictionloss=values["drag"])
        hinge.damping = np.array([values["damping_of_hinge"], 0.0, 0.0])
        boxes.append((two, ARM))
    for body, place in boxes:
        geom = body.add_geom(type=engine.mjtGeom.mjGEOM_BOX, size=0.5 * values["side"] * thing.sides, pos=place)
        geom.priority, geom.condim, geom.friction[0] = 1, 3, values["friction"]
        geom.solref = [max(values["softness"], 2.0 * step), values["damping"]]
        geom.contype, geom.conaffinity = 2, 1  # they meet the table alone
    model, state = spec.compile(), []
    for start in starts:
        place, quat, _, spin = (of[0] for of in start.links)
        angle, rate = ([value] for value in _hinge(start)) if thing.hinged else ([], [])
        turning = Rotation.from_quat(quat).inv().apply(spin)
        fall = half_a_step_ago(start, step, gravity)
        state.append([0.0, *place, *np.roll(quat, 1), *angle, *fall, *turning, *rate])
    found = rollout.rollout(model, engine.MjData(model), np.array(state), nstep=FRAMES * INNER)[0][
        :, INNER - 1 :: INNER
    ]
    return _moved(found[..., 1:4], np.roll(found[..., 4:8], -1, axis=-1), found[..., 8] if thing.hinged else None)


def bullet(thing: Thing, starts: Sequence[Start], dt: float, gravity: np.ndarray, values: dict[str, float]) -> Motion:
    """PyBullet with default settings."""
    engine = import_pybullet()
    client, step = engine.connect(engine.DIRECT), dt / INNER
    here: dict[str, Any] = {"physicsClientId": client}
    try:
        engine.setGravity(*gravity, **here)
        engine.setTimeStep(step, **here)
        plane = engine.createCollisionShape(engine.GEOM_PLANE, **here)
        table = engine.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, values["height"]], **here)
        engine.changeDynamics(table, -1, lateralFriction=1.0, restitution=1.0, **here)
        engine.setCollisionFilterGroupMask(table, -1, 1, 2, **here)
        form: dict[str, Any] = {"halfExtents": (0.5 * values["side"] * thing.sides).tolist(), **here}
        box, held, damped = engine.createCollisionShape(engine.GEOM_BOX, **form), {}, {}
        if thing.hinged:
            other = engine.createCollisionShape(engine.GEOM_BOX, collisionFramePosition=ARM.tolist(), **form)
            held = {
                "linkMasses": [thing.mass], "linkCollisionShapeIndices": [other], "linkVisualShapeIndices": [-1],
                "linkPositions": [PIVOT.tolist()], "linkOrientations": [[0, 0, 0, 1]],
                "linkInertialFramePositions": [ARM.tolist()], "linkInertialFrameOrientations": [[0, 0, 0, 1]],
                "linkParentIndices": [0], "linkJointTypes": [engine.JOINT_REVOLUTE], "linkJointAxis": [[0, 1, 0]],
            }  # fmt: skip
            damped = {"jointDamping": values["damping_of_hinge"]}
        made = []
        for start in starts:
            place, quat, _, spin = start.links
            one = engine.createMultiBody(thing.mass, box, -1, place[0], quat[0], **held, **here)
            for link in range(-1, len(place) - 1):
                engine.changeDynamics(
                    one, link, localInertiaDiagonal=(values["inertia"] * thing.inertia).tolist(),
                    lateralFriction=values["friction"], restitution=values["restitution"], linearDamping=0.0,
                    angularDamping=0.0, **damped, **here,
                )  # fmt: skip
                engine.setCollisionFilterGroupMask(one, link, 2, 1, **here)  # they meet the table alone
            if thing.hinged:
                engine.resetJointState(one, 0, *_hinge(start), **here)
                drag = {"targetVelocity": 0.0, "force": values["drag"]}
                engine.setJointMotorControl2(one, 0, engine.VELOCITY_CONTROL, **drag, **here)
            engine.resetBaseVelocity(one, half_a_step_ago(start, step, gravity), spin[0], **here)
            made.append(one)
        poses, angles = [], []
        for _ in range(FRAMES):
            for _ in range(INNER):
                engine.stepSimulation(**here)
            poses.append([np.concatenate(engine.getBasePositionAndOrientation(one, **here)) for one in made])
            angles.append([engine.getJointState(one, 0, **here)[0] for one in made] if thing.hinged else [])
    finally:
        engine.disconnect(client)
    pose = np.swapaxes(np.array(poses), 0, 1)
    return _moved(pose[..., :3], pose[..., 3:], np.swapaxes(np.array(angles), 0, 1) if thing.hinged else None)
