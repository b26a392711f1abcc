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
from sdfsim.shape.mlp import BOX, MlpSdf
from sdfsim.shape.soap import Adam, Soap
from sdfsim.shape.sweep import Activation, Tape, value_and_gradient


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
        goal: mean errors (within 0.01, in the box) of the averaged weights at which the decay begins early; a decay
            halves them. None never stops early.
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
    goal: tuple[float, float] | None
    settle: int
    fold: bool


PLANS = {
    # Chosen by measurement on scanned and thin-walled shapes. The box gets its share of points and the loss stays soft
    # up to some hundredths of the size, without which the far field is off by as much.
    "default": Plan(
        activation="wave",
        width=64,
        layers=8,
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
        goal=(8e-4, 4e-3),
        settle=700,
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
WARMUP = 50
# Points are drawn from a little beyond the box that is used: at the very edge of its data a network's slope is poor.
MARGIN = 1.15
CHECK = 100
# Seconds that the certificate takes of a budget, beside a tenth.
RESERVE = 2.0
# A solid whose distances agree with their mirror images' to this, relative to its size, is fitted on one side only.
SAME = 1e-4


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
    mirrors = _mirrors(oracle, frame) if plan.fold else (False, False, False)
    pool = _sample(oracle, frame, plan, mirrors, np.random.default_rng([seed, 0]))
    checked = replace(plan, pool=8000, near=0.5, sigmas=(0.006, 0.006))
    check = _sample(oracle, frame, checked, mirrors, np.random.default_rng([seed, 1]))
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
    tape = Tape(plan.activation, plan.width, plan.layers, parameters[0])
    before, looping = step, time.monotonic()

    while step < stop:
        if plan.resample and step and step % plan.resample == 0:
            pool = _sample(oracle, frame, plan, mirrors, np.random.default_rng([seed, 0, step]))
        chosen = torch.randint(len(pool.points), (plan.batch,), generator=generator)
        loss = _differentiate(tape, parameters, plan, pool, chosen)
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

        if not math.isfinite(loss) or not all(bool(p.isfinite().all()) for p in parameters):
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
            kept = min(0.1 * budget + RESERVE, 0.5 * budget)
            possible = step + int((budget - kept - elapsed) / pace)
            turn, stop = _fitted(possible, step, turn, stop, plan)
        tell(0.97 * step / max(stop, 1), f"step {step} of {stop}, error {near:.2g} near, {far:.2g} in the box")
        if saved is not None and step % (2 * CHECK) == 0:
            saved.save(parameters, average, optimiser, generator, (step, turn, stop))

    if saved is not None:
        saved.remove()
    weights, biases = _layers(parameters, plan.activation)
    return MlpSdf(
        tuple(weight[0].clone() for weight in weights),
        tuple(bias[0].clone() for bias in biases),
        plan.activation,
        frame,
        oracle.bounds.copy(),
        mirrors,
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


def _mirrors(oracle: DistanceOracle, frame: Frame) -> tuple[bool, bool, bool]:
    """Across which planes of its frame the solid is its own mirror image, as far as sampled distances tell."""
    rng = np.random.default_rng(0)
    local = frame.inward(sample_surface(oracle.surface, 2000, rng)[0])
    local = np.concatenate([local, local + rng.normal(0.0, 0.05, local.shape)])
    truth = oracle(frame.outward(local)).distance
    same = []
    for axis in range(3):
        image = local.copy()
        image[:, axis] *= -1.0
        same.append(bool(np.abs(oracle(frame.outward(image)).distance - truth).max() < SAME * frame.scale))
    return same[0], same[1], same[2]


def _sample(
    oracle: DistanceOracle, frame: Frame, plan: Plan, mirrors: tuple[bool, bool, bool], rng: np.random.Generator
) -> _Pool:
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
    local = np.where(mirrors, np.abs(local), local)
    return _Pool(
        torch.from_numpy(local).float(),
        torch.from_numpy(truth.distance / frame.scale).float(),
        torch.from_numpy(signed),
    )


def _initial(plan: Plan, generator: torch.Generator) -> list[torch.Tensor]:
    """First [1, W, 3], hidden [L - 2, W, W] and last [1, 1, W] weights, then the biases [L - 1, W, 1] and [1, 1, 1].

    Equal layers are stacked for the optimiser. Periodic layers start with phases all around and the spread of inputs
    that sine layers have (Sitzmann et al. 2020); ReLU layers with He's variance.
    """
    width, hidden = plan.width, plan.layers - 2

    def uniform(bound: float, *shape: int) -> torch.Tensor:
        parameter = (2.0 * torch.rand(shape, generator=generator) - 1.0) * bound
        parameter.grad = torch.zeros_like(parameter)
        return parameter

    periodic = plan.activation == "wave"
    return [
        uniform(plan.first if periodic else math.sqrt(2.0), 1, width, 3),
        uniform(math.sqrt(6.0 / width), hidden, width, width),
        uniform(math.sqrt(6.0 / width) / (10.0 if periodic else 1.0), 1, 1, width),
        uniform(math.pi if periodic else 0.05, plan.layers - 1, width, 1),
        uniform(0.05, 1, 1, 1),
    ]


# A wave of period 1 with the parameters of a sine of period 2 pi: they are trained at the sine's scale, on which
# equal steps of the optimiser suit all layers, and multiplied by these before every use. Its height is 1/8.
_SCALES = {"wave": (0.5 / math.pi, 4.0 / math.pi, 8.0, 0.5 / math.pi, 1.0), "relu": (1.0,) * 5}


def _layers(parameters: list[torch.Tensor], activation: Activation) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """What the network computes with, per layer: weights [1, out, in] and biases [1, out]."""
    used = [parameter * scale for parameter, scale in zip(parameters, _SCALES[activation], strict=True)]
    return _split(used)


def _split(parts: list[torch.Tensor]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    first, hidden, last, biases, end = parts
    return [first, *hidden.split(1), last], [*biases[..., 0].split(1), end[..., 0]]


def _differentiate(tape: Tape, parameters: list[torch.Tensor], plan: Plan, pool: _Pool, chosen: torch.Tensor) -> float:
    """Weighted L1 of the signed distance, and of the unsigned one where the sign is not known; fills the gradients."""
    weights, biases = _layers(parameters, plan.activation)
    points = pool.points[chosen][None]
    value = tape.forward(weights, biases, points)[0]
    distance, signed = pool.distance[chosen], pool.signed[chosen]
    error = torch.where(signed, value - distance, value.abs() - distance.abs())
    slope = error.sign() * torch.where(signed, 1.0, value.sign()) / len(chosen)
    if plan.soften is not None:
        weight = plan.soften / (distance.abs() + plan.soften)
        error, slope = error * weight, slope * weight
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    tape.parameter_gradients(weights, points, slope[None], *_split(gradients))
    for gradient, scale in zip(gradients, _SCALES[plan.activation], strict=True):
        gradient.mul_(scale)
    return float(error.abs().mean())


def _errors(parameters: list[torch.Tensor], plan: Plan, check: _Pool) -> tuple[float, float]:
    """Mean absolute error near the surface (first half of the pool) and in the box (second half)."""
    value, _ = value_and_gradient(*_layers(parameters, plan.activation), plan.activation, check.points[None])
    error = torch.where(check.signed, value[0] - check.distance, value[0].abs() - check.distance.abs()).abs()
    half = len(error) // 2
    return float(error[:half].mean()), float(error[half:].mean())
