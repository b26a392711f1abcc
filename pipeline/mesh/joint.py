"""Two states of one thing, such as a door shut and open -> its joint: the part that moves, and the screw that moves it.

What the surfaces of both states have in common stands still. The rest of the one is laid on the rest of the other by
ICP from many starts, and by what photos show of both; the motion with the least turn and slide of those that fit is a
hinge or a slider. Where it is known what the photos look through, what they do not show says nothing.
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
POINTS, MOST_POINTS = 8_000, 64_000  # on each surface: at first, and where little of it moves
ENOUGH = 1_500  # points that move are enough
STILL = 0.02  # of the size: what is nearer to the other state's surface does not move
LEAST = 0.01  # of the surface: less of it that moves is noise
# In units of what counts as still:
FAR = 2.5  # a point that is farther off counts as so far
HIDDEN = 0.3  # how far off a point counts that would be where the other state's photos do not look
COARSE, FINE = 5.0, 0.5  # how far ICP looks for partners, first and last
WIDE = 0.2  # of the part's size, how far it looks first at least
FIT = 0.5  # mean distance of points, of a motion that fits
MOST = 0.9  # of the surface: where more of it moves, nothing tells where the rest is
ROUNDS = 10  # of ICP at each reach
FEW, BEST = 400, 10  # points with which all starts are tried, and how many of these go on with all
ALIKE = 1.5  # times the least such distance: motions that fit as well, as those of a thing with symmetries do
EXACT = 2e-5  # of the size: what fits better fits as well
DIP = math.radians(10.0)  # motions that differ by a smaller turn are one, found less or more exactly
BESIDE = 0.1  # of the part's size: how far a hinge may be from the part
SLIDES = math.radians(2.0)  # a motion that turns by less is a slide
PITCH = 0.05  # of the size: a hinge that slides more along its axis is none
APART = 3.0  # times what counts as still: surfaces so far apart are two patches
SPECK = 0.1  # of the largest patch that moves: a smaller one is noise
SURE = 0.9  # of what moves: where less of it goes with the motion, what was found says so
FOLLOWS = 0.6  # of what moves: where less of it goes with one motion, more than one thing has moved
AGREED = 12  # features at least that show the same motion
BY_CHANCE = 0.05  # of the features that look alike: so many lie right by chance
ONE = "give two states between which one thing has moved"
# Of how far both states' surfaces differ: what is the same all over, and so no draw shows. On rendered sets the joint
# was off by about as much.
COMMON = 0.1
DRAWS = 8  # of patches of the surface, and features, by which the doubt is measured


@dataclass(frozen=True)
class Doubt:
    """How far a joint may be off, one standard deviation, see `_doubt`."""

    axis: float  # rad
    place: float  # m, of a hinge's axis beside itself
    travel: float  # rad or m


@dataclass(frozen=True)
class FoundJoint:
    """A joint between a part that moves and what stands still, in the frame of the first state."""

    kind: Literal["hinge", "slider"]
    anchor: np.ndarray  # [3] m, a point of a hinge's axis, in the middle of the part; of a slider the part's middle
    axis: np.ndarray  # [3] unit vector, along which the second state is at a positive angle or position
    travel: float  # rad or m, from the first state to the second
    motion: Similarity  # of the part, at scale 1
    moving: np.ndarray  # [F] bool, the faces of the first state that move
    off: float  # m, mean distance of the part, moved, from the second state
    doubt: Doubt
    follows: float  # share of what moves that goes with this motion, or that the other state's photos do not show
    seen: tuple[np.ndarray, np.ndarray]  # [P, 3] m of the part's surface in the first and in the second state

    def line(self, size: float) -> str:
        """What it found."""
        return _told(self, size)


Empty = Callable[[np.ndarray], np.ndarray]  # whether points [P, 3] m are where a state's photos see through, [P] bool
Pairs = tuple[np.ndarray, np.ndarray]  # [K, 3] m: the same places of what moves, in the one and in the other state


def find_joint(
    one: Mesh, other: Mesh, *, seed: int = 0, near: float | None = None, empty: tuple[Empty, Empty] | None = None,
    paired: Callable[[np.ndarray, np.ndarray], Pairs] | None = None,
) -> FoundJoint:  # fmt: skip
    """The joint between two states of one thing, whose surfaces lie in one frame where nothing moves.

    What is within `near` m of the other state's surface stands still. `empty` tells of both states where photos see
    through: what moves has left such a place, or come to it. Without it all that has no surface is empty. `paired`
    gives places that are alike, some of them wrongly, from the points [P, 3] m that move in the one and in the other.

    Raises SdfsimError if nothing moves, all does, several things do, no motion carries the one part onto the other,
    or the motion is that of neither a hinge nor a slider.
    """
    rng = np.random.default_rng(seed)
    size = float(np.linalg.norm(np.ptp(one.vertices, axis=0)))
    near = STILL * size if near is None else near
    on = ClosestPoint(one), ClosestPoint(other)
    clear = (_everywhere, _everywhere) if empty is None else empty
    part, share = _moved(one, on[1], clear[1], near, rng)
    there, their_share = _moved(other, on[0], clear[0], near, rng)
    if empty is None and share > MOST:
        raise SdfsimError("everything moves: the two states have nothing in common", "bring both into one frame first")
    # What photos see through tells one way alone where the part is hidden in the other state, as a drawer is.
    for some, which in ((share, "first"), (their_share, "second")):
        if some < LEAST and (empty is None or max(share, their_share) < LEAST):
            raise SdfsimError(f"nothing moves: the {which} state lies on the other within {100 * near / size:.2g} % "
                              "of the size")  # fmt: skip
    if empty is not None:
        part, there = _patches(part, APART * near), _patches(there, APART * near)
    pairs = (np.zeros((0, 3)), np.zeros((0, 3)))
    shown: Similarity | None = None
    if paired is not None:
        shown, pairs = _agreed(paired(part[0], there[0]), near)
    surfaces = _Surfaces(on, clear, part, there, pairs, near, size)
    few, width = surfaces.some(FEW), max(_extent(part[0]), _extent(there[0]))
    mid = part[0].mean(0) if len(part[0]) else pairs[0].mean(0)

    def tried(starts: list[Similarity]) -> list[_Rated]:
        """The best of the motions to which these lead, each once."""
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

    # What is alike by its looks is the same place, however many other places are shaped alike.
    found = [] if shown is None else tried([shown])
    if not found or found[0].off > FIT * near:
        if not len(part[0]) or not len(there[0]):
            message = "what moves is seen in one state only"
            raise SdfsimError(message, "photograph it from the same sides in both")
        found += tried(_starts(part[0], there[0]))
    least = max(min(entry.off for entry in found), EXACT * size)
    if least > FIT * near:
        told = f"no motion carries the part that moves onto its second place (best: {least:.3g} m off)"
        raise SdfsimError(told, ONE)

    # Of motions that fit as well, which a thing with symmetries has: a hinge or a slider before a screw, a hinge beside
    # its part before one in the air, and then the least motion.
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
    # Several starts lead into one dip: the deepest place of it counts.
    same = [entry for entry in fitting or found if _screw(entry.motion.after(chosen.motion.inverse()), mid)[0] < DIP]
    rated = min(same, key=lambda entry: entry.cost)
    if empty is not None and rated.follows < FOLLOWS:
        told = f"more than one thing has moved: {1 - rated.follows:.0%} of what moved does not go with the rest"
        raise SdfsimError(told, ONE)
    angle, _, _, slide = _screw(rated.motion, mid)
    if angle > SLIDES and abs(slide) > PITCH * size:
        told = f"turns by {math.degrees(angle):.1f} degrees and slides by {slide:.3g} m along the same axis"
        raise SdfsimError(f"the part is on neither a hinge nor a slider: it {told}")
    motion = rated.motion
    if angle <= SLIDES:  # the slide that takes the middle where the motion takes it
        motion = surfaces.laid(_shift(motion.points(mid) - mid), FINISH, turns=False)
    kind, anchor, axis, travel = _joint_of(motion, mid)
    doubt = _doubt(surfaces, motion, mid, COMMON * rated.off, 0.5 * width, rng)
    seen = tuple(
        points[(away <= near) | hidden]
        for points, way, k in ((part[0], motion, 1), (there[0], motion.inverse(), 0))
        for away, hidden in [surfaces.carried(points, way, k)]
    )
    moving = _faces(one, motion, on[1], near)
    return FoundJoint(kind, anchor, axis, travel, motion, moving, rated.off, doubt, rated.follows, seen)  # type: ignore[arg-type]


def scene_keys(found: FoundJoint | HeldPart) -> dict[str, Any]:
    """The joint as keys of scene.yaml, the limits from the two states, of which the first is the start."""
    keys: dict[str, Any] = {"anchor": found.anchor.tolist(), "axis": found.axis.tolist()}
    if found.kind == "hinge":
        return keys | {"limits_deg": [0.0, math.degrees(found.travel)]}
    return keys | {"limits": [0.0, found.travel]}


@dataclass(frozen=True)
class HeldPart:
    """A joint that was found between two states, in the world of the state of which the scene is made."""

    kind: Literal["hinge", "slider"]
    anchor: np.ndarray  # [3] on the axis
    axis: np.ndarray  # [3] unit
    travel: float  # rad, or a length, from the first state to the second
    turn: np.ndarray  # [3, 3] and shift [3]: from the part as the scene's meshes have it to the first state
    shift: np.ndarray
    metres: float  # a unit of this world in metres
    size_from: str  # where that is from, in words
    size_assumed: bool
    off: float  # as of `FoundJoint`, and so are the next two
    doubt: Doubt
    follows: float
    size: float  # of what both states were compared by

    def line(self) -> str:
        """What was found."""
        return _told(self, self.size)

    def moved(self, move: Similarity) -> HeldPart:
        """The same in another world."""
        home = move.after(Similarity(1.0, self.turn, self.shift)).after(move.inverse())
        long = 1.0 if self.kind == "hinge" else move.scale  # a unit of what the joint measures
        doubt = Doubt(self.doubt.axis, self.doubt.place * move.scale, self.doubt.travel * long)
        return replace(self, anchor=move.points(self.anchor), axis=move.rotation @ self.axis, travel=self.travel * long,
                       turn=home.rotation, shift=home.translation, metres=self.metres / move.scale,
                       off=self.off * move.scale, doubt=doubt, size=self.size * move.scale)  # fmt: skip

    def save(self, path: Path) -> None:
        """Writes it as JSON."""
        write_json(path, {"version": 1, **plain(asdict(self))})


def load_held(path: Path) -> HeldPart | None:
    """What `HeldPart.save` wrote; None if nothing is there. Raises SdfsimError: damaged."""
    if not path.exists():
        return None
    known = read_json(path)
    try:
        arrays = {key: np.array(known[key], float) for key in ("anchor", "axis", "turn", "shift")}
        plainly = {key: value for key, value in known.items() if key != "version"}
        return HeldPart(**{**plainly, **arrays, "doubt": Doubt(**known["doubt"])})
    except (ValueError, KeyError, TypeError) as error:
        raise SdfsimError(f"{path}: damaged", "run `sdfsim reconstruct --joint` again") from error


def _told(joint: FoundJoint | HeldPart, size: float) -> str:
    """What was found, in words; the surfaces that were compared are of a size, m."""
    axis = ", ".join(f"{value:.3f}" for value in joint.axis)
    where = ", ".join(f"{value:.4g}" for value in joint.anchor)
    doubt = f"the axis is sure to {math.degrees(joint.doubt.axis):.2g} degrees"
    if joint.kind == "hinge":
        way = f"turns by {math.degrees(joint.travel):.1f} degrees about"
        doubt += f" and {joint.doubt.place:.2g} m"
    else:
        way = f"slides by {joint.travel:.3g} m along"
    rest = f"; {1 - joint.follows:.0%} of what moved does not go with it" if joint.follows < SURE else ""
    fit = f"the two states fit with {100.0 * joint.off / size:.2g} % of the size off"
    return f"{joint.kind}: a part {way} ({axis}) through ({where}) m; {fit}; {doubt}{rest}"


def _shift(way: np.ndarray) -> Similarity:
    """The slide by a way [3] m."""
    return Similarity(1.0, np.eye(3), way)


def _starts(moving: np.ndarray, moved: np.ndarray) -> list[Similarity]:
    """Motions to try: a slide; and turns, about the principal axes of the part, by which it may have gone."""
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
    found = [Similarity(1.0, turn, moved.mean(0) - turn @ moving.mean(0)) for turn in turns]
    # Of a slide the middles tell little either: the one or the other end along each axis may be what both show.
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
Reaches = tuple[float, ...]  # how far partners may be, in units of what counts as still, one after the other
FINISH: Reaches = (3.0 * FINE, FINE, FINE, FINE)


def _moved(
    mesh: Mesh, other: ClosestPoint, empty: Empty, near: float, rng: np.random.Generator
) -> tuple[Points, float]:
    """Points of a surface that the other state does not have, and what share of it they are."""
    points, normals = sample_surface(mesh, POINTS, rng)
    gone = _gone(points, other, empty, near)
    share = float(gone.mean())
    if share and gone.sum() < ENOUGH and empty is not _everywhere:
        points, normals = sample_surface(mesh, min(MOST_POINTS, int(ENOUGH / share)), rng)
        gone = _gone(points, other, empty, near)
    return (points[gone], normals[gone]), share


def _gone(points: np.ndarray, other: ClosestPoint, empty: Empty, near: float) -> np.ndarray:
    """[P] bool, points that the other state's surface has not, where its photos see through."""
    gone = _away(other, points) > near
    gone[gone] = empty(points[gone])
    return gone


def _patches(points: Points, gap: float) -> Points:
    """Those points that lie in the larger patches."""
    if not len(points[0]):
        return points
    links = KDTree(points[0]).sparse_distance_matrix(KDTree(points[0]), gap, output_type="coo_matrix")
    label = connected_components(links, directed=False)[1]
    count = np.bincount(label)
    kept = (count > SPECK * count.max())[label]
    return points[0][kept], points[1][kept]


def _agreed(pairs: Pairs, near: float) -> tuple[Similarity | None, Pairs]:
    """The motion that most pairs of places agree on, None if too few do, and these pairs."""
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
    cost: float  # m, the mean over what moves, the hidden counting a little
    off: float  # m, the mean distance of what moves where it can be seen
    follows: float  # share of what moves that it explains


@dataclass(frozen=True)
class _Surfaces:
    """What moves, in both states, and what it is to be laid on."""

    on: tuple[ClosestPoint, ClosestPoint]  # all of the surface of the first and of the second state
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
        """[P] m, how far points, moved, are from a state's surface, and whether they are where its photos do not look
        and so may have one."""
        moved = motion.points(points)
        away = _away(self.on[state], moved)
        hidden = away > self.near
        hidden[hidden] = ~self.empty[state](moved[hidden])
        return away, hidden

    def rated(self, motion: Similarity, by: _Surfaces) -> _Rated:
        """How well a motion fits, both ways: nothing of either part is to be left over."""
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
        """A motion made better by ICP, points to planes: of the part in the first state on the second's surface, and of
        the part in the second state on the first's, looking ever nearer; and of pairs of places on each other. Edges of
        a part that lies flush in the one state are seen in the other. Without `turns` it does not turn."""
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
        """The same without points that a motion carries to where the other state's photos do not look. There is no
        surface for them, and the nearest one is another's."""
        if self.empty == (_everywhere, _everywhere):
            return self
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
        # What moves, where it is to go along a normal, and which way it faces and should.
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
        # What is seen in one state only has no partner, or a wrong one, which is far.
        weight = np.maximum(1.0 / (1.0 + (distance[kept] / (0.3 * reach)) ** 2), 0.05)
        middle = moving.mean(0)
        lever = moving - middle
        rows = np.concatenate([np.cross(lever, along), along], 1)
        wanted = ((goal - moving) * along).sum(1)
        scale = np.concatenate([np.full(3, np.sqrt((lever**2).sum(1).mean())), np.ones(3)])
        # A part that symmetry lets slide along itself is held where it is.
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

    def drawn(self, rng: np.random.Generator) -> _Surfaces:
        """The same with patches of the surface, and pairs, drawn with replacement."""

        def draw(points: Points) -> Points:
            if not len(points[0]):
                return points
            cell = np.unique(np.floor(points[0] / (APART * self.near)).astype(int), axis=0, return_inverse=True)[
                1
            ].ravel()
            often = np.bincount(rng.integers(0, cell.max() + 1, cell.max() + 1), minlength=cell.max() + 1)[cell]
            return np.repeat(points[0], often, axis=0), np.repeat(points[1], often, axis=0)

        pairs = self.pairs
        if len(pairs[0]):
            some = rng.integers(0, len(pairs[0]), len(pairs[0]))
            pairs = pairs[0][some], pairs[1][some]
        return replace(self, part=draw(self.part), there=draw(self.there), pairs=pairs)


def _doubt(
    surfaces: _Surfaces, motion: Similarity, mid: np.ndarray, common: float, lever: float, rng: np.random.Generator
) -> Doubt:  # fmt: skip
    """How far the joint differs, in the mean, when it is found from other draws of what moves (the bootstrap), and by
    what all draws have in `common`, m: an end of the part, `lever` m from its middle, may be off by that."""
    kind, anchor, axis, travel = _joint_of(motion, mid)
    found = []
    for _ in range(DRAWS):
        again = surfaces.drawn(rng).laid(motion, (FINE, FINE), turns=kind == "hinge")
        _, point, direction, way = _joint_of(again, mid)
        apart = point - anchor
        found.append((math.acos(min(1.0, abs(float(direction @ axis)))),
                      float(np.linalg.norm(apart - axis * (apart @ axis))), way - travel))  # fmt: skip
    axis_off, place, way_off = np.sqrt(np.square(found).mean(0))
    tilt = common / lever
    if kind == "slider":
        return Doubt(float(np.hypot(axis_off, common / travel)), 0.0, float(np.hypot(way_off, common)))
    # A shift of the part moves the axis so far that turning about it makes up for that.
    shifted = common / (2.0 * math.sin(0.5 * min(travel, math.pi)))
    return Doubt(float(np.hypot(axis_off, tilt)), float(np.hypot(place, shifted)), float(np.hypot(way_off, tilt)))


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
    """[F] bool: faces that are off the second state's surface, and nearer to it once they are moved."""
    middles = one.vertices[one.faces].mean(1)
    stays, moves = (_away(other, points) for points in (middles, motion.points(middles)))
    return (stays > 0.25 * near) & (moves < 0.5 * stays)
