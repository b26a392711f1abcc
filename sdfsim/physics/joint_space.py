"""Joints as coordinates: their positions and velocities as vectors, set and read; Jacobians and the mass matrix.

A hinge has one coordinate (rad) and so has a slider (model lengths); a ball has three, the rotation vector of the first
body's joint frame in the second's, and as velocity the angular velocity in the axes of the second's. Joints follow one
another in the scene's order. Bodies and joints form trees; the joints left over close loops.
"""

import itertools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.joint_columns import (
    ARMATURE,
    BALL,
    BROKEN,
    COORD,
    DISTANCE,
    FIXED,
    HINGE,
    LENGTH,
    SLIDER,
    SPEED,
    TARGET,
)
from sdfsim.physics.joints import coordinates, speeds, world_frames
from sdfsim.physics.motion import Motion

# Components of the motion of the first body's joint frame relative to the second's (translation along and rotation
# about the second's x, y, z) that each kind allows.
FREE: dict[int, list[int]] = {HINGE: [3], SLIDER: [0], BALL: [3, 4, 5], FIXED: []}
CLOSED = 1e-10  # model lengths and rad: how well loops close
TRIES = 60  # of Newton's method
STRIDE = 0.3  # rad or model lengths, its longest step


def columns(kind: np.ndarray) -> list[slice]:
    """The place of each joint in the vectors, by its kind [J]."""
    ends = np.cumsum([0, *(len(FREE.get(int(k), ())) for k in kind)]).tolist()
    return [slice(*pair) for pair in itertools.pairwise(ends)]


def spanning(ends: Sequence[tuple[int, int] | None], still: Iterable[int], count: int) -> list[tuple[int, int]]:
    """Trees of `count` bodies whose roots are the world (-1) and the bodies that are `still`, then free bodies.

    `ends` are the two bodies of each joint, the second holding the first; None for a joint that can hold none. Returns
    the number of each joint in a tree with the body that it holds, each after the joint of that body's parent.
    """
    at: dict[int, list[int]] = {}
    for j, pair in enumerate(ends):
        for k in pair or ():
            at.setdefault(k, []).append(j)
    # Bodies that are first in no joint are the natural roots of free trees.
    firsts = {pair[0] for pair in ends if pair is not None}
    reached, found = {-1, *still}, []
    free = sorted((k for k in range(count) if k not in reached), key=lambda k: k in firsts)
    for seeds in (sorted(reached), *([k] for k in free)):
        if seeds[0] >= 0 and seeds[0] in reached:
            continue
        reached |= set(seeds)
        for k in seeds:  # grows
            for j in at.get(k, ()):
                pair = ends[j]
                assert pair is not None
                other = pair[1] if pair[0] == k else pair[0]
                if other not in reached:
                    reached.add(other)
                    seeds.append(other)
                    found.append((j, other))
    return found


class JointSpace:
    """The joints of `bodies` in a state, in model units. Broken joints hold nothing, and so have no coordinates that
    could be set."""

    def __init__(self, bodies: Bodies, state: State) -> None:
        if bodies.joints is None or state.joints is None:
            raise SdfsimError("the scene has no joints, or they are off", "see joints, and effects.joints")
        self.bodies, self.state, self.joints = bodies, state, bodies.joints
        kind, pairs = self.joints.kind, [(int(a), int(b)) for a, b in self.joints.body]
        whole = state.joints[:, BROKEN] == 0.0
        still = np.flatnonzero(~bodies.moves).tolist()
        self.columns = columns(kind)
        self.size = self.columns[-1].stop if self.columns else 0
        ends = [pair if good and k != DISTANCE else None for pair, good, k in zip(pairs, whole, kind, strict=True)]
        self.tree = spanning(ends, still, len(bodies))
        inner, held = {j for j, _ in self.tree}, {k for _, k in self.tree}
        self.roots = [k for k in np.flatnonzero(bodies.moves).tolist() if k not in held]  # free bodies
        rod = (kind == DISTANCE) & (self.joints.number[:, LENGTH] >= 0.0)
        moving = np.array([any(k >= 0 and bodies.moves[k] for k in pair) for pair in pairs])
        holds = whole & moving & ((kind != DISTANCE) | rod)
        self.loops = [int(j) for j in np.flatnonzero(holds) if j not in inner]
        # One row more for the world, which is body -1.
        self.place = np.append(state.position, np.zeros((1, 3)), 0)
        self.turn = np.append(pose.to_matrix(state.orientation), np.eye(3)[None], 0)

    @property
    def positions(self) -> np.ndarray:
        """[n] the coordinates of all joints."""
        assert self.state.joints is not None
        found, axes = np.zeros(self.size), self._frames()[1]
        near = coordinates(self.joints, self.state.joints[:, COORD], self.state.position, self.state.orientation)
        for j, (kind, own) in enumerate(zip(self.joints.kind, self.columns, strict=True)):
            if kind in (HINGE, SLIDER):
                found[own] = near[j]
            elif kind == BALL:
                found[own] = pose.to_rotvec(pose.from_matrix(axes[j, 1] @ axes[j, 0].T))
        return found

    @property
    def velocities(self) -> np.ndarray:
        """[n] their velocities."""
        found, given = np.zeros(self.size), self._motion()
        for j, own in enumerate(self.columns):
            if self.joints.kind[j] != DISTANCE:
                found[own] = self._relative(j, *given)[FREE[int(self.joints.kind[j])], 0]
        return found

    def jacobian(self, base: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The velocity of each body's centre of mass and its angular velocity, [N + 1, 3, n] each, world axes, for a
        unit velocity of each coordinate; the world comes last. A free body `base` adds six columns in front: its own
        velocity and angular velocity. Joints that close loops have columns of zeros."""
        more = 0 if base is None else 6
        fast, spin = np.zeros((2, len(self.place), 3, more + self.size))
        if base is not None:
            fast[base, :, :3] = spin[base, :, 3:6] = np.eye(3)
        self._carry(np.eye(more + self.size)[more:], fast, spin)
        return fast, spin

    def mass_matrix(self, base: int | None = None) -> np.ndarray:
        """[n, n] so that half of v M v is the kinetic energy of all bodies and rotors (the armature of joints), for
        velocities v of the coordinates."""
        fast, spin = (part[:-1][self.bodies.moves] for part in self.jacobian(base))
        turn = self.turn[:-1][self.bodies.moves]
        inertia = turn @ self.bodies.inertia[self.bodies.moves] @ turn.swapaxes(1, 2)
        slow = np.einsum("n,nxi,nxj->ij", self.bodies.mass[self.bodies.moves], fast, fast)
        made = slow + np.einsum("nxi,nxy,nyj->ij", spin, inertia, spin)
        rotors = np.zeros(len(made))
        for j, _ in self.tree:
            rotors[len(made) - self.size :][self.columns[j]] = self.joints.number[j, ARMATURE]
        return made + np.diag(rotors)

    def set(
        self, positions: np.ndarray, velocities: np.ndarray, which: Collection[int] | None = None
    ) -> tuple[State, np.ndarray]:
        """The state in which joints have `positions` [n] and `velocities` [n], and the numbers of bodies that change.

        The bodies that a joint holds follow it, from the roots on, which stay as they are; with `which` only those that
        these joints hold, directly or not. Where loops would open, all joints but `which` give way, by the smallest
        change of coordinates; so they do for couplings. Raises SdfsimError if a loop cannot close.
        """
        assert self.state.joints is not None
        fixed = set(which or ())
        below, moved = set(), []
        for j, k in self.tree:
            if which is None or j in fixed or self._parent(j, k) in below:
                below.add(k)
                moved.append((j, k))
        q, v = positions.copy(), velocities.copy()
        kept = np.concatenate([np.arange(self.size)[self.columns[j]] for j in fixed], dtype=int) if fixed else []
        free = np.setdiff1d(np.arange(self.size), kept)
        self._fold(q, moved)
        closes = bool(self.loops) or len(self.joints.coupled) > 0
        rows = self._open(q, positions, fixed)[0] if closes else np.zeros(0)
        if np.abs(rows).max(initial=0.0) > CLOSED:
            for _ in range(TRIES):
                self._fold(q, self.tree)
                wrong, slope, _ = self._open(q, positions, fixed)
                if np.abs(wrong).max() <= CLOSED:
                    break
                step = np.linalg.lstsq(slope[:, free], wrong, rcond=1e-9)[0]
                q[free] -= step * min(1.0, STRIDE / max(np.abs(step).max(), 1e-300))
            else:
                hint = "set the joint that is driven; the others follow it"
                raise SdfsimError(f"joints: a loop or coupling stays open by {np.abs(wrong).max():.3g} there", hint)
        if closes:
            _, slope, own = self._open(q, positions, fixed)
            wanted = np.where(own >= 0, velocities[own], 0.0)
            v[free] -= np.linalg.lstsq(slope[:, free], slope @ v - wanted, rcond=1e-9)[0]
            moved = self.tree
        fast, spin = self._motion()
        self._carry(v[:, None], fast, spin, moved)
        changed = np.array(sorted({k for _, k in moved}), int)
        orientation = self.state.orientation.copy()
        made = pose.from_matrix(self.turn[changed])
        orientation[changed] = made * np.where((made * orientation[changed]).sum(1) < 0.0, -1.0, 1.0)[:, None]
        after = {
            "position": self.place[:-1].copy(), "orientation": orientation, "velocity": fast[:-1, :, 0].copy(),
            "angular_velocity": spin[:-1, :, 0].copy(),
        }  # fmt: skip
        known, touched = self.state.joints.copy(), np.isin(self.joints.body, changed).any(axis=1)
        known[touched] = 0.0  # impulses of the step before
        for column in (TARGET, BROKEN):
            known[:, column] = self.state.joints[:, column]
        for j in np.flatnonzero(touched & np.isin(self.joints.kind, (HINGE, SLIDER))):
            known[j, COORD] = q[self.columns[j].start]
        known[:, COORD] = coordinates(self.joints, known[:, COORD], after["position"], orientation)
        known[touched, SPEED] = speeds(self.joints, Motion(**after))[touched]
        return replace(self.state, **after, joints=known), changed

    def _motion(self) -> list[np.ndarray]:
        """Velocities and angular velocities, [N + 1, 3, 1] each."""
        parts = self.state.velocity, self.state.angular_velocity
        return [np.append(part, np.zeros((1, 3)), 0)[:, :, None] for part in parts]

    def _frames(self) -> tuple[np.ndarray, np.ndarray]:
        return world_frames(self.joints, self.place, self.turn)

    def _parent(self, j: int, k: int) -> int:
        a, b = self.joints.body[j]
        return int(b if a == k else a)

    def _fold(self, q: np.ndarray, tree: Sequence[tuple[int, int]]) -> None:
        """Move the bodies of a tree to coordinates `q`."""
        joints = self.joints
        for j, k in tree:
            (a, b), kind, own, shift = joints.body[j], joints.kind[j], q[self.columns[j]], np.zeros(3)
            turn = np.eye(3)
            if kind == SLIDER:
                shift[0] = own[0]
            elif kind != FIXED:
                turn = pose.to_matrix(pose.from_rotvec(own if kind == BALL else np.array([own[0], 0.0, 0.0])))
            first, second = joints.axes[j, 0].T, joints.axes[j, 1].T
            if k == a:
                frame = self.turn[b] @ second
                self.turn[k] = frame @ turn @ first.T
                origin = self.place[b] + self.turn[b] @ joints.anchor[j, 1] + frame @ shift
                self.place[k] = origin - self.turn[k] @ joints.anchor[j, 0]
            else:
                frame = self.turn[a] @ first @ turn.T
                self.turn[k] = frame @ second.T
                origin = self.place[a] + self.turn[a] @ joints.anchor[j, 0] - frame @ shift
                self.place[k] = origin - self.turn[k] @ joints.anchor[j, 1]

    def _arms(self, j: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        """The two bodies, and from the centre of each to the first body's anchor, [3] each, world axes."""
        a, b = (int(k) for k in self.joints.body[j])
        arm = self.turn[a] @ self.joints.anchor[j, 0]
        return a, b, arm, self.place[a] + arm - self.place[b]

    def _carry(self, v: np.ndarray, fast: np.ndarray, spin: np.ndarray, tree: Any = None) -> None:
        """Give the bodies of a tree the velocities `fast` and `spin` [N + 1, 3, m] that follow from those of the
        coordinates [n, m]."""
        for j, k in self.tree if tree is None else tree:
            a, b, arm, reach = self._arms(j)
            free, axes = FREE[int(self.joints.kind[j])], self.turn[b] @ self.joints.axes[j, 1].T
            own = np.zeros((6, v.shape[1]))
            own[free] = v[self.columns[j]]
            slide, turn = axes @ own[:3], axes @ own[3:]
            if k == a:
                spin[a] = spin[b] + turn
                fast[a] = fast[b] + _across(spin[b], reach) + slide - _across(spin[a], arm)
            else:
                spin[b] = spin[a] - turn
                fast[b] = fast[a] + _across(spin[a], arm) - slide - _across(spin[b], reach)

    def _relative(self, j: int, fast: np.ndarray, spin: np.ndarray) -> np.ndarray:
        """[6, m] the motion of the first body's frame relative to the second's, in the axes of the second's."""
        a, b, arm, reach = self._arms(j)
        axes = self.joints.axes[j, 1] @ self.turn[b].T
        slide = fast[a] + _across(spin[a], arm) - fast[b] - _across(spin[b], reach)
        return np.concatenate([axes @ slide, axes @ (spin[a] - spin[b])])

    def _open(
        self, q: np.ndarray, wanted: np.ndarray, fixed: Collection[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The errors [r] of couplings and of joints that close loops at coordinates `q`, and their derivatives [r, n];
        for such joints that are `fixed` also how far they are from the coordinates `wanted`, and which these are, [r]
        (-1: none)."""
        point, axes = self._frames()
        fast, spin = self.jacobian()
        # A joint that closes a loop has no coordinate of its own, so its couplings are left to the solve.
        own = ~np.isin(self.joints.coupled, self.loops).any(1)
        starts = np.array([place.start for place in self.columns])
        first, second = starts[self.joints.coupled[own]].T
        ratio, offset = self.joints.coupling[own].T
        unit = np.eye(self.size)
        wrong, slope = [q[first] - ratio * q[second] - offset], [unit[first] - ratio[:, None] * unit[second]]
        of = [np.full(len(first), -1)]
        for j in self.loops:
            kind, way, moves = int(self.joints.kind[j]), point[j, 0] - point[j, 1], self._relative(j, fast, spin)
            if kind == DISTANCE:
                length = float(np.linalg.norm(way))
                wrong.append(np.array([length - self.joints.number[j, LENGTH]]))
                slope.append((axes[j, 1] @ way / length)[None] @ moves[:3])
                of.append(np.full(1, -1))
                continue
            turn = axes[j, 1] @ axes[j, 0].T
            errors = np.concatenate([axes[j, 1] @ way, pose.to_rotvec(pose.from_matrix(turn))])
            if kind == HINGE:
                angle = np.arctan2(turn[2, 1] - turn[1, 2], turn[1, 1] + turn[2, 2])
                errors[3:] = angle, -turn[2, 0], turn[1, 0]
            free = FREE[kind]
            rows = [e for e in range(6) if e not in free]
            rows += free if j in fixed else []
            own = np.full(6, -1)
            own[free] = np.arange(self.size)[self.columns[j]]
            if j in fixed:
                errors[free] -= wanted[self.columns[j]]
                errors[3:] -= 2.0 * np.pi * np.round(errors[3:] / (2.0 * np.pi))
            wrong.append(errors[rows])
            slope.append(moves[rows])
            of.append(own[rows])
        return np.concatenate(wrong), np.concatenate(slope), np.concatenate(of)


def _across(spin: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """[3, m] the cross products of columns of `spin` [3, m] with `arm` [3]."""
    x, y, z = arm
    return np.stack([spin[1] * z - spin[2] * y, spin[2] * x - spin[0] * z, spin[0] * y - spin[1] * x])
