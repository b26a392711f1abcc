"""Two states of one object, such as a door shut and open -> its joint: the moving part, and its screw motion.

The common surface of both states is static. The rest of one is matched with the rest of the other by ICP from many
starts, and by features in photos of both; the fitting motion with the least rotation and translation is a hinge or a
slider. If it is known where photos see through, hidden places do not count.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pipeline.cameras import Similarity
from sdfsim.base.console import plain
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_json, write_json
from sdfsim.geometry.bvh import ClosestPoint
from sdfsim.geometry.mesh import Mesh, sample_surface

JOINT, PART = "joint.json", "part"  # the file, and the name of the body
# Shares and limits are set by hand on two drawn sets, `hinged` and `sliding`, and on the meshes of tests/pipeline/
# test_joint.py, unless a comment says otherwise; no set was kept apart for testing them.
POINTS, MOST_POINTS = 8_000, 64_000  # on each surface: at first, and if little of it moves
ENOUGH = 1_500  # sufficient number of moving points
STILL = 0.02  # of the size: points nearer to the other state's surface do not move
LEAST = 0.01  # of the surface: a smaller moving part is noise
# In units of the limit of static:
FAR = 2.5  # distances are capped at this
HIDDEN = 0.3  # distance assumed for a point where the other state's photos do not look
COARSE, FINE = 5.0, 0.5  # search radius of ICP for partners, first and last
WIDE = 0.2  # of the part's size, smallest first search radius
FIT = 0.5  # largest mean distance of points for a motion that fits
MOST = 0.9  # of the surface: if more of it moves, the static rest is unknown (not tuned)
ROUNDS = 10  # of ICP at each search radius
FEW, BEST = 400, 10  # points with which all starts are tried, and how many starts continue with all points
ALIKE = 1.5  # times the least mean distance: motions that fit equally well, as for an object with symmetries
EXACT = 2e-5  # of the size: better fits count as equal (rounding of exact meshes)
DIP = math.radians(10.0)  # motions that differ by a smaller turn are the same local minimum
BESIDE = 0.1  # of the part's size: largest distance of a hinge from the part
SLIDES = math.radians(2.0)  # a motion with a smaller turn is a slide
PITCH = 0.05  # of the size: largest slide of a hinge along its axis
APART = 3.0  # times the limit of static: surfaces so far apart are two patches
SPECK = 0.1  # of the largest moving patch: a smaller one is noise
SURE = 0.9  # of the moving surface: if less of it follows the motion, the result says so
FOLLOWS = 0.6  # of the moving surface: if less of it follows one motion, more than one part has moved
AGREED = 12  # features at least that show the same motion (not tuned; a motion takes three)
BY_CHANCE = 0.05  # of the features that look alike: this share fits by chance
ONE = "give two states between which only one part has moved"
# Share of the difference between both states' surfaces that is the same everywhere. On rendered sets the joint was off
# by about as much.
COMMON = 0.1


@dataclass(frozen=True)
class Doubt:
    """Uncertainty of a joint, one standard deviation, see `_doubt`."""

    axis: float  # rad
    place: float  # m, of a hinge's axis, sideways
    travel: float  # rad or m


@dataclass(frozen=True)
class Joint:
    """A joint between a moving part and the static rest."""

    kind: Literal["hinge", "slider"]
    anchor: np.ndarray  # [3] m, a point of a hinge's axis, in the middle of the part; of a slider the part's middle
    axis: np.ndarray  # [3] unit vector, along which the second state is at a positive angle or position
    travel: float  # rad or m, from the first state to the second
    off: float  # m, mean distance of the part, moved, from the second state
    doubt: Doubt
    follows: float  # share of the moving surface that follows this motion, or that the other state's photos do not show
    size: float  # m, of the compared surfaces

    def line(self) -> str:
        """What was found, in words."""
        axis = ", ".join(f"{value:.3f}" for value in self.axis)
        where = ", ".join(f"{value:.4g}" for value in self.anchor)
        doubt = f"the uncertainty of the axis is {math.degrees(self.doubt.axis):.2g} degrees"
        way = f"slides by {self.travel:.3g} m along"
        if self.kind == "hinge":
            way = f"turns by {math.degrees(self.travel):.1f} degrees about"
            doubt += f" and {self.doubt.place:.2g} m"
        rest = (
            f"; {1 - self.follows:.0%} of the moved surface does not follow the motion" if self.follows < SURE else ""
        )
        fit = f"the two states fit to {100.0 * self.off / self.size:.2g} % of the size"
        return f"{self.kind}: a part {way} ({axis}) through ({where}) m; {fit}; {doubt}{rest}"


@dataclass(frozen=True)
class FoundJoint(Joint):
    """A joint in the frame of the first state."""

    motion: Similarity  # of the part, at scale 1
    moving: np.ndarray  # [F] bool, moving faces of the first state
    seen: tuple[np.ndarray, np.ndarray]  # [P, 3] m of the part's surface in the first and in the second state


Empty = Callable[[np.ndarray], np.ndarray]  # whether points [P, 3] m are where a state's photos see through, [P] bool
Pairs = tuple[np.ndarray, np.ndarray]  # [K, 3] m: the same points of the moving part, in one and in the other state


def find_joint(
    one: Mesh, other: Mesh, *, seed: int = 0, near: float | None = None, empty: tuple[Empty, Empty] | None = None,
    paired: Callable[[np.ndarray, np.ndarray], Pairs] | None = None,
) -> FoundJoint:  # fmt: skip
    """The joint between two states of one object, whose static surfaces coincide.

    Points within `near` m of the other state's surface are static. `empty` gives for both states the places through
    which photos see: the moving part has left such a place, or come to it. Without it all space without a surface is
    empty. `paired` gives points that look alike, with some wrong pairs, from the points [P, 3] m that move in one and
    in the other.

    Raises SdfsimError if nothing moves, if everything or several parts move, if no motion carries the part from one
    place to the other, or if the motion is neither that of a hinge nor that of a slider.
    """
    rng = np.random.default_rng(seed)
    size = float(np.linalg.norm(np.ptp(one.vertices, axis=0)))
    near = STILL * size if near is None else near
    on = ClosestPoint(one), ClosestPoint(other)
    clear = empty or (_everywhere, _everywhere)
    part, share = _moved(one, on[1], clear[1], near, rng)
    there, their_share = _moved(other, on[0], clear[0], near, rng)
    if share > MOST:
        raise SdfsimError("everything moves: the two states have nothing in common", "bring both into one frame first")
    # One state alone may show the part, as of a drawer.
    if max(share, their_share) < LEAST:
        raise SdfsimError(f"nothing moves: both states coincide within {100 * near / size:.2g} % of the size")
    part, there = _patches(part, APART * near), _patches(there, APART * near)
    pairs = (np.zeros((0, 3)), np.zeros((0, 3)))
    shown: Similarity | None = None
    if paired is not None:
        shown, pairs = _agreed(paired(part[0], there[0]), near)
    surfaces = _Surfaces(on, clear, part, there, pairs, near, size)
    few, width = surfaces.some(FEW), max(_extent(part[0]), _extent(there[0]))
    mid = part[0].mean(0) if len(part[0]) else pairs[0].mean(0)

    def tried(starts: list[Similarity]) -> list[_Rated]:
        """The best of the motions from these starts, each once."""
        reach = max(COARSE, WIDE * width / near)
        rough = [surfaces.rated(few.laid(start, (reach, 0.5 * reach, 0.25 * reach)), few) for start in starts]
        best: list[Similarity] = []
        for entry in sorted(rough, key=lambda entry: entry.cost):
            apart = [entry.motion.inverse().after(other) for other in best]
            if len(best) < BEST and not any(
                _screw(step, mid)[0] < SLIDES and np.linalg.norm(step.points(mid) - mid) < near for step in apart
            ):
                best.append(entry.motion)
        return [surfaces.rated(surfaces.laid(motion, FINISH), surfaces) for motion in best]

    # Matching features mark the same place, however many other places have the same shape.
    found = [] if shown is None else tried([shown])
    if not found or found[0].off > FIT * near:
        if not len(part[0]) or not len(there[0]):
            message = "the moving part is seen in one state only"
            raise SdfsimError(message, "photograph it from the same sides in both")
        found += tried(_starts(part[0], there[0]))
    least = max(min(entry.off for entry in found), EXACT * size)
    if least > FIT * near:
        told = f"no motion carries the moving part to its second place (best: {least:.3g} m off)"
        raise SdfsimError(told, ONE)

    # Order of motions that fit equally well, as for an object with symmetries: a hinge or a slider before a screw, a
    # hinge next to its part before one in the air, and then the smallest motion.
    def unlikely(entry: _Rated) -> tuple[bool, bool, float]:
        angle, axis, point, slide = _screw(entry.motion, mid)
        across = (part[0] if len(part[0]) else pairs[0]) - point
        beside = np.linalg.norm(across - np.outer(across @ axis, axis), axis=1).min()
        turns = angle > SLIDES
        screw, astray = turns and abs(slide) > PITCH * size, turns and bool(beside > BESIDE * width)
        return screw, astray, 0.5 * angle * width + abs(slide)

    lowest = max(min(entry.cost for entry in found), EXACT * size)
    fitting = [entry for entry in found if entry.cost <= ALIKE * lowest and entry.off <= FIT * near]
    chosen = min(fitting or found, key=unlikely)
    # Several starts lead into one local minimum: its lowest point counts.
    same = [entry for entry in fitting or found if _screw(entry.motion.after(chosen.motion.inverse()), mid)[0] < DIP]
    rated = min(same, key=lambda entry: entry.cost)
    if rated.follows < FOLLOWS:
        told = f"more than one part has moved: {1 - rated.follows:.0%} of what moved does not go with the rest"
        raise SdfsimError(told, ONE)
    angle, _, _, slide = _screw(rated.motion, mid)
    if angle > SLIDES and abs(slide) > PITCH * size:
        told = f"turns by {math.degrees(angle):.1f} degrees and slides by {slide:.3g} m along the same axis"
        raise SdfsimError(f"the part is on neither a hinge nor a slider: it {told}")
    motion = rated.motion
    if angle <= SLIDES:  # the slide that moves the middle like the motion
        motion = surfaces.laid(_shift(motion.points(mid) - mid), FINISH, turns=False)
    kind, anchor, axis, travel = _joint_of(motion, mid)
    cells = [np.unique(np.floor(points / (APART * near)), axis=0) for points in (part[0], there[0], pairs[0])]
    doubt = _doubt(kind, travel, rated.off, max(1, *map(len, cells)), 0.5 * width)
    seen = tuple(
        points[(away <= near) | hidden]
        for points, way, k in ((part[0], motion, 1), (there[0], motion.inverse(), 0))
        for away, hidden in [surfaces.carried(points, way, k)]
    )
    moving = _faces(one, motion, on[1], near)
    return FoundJoint(kind, anchor, axis, travel, rated.off, doubt, rated.follows, size, motion, moving, seen)  # type: ignore[arg-type]


def scene_keys(found: Joint) -> dict[str, Any]:
    """The joint as keys of scene.yaml, the limits from the two states, of which the first is the start."""
    keys: dict[str, Any] = {"anchor": found.anchor.tolist(), "axis": found.axis.tolist()}
    if found.kind == "hinge":
        return keys | {"limits_deg": [0.0, math.degrees(found.travel)]}
    return keys | {"limits": [0.0, found.travel]}


@dataclass(frozen=True)
class HeldPart(Joint):
    """A joint in the world of the state from which the scene is made."""

    turn: np.ndarray  # [3, 3] and shift [3]: from the part in the scene's meshes to the first state
    shift: np.ndarray
    metres: float  # a unit of this world in metres
    size_from: str  # its source, in words
    size_assumed: bool

    def moved(self, move: Similarity) -> HeldPart:
        """The same in another world."""
        home = move.after(Similarity(1.0, self.turn, self.shift)).after(move.inverse())
        long = 1.0 if self.kind == "hinge" else move.scale  # a unit of the joint's coordinate
        doubt = Doubt(self.doubt.axis, self.doubt.place * move.scale, self.doubt.travel * long)
        return replace(self, anchor=move.points(self.anchor), axis=move.rotation @ self.axis, travel=self.travel * long,
                       turn=home.rotation, shift=home.translation, metres=self.metres / move.scale,
                       off=self.off * move.scale, doubt=doubt, size=self.size * move.scale)  # fmt: skip

    def save(self, path: Path) -> None:
        """Writes it as JSON."""
        write_json(path, {"version": 1, **plain(asdict(self))})


def load_held(path: Path) -> HeldPart | None:
    """The joint that `HeldPart.save` wrote; None if there is none. Raises SdfsimError if the file is damaged."""
    if not path.exists():
        return None
    known = read_json(path)
    try:
        arrays = {key: np.array(known[key], float) for key in ("anchor", "axis", "turn", "shift")}
        plainly = {key: value for key, value in known.items() if key != "version"}
        return HeldPart(**{**plainly, **arrays, "doubt": Doubt(**known["doubt"])})
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run `sdfsim reconstruct --joint` again") from error


def _shift(way: np.ndarray) -> Similarity:
    """The slide by a way [3] m."""
    return Similarity(1.0, np.eye(3), way)


def _starts(moving: np.ndarray, moved: np.ndarray) -> list[Similarity]:
    """Motions to try: a slide, and turns about the principal axes of the part."""
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
    # Principal axes are unreliable if a part is only partly seen: so also turns about each by steps of a twelfth.
    for axis in frames[0].T:
        turns += [Rotation.from_rotvec(axis * angle).as_matrix() for angle in np.arange(1, 12) * (math.pi / 6.0)]
    found = [Similarity(1.0, turn, moved.mean(0) - turn @ moving.mean(0)) for turn in turns]
    # For a slide the middles are unreliable too: both states may show only one end or the other along each axis.
    ends = [[(points @ frames[1]).min(0), (points @ frames[1]).max(0)] for points in (moving, moved)]
    return found + [
        _shift(frames[1] @ [ends[1][end][k] - ends[0][end][k] for k, end in enumerate(which)])
        for which in np.ndindex(2, 2, 2)
    ]


def _away(surface: ClosestPoint, points: np.ndarray) -> np.ndarray:
    """[P] m, how far points are from a surface."""
    return np.linalg.norm(surface(points)[0] - points, axis=1) if len(points) else np.zeros(0)


def _extent(points: np.ndarray) -> float:
    """m, the diagonal of the box around points."""
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def _everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), bool)


Points = tuple[np.ndarray, np.ndarray]  # [P, 3] m of a surface, with the normals there
Reaches = tuple[float, ...]  # search radii for partners, in units of the limit of static, one after the other
FINISH: Reaches = (3.0 * FINE, FINE, FINE, FINE)


def _moved(
    mesh: Mesh, other: ClosestPoint, empty: Empty, near: float, rng: np.random.Generator
) -> tuple[Points, float]:
    """Points of a surface that the other state does not have, and their share of it."""
    points, normals = sample_surface(mesh, POINTS, rng)
    gone = _gone(points, other, empty, near)
    share = float(gone.mean())
    if share and gone.sum() < ENOUGH:
        points, normals = sample_surface(mesh, min(MOST_POINTS, int(ENOUGH / share)), rng)
        gone = _gone(points, other, empty, near)
    return (points[gone], normals[gone]), share


def _gone(points: np.ndarray, other: ClosestPoint, empty: Empty, near: float) -> np.ndarray:
    """[P] bool, points missing in the other state's surface, where its photos see through."""
    gone = _away(other, points) > near
    gone[gone] = empty(points[gone])
    return gone


def _patches(points: Points, gap: float) -> Points:
    """The points in the larger patches."""
    if not len(points[0]):
        return points
    links = KDTree(points[0]).sparse_distance_matrix(KDTree(points[0]), gap, output_type="coo_matrix")
    label = connected_components(links, directed=False)[1]
    count = np.bincount(label)
    kept = (count > SPECK * count.max())[label]
    return points[0][kept], points[1][kept]


def _agreed(pairs: Pairs, near: float) -> tuple[Similarity | None, Pairs]:
    """The motion that most pairs of points agree on, None if too few do, and these pairs."""
    import pycolmap

    options = pycolmap.RANSACOptions(max_error=near, max_num_trials=100_000, random_seed=0)
    found: Any = pycolmap.estimate_rigid3d_robust(*pairs, options) if len(pairs[0]) >= AGREED else None
    if found is None or found["num_inliers"] < max(AGREED, BY_CHANCE * len(pairs[0])):
        return None, (np.zeros((0, 3)), np.zeros((0, 3)))
    good, move = np.asarray(found["inlier_mask"], bool), found["tgt_from_src"]
    motion = Similarity(1.0, move.rotation.matrix(), np.asarray(move.translation))
    return motion, (pairs[0][good], pairs[1][good])


@dataclass(frozen=True)
class _Rated:
    """A motion of the part from the first state to the second, and how well it fits."""

    motion: Similarity
    cost: float  # m, the mean over moving points, with a small cost for hidden ones
    off: float  # m, the mean distance of visible moving points
    follows: float  # share of the moving points that it explains


@dataclass(frozen=True)
class _Surfaces:
    """The moving surface in both states, and the surfaces with which it is matched."""

    on: tuple[ClosestPoint, ClosestPoint]  # the whole surface of the first and of the second state
    empty: tuple[Empty, Empty]
    part: Points  # of the first state
    there: Points  # of the second
    pairs: Pairs
    near: float  # m
    size: float  # m

    def some(self, count: int) -> _Surfaces:
        """The same with fewer points."""

        def few(points: Points) -> Points:
            step = max(1, len(points[0]) // count)
            return points[0][::step], points[1][::step]

        step = max(1, len(self.pairs[0]) // count)
        pairs = self.pairs[0][::step], self.pairs[1][::step]
        return replace(self, part=few(self.part), there=few(self.there), pairs=pairs)

    def carried(self, points: np.ndarray, motion: Similarity, state: int) -> tuple[np.ndarray, np.ndarray]:
        """[P] m, distance of moved points from a state's surface, and whether its photos do not look there, so that a
        hidden surface may exist."""
        moved = motion.points(points)
        away = _away(self.on[state], moved)
        hidden = away > self.near
        hidden[hidden] = ~self.empty[state](moved[hidden])
        return away, hidden

    def rated(self, motion: Similarity, by: _Surfaces) -> _Rated:
        """How well a motion fits in both directions, so that no part of either surface is left over."""
        costs, offs, follow, count = [0.0], [0.0], 0.0, 0
        for (points, _), way, state in ((by.part, motion, 1), (by.there, motion.inverse(), 0)):
            if not len(points):
                continue
            away, hidden = self.carried(points, way, state)
            away = np.minimum(away, FAR * self.near)
            costs.append(float(np.where(hidden, HIDDEN * self.near, away).mean()))
            offs.append(float(away[~hidden].mean()) if (~hidden).mean() > LEAST else FAR * self.near)
            follow, count = follow + float((hidden | (away <= self.near)).sum()), count + len(points)
        return _Rated(motion, max(costs), max(offs), follow / max(count, 1))

    def laid(self, motion: Similarity, reaches: Reaches, *, turns: bool = True) -> Similarity:
        """A motion refined by point-to-plane ICP: of the part in the first state with the second's surface, and of the
        part in the second state with the first's, with shrinking search radii; and of pairs of points. If a part is
        flush in one state, its edges are seen in the other. Without `turns` the motion has no rotation."""
        for reach in reaches:
            shown = self._shown(motion)
            for _ in range(ROUNDS):
                step = shown._step(motion, reach * self.near, turns)
                if step is None:
                    break
                motion = step[0].after(motion)
                if step[1] < 1e-6 * self.size:
                    break
        return motion

    def _shown(self, motion: Similarity) -> _Surfaces:
        """The same without points that a motion carries to where the other state's photos do not look. They have no
        surface there, and the nearest one belongs to something else."""
        some = [
            (points[~hidden], normals[~hidden])
            for (points, normals), way, state in ((self.part, motion, 1), (self.there, motion.inverse(), 0))
            for hidden in [self.carried(points, way, state)[1]]
        ]
        return replace(self, part=some[0], there=some[1])

    def _step(self, motion: Similarity, reach: float, turns: bool) -> tuple[Similarity, float] | None:
        """A step of ICP and how long it is, m; None if too little has a partner."""
        turn, shift = motion.rotation, motion.translation
        here, facing = self.part[0] @ turn.T + shift, self.part[1] @ turn.T
        goal, normal = self.on[1](here) if len(here) else (here, facing)
        back, normal_back = self.on[0]((self.there[0] - shift) @ turn) if len(self.there[0]) else self.there
        # The moving points, their targets along a normal, and their present and wanted directions.
        moving = np.concatenate([here, back @ turn.T + shift])
        goal = np.concatenate([goal, self.there[0]])
        along = np.concatenate([normal, normal_back @ turn.T])
        alike = np.concatenate([(facing * normal).sum(1), (normal_back @ turn.T * self.there[1]).sum(1)])
        if len(self.pairs[0]):
            placed = self.pairs[0] @ turn.T + shift
            moving = np.concatenate([moving, np.repeat(placed, 3, axis=0)])
            goal = np.concatenate([goal, np.repeat(self.pairs[1], 3, axis=0)])
            along = np.concatenate([along, np.tile(np.eye(3), (len(placed), 1))])
            alike = np.concatenate([alike, np.ones(3 * len(placed))])
        distance = np.linalg.norm(goal - moving, axis=1)
        kept = (distance <= reach) & (alike > 0.5)
        if kept.sum() < 12:
            return None
        moving, goal, along = moving[kept], goal[kept], along[kept]
        # Surface seen in only one state has no partner, or a wrong one far away.
        weight = np.maximum(1.0 / (1.0 + (distance[kept] / (0.3 * reach)) ** 2), 0.05)
        middle = moving.mean(0)
        lever = moving - middle
        rows = np.concatenate([np.cross(lever, along), along], 1)
        wanted = ((goal - moving) * along).sum(1)
        scale = np.concatenate([np.full(3, np.sqrt((lever**2).sum(1).mean())), np.ones(3)])
        # Damping holds a part that can slide along itself by symmetry.
        heavy = (rows / scale) * weight[:, None]
        system = heavy.T @ (rows / scale) + 1e-6 * weight.sum() * np.eye(6)
        if not turns:
            system[:3, :3] += 1e6 * weight.sum() * np.eye(3)
        step = np.linalg.solve(system, heavy.T @ wanted) / scale
        if not turns:
            step[:3] = 0.0
        turned = Rotation.from_rotvec(step[:3]).as_matrix()
        change = Similarity(1.0, turned, middle + step[3:] - turned @ middle)
        return change, float(np.linalg.norm(step[3:]) + np.linalg.norm(step[:3]) * self.size)


def _doubt(kind: str, travel: float, off: float, patches: int, lever: float) -> Doubt:
    """The uncertainty of a joint whose states are `off` by so much, m, in independent `patches`: that of their mean,
    and the share that is common to all. An end of the part, `lever` m from its middle, may be off by that."""
    common = off * math.hypot(COMMON, 1.0 / math.sqrt(patches))
    tilt = common / lever
    if kind == "slider":
        return Doubt(common / travel, 0.0, common)
    # A shift of the part moves the axis until the turn about it compensates.
    return Doubt(tilt, common / (2.0 * math.sin(0.5 * min(travel, math.pi))), tilt)


def _joint_of(motion: Similarity, mid: np.ndarray) -> tuple[Literal["hinge", "slider"], np.ndarray, np.ndarray, float]:
    """Kind, anchor, axis and travel of a motion; the anchor is near `mid`."""
    angle, axis, point, _ = _screw(motion, mid)
    if angle > SLIDES:
        return "hinge", point, axis, angle
    way = motion.points(mid) - mid
    length = float(np.linalg.norm(way))
    return "slider", mid, way / length, length


def _screw(motion: Similarity, near: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Angle rad, axis, the point of it that is nearest to `near`, and the slide along it m, of a motion."""
    shift, vector = motion.translation, Rotation.from_matrix(motion.rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else np.array([1.0, 0.0, 0.0])
    if angle <= SLIDES:
        return angle, axis, near, float(np.linalg.norm(motion.points(near) - near))
    slide = float(axis @ shift)
    across = shift - slide * axis
    # (1 - R) x = t has this solution across the axis; any point along it will do.
    point = 0.5 * (across + np.cross(axis, across) / math.tan(0.5 * angle))
    return angle, axis, point + axis * (axis @ (near - point)), slide


def _faces(one: Mesh, motion: Similarity, other: ClosestPoint, near: float) -> np.ndarray:
    """[F] bool: faces that are off the second state's surface, and nearer to it after the motion."""
    middles = one.vertices[one.faces].mean(1)
    stays, moves = (_away(other, points) for points in (middles, motion.points(middles)))
    return (stays > 0.25 * near) & (moves < 0.5 * stays)
