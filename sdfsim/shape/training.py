"""The training loop behind `fit`: sampling, loss, schedule, early stop, resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from sdfsim.shape.checkpoint import Checkpoint
from sdfsim.shape.distance import DistanceOracle
from sdfsim.shape.mesh import Frame, normal_frame, sample_surface
from sdfsim.shape.mlp import BOX, Activation, MlpSdf, value_and_gradient
from sdfsim.shape.soap import Adam, Soap


@dataclass(frozen=True)
class Plan:
    """One recipe. Lengths are relative to the shape's largest extent.

    Attributes:
        activation: of the hidden layers.
        width: of the hidden layers.
        layers: linear layers, the last one included.
        first: first-layer weights are uniform in +-first (sine; it sets the finest scale the fit starts with).
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
        goal: mean errors (within 0.01, in the box) of the averaged weights at which the decay begins early; a decay
            halves them. None never stops early.
        settle: steps of an early decay.
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
    goal: tuple[float, float] | None
    settle: int


PLANS = {
    # Chosen by measurement on scanned and thin-walled shapes. The box gets its share of points and the loss stays soft
    # up to some hundredths of the size, without which the far field is off by as much.
    "default": Plan(
        activation="sine",
        width=64,
        layers=8,
        first=8.0,
        optimiser="soap",
        lr=1e-2,
        decay=0.5,
        steps=6000,
        batch=2048,
        sigmas=(0.002, 0.15),
        near=0.75,
        resample=0,
        pool=400_000,
        soften=0.04,
        sign_everywhere=True,
        goal=(8e-4, 5e-3),
        settle=1200,
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
    ),
}
WARMUP = 50
# Points are drawn from a little beyond the box that is used: at the very edge of its data a network's slope is poor.
MARGIN = 1.15
CHECK = 100


@dataclass(frozen=True)
class _Pool:
    """Points [P, 3] with their distance [P] (normalised) and whether its sign counts [P]."""

    points: torch.Tensor
    distance: torch.Tensor
    signed: torch.Tensor


def train(
    oracle: DistanceOracle,
    plan: Plan,
    *,
    budget: float | None,
    seed: int,
    tell: Callable[[float, str], None],
    checkpoint: Path | None,
) -> tuple[MlpSdf, int]:
    """Run a plan.

    Args:
        oracle: true distances, metres.
        plan: the recipe.
        budget: seconds at most; the decay begins early enough to end within them.
        seed: of points and weights.
        tell: called with (fraction done, message).
        checkpoint: resumed from when it belongs to this very fit; removed at the end.

    Returns:
        the network and the number of updates made.
    """
    started = time.monotonic()
    frame = normal_frame(oracle.bounds)
    tell(0.0, "sampling distances")
    pool = _sample(oracle, frame, plan, np.random.default_rng([seed, 0]))
    check = _sample(
        oracle, frame, replace(plan, pool=8000, near=0.5, sigmas=(0.006, 0.006)), np.random.default_rng([seed, 1])
    )
    generator = torch.Generator().manual_seed(seed)
    parameters = _initial(plan, generator)
    average = [parameter.detach().clone() for parameter in parameters]
    optimiser = (Soap if plan.optimiser == "soap" else Adam)(parameters, plan.lr)
    # Where the decay begins; an early stop or a short budget moves it forward.
    turn, step = int(plan.steps * (1.0 - plan.decay)), 0
    stop = plan.steps
    saved = Checkpoint(checkpoint, f"{asdict(plan)}|{seed}", oracle.surface) if checkpoint is not None else None
    if saved is not None:
        step, turn, stop = saved.load(parameters, average, optimiser, generator) or (step, turn, stop)
    before, looping = step, time.monotonic()

    while step < stop:
        if plan.resample and step and step % plan.resample == 0:
            pool = _sample(oracle, frame, plan, np.random.default_rng([seed, 0, step]))
        loss = _loss(parameters, plan, pool, torch.randint(len(pool.points), (plan.batch,), generator=generator))
        for parameter in parameters:
            parameter.grad = None
        loss.backward()
        factor = min(1.0, (step + 1) / WARMUP)
        if plan.decay and step >= turn:
            factor *= 0.5 * (1.0 + math.cos(math.pi * (step - turn) / max(stop - turn, 1)))
        optimiser.step(factor)
        step += 1
        with torch.no_grad():
            for mean, parameter in zip(average, parameters, strict=True):
                mean.lerp_(parameter, 0.02)
        if step % CHECK:
            continue

        if not math.isfinite(loss.item()) or not all(bool(p.isfinite().all()) for p in parameters):
            # A fresh start from new weights with a quarter of the step size.
            parameters = _initial(plan, torch.Generator().manual_seed(1))
            average = [parameter.detach().clone() for parameter in parameters]
            optimiser = type(optimiser)(parameters, optimiser.lr / 4)
        near, far = _errors(average, plan, check)
        if plan.goal is not None and step < turn and near <= plan.goal[0] and far <= plan.goal[1]:
            turn, stop = step, min(stop, step + plan.settle)
        elapsed = time.monotonic() - started
        if budget is not None:
            pace = (time.monotonic() - looping) / (step - before)
            possible = step + int((0.9 * budget - elapsed) / pace)  # a tenth is left for the certificate
            turn, stop = _fitted(possible, step, turn, stop, plan)
        tell(0.97 * step / max(stop, 1), f"step {step} of {stop}, error {near:.2g} near, {far:.2g} in the box")
        if saved is not None and step % (2 * CHECK) == 0:
            saved.save(parameters, average, optimiser, generator, (step, turn, stop))

    if saved is not None:
        saved.remove()
    weights, biases = _layers([parameter.detach() for parameter in parameters])
    return MlpSdf(
        tuple(weight.clone() for weight in weights),
        tuple(bias.clone() for bias in biases),
        plan.activation,
        frame,
        oracle.bounds.copy(),
    ), step


def _fitted(possible: int, step: int, turn: int, stop: int, plan: Plan) -> tuple[int, int]:
    """Where decay and end must lie when `possible` steps can be made in all.

    Until the decay has begun the end moves both ways, since the first steps of a busy machine tell little; after
    that it only comes nearer.
    """
    if step >= turn:
        return turn, max(min(stop, possible), step)
    stop = max(min(plan.steps, possible), step)
    return max(step, int(stop * (1.0 - plan.decay))), stop


def _sample(oracle: DistanceOracle, frame: Frame, plan: Plan, rng: np.random.Generator) -> _Pool:
    near = int(plan.pool * plan.near)
    local = frame.inward(sample_surface(oracle.surface, near, rng)[0])
    low, high = np.log(plan.sigmas)
    sigma = np.exp(rng.uniform(low, high, (near, 1)))
    local = np.concatenate(
        [
            local + sigma * rng.standard_normal((near, 3)),
            rng.uniform(-MARGIN * BOX, MARGIN * BOX, (plan.pool - near, 3)),
        ]
    )
    local = np.clip(local, -MARGIN * BOX, MARGIN * BOX)
    truth = oracle(frame.outward(local))
    signed = truth.trusted | (oracle.closed and plan.sign_everywhere)
    return _Pool(
        torch.from_numpy(local).float(),
        torch.from_numpy(truth.distance / frame.scale).float(),
        torch.from_numpy(signed),
    )


def _initial(plan: Plan, generator: torch.Generator) -> list[torch.Tensor]:
    """First [1, W, 3], hidden [L - 2, W, W] and last [1, 1, W] weights, then the biases [L - 1, W, 1] and [1, 1, 1].

    Equal layers are stacked for the optimiser. Sine layers start with phases all around and pre-activations of unit
    variance (Sitzmann et al. 2020); ReLU layers with He's variance.
    """
    width, hidden = plan.width, plan.layers - 2

    def uniform(bound: float, *shape: int) -> torch.Tensor:
        return ((2.0 * torch.rand(shape, generator=generator) - 1.0) * bound).requires_grad_()

    sine = plan.activation == "sine"
    return [
        uniform(plan.first if sine else math.sqrt(2.0), 1, width, 3),
        uniform(math.sqrt(6.0 / width), hidden, width, width),
        uniform(math.sqrt(6.0 / width) / (10.0 if sine else 1.0), 1, 1, width),
        uniform(math.pi if sine else 0.05, plan.layers - 1, width, 1),
        uniform(0.05, 1, 1, 1),
    ]


def _layers(parameters: list[torch.Tensor]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Per layer weights [out, in] and biases [out]."""
    first, hidden, last, biases, end = parameters
    return [first[0], *hidden.unbind(0), last[0]], [*biases[..., 0].unbind(0), end[0, :, 0]]


def _loss(parameters: list[torch.Tensor], plan: Plan, pool: _Pool, chosen: torch.Tensor) -> torch.Tensor:
    """Weighted L1 of the signed distance, and of the unsigned one where the sign is not known."""
    weights, biases = _layers(parameters)
    hidden = pool.points[chosen]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        hidden = torch.addmm(bias, hidden, weight.t())
        hidden = hidden.sin() if plan.activation == "sine" else hidden.relu()
    value = torch.addmm(biases[-1], hidden, weights[-1].t())[:, 0]
    distance, signed = pool.distance[chosen], pool.signed[chosen]
    error = torch.where(signed, value - distance, value.abs() - distance.abs()).abs()
    if plan.soften is not None:
        error = error * (plan.soften / (distance.abs() + plan.soften))
    return error.mean()


def _errors(parameters: list[torch.Tensor], plan: Plan, check: _Pool) -> tuple[float, float]:
    """Mean absolute error near the surface (first half of the pool) and in the box (second half)."""
    weights, biases = _layers(parameters)
    value, _ = value_and_gradient(
        [w[None] for w in weights], [b[None] for b in biases], plan.activation, check.points[None]
    )
    error = torch.where(check.signed, value[0] - check.distance, value[0].abs() - check.distance.abs()).abs()
    half = len(error) // 2
    return float(error[:half].mean()), float(error[half:].mean())
