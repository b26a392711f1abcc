"""Starts in plain motion: bodies that roll, slide, spin or drop, and pairs that meet in flight."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.pybullet_sim import Teacher, TeacherBody
from sdfsim.data.shape_assets import ShapeSource
from sdfsim.data.starts_resting import FIELD, GAP, standing, upright

MOTIONS = ("rolling", "sliding", "spinning", "falling", "head-on")
SPEEDS = (0.5, 4.0)  # m/s
SPINS = (1.0, 10.0)  # rad/s, about the vertical
HEIGHTS = (0.1, 2.0)  # m, under a body that falls
MEETING = (0.1, 1.0)  # s, until the bodies of a pair touch
ALOFT = 32.0  # m, the lowest pair: more than it falls in 2 s, with what a hit may add
APART = 12.0  # m between the heights of pairs
HALF = 0.5  # of the bodies: along x or y, of a spin that fits, or unturned; the others any way


def set_moving(
    teacher: Teacher, rng: np.random.Generator, bodies: list[tuple[ShapeSource, TeacherBody]], motion: str, tries: int
) -> bool:
    """Put bodies into the world, all in one kind of motion.

    Those that roll are to be balls: half go along x or y, half have the spin of their speed and the others any. Those
    that slide do not turn at first. Those that spin or fall have no other velocity.

    Args:
        teacher: the world; the bodies come after those that it has.
        rng: what is drawn from.
        bodies: shapes of largest extent 1 m at scale 1, and their bodies; "head-on" takes two at a time.
        motion: one of `MOTIONS`.
        tries: places for one body.

    Returns:
        False when one found no room.
    """
    if motion == "head-on":
        for k in range(0, len(bodies) - 1, 2):
            _meet(teacher, rng, bodies[k : k + 2], ALOFT + APART * (k // 2))
        return True
    for one in bodies:
        index = teacher.add(one[1])
        for _ in range(tries):
            gap = rng.uniform(*HEIGHTS) if motion == "falling" else GAP
            if one[0].sphere or (motion == "falling" and rng.random() < HALF):
                rotation = Rotation.random(rng=rng)
            else:
                rotation = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)) * standing(one[0].vertices, rng)
            position, _ = upright(*one, rng.uniform(-FIELD, FIELD, 2), gap, rotation)
            teacher.place(index, position, rotation.as_quat())
            if not teacher.overlaps(index):
                break
        else:
            return False
        teacher.push(index, *_velocities(rng, motion, one[1].scale))
    return True


def _velocities(rng: np.random.Generator, motion: str, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear [3] m/s and angular [3] rad/s velocity of a body on the floor or above it."""
    up, still = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    if motion == "falling":
        return still, still
    if motion == "spinning":
        return still, rng.choice((-1.0, 1.0)) * rng.uniform(*SPINS) * up
    turn = 0.5 * np.pi * rng.integers(4) if rng.random() < HALF else rng.uniform(0.0, 2 * np.pi)
    velocity = rng.uniform(*SPEEDS) * np.array([np.cos(turn), np.sin(turn), 0.0])
    if motion == "sliding":
        return velocity, still
    spin = np.cross(up, velocity) / (0.5 * extent)
    if rng.random() < HALF:
        spin = Rotation.random(rng=rng).apply(rng.uniform(0.0, 2.0) * spin)
    return velocity, spin


def _meet(
    teacher: Teacher, rng: np.random.Generator, pair: list[tuple[ShapeSource, TeacherBody]], height: float
) -> None:
    """Two bodies at `height` m that fly at each other along a level line."""
    turn = rng.uniform(0.0, 2 * np.pi)
    line = np.array([np.cos(turn), np.sin(turn), 0.0])
    speeds, rotations = rng.uniform(*SPEEDS, 2), Rotation.random(2, rng=rng)
    reach = [body.scale * np.linalg.norm(source.vertices, axis=1).max() for source, body in pair]
    middle = np.array([*rng.uniform(-FIELD, FIELD, 2), height])
    time = rng.uniform(*MEETING)
    for k, side in enumerate((-1.0, 1.0)):
        index = teacher.add(pair[k][1])
        teacher.place(index, middle + side * (reach[k] + speeds[k] * time) * line, rotations[k].as_quat())
        teacher.push(index, -side * speeds[k] * line, np.zeros(3))
