"""Supports that are moved along in a film, as a plank that is tilted: where they were, and how they look before others
are found on them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from scipy.interpolate import make_smoothing_spline

from sdfsim.apps.film.background import Background, background
from sdfsim.apps.film.drawing import Look, Window
from sdfsim.apps.film.eye import Eye
from sdfsim.apps.film.frames import Clip
from sdfsim.apps.film.poses import Frame, Seen, Shutter, fitted, smear
from sdfsim.apps.film.track import POOR, Track, again, either, follow, masks
from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress
from sdfsim.physics import pose
from sdfsim.scene.scene import Body, Scene, Waypoints

# px, from coarse to fine: by how much pictures are smeared, and a margin around the body that its background lacks.
BEGIN = ((4.0, 8.0), (1.5, 4.0), (0.0, 2.0))
MENDED = 5  # px around a hole that its mending looks at
VIEWS = 7  # frames that show how a face looks
FULL = 0.98  # share of a pixel from which what is behind it does not matter
UNSURE = 0.25  # px by which outlines are wrong alike in neighbouring frames
BRIGHTER = 0.5, 2.0  # limits of how brightnesses of a face differ

Front = Callable[[np.ndarray, int], np.ndarray]


def supported(
    clip: Clip, back: Background, eye: Eye, looks: Sequence[Look], bodies: Sequence[Body], shutter: Shutter,
    on_progress: Progress,
) -> list[Track]:  # fmt: skip
    """Supports from about where the scene has them in the first frame. Raises SdfsimError if they are not there."""
    found = []
    for look, body in zip(looks, bodies, strict=True):
        place, turn = body.position + pose.rotate(body.quat_xyzw, look.com), body.quat_xyzw
        one: Seen | None = None
        behind, begun = back, place
        for wide, margin in BEGIN:
            at = look.window(eye, place, turn, 8.0)
            cover = np.zeros(clip.pixels.shape[1:3], np.float32)
            if at is not None:
                cover[at.rows, at.columns] = look.cover(eye, place, turn, at).sum(0)
            hole = cv2.GaussianBlur(cover, (0, 0), margin) > 0.02
            mended = cv2.inpaint(np.nan_to_num(back.first).astype(np.uint8), hole.astype(np.uint8), MENDED,
                                 cv2.INPAINT_TELEA).astype(np.float32)  # fmt: skip
            behind = replace(back, pixels=mended, first=mended, last=mended)
            frame = Frame(clip.pixels[0], mended, float(back.gain[0]), back.noise)
            one = fitted(look, eye, frame, place, turn, np.zeros(2), shutter.spread, None, wide=wide)
            if one is None:
                break
            place, turn = one.place, one.turn
        if one is None or one.score < POOR or np.linalg.norm(place - begun) > look.radius:
            raise SdfsimError(
                f"{clip.path}: {body.name!r} is not where the scene has it when the film begins",
                "correct its position in the scene, or the points; --start chooses another beginning",
            )
        found.append(follow(clip, behind, look, eye, shutter, 0, one, np.zeros(3), on_progress=on_progress))
    return found


def behind_others(
    clip: Clip, eye: Eye, tracks: Sequence[Track], shutter: Shutter,
    covered: Sequence[np.ndarray | None] | None = None,
) -> tuple[list[Track], Background]:  # fmt: skip
    """Supports and what is behind them, both found again; then they are drawn into the background. `covered`: [T]
    masks of what is before them, if that is known."""
    around = [masks(clip, eye, one) for one in tracks]
    every = [either([of[k] for of in (*around, *([covered] if covered else []))]) for k in range(len(clip.time))]
    back = background(clip, every, complete=covered is not None)
    tracks = [again(clip, back, eye, shutter, one, covered) for one in tracks]
    front: Front = partial(_drawn, clip, eye, shutter, tracks, covered)
    return tracks, replace(back, front=front)


def _drawn(
    clip: Clip, eye: Eye, shutter: Shutter, tracks: Sequence[Track], covered: Sequence[np.ndarray | None] | None,
    still: np.ndarray, k: int,
) -> np.ndarray:  # fmt: skip
    """A background [H, W, 3] with the supports where they are in frame k."""
    still = still.copy()
    for one in tracks:
        seen = one.seen[k]
        at = seen and one.look.window(eye, seen.place, seen.turn, 3.0)
        if seen is None or at is None:
            continue
        cover = smear(one.look.cover(eye, seen.place, seen.turn, at), np.zeros(2), shutter.spread)
        total = cover.sum(0)[..., None]
        own = sum(part[..., None] * _face(clip, eye, one, covered, k, n, at) for n, part in enumerate(cover))
        under = still[at.rows, at.columns]
        mixed = (1.0 - total) * under + own
        still[at.rows, at.columns] = np.where(total > FULL, own / np.maximum(total, FULL), mixed)
    return still


def _face(
    clip: Clip, eye: Eye, track: Track, covered: Sequence[np.ndarray | None] | None, k: int, n: int, at: Window
) -> np.ndarray:
    """[h, w, 3] what a flat face looks like in a part of frame k: as in other frames, moved there. As long as it is not
    known what lies on it where (`covered`), each pixel is taken from the frame in which it is most like the face."""
    look, now = track.look, track.at(k)
    color = now.color[n].astype(np.float32)
    if not look.faces or color.min() <= 0.0:
        return np.broadcast_to(color, (at.bottom - at.top, at.right - at.left, 3))
    rows = track.frames
    views = []
    for j in np.unique(rows[np.linspace(0, len(rows) - 1, VIEWS).astype(int)]).tolist():
        then = track.at(j)
        where = [eye.rotation @ pose.to_matrix(one.turn) for one in (then, now)]
        shift = [eye.seen(one.place) for one in (then, now)]
        normal = where[0] @ look.normals[n]
        away = float(normal @ shift[0]) + look.heights[n]  # of the face's plane from the camera
        if away >= -0.05 * look.radius or then.color[n].min() <= 0.0:
            continue  # it looks away
        turn = where[1] @ where[0].T
        plane = turn + np.outer(shift[1] - turn @ shift[0], normal) / away
        lens = np.array([[eye.focal, 0, eye.middle[0]], [0, eye.focal, eye.middle[1]], [0, 0, 1.0]])
        # Pixel centres are at integers for OpenCV, half a pixel further here.
        half, corner = np.eye(3), np.eye(3)
        half[:2, 2], corner[:2, 2] = 0.5, (-at.left - 0.5, -at.top - 0.5)
        lead = corner @ lens @ plane @ np.linalg.inv(lens) @ half
        size = (at.right - at.left, at.bottom - at.top)
        ratio = np.clip(color / then.color[n], *BRIGHTER).astype(np.float32)
        view = ratio * cv2.warpPerspective(clip.pixels[j], lead, size, borderMode=cv2.BORDER_REPLICATE)
        cover = covered[j] if covered else None
        if cover is not None:
            view[cv2.warpPerspective(cover.astype(np.uint8), lead, size) > 0] = np.nan
        views.append(view)
    if len(views) < 3:
        return np.broadcast_to(color, (at.bottom - at.top, at.right - at.left, 3))
    if covered is None:
        nearest = np.abs(np.stack(views) - color).max(-1).argmin(0)
        return np.take_along_axis(np.stack(views), nearest[None, ..., None], 0)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # where something always lies on it
        usual = np.nanmedian(views, 0)
    return np.where(np.isnan(usual), color, usual)


def with_paths(clip: Clip, eye: Eye, scene: Scene, tracks: Sequence[Track]) -> Scene:
    """The scene whose bodies of these tracks move as tracked."""
    path = {one.look.name: _path(clip, eye, one) for one in tracks}
    bodies = tuple(
        replace(b, path=path[b.name], position=path[b.name].position[0], quat_xyzw=path[b.name].quat_xyzw[0])
        if b.name in path else b for b in scene.bodies
    )  # fmt: skip
    return replace(scene, bodies=bodies)


def _path(clip: Clip, eye: Eye, track: Track) -> Waypoints:
    """A smooth path through the poses of a track. How smooth, cross-validation decides for what frames show exactly:
    places across the picture, and turns in it. In depth and tilt neighbouring frames err alike, which it would take
    for motion that shakes what lies there: these are as smooth as outlines allow."""
    rows = track.frames
    time = clip.time[rows] - clip.time[0]
    local = np.stack([eye.seen(track.at(k).place) for k in rows])
    turn = np.stack([track.at(k).turn for k in rows])
    middle = turn[len(turn) // 2]
    away = pose.to_rotvec(pose.multiply(turn, pose.conjugate(middle))) @ eye.rotation.T
    columns = np.c_[local[:, :2] / local[:, 2:], np.log(local[:, 2]), away]
    outline = UNSURE / (eye.focal * track.look.radius / float(np.median(local[:, 2])))
    smooth = np.stack([_smooth(time, columns[:, n], outline * (n in (2, 3, 4))) for n in range(6)], 1)
    depth = np.exp(smooth[:, 2:3])
    place = (np.c_[smooth[:, :2] * depth, depth] - eye.translation) @ eye.rotation
    turned = pose.multiply(pose.from_rotvec(smooth[:, 3:] @ eye.rotation), middle)
    origin = place - pose.rotate(turned, np.tile(track.look.com, (len(rows), 1)))
    return Waypoints(time, origin, turned)


def _smooth(time: np.ndarray, column: np.ndarray, unsure: float) -> np.ndarray:
    """[N] numbers at times [N] s, smoothed by cross-validation, or more as long as they change by `unsure` (root mean
    square) at most."""
    best, low, high = make_smoothing_spline(time, column)(time), -12.0, 2.0
    while unsure and high - low > 0.1:
        middle = 0.5 * (low + high)
        trial = make_smoothing_spline(time, column, lam=10.0**middle * float(np.ptp(time)) ** 3)(time)
        if np.sqrt(np.mean((trial - column) ** 2)) > unsure:
            high = middle
        else:
            low, best = middle, trial
    return np.asarray(best)
