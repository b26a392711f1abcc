"""Films of motions that are known: a phone's blur, noise, flicker, shadows, and a hand in front."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sdfsim.apps.beside import between
from sdfsim.apps.render import write_movie
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene
from sdfsim.simulate.camera import Camera, Style

GRAVITY = 9.81
Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]  # time -> centres of mass [N, 3], orientations [N, 4]
SKIN = np.array([196, 150, 120])


def of_rollout(rollout: Rollout) -> Motion:
    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        place, turn = between(rollout.time, rollout.position, rollout.orientation, np.array([max(0.0, time)]))
        return place[0], turn[0]

    return at


def bouncing(
    start: Sequence[float], velocity: Sequence[float], radius: float, restitution: float, friction: float
) -> Motion:
    """A ball on the plane z = 0, body 1 of two, in closed form: impulses of a rigid solid sphere."""
    pieces = [(0.0, np.array(start, float), np.array(velocity, float), np.zeros(3))]
    for _ in range(40):
        t, p, v, w = pieces[-1]
        fall = (v[2] + np.sqrt(max(0.0, v[2] ** 2 + 2 * GRAVITY * (p[2] - radius)))) / GRAVITY
        p = p + v * fall - [0, 0, 0.5 * GRAVITY * fall**2]
        v = v - [0, 0, GRAVITY * fall]
        slip = v[:2] - radius * np.array([w[1], -w[0]])  # of the lowest point
        speed = np.linalg.norm(slip)
        push = min(friction * (1 + restitution) * -v[2], speed / 3.5) * -slip / max(speed, 1e-12)
        w = w - 2.5 / radius * np.array([-push[1], push[0], 0.0])
        p[2] = radius
        pieces.append((t + fall, p, np.array([*(v[:2] + push), -restitution * v[2]]), w))
        if restitution * -v[2] < 0.02:
            break
    starts = np.array([t for t, *_ in pieces])

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        t, p, v, _ = pieces[max(0, int(np.searchsorted(starts, time, "right")) - 1)]
        later = time - t
        place = p + v * later - [0, 0, 0.5 * GRAVITY * later**2]
        place[2] = max(place[2], radius)
        return np.array([np.zeros(3), place]), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))

    return at


def slid(start: Sequence[float], speed: float, friction: float, turn: Sequence[float]) -> Motion:
    """Body 1 of two, which slides along x to a halt, without turning."""

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        t = min(time, speed / (friction * GRAVITY))
        place = np.array([start[0] + speed * t - 0.5 * friction * GRAVITY * t**2, *start[1:]])
        return np.array([np.zeros(3), place]), np.array([[0.0, 0.0, 0.0, 1.0], turn])

    return at


def filmed(
    path: Path, scene: Scene, motion: Motion, camera: Camera, seconds: float, fps: float, *, exposure: float = 0.5,
    noise: float = 2.0, flicker: float = 0.0, hand: Callable[[float], np.ndarray | None] | None = None,
    shake: float = 0.0, light: float = 1.0, subframes: int = 4, seed: int = 0,
) -> Path:  # fmt: skip
    """Write a film of `seconds`. A frame k is the mean of `subframes` pictures in an exposure of `exposure` frames
    about the time k / fps. `flicker`: the share by which lamps at 100 Hz vary; `hand`: time -> the box (left, top,
    right, bottom) px that it covers; `shake`: px by which the camera drifts a frame; `light`: of the picture."""
    rng = np.random.default_rng(seed)
    style = Style(smooth=True)

    def frames() -> Iterator[np.ndarray]:
        still: tuple | None = None
        for k in range(round(seconds * fps)):
            shots = []
            for part in (np.arange(subframes) + 0.5) / subframes - 0.5:
                now = motion((k + exposure * part) / fps)
                if still is None or any(np.abs(a - b).max() > 1e-9 for a, b in zip(now, still[0], strict=True)):
                    still = now, camera.picture(scene, *now, style).color.astype(float)
                shots.append(still[1])
            pixels = np.mean(shots, 0)
            cover = hand(k / fps) if hand else None
            if cover is not None:
                left, top, right, bottom = (int(v) for v in cover)
                pixels[max(0, top) : max(0, bottom), max(0, left) : max(0, right)] = SKIN
            pixels *= light * (1.0 + flicker * np.sin(2 * np.pi * 100.0 * k / fps + 0.3 * k))
            if shake:
                pixels = np.roll(pixels, round(shake * k), 1)
            yield np.clip(pixels + noise * rng.standard_normal(pixels.shape), 0, 255).astype(np.uint8)

    write_movie(path, frames(), camera, fps)
    return path
