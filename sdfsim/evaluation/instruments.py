"""Instruments that judge a motion, whatever made it: overlap and free space between true surfaces, and an account of
energy.

Nothing here uses the contact search, baked grids or the solver's own penetration: only poses, velocities, shapes'
closed forms and meshes.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sdfsim.base.lazy import made_once
from sdfsim.base.parallel import Progress, silent
from sdfsim.evaluation.true_surfaces import Gaps, Placed, TrueSurface, gaps, true_surface
from sdfsim.physics import pose
from sdfsim.physics.bodies import largest_extent
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.builder import SceneBuilder, loaded
from sdfsim.scene.collision_filter import contact_groups
from sdfsim.scene.scene import Joint, Scene
from sdfsim.shape.shape import Shape

DEEP = 0.01  # relative to the smaller thickness of two bodies: a deeper overlap is reported
FREE = 0.005  # likewise: wider free space around a body that something pushes or holds up is reported
MADE = 0.01  # relative to the available energy: larger gains from nothing are reported
SHARE = 0.1  # available energy is at least this part of what lifts a body by its own size
FADE = 0.9  # whenever energy falls to a new low, this part of the earlier available energy stays available
PART, LEAST = 0.05, 0.1  # part of a run's time that measuring surfaces may take, and s that it may always take
FEW, MANY = 32, 4096  # pairs that are measured together: at first, and at most
LOOSE = 0.001  # relative to the size of the smaller body: how far a joint's parts may be apart
TOUCH = 0.01  # relative to the mean size of the dynamic bodies: surfaces that are nearer than this touch
IMPACTS = 6  # frames after an impact in which surfaces are always measured
FEW_BODIES = 64  # dynamic bodies: with more, only their total energy is accounted for


@dataclass(frozen=True)
class Energy:
    """Energy that came from nothing: mechanical energy may be lost, but only pulls and bodies on paths may add to it.

    Attributes:
        sum_J: total gain over all steps in which energy grew.
        worst: the largest gain of a step, relative to the energy available then.
        steps_above_1_percent: the part of the steps that gained more than 0.01 of that.
        climb_J: the largest rise of energy above an earlier time, of the scene, or of one body while it touched no
            other moving body.
        climb: likewise, relative to the energy available at that earlier time: kinetic energy, what it gained in
            falling since, and a tenth of what lifts the body by its own size.
        body: the body of this rise; empty for the scene.
        at_s: time of this rise, s.
    """

    sum_J: float
    worst: float
    steps_above_1_percent: float
    climb_J: float
    climb: float
    body: str
    at_s: float


class Near(NamedTuple):
    """Two bodies that overlap, or that are apart although something acts on one of them."""

    metres: float  # depth or distance
    part: float  # the same, relative to the smaller thickness of the two
    first: str
    second: str  # empty if nothing is near
    at_s: float


@dataclass(frozen=True)
class Verdict:
    """What the instruments say of a motion.

    Attributes:
        energy: see `Energy`.
        overlap: the deepest overlap of two bodies, relative to the smaller thickness; None if there is none.
        floating: the widest free space around a body that was nevertheless pushed or held up; None if there is none.
        frames: number of frames in which surfaces were measured.
        broken: one line for each law that is broken.
    """

    energy: Energy
    overlap: Near | None
    floating: Near | None
    frames: int
    broken: tuple[str, ...]

    def report(self) -> dict[str, Any]:
        """As plain numbers, for report.json."""
        return {
            "energy_from_nothing": vars(self.energy),
            "overlap": None if self.overlap is None else self.overlap._asdict(),
            "floating": None if self.floating is None else self.floating._asdict(),
            "frames_measured": self.frames,
            "broken_laws": list(self.broken),
        }


def judged(
    scene: Scene | SceneBuilder | Path | str, rollout: Rollout, *, seconds: float = np.inf, every: int = 1,
    on_progress: Progress = silent,
) -> Verdict:  # fmt: skip
    """Check a motion of a scene against the laws that hold for all rigid bodies.

    Surfaces are always measured in the first frame, the last, and those after the hardest impacts; and in every
    `every`-th frame, or in fewer of these, spread evenly, if that would take longer than `seconds`. `on_progress` is
    called with the share of these frames that are measured. A scene that is not loaded yet is loaded as `Simulator`
    does.
    """
    scene = loaded(scene)
    energy = energy_account(scene, rollout)
    overlap, floating, frames = _surfaces(scene, rollout, seconds, every, on_progress)
    broken = []
    loose = _loosest(scene, rollout)
    if loose is not None and loose.part > LOOSE:
        broken.append(
            f"joint: {loose.first!r} is {loose.metres:.2g} m off at {loose.at_s:.2f} s, "
            f"{100 * loose.part:.2g} % of the size of its smaller body"
        )
    if overlap is not None and overlap.part > DEEP:
        broken.append(
            f"overlap: {overlap.first!r} and {overlap.second!r} are {overlap.metres:.2g} m deep in each other at "
            f"{overlap.at_s:.2f} s, {100 * overlap.part:.2g} % of the thinner one's thickness"
        )
    if floating is not None:
        beside = f"{floating.second!r} is {floating.metres:.2g} m away" if floating.second else "nothing is near it"
        broken.append(f"floating: {floating.first!r} is held or pushed at {floating.at_s:.2f} s, and {beside}")
    if energy.climb > MADE or energy.worst > MADE:
        whose = f" of {energy.body!r}" if energy.body else ""
        steps = f"{100 * energy.steps_above_1_percent:.1f} % of the steps gained more than 1 % of the available energy"
        broken.append(
            f"energy from nothing: {energy.climb_J:.3g} J{whose} by {energy.at_s:.2f} s, {100 * energy.climb:.2g} % of "
            f"the available energy; {steps}, the worst {100 * energy.worst:.2g} %"
        )
    return Verdict(energy, overlap, floating, frames, tuple(broken))


# --- energy ---


def energies(scene: Scene, rollout: Rollout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every body (0 unless it is dynamic): kinetic and potential energy [T+1, N] J, the latter relative to the
    first frame, and the energy that lifts it by its own size [N] J."""
    shape = rollout.position.shape[:2]
    kinetic, potential, lift = np.zeros(shape), np.zeros(shape), np.zeros(shape[1])
    strength = float(np.linalg.norm(scene.gravity))
    for k, body in enumerate(scene.bodies):
        if body.motion != "dynamic":
            continue
        own = scene.shapes[body.shape]
        inertia = body.inertia
        if inertia is None:
            inertia = own.inertia * (body.mass / own.volume * body.scale**2)
        local = pose.rotate(pose.conjugate(rollout.orientation[:, k]), rollout.angular_velocity[:, k])
        spin = np.einsum("ti,ij,tj->t", local, inertia, local)
        kinetic[:, k] = 0.5 * body.mass * np.square(rollout.velocity[:, k]).sum(1) + 0.5 * spin
        potential[:, k] = -body.mass * (rollout.position[:, k] - rollout.position[0, k]) @ scene.gravity
        lift[k] = body.mass * strength * body.scale * float(np.ptp(own.sdf.bounds, axis=0).max())
    return kinetic, potential, lift


def energy_account(scene: Scene, rollout: Rollout) -> Energy:
    """How much mechanical energy has grown, step by step and in all. Work of pulls and pushes (the counter
    `energy_given`) is subtracted; steps in which a body on a path touches something are not limited."""
    kinetic, potential, lift = energies(scene, rollout)
    steps, count = len(rollout), len(scene.bodies)
    dynamic = np.array([b.motion == "dynamic" for b in scene.bodies])
    driven = np.array([b.motion == "kinematic" for b in scene.bodies])
    work = rollout.counters.get("energy_given", np.zeros(steps + 1))
    joined = held_bodies(scene)
    alone = 1 < dynamic.sum() and (dynamic | driven).sum() <= FEW_BODIES
    beside = _beside(scene, rollout) if alone or driven.any() else np.zeros((steps + 1, count, count), bool)
    led = np.asarray(beside[:, driven].any((1, 2)))
    if any(driven[b] for joint in _joints(scene) for b in joint.bodies if b >= 0):
        led[:] = True
    total = (kinetic + potential).sum(1) + _of_springs(scene, rollout)
    change = np.diff(total) - work[1:]
    change[led[1:]] = np.minimum(change[led[1:]], 0.0)
    change[np.abs(change) < 1e-12 * (np.abs(potential).max(initial=0.0) + kinetic.max(initial=0.0))] = 0.0
    course = np.concatenate([[0.0], np.cumsum(change)])
    floor = SHARE * float(lift.sum())
    climb_J, climb, when = _climb(course[:, None], kinetic.sum(1)[:, None], np.array([floor]), None)
    best = (float(climb_J[0]), float(climb[0]), "", float(rollout.time[when[0]]))
    if alone:
        rows = np.flatnonzero(dynamic)
        shared = beside.any(2) | np.asarray(work != 0)[:, None] | joined
        climbs = _climb((kinetic + potential)[:, rows], kinetic[:, rows], SHARE * lift[rows], shared[:, rows])
        k = int(climbs[1].argmax())
        if climbs[1][k] > best[1]:
            name = scene.bodies[rows[k]].name
            best = (float(climbs[0][k]), float(climbs[1][k]), name, float(rollout.time[climbs[2][k]]))
    gain = change.clip(min=0.0)
    in_play = np.maximum.accumulate(kinetic.sum(1))[:-1] + float(lift.sum())
    part = np.divide(gain, in_play, out=np.zeros_like(gain), where=in_play > 0)
    return Energy(float(gain.sum()), float(part.max(initial=0.0)), float((part > MADE).mean()) if steps else 0.0, *best)


def _joints(scene: Scene) -> tuple[Joint, ...]:
    """The joints that are switched on."""
    return () if scene.effects.joints == "off" else scene.joints


def held_bodies(scene: Scene) -> np.ndarray:
    """[N] bool, the bodies that joints hold: joints may push and pull them without contact."""
    held = np.zeros(len(scene.bodies), bool)
    held[[b for joint in _joints(scene) for b in joint.bodies if b >= 0]] = True
    return held


def _of_springs(scene: Scene, rollout: Rollout) -> np.ndarray:
    """[T+1] J, the energy in springs of joints."""
    total = np.zeros(len(rollout.time))
    for k, joint in enumerate(_joints(scene)):
        if joint.spring is not None and rollout.joint_names:
            total += 0.5 * joint.spring.stiffness * (rollout.joint_position[:, k] - joint.spring.rest) ** 2
    return total


def _loosest(scene: Scene, rollout: Rollout) -> Near | None:
    """The joint whose parts are farthest apart, relative to the size of the smaller body. Joints that can break are
    left out."""
    worst: Near | None = None
    sizes = [body.scale * largest_extent(scene.shapes[body.shape]) for body in scene.bodies]
    centre = [scene.shapes[body.shape].com * body.scale for body in scene.bodies]
    for joint in _joints(scene):
        if np.isfinite(joint.breaks_force) or np.isfinite(joint.breaks_torque):
            continue
        points, axes = [], []
        for b, anchor, quat in zip(joint.bodies, joint.anchor, joint.quat_xyzw, strict=True):
            if b < 0:
                points.append(np.broadcast_to(anchor, (len(rollout.time), 3)))
                axes.append(np.broadcast_to(pose.to_matrix(quat), (len(rollout.time), 3, 3)))
            else:
                turn = pose.to_matrix(rollout.orientation[:, b])
                points.append(rollout.position[:, b] + turn @ (anchor - centre[b]))
                axes.append(turn @ pose.to_matrix(quat))
        way = points[0] - points[1]
        if joint.kind == "slider":
            way = way - (way * axes[1][:, :, 0]).sum(1)[:, None] * axes[1][:, :, 0]
        apart = np.linalg.norm(way, axis=1)
        if joint.kind == "distance":
            apart = apart - (joint.length if joint.length is not None else np.inf)
            if joint.length is None and joint.limits is not None:
                apart = np.maximum(np.linalg.norm(way, axis=1) - joint.limits[1], 0.0)
            apart = np.where(np.isfinite(apart), np.abs(apart), 0.0)
        size = min(size for size in (sizes[b] for b in joint.bodies if b >= 0) if np.isfinite(size))
        t = int(apart.argmax())
        if worst is None or apart[t] / size > worst.part:
            worst = Near(float(apart[t]), float(apart[t] / size), joint.name, "", float(rollout.time[t]))
    return worst


def _beside(scene: Scene, rollout: Rollout) -> np.ndarray:
    """[T+1, N, N] whether a dynamic body could touch another moving body, by the balls around them, in the step that
    led to a frame."""
    mover = np.array([b.motion != "static" for b in scene.bodies])
    dynamic = np.array([b.motion == "dynamic" for b in scene.bodies])
    group, allowed = contact_groups(scene.bodies)
    may = (mover[:, None] & mover) & (dynamic[:, None] | dynamic) & allowed[group][:, group]
    np.fill_diagonal(may, False)
    reach = np.array([_reach(solid_of(scene.shapes[b.shape]), scene.shapes[b.shape]) * b.scale for b in scene.bodies])
    reach = np.where(np.isfinite(reach), reach, 0.0)
    found = np.zeros((len(rollout.time), len(mover), len(mover)), bool)
    for t in range(1, len(rollout.time)):
        move = np.linalg.norm(rollout.position[t] - rollout.position[t - 1], axis=1)
        ball = 1.05 * (reach + 2 * move)
        away = np.linalg.norm(rollout.position[t, :, None] - rollout.position[t, None], axis=2)
        found[t] = may & (away <= ball[:, None] + ball)
    return found


def _climb(
    course: np.ndarray, kinetic: np.ndarray, floor: np.ndarray, anew: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For K courses of energy [T+1, K] J the highest rise above an earlier time, in J and relative to the energy
    available since then, with the frame of the latter; [K] each. An account starts again at frames where `anew` [T+1,
    K]."""
    low, play = course[0].copy(), kinetic[0].copy()
    most, part, when = np.zeros(len(low)), np.zeros(len(low)), np.zeros(len(low), int)
    for t in range(1, len(course)):
        now = course[t]
        fresh = now < low
        if anew is not None:
            fresh = fresh | anew[t]
        low = np.where(fresh, now, low)
        rise = now - low
        # The part of the present motion that existed before. The energy of an impact stays available for a while.
        play = np.maximum(np.where(fresh, FADE * play, play), kinetic[t] - rise)
        whole = play + floor
        share = np.divide(rise, whole, out=np.zeros_like(rise), where=whole > 0)
        higher = share > part
        part, when = np.where(higher, share, part), np.where(higher, t, when)
        most = np.maximum(most, rise)
    return most, part, when


# --- surfaces ---


def telling_frames(scene: Scene, rollout: Rollout) -> list[int]:
    """The frames that are measured however long it takes, so that a verdict does not depend on the clock: the last, the
    first, and those after the `IMPACTS` largest changes of a body's velocity other than by gravity, apart from each
    other in time."""
    last = len(rollout.time) - 1
    dynamic = [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]
    size = np.array([scene.bodies[k].scale * largest_extent(scene.shapes[scene.bodies[k].shape]) for k in dynamic])
    change = np.diff(rollout.velocity[:, dynamic], axis=0) - scene.gravity * np.diff(rollout.time)[:, None, None]
    hit = np.linalg.norm(change, axis=2) + size * np.linalg.norm(
        np.diff(rollout.angular_velocity[:, dynamic], axis=0), axis=2
    )
    hardest = np.concatenate([[0.0], (hit / np.sqrt(size)).max(1, initial=0.0)])
    found = list(dict.fromkeys((last, 0)))
    apart = max(1, last // (4 * IMPACTS))
    while len(found) < 2 + IMPACTS and hardest.max() > 0.0:
        frame = int(hardest.argmax())
        hardest[max(0, frame - apart) : frame + apart + 1] = 0.0
        if frame not in found:
            found.append(frame)
    return found


def in_order(count: int) -> list[int]:
    """The numbers of `count` frames, each once: the last, the first, the middle, the quarters, ..."""
    order, step = [count - 1, 0], 1
    while step < count:
        step *= 2
        order += [(count - 1) * odd // step for odd in range(1, step, 2)]
    return list(dict.fromkeys(order)) if count else []


@dataclass(frozen=True)
class _Course:
    """A motion and its bodies' geometry."""

    scene: Scene
    rollout: Rollout
    solids: list[TrueSurface]
    dynamic: np.ndarray  # [N] bool
    group: np.ndarray  # [N]
    allowed: np.ndarray  # [G, G]
    pushed: np.ndarray  # [T+1, N] bool: whether anything but gravity acted in the step that led here


def _course(scene: Scene, rollout: Rollout) -> _Course:
    solids = [solid_of(shape) for shape in scene.shapes]
    dynamic = np.array([b.motion == "dynamic" for b in scene.bodies])
    pushed = _pushed(scene, rollout, dynamic & ~held_bodies(scene))
    return _Course(scene, rollout, solids, dynamic, *contact_groups(scene.bodies), pushed)


def depths(scene: Scene, rollout: Rollout, every: int = 5) -> np.ndarray:
    """[F] m, depth of the deepest overlap of two bodies in every `every`-th frame in which bodies touch."""
    course, found = _course(scene, rollout), []
    sizes = [b.scale * largest_extent(scene.shapes[b.shape]) for b in scene.bodies if b.motion == "dynamic"]
    touch = TOUCH * float(np.mean(sizes))
    for frame in range(every, len(rollout.time), every):
        pair = near_pairs(course, frame, np.full(len(scene.bodies), touch))
        one, other = (placed(scene, rollout, np.full(len(pair), frame), pair[:, k]) for k in (0, 1))
        apart = gaps(course.solids, one, other, np.full(len(pair), touch)).apart.min(initial=np.inf)
        found += [max(0.0, -float(apart))] if apart <= touch else []
    return np.array(found)


def _surfaces(
    scene: Scene, rollout: Rollout, seconds: float, every: int, on_progress: Progress
) -> tuple[Near | None, Near | None, int]:
    started = time.perf_counter()
    course = _course(scene, rollout)
    deepest: Near | None = None
    widest: Near | None = None
    always = telling_frames(scene, rollout)
    done, chunk = 0, len(always)
    frames = list(dict.fromkeys([*always, *(every * k for k in in_order(-(-len(rollout.time) // every)))]))
    while done < len(frames):
        some = np.array(frames[done : done + chunk])
        before = time.perf_counter()
        deep, wide = _measured(course, some, started + seconds if done else np.inf)
        done += len(some)
        on_progress(done / len(frames), f"{done} of {len(frames)} frames measured")
        if deep and (deepest is None or deep.part > deepest.part):
            deepest = deep
        if wide and (widest is None or wide.part > widest.part):
            widest = wide
        took, now = time.perf_counter() - before, time.perf_counter() - started
        # Take as many frames at once as fit into half of the remaining time.
        left = seconds - now
        if left <= 0:
            break
        pace = took / len(some)
        chunk = int(min(max(1.0, 0.5 * left / max(pace, 1e-6)), 4 * chunk))
        if pace > left:
            break
    return deepest, widest, done


def solid_of(shape: Shape) -> TrueSurface:
    """A shape's exact geometry, made once."""
    return made_once(shape, true_surface)


def _pushed(scene: Scene, rollout: Rollout, dynamic: np.ndarray) -> np.ndarray:
    """[T+1, N] whether gravity does not explain a change of velocity, for bodies that nothing pulls."""
    dt = np.diff(rollout.time)[:, None, None]
    change = np.diff(rollout.velocity, axis=0) - scene.gravity * dt
    fast = np.linalg.norm(rollout.velocity, axis=2)
    strength = float(np.linalg.norm(scene.gravity))
    least = 0.02 * strength * dt[..., 0] + 1e-6 * np.maximum(fast[1:], fast[:-1]) + 1e-9
    pushed = np.zeros(fast.shape, bool)
    pushed[1:] = (np.linalg.norm(change, axis=2) > least) & dynamic
    # The velocity of a body that has just been touched may be that of the inner step before. Gravity then acts for up
    # to half a step longer in the next step.
    if strength:
        down = scene.gravity / strength
        longer = np.clip(change @ down, 0.0, 0.5 * strength * dt[..., 0])[..., None] * down
        pushed[2:] &= ~pushed[1:-1] | (np.linalg.norm(change - longer, axis=2) > least)[1:]
    if "energy_given" in rollout.counters:
        pushed &= np.asarray(rollout.counters["energy_given"] == 0)[:, None]
    if rollout.meta.get("free_flight") == "learned":
        pushed[:] = False
    return pushed


def placed(course_scene: Scene, rollout: Rollout, frame: np.ndarray, body: np.ndarray) -> Placed:
    """Bodies [K] in frames [K]; solids have the numbers of their shapes."""
    turn = pose.to_matrix(rollout.orientation[frame, body])
    shape = np.array([b.shape for b in course_scene.bodies])[body]
    scale = np.array([b.scale for b in course_scene.bodies])[body]
    com = np.stack([s.com for s in course_scene.shapes])[shape] * scale[:, None]
    origin = rollout.position[frame, body] - np.einsum("kij,kj->ki", turn, com)
    return Placed(shape, scale, origin, turn)


def near_pairs(course: _Course, frame: int, margin: np.ndarray) -> np.ndarray:
    """[P, 2] bodies, one of them dynamic, whose boxes are within the larger of their `margin`s [N] m in a frame."""
    scene, rollout = course.scene, course.rollout
    count = len(scene.bodies)
    every = np.arange(count)
    at = placed(scene, rollout, np.full(count, frame), every)
    bounds = np.stack([s.bounds for s in course.solids])[at.solid] * at.scale[:, None, None]
    endless = np.asarray(~np.isfinite(bounds).all((1, 2)))
    bounds = np.where(endless[:, None, None], 0.0, bounds)
    middle = at.origin + np.einsum("kij,kj->ki", at.turn, bounds.mean(1))
    half = 0.5 * np.ptp(bounds, axis=1)
    radius = np.linalg.norm(half, axis=1) + margin
    wide = endless | (radius > 4 * np.median(radius[~endless]) if (~endless).any() else True)
    found = []
    small = every[~wide]
    if 1 < len(small) <= FEW_BODIES:
        found.append(small[np.stack(np.triu_indices(len(small), 1), 1)])
    elif len(small) > FEW_BODIES:
        from scipy.spatial import KDTree  # slow to load

        close = KDTree(middle[small]).query_pairs(2 * float(radius[small].max()), output_type="ndarray")
        found.append(small[close])
    for k in every[wide]:
        others = every[(every != k) & ~(wide & (every < k))]
        found.append(np.column_stack([np.full(len(others), k), others]))
    pair = np.concatenate([*found, np.zeros((0, 2), int)]).astype(int)
    one, other = pair.T
    kept = (course.dynamic[one] | course.dynamic[other]) & course.allowed[course.group[one], course.group[other]]
    kept &= ~(endless[one] & endless[other])
    if joined := {b for joint in _joints(scene) if not joint.collides for b in (joint.bodies, joint.bodies[::-1])}:
        kept &= np.array([(a, b) not in joined for a, b in pair.tolist()], bool)
    pair = pair[kept]
    one, other = pair.T
    slack = np.maximum(margin[one], margin[other])
    # Separating axis test: no gap along the axes of both boxes and their cross products.
    axes = np.concatenate([at.turn[one], at.turn[other]], 2).swapaxes(1, 2)
    across = np.cross(at.turn[one].swapaxes(1, 2)[:, :, None], at.turn[other].swapaxes(1, 2)[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(across, axis=2, keepdims=True)
    across = np.where(length > 1e-6, across / np.maximum(length, 1e-6), 0.0)
    axes = np.concatenate([axes, across], 1)
    reach = sum(
        np.einsum("pi,pai->pa", half[k], np.abs(np.einsum("paj,pji->pai", axes, at.turn[k]))) for k in (one, other)
    )
    gap = np.abs(np.einsum("pai,pi->pa", axes, middle[one] - middle[other])) - reach
    apart = gap.max(1) > slack
    plane = endless[one] | endless[other]
    if plane.any():
        flat, solid_body = np.where(endless[one], one, other)[plane], np.where(endless[one], other, one)[plane]
        up = at.turn[flat, :, 2]
        low = ((middle[solid_body] - at.origin[flat]) * up).sum(1)
        low -= (half[solid_body] * np.abs(np.einsum("pj,pji->pi", up, at.turn[solid_body]))).sum(1)
        apart[plane] = low > slack[plane]
    return pair[~apart]


def _measured(course: _Course, frames: np.ndarray, deadline: float) -> tuple[Near | None, Near | None]:
    """The deepest overlap in these frames, and the widest free space around bodies that are pushed in the steps that
    start in them. Pairs that are left at the `deadline` (of `time.perf_counter`) are not measured, and free space is
    then not reported."""
    scene, rollout = course.scene, course.rollout
    size = np.array([course.solids[b.shape].thickness * b.scale for b in scene.bodies])
    reach = np.array([_reach(course.solids[b.shape], scene.shapes[b.shape]) * b.scale for b in scene.bodies])
    last = len(rollout.time) - 1
    pushed = {f: course.pushed[f + 1] if f < last else np.zeros(len(size), bool) for f in frames.tolist()}
    margin = {f: _margin(course, f, size, reach) * acts for f, acts in pushed.items()}
    deepest: Near | None = None
    # Only pairs whose boxes overlap may overlap. They mostly show what pushes a body; what is farther away is measured
    # for the others alone.
    row = np.concatenate([_rows(course, f, np.zeros(len(size))) for f in margin])
    near = _apart(course, row, margin, reach, deadline)
    if len(near.row):
        thin = np.minimum(size[near.row[:, 1]], size[near.row[:, 2]])
        closing, _ = _coming(course, near.row, near.found, reach)
        # An impact is noticed within a step; a body may move that far into the other before it is stopped.
        before, _ = _coming(course, near.row, near.found, reach, back=1)
        share = (-near.found.apart - np.maximum(np.abs(closing), np.abs(before))) / thin
        k = int(share.argmax())
        if share[k] > 0:
            deepest = _near(course, near.row[k], float(-near.found.apart[k]), float(share[k]))
    if len(near.row) < len(row):
        return deepest, None
    free = near.free / np.minimum(size[row[:, 1]], size[row[:, 2]]) if len(row) else np.zeros(0)
    touched = row[free <= FREE]
    for f, body in touched[:, :2].tolist() + touched[:, ::2].tolist():
        pushed[f][body] = False
    farther = []
    for f, acts in pushed.items():
        pairs = _rows(course, f, margin[f] * acts)
        asked = (acts[pairs[:, 1:]]).any(1)
        farther.append(pairs[asked])
    row = np.concatenate(farther)
    wide = _apart(course, row, margin, reach, deadline)
    if len(wide.row) < len(row):
        return deepest, None
    widest: Near | None = None
    thin = np.minimum(size[row[:, 1]], size[row[:, 2]])
    for f, acts in pushed.items():
        for body in np.flatnonzero(acts).tolist():
            mine = np.flatnonzero((row[:, 0] == f) & ((row[:, 1] == body) | (row[:, 2] == body)))
            if (wide.free[mine] <= FREE * thin[mine]).any():
                continue
            if not len(mine):
                metres, part, second = np.inf, np.inf, -1
            else:
                k = mine[wide.free[mine].argmin()]
                metres, part = float(wide.found.surely[k]), float(wide.free[k] / thin[k])
                second = int(row[k, 1] + row[k, 2] - body)
            if widest is None or part > widest.part:
                other = scene.bodies[second].name if second >= 0 else ""
                widest = Near(metres, part, scene.bodies[body].name, other, float(rollout.time[f]))
    return deepest, widest


def _margin(course: _Course, frame: int, size: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """[N] m, how far away what pushes a body in the step after a frame may be at its start."""
    rollout = course.rollout
    if frame == len(rollout.time) - 1:
        return np.zeros(len(size))
    dt = float(rollout.time[frame + 1] - rollout.time[frame])
    speed = np.linalg.norm(rollout.velocity[frame : frame + 2], axis=2).max(0)
    turning = np.maximum(_turning(course, frame), _turning(course, frame + 1))
    turning = turning * np.where(np.isfinite(reach), reach, 0.0)
    fastest = float((speed + turning).max(initial=0.0))
    thick = np.where(np.isfinite(size), size, 0.0)
    return 0.2 * thick + (speed + turning + fastest) * dt + float(np.linalg.norm(course.scene.gravity)) * dt * dt


def _rows(course: _Course, frame: int, margin: np.ndarray) -> np.ndarray:
    """[P, 3] the frame and the bodies of `near_pairs`."""
    pair = near_pairs(course, frame, margin)
    return np.column_stack([np.full(len(pair), frame), pair])


class _Apart(NamedTuple):
    row: np.ndarray  # [P, 3] frame and bodies
    found: Gaps
    free: np.ndarray  # [P] m, the least free space between them that may be left in the step after the frame


def _apart(
    course: _Course, row: np.ndarray, margin: dict[int, np.ndarray], reach: np.ndarray, deadline: float
) -> _Apart:
    """Distances of pairs, as far as the larger of their margins; only of the first ones if the deadline comes."""
    most = np.array([margin[f][[one, other]].max() for f, one, other in row.tolist()])
    parts, done, chunk = [], 0, FEW
    while not parts or (done < len(row) and time.perf_counter() < deadline):
        cut = slice(done, done + chunk)
        one, other = (placed(course.scene, course.rollout, row[cut, 0], row[cut, k]) for k in (1, 2))
        parts.append(gaps(course.solids, one, other, most[cut]))
        done, chunk = done + chunk, min(2 * chunk, MANY)
    row, found = row[:done], Gaps(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    # A body that a third one hits may hit the other within the same step, with its speed at the step's end.
    closing, turned = _coming(course, row, found, reach)
    later, turned_later = _coming(course, row, found, reach, back=-1)
    free = found.surely - np.maximum(np.maximum(closing, later), 0.0) - np.maximum(turned, turned_later)
    return _Apart(row, found, free)


def _near(course: _Course, row: Sequence[int] | np.ndarray, metres: float, part: float) -> Near:
    f, one, other = (int(v) for v in row)
    names = course.scene.bodies[one].name, course.scene.bodies[other].name
    return Near(metres, part, *names, float(course.rollout.time[f]))


def _reach(one: TrueSurface, shape: Shape) -> float:
    """m, the distance of a solid's farthest point from its centre of mass."""
    return float(np.linalg.norm(np.abs(one.bounds - shape.com).max(0))) if np.isfinite(one.bounds).all() else np.inf


def _turning(course: _Course, frame: int) -> np.ndarray:
    """[N] rad/s, the part of the angular velocity that moves a body's surface (a ball may spin freely)."""
    spin = course.rollout.angular_velocity[frame]
    kind = np.array([course.solids[b.shape].turns_into_itself for b in course.scene.bodies])
    axis = pose.to_matrix(course.rollout.orientation[frame])[:, :, 2]
    across = np.linalg.norm(np.cross(spin, axis), axis=1)
    return np.select([kind == 2, kind == 1], [np.zeros(len(kind)), across], np.linalg.norm(spin, axis=1))


def _coming(
    course: _Course, row: np.ndarray, found: Gaps, reach: np.ndarray, back: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """[P] m, how much two bodies come nearer in a step along the line between their nearest points, by the speeds of
    these points `back` frames before; and how much turning and gravity may add for other points."""
    rollout = course.rollout
    frame, one, other = row.T
    dt = np.diff(rollout.time, append=rollout.time[-1:])[frame]
    dt[frame == len(rollout.time) - 1] = float(np.diff(rollout.time).max(initial=0.0))
    toward = found.normal * found.sign[:, None]  # from the second body to the first

    def of(body: np.ndarray) -> np.ndarray:
        arm = found.point - rollout.position[frame, body]
        return rollout.velocity[then, body] + np.cross(rollout.angular_velocity[then, body], arm)

    then = np.clip(frame - back, 0, len(rollout.time) - 1)
    closing = -((of(one) - of(other)) * toward).sum(1) * dt
    turning = np.zeros(len(row))
    for f in np.unique(then):
        here, spin = then == f, _turning(course, int(f))
        for body in (one, other):
            turning[here] += (spin * np.where(np.isfinite(reach), reach, 0.0))[body[here]]
    return closing, turning * dt + float(np.linalg.norm(course.scene.gravity)) * dt * dt
