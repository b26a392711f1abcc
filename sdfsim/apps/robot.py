"""From the links and joints of robot files to a scene: its scene.yaml, and a Shape folder for each link that is more
than one primitive. `urdf` and `mjcf` read the files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from sdfsim.apps.export import plain_names
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import WORLD
from sdfsim.shape.parts import GREY, Part, color_of, mesh_of, moved, pose_of, primitive_of, skin_of, solid_of, textured
from sdfsim.shape.round_form import round_form
from sdfsim.shape.shape import Shape

FLOOR = "floor"
SMALL_PART = 0.02  # relative to a link's mass: mass of a ball between two of its joints
EVEN = 1e-5  # relative: largest deviation from evenly spread mass at which it is written as such
OVERLAP = 2e-3  # relative to the smaller size: links that overlap deeper at the start do not touch each other
MOST_NAMED = 6  # names in a line of the report
UNBOUNDED = 1e6  # N m or N, for a motor without a limit in the file


@dataclass(frozen=True)
class Link:
    """A rigid part of a robot, as it is at the start."""

    name: str
    pose: np.ndarray  # [4, 4] in the world
    solid: tuple[Part, ...] = ()  # parts that touch others
    shown: tuple[Part, ...] = ()  # parts that are shown; if empty, the solid
    mass: float = 0.0  # kg
    com: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] m, in the link
    # [3, 3] kg m^2 about the centre of mass, axes of the link; None: the mass is spread evenly in its parts
    inertia: np.ndarray | None = None
    still: bool = False  # whether it never moves
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] m/s, of the centre of mass
    spin: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] rad/s, world
    friction: float = 0.5
    restitution: float = 0.0
    where: str = ""

    @property
    def whole(self) -> bool:
        return bool(self.solid or self.shown) and (self.still or self.mass > 0)


@dataclass(frozen=True)
class LinkJoint:
    """A joint by which the link `parent` (-1: the world) holds the link `child`, in world coordinates at the start."""

    name: str
    kind: Literal["hinge", "slider", "ball", "fixed", "distance"]
    child: int
    parent: int
    anchor: np.ndarray | None = None  # [3] m
    axis: np.ndarray | None = None  # [3]
    start: float = 0.0  # rad or m
    limits: tuple[float, float] | None = None  # rad or m; for a ball the cone, for a distance a rope
    spring: tuple[float, float] | None = None  # stiffness, and rest position
    motor: dict[str, float] | None = None  # speed or position (rad or m) or neither; most; time; gain
    others: dict[str, Any] = field(default_factory=dict)  # further keys of scene.yaml
    loop: bool = False  # closes a loop: its links may touch


@dataclass(frozen=True)
class Pose:
    """A keyframe: positions of joints (rad, m; a quaternion [4] xyzw for a ball) by their names, and poses [4, 4] in
    the world of links that no joint holds with their velocities [3] m/s, of the centre of mass, and angular velocities
    [3] rad/s, by their numbers; speeds of joints, and targets of their motors."""

    joints: dict[str, Any]
    links: dict[int, tuple[np.ndarray, ...]]
    speeds: dict[str, Any]
    targets: dict[str, float]


@dataclass(frozen=True)
class Robot:
    name: str
    links: tuple[Link, ...]
    joints: tuple[LinkJoint, ...]
    gravity: np.ndarray | None = None  # [3] m/s^2
    # pairs of links that never touch, the lower number first; None: those that overlap at the start
    apart: frozenset[tuple[int, int]] | None = None
    left_out: tuple[str, ...] = ()  # what is left out, one line each
    notes: tuple[str, ...] = ()  # what was changed, one line each
    contact: bool = True  # whether its links touch anything
    frames: tuple[tuple[str, int, np.ndarray], ...] = ()  # a name, the number of its link, and its pose [4, 4] in it
    keyframes: dict[str, Pose] = field(default_factory=dict)
    couplings: tuple[tuple[str, str, float, float], ...] = ()  # first joint = number x second + number, rad or m


def named(what: str, names: Sequence[str]) -> list[str]:
    """A line of the report: `what (3: a, b, c)`. None if there are no names."""
    more = ", ..." if len(names) > MOST_NAMED else ""
    return [f"{what} ({len(names)}: {', '.join(names[:MOST_NAMED])}{more})"] * bool(names)


# --- to a scene ---


def write_scene(
    robot: Robot, out: Path, *, floor: bool = False, on_progress: Progress = silent
) -> tuple[list[Path], list[str]]:
    """Write a scene.yaml, and Shape folders in `NAME_shapes/` beside it. Returns the files and folders, and notes on
    what was changed, one line each. With `floor`, a plane at z = 0 is added, and everything is raised or lowered to
    stand on it.

    Raises SdfsimError if a link cannot be a body, or if files cannot be written.
    """
    whole, notes = _apart(_merged(robot, {WORLD, FLOOR} if floor else {WORLD}))
    folder = out.with_name(f"{out.stem}_shapes")
    settings: dict[str, Any] = {} if whole.gravity is None else {"gravity": _round(whole.gravity)}
    scene = SceneBuilder(**settings, **({} if whole.contact else {"effects": {"contact": "off"}}))
    made: list[tuple[Shape | None, dict[str, Any], np.ndarray, dict[str, Any]]] = []
    for k, link in enumerate(whole.links):
        on_progress(k / len(whole.links), link.name)
        made.append(_body(link, notes))
    poses = [link.pose @ frame for link, (_, _, frame, _) in zip(whole.links, made, strict=True)]
    lift = np.zeros(3)
    if floor:
        # Only links that touch others stand: a camera's housing or a ball in place of a frame may hang lower.
        corners = [
            moved(shape.mesh, pose).vertices[:, 2].min()
            for link, (shape, *_), pose in zip(whole.links, made, poses, strict=True)
            if link.solid and shape is not None and np.isfinite(shape.sdf.bounds).all()
        ]
        lift[2] = -min(corners, default=0.0)
        scene.add(FLOOR, plane={}, friction=1.0, restitution=0.0)
    avoided = _avoided(whole, [shape for shape, *_ in made], poses, notes)
    bare = [shape is None or (shape.skin is None and "color" not in keys) for shape, keys, *_ in made]
    folders: list[Path] = []
    names = [link.name for link in whole.links]
    files = dict(zip(names, plain_names(names), strict=True))
    for link, (shape, keys, _, mass), pose, others in zip(whole.links, made, poses, avoided, strict=True):
        if "asset" in keys and shape is not None:
            folders.append(shape.save(folder / files[link.name]))
            keys = keys | {"asset": folders[-1]}
        surface = {"friction": _round(link.friction), "restitution": _round(link.restitution)}
        if "plane" in keys:
            normal = pose[:3, 2]
            flat = {"normal": _round(normal), "offset": _round(normal @ (pose[:3, 3] + lift))}
            scene.add(link.name, plane=flat, **surface)
            continue
        motion = {"motion": "static"} if link.still else mass
        speeds = {"velocity": link.velocity, "angular_velocity": link.spin}
        motion |= {key: _round(value) for key, value in speeds.items() if np.any(value) and not link.still}
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
        turned = {} if abs(quat[3]) > 1 - 1e-15 else {"quat_xyzw": _round(quat)}
        touched = {} if others is None else {"avoids": others} if others else {"collides_with": []}
        at = _round(pose[:3, 3] + lift)
        entry: dict[str, Any] = {**keys, "position": at, **turned, **motion, **surface, **touched}
        # In a robot that has colours, a link without one is grey.
        plain: dict[str, Any] = {} if all(bare) or shape is None or shape.skin is not None else {"color": [*GREY]}
        scene.add(link.name, **(plain | entry))
    for joint in whole.joints:
        _join(scene, joint, names, lift)
    _add_poses(scene, whole, names, poses, lift)
    return [scene.save(out), *folders], notes


def _add_poses(scene: SceneBuilder, robot: Robot, names: list[str], poses: list[np.ndarray], lift: np.ndarray) -> None:
    """Add frames, keyframes and couplings, for bodies called `names` at `poses`."""

    def placed(pose: np.ndarray) -> dict[str, Any]:
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return {"position": _round(np.round(pose[:3, 3], 12))} | (
            {} if abs(quat[3]) > 1 - 1e-15 else {"quat_xyzw": _round(quat)}
        )

    # A body has its origin in the middle of its primitive: the link's own frame is one more.
    own = ((link.name, k, np.eye(4)) for k, link in enumerate(robot.links) if not np.allclose(link.pose, poses[k]))
    taken: set[str] = set()
    for name, k, pose in (*robot.frames, *own):
        if name not in taken:
            taken.add(name)
            into = np.linalg.inv(poses[k]) @ robot.links[k].pose @ pose if k >= 0 else pose_of(lift) @ pose
            scene.frame(name, names[k] if k >= 0 else WORLD, **placed(into))
    kinds = {joint.name: joint.kind for joint in robot.joints}
    for name, key in robot.keyframes.items():
        keys: dict[str, Any] = {"angles_deg": {}, "positions": {}, "quats_xyzw": {}}
        for joint, value in key.joints.items():
            if kinds.get(joint) == "hinge":
                keys["angles_deg"][joint] = _round(np.rad2deg(value))
            elif joint in kinds:
                keys["positions" if kinds[joint] == "slider" else "quats_xyzw"][joint] = _round(value)
        shapes = {k: np.linalg.inv(robot.links[k].pose) @ poses[k] for k in key.links}
        for joint, speed in key.speeds.items():
            if joint in kinds:
                keys.setdefault("spins" if kinds[joint] == "ball" else "speeds", {})[joint] = _round(speed)
        keys["targets"] = {joint: _round(value) for joint, value in key.targets.items() if joint in kinds}
        keys["bodies"] = {
            names[k]: placed(pose_of(lift) @ pose @ shapes[k])
            | {what: _round(v) for what, v in zip(("velocity", "angular_velocity"), fast, strict=True) if np.any(v)}
            for k, (pose, *fast) in key.links.items()
        }
        scene.keyframe(name, **{what: found for what, found in keys.items() if found})
    for first, second, ratio, given in robot.couplings:
        offset = float(np.round(given, 12))
        if {first, second} <= kinds.keys():
            shift = (
                {"offset_deg": _round(np.rad2deg(offset))} if kinds[first] == "hinge" else {"offset": _round(offset)}
            )
            scene.couple(first, second, ratio=_round(ratio), **(shift if offset else {}))


def _round(values: Any) -> Any:
    """Numbers rounded to twelve digits."""
    found = np.vectorize(lambda value: float(f"{value:.12g}") + 0.0)(np.asarray(values, np.float64))
    return found.tolist()


def _merged(robot: Robot, taken: set[str]) -> Robot:
    """Merge links that cannot be bodies of their own into those to which they are fixed. Links fixed to one that never
    moves become static themselves, without a joint."""
    links, joints, notes = list(robot.links), list(robot.joints), list(robot.notes)
    into = list(range(len(links)))

    def home(k: int) -> int:
        while k >= 0 and into[k] != k:
            k = into[k]
        return k

    for joint in [joint for joint in joints if joint.kind == "fixed" and joint.parent >= 0 and not joint.loop]:
        one, other = home(joint.child), home(joint.parent)
        if links[other].still or (links[one].whole and links[other].whole):
            continue
        # The one that can be a body stays; if neither can, the one nearer to the root.
        keep, gone = (one, other) if links[one].whole else (other, one)
        if links[gone].solid or links[gone].shown or links[gone].mass:
            notes.append(f"link {links[gone].name} is part of {links[keep].name}, to which it is fixed")
        links[keep] = _with(links[keep], links[gone])
        into[gone] = keep
        joints.remove(joint)
    joints = [replace(joint, child=home(joint.child), parent=home(joint.parent)) for joint in joints]
    held = {joint.child for joint in joints}
    for k, link in enumerate(links):
        if into[k] == k and not link.still and not link.mass and k not in held:
            links[k] = replace(link, still=True)
            if link.solid or link.shown:
                notes.append(f"link {link.name} has no mass and no joint holds it: it stands still")
    while bound := [j for j in joints if j.kind == "fixed" and not j.loop and (j.parent < 0 or links[j.parent].still)]:
        for joint in bound:
            links[joint.child] = replace(links[joint.child], still=True)
        joints = [joint for joint in joints if joint not in bound]
    # A link that never moves and is not shown is the world.
    gone = {k for k, link in enumerate(links) if into[k] != k or (link.still and not (link.solid or link.shown))}
    kept = [k for k in range(len(links)) if k not in gone]
    number = {k: i for i, k in enumerate(kept)}
    joints = [
        replace(joint, child=number[joint.child], parent=number.get(joint.parent, -1))
        for joint in joints
        if not links[joint.child].still
    ]
    frames = [*robot.frames, *((links[k].name, k, np.eye(4)) for k in sorted(gone) if links[k].name != WORLD)]
    there = [(name, number.get(home(k), -1), links[k].pose @ pose if k >= 0 else pose) for name, k, pose in frames]
    apart = robot.apart
    if apart is not None:
        pairs = {tuple(sorted((number.get(home(a), -1), number.get(home(b), -1)))) for a, b in apart}
        apart = frozenset((a, b) for a, b in pairs if 0 <= a < b)
    whole = tuple(_renamed([links[k] for k in kept], taken))
    return replace(
        robot,
        links=whole,
        joints=tuple(joints),
        apart=apart,
        notes=tuple(notes),
        frames=tuple((name, k, np.linalg.inv(whole[k].pose) @ pose if k >= 0 else pose) for name, k, pose in there),
        keyframes={
            name: replace(key, links={number[k]: pose for k, pose in key.links.items() if k in number})
            for name, key in robot.keyframes.items()
        },
    )


def _renamed(links: list[Link], taken: set[str]) -> Iterator[Link]:
    """Links, renamed if their names are taken or occur twice."""
    names = {link.name for link in links} | taken
    for link in links:
        name = link.name
        while name in taken or (name != link.name and name in names):
            name += "_"
        names.add(name)
        yield replace(link, name=name)


def _with(keep: Link, gone: Link) -> Link:
    into = np.linalg.inv(keep.pose) @ gone.pose

    def carried(parts: tuple[Part, ...]) -> tuple[Part, ...]:
        return tuple(replace(part, pose=into @ part.pose) for part in parts)

    mass, com, inertia = keep.mass, keep.com, keep.inertia
    if gone.mass > 0:
        turn, other = into[:3, :3], into[:3, :3] @ gone.com + into[:3, 3]
        theirs = None if gone.inertia is None else turn @ gone.inertia @ turn.T
        if keep.mass > 0:
            mass = keep.mass + gone.mass
            com = (keep.mass * keep.com + gone.mass * other) / mass
            if inertia is not None and theirs is not None:
                inertia = _shifted(inertia, keep.mass, keep.com - com) + _shifted(theirs, gone.mass, other - com)
            else:
                inertia = None
        else:
            mass, com, inertia = gone.mass, other, theirs
    return replace(
        keep, mass=mass, com=com, inertia=inertia, solid=keep.solid + carried(gone.solid),
        shown=(keep.shown or keep.solid * bool(gone.shown)) + carried(gone.shown),
    )  # fmt: skip


def _shifted(inertia: np.ndarray, mass: float, away: np.ndarray) -> np.ndarray:
    """An inertia, moved to a point that is `away` [3] m from the centre of mass."""
    return inertia + mass * (away @ away * np.eye(3) - np.outer(away, away))


def _apart(robot: Robot) -> tuple[Robot, list[str]]:
    """Insert small balls with a little of the mass between the joints of links that have several."""
    links, joints, notes = list(robot.links), [], list(robot.notes)
    chains: dict[tuple[int, int], list[LinkJoint]] = {}
    for joint in robot.joints:
        if joint.loop or joint.kind == "distance":
            joints.append(joint)
        else:
            chains.setdefault((joint.child, joint.parent), []).append(joint)
    split = []
    for (child, parent), chain in chains.items():
        link, before = links[child], parent
        if len(chain) > 1:
            split.append(link.name)
            part = SMALL_PART * link.mass
            mean = float(np.trace(_spread(link))) / 3.0
            radius = 0.5 * np.sqrt(1.5 * mean / link.mass) if link.mass > 0 else 0.01
            left = 1.0 - SMALL_PART * (len(chain) - 1)
            tensor = None if link.inertia is None else left * link.inertia
            links[child] = replace(link, mass=left * link.mass, inertia=tensor)
            for joint in chain[:-1]:
                assert joint.anchor is not None
                ball = Part("sphere", np.eye(4), {"radius": radius})
                name = f"{link.name}_{joint.name}"
                links.append(
                    Link(name, pose_of(joint.anchor), shown=(ball,), mass=part, inertia=SMALL_PART * mean * np.eye(3))
                )
                joints.append(replace(joint, child=len(links) - 1, parent=before))
                before = len(links) - 1
        joints.append(replace(chain[-1], child=child, parent=before))
    part = f"{100 * SMALL_PART:g} % of their mass"
    notes += named(f"links with several joints: a small ball between two of these has {part}", split)
    return replace(robot, links=tuple(links), joints=tuple(joints)), notes


def _spread(link: Link) -> np.ndarray:
    """[3, 3] kg m^2, the approximate inertia of a link; if unknown, that of a ball of its size."""
    if link.inertia is not None:
        return link.inertia
    parts = [mesh_of(part).vertices for part in (link.solid or link.shown) if part.kind != "plane"]
    size = max((float(np.ptp(points, axis=0).max()) for points in parts), default=0.1)
    return 0.1 * link.mass * size**2 * np.eye(3)


def _body(link: Link, notes: list[str]) -> tuple[Shape | None, dict[str, Any], np.ndarray, dict[str, Any]]:
    """The shape of a link, the shape's keys in scene.yaml, its frame [4, 4] in the link, and the keys of its mass."""
    parts = list(link.solid or link.shown)
    flat = [part for part in parts if part.kind == "plane"]
    if flat and (not link.still or len(parts) > 1):
        what = "moves" if not link.still else "has other parts"
        raise SdfsimError(
            f"{flat[0].where}: only a static link without other parts can have a plane ({link.name} {what})"
        )
    if flat:
        return None, {"plane": {}}, flat[0].pose, {}
    if not parts:
        if not link.mass > 0:
            reason = "has neither mass nor shape, but a movable joint"
            raise SdfsimError(f"{link.where}: link {link.name} {reason}", "give it an inertial with a mass, or fix it")
        radius = np.sqrt(2.5 * np.trace(_spread(link)) / 3.0 / link.mass)
        notes.append(f"link {link.name} has no shape: a ball of {radius:.3g} m that touches nothing replaces it")
        parts = [Part("sphere", pose_of(link.com), {"radius": radius})]
    density = 1000.0
    if link.solid and len(parts) == 1 and parts[0].mesh is not None and (form := round_form(parts[0].mesh)):
        parts = [replace(parts[0], kind=form.kind, pose=parts[0].pose @ form.pose, sizes=form.sizes, mesh=None)]
        notes.append(f"link {link.name}: {form}")
    if len(parts) == 1 and parts[0].mesh is None:
        frame, shape = parts[0].pose, primitive_of(parts[0], link.name)
        keys: dict[str, Any] = {parts[0].kind: {key: _round(value) for key, value in parts[0].sizes.items()}}
    else:
        frame, keys, shape = np.eye(4), {"asset": link.name}, solid_of(parts, link.name)
        notes += [f"link {link.name}: {note}" for note in shape.source.pop("notes", [])]
    shape, look = _dressed(link, shape, frame)
    mass: dict[str, Any] = {}
    if not link.still:
        held = link.mass
        if not held > 0:
            held = density * shape.volume
            notes.append(f"link {link.name} has no mass: it gets that of water, {held:.3g} kg")
        mass = {"mass": _round(held)}
        turn = frame[:3, :3]
        com = turn.T @ (link.com - frame[:3, 3]) if link.mass > 0 else shape.com
        even = held / shape.volume * shape.inertia
        tensor = even if link.inertia is None or not link.mass > 0 else turn.T @ link.inertia @ turn
        tensor = _possible(link, tensor, even, notes)
        factor = float(np.trace(tensor) / np.trace(even))
        size = float(np.ptp(shape.mesh.vertices, axis=0).max())
        near = np.abs(com - shape.com).max() <= EVEN * size and np.abs(tensor - factor * even).max() <= (
            EVEN * factor * np.abs(even).max()
        )
        if near and factor <= 100.0:
            mass |= {} if abs(factor - 1.0) <= EVEN else {"inertia_factor": _round(factor)}
        else:  # a folder holds any
            keys = {"asset": link.name}
            shape = replace(shape, com=com, inertia=tensor * shape.volume / held)
    if shape.skin is not None:
        keys = {"asset": link.name}
    return shape, keys | look, frame, mass


def _possible(link: Link, tensor: np.ndarray, even: np.ndarray, notes: list[str]) -> np.ndarray:
    """The given inertia if a body can have it, else that of the mass spread evenly."""
    principal = np.linalg.eigvalsh(tensor)
    if principal[0] <= 1e-9 * principal[2]:
        reason = f"moments of {', '.join(f'{value:.3g}' for value in principal)} kg m^2 are not all above zero"
        notes.append(f"link {link.name}: its inertia is impossible ({reason}): its mass is spread evenly instead")
        return even
    if principal[2] > (1.0 + 1e-6) * (principal[0] + principal[1]):
        reason = f"{principal[2]:.3g} kg m^2 is above the sum of {principal[0]:.3g} and {principal[1]:.3g}"
        notes.append(f"link {link.name}: no solid has its inertia ({reason}); it is kept")
    return tensor


def _dressed(link: Link, shape: Shape, frame: np.ndarray) -> tuple[Shape, dict[str, Any]]:
    """A shape with the shown mesh of its link, with its colours and textures. If that is the solid itself, in one
    colour, the body's key for its colour instead."""
    parts = [part for part in (link.shown or link.solid) if part.kind != "plane"]
    if not link.solid or [mesh_of(part).digest() for part in parts] == [mesh_of(part).digest() for part in link.solid]:
        colors = {color_of(part) for part in parts}
        if len(colors) <= 1 and not any(map(textured, parts)):
            (color,) = colors or {None}
            return shape, {"color": [*color]} if color else {}
    return replace(shape, skin=skin_of(parts, frame)), {}


# --- which links touch ---


def _avoided(
    robot: Robot, shapes: list[Shape | None], poses: list[np.ndarray], notes: list[str]
) -> list[list[str] | None]:
    """The links that each link `avoids`; None: nothing, an empty list: all. Jointed bodies do not touch anyway."""
    links, count = robot.links, len(robot.links)
    still = [k for k, link in enumerate(links) if link.still]
    tree = [joint for joint in robot.joints if not joint.loop and joint.kind != "distance"]
    fixed = [(joint.child, joint.parent) for joint in tree if joint.kind == "fixed" and joint.parent >= 0]
    rows, columns = np.reshape([*fixed, *((still[0], k) for k in still)], (-1, 2)).astype(int).T
    # [links] the groups of links that move together; all static ones are one.
    rigid = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count)), directed=False)[1]
    bare = [not link.solid for link in links]
    denied: set[tuple[int, int]] = set()
    above = {joint.child: joint.parent for joint in tree}
    own, near = set(), set()
    for joint in tree:
        own |= {(joint.child, joint.parent), (joint.parent, joint.child)}
        parent = joint.parent
        while parent >= 0 and bare[parent] and parent in above:  # skips a chain of small balls
            parent = above[parent]
        if parent >= 0 and links[parent].still:
            denied |= {(joint.child, parent), (parent, joint.child)}
        elif parent >= 0:
            near |= {(rigid[joint.child], rigid[parent]), (rigid[parent], rigid[joint.child])}
    overlapping: list[str] = []
    for a in range(count):
        for b in range(a + 1, count):
            if (links[a].still and links[b].still) or (a, b) in own:
                continue
            if bare[a] or bare[b] or rigid[a] == rigid[b] or (rigid[a], rigid[b]) in near:
                denied.add((a, b))
            elif robot.apart is not None:
                denied |= {(a, b)} & robot.apart
            elif _overlap(shapes[a], poses[a], shapes[b], poses[b]):
                denied.add((a, b))
                overlapping.append(f"{links[a].name} and {links[b].name}")
    notes += named("links that overlap at the start will not touch each other", overlapping)
    found: list[list[str] | None] = [[] if alone else None for alone in bare]
    for k in (k for k in range(count) if not bare[k]):
        # Without those that a joint already keeps from touching.
        others = {b if a == k else a for a, b in denied - own if k in (a, b)}
        others = sorted(j for j in others if not bare[j])
        if others and "plane" not in {part.kind for part in links[k].solid or links[k].shown}:
            found[k] = [links[j].name for j in others]
    return found


def _overlap(one: Shape | None, pose: np.ndarray, other: Shape | None, place: np.ndarray) -> bool:
    if one is None or other is None:
        return False
    for a, b, into in ((one, other, np.linalg.inv(place) @ pose), (other, one, np.linalg.inv(pose) @ place)):
        points = a.nodes @ into[:3, :3].T + into[:3, 3]
        low, high = b.sdf.bounds
        near = points[((points > low) & (points < high)).all(1)]
        depth = OVERLAP * min(float(np.ptp(shape.mesh.vertices, axis=0).max()) for shape in (a, b))
        if len(near) and float(np.min(b.sdf(near)[0])) < -depth:
            return True
    return False


# --- joints ---


def _join(scene: SceneBuilder, joint: LinkJoint, names: list[str], lift: np.ndarray) -> None:
    """Write a joint, with angles in degrees."""
    turns = joint.kind in ("hinge", "ball")

    def with_unit(name: str, value: Any) -> dict[str, Any]:
        return {f"{name}_deg" if turns else name: _round(np.rad2deg(value) if turns else value)}

    keys: dict[str, Any] = {}
    if joint.anchor is not None:
        keys["anchor"] = _round(joint.anchor + lift)
    if joint.axis is not None:
        keys["axis"] = _round(joint.axis)
    if joint.start and joint.kind in ("hinge", "slider"):
        keys |= with_unit("start", joint.start)
    if joint.limits is not None:
        if joint.kind == "ball":
            keys |= with_unit("cone", joint.limits[1])
        elif joint.kind == "distance":
            keys["rope"] = _round(joint.limits[1])
        else:
            keys |= with_unit("limits", joint.limits)
    if joint.spring is not None:
        keys["spring"] = {"stiffness": _round(joint.spring[0]), **with_unit("rest", joint.spring[1])}
    if joint.motor is not None:
        place = {key: value for key, value in joint.motor.items() if key != "position"}
        keys["motor"] = {key: _round(value) for key, value in place.items()}
        keys["motor"] |= with_unit("position", joint.motor["position"]) if "position" in joint.motor else {}
    keys |= {
        key: _round(value) if isinstance(value, float | np.ndarray) else value for key, value in joint.others.items()
    }
    keys |= {"to": _round(joint.others["to"] + lift)} if "to" in joint.others else {}
    keys |= {"collide": "on"} if joint.loop else {}
    held = names[joint.parent] if joint.parent >= 0 else WORLD
    scene.join(joint.name, joint.kind, names[joint.child], held, **keys)
