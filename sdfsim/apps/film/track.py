"""Follows the bodies of a scene through a film: found once, then predicted from frame to frame, in both directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from sdfsim.apps.film.background import Background
from sdfsim.apps.film.drawing import Look, Window
from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.frames import Clip
from sdfsim.apps.film.poses import ROUNDS, Frame, Seen, Shutter, fitted
from sdfsim.apps.observed import Recording
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, silent
from sdfsim.physics import pose
from sdfsim.scene.scene import Scene

STARTS, BLOBS, TURNS = 8, 3, 16  # frames in which a body is looked for, things that move there, and orientations
FEWER = 4  # orientations if it begins where the scene has it
FOREGROUND = 4.5  # standard deviations of noise, of what moves
TURNED, OTHERWISE = 0.6, 1.5  # rad from the scene's orientation, and how much less likely another is
WORSE = 0.03  # score below the best, from which the best's orientation is tried again
SEEN = 0.8  # share of the frames in which a body that lies is seen
SAME, SAME_TURN = 0.2, 0.01  # px, and rad, between predictions that count as one
JUMP = 0.3  # rad from what is likely, which makes a pose half as likely
FASTER, LEAP = 1.5, 2.0  # times the fastest motion, and px, by which a body is elsewhere at most
NEARER, APPROACH = 0.05, 5.0  # share of the distance to the camera, and m/s, by which it changes at most
BACK = 0.3  # share of that distance by which it may differ from the scene's at first, or after the body was lost
REBOUND = np.array([1.0, -0.6])  # of the speed in the picture, after an impact
GOOD, POOR = 0.75, 0.5  # scores of a body that is found, and of one that is lost
ALIKE = 2.0  # how much larger errors of depth are than they scatter from frame to frame
FAR = 6  # frames for which a lost body is looked for where it would fly
TWIN = 0.85  # score of each of two things that may both be the body
OTHER, OTHERS = 60.0, 90.0  # levels by which the colour of a ball, and the mean of a body's, differ between frames
DIM = 0.25  # score below the median of a film, of frames that do not count
HUE, FAINT = 0.08, 10.0  # how much hues of one thing differ; levels that are noise
SHUTTERS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)  # of the time between frames
SPREADS = (0.0, 0.6, 1.0, 1.6)  # px


@dataclass
class Track:
    """A body through a film: what was seen of it in each frame, None where it was not found."""

    look: Look
    seen: list[Seen | None]

    def at(self, k: int) -> Seen:
        """What was seen in one of its `frames`."""
        one = self.seen[k]
        assert one is not None
        return one

    @property
    def frames(self) -> np.ndarray:
        return np.array([k for k, one in enumerate(self.seen) if one is not None], dtype=int)


@dataclass(frozen=True)
class Film:
    """A film with all that was found in it."""

    clip: Clip
    back: Background
    shutter: Shutter
    eye: Eye
    tracks: list[Track]  # of the moving bodies
    supports: list[Track]  # of bodies that are moved along
    scene: Scene  # with the supports' paths
    recording: Recording
    notes: list[str]


def frame_of(clip: Clip, back: Background, k: int, hidden: np.ndarray | None = None, way: int = 0) -> Frame:
    """Frame k, with the background that is free of the body later (`way` 1), earlier (-1), or both (0)."""
    still = back.front((back.pixels, back.first, back.last)[way], k)
    return Frame(clip.pixels[k], still, float(back.gain[k]), back.noise, hidden)


def blobs(frame: Frame, others: Sequence[np.ndarray] = ()) -> list[tuple[np.ndarray, float]]:
    """What differs from the background, and from `others`, largest first: centres [2] px and areas px^2."""
    off = np.full(frame.pixels.shape[:2], np.inf)
    for still in (frame.still, *others):
        off = np.fmin(off, np.abs(frame.pixels - np.float32(frame.gain) * still).max(-1))
    off[np.isinf(off)] = 0.0
    moves = (cv2.GaussianBlur(off, (0, 0), 1.0) > FOREGROUND * frame.noise).astype(np.uint8)
    moves = cv2.morphologyEx(moves, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, _, stats, centres = cv2.connectedComponentsWithStats(moves)
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:BLOBS]
    return [(centres[k] + 0.5, float(stats[k, cv2.CC_STAT_AREA])) for k in order if stats[k, cv2.CC_STAT_AREA] > 12]


def guesses(
    look: Look, eye: Eye, blob: tuple[np.ndarray, float], place: np.ndarray, turns: Sequence[np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses with their middle on a blob: a ball's depth is that of its area, others have that of `place`."""
    at, area = blob
    depth = float(eye.seen(place)[2])
    if look.ball:
        depth = eye.focal * look.ball / np.sqrt(area / np.pi)
    local = eye.rays(*at) * max(depth, 2.0 * look.radius)
    return [((local - eye.translation) @ eye.rotation, turn) for turn in turns]


def find(
    clip: Clip, back: Background, look: Look, eye: Eye, place: np.ndarray, turn: np.ndarray, name: str,
    on_progress: Progress = silent, free: bool = True,
) -> tuple[int, Seen]:  # fmt: skip
    """The frame in which a body is found best, and its pose there; `place` and `turn`: about where it begins. Raises
    SdfsimError if nothing that moves looks like it, or two things do."""
    rng = np.random.default_rng(0)
    turns = [turn]
    if not look.ball:
        turns += [pose.normalise(q) for q in rng.standard_normal((TURNS, 4))]
    none, found = np.zeros(2), []
    frame = frame_of(clip, back, 0, way=-1)
    begun = fitted(look, eye, frame, place, turn, none, 0.7, None, wide=2.5, turned=False)
    begun = begun and fitted(look, eye, frame, begun.place, begun.turn, none, 0.7, None)
    if begun is not None and not look.ball and _distant(eye, begun.place, place):
        begun = None
    if begun is not None:
        found.append((0, begun))
        turns = turns[: 1 + FEWER] if begun.score > GOOD else turns
    for k in np.unique(np.linspace(0, len(clip.time) - 1, STARTS + 2)[1:-1].astype(int)).tolist():
        frame = frame_of(clip, back, k)
        # A place where the body rests for long, before or after, differs from the median when it is free.
        for blob in blobs(frame, (back.first, back.last)):
            tried = []
            for n, guess in enumerate(guesses(look, eye, blob, place, turns)):
                rough = fitted(look, eye, frame, *guess, none, 0.7, None, rounds=6, wide=2.5, turned=n > 0)
                if rough is not None:
                    tried.append(rough)
                if rough is not None and rough.score > 0.9:
                    break
            first, *others = tried or [None]
            others.sort(key=lambda one: -one.score)
            for rough in [first, *others[:2]] if first else []:
                sharp = fitted(look, eye, frame, rough.place, rough.turn, none, 0.7, None)
                if sharp is not None:
                    found.append((k, sharp))
        on_progress(0.0, f"looking for {name} in frame {k}")
    if not found or max(one.score for _, one in found) < POOR:
        raise SdfsimError(
            f"{clip.path}: nothing that moves looks like {name!r}",
            "check its shape and size in the scene, and the camera; more light may help",
        )

    def unlikely(item: tuple[int, Seen]) -> float:
        """A thin or small body looks alike from two sides, and others move too: what the scene has is more likely."""
        if item[1] is begun:
            return (1.0 - item[1].score) / OTHERWISE**2
        way = pose.to_rotvec(pose.multiply(item[1].turn, pose.conjugate(turn)))
        return (1.0 - item[1].score) * (1.0 if look.ball or np.linalg.norm(way) < TURNED else OTHERWISE)

    if not look.ball:  # a hand before a body looks like it, but larger
        found = [item for item in found if not _distant(eye, item[1].place, place)] or found
    # As at first, or as in most frames: a hand leaves soon.
    best_of = {k: max((one for j, one in found if j == k), key=lambda one: one.score) for k, _ in found}
    known = [begun] if begun is not None and begun.score > GOOD else best_of.values()
    usual = np.median([_hue(one) for one in known], 0)
    found = [item for item in found if np.abs(_hue(item[1]) - usual).max() < HUE] or found
    k, best = min(found, key=unlikely)
    if free and _twins(found, look):
        raise SdfsimError(
            f"{clip.path}: two things that move look like {name!r}",
            "cover one of them, or add it to the scene; --start and --end choose a part of the film",
        )
    return k, best


def _twins(found: list[tuple[int, Seen]], look: Look) -> bool:
    """Whether two things that look like a body, and have its colour, move in several frames. What only seems to move
    stays in its place: a place that the body left, which the background still shows."""
    best: dict[int, list[Seen]] = {}
    for k, one in sorted(found, key=lambda item: -item[1].score):
        if one.score > TWIN and all(
            np.linalg.norm(one.place - other.place) > 2.0 * look.radius for other in best.get(k, [])
        ):
            best.setdefault(k, []).append(one)
    pairs = [some[:2] for some in best.values() if len(some) > 1]
    ways = [np.ptp([pair[n].place for pair in pairs], axis=0).max() for n in range(2)] if len(pairs) > 2 else [0.0]
    return min(ways) > 2.0 * look.radius


def _tone(one: Seen) -> np.ndarray:
    """[3] the mean colour of the faces that are seen."""
    seen = one.color[(one.color > 1.0).any(1)]
    return np.asarray(seen.mean(0) if len(seen) else np.zeros(3))


def _hue(one: Seen) -> np.ndarray:
    """[3] shares of red, green and blue in the faces that are seen; those of dark faces are noise, and about even."""
    mean = _tone(one) + FAINT
    return mean / mean.sum()


def follow(
    clip: Clip, back: Background, look: Look, eye: Eye, shutter: Shutter, k: int, first: Seen, gravity: np.ndarray,
    hidden: Sequence[np.ndarray | None] | None = None, on_progress: Progress = silent,
) -> Track:  # fmt: skip
    """The body in all frames, from its pose in frame k."""
    seen: list[Seen | None] = [None] * len(clip.time)
    seen[k] = first

    def ahead(at: int, way: int) -> Seen | None:
        before = [j for j in range(at - way, at - way * (FAR + 1), -way) if 0 <= j < len(seen) and seen[j]][:3]
        frame = frame_of(clip, back, at, hidden[at] if hidden else None, way)
        on_progress(0.0, f"frame {at}")
        return _next(clip, look, eye, shutter, frame, at, [(j, seen[j]) for j in before], first, gravity)

    for way in (1, -1):
        for at in range(k + way, len(seen) if way > 0 else -1, way):
            seen[at] = ahead(at, way)
    # A turn may have been mistaken until a frame in which it was found: from there the way back is followed again.
    for way in (1, -1):
        better = False
        for at in range(1, len(seen)) if way > 0 else range(len(seen) - 2, -1, -1):
            last, one = seen[at - way], seen[at]
            if last and one and not look.ball and (better or one.score < last.score - WORSE):
                new = ahead(at, way)
                better = new is not None and new.score > one.score
                seen[at] = new if better else one
            else:
                better = False
    return without_others(clip, eye, Track(look, seen))


def without_others(clip: Clip, eye: Eye, track: Track) -> Track:
    """The track without frames in which something else was followed, as a hand before the body, or a place that it
    left: in most frames it is seen in another colour, or much better, or where it cannot have come by then."""
    rows = track.frames
    if track.look.support or not len(rows):
        return track
    hues, scores = np.array([_hue(track.at(k)) for k in rows]), np.array([track.at(k).score for k in rows])
    alike = (np.abs(hues - np.median(hues, 0)).max(1) < HUE) | bool(track.look.ball)
    rows = rows[alike & (scores > np.median(scores) - DIM)]
    at, time = {k: eye.project(track.at(k).place) for k in rows.tolist()}, clip.time
    speed = [np.hypot(*(at[k] - at[j])) / (time[k] - time[j]) for j, k in pairwise(rows.tolist())]
    fastest = max(map(min, pairwise(speed)), default=np.inf)  # a single leap to elsewhere is no motion

    def leaps(j: int, k: int) -> bool:
        later = abs(float(time[k] - time[j]))
        far = np.hypot(*(at[k] - at[j])) > FASTER * fastest * later + LEAP
        return bool(far) or _jumps(track.look, eye, track.at(k), track.at(j), later)

    leapt = [n for n, (j, k) in enumerate(pairwise(rows.tolist()), 1) if leaps(j, k)]
    longest = max(np.split(rows, leapt), key=len)
    best = max(longest.tolist(), key=lambda k: track.at(k).score)
    seen: list[Seen | None] = [None] * len(track.seen)
    seen[best] = track.at(best)
    for order in (rows[rows > best], rows[rows < best][::-1]):
        last = best
        for k in order.tolist():
            if not leaps(last, k):
                last, seen[k] = k, track.at(k)
    return Track(track.look, seen)


def _jumps(look: Look, eye: Eye, one: Seen, last: Seen, later: float) -> bool:
    """Whether a body is nearer or farther than it can be `later` s after it was seen last: what is before it looks
    like it, but larger."""
    depth = float(eye.seen(last.place)[2])
    return not look.ball and abs(float(eye.seen(one.place)[2]) - depth) > NEARER * depth + APPROACH * abs(later)


def _next(clip, look, eye, shutter, frame, at, before, first, gravity) -> Seen | None:
    if not before:  # lost for long: wherever something moves
        for blob in blobs(frame):
            for guess in guesses(look, eye, blob, first.place, [first.turn]):
                one = fitted(look, eye, frame, *guess, np.zeros(2), shutter.spread, first.color, wide=2.5)
                one = one and fitted(look, eye, frame, one.place, one.turn, np.zeros(2), shutter.spread, first.color)
                if one is None or one.score < GOOD or _distant(eye, one.place, first.place):
                    continue
                if np.abs(_hue(one) - _hue(first)).max() < HUE and not _repainted(look, one, first):
                    return one
        return None
    best, least = None, np.inf
    color = before[0][1].color
    likely = predicted(clip, eye, shutter, at, before, gravity)
    tries: list[tuple[Any, ...]] = [(*guess, wide) for wide in (0.0, 2.5) for guess in likely]
    depth = float(eye.seen(before[0][1].place)[2])
    for blob, _ in [] if look.support else blobs(frame)[:2]:  # something pushed it: it may be anywhere, and rebound
        there = (eye.rays(*blob) * depth - eye.translation) @ eye.rotation
        tries += [(there, tries[0][1], flow, 2.5) for flow in (np.zeros(2), tries[0][2] * REBOUND)]
    for n, (place, turn, flow, wide) in enumerate(tries):
        # All predictions are tried: where pictures show depth and tilt badly, one alone leads from wrong to worse.
        if best is not None and best.score > GOOD and n >= len(likely):
            break
        # Where it is first: a body that is in a wrong place is turned to cover the picture.
        one = fitted(look, eye, frame, place, turn, flow, shutter.spread, color, rounds=5, wide=wide, turned=False)
        if one is not None and not wide and not look.ball:
            one = fitted(look, eye, frame, one.place, turn, flow, shutter.spread, color, rounds=10)
        if one is not None and wide and one.score > max(POOR, best.score if best else 0.0):
            one = fitted(look, eye, frame, one.place, one.turn, flow, shutter.spread, color)
        if one is None or _repainted(look, one, first):
            continue
        if _jumps(look, eye, one, before[0][1], float(clip.time[at] - clip.time[before[0][0]])):
            continue
        if odd(one, likely) < least:
            best, least = one, odd(one, likely)
    if best is not None and best.score < first.score - WORSE and not look.ball:  # it may have been mistaken before
        place, turn, flow = best.place, first.turn, likely[0][2]
        likely = [(place, turn, flow), *likely]
        one = fitted(look, eye, frame, place, turn, flow, shutter.spread, color)
        best = one if one is not None and odd(one, likely) < odd(best, likely) else best
    if best is None or best.score < POOR or at_edge(look, eye, best.place, best.turn):
        return None
    return best


def odd(one: Seen, likely: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    """How little a pose explains, and how far it is turned from all that is likely: a box seen from its front looks
    nearly alike when it is tilted to either side."""
    turns = [np.linalg.norm(pose.to_rotvec(pose.multiply(one.turn, pose.conjugate(turn)))) for _, turn, _ in likely]
    return (1.0 - one.score) * (1.0 + float(min(turns)) / JUMP)


def _distant(eye: Eye, place: np.ndarray, other: np.ndarray) -> bool:
    """Whether two places [3] are not about as far from the camera."""
    return bool(abs(np.log(eye.seen(place)[2] / eye.seen(other)[2])) > BACK)


def _repainted(look: Look, one: Seen, first: Seen) -> bool:
    """Whether what looks like a body has another colour than it: a place that it left, seen before the background.
    Faces of one body may differ, those of a ball do not."""
    off = one.color[0] - first.color[0] if look.ball else _tone(one) - _tone(first)
    return float(np.abs(off).max()) > (OTHER if look.ball else OTHERS)


def predicted(clip, eye, shutter, at, before, gravity) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Places, turns, and flows while the shutter is open, from up to three frames before, the last one first: as after
    a flight, at the same speed, and in the last pose."""
    (k, last), time = before[0], clip.time
    if len(before) == 1:
        return [(last.place, last.turn, np.zeros(2))]
    j, earlier = before[1]
    later, sooner = time[at] - time[k], time[k] - time[j]
    spin = pose.to_rotvec(pose.multiply(last.turn, pose.conjugate(earlier.turn)))
    turn = pose.multiply(pose.from_rotvec(later / sooner * spin), last.turn)
    speed, found = (last.place - earlier.place) / sooner, []
    for pull in (gravity, 0.0 * gravity):
        now = speed + 0.5 * sooner * pull  # at the last frame
        place = last.place + later * now + 0.5 * later**2 * pull
        way = eye.project(place + (now + later * pull) * 0.5 * shutter.open) - eye.project(
            place - (now + later * pull) * 0.5 * shutter.open
        )
        found.append((place, turn, way))
    distinct = found[:1]  # what is at rest or slow is predicted once
    for place, turn, way in [*found[1:], (last.place, last.turn, found[0][2])]:
        if all(
            np.linalg.norm(place - other) > SAME * eye.seen(place)[2] / eye.focal
            or np.linalg.norm(pose.to_rotvec(pose.multiply(turn, pose.conjugate(turned)))) > SAME_TURN
            for other, turned, _ in distinct
        ):
            distinct.append((place, turn, way))
    return distinct


def at_edge(look: Look, eye: Eye, place: np.ndarray, turn: np.ndarray) -> bool:
    """Whether a part of it is outside of the picture; supports may reach beyond it."""
    if look.support:
        return False
    at = look.window(eye, place, turn, 1.0)
    return at is None or at.left <= 0 or at.top <= 0 or at.right >= eye.width or at.bottom >= eye.height


def flows(clip: Clip, eye: Eye, track: Track, shutter: Shutter) -> dict[int, np.ndarray]:
    """[2] px by which the body moves while the shutter is open in each frame: the mean of the speeds before and after,
    if both are alike."""
    rows, found = track.frames, {}
    at = {int(k): eye.project(track.at(k).place) for k in rows}
    for i, k in enumerate(rows.tolist()):
        near = [j for j in rows[max(0, i - 1) : i + 2].tolist() if j != k and abs(j - k) <= 2]
        speeds = [(at[j] - at[k]) / (clip.time[j] - clip.time[k]) for j in near]
        found[k] = np.mean(speeds, 0) * shutter.open if speeds else np.zeros(2)
    return found


def again(
    clip: Clip, back: Background, eye: Eye, shutter: Shutter, track: Track,
    hidden: Sequence[np.ndarray | None] | None = None, only: Sequence[int] | None = None, shadows: bool = True,
    rounds: int = ROUNDS,
) -> Track:  # fmt: skip
    """The poses fitted again, with both neighbours' speeds, the film's usual colours, and another background."""
    speed = flows(clip, eye, track, shutter)
    color = np.median([track.at(k).color for k in track.frames], 0)
    seen = [None if only is not None and k not in only else one for k, one in enumerate(track.seen)]
    for k in [k for k in track.frames.tolist() if only is None or k in only]:
        frame, one = frame_of(clip, back, k, hidden[k] if hidden else None, 0), track.seen[k]
        usual = 0.5 * (color + one.color)
        new = fitted(track.look, eye, frame, one.place, one.turn, speed[k], shutter.spread, usual, rounds=rounds,
                     shadows=shadows)  # fmt: skip
        seen[k] = None if new is None or new.score < POOR or at_edge(track.look, eye, new.place, new.turn) else new
    return Track(track.look, seen)


def lies(clip: Clip, lying: Track, free: Track) -> bool:
    """Whether a body that was taken to lie does: it is seen nearly always, and poses in which it may also be tilted or
    in the air explain hardly more."""
    rows = free.frames
    more = [free.at(k).score - lying.at(k).score for k in rows]
    return len(rows) > SEEN * len(clip.time) and bool((np.quantile(more, (0.5, 0.9)) < (WORSE, 2.0 * WORSE)).all())


def shutter_of(clip: Clip, back: Background, eye: Eye, track: Track) -> Shutter:
    """The shutter that explains the frames of the fastest motion best."""
    speed = flows(clip, eye, track, Shutter(clip.step, 0.0))
    fast = sorted(speed, key=lambda k: -float(np.hypot(*speed[k])))
    some = fast[2 : max(10, len(fast) // 4) : max(1, len(fast) // 40)][:8]

    @cache
    def rest(trial: Shutter) -> float:
        # Smears are dark beside it, as shadows are.
        found = again(clip, back, eye, trial, track, only=some, shadows=False, rounds=6)
        return float(np.median([one.mean**2 if (one := found.seen[k]) else 1e3 for k in some]))

    best = Shutter(0.5 * clip.step, SPREADS[1])
    for _ in range(2):  # each hides a little of the other
        best = min((replace(best, open=share * clip.step) for share in SHUTTERS), key=rest)
        best = min((replace(best, spread=spread) for spread in SPREADS), key=rest)
    return best


def deepened(clip: Clip, eye: Eye, track: Track) -> Track:
    """The track with depths as uncertain as they scatter. Blur, highlights and a dark background change how large a
    body seems, alike in neighbouring frames, and what a single frame shows does not tell."""
    rows = track.frames
    depth = np.log([eye.seen(track.at(k).place)[2] for k in rows])
    bend = np.abs(depth[2:] - 2.0 * depth[1:-1] + depth[:-2])[(rows[2:] - rows[:-2]) == 2]
    scatter = ALIKE * 1.48 * float(np.median(bend)) / np.sqrt(6.0) if len(bend) else 0.1
    seen = list(track.seen)
    for k in rows:
        one = seen[k]
        away = np.r_[one.place + eye.rotation.T @ eye.translation, np.zeros(3)] * scatter
        sure = one.root.T @ one.root
        sure = sure - np.outer(sure @ away, sure @ away) / (1.0 + away @ sure @ away)
        values, vectors = np.linalg.eigh(sure)
        root = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        change = root @ np.linalg.pinv(one.root, rcond=1e-9)
        seen[k] = replace(one, root=root, rest=change @ one.rest, camera=change @ one.camera)
    return Track(track.look, seen)


def masks(clip: Clip, eye: Eye, track: Track, wide: float = 3.0) -> list[np.ndarray | None]:
    """[H, W] bool for each frame: where the body is, and a little around; None if that is unknown."""
    found: list[np.ndarray | None] = []
    for one in track.seen:
        at: Window | None = None if one is None else track.look.window(eye, one.place, one.turn, 8.0)
        if one is None or at is None:
            found.append(None)
            continue
        mask = np.zeros(clip.pixels.shape[1:3], bool)
        cover = track.look.cover(eye, one.place, one.turn, at).sum(0)
        mask[at.rows, at.columns] = cv2.GaussianBlur(cover, (0, 0), wide) > 0.02
        found.append(mask)
    return found


def either(found: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Masks of several bodies as one; None if there is none."""
    there = [one for one in found if one is not None]
    return np.logical_or.reduce(there) if there else None
