"""Imports robots, and compares the poses of their links, and their motion after an export, with MuJoCo's.

    python -m benchmarks robots [FILE ...]     # else all of pybullet_data but its random solids

For each file: bodies and joints of the scene; the largest distance (mm) and angle (degrees) between MuJoCo's and the
scene's links, which `Simulator.set_joints` moves, over the start and 20 random positions of all joints; the largest
relative difference of masses. For MJCF with actuators, MuJoCo also runs the file and its export for 2 s from the first
keyframe, without contacts: the largest difference of a hinge (rad) or slide (m) at the end, and how often the forces of
actuators change their sign in each.
"""

import math
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from benchmarks.records import Cell, progress, write_record
from sdfsim import Simulator, export, load_scene
from sdfsim.apps.export import plain_names
from sdfsim.apps.import_robot import import_robot
from sdfsim.base.errors import SdfsimError
from sdfsim.scene.scene import Joint, Scene

TRIES = 20
SECONDS = 2.0  # of motion in MuJoCo
ROUNDING = 1e-6  # N or N m: at a keyframe where actuators hold nothing, their forces are noise below this
FREE = 1.0  # rad or m to each side, of joints without limits


def simulator_of(scene: Scene) -> Simulator:
    """A simulator of a scene without what closes loops or couples joints; nothing collides, so no shape is prepared."""
    trees = tuple(joint for joint in scene.joints if not joint.collides)
    bodies = tuple(replace(body, collides_with=()) for body in scene.bodies)
    return Simulator(replace(scene, model="solver", bodies=bodies, joints=trees, couplings=(), keyframes={}))


def poses(simulator: Simulator, q: dict[str, float | np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] m centres of mass and [N, 3, 3] axes of all bodies, in the world, after `set_joints`: roots at their start
    poses, joints at `q` (rad, m; a rotation vector for a ball), by name."""
    if simulator.scene.joints:
        values = simulator.joint_positions
        for name, place in simulator.joint_columns.items():
            values[place] = q.get(name, 0.0)
        simulator.set_joints(values)
    bodies = [simulator[body.name] for body in simulator.scene.bodies]
    turns = Rotation.from_quat([body.quat_xyzw for body in bodies]).as_matrix()
    return np.stack([body.centre for body in bodies]), turns


@dataclass(frozen=True)
class Judged:
    """Differences between a scene and MuJoCo's model of the same file."""

    links: int  # in both
    apart: float  # m, the largest
    turned: float  # rad, the largest
    mass: float  # relative, the largest


def judge(source: Path, scene: Scene, *, tries: int = TRIES, seed: int = 0) -> Judged:
    """Compare a scene with MuJoCo's model of the file that it was made from, at the start and at random positions."""
    import mujoco

    spec = (
        mujoco.MjSpec.from_string(_bare(source)) if source.suffix == ".urdf" else mujoco.MjSpec.from_file(str(source))
    )
    if source.suffix == ".urdf":
        spec.compiler.fusestatic = False
        spec.compiler.balanceinertia = True
    model = spec.compile()
    data = mujoco.MjData(model)
    number = {body.name: k for k, body in enumerate(scene.bodies)}
    ids = {k: model.body(k).name or f"body_{k}" for k in range(1, model.nbody)}
    # Each static geom of MJCF is a body; links without mass are parts of others.
    both = [(k, number[name]) for k, name in ids.items() if name in number and model.body_mass[k] > 0]
    both = [(k, i) for k, i in both if scene.bodies[i].motion == "dynamic"]
    by_name = {joint.name: joint for joint in scene.joints}
    joints = {j: model.joint(j).name for j in range(model.njnt)}  # those without a name stay at zero
    rng = np.random.default_rng(seed)
    start = _set(mujoco, model, data, joints, by_name, None)
    simulator = simulator_of(scene)
    turns = poses(simulator, start)[1]
    first = [(data.xmat[k].reshape(3, 3).copy(), turns[i]) for k, i in both]
    axes = {k: ours.T @ theirs for (k, _), (theirs, ours) in zip(both, first, strict=True)}
    apart = turned = 0.0
    # MuJoCo fixes the root of a URDF at the origin; in a scene it is free at its own pose.
    for trial in range(tries + 1):
        values = start if trial == 0 else _set(mujoco, model, data, joints, by_name, rng, axes)
        places, turns = poses(simulator, values)
        for (k, i), (theirs, ours) in zip(both, first, strict=True):
            apart = max(apart, float(np.linalg.norm(data.xipos[k] - places[i])))
            change = data.xmat[k].reshape(3, 3) @ theirs.T @ (turns[i] @ ours.T).T
            turned = max(turned, float(np.linalg.norm(Rotation.from_matrix(change).as_rotvec())))
    mass = max((abs(_mass(scene, i) / model.body_mass[k] - 1.0) for k, i in both), default=0.0)
    return Judged(len(both), apart, turned, mass)


def there_and_back(source: Path, scene: Path) -> tuple[float, int, int] | None:
    """The largest difference (rad, m) of a joint's position after `SECONDS` in MuJoCo between an MJCF file and an
    export of the `scene` made from it, and how often in each forces of actuators change their sign by more than a
    thousandth of the largest and more than rounding. None if it has no actuators."""
    import mujoco

    export(scene, scene.with_suffix(".xml"), collide="sdf")  # nothing touches: no need to cut meshes
    ends, turns, start = [], [], {}
    keys = mujoco.MjModel.from_xml_path(str(source))
    key = (keys.key(0).name or "key 0") if keys.nkey else "start"
    for file in (scene.with_suffix(".xml"), source):
        spec = mujoco.MjSpec.from_file(str(file))
        for geom in spec.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_SDF:  # its octree would take minutes
                geom.type = mujoco.mjtGeom.mjGEOM_MESH
        model = spec.compile()
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        data, forces = mujoco.MjData(model), []
        if not model.nu:
            return None
        if number := [k for k in range(model.nkey) if (model.key(k).name or f"key {k}") == key]:
            mujoco.mj_resetDataKeyframe(model, data, number[0])
        # Hinges and slides, all from the export's start, which is within limits.
        chosen = np.flatnonzero(model.jnt_type > 1)
        names = plain_names([model.joint(j).name for j in chosen])  # as an export writes them
        single = dict(zip(names, model.jnt_qposadr[chosen], strict=True))
        for name, at in single.items():
            data.qpos[at] = start.setdefault(name, float(data.qpos[at]))
        while data.time < SECONDS - 1e-9:
            mujoco.mj_step(model, data)
            forces.append(data.actuator_force.copy())
        force = np.array(forces)
        least = max(1e-3 * np.abs(force).max(), ROUNDING)
        sign = np.sign(np.where(np.abs(force) > least, force, 0.0))
        turns.append(int((sign[1:] * sign[:-1] < 0).sum()))
        ends.append({name: float(data.qpos[at]) for name, at in single.items()})
    return max(abs(ends[0][name] - end) for name, end in ends[1].items() if name in ends[0]), turns[1], turns[0]


def _mass(scene: Scene, k: int) -> float:
    """kg, of a body including the small balls that have a part of its mass."""
    name = scene.bodies[k].name
    balls = [b for b in scene.bodies if b.collides_with == () and b.name.startswith(f"{name}_")]
    chain = [b for b in balls if b.name.removeprefix(f"{name}_") in {joint.name for joint in scene.joints}]
    return scene.bodies[k].mass + sum(b.mass for b in chain)


def _set(
    mujoco, model, data, joints, known: dict[str, Joint], rng: np.random.Generator | None,
    shape_axes: dict[int, np.ndarray] | None = None,
) -> dict:  # fmt: skip
    """Set joints to the scene's start, or at random within limits, and return their positions; `shape_axes` by body map
    the axes of its link to those of its shape."""
    mujoco.mj_resetData(model, data)
    if "start" in (keys := [model.key(k).name for k in range(model.nkey)]):
        mujoco.mj_resetDataKeyframe(model, data, keys.index("start"))
    values: dict[str, float | np.ndarray] = {}
    for j, name in joints.items():
        at, kind = int(model.jnt_qposadr[j]), mujoco.mjtJoint(int(model.jnt_type[j]))
        if kind == mujoco.mjtJoint.mjJNT_FREE or name not in known:
            continue
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            turn = np.zeros(3) if rng is None else rng.normal(size=3)
            data.qpos[at : at + 4] = np.roll(Rotation.from_rotvec(turn).as_quat(), 1)
            # MuJoCo's rotation is in the link's axes, which may differ from those of the body's shape.
            own = Rotation.from_quat(known[name].quat_xyzw[0]).inv()
            values[name] = own.apply(shape_axes[int(model.jnt_bodyid[j])] @ turn) if shape_axes else turn
            continue
        low, high = model.jnt_range[j] if model.jnt_limited[j] else (-FREE, FREE)
        value = float(data.qpos[at]) if rng is None else float(rng.uniform(low, high))
        if rng is None and model.jnt_limited[j]:
            value = min(max(value, low), high)
        data.qpos[at] = values[name] = value
    mujoco.mj_forward(model, data)
    return values


def _bare(source: Path) -> str:
    """A URDF without geometry, because MuJoCo finds no meshes by ROS paths, and masses and joints do not need them.
    Text outside of the XML is removed, and ROS' defaults replace environment variables."""
    text = source.read_bytes().decode(errors="replace").strip(" \t\r\n\0")
    root = ElementTree.fromstring(re.sub(r"\$\(optenv +\w+([^()]*)\)", r"\1", text).encode())
    for link in root.findall("link"):
        for tag in ("visual", "collision"):
            for child in link.findall(tag):
                link.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


def main(files: Annotated[list[Path] | None, typer.Argument()] = None) -> None:
    """A row for each URDF or MJCF file; by default for those of pybullet_data. Those that are refused come first."""
    refused: list[tuple[Cell, ...]] = []
    rows: list[tuple[Cell, ...]] = []
    files = files or _all()
    for k, file in enumerate(files):
        progress(k / len(files), name := f"{file.parent.name}/{file.name}")
        with tempfile.TemporaryDirectory() as folder:
            try:
                import_robot(file, out := Path(folder) / "scene.yaml")
                moved = there_and_back(file, out) if file.suffix != ".urdf" else None
                scene = load_scene(out)
            except (SdfsimError, ValueError) as error:
                message = error.message if isinstance(error, SdfsimError) else f"MuJoCo: {str(error).splitlines()[0]}"
                refused.append((name, *[""] * 8, message.replace(f"{file.parent}/", "")[:150]))
                continue
        counts = (name, len(scene.bodies), len(scene.joints))
        try:
            found = judge(file, scene)
        except ValueError as error:
            refused.append((*counts, *[""] * 6, f"MuJoCo: {str(error).splitlines()[0][:100]}"))
            continue
        apart = 1e3 * found.apart, math.degrees(found.turned)
        there = ("", "") if moved is None else (moved[0], f"{moved[1]} / {moved[2]}")
        rows.append((*counts, found.links, *apart, found.mass, *there, ""))
    columns = (
        "file", "bodies", "joints", "links compared", "apart, mm", "turned, degrees", "masses, relative",
        "after 2 s of the export", "sign changes",
    )  # fmt: skip
    measured = f"Largest differences from MuJoCo's models, over the start and {TRIES} random joint configurations."
    write_record("robots", "python -m benchmarks robots", measured, (*columns, "refused"), [*refused, *rows])


def _all() -> list[Path]:
    import pybullet_data

    data = Path(pybullet_data.getDataPath())
    found = [*data.rglob("*.urdf"), *(data / "mjcf").glob("*.xml")]
    return sorted(file for file in found if "random_urdfs" not in file.parts)
