"""Joints of a scene in the formats of `export`: nested bodies in MJCF, links in URDF, joints in UsdPhysics."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.geometry.gltf import GltfWriter
from sdfsim.physics.joint_space import spanning
from sdfsim.scene.scene import Body, Joint, Scene

NESTING = ("hinge", "slider", "ball", "fixed")  # kinds of joints by which one body can hold another in a tree
KEEN = 20.0  # s/rad or s/m: gain of a motor, its largest force divided by the speed error at which it gives this force
LEAST_TIME = 1e-3  # s: shorter times to a position give no larger stiffness
GLTF_PHYSICS = "KHR_physics_rigid_bodies"
EFFORT = 1e6  # N m or N, and rad/s or m/s: URDF requires limits, so these are given where there are none


@dataclass(frozen=True)
class Held:
    """A joint between a child and its parent; reversed if the scene names the child second."""

    joint: Joint
    parent: int  # -1: the world
    anchor: np.ndarray  # [3] m, in the child
    frame: Rotation  # the joint's axes, in the child
    parent_anchor: np.ndarray  # [3] m, in the parent
    parent_frame: Rotation
    sense: float  # -1 if it is reversed: its axis then points the other way

    def axis(self) -> np.ndarray:
        """[3] in the child."""
        return self.frame.apply([self.sense, 0.0, 0.0])


def held(joint: Joint, child: int) -> Held:
    """A joint, with one of its bodies as the child."""
    own = 0 if joint.bodies[0] == child else 1
    frames = [Rotation.from_quat(quat) for quat in joint.quat_xyzw]
    return Held(
        joint, joint.bodies[1 - own], joint.anchor[own], frames[own], joint.anchor[1 - own], frames[1 - own],
        1.0 if own == 0 else -1.0,
    )  # fmt: skip


@dataclass(frozen=True)
class Trees:
    """The bodies of a scene as trees: which body holds which, and the other joints, which close loops."""

    order: tuple[int, ...]  # all bodies, each after its parent, in depth-first order
    above: dict[int, Held]  # the joints of bodies that are held
    loops: tuple[Joint, ...]  # the other joints, including distances

    def root(self, k: int) -> int:
        """The root of a body's tree, -1 for the world."""
        while k in self.above:
            k = self.above[k].parent
        return k


def trees(scene: Scene) -> Trees:
    """Trees whose roots are the world and bodies that are not dynamic, then those of free bodies."""
    still = [k for k, body in enumerate(scene.bodies) if body.motion != "dynamic"]
    ends = [joint.bodies if joint.kind in NESTING else None for joint in scene.joints]
    used = spanning(ends, still, len(scene.bodies))
    above = {k: held(scene.joints[j], k) for j, k in used}
    below: dict[int, list[int]] = {}
    for k in sorted(above):
        below.setdefault(above[k].parent, []).append(k)
    order: list[int] = []
    stack = sorted((k for k in range(len(scene.bodies)) if k not in above or above[k].parent < 0), reverse=True)
    while stack:
        k = stack.pop()
        order.append(k)
        stack += reversed(below.get(k, ()))
    return Trees(tuple(order), above, tuple(j for n, j in enumerate(scene.joints) if n not in dict(used)))


def place(body: Body | None) -> tuple[np.ndarray, Rotation]:
    """Pose of a body at the start, or of the world."""
    return (np.zeros(3), Rotation.identity()) if body is None else (body.position, Rotation.from_quat(body.quat_xyzw))


def _body(scene: Scene, k: int) -> Body | None:
    return scene.bodies[k] if k >= 0 else None


def _speed(scene: Scene, k: int, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity [3] m/s of a body at a point in the world, and its angular velocity [3] rad/s."""
    body = _body(scene, k)
    if body is None or body.motion != "dynamic":
        return np.zeros(3), np.zeros(3)
    centre = body.position + Rotation.from_quat(body.quat_xyzw).apply(body.scale * scene.shapes[body.shape].com)
    return body.velocity + np.cross(body.angular_velocity, point - centre), body.angular_velocity


def speed_of(scene: Scene, one: Held, child: int) -> np.ndarray:
    """[0, 1 or 3] rad/s or m/s: the joint's speed at the start; for a ball in the axes of the child."""
    here, turn = place(scene.bodies[child])
    point = here + turn.apply(one.anchor)
    (fast, spin), (carried, turned) = _speed(scene, child, point), _speed(scene, one.parent, point)
    axis = turn.apply(one.axis())
    kinds = {"hinge": [axis @ (spin - turned)], "slider": [axis @ (fast - carried)]}
    return turn.inv().apply(spin - turned) if one.joint.kind == "ball" else np.array(kinds.get(one.joint.kind, []))


def left_out(
    scene: Scene, *, breaks: bool = True, mjcf: bool = False, coupled: bool = True, spring_of: Sequence[str] = ()
) -> list[str]:
    """What only our own format has of joints, or also `mjcf` or formats with couplings, one line each."""
    joints = scene.joints
    lines = {
        "the loads at which joints break": breaks
        and any(np.isfinite([j.breaks_force, j.breaks_torque]).any() for j in joints),
        "the restitution of joints' limits": any(j.restitution for j in joints),
        "armature of joints": not mjcf and any(j.armature for j in joints),
        "keyframes": not mjcf and bool(scene.keyframes),
        "couplings of joints": not coupled and bool(scene.couplings),
    }
    lines |= {f"springs of {kind}s": any(j.kind == kind and j.spring for j in joints) for kind in spring_of}
    return [line for line, there in lines.items() if there]


def gains(joint: Joint) -> tuple[float, float]:
    """Stiffness and damping of a motor for programs that know nothing else, N m/rad and N m s/rad (or N/m and N s/m);
    0 if it has no target."""
    motor = joint.motor
    if motor is None or (motor.speed is None and motor.position is None):
        return 0.0, 0.0
    if motor.speed is not None:
        return 0.0, motor.gain or KEEN * motor.max_force
    kp = motor.gain or KEEN * motor.max_force / max(motor.time, LEAST_TIME)
    return kp, kp * motor.time


# --- MJCF ---


def numbers(*values: Any) -> str:
    """Numbers and arrays as an XML attribute."""
    return " ".join(f"{value + 0.0:.12g}" for value in np.concatenate([np.ravel(value) for value in values]))


def add(parent: Element, tag: str, **attributes: str) -> Element:
    return SubElement(parent, tag, attributes)


def mjcf_pose(scene: Scene, tree: Trees, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] m and quaternion [4] xyzw of a body in the frame of its parent, at the start."""
    here, turn = place(scene.bodies[k])
    there, other = place(_body(scene, tree.above[k].parent) if k in tree.above else None)
    return other.inv().apply(here - there), (other.inv() * turn).as_quat()


def mjcf_joint(node: Element, one: Held, name: str) -> None:
    """Write the joint that holds a body."""
    joint = one.joint
    if joint.kind == "fixed":
        return
    keys = {"type": {"hinge": "hinge", "slider": "slide", "ball": "ball"}[joint.kind], "pos": numbers(one.anchor)}
    if joint.kind != "ball":
        keys |= {"axis": numbers(one.axis()), "ref": numbers(joint.start)}
    drags = {"damping": joint.damping, "frictionloss": joint.friction, "armature": joint.armature}
    keys |= {key: numbers(value) for key, value in drags.items() if value}
    if joint.limits is not None:
        keys |= {"limited": "true", "range": numbers(joint.limits)}
    if joint.spring is not None:
        keys |= {"stiffness": numbers(joint.spring.stiffness), "springref": numbers(joint.spring.rest)}
    add(node, "joint", name=name, **keys)


def mjcf_state(scene: Scene, posed: Scene, tree: Trees) -> dict[str, str]:
    """The attributes qpos, qvel and ctrl of a keyframe for bodies and joints as in `posed`; the model has them as in
    `scene`."""
    joints = {joint.name: joint for joint in posed.joints}
    places, speeds = [], []
    for k in tree.order:
        (here, turn), body, one = place(posed.bodies[k]), posed.bodies[k], tree.above.get(k)
        if body.motion == "dynamic" and one is None:
            # Velocity of the body's own origin, in world axes; and angular velocity, in body axes.
            arm = turn.apply(body.scale * scene.shapes[body.shape].com)
            fast = body.velocity - np.cross(body.angular_velocity, arm)
            places += [here, np.roll(body.quat_xyzw, 1)]
            speeds += [fast, turn.inv().apply(body.angular_velocity)]
        elif one is not None and one.joint.kind != "fixed":
            before, now = (Rotation.from_quat(mjcf_pose(of, tree, k)[1]) for of in (scene, posed))
            ball = one.joint.kind == "ball"
            places.append(np.roll((before.inv() * now).as_quat(), 1) if ball else [joints[one.joint.name].start])
            speeds.append(speed_of(posed, one, k))
    motors = [j.motor for j in posed.joints if j.motor and j.name not in {joint.name for joint in tree.loops}]
    goals = [motor.speed if motor.speed is not None else motor.position or 0.0 for motor in motors]
    found = {"qpos": places, "qvel": speeds, "ctrl": goals}
    return {key: numbers(*values) for key, values in found.items() if values}


def mjcf_rest(
    root: Element, sites: Sequence[Element], scene: Scene, tree: Trees, bodies: Sequence[str], names: dict[str, str],
    step: float,
) -> list[str]:  # fmt: skip
    """Write loops, distances, motors and excluded contacts. Returns what is left out. `sites` are the
    elements of the bodies, the world's last; `bodies` and `names` are the names of bodies and joints, `step`
    [s] is MuJoCo's."""
    lines = left_out(scene, mjcf=True)
    tags = ("equality", "tendon", "actuator", "contact")
    into = {tag: Element(tag) for tag in tags}

    def end(joint: Joint, side: int) -> str:
        name = f"{names[joint.name]}_end{side}"
        add(sites[joint.bodies[side]], "site", name=name, pos=numbers(joint.anchor[side]), size="0.002")
        return name

    for joint in tree.loops:
        name = names[joint.name]
        if joint.kind == "distance":
            keys: dict[str, str] = {}
            if joint.limits is not None:
                keys |= {"limited": "true", "range": numbers(joint.limits)}
            if joint.spring is not None:
                keys |= {"stiffness": numbers(joint.spring.stiffness), "springlength": numbers(joint.spring.rest)}
            keys |= {"damping": numbers(joint.damping)} if joint.damping else {}
            rope = add(into["tendon"], "spatial", name=name, width="0.003", **keys)
            for side in (0, 1):
                add(rope, "site", site=end(joint, side))
            if joint.length is not None:
                add(into["equality"], "tendon", name=f"{name}_rod", tendon1=name)
            continue
        one = held(joint, joint.bodies[0])
        ends = {"body1": bodies[joint.bodies[0]]} | ({"body2": bodies[one.parent]} if one.parent >= 0 else {})
        if joint.kind == "fixed":
            add(into["equality"], "weld", name=name, **ends, anchor=numbers(np.zeros(3)))
        elif joint.kind == "slider":
            lines.append(f"slider {joint.name}, which closes a loop")
        else:  # a hinge is held at two points of its axis
            points = [one.anchor] if joint.kind == "ball" else [one.anchor + s * 0.1 * one.axis() for s in (-1.0, 1.0)]
            for number, point in enumerate(points):
                add(
                    into["equality"], "connect", name=name + (f"_{number}" if number else ""), **ends,
                    anchor=numbers(point),
                )  # fmt: skip
            if joint.limits or joint.damping or joint.friction or joint.spring or joint.motor:
                lines.append(f"limits, damping, friction, spring and motor of {joint.name}, which closes a loop")
    for coupling in scene.couplings:
        one, other = (scene.joints[j] for j in coupling.joints)
        if one in tree.loops or other in tree.loops:
            lines.append(f"the coupling of {one.name} and {other.name}: one of them closes a loop")
            continue
        shift = coupling.offset + coupling.ratio * other.start - one.start  # MuJoCo counts from the start
        add(into["equality"], "joint", name=f"{names[one.name]}_coupling", joint1=names[one.name],
            joint2=names[other.name], polycoef=numbers((shift, coupling.ratio, 0.0, 0.0, 0.0)))  # fmt: skip
    for joint in scene.joints:
        first, second = joint.bodies
        if joint.collides and any(one.joint is joint for one in tree.above.values()):
            lines.append(f"that bodies of {joint.name} touch each other")
        elif not joint.collides and second >= 0 and "dynamic" == scene.bodies[first].motion:
            add(into["contact"], "exclude", body1=bodies[first], body2=bodies[second])
        if joint.motor is None or joint in tree.loops:
            continue
        kp, kv = gains(joint)
        keys = {"name": f"{names[joint.name]}_motor", "joint": names[joint.name]}
        keys |= {"forcerange": numbers((-joint.motor.max_force, joint.motor.max_force))}
        if joint.motor.speed is not None:
            add(into["actuator"], "velocity", kv=numbers(kv), **keys)
        elif joint.motor.position is not None:
            add(into["actuator"], "position", kp=numbers(kp), kv=numbers(kv), **keys)
        else:  # no target is set
            add(into["actuator"], "motor", **keys)
    if any(joint.kind == "ball" and joint.limits for joint in scene.joints):
        lines.append("that a cone bounds only the lean of a ball: MuJoCo bounds its whole rotation")
    for held_so in into["equality"]:  # as stiff as the step allows: here they are rigid
        held_so.attrib |= {"solref": numbers(2.0 * step, 1.0), "solimp": "0.99 0.999 0.001"}
    for tag in tags:
        before = root.find(tag)
        if len(into[tag]) and before is not None:
            before.extend(into[tag])
        elif len(into[tag]):
            root.append(into[tag])
    return lines


# --- URDF ---


def urdf_joint(root: Element, one: Held, child: int, names: dict[str, str], links: dict[int, str],
               origin: np.ndarray, scene: Scene) -> None:  # fmt: skip
    """Write the joint that holds a link; `origin` [3] m is that of the parent's link in the parent's body."""
    joint = one.joint
    bounded = joint.limits is not None and joint.kind != "ball"
    kinds = {"hinge": "revolute" if bounded else "continuous", "slider": "prismatic", "ball": "spherical"}
    made = add(root, "joint", name=names[joint.name], type=kinds.get(joint.kind, "fixed"))
    add(made, "parent", link=links[one.parent])
    add(made, "child", link=links[child])
    turn = one.parent_frame * one.frame.inv()
    add(made, "origin", xyz=numbers(one.parent_anchor - origin), rpy=numbers(turn.as_euler("xyz")))
    if joint.kind in ("hinge", "slider"):
        add(made, "axis", xyz=numbers(one.axis()))
        low, high = joint.limits or (-EFFORT, EFFORT)
        effort = EFFORT if joint.motor is None else joint.motor.max_force
        ends = {} if joint.kind == "hinge" and not bounded else {"lower": numbers(low), "upper": numbers(high)}
        add(made, "limit", **ends, effort=numbers(effort), velocity=numbers(EFFORT))
    for coupling in scene.couplings:
        if scene.joints[coupling.joints[0]] is joint:
            of = names[scene.joints[coupling.joints[1]].name]
            add(made, "mimic", joint=of, multiplier=numbers(coupling.ratio), offset=numbers(coupling.offset))
    if joint.damping or joint.friction:
        add(made, "dynamics", damping=numbers(joint.damping), friction=numbers(joint.friction))


def urdf_left_out(scene: Scene, tree: Trees) -> list[str]:
    """What a URDF leaves out of joints, one line each."""
    lines = left_out(scene, spring_of=("hinge", "slider"))
    lines += [f"joint {joint.name}: URDF supports trees only" for joint in tree.loops if joint.kind in NESTING]
    lines += [
        f"joint {joint.name}: URDF has no {joint.kind} joints" for joint in tree.loops if joint.kind not in NESTING
    ]
    if any(joint.motor for joint in scene.joints):
        lines.append("motors of joints: only their largest force is exported, as the effort")
    if any(joint.kind == "ball" and joint.limits for joint in scene.joints):
        lines.append("cones of balls")
    for one in tree.above.values():
        if abs(start := one.joint.start) > 1e-9:
            unit = "m" if one.joint.kind == "slider" else "rad"
            lines.append(
                f"that joint {one.joint.name} starts at {start:.6g} {unit}: in a URDF all joints start at zero"
            )
    return lines


# --- USD ---


def usd_joints(
    stage: Any, physics: Any, gf: Any, scene: Scene, bodies: Sequence[str], names: dict[str, str]
) -> list[str]:
    """Write UsdPhysics joints; their x axes are the joints' axes. Returns what is left out."""
    made_of = {
        "hinge": physics.RevoluteJoint, "slider": physics.PrismaticJoint, "ball": physics.SphericalJoint,
        "fixed": physics.FixedJoint, "distance": physics.DistanceJoint,
    }  # fmt: skip
    lines = left_out(scene, breaks=False, coupled=False)
    stage.DefinePrim("/World/joints", "Scope")
    for joint in scene.joints:
        made = made_of[joint.kind].Define(stage, f"/World/joints/{names[joint.name]}")
        for theirs, ours in ((0, 1), (1, 0)):  # USD's second body moves against its first
            if joint.bodies[ours] >= 0:
                getattr(made, f"CreateBody{theirs}Rel")().SetTargets([f"/World/{bodies[joint.bodies[ours]]}"])
            x, y, z, w = joint.quat_xyzw[ours].tolist()
            getattr(made, f"CreateLocalPos{theirs}Attr")(gf.Vec3f(*joint.anchor[ours].tolist()))
            getattr(made, f"CreateLocalRot{theirs}Attr")(gf.Quatf(w, x, y, z))
        made.CreateCollisionEnabledAttr(joint.collides)
        if math.isfinite(joint.breaks_force):
            made.CreateBreakForceAttr(joint.breaks_force)
        if math.isfinite(joint.breaks_torque):
            made.CreateBreakTorqueAttr(joint.breaks_torque)
        degrees = 180.0 / math.pi if joint.kind == "hinge" else 1.0
        if joint.kind in ("hinge", "slider", "ball"):
            made.CreateAxisAttr("X")
        if joint.kind in ("hinge", "slider") and joint.limits is not None:
            made.CreateLowerLimitAttr(joint.limits[0] * degrees)
            made.CreateUpperLimitAttr(joint.limits[1] * degrees)
        if joint.kind == "ball" and joint.limits is not None:
            made.CreateConeAngle0LimitAttr(math.degrees(joint.limits[1]))
            made.CreateConeAngle1LimitAttr(math.degrees(joint.limits[1]))
        if joint.kind == "distance":
            low, high = (joint.length, joint.length) if joint.length is not None else joint.limits or (-1.0, -1.0)
            made.CreateMinDistanceAttr(low if low > 0 else -1.0)
            made.CreateMaxDistanceAttr(high)
        lines += _usd_drive(made, physics, joint, degrees)
    return lines


def _usd_drive(made: Any, physics: Any, joint: Joint, degrees: float) -> list[str]:
    """Write motor, spring and damping of a hinge or slider, and return what is left out; a drive's numbers are in
    degrees."""
    lines = [f"friction of joint {joint.name}"] if joint.friction else []
    if joint.kind not in ("hinge", "slider"):
        return [*lines, *([f"spring and damping of joint {joint.name}"] if joint.spring or joint.damping else [])]
    if not (joint.motor or joint.spring or joint.damping):
        return lines
    drive = physics.DriveAPI.Apply(made.GetPrim(), "angular" if joint.kind == "hinge" else "linear")
    drive.CreateTypeAttr("force")
    if joint.motor is not None:
        kp, kv = gains(joint)
        drive.CreateMaxForceAttr(joint.motor.max_force)
        drive.CreateDampingAttr(kv / degrees)
        drive.CreateStiffnessAttr(kp / degrees)
        if joint.motor.speed is not None:
            drive.CreateTargetVelocityAttr(joint.motor.speed * degrees)
        elif joint.motor.position is not None:
            drive.CreateTargetPositionAttr(joint.motor.position * degrees)
        return [
            *lines,
            *([f"spring and damping beside the motor of joint {joint.name}"] * bool(joint.spring or joint.damping)),
        ]
    drive.CreateDampingAttr(joint.damping / degrees)
    if joint.spring is not None:
        drive.CreateStiffnessAttr(joint.spring.stiffness / degrees)
        drive.CreateTargetPositionAttr(joint.spring.rest * degrees)
    return lines


# --- glTF ---


def gltf_joints(file: GltfWriter, scene: Scene, names: dict[str, str]) -> list[str]:
    """Add joints of the draft KHR_physics_rigid_bodies between the first nodes, which are the bodies. The node of a
    joint is in the body that holds, and the x axes of both nodes are the joint's. Returns what is left out."""
    linear, angular, made = [0, 1, 2], [0, 1, 2], []
    firm = {  # axes along and about which nothing moves
        "hinge": (linear, [1, 2]), "slider": ([1, 2], angular), "ball": (linear, []), "fixed": (linear, angular),
        "distance": ([], []),
    }  # fmt: skip
    free = {
        "hinge": ("angular", [0]),
        "slider": ("linear", [0]),
        "ball": ("angular", [1, 2]),
        "distance": ("linear", linear),
    }
    lines = left_out(scene, coupled=False)
    for joint in scene.joints:
        ends = []
        for side, body in enumerate(joint.bodies):
            place = joint.anchor[side] - (file.origin if body < 0 else 0.0)
            frame = {"translation": place.tolist(), "rotation": joint.quat_xyzw[side].tolist()}
            ends.append(file.below(body, {"name": f"{names[joint.name]}-{side}", **frame}))
        held_by = {"connectedNode": ends[0], "joint": len(made), "enableCollision": joint.collides}
        file.nodes[ends[1]]["extensions"] = {GLTF_PHYSICS: {"joint": held_by}}
        limits: list[dict[str, Any]] = [
            {f"{kind}Axes": axes, "min": 0.0, "max": 0.0}
            for kind, axes in zip(("linear", "angular"), firm[joint.kind], strict=True)
            if axes
        ]
        kind, axes = free.get(joint.kind, ("", []))
        reach = joint.limits if joint.length is None else (joint.length, joint.length)
        if reach is not None:
            limits.append({f"{kind}Axes": axes, "min": reach[0], "max": reach[1]})
        drives: list[dict[str, Any]] = []
        spring = joint.spring
        if joint.kind == "distance" and spring is not None:  # a limit that is soft
            soft = {"stiffness": spring.stiffness, "damping": joint.damping}
            limits.append({"linearAxes": linear, "min": spring.rest, "max": spring.rest, **soft})
        elif joint.kind == "distance" and joint.damping:
            lines.append(f"damping of joint {joint.name}")
        elif joint.kind != "distance":
            if spring is not None:
                drives.append({"axis": 0, "positionTarget": spring.rest, "stiffness": spring.stiffness})
            dragged = angular if joint.kind == "ball" else [0]
            drives += [{"axis": a, "velocityTarget": 0.0, "damping": joint.damping} for a in dragged if joint.damping]
        if joint.motor is not None and (joint.motor.speed is not None or joint.motor.position is not None):
            kp, kv = gains(joint)
            goal = {"maxForce": joint.motor.max_force, "velocityTarget": joint.motor.speed or 0.0, "damping": kv}
            goal |= {} if joint.motor.position is None else {"positionTarget": joint.motor.position, "stiffness": kp}
            drives.append({"axis": 0, **goal})
        drives = [{"type": kind, "mode": "force", **drive} for drive in drives]
        made.append({"name": names[joint.name], "limits": limits, **({"drives": drives} if drives else {})})
        lines += [f"friction of joint {joint.name}"] if joint.friction else []
    file.extensions[GLTF_PHYSICS]["physicsJoints"] = made
    return lines
