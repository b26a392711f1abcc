"""Joints of a scene as arrays in model units: their constants, their state, and their angles and positions."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfsim.physics import pose
from sdfsim.physics.joint_columns import (
    ARMATURE,
    BOUNCE,
    BROKEN,
    COORD,
    DAMPING,
    FORCE,
    FRICTION,
    GAIN,
    HIGH,
    HINGE,
    KINDS,
    LENGTH,
    LOW,
    MAX_FORCE,
    MOTOR,
    NUMBERS,
    REST,
    SPEED,
    STATE,
    STIFFNESS,
    TARGET,
    TIME,
    TO_PLACE,
    TO_SPEED,
    TORQUE,
)
from sdfsim.physics.motion import Motion
from sdfsim.scene.scene import Coupling, Joint

# A mode besides `TO_SPEED` and `TO_PLACE`: the motor gives a torque or force, and the target is this value. The
# compiled step has no such mode: it gets a motor with this maximum and a target speed that it never reaches.
EFFORT = 3
NEVER = 1e4  # model units of speed, which no joint reaches


@dataclass(frozen=True)
class Joints:
    """J joints of N bodies; lengths, times and masses in model units."""

    body: np.ndarray  # [J, 2] int64; the second is -1 for the world
    kind: np.ndarray  # [J] int64, index into `KINDS`
    anchor: np.ndarray  # [J, 2, 3] from the centres of mass, in the bodies' axes
    axes: np.ndarray  # [J, 2, 3, 3] the axes of the joint's frames in body axes, one per row
    number: np.ndarray  # [J, NUMBERS], see the columns
    start: np.ndarray  # [J] angles of hinges and positions of sliders at the start
    target: np.ndarray  # [J] targets of motors
    collides: np.ndarray  # [J] bool, whether the two bodies may touch
    # Couplings of hinges and sliders: [C, 2] int64, the first joint follows the second; [C, 2] ratio and offset
    coupled: np.ndarray
    coupling: np.ndarray

    def __len__(self) -> int:
        return len(self.body)


def joints_of(
    joints: Sequence[Joint],
    com: np.ndarray,
    couplings: Sequence[Coupling] = (),
    *,
    length: float,
    time: float,
    mass: float,
) -> Joints:
    """The joints of a scene with their `couplings`; `com` [N, 3] are the centres of mass from the shapes' origins, in
    model units of `length` m, `time` s and `mass` kg."""
    count = len(joints)
    number, start, target = np.zeros((count, NUMBERS)), np.zeros(count), np.zeros(count)
    number[:, LOW], number[:, HIGH], number[:, LENGTH] = -np.inf, np.inf, -1.0
    force = mass * length / time**2
    torque = force * length
    for row, joint, k in zip(number, joints, range(count), strict=True):
        turns = joint.kind in ("hinge", "ball")
        unit, effort = (1.0, torque) if turns else (length, force)
        start[k] = joint.start / unit
        if joint.limits is not None:
            one_sided = joint.kind in ("ball", "distance")
            row[LOW] = -np.inf if one_sided else joint.limits[0] / unit
            row[HIGH] = joint.limits[1] / unit
        row[BOUNCE] = joint.restitution
        row[DAMPING] = joint.damping / (effort / unit * time)
        row[FRICTION] = joint.friction / effort
        row[ARMATURE] = joint.armature * unit / (effort * time**2)
        if joint.spring is not None:
            row[STIFFNESS], row[REST] = joint.spring.stiffness * unit / effort, joint.spring.rest / unit
        if (motor := joint.motor) is not None:
            row[MAX_FORCE], row[TIME], gain = motor.max_force / effort, motor.time / time, motor.gain or 0.0
            row[GAIN] = gain * unit / effort
            if motor.speed is not None:
                row[MOTOR], target[k] = TO_SPEED, motor.speed * time / unit
                row[GAIN] /= time
            elif motor.position is not None:
                row[MOTOR], target[k] = TO_PLACE, motor.position / unit
        if joint.length is not None:
            row[LENGTH] = joint.length / length
        row[FORCE], row[TORQUE] = joint.breaks_force / force, joint.breaks_torque / torque
    body = np.array([joint.bodies for joint in joints], np.int64).reshape(count, 2)
    anchor = np.array([joint.anchor for joint in joints], np.float64).reshape(count, 2, 3) / length
    anchor -= np.where(body[:, :, None] >= 0, com[body], 0.0)
    turned = pose.to_matrix(np.array([joint.quat_xyzw for joint in joints], np.float64).reshape(-1, 4))
    axes = np.ascontiguousarray(turned.reshape(count, 2, 3, 3).swapaxes(2, 3))
    kind = np.array([KINDS.index(joint.kind) for joint in joints], np.int64)
    collides = np.array([joint.collides for joint in joints], bool)
    unit = np.where(kind == HINGE, 1.0, length)
    coupled = np.array([c.joints for c in couplings], np.int64).reshape(-1, 2)
    first, second = unit[coupled].T
    factors = np.array([[c.ratio, c.offset] for c in couplings]).reshape(-1, 2)
    coupling = factors * np.stack([second / first, 1.0 / first], 1)
    return Joints(body, kind, anchor, axes, number, start, target, collides, coupled, coupling)


def initial(joints: Joints, motion: Motion) -> np.ndarray:
    """[J, STATE] of joints at the start, when only the motion of bodies is known."""
    state = np.zeros((len(joints), STATE))
    state[:, TARGET] = joints.target
    state[:, COORD] = coordinates(joints, joints.start, motion.position, motion.orientation)
    state[:, SPEED] = speeds(joints, motion)
    return state


def world_frames(joints: Joints, place: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[..., J, 2, 3] the anchors of joints at both bodies, and [..., J, 2, 3, 3] the axes there, one per row, in the
    world, for bodies at `place` [..., N + 1, 3] with axes `turn` [..., N + 1, 3, 3]; the last row is the world."""
    matrix = turn[..., joints.body, :, :]
    point = place[..., joints.body, :] + np.einsum("...jsxy,jsy->...jsx", matrix, joints.anchor)
    return point, np.einsum("...jsxy,jsky->...jskx", matrix, joints.axes)


def _with_world(position: np.ndarray, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`place` and `turn` of `world_frames`."""
    turn = pose.to_matrix(orientation)
    return _and_still(position), np.concatenate([turn, np.broadcast_to(np.eye(3), (*turn.shape[:-3], 1, 3, 3))], -3)


def _and_still(values: np.ndarray) -> np.ndarray:
    """[..., N + 1, 3]: values of bodies, and zeros for the world."""
    return np.concatenate([values, np.zeros((*values.shape[:-2], 1, 3))], -2)


def coordinates(joints: Joints, near: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """[J] the angle of hinges (the one nearest to `near` [J]), the position of sliders, the angle between the axes of
    balls, the length of distances, and 0 for fixed joints, for bodies at `position` [N, 3] and `orientation` [N, 4]."""
    if not len(joints):
        return np.zeros(0)
    point, axes = world_frames(joints, *_with_world(position, orientation))
    way = point[:, 0] - point[:, 1]

    def times(k: int, m: int) -> np.ndarray:
        return (axes[:, 0, k] * axes[:, 1, m]).sum(-1)

    angle = np.arctan2(times(1, 2), times(1, 1))
    angle += 2.0 * np.pi * np.floor((near - angle) / (2.0 * np.pi) + 0.5)
    leaning = np.arctan2(np.linalg.norm(np.cross(axes[:, 0, 0], axes[:, 1, 0]), axis=-1), times(0, 0))
    along, length = (axes[:, 1, 0] * way).sum(-1), np.linalg.norm(way, axis=-1)
    return np.choose(joints.kind, [angle, along, leaning, np.zeros(len(joints)), length])


def speeds(joints: Joints, motion: Motion) -> np.ndarray:
    """[..., J] the rates at which the `coordinates` change, at one instant or at several."""
    place, turned = _with_world(motion.position, motion.orientation)
    point, axes = world_frames(joints, place, turned)
    fast, spin = (_and_still(part)[..., joints.body, :] for part in (motion.velocity, motion.angular_velocity))
    way, turn = point[..., 0, :] - point[..., 1, :], spin[..., 0, :] - spin[..., 1, :]
    # Both bodies at the first one's anchor: as seen from the second body, whose points turn with it.
    ends = fast + np.cross(spin, point[..., :1, :] - place[..., joints.body, :])
    slide = ends[..., 0, :] - ends[..., 1, :]
    first, second = axes[..., 0, 0, :], axes[..., 1, 0, :]
    lean = np.cross(second, first)
    ways = np.stack([first, second, lean, np.zeros_like(lean), way])
    lengths = np.linalg.norm(ways, axis=-1)
    rates = (ways * np.stack([turn, slide, turn, turn, slide])).sum(-1) / np.where(lengths > 1e-12, lengths, np.inf)
    return np.choose(joints.kind, rates)


def driven(joints: Joints, state: np.ndarray, drive: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """[J, NUMBERS] and the targets [J] for the compiled step, for joints whose numbers were changed to `drive`."""
    number = joints.number if drive is None else drive
    target, effort = state[:, TARGET], number[:, MOTOR] == EFFORT
    if not effort.any():
        return number, target
    number = number.copy()
    number[effort, MOTOR], number[effort, MAX_FORCE], number[effort, GAIN] = TO_SPEED, np.abs(target[effort]), 0.0
    return number, np.where(effort, NEVER * np.sign(target), target)


def stored(joints: Joints, state: np.ndarray) -> float:
    """The energy in springs and rotors."""
    stiffness, away = joints.number[:, STIFFNESS], state[:, COORD] - joints.number[:, REST]
    springs = stiffness * away**2 * (state[:, BROKEN] == 0.0)
    return 0.5 * float((springs + joints.number[:, ARMATURE] * state[:, SPEED] ** 2).sum())


@dataclass(frozen=True)
class Order:
    """The order in which bodies and joints are eliminated, and the fill-in; see `solver.joints.Held`."""

    comp: np.ndarray
    node: np.ndarray
    of_body: np.ndarray
    of_comp: np.ndarray
    entry: np.ndarray
    below: np.ndarray
    row: np.ndarray
    start: np.ndarray
    target: np.ndarray


def ordered(joints: Joints, moves: np.ndarray) -> Order:
    """Eliminate nodes with the fewest neighbours first: bodies that move, and joints once one of their bodies is
    eliminated; or once both are, if what is eliminated already is held by the world or in a loop, and so cannot give
    way in all directions. Trees are solved in time proportional to their size, whatever their form."""
    ends: list[list[int]] = [[int(b) for b in row if b >= 0 and moves[b]] for row in joints.body]
    near: dict[int, set[int]] = {}
    for j, bodies in enumerate(ends):
        near[-1 - j] = set(bodies)
        for b in bodies:
            near.setdefault(b, set()).add(-1 - j)
    beside: dict[int, list[int]] = {}  # what couplings connect sleeps and wakes together
    for one, other in joints.coupled.tolist():
        beside.setdefault(-1 - one, []).append(-1 - other)
        beside.setdefault(-1 - other, []).append(-1 - one)
    comps: list[list[int]] = []
    seen: set[int] = set()
    for first in sorted(n for n in near if n >= 0):
        if first in seen:
            continue
        seen.add(first)
        todo, found = [first], []
        while todo:
            n = todo.pop()
            found.append(n)
            new = near[n].union(beside.get(n, ())) - seen
            seen |= new
            todo += sorted(new)
        comps.append(found)
    node: list[int] = []
    fill: dict[int, list[int]] = {}
    comp = [0]
    own: dict[int, int] = {}  # for every eliminated body, the one that represents all eliminated bodies connected to it
    firm: set[int] = set()  # representatives whose group the world or a loop holds
    waiting: dict[int, list[int]] = {}  # bodies not eliminated yet, and the groups that eliminated joints hold to them
    pinned: set[int] = set()  # groups that are held this way, as long as that lasts

    def whose(n: int) -> int:
        while own[n] != n:
            n = own[n]
        return n

    def ready(n: int) -> bool:
        if n >= 0:
            return True
        gone = {whose(b) for b in ends[-1 - n] if b in own}
        whole = all(b in own for b in ends[-1 - n])
        return bool(gone) and not gone & pinned and (whole or not gone & firm)

    for found in comps:
        queue = [(len(near[n]), n) for n in found if n >= 0]
        heapq.heapify(queue)
        taken: set[int] = set()
        while queue:
            degree, n = heapq.heappop(queue)
            if n in taken or degree != len(near[n]) or not ready(n):
                continue
            taken.add(n)
            node.append(n)
            around = near[n]
            fill[n] = list(around)
            for m in around:
                near[m] |= around
                near[m] -= {n, m}
            if n >= 0:
                own[n] = n
                for one in waiting.pop(n, []):
                    pinned.discard(one)
                    if one in firm or whose(one) == n:
                        firm.add(n)
                    own[one] = n
            else:
                gone = [whose(b) for b in ends[-1 - n] if b in own]
                if len(gone) < len(ends[-1 - n]):
                    (left,) = [b for b in ends[-1 - n] if b not in own]
                    waiting.setdefault(left, []).append(gone[0])
                    pinned.add(gone[0])
                elif len(gone) == 1 or gone[0] == gone[1]:
                    firm.add(gone[0])
                else:
                    own[gone[0]] = gone[1]
                    if gone[0] in firm:
                        firm.add(gone[1])
            for m in around:
                heapq.heappush(queue, (len(near[m]), m))
            if not queue:
                queue = [(len(near[m]), m) for m in found if m not in taken]
        comp.append(len(node))
    place = {n: k for k, n in enumerate(node)}
    below, row, start, target = [0], [], [0], []
    block: dict[tuple[int, int], int] = {}
    for k, n in enumerate(node):
        for r in sorted(place[m] for m in fill[n]):
            block[r, k] = len(row)
            row.append(r)
        below.append(len(row))
    for k in range(len(node)):
        rows = row[below[k] : below[k + 1]]
        for p, r in enumerate(rows):
            target += [block[r, q] for q in rows[:p]] + [-1 - r]
        start.append(len(target))
    of_body, of_comp = np.full(len(moves), -1, np.int64), np.full(len(moves), -1, np.int64)
    for n, k in place.items():
        if n >= 0:
            of_body[n], of_comp[n] = k, np.searchsorted(comp, k, side="right") - 1
    entry = np.full((len(joints), 2), -1, np.int64)
    for j, bodies in enumerate(joints.body):
        for s, b in enumerate(bodies):
            if b >= 0 and moves[b]:
                pair = place[-1 - j], place[int(b)]
                entry[j, s] = block[max(pair), min(pair)]

    def whole(values: list[int]) -> np.ndarray:
        return np.array(values, np.int64)

    return Order(
        whole(comp), whole(node), of_body, of_comp, entry, whole(below), whole(row), whole(start), whole(target)
    )


def apart(joints: Joints, count: int) -> np.ndarray:
    """[N + 1 + E] int64: the bodies that body b may not touch, because of joints, are the entries from `apart[b]` to
    before `apart[b + 1]`. Empty if there are none."""
    pairs = [(int(a), int(b)) for a, b in joints.body[~joints.collides] if a >= 0 and b >= 0]
    if not pairs:
        return np.zeros(0, np.int64)
    partners: list[list[int]] = [[] for _ in range(count)]
    for a, b in pairs:
        partners[a].append(b)
        partners[b].append(a)
    first = count + 1 + np.cumsum([0, *map(len, partners)])
    return np.concatenate([first, [b for some in partners for b in some]]).astype(np.int64)
