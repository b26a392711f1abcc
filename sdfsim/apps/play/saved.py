"""A scene as it is at a moment, as a folder with scene.yaml and its shapes; and a run of it as a run folder."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from sdfsim.apps.export import plain_names
from sdfsim.apps.run import summary
from sdfsim.base.console import plain as plain_report
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import CONFIG, check_own, check_writable, write_json, write_text
from sdfsim.physics import pose
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import SceneBuilder, plain
from sdfsim.scene.joints import joint_axes
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import WORLD, Body, Coupling, Frame, Joint, Keyframe, Scene, fingerprints
from sdfsim.sdf.closed_forms import ClosedForm, sizes_in_scene
from sdfsim.shape.shape import Shape
from sdfsim.simulate.looks import is_infinite
from sdfsim.simulate.record import Recording, at_frame
from sdfsim.simulate.simulator import Simulator

SCENE = "scene.yaml"


def save_scene(scene: Scene, folder: Path) -> Path:
    """Write a scene to `folder`/scene.yaml, with a Shape folder for each shape that is not a ball, box, capsule or
    cylinder, and return the file. Raises SdfsimError if it cannot be written, or if an SDF has no file format."""
    check_writable(folder)
    effects = {name: value for name, value in vars(scene.effects).items() if value != "auto"}
    settings: dict[str, Any] = {"gravity": scene.gravity, "duration": scene.duration, "seed": scene.seed}
    built = SceneBuilder(**settings, **({"effects": effects} if effects else {}), model=scene.model)
    used = {body.shape for body in scene.bodies if not is_infinite(scene.shapes[body.shape])}
    files = plain_names([shape.name for shape in scene.shapes])
    for number in sorted(used):
        built.shapes[files[number]] = plain(_shape(scene.shapes[number], folder / "shapes" / files[number]))
    built.bodies = [plain(_body(body, scene.shapes[body.shape], files[body.shape])) for body in scene.bodies]
    built.joints = [plain(_joint(scene, joint)) for joint in scene.joints]
    built.frames = [plain(_frame(scene, frame)) for frame in scene.frames]
    built.couplings = [plain(_coupling(scene, coupling)) for coupling in scene.couplings]
    built.keyframes = {name: plain(_keyframe(scene, keyframe)) for name, keyframe in scene.keyframes.items()}
    folder.mkdir(parents=True, exist_ok=True)
    return built.save(folder / SCENE)


def write_run(scene: Scene, rollout: Rollout, folder: Path) -> Path:
    """Write the motion of a scene, whose bodies are as in the first frame, as a run folder that the other commands
    read. Returns the folder. Raises SdfsimError as `save_scene` does, and if the folder holds other results."""
    check_own(folder, "play", "rollout.npz", "report.json")
    file = save_scene(scene, folder).resolve()
    known = load_scene(file)  # with the rounding of the file
    rollout = replace(rollout, time=rollout.time - rollout.time[0], meta=rollout.meta | {"scene": fingerprints(known)})
    config = {"command": "play", "scene": str(file), "model": rollout.meta["model"], "seed": rollout.meta["seed"],
              "seconds": float(rollout.time[-1]), "device": rollout.meta["device"]}  # fmt: skip
    write_text(folder / CONFIG, yaml.safe_dump(config, sort_keys=False))
    report = summary(known, rollout, float(rollout.time[-1])) | {"status": "done", "folder": folder}
    rollout.save(folder / "rollout.npz")
    write_json(folder / "report.json", plain_report(report))
    return folder


def save_run(simulator: Simulator, run: Recording | Rollout, folder: Path | str) -> Path:
    """Write a recording of a simulator as a run folder, which `view`, `render`, `export` and `identify` read: its
    motion, with joints, efforts and forces, and its scene as it was in the first frame. Returns the folder. Raises
    SdfsimError if the recording has no step or is of other bodies, or if the folder holds other results."""
    rollout = run.rollout if isinstance(run, Recording) else run
    if rollout.names != tuple(body.name for body in simulator.scene.bodies):
        raise SdfsimError(
            "run: its bodies are not those of the simulator", "save it before bodies are added or removed"
        )
    if not len(rollout):
        raise SdfsimError("run: has no step", "make steps inside the block: with simulator.record() as run: ...")
    return write_run(at_frame(simulator.scene, rollout), rollout, Path(folder))


def _shape(shape: Shape, folder: Path) -> dict[str, Any]:
    if set(shape.source) == {"kind"} and isinstance(shape.sdf, ClosedForm):
        return {shape.sdf.KIND: sizes_in_scene(shape.sdf)}
    return {"asset": shape.save(folder).resolve()}


def _body(body: Body, shape: Shape, name: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": body.name, "friction": body.friction, "restitution": body.restitution}
    entry |= {} if body.color is None else {"color": [*body.color]}
    entry |= {"stiffness": body.stiffness, "damping": body.damping} if math.isfinite(body.stiffness) else {}
    if body.collides_with is not None:
        entry["collides_with"] = list(body.collides_with)
    if is_infinite(shape):
        normal = pose.rotate(body.quat_xyzw, np.array([0.0, 0.0, 1.0]))
        return entry | {"plane": {"normal": normal, "offset": float(normal @ body.position)}}
    entry |= {"shape": name, "motion": body.motion, "scale": body.scale}
    if body.path is not None:
        poses = zip(body.path.time, body.path.position, body.path.quat_xyzw, strict=True)
        return entry | {"path": [{"time": t, "position": place, "quat_xyzw": turn} for t, place, turn in poses]}
    entry |= {"position": body.position, "quat_xyzw": body.quat_xyzw}
    if body.motion == "dynamic":
        entry |= {"velocity": body.velocity, "angular_velocity": body.angular_velocity, "mass": body.mass}
        if body.inertia is not None:
            even = body.mass / shape.volume * body.scale**2 * shape.inertia
            entry["inertia_factor"] = float(np.trace(body.inertia) / np.trace(even))
    return entry


def _frame(scene: Scene, frame: Frame) -> dict[str, Any]:
    body = WORLD if frame.body < 0 else scene.bodies[frame.body].name
    return {"name": frame.name, "body": body, "position": frame.position, "quat_xyzw": frame.quat_xyzw}


def _coupling(scene: Scene, coupling: Coupling) -> dict[str, Any]:
    first, second = (scene.joints[j] for j in coupling.joints)
    offset = {"offset_deg": np.degrees(coupling.offset)} if first.kind == "hinge" else {"offset": coupling.offset}
    return {"joints": [first.name, second.name], "ratio": coupling.ratio, **offset}


def _keyframe(scene: Scene, keyframe: Keyframe) -> dict[str, Any]:
    """A keyframe; the rotations of its balls count from the saved pose."""
    keys: dict[str, dict[str, Any]] = {key: {} for key in ("angles_deg", "positions", "quats_xyzw", "speeds", "spins")}
    for joint in scene.joints:
        value, speed = keyframe.joints.get(joint.name), keyframe.speeds.get(joint.name)
        if joint.kind == "ball":
            old = [Rotation.from_quat(quat) for quat in joint.quat_xyzw]
            bodies = [Rotation.from_quat([0, 0, 0, 1] if k < 0 else scene.bodies[k].quat_xyzw) for k in joint.bodies]
            axis = (bodies[0] * old[0]).as_matrix()[:, 0] if joint.limits is not None else None
            one, other = (was.inv() * body.inv() * joint_axes(axis) for was, body in zip(old, bodies, strict=True))
            value = None if value is None else (other.inv() * Rotation.from_quat(value) * one).as_quat()
            speed = None if speed is None else other.inv().apply(speed)
        hinge = joint.kind == "hinge"
        what = {"hinge": "angles_deg", "slider": "positions"}.get(joint.kind, "quats_xyzw")
        keys[what] |= {} if value is None else {joint.name: np.degrees(value) if hinge else value}
        keys["spins" if joint.kind == "ball" else "speeds"] |= {} if speed is None else {joint.name: speed}
    names = ("position", "quat_xyzw", "velocity", "angular_velocity")
    bodies = {name: dict(zip(names, at, strict=True)) for name, at in keyframe.bodies.items()}
    return {**keys, "bodies": bodies, "targets": keyframe.targets}


def _joint(scene: Scene, joint: Joint) -> dict[str, Any]:
    """A joint in the frame of its first body, with both bodies where they are now."""
    first, second = (WORLD if k < 0 else scene.bodies[k].name for k in joint.bodies)
    entry: dict[str, Any] = {"name": joint.name, "type": joint.kind, "bodies": [first, second]}
    entry |= {"frame": first, "anchor": joint.anchor[0]}
    body, hinge, limits = scene.bodies[joint.bodies[0]], joint.kind == "hinge", joint.limits

    def angles(name: str, value: Any) -> dict[str, Any]:
        return {f"{name}_deg": np.degrees(value)} if hinge else {name: value}

    if joint.kind in ("hinge", "slider"):
        entry |= angles("start", joint.start) | ({} if limits is None else angles("limits", limits))
    if joint.kind in ("hinge", "slider") or (joint.kind == "ball" and limits is not None):
        entry["axis"] = pose.rotate(joint.quat_xyzw[0], np.array([1.0, 0.0, 0.0]))
    if joint.kind == "ball" and limits is not None:
        entry["cone_deg"] = math.degrees(limits[1])
    if joint.kind == "distance":
        end = joint.anchor[1]
        if joint.bodies[1] >= 0:
            other = scene.bodies[joint.bodies[1]]
            end = other.position + pose.rotate(other.quat_xyzw, end)
        entry["to"] = pose.rotate(pose.conjugate(body.quat_xyzw), end - body.position)
        entry |= {} if joint.length is None else {"rod": joint.length}
        entry |= {} if limits is None or joint.length is not None else {"rope": limits[1]}
    numbers = {"restitution": joint.restitution, "damping": joint.damping, "friction": joint.friction,
               "armature": joint.armature}  # fmt: skip
    entry |= {name: value for name, value in numbers.items() if value}
    if joint.spring is not None:
        entry["spring"] = {"stiffness": joint.spring.stiffness} | angles("rest", joint.spring.rest)
    if (motor := joint.motor) is not None:
        entry["motor"] = {"max_force": motor.max_force, "gain": motor.gain, "speed": motor.speed}
        entry["motor"] |= {} if motor.speed is not None else {"time": motor.time}
        entry["motor"] |= {} if motor.position is None else angles("position", motor.position)
    loads = {"force": joint.breaks_force, "torque": joint.breaks_torque}
    loads = {name: most for name, most in loads.items() if math.isfinite(most)}
    entry |= {"breaks_at": loads} if loads else {}
    return entry | ({"collide": "on"} if joint.collides else {})
