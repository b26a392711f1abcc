"""Where the camera of a film stood: from points of known places and the horizon, or from a ball that falls."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml

from sdfsim.apps.film.eye import WAYS, Eye
from sdfsim.apps.film.frames import Clip
from sdfsim.apps.film.poses import Seen
from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose

CLICK, FAR = 1.0, 2.0  # px, standard deviations of a clicked point, and of one on the horizon
LENS = 1.0, 0.35  # focal length of phones relative to the longer side, and the spread of its logarithm
FLIGHT = 0.22  # s, of pieces in which a ball is taken to fly
FITS = 4.0  # mean of squares up to which a piece is a flight
LEVEL = 0.4  # rad, how much phones are tilted up or down
LEAST, LEAST_LEVEL = 4, 2  # points; and with as many of the horizon
YAWS = 72  # ways to turn about the vertical that are tried
BY_FALLING = "a falling ball"  # where such a camera comes from
WRONG = 8.0  # px, of points that do not fit together
UNSURE = 10.0  # how many standard deviations gravity must be from nothing in a piece
SCALE = 0.75, 1.35  # accelerations relative to gravity beyond which a piece is no flight


@dataclass(frozen=True)
class Points:
    """What was clicked in a film."""

    pixels: np.ndarray  # [N, 2] px of the upright film
    places: np.ndarray  # [N, 3] m
    horizon: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # [H, 2] px
    focal: float | None = None  # px

    def smaller(self, by: float) -> Points:
        """As clicked in a film whose sides are this much smaller."""
        return Points(self.pixels / by, self.places, self.horizon / by, self.focal and self.focal / by)


def read_points(path: Path) -> Points:
    """Points of a YAML file. Raises SdfsimError for a file that is not of this form."""
    try:
        data = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        points, level = ([one for one in data["points"] if (one["place"] == "horizon") == far] for far in (False, True))
        pixels, places = (np.array([one[key] for one in points], dtype=np.float64) for key in ("pixel", "place"))
        horizon = np.array([one["pixel"] for one in level], dtype=np.float64).reshape(len(level), 2)
        found = Points(pixels, places, horizon, data.get("focal"))
        enough = len(points) >= (LEAST_LEVEL if len(level) >= LEAST_LEVEL else LEAST)
        if pixels.shape[1:] != (2,) or places.shape[1:] != (3,) or not enough or (found.focal or 1.0) <= 0:
            raise ValueError
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        what = (
            f"must hold points, at least {LEAST}, each with pixel: [x, y] and place: [x, y, z] (m), or at least "
            f"{LEAST_LEVEL} such and {LEAST_LEVEL} with place: horizon"
        )
        raise SdfsimError(f"{path}: {what}", "docs/identify.md shows such a file") from error
    return found


def of_points(points: Points, size: tuple[int, int], name: str) -> Eye:
    """The camera that sees points at these pixels; the focal length is found with it, by what is usual and, if given,
    to 2 %. Raises SdfsimError if no camera does."""
    from scipy.optimize import least_squares

    wide, high = size
    longer, places = max(size), points.places
    usual, spread = (np.log(points.focal), 0.02) if points.focal else (np.log(LENS[0] * longer), LENS[1])
    best, rest = None, None
    for guess in [points.focal] if points.focal else np.geomspace(0.5, 2.5, 9) * longer:
        for turn, shift in _posed(points, float(guess), 0.5 * np.array(size)):
            start = Eye(turn, shift, float(guess), wide, high, np.zeros((WAYS, 0)), name)

            def off(change: np.ndarray, start: Eye = start) -> np.ndarray:
                eye = start.moved(change)
                at = np.nan_to_num((eye.project(places) - points.pixels) / CLICK, nan=1e3)
                up = eye.rotation[:, 2]
                far = eye.rays(*points.horizon.T) @ up * eye.focal / max(float(np.hypot(*up[:2])), 1e-6)
                return np.r_[at.ravel(), far / FAR, (np.log(eye.focal) - usual) / spread]

            found = least_squares(off, np.zeros(WAYS), x_scale="jac")
            eye = start.moved(found.x)
            if (eye.seen(places)[:, 2] > 0).all() and (rest is None or found.cost < rest.cost):
                best, rest = eye, found
    mean = np.inf if rest is None else float(np.sqrt(np.square(rest.fun[:-1]).sum() / len(places)))
    if best is None or rest is None or mean > WRONG:
        raise SdfsimError(
            f"{name}: no camera sees these points at these pixels ({mean:.1f} px off)", "check the points"
        )
    freedom = max(1, 2 * len(places) + len(points.horizon) - WAYS)
    chi = max(1.0, float(np.square(rest.fun[:-1]).sum()) / freedom)
    normal = rest.jac.T @ rest.jac
    covariance = np.linalg.inv(normal + 1e-9 * np.diag(np.diag(normal))) * chi
    values, vectors = np.linalg.eigh(covariance)
    at_best = np.eye(WAYS)  # changes about `start` are those about `best` to first order
    doubt = at_best @ vectors * np.sqrt(np.maximum(values, 0.0))
    return Eye(best.rotation, best.translation, best.focal, wide, high, doubt, name)


def _posed(points: Points, focal: float, middle: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """First guesses of a camera: rotations [3, 3] of the world to it, and translations [3] m."""
    import cv2

    if len(points.places) >= LEAST:
        lens = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
        for method in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
            done, turn, shift = cv2.solvePnP(points.places, points.pixels, lens, None, flags=method)
            if done and np.isfinite(shift).all():
                yield cv2.Rodrigues(turn)[0], shift[:, 0]
    if len(points.horizon) >= LEAST_LEVEL:
        # The rays to the horizon are level, so the vertical is known; each turn about it leaves a linear problem.
        rays, far = (np.c_[(at - middle) / focal, np.ones(len(at))] for at in (points.pixels, points.horizon))
        up = np.linalg.svd(far)[2][2]
        up = -up if up[1] > 0 else up
        aside = np.linalg.svd(up[None])[2][1:]
        aside[1] *= np.sign(np.linalg.det(np.c_[aside.T, up]))
        across = np.cross(np.eye(3), rays[:, None]).transpose(0, 2, 1)  # [N, 3, 3]: v -> ray x v
        found = []
        for yaw in np.arange(YAWS) * 2 * np.pi / YAWS:
            first = np.cos(yaw) * aside[0] + np.sin(yaw) * aside[1]
            turn = np.stack([first, np.cross(up, first), up], 1)
            seen = np.einsum("nij,jk,nk->ni", across, turn, points.places).ravel()
            shift = -np.linalg.lstsq(across.reshape(-1, 3), seen, rcond=None)[0]
            depth = (points.places @ turn.T + shift)[:, 2]
            rest = np.square(across.reshape(-1, 3) @ shift + seen).sum() / max(float(np.square(depth).sum()), 1e-12)
            found.append((rest if (depth > 0).all() else np.inf, turn, shift))
        yield min(found, key=lambda one: one[0])[1:]


def level(clip: Clip) -> Eye:
    """A camera at the origin that looks along y, of a usual phone: what is taken before anything is known."""
    high, wide = clip.pixels.shape[1:3]
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    return Eye(turn, np.zeros(3), LENS[0] * max(wide, high), wide, high, np.zeros((WAYS, 0)), BY_FALLING)


def of_ball(
    clip: Clip, eye: Eye, seen: Sequence[Seen | None], gravity: np.ndarray, start: np.ndarray, ground: float
) -> tuple[Eye, np.ndarray, np.ndarray]:
    """The camera of a film of a ball that bounces on level ground: down is where it accelerates to, and its lowest
    place is on the `ground`, m above which its centre then is; it begins at `start` [3] m, seen from above.

    Returns the camera, and the matrix [3, 3] and shift [3] that lead from the world of `eye` to that of the scene.
    Raises SdfsimError if it never flies, or falls at another rate than gravity's."""
    rows = np.array([k for k, one in enumerate(seen) if one is not None])
    count = max(6, round(FLIGHT / clip.step))
    strength = float(np.linalg.norm(gravity))
    found = []
    for a in range(0, len(rows) - count + 1, max(1, count // 3)):
        some = [seen[k] for k in rows[a : a + count]]
        t = clip.time[rows[a : a + count]] - clip.time[rows[a : a + count]].mean()
        root = np.stack([one.root[:, :3] for one in some])
        right = np.stack([one.root[:, :3] @ one.place - one.rest for one in some]).ravel()
        matrix = np.concatenate([root, root * t[:, None, None], root * 0.5 * t[:, None, None] ** 2], 2).reshape(-1, 9)
        fit = np.linalg.lstsq(matrix, right, rcond=None)[0]
        chi = max(1.0, float(np.square(matrix @ fit - right).sum()) / (3 * count - 9))
        across = fit[6:] - eye.rotation[2] * (eye.rotation[2] @ fit[6:])
        sure = matrix[:, 6:] - matrix[:, :6] @ np.linalg.lstsq(matrix[:, :6], matrix[:, 6:], rcond=None)[0]
        certain = float(np.linalg.norm(sure @ across)) / np.sqrt(chi)  # standard deviations from an even speed
        if t[-1] - t[0] < 1.5 * FLIGHT and certain > UNSURE:
            found.append((chi, across, matrix / np.sqrt(chi), right / np.sqrt(chi)))
    flights = [one for one in found if one[0] <= FITS]
    pulls = [float(np.linalg.norm(across)) for _, across, *_ in flights]
    pieces = [one for one, pull in zip(flights, pulls, strict=True) if SCALE[0] < pull / strength < SCALE[1]]
    if not pieces:
        usual = float(np.median(pulls or [0.0]))
        if usual > 1e-3 * strength:
            hint = f"a film in slow motion needs --slow, here about {np.sqrt(strength / usual):.1f}"
            raise SdfsimError(f"{clip.path}: things fall at {usual:.2g} m/s^2, not {strength:.3g}", hint)
        hint = "the camera needs points of known places: --points"
        raise SdfsimError(f"{clip.path}: the ball never flies freely", hint)
    # The direction of gravity, of this strength: two angles, by Gauss-Newton; places and speeds are eliminated.
    down = np.median([across / np.linalg.norm(across) for _, across, *_ in pieces], 0)
    down /= np.linalg.norm(down)
    for _ in range(30):
        aside = np.linalg.svd(down[None])[2][1:]
        normal, pull = np.zeros((2, 2)), np.zeros(2)
        for _, _, matrix, right in pieces:
            basis = np.linalg.qr(matrix[:, :6])[0]
            rest = right - strength * matrix[:, 6:] @ down
            slope = strength * matrix[:, 6:] @ aside.T
            rest, slope = (x - basis @ (basis.T @ x) for x in (rest, slope))
            normal, pull = normal + slope.T @ slope, pull + slope.T @ rest
        ahead = eye.rotation[2]  # people hold phones about level
        normal = normal + np.outer(aside @ ahead, aside @ ahead) / LEVEL**2 + 1e-9 * np.eye(2)
        by = np.linalg.solve(normal, pull - aside @ ahead * (down @ ahead) / LEVEL**2)
        down = down + by * min(1.0, 0.1 / np.linalg.norm(by)) @ aside
        down /= np.linalg.norm(down)
    axis = np.cross(down, [0.0, 0.0, -1.0])
    angle = np.arctan2(np.linalg.norm(axis), -down[2])
    matrix = pose.to_matrix(pose.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle))
    places = np.stack([seen[k].place for k in rows]) @ matrix.T
    sure = np.stack([np.linalg.norm(seen[k].root[:, :3] @ matrix.T[:, 2]) for k in rows])
    low = np.quantile(places[sure > 0.3 * np.median(sure), 2], 0.02)
    shift = np.r_[start[:2] - places[0, :2], ground - low]
    rotation = eye.rotation @ matrix.T
    # Not known: which way is down (two angles about axes across it), the height, and the focal length.
    doubt = np.zeros((WAYS, 4))
    covariance = 2.0 * np.linalg.inv(normal)
    values, vectors = np.linalg.eigh(covariance)
    for k in range(2):
        about = matrix @ np.cross(down, vectors[:, k] @ aside)
        doubt[:3, k] = np.sqrt(values[k]) * (rotation @ about)
    doubt[3:6, 2] = rotation @ np.array([0.0, 0.0, 0.05])
    doubt[6, 3] = LENS[1]
    translation = -rotation @ shift
    return Eye(rotation, translation, eye.focal, eye.width, eye.height, doubt, eye.source), matrix, shift


def in_world(one: Seen, turn: np.ndarray, shift: np.ndarray) -> Seen:
    """A ball's pose after its world was turned and shifted; its uncertainty is to be found again."""
    return replace(one, place=turn @ one.place + shift)
