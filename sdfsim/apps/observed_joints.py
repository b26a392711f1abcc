"""Recordings of scenes with joints: poses and velocities that the joints allow, near the observed ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from sdfsim.apps.export_joints import Held, trees
from sdfsim.physics import pose
from sdfsim.physics.options import Options
from sdfsim.physics.steps import Frames as Moved
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Scene
from sdfsim.simulate.batch import Copies, inner_of_frame

ROUNDS = 5  # Gauss-Newton rounds for the flight of a tree
BEGIN = 8  # frames of a flight from which its fit starts
SINGULAR = 1e-3  # relative to the strongest way to change a flight: weaker ways are those that joints do not allow
OUTLIER = 3.0  # standard deviations: poses that are farther off count less than squared

Frames = tuple[
    np.ndarray, np.ndarray, np.ndarray, np.ndarray
]  # position of the centre of mass, orientation, velocity, spin


def jointed(scene: Scene) -> list[bool]:
    """For each moving body, whether a joint holds it, so that it does not fly freely."""
    rows = {k for joint in scene.joints for k in joint.bodies}
    return [k in rows for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]


def held_together(seen: Frames, scene: Scene) -> Frames:
    """Poses and velocities [T, D, *] of the moving bodies, corrected so that the joints of trees allow them: each is as
    observed relative to its parent, except for motion that the joint does not allow. Loops and distances are
    ignored."""
    tree = trees(scene)
    number = {k: d for d, k in enumerate(k for k, b in enumerate(scene.bodies) if b.motion == "dynamic")}
    arrays = [array.copy() for array in seen]
    count = len(arrays[0])

    def of(k: int) -> Frames:
        if k in number:
            return tuple(array[:, number[k]] for array in arrays)  # type: ignore[return-value]
        body = scene.bodies[k] if k >= 0 else None
        place = np.zeros(3) if body is None else body.position + pose.rotate(body.quat_xyzw, _com(scene, k))
        turn = np.array([0.0, 0.0, 0.0, 1.0]) if body is None else body.quat_xyzw
        rest = np.zeros((count, 3))
        return np.tile(place, (count, 1)), np.tile(turn, (count, 1)), rest, rest

    for k in tree.order:
        if k in tree.above and k in number:
            one = tree.above[k]
            com_of_parent = np.zeros(3) if one.parent < 0 else _com(scene, one.parent)
            made = _allowed(one, of(k), of(one.parent), _com(scene, k), com_of_parent)
            for array, values in zip(arrays, made, strict=True):
                array[:, number[k]] = values
    place, turn, speed, spin = arrays
    return place, turn, speed, spin


def _com(scene: Scene, k: int) -> np.ndarray:
    return scene.bodies[k].scale * scene.shapes[scene.bodies[k].shape].com


def _allowed(one: Held, child: Frames, parent: Frames, com: np.ndarray, com_of_parent: np.ndarray) -> Frames:
    """Pose and velocities of a child that its joint with the parent allows."""
    (place, turn, speed, spin), (base, lie, carried, turned) = child, parent
    own, theirs = one.frame.as_quat(), one.parent_frame.as_quat()
    frame = pose.multiply(lie, np.tile(theirs, (len(lie), 1)))
    axis = pose.rotate(frame, np.array([1.0, 0.0, 0.0]))
    kind = one.joint.kind
    seen = pose.multiply(pose.conjugate(frame), pose.multiply(turn, np.tile(own, (len(turn), 1))))
    twist = np.zeros_like(seen)
    twist[:, 3] = 1.0
    if kind == "hinge":
        twist = pose.normalise(seen * np.array([1.0, 0.0, 0.0, 1.0]))
    elif kind == "ball":
        twist = seen
    orientation = pose.multiply(pose.multiply(frame, twist), np.tile(pose.conjugate(own), (len(turn), 1)))
    relative = spin - turned
    if kind == "hinge":
        relative = axis * (relative * axis).sum(-1, keepdims=True)
    elif kind != "ball":
        relative = np.zeros_like(relative)
    rate = turned + relative
    arm = pose.rotate(lie, np.tile(one.parent_anchor - com_of_parent, (len(lie), 1)))
    anchor = base + arm
    # From the child's anchor to its centre of mass, as observed and as corrected.
    was, lever = (pose.rotate(q, np.tile(com - one.anchor, (len(q), 1))) for q in (turn, orientation))
    along, sliding = np.zeros_like(anchor), np.zeros_like(anchor)
    if kind == "slider":
        along = axis * ((place - was - anchor) * axis).sum(-1, keepdims=True)
        there = carried + np.cross(turned, arm + along)
        here = speed - np.cross(spin, was)
        sliding = axis * ((here - there) * axis).sum(-1, keepdims=True)
    velocity = carried + np.cross(turned, arm + along) + sliding + np.cross(rate, lever)
    return anchor + along + lever, orientation, velocity, rate


# --- flights ---


@dataclass(frozen=True)
class Swing:
    """A flight of D bodies that joints hold together, as observed in N frames."""

    time: np.ndarray  # [N] s, since its first frame
    position: np.ndarray  # [N, D, 3] m, of the centres of mass
    orientation: np.ndarray  # [N, D, 4]
    noise: tuple[float, float]  # m and rad


def flying_trees(scene: Scene) -> list[list[int]]:
    """Groups of moving bodies (by their numbers among these) that joints hold together and nothing else holds. Groups
    with loops or distances are left out."""
    if scene.effects.joints == "off":
        return []
    tree = trees(scene)
    number = {k: d for d, k in enumerate(k for k, b in enumerate(scene.bodies) if b.motion == "dynamic")}
    looped = {tree.root(k) for joint in tree.loops for k in joint.bodies}
    found: dict[int, list[int]] = {}
    for k in number:
        found.setdefault(tree.root(k), []).append(number[k])
    return [rows for root, rows in found.items() if root in number and len(rows) > 1 and root not in looped]


def tree_of(scene: Scene, rows: Sequence[int]) -> Scene:
    """A scene with only these moving bodies and their joints, without gravity."""
    moving = [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]
    new = {moving[row]: at for at, row in enumerate(rows)}
    joints = [j for j in scene.joints if set(j.bodies) <= set(new)]
    return replace(
        scene, bodies=tuple(scene.bodies[k] for k in new), gravity=np.zeros(3),
        joints=tuple(replace(j, bodies=(new[j.bodies[0]], new[j.bodies[1]])) for j in joints),
    )  # fmt: skip


def swung(swings: Sequence[Swing], dt: float, scene: Scene) -> list[tuple[Frames, float, float]]:
    """The motions of the tree `scene` in free flight that are nearest to the observed ones, frame by frame at `dt` s up
    to the last frame of each; and the root mean square errors of poses, m and rad. Positions and velocities are
    relative to the common centre of mass, which flies separately."""
    mass = np.array([b.mass for b in scene.bodies])
    share = mass / mass.sum()
    count, many = len(swings), len(mass)
    last = [round(float(s.time[-1]) / dt) for s in swings]
    guess = [np.stack(arrays) for arrays in zip(*(_begun(s, share) for s in swings), strict=True)]
    # Each body is rotated and spun, and moved where a joint lets it slide; joints remove what they do not allow.
    slides = [b for j in scene.joints if j.kind == "slider" for b in j.bodies]
    ways = [(array, d, c) for array, rows in ((1, range(many)), (3, range(many)), (0, slides), (2, slides))
            for d in rows for c in range(3)]  # fmt: skip
    length = scene_units(scene).length
    for turn in range(ROUNDS + 1):
        tried = [np.repeat(array[:, None], 1 + len(ways), 1) for array in guess]
        # Rates are changed by enough to show at the end.
        step = np.empty((count, len(ways)))
        for w, (array, d, c) in enumerate(ways):
            step[:, w] = 1e-4 * (length if array in (0, 2) else 1.0)
            step[:, w] /= np.array(last) * dt if array in (2, 3) else 1.0
            _nudge(tried, slice(None), 1 + w, (array, d, c), step[:, w])
        flat = [array.reshape(-1, *array.shape[2:]) for array in tried]
        begun = tuple(array.reshape(count, 1 + len(ways), *array.shape[1:]) for array in _centred(flat, scene, share))
        if turn == ROUNDS:
            begun = tuple(array[:, :1] for array in begun)
        paths = _flown(begun, dt, max(last), scene)
        if turn == ROUNDS:
            break
        for f, swing in enumerate(swings):
            off = _off(swing, [path[f] for path in paths], dt, share).reshape(1 + len(ways), -1)
            slope = off[1:] - off[0]  # per step each, which makes rotations and rates comparable
            usual = max(1.0, 1.48 * float(np.median(np.abs(off[0]))))  # trackers are less exact in motion than at rest
            weight = (1.0 + np.square(off[0] / (OUTLIER * usual))) ** -0.25
            change = np.linalg.lstsq((slope * weight).T, -off[0] * weight, rcond=SINGULAR)[0]
            for w, way in enumerate(ways):
                _nudge(guess, f, None, way, change[w] * step[f, w])
    found = []
    for f, swing in enumerate(swings):
        own = cast("Frames", tuple(path[f, 0, : last[f] + 1] for path in paths))
        off = _off(swing, [path[f] for path in paths], dt, share).reshape(-1, many, 6) * np.repeat(swing.noise, 3)
        away = [float(np.sqrt(np.square(off[..., k]).sum(-1).mean())) for k in (slice(0, 3), slice(3, 6))]
        found.append((own, away[0], away[1]))
    return found


def _nudge(arrays: list[np.ndarray], flight: int | slice, at: int | None, way: tuple[int, int, int], by) -> None:
    """Change a number of a body in flights; an orientation, by a rotation about a world axis."""
    array, d, c = way
    rows = arrays[array][flight] if at is None else arrays[array][flight, at]
    if array == 1:
        turn = np.zeros((*np.shape(by), 3))
        turn[..., c] = by
        rows[..., d, :] = pose.multiply(pose.from_rotvec(turn), rows[..., d, :])
    else:
        rows[..., d, c] += by


def _begun(swing: Swing, share: np.ndarray) -> Frames:
    """[D, *] a first guess of a flight's start, by parabolas through its first frames, for positions about the centre
    of mass and for rotations."""
    time = swing.time[:BEGIN, None]
    powers = time ** np.arange(3)
    about = swing.position - (share[:, None] * swing.position).sum(1, keepdims=True)
    place = np.linalg.lstsq(powers, about[:BEGIN].reshape(len(time), -1), rcond=None)[0].reshape(3, -1, 3)
    first = swing.orientation[0]
    turned = pose.to_rotvec(pose.multiply(swing.orientation[:BEGIN], pose.conjugate(first)[None]))
    turn = np.linalg.lstsq(powers, turned.reshape(len(time), -1), rcond=None)[0].reshape(3, -1, 3)
    return place[0], pose.multiply(pose.from_rotvec(turn[0]), first), place[1], turn[1]


def _centred(arrays: Sequence[np.ndarray], scene: Scene, share: np.ndarray) -> Frames:
    """Poses and velocities that joints allow, with the common centre of mass at rest at zero."""
    place, turn, speed, spin = held_together(cast("Frames", tuple(arrays)), scene)
    about, drift = ((share[:, None] * array).sum(1, keepdims=True) for array in (place, speed))
    return place - about, turn, speed - drift, spin


def _flown(begun: tuple[np.ndarray, ...], dt: float, frames: int, scene: Scene) -> list[np.ndarray]:
    """[F, P, T, D, *] poses and velocities of flights from their starts [F, P, D, *], which come first."""
    count, many = begun[0].shape[0] * begun[0].shape[1], len(scene.bodies)
    copies = Copies(scene, count)
    u, solver, step = copies.units, copies.solver, dt / copies.units.time
    state = copies.begun(*(array.reshape(count * many, -1) for array in begun))
    options = Options(np.zeros(3), step, inner_of_frame(step))
    moved = cast("Moved", solver.advance(state, solver.init(copies.bodies, state, options), frames, keep=True).frames)
    kept = (moved.position * u.length, moved.orientation, moved.velocity * u.velocity, moved.angular_velocity / u.time)
    paths = []
    for first, later in zip(begun, kept, strict=True):
        later = np.moveaxis(later.reshape(frames, *first.shape), 0, 2)
        paths.append(np.concatenate([first[:, :, None], later], 2))
    return paths


def _off(swing: Swing, paths: Sequence[np.ndarray], dt: float, share: np.ndarray) -> np.ndarray:
    """[P, N, D, 6] for paths [P, T, D, *]: differences from the observed poses, relative to the centre of mass, in
    standard deviations."""
    rows = np.round(swing.time / dt).astype(int)
    about = swing.position - (share[:, None] * swing.position).sum(1, keepdims=True)
    away = pose.to_rotvec(pose.multiply(paths[1][:, rows], pose.conjugate(swing.orientation)[None]))
    return np.concatenate([(paths[0][:, rows] - about) / swing.noise[0], away / swing.noise[1]], -1)
