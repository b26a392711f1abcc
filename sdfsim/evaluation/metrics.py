"""Measures of rollouts: errors as Rubanova et al. (2024) report them, energy, rest, survival."""

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.dataset import Trajectory

HORIZONS = (50, 100)  # steps; Rubanova et al. 2024 report errors over all steps up to there
REST_SPEED = 0.05  # m/s, bodies at rest in a recording are slower than this
REST_STEPS = 10  # number of last steps in which they must be
LIMITS = (0.1, 0.25, 0.5)  # m, translation errors up to which a body survives

Motions = list[Trajectory]


def errors(motions: Motions, recorded: Motions, horizons: Iterable[int] = HORIZONS) -> dict[str, dict]:
    """Errors of motions, over the dynamic bodies, at these horizons, as far as recordings reach, and at their end.

    Returns:
        Horizon in steps -> seconds, translation_rmse m and rotation_error degrees over all bodies and steps up to
        there, with 95 % intervals over trajectories, and `at_frame`: the same in the last of these steps only, where
        translation is the mean over trajectories of the root mean square over bodies (as in HOPNet, Wei et al. 2025).
    """
    longest = len(recorded[0].position) - 1
    bodies = np.array([(~t.static).sum() for t in recorded])
    share = bodies / bodies.mean()
    report = {}
    for h in sorted({h for h in horizons if h <= longest} | {longest}):
        upto, there = (
            np.array([compared(motion, truth, frames) for motion, truth in zip(motions, recorded, strict=True)])
            for frames in (slice(1, h + 1), slice(h, h + 1))
        )
        squared, angle = upto[:, 0] ** 2 * share, upto[:, 1] * share
        report[str(h)] = {
            "seconds": h * recorded[0].dt,
            "translation_rmse": float(np.sqrt(squared.mean())),
            "translation_rmse_95": [float(np.sqrt(v)) for v in interval(squared)],
            "rotation_error": float(angle.mean()),
            "rotation_error_95": interval(angle),
            "at_frame": {
                "translation_rmse": float(there[:, 0].mean()),
                "translation_rmse_95": interval(there[:, 0]),
                "rotation_error": float((there[:, 1] * share).mean()),
                "rotation_error_95": interval(there[:, 1] * share),
            },
        }
    return report


def compared(motion: Trajectory, truth: Trajectory, frames: slice) -> tuple[float, float]:
    """Root mean square distance in m, and mean angle in degrees, over some frames of the dynamic bodies."""
    moving = ~truth.static
    apart = motion.position[frames, moving] - truth.position[frames, moving]
    turns, true = (Rotation.from_quat(t.orientation[frames, moving].reshape(-1, 4)) for t in (motion, truth))
    angle = (turns * true.inv()).magnitude()
    return float(np.sqrt(np.square(apart).sum(-1).mean())), float(np.degrees(angle).mean())


def interval(values: np.ndarray) -> list[float]:
    """[low, high]: 95 % bootstrap interval of the mean of `values` [K]."""
    means = values[np.random.default_rng(0).integers(len(values), size=(1000, len(values)))].mean(1)
    return [float(v) for v in np.percentile(means, [2.5, 97.5])]


def energy(motion: Trajectory) -> np.ndarray:
    """[T] J: kinetic and potential energy of the dynamic bodies, with heights relative to the origin (the floor)."""
    moving = ~motion.static
    mass, inertia = motion.mass[moving], motion.inertia[moving]
    velocity, quat = motion.velocity[:, moving], motion.orientation[:, moving]
    turned = Rotation.from_quat(quat.reshape(-1, 4)).inv()
    spin = turned.apply(motion.angular_velocity[:, moving].reshape(-1, 3)).reshape(velocity.shape)
    kinetic = 0.5 * (mass * np.square(velocity).sum(-1) + (inertia * np.square(spin)).sum(-1))
    potential = -mass * (motion.position[:, moving] @ motion.gravity)
    return (kinetic + potential).sum(1)


def energy_gain(motions: Motions) -> dict[str, float | None]:
    """Mean and worst, over the trajectories, of the largest gain as a fraction of the energy at the start (0 if it
    never rises). Trajectories that start with no more energy than at rest at the origin's height are left out."""
    courses = [course for course in map(energy, motions) if course[0] > 0]
    gains = [float((course.max() - course[0]) / course[0]) for course in courses]
    return {"mean": float(np.mean(gains)) if gains else None, "worst": max(gains) if gains else None}


def speeds(motion: Trajectory) -> np.ndarray:
    """[`REST_STEPS`, N] m/s over the last steps: displacement divided by time, so that a creeping body counts as
    moving."""
    return np.linalg.norm(np.diff(motion.position[-REST_STEPS - 1 :], axis=0), axis=-1) / motion.dt


def resting(recorded: Trajectory) -> np.ndarray:
    """[N] bool: the dynamic bodies that are slower than `REST_SPEED` in all of the last steps."""
    return (speeds(recorded) < REST_SPEED).all(0) & ~recorded.static


def survival(motions: Motions, recorded: Motions) -> dict[str, float | None]:
    """Limit of `LIMITS` -> seconds until more than half of all bodies have been at least this far from the recording;
    None if they never are."""
    error = np.concatenate([distance(m, t) for m, t in zip(motions, recorded, strict=True)], axis=1)
    farthest = np.maximum.accumulate(error, axis=0)
    share = {str(limit): (farthest < limit).mean(1) for limit in LIMITS}
    fallen = {limit: np.flatnonzero(alive < 0.5) for limit, alive in share.items()}
    return {limit: float(at[0] * recorded[0].dt) if len(at) else None for limit, at in fallen.items()}


def distance(motion: Trajectory, truth: Trajectory) -> np.ndarray:
    """[T, N] m: translation errors of the dynamic bodies, including the first frame."""
    moving = ~truth.static
    return np.linalg.norm(motion.position[:, moving] - truth.position[:, moving], axis=-1)
