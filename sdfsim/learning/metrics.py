"""Errors of rollouts against recorded trajectories, as the paper reports them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def translation_rmse(position: np.ndarray, truth: np.ndarray) -> float:
    """Root mean squared distance in m over bodies and steps of [T, N, 3] positions."""
    return float(np.sqrt(np.square(position - truth).sum(-1).mean()))


def rotation_error(quat: np.ndarray, truth: np.ndarray) -> float:
    """Mean angle in degrees between [T, N, 4] xyzw orientations, over bodies and steps."""
    one, two = Rotation.from_quat(quat.reshape(-1, 4)), Rotation.from_quat(truth.reshape(-1, 4))
    return float(np.degrees((one * two.inv()).magnitude()).mean())


def interval(values: np.ndarray, seed: int = 0, draws: int = 1000) -> list[float]:
    """[low, high]: 95 % bootstrap interval of the mean of `values` [K]."""
    rng = np.random.default_rng(seed)
    means = values[rng.integers(len(values), size=(draws, len(values)))].mean(1)
    return [float(v) for v in np.percentile(means, [2.5, 97.5])]
