"""The recipes that `fit` can follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from sdfsim.shape.mlp_sdf import Activation


@dataclass(frozen=True)
class Plan:
    """One recipe. Lengths are relative to the shape's largest extent.

    Attributes:
        activation: of the hidden layers ("wave" or "relu").
        width: of the hidden layers.
        layers: linear layers, the last one included.
        first: first-layer weights are uniform in +-first (periodic; it sets the finest scale the fit starts with).
        optimiser: "soap" or "adam".
        lr: step size.
        decay: the part of the steps over which it falls to zero, at the end (0: constant).
        steps: updates.
        batch: points an update.
        sigmas: points lie this far from the surface (standard deviation, log-uniform between the two).
        near: fraction of points near the surface; the others are uniform in the box.
        resample: updates between fresh pools of points (0: one pool).
        pool: points in a pool.
        soften: errors count with soften / (|distance| + soften); None counts all alike.
        sign_everywhere: use the parity sign everywhere on closed surfaces, not only where the paper's rule trusts it.
        goal: errors of the averaged weights at which the decay begins early, which halves them: of the distance (means
            within 0.01 and in the box), of the gradient (median cosine distance within 0.1) and of the sign (fraction
            wrong farther than 0.002). None never stops early.
        settle: steps of an early decay.
        fold: fit a solid that is its own mirror image on one side only.
    """

    activation: Activation
    width: int
    layers: int
    first: float
    optimiser: Literal["soap", "adam"]
    lr: float
    decay: float
    steps: int
    batch: int
    sigmas: tuple[float, float]
    near: float
    resample: int
    pool: int
    soften: float | None
    sign_everywhere: bool
    goal: tuple[float, float, float, float] | None
    settle: int
    fold: bool


PLANS = {
    # Chosen by measurement on scanned and thin-walled shapes. The box gets its share of points and the loss stays soft
    # up to some hundredths of the size, without which the far field is off by as much.
    "default": Plan(
        activation="wave",
        width=64,
        layers=6,
        first=8.0,
        optimiser="soap",
        lr=1e-2,
        decay=0.5,
        steps=5000,
        batch=4096,
        sigmas=(0.002, 0.15),
        near=0.8,
        resample=0,
        pool=400_000,
        soften=0.04,
        sign_everywhere=True,
        goal=(7e-4, 6e-3, 4e-3, 1.3e-3),
        settle=1000,
        fold=True,
    ),
    # Rubanova et al. 2024, section 3.1 and appendix: 400k updates at 1e-5, noise 0.1 drawn again every 100 updates.
    "paper": Plan(
        activation="relu",
        width=128,
        layers=8,
        first=0.0,
        optimiser="adam",
        lr=1e-5,
        decay=0.0,
        steps=400_000,
        batch=4096,
        sigmas=(0.1, 0.1),
        near=1.0,
        resample=100,
        pool=65_536,
        soften=None,
        sign_everywhere=False,
        goal=None,
        settle=0,
        fold=False,
    ),
}
# A surface from a few minutes of training is not known as exactly as a full fit would follow it.
PLANS["quick"] = replace(PLANS["default"], steps=2000, settle=600)
