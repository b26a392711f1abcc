"""Two states of one thing, such as a door shut and open -> its joint: the part that moves, and the screw that moves it.

What the surfaces of both states have in common stands still. The rest of the one is laid on the rest of the other by
ICP from many starts; the motion with the least turn and slide of those that fit is a hinge or a slider.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.bvh import ClosestPoint
from sdfsim.geometry.mesh import Mesh, sample_surface

POINTS = 8_000  # on each surface
STILL = 0.02  # of the size: what is nearer to the other state's surface does not move
LEAST = 0.01  # of the surface: less of it that moves is noise
FAR = 0.05  # of the size: a point that is farther off counts as so far
MOST = 0.9  # of the surface: where more of it moves, nothing tells where the rest is
COARSE, FINE = 0.1, 0.01  # of the size: how far ICP looks for partners, first and last
ROUNDS = 10  # of ICP at each reach
FEW, BEST = 400, 10  # points with which all starts are tried, and how many of these go on with all
FIT = 0.01  # of the size: mean distance of points, of a motion that fits
ALIKE = 1.5  # times the least such distance: motions that fit as well, as those of a thing with symmetries do
EXACT = 2e-5  # of the size: what fits better fits as well
DIP = math.radians(10.0)  # motions that differ by a smaller turn are one, found less or more exactly
BESIDE = 0.1  # of the part's size: how far a hinge may be from the part
SLIDES = math.radians(2.0)  # a motion that turns by less is a slide
PITCH = 0.05  # of the size: a hinge that slides more along its axis is none


@dataclass(frozen=True)
class FoundJoint:
    """A joint between a part that moves and what stands still, in the frame of the first state."""

    kind: Literal["hinge", "slider"]
    anchor: np.ndarray  # [3] m, a point of a hinge's axis, in the middle of the part; of a slider the part's middle
    axis: np.ndarray  # [3] unit vector, along which the second state is at a positive angle or position
    travel: float  # rad or m, from the first state to the second
    turn: np.ndarray  # [3, 3] and shift [3] m: the motion of the part
    shift: np.ndarray
    moving: np.ndarray  # [F] bool, the faces of the first state that move
    off: float  # m, mean distance of the part, moved, from the second state

    def line(self, size: float) -> str:
        """What it found."""
        axis = ", ".join(f"{value:.3f}" for value in self.axis)
        told = (
            f"turns by {math.degrees(self.travel):.1f} degrees about"
            if self.kind == "hinge"
            else (f"slides by {self.travel:.3g} m along")
        )
        where = ", ".join(f"{value:.4g}" for value in self.anchor)
        share = f"{100.0 * self.off / size:.2g} % of the size off"
        return f"{self.kind}: a part {told} ({axis}) through ({where}) m; the two states fit with {share}"


def find_joint(one: Mesh, other: Mesh, *, seed: int = 0) -> FoundJoint:
    """The joint between two states of one thing, whose surfaces lie in one frame where nothing moves.

    Raises SdfsimError where nothing moves, all does, no motion carries the one part onto the other, or the motion is
    that of neither a hinge nor a slider.
    """
    rng = np.random.default_rng(seed)
    size = float(np.linalg.norm(np.ptp(one.vertices, axis=0)))
    points, normals = sample_surface(one, POINTS, rng)
    theirs, facing = sample_surface(other, POINTS, rng)
    on = ClosestPoint(one), ClosestPoint(other)
    near = STILL * size
    goes, comes = _away(on[1], points) > near, _away(on[0], theirs) > near
    for rows, which in ((goes, "first"), (comes, "second")):
        if rows.mean() < LEAST:
            raise SdfsimError(
                f"nothing moves: the {which} state lies on the other within {100 * STILL:g} % of the size"
            )
    if goes.mean() > MOST:
        raise SdfsimError("all moves: the two states have nothing in common", "bring both into one frame first")
    part, there = (points[goes], normals[goes]), (theirs[comes], facing[comes])

    def tried(motion: np.ndarray) -> tuple[float, np.ndarray]:
        """Off, both ways: nothing of either part is to be left over."""
        back = np.linalg.inv(motion)
        return max(_off(part[0], motion, on[1], FAR * size), _off(there[0], back, on[0], FAR * size)), motion

    few = [(some[0][:: max(1, len(some[0]) // FEW)], some[1][:: max(1, len(some[0]) // FEW)]) for some in (part, there)]
    rough = [tried(_laid(few[0], few[1], start, on, size)) for start in _starts(part[0], there[0])]
    rough.sort(key=lambda entry: entry[0])
    found, mid = [], part[0].mean(0)
    for _, motion in rough[:BEST]:
        off, motion = tried(_laid(part, there, motion, on, size, reaches=(3.0 * FINE, FINE, FINE, FINE)))
        found.append((off, *_screw(motion, mid), motion))
    least = max(min(off for off, *_ in found), EXACT * size)
    if least > FIT * size:
        raise SdfsimError(f"no motion carries the part that moves onto its second place (best: {least:.3g} m off)")
    # Of motions that fit as well, which a thing with symmetries has: a hinge or a slider before a screw, a hinge beside
    # its part before one in the air, and then the least motion.
    width = float(np.linalg.norm(np.ptp(part[0], axis=0)))

    def unlikely(entry: tuple[float, float, np.ndarray, np.ndarray, float, np.ndarray]) -> tuple[bool, bool, float]:
        _, angle, axis, point, slide, _ = entry
        across = part[0] - point
        beside = np.linalg.norm(across - np.outer(across @ axis, axis), axis=1).min()
        turns = angle > SLIDES
        screw, astray = turns and abs(slide) > PITCH * size, turns and bool(beside > BESIDE * width)
        return screw, astray, 0.5 * angle * width + abs(slide)

    fitting = [entry for entry in found if entry[0] <= ALIKE * least]
    chosen = min(fitting, key=unlikely)
    # Several starts lead into one dip: the deepest place of it counts.
    same = [entry for entry in fitting if _screw(entry[-1] @ np.linalg.inv(chosen[-1]), mid)[0] < DIP]
    off, angle, axis, point, slide, motion = min(same, key=lambda entry: entry[0])
    turn, shift = motion[:3, :3], motion[:3, 3]
    moving = _faces(one, motion, on[1], near)
    if angle <= SLIDES:
        middle = points[goes].mean(0)
        way = turn @ middle + shift - middle
        length = float(np.linalg.norm(way))
        return FoundJoint("slider", middle, way / length, length, turn, shift, moving, off)
    if abs(slide) > PITCH * size:
        told = f"turns by {math.degrees(angle):.1f} degrees and slides by {slide:.3g} m along the same axis"
        raise SdfsimError(f"the part is on neither a hinge nor a slider: it {told}")
    return FoundJoint("hinge", point, axis, angle, turn, shift, moving, off)


def scene_keys(found: FoundJoint) -> dict[str, Any]:
    """The joint as keys of scene.yaml, the limits from the two states, of which the first is the start."""
    keys: dict[str, Any] = {"anchor": found.anchor.tolist(), "axis": found.axis.tolist()}
    if found.kind == "hinge":
        return keys | {"limits_deg": [0.0, math.degrees(found.travel)]}
    return keys | {"limits": [0.0, found.travel]}


def split(mesh: Mesh, moving: np.ndarray) -> tuple[Mesh, Mesh]:
    """The part that moves, and the rest."""
    return tuple(replace(mesh, faces=mesh.faces[rows]) for rows in (moving, ~moving))  # type: ignore[return-value]


def _starts(moving: np.ndarray, moved: np.ndarray) -> list[np.ndarray]:
    """[4, 4] motions to try: a slide; and turns, about the principal axes of the part, by which it may have gone."""
    found = []
    frames = []
    for points in (moving, moved):
        centred = points - points.mean(0)
        frames.append(np.linalg.svd(centred[:: max(1, len(centred) // 4000)], full_matrices=False)[2].T)
    turns = [np.eye(3)]
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        for signs in np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)]):
            turn = (frames[1][:, order] * signs) @ frames[0].T
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    # Principal axes tell little where a part is seen in part: also turns about each by steps of a twelfth.
    for axis in frames[0].T:
        turns += [Rotation.from_rotvec(axis * angle).as_matrix() for angle in np.arange(1, 12) * (math.pi / 6.0)]
    for turn in turns:
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = turn, moved.mean(0) - turn @ moving.mean(0)
        found.append(start)
    return found


def _away(surface: ClosestPoint, points: np.ndarray) -> np.ndarray:
    """[P] m, how far points are from a surface."""
    return np.linalg.norm(surface(points)[0] - points, axis=1)


Points = tuple[np.ndarray, np.ndarray]  # [P, 3] m of a surface, with the normals there


def _laid(
    part: Points, there: Points, start: np.ndarray, on: tuple[ClosestPoint, ClosestPoint], size: float,
    reaches: Sequence[float] = (COARSE, 0.5 * COARSE, 0.25 * COARSE),
) -> np.ndarray:  # fmt: skip
    """[4, 4] by ICP, points to planes: of the part in the first state on the second's surface, and of the part in the
    second state on the first's, looking ever nearer. Edges of a part that lies flush in the one state are seen in the
    other."""
    motion = start.copy()
    for reach in reaches:
        for _ in range(ROUNDS):
            turn, shift = motion[:3, :3], motion[:3, 3]
            here, facing = part[0] @ turn.T + shift, part[1] @ turn.T
            goal, normal = on[1](here)
            back, normal_back = on[0]((there[0] - shift) @ turn)
            # What moves, where it is to go along a normal, and which way it faces and should.
            moving = np.concatenate([here, back @ turn.T + shift])
            goal = np.concatenate([goal, there[0]])
            along = np.concatenate([normal, normal_back @ turn.T])
            alike = np.concatenate([(facing * normal).sum(1), (normal_back @ turn.T * there[1]).sum(1)])
            distance = np.linalg.norm(goal - moving, axis=1)
            kept = (distance <= reach * size) & (alike > 0.5)
            if kept.sum() < 12:
                break
            moving, goal, along = moving[kept], goal[kept], along[kept]
            # What is seen in one state only has no partner, or a wrong one, which is far.
            weight = np.maximum(1.0 / (1.0 + (distance[kept] / (0.3 * reach * size)) ** 2), 0.05)
            middle = moving.mean(0)
            lever = moving - middle
            rows = np.concatenate([np.cross(lever, along), along], 1)
            wanted = ((goal - moving) * along).sum(1)
            scale = np.concatenate([np.full(3, np.sqrt((lever**2).sum(1).mean())), np.ones(3)])
            # A part that symmetry lets slide along itself is held where it is.
            heavy = (rows / scale) * weight[:, None]
            system = heavy.T @ (rows / scale) + 1e-6 * weight.sum() * np.eye(6)
            step = np.linalg.solve(system, heavy.T @ wanted) / scale
            change = np.eye(4)
            change[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
            change[:3, 3] = middle + step[3:] - change[:3, :3] @ middle
            motion = change @ motion
            if np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * size < 1e-6 * size:
                break
    return motion


def _off(points: np.ndarray, motion: np.ndarray, surface: ClosestPoint, most: float) -> float:
    """m, the mean distance of moved points from a surface, of each at most so much: a part may be seen in one state
    only."""
    return float(np.minimum(_away(surface, points @ motion[:3, :3].T + motion[:3, 3]), most).mean())


def _screw(motion: np.ndarray, near: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Angle rad, axis, the point of it that is nearest to `near`, and the slide along it m, of a motion [4, 4]."""
    turn, shift = motion[:3, :3], motion[:3, 3]
    vector = Rotation.from_matrix(turn).as_rotvec()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else np.array([1.0, 0.0, 0.0])
    if angle <= SLIDES:
        return angle, axis, near, float(np.linalg.norm(turn @ near + shift - near))
    slide = float(axis @ shift)
    across = shift - slide * axis
    # (1 - R) x = t has this solution across the axis; any point along it will do.
    point = 0.5 * (across + np.cross(axis, across) / math.tan(0.5 * angle))
    return angle, axis, point + axis * (axis @ (near - point)), slide


def _faces(one: Mesh, motion: np.ndarray, other: ClosestPoint, near: float) -> np.ndarray:
    """[F] bool: faces that are off the second state's surface, and nearer to it once they are moved."""
    middles = one.vertices[one.faces].mean(1)
    stays, moves = (_away(other, points) for points in (middles, middles @ motion[:3, :3].T + motion[:3, 3]))
    return (stays > 0.25 * near) & (moves < 0.5 * stays)
