"""The pose of a body in one frame, by comparing the frame with what the body would cover (analysis by synthesis).

A pixel is the background's colour and the body's, mixed by the share that the body covers: of the time of exposure too,
so blur is drawn as blur. Colours of the body's flat faces are unknown, and found with the pose by least squares. Pixels
that fit badly (a shadow's edge, a hand) count less.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.linalg import block_diag

from sdfsim.apps.film.drawing import Look, Window
from sdfsim.apps.film.eye import WAYS, Eye
from sdfsim.physics import pose

ROUNDS = 12
GRAZING = 0.1  # sine of the least angle between what a body lies on and the line of sight
TRY = 0.3  # px, steps of derivatives
ODD = 3.0  # standard deviations beyond which a pixel counts less
MARGIN = 5.0  # px around a body that are compared
# px, of a face whose colour is half its own, and half that of other faces, or that which it had before: if it took the
# background's, a body could turn as it likes.
OTHERS, BEFORE = 3.0, 20.0
SMEARED = 4.0  # radii: the longest smear
LARGEST = 640  # px, sides of the part of a picture that is compared
# Brightness and two differences of colour, from red, green and blue (ITU-R BT.601). Films keep a quarter of the pixels
# of the latter, so outlines are smeared in them, by so many px.
SPLIT = np.array([[0.299, 0.587, 0.114], [0.5, -0.4187, -0.0813], [-0.1687, -0.3313, 0.5]], np.float32)
COARSE = 0.8
DARKER, LIT = (0.2, 0.95), (0.6, 1.4)  # brightness of a shadow, and of a body in another light
LARGE = 0.15  # share of a body of faces whose colour is sure
BESIDE, NEAR = 0.05, 0.05  # shares: of a pixel that the body may cover beside itself; of shadow nearby, to be one
HAND = 0.6  # share of what is around a body that differs from the background: then it is a part of something larger
AROUND = 3  # px from a body's outline, where that is looked for
UNLIKE = 5.0  # standard deviations of noise from which it differs
VISIBLE = 1.5  # mean square of differences to the background, relative to noise, of something that is there
FLOOR = 0.12  # px: shadows and light shift an outline by as much, alike in all frames


@dataclass(frozen=True)
class Shutter:
    """How moving things are smeared."""

    open: float  # s
    spread: float  # px, standard deviation of what the lens and compression smear


@dataclass(frozen=True)
class Seen:
    """A body's pose in a frame. Small motions of it [6] (shift m, rotation vector rad, world axes) and of the camera
    [WAYS] are as likely as `root` @ motion + `rest` + `camera` @ change is small, in standard deviations."""

    place: np.ndarray  # [3] m, centre of mass
    turn: np.ndarray  # [4]
    root: np.ndarray  # [6, 6]
    rest: np.ndarray  # [6]
    camera: np.ndarray  # [6, WAYS]
    color: np.ndarray  # [basis, 3] levels
    score: float  # the share of the difference to the background that is explained
    mean: float  # standard deviations, of the difference that remains


@dataclass(frozen=True)
class Frame:
    """What a pose is compared with."""

    pixels: np.ndarray  # [H, W, 3] uint8
    still: np.ndarray  # [H, W, 3] float32, the background
    gain: float  # how much brighter the frame is
    noise: float
    hidden: np.ndarray | None = None  # [H, W] bool, covered by other bodies


def smear(cover: np.ndarray, flow: np.ndarray, spread: float) -> np.ndarray:
    """Covers [parts, h, w] of a body that moves by `flow` [2] px while the shutter is open."""
    length, seen = float(np.hypot(*flow)), np.flatnonzero(cover.any((1, 2)))
    if (length <= 0.3 and spread <= 0.0) or not len(seen):
        return cover
    some = np.ascontiguousarray(np.moveaxis(cover[seen], 0, -1))
    if length > 0.3:
        half = int(np.ceil(length / 2)) + 1
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        for share in (np.arange(n := int(4 * length) + 2) + 0.5) / n - 0.5:
            x, y = half + share * flow
            left, top = int(x), int(y)
            across, down = x - left, y - top
            kernel[top : top + 2, left : left + 2] += np.outer([1 - down, down], [1 - across, across]) / n
        some = cv2.filter2D(some, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    if spread > 0.0:
        some = cv2.GaussianBlur(some, (0, 0), spread, borderType=cv2.BORDER_CONSTANT)
    smeared = np.zeros_like(cover)
    smeared[seen] = np.moveaxis(some.reshape(*cover.shape[1:], len(seen)), -1, 0)
    return smeared


class Comparison:
    """A frame and a body, about a first guess of its pose."""

    def __init__(
        self, look: Look, eye: Eye, frame: Frame, at: Window, flow: np.ndarray, spread: float, wide: float = 0.0,
    ) -> None:  # fmt: skip
        self.look, self.eye, self.at, self.flow, self.spread = look, eye, at, flow, float(np.hypot(spread, wide))
        still = frame.gain * frame.still[at.rows, at.columns]
        self.weight = np.isfinite(still[..., 0]).astype(np.float32)
        if frame.hidden is not None:
            self.weight *= ~frame.hidden[at.rows, at.columns]
        self.still, now = np.nan_to_num(still) @ SPLIT.T, frame.pixels[at.rows, at.columns] @ SPLIT.T
        if wide:
            self.still, now = (cv2.GaussianBlur(one, (0, 0), wide) for one in (self.still, now))
        self.now, self.off, self.noise = now, now - self.still, frame.noise

    def shade(self, patterns: np.ndarray, color: np.ndarray) -> None:
        """Darken the background where a shadow lies beside a body of these patterns and colours, and a little
        further below it. Lines are edges of the body."""
        beside = smear(patterns[: self.look.parts], np.zeros(2), 0.7).sum(0) < BESIDE
        size = self.sizes(patterns)
        colors = color[: len(size)][size > LARGE * size.sum()]
        now, still = (cv2.GaussianBlur(one, (0, 0), 1.0) for one in (self.now, self.still))
        dark, light = _shaded(now, still, colors @ SPLIT.T)
        dark = cv2.morphologyEx((beside & dark).astype(np.float32), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        reach = 2.0 + 0.25 * float(np.hypot(*self.flow))
        near, mean = (cv2.GaussianBlur(one.astype(np.float32), (0, 0), reach) for one in (dark, dark * light))
        below = ~beside & (near > NEAR)
        self.still = self.still * np.where(below, mean / np.maximum(near, NEAR), np.where(dark, light, 1.0))[..., None]
        self.off = self.now - self.still

    def patterns(self, place: np.ndarray, turn: np.ndarray) -> np.ndarray:
        return smear(self.look.patterns(self.eye, place, turn, self.at), self.flow, self.spread)

    def sizes(self, patterns: np.ndarray) -> np.ndarray:
        """[parts] px, what each part covers."""
        return patterns[: self.look.parts].sum((1, 2))

    def explained(
        self, patterns: np.ndarray, color: np.ndarray | None, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best colours [basis, 3], and the remaining differences [h, w, 3] in standard deviations."""
        coarse = smear(patterns, np.zeros(2), COARSE)
        found, w, parts = [], weight.ravel(), self.look.parts
        for seen, of in ((patterns, slice(0, 1)), (coarse, slice(1, 3))):
            basis, total = seen.reshape(-1, weight.size), seen[:parts].sum(0)[..., None]
            right = (self.off[..., of] + total * self.still[..., of]).reshape(weight.size, -1)
            # What hardly shows is about as it was, or as the rest.
            usual = np.zeros((len(basis), right.shape[1]))
            inside = total.ravel() * w
            usual[:parts] = inside @ (self.off + self.still)[..., of].reshape(weight.size, -1)
            usual /= max(float(inside.sum()), 1e-6)
            if color is not None:
                usual = np.where(np.asarray(color.any(1))[:, None], color @ SPLIT.T[:, of], usual)
            pull = np.full((len(basis), 1), OTHERS)
            if color is not None:
                size = self.sizes(seen)
                pull[:parts, 0][size > LARGE * size.sum()] = BEFORE
            normal = (basis * w) @ basis.T + np.diag(pull[:, 0])
            best = np.linalg.solve(normal, (basis * w) @ right + pull * usual)
            found.append((best, (right - basis.T @ best) / self.noise))
        best, rest = (np.concatenate(both, 1) for both in zip(*found, strict=True))
        return best @ np.linalg.inv(SPLIT).T, rest.reshape(self.off.shape)

    def reaches(self, place: np.ndarray, turn: np.ndarray) -> float:
        """The share of what is around the body that is not background: all of it if it is a part of a hand."""
        cover = smear(self.patterns(place, turn)[: self.look.parts], np.zeros(2), 0.7).sum(0)
        near = cv2.dilate((cover > 0.5).astype(np.uint8), np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8)) > 0
        around = near & (cover < BESIDE) & (self.weight > 0.0)
        unlike = np.linalg.norm(cv2.GaussianBlur(self.off, (0, 0), 0.7), axis=-1) > UNLIKE * self.noise
        return float(unlike[around].mean()) if around.any() else 0.0

    def robust(self, rest: np.ndarray) -> np.ndarray:
        return self.weight / (1.0 + (rest**2).mean(-1) / ODD**2)

    def cost(self, rest: np.ndarray) -> float:
        return float((self.weight * np.log1p((rest**2).mean(-1) / ODD**2)).sum())


def _shaded(now: np.ndarray, still: np.ndarray, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[h, w] whether a pixel [h, w, 3] is a darker background, by far rather than a body of these colours [K, 3] in
    another light, and how dark it is."""

    def off(color: np.ndarray, least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
        light = np.clip((now * color).sum(-1) / np.maximum((color * color).sum(-1), 1e-6), least, most)
        return light, np.linalg.norm(now - light[..., None] * color, axis=-1)

    light, rest = off(still, *DARKER)
    return (light < DARKER[1]) & (rest < 0.5 * np.min([off(one, *LIT)[1] for one in colors] or [np.inf], 0)), light


def moved(look: Look, eye: Eye, place: np.ndarray, turn: np.ndarray, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose after small motions `by` [ways], each of about a pixel."""
    way = axes(look, eye, place, turn) @ by
    return place + way[:3], pose.multiply(pose.from_rotvec(way[3:]), turn)


def axes(look: Look, eye: Eye, place: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """[6, ways] motions of the world (shift in m, rotation vector in rad) that move the outline by about a pixel:
    across, down, towards the camera, and about axes."""
    local = eye.seen(place)
    pixel = local[2] / eye.focal
    large = max(look.radius / pixel, 1.0)
    if look.normal is not None:
        ray = eye.rotation.T @ local / np.linalg.norm(local)
        across = np.cross(ray, look.normal)
        across /= max(float(np.linalg.norm(across)), 1e-9)
        ahead = np.cross(look.normal, across) / max(abs(float(look.normal @ ray)), GRAZING)
        slid = np.asarray(block_diag(pixel * np.stack([across, ahead], 1), look.normal[:, None] / large))
        return slid[:, : look.ways]
    shift = eye.rotation.T @ np.stack([[pixel, 0, 0], [0, pixel, 0], local / large], 1)
    about = eye.rotation.T
    if look.axis is not None:  # about two axes across its own
        own = pose.rotate(turn, look.axis)
        about = np.linalg.svd(own[None])[2][1:].T
    return np.asarray(block_diag(shift, about[:, : look.ways - 3] / large))


def fitted(
    look: Look, eye: Eye, frame: Frame, place: np.ndarray, turn: np.ndarray, flow: np.ndarray, spread: float,
    color: np.ndarray | None, *, rounds: int = ROUNDS, wide: float = 0.0, turned: bool = True,
    shadows: bool = True,
) -> Seen | None:  # fmt: skip
    """The pose near a first guess that explains a frame best; `wide`: px by which both are smeared, for a guess that
    is off by as much; without `turned` its orientation stays, as smeared pictures hardly show it; `shadows` beside the
    body are known by their colour. None if it is not in the picture."""
    place, turn = look.laid(eye, place, turn)
    most = SMEARED * look.radius * eye.focal / max(float(eye.seen(place)[2]), look.radius)
    flow = flow * min(1.0, most / max(float(np.hypot(*flow)), 1e-9))
    at = look.window(eye, place, turn, MARGIN + 3.0 * wide + 0.6 * float(np.abs(flow).max()))
    if at is None or max(at.right - at.left, at.bottom - at.top) > LARGEST:
        return None
    seen = Comparison(look, eye, frame, at, flow, spread, wide)
    damping = 1e-3
    patterns = seen.patterns(place, turn)
    if color is not None and shadows:
        seen.shade(patterns, color)
    color_now, rest = seen.explained(patterns, color, seen.weight)
    weight = seen.robust(rest)
    color_now, rest = seen.explained(patterns, color, weight)
    cost = seen.cost(rest)
    slopes = _slopes(seen, place, turn, color, weight, rest)
    for _ in range(rounds):
        _, normal, pull = slopes
        by = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-3), pull)
        by[look.shifts :] *= turned
        by *= min(1.0, (1.5 + wide) / max(np.abs(by).max(), 1e-9))
        new = moved(look, eye, place, turn, by)
        if eye.seen(new[0])[2] < 1.5 * look.radius:
            return None
        tried, left = seen.explained(seen.patterns(*new), color, weight)
        after = seen.cost(left)
        if after < cost:
            done = np.abs(by).max() < 0.02 or cost - after < 1e-4 * cost
            place, turn, color_now, rest, damping, cost = *new, tried, left, damping / 4.0, after
            weight = seen.robust(rest)
            slopes = _slopes(seen, place, turn, color, weight, rest)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e2 or np.abs(by).max() < 0.02:
                break
    slope, normal, pull = slopes
    return _seen(seen, place, turn, color_now, rest, weight, slope, normal, pull)


def _slopes(seen: Comparison, place, turn, color, weight, rest) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives [ways, h, w, 3] of the differences, colours fitted again, and their normal equations. Steps to one
    side only would lead a small box to poses in which it is tilted."""
    ways, slope = seen.look.ways, []
    for k in range(ways):
        by = np.zeros(ways)
        by[k] = TRY
        ends = [seen.explained(seen.patterns(*moved(seen.look, seen.eye, place, turn, s * by)), color, weight)[1]
                for s in (1.0, -1.0)]  # fmt: skip
        slope.append((ends[0] - ends[1]) / (2.0 * TRY))
    stacked = np.stack(slope)
    flat = (stacked * weight[..., None]).reshape(ways, -1)
    return stacked, flat @ stacked.reshape(ways, -1).T, flat @ rest.ravel()


def _seen(seen: Comparison, place, turn, color, rest, weight, slope, normal, pull) -> Seen:
    look, eye = seen.look, seen.eye
    # How large the differences are where the pose shows: more than noise, as no model is exact.
    edge = (slope**2).sum((0, -1)) * weight
    mean = float((edge * (rest**2).mean(-1)).sum() / max(edge.sum(), 1e-12))
    each = max(1.0, mean) * 2.0  # neighbouring pixels err together
    # A camera's change, as the motion of the body's outline that it looks like.
    like = np.zeros((look.ways, WAYS))
    for k in range(WAYS):
        step = np.zeros(WAYS)
        step[k] = 1e-4
        like[:, k] = _alike(look, eye, eye.moved(step), place, turn) / 1e-4
    values, vectors = np.linalg.eigh(normal / each)
    values = np.maximum(values, 0.0)
    root = vectors * np.sqrt(values / (1.0 + values * FLOOR**2)) @ vectors.T  # per pixel-like motion
    off = np.linalg.pinv(normal, rcond=1e-6) @ pull
    full = np.zeros((6, look.ways))
    full[: look.ways] = root
    before, small = (np.abs(seen.off) ** 2).mean(-1), (rest**2).mean(-1) * seen.noise**2
    size = seen.sizes(seen.patterns(place, turn))
    large = size > LARGE * size.sum()
    color = color.copy()
    color[: len(size)][~large] = size[large] @ color[: len(size)][large] / max(float(size[large].sum()), 1e-6)
    counts = weight if look.support else seen.weight  # what lies on a support is not explained by it
    total = float((before * counts).sum())
    score = 1.0 - float((small * counts).sum()) / max(total, 1e-9)
    if total < VISIBLE * seen.noise**2 * seen.weight.size or (not look.support and seen.reaches(place, turn) > HAND):
        score = min(score, 0.0)
    return Seen(place, turn, full @ np.linalg.pinv(axes(look, eye, place, turn)), full @ off, full @ like, color,
                score, np.sqrt(mean))  # fmt: skip


def _alike(look: Look, eye: Eye, other: Eye, place, turn) -> np.ndarray:
    """[ways] the pixel-like motion of a body that looks as the change from a camera to another."""
    points = pose.rotate(turn, look.corners)
    if look.ball:
        points = np.concatenate([np.eye(3), -np.eye(3)]) @ eye.rotation * look.ball
    base = eye.project(points + place)
    target = other.project(points + place) - base
    columns = []
    for k in range(look.ways):
        by = np.zeros(look.ways)
        by[k] = 1e-3
        new, turned = moved(look, eye, place, turn, by)
        body = pose.rotate(pose.multiply(turned, pose.conjugate(turn)), points)
        columns.append(((eye.project(body + new) - base) / 1e-3).ravel())
    return np.linalg.lstsq(np.stack(columns, 1), target.ravel(), rcond=None)[0]
