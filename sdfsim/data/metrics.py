"""What rollouts are judged by: errors against a recording as the paper reports them, energy, rest, survival."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.dataset import Trajectory

HORIZONS = (50, 100)  # steps; errors over all steps up to there are what Rubanova et al. 2024 report
FRAMES = (25, 50, 75, 100)  # steps; errors there are what HOPNet (Wei et al. 2025) and RigidFormer (2026) report
REST_SPEED = 0.05  # m/s, what rests in a recording is slower than this
REST_STEPS = 10  # the last steps, in which it has to be


def translation_rmse(position: np.ndarray, truth: np.ndarray) -> float:
    """Root mean squared distance in m over bodies and steps of [T, N, 3] positions."""
    return float(np.sqrt(np.square(position - truth).sum(-1).mean()))


def rotation_error(quat: np.ndarray, truth: np.ndarray) -> float:
    """Mean angle in degrees between [T, N, 4] xyzw orientations, over bodies and steps."""
    one, two = Rotation.from_quat(quat.reshape(-1, 4)), Rotation.from_quat(truth.reshape(-1, 4))
    return float(np.degrees((one * two.inv()).magnitude()).mean())


def interval(values: np.ndarray) -> list[float]:
    """[low, high]: 95 % bootstrap interval of the mean of `values` [K]."""
    means = values[np.random.default_rng(0).integers(len(values), size=(1000, len(values)))].mean(1)
    return [float(v) for v in np.percentile(means, [2.5, 97.5])]


def energy(motion: Trajectory) -> np.ndarray:
    """[T] J: kinetic and potential energy of the bodies that move, heights taken from the origin (the floor)."""
    moving = ~motion.static
    mass, inertia = motion.mass[moving], motion.inertia[moving]
    velocity, quat = motion.velocity[:, moving], motion.quat_xyzw[:, moving]
    turned = Rotation.from_quat(quat.reshape(-1, 4)).inv()
    spin = turned.apply(motion.angular_velocity[:, moving].reshape(-1, 3)).reshape(velocity.shape)
    kinetic = 0.5 * (mass * np.square(velocity).sum(-1) + (inertia * np.square(spin)).sum(-1))
    potential = -mass * (motion.position[:, moving] @ motion.gravity)
    return (kinetic + potential).sum(1)


def energy_gain(motion: Trajectory) -> float | None:
    """Largest increase of the energy over that of the first frame, as a fraction of it (0 when it never rises). None
    where the first frame has no energy above that of rest at the origin's height, so that no fraction exists."""
    course = energy(motion)
    return float((course.max() - course[0]) / course[0]) if course[0] > 0 else None


def speeds(motion: Trajectory) -> np.ndarray:
    """[`REST_STEPS`, N] m/s over the last steps: displacement by time, so that a body which creeps is seen to move."""
    return np.linalg.norm(np.diff(motion.position[-REST_STEPS - 1 :], axis=0), axis=-1) / motion.dt


def resting(recorded: Trajectory) -> np.ndarray:
    """[N] bool: the bodies, static ones left out, that are slower than `REST_SPEED` in all of the last steps."""
    return (speeds(recorded) < REST_SPEED).all(0) & ~recorded.static


def survival(error: np.ndarray, limit: float) -> np.ndarray:
    """[T] share of bodies whose error [T, N] m has stayed below `limit` m up to each frame."""
    return (np.maximum.accumulate(error, axis=0) < limit).mean(1)


def median_survival(share: np.ndarray, dt: float) -> float | None:
    """Seconds until fewer than half of the bodies survive, of a curve [T] with a frame each `dt` s; None if never."""
    fallen = np.flatnonzero(share < 0.5)
    return float(fallen[0] * dt) if len(fallen) else None
