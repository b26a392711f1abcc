"""The training loop behind `fit`: many small networks side by side, each with its own schedule and early stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch

from sdfsim.parallel import choose_threads
from sdfsim.shape.checkpoint import Checkpoint
from sdfsim.shape.distance import DistanceOracle
from sdfsim.shape.fit import CHECKED, Plan, Subject, stack
from sdfsim.shape.mlp_sdf import Activation, MlpSdf, Tape, value_and_gradient
from sdfsim.shape.soap import Adam, Soap

WARMUP = 50
CHECK = 100
# Seconds that the certificate takes of a budget, beside a tenth.
RESERVE = 2.0
SIGN_FROM = 0.002  # nearer to the surface a wrong sign is no more than an error of the distance
CPU = torch.device("cpu")

# Weights and biases per layer, [S, out, in] and [S, out].
Layers = tuple[list[torch.Tensor], list[torch.Tensor]]


def train(
    oracles: Sequence[DistanceOracle],
    plan: Plan,
    *,
    budget: float | None,
    seed: int,
    tell: Callable[[float, str], None],
    checkpoint: Path | None = None,
    device: torch.device = CPU,
) -> list[tuple[MlpSdf, int]]:
    """Run a plan for several solids in one batched optimiser; each comes out as it would alone, up to rounding.

    Args:
        oracles: true distances to each solid, metres.
        plan: the recipe.
        budget: seconds for all at most; the decay begins early enough to end within them.
        seed: of points and weights.
        tell: called with (fraction done, message).
        checkpoint: of a single solid; resumed from when it belongs to this very fit. The caller removes it once what
            came of the fit is safe.
        device: to train on.

    Returns:
        per solid its network, on the CPU, and the number of updates made.
    """
    started = time.monotonic()
    run = _Run(oracles, plan, seed, tell, device)
    if checkpoint is not None and len(oracles) > 1:
        raise ValueError("a checkpoint belongs to a single solid")
    saved = Checkpoint(checkpoint, f"{asdict(plan)}|{seed}", oracles[0].surface) if checkpoint is not None else None
    if saved is not None:
        run.restore(saved)
    if device.type == "cpu":
        choose_threads(partial(run.differentiate, torch.arange(plan.batch) % plan.pool))
    before, looping = run.step, time.monotonic()

    while run.step < run.stop.max():
        run.update()
        if run.step % CHECK:
            continue
        run.repair()
        near, far = run.judge()
        if budget is not None:
            pace = (time.monotonic() - looping) / (run.step - before)
            run.hurry(run.step + int((training_share(budget) - (time.monotonic() - started)) / pace))
        run.retire()
        last = max(int(run.stop.max()), 1)
        errors = f"error {near:.2g} near, {far:.2g} in the box"
        tell(0.97 * run.step / last, f"step {run.step} of {last}, {errors}")
        if saved is not None and run.step % (2 * CHECK) == 0:
            run.save(saved)
    return run.results()


def training_share(budget: float) -> float:
    """Seconds of a budget that the training may take; the rest is the certificate's."""
    return budget - min(0.1 * budget + RESERVE, 0.5 * budget)


class _Run:
    """S networks in training; those that are done leave the stack.

    Attributes:
        step: updates made.
        turn: [S] the update at which each one's decay begins; an early stop or a short budget moves it forward.
        stop: [S] the update at which each one ends.
    """

    def __init__(
        self,
        oracles: Sequence[DistanceOracle],
        plan: Plan,
        seed: int,
        tell: Callable[[float, str], None],
        device: torch.device,
    ) -> None:
        self.plan, self.device = plan, device
        self.subjects, pools, checks = [], [], []
        for done, oracle in enumerate(oracles):
            tell(0.0, "sampling distances" + (f" of {done + 1} of {len(oracles)}" if len(oracles) > 1 else ""))
            subject = Subject(oracle, plan, seed)
            self.subjects.append(subject)
            pools.append(subject.pool())
            checks.append(subject.check())
        self.pool, self.check = stack(pools).to(device), stack(checks).to(device)
        # Drawn on the CPU, so that points and first weights do not depend on the device.
        self.generator = torch.Generator().manual_seed(seed)
        self._take([p.to(device) for p in _initial(plan, len(oracles), self.generator)])
        self.average = [parameter.clone() for parameter in self.parameters]
        self.optimiser = (Soap if plan.optimiser == "soap" else Adam)(self.parameters, plan.lr)
        self.step = 0
        self.turn = np.full(len(oracles), int(plan.steps * (1.0 - plan.decay)))
        self.stop = np.full(len(oracles), plan.steps)
        self.rate = np.ones(len(oracles))  # of the step size, lower after a fresh start
        self.places = np.arange(len(oracles))  # in the results
        self.done: dict[int, tuple[MlpSdf, int]] = {}
        self._tape = Tape(plan.activation, plan.width, plan.layers, self.parameters[0])

    def _take(self, parameters: list[torch.Tensor]) -> None:
        self.parameters = parameters
        for parameter in parameters:
            parameter.grad = torch.zeros_like(parameter)

    def update(self) -> None:
        """One step of the optimiser for all that are not done."""
        plan = self.plan
        if plan.resample and self.step and self.step % plan.resample == 0:
            self.pool = stack([subject.pool(self.step) for subject in self.subjects]).to(self.device)
        self.differentiate(torch.randint(plan.pool, (plan.batch,), generator=self.generator))
        factor = min(1.0, (self.step + 1) / WARMUP) * self.rate
        if plan.decay:
            late = np.clip((self.step - self.turn) / np.maximum(self.stop - self.turn, 1), 0.0, 1.0)
            factor = factor * 0.5 * (1.0 + np.cos(math.pi * late))
        factor = np.where(self.step < self.stop, factor, 0.0)
        self.optimiser.step(torch.from_numpy(factor).to(self.parameters[0]))
        self.step += 1
        for mean, parameter in zip(self.average, self.parameters, strict=True):
            mean.lerp_(parameter, 0.02)

    def differentiate(self, chosen: torch.Tensor) -> None:
        """Weighted L1 of the signed distance, and of the unsigned one where the sign is not known; fills the gradients.

        Args:
            chosen: [T] points of each pool.
        """
        chosen = chosen.to(self.device)
        points, distance, signed = (
            self.pool.points[:, chosen],
            self.pool.distance[:, chosen],
            self.pool.signed[:, chosen],
        )
        weights, biases = _layers(self.parameters, self.plan.activation)
        value = self._tape.forward(weights, biases, points)
        error = torch.where(signed, value - distance, value.abs() - distance.abs())
        slope = error.sign() * torch.where(signed, 1.0, value.sign()) / len(chosen)
        if self.plan.soften is not None:
            slope = slope * (self.plan.soften / (distance.abs() + self.plan.soften))
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        self._tape.parameter_gradients(weights, points, slope, *_split(gradients))
        for gradient, scale in zip(gradients, _SCALES[self.plan.activation], strict=True):
            gradient.mul_(scale)

    def repair(self) -> None:
        """A fresh start, from new weights and with a quarter of the step size, for what is not finite."""
        finite = torch.stack([p.isfinite().all(-1).all(-1).all(0) for p in self.parameters]).all(0)
        if bool(finite.all()):
            return
        broken = ~finite
        fresh = _initial(self.plan, len(finite), torch.Generator().manual_seed(1))
        for mean, parameter, start in zip(self.average, self.parameters, fresh, strict=True):
            parameter[:, broken] = start.to(self.device)[:, broken]
            mean[:, broken] = parameter[:, broken]
        self.optimiser.forget(broken)
        self.rate[broken.cpu().numpy()] /= 4

    def judge(self) -> tuple[float, float]:
        """Begin the decay of those that meet the goal. Returns mean errors near the surface and in the box, of all."""
        layers = _layers(self.average, self.plan.activation)
        value, gradient = value_and_gradient(*layers, self.plan.activation, self.check.points)
        distance, signed = self.check.distance, self.check.signed
        error = torch.where(signed, value - distance, value.abs() - distance.abs()).abs()
        near, far = error[:, :CHECKED].mean(1), error[:, 2 * CHECKED :].mean(1)
        if self.plan.goal is not None:
            cosine = torch.nn.functional.cosine_similarity(gradient, self.check.direction, dim=-1)
            turned = 1.0 - cosine[:, CHECKED : 2 * CHECKED].median(1).values
            clear = signed & (distance.abs() > SIGN_FROM)
            wrong = (clear & (value * distance <= 0)).sum(1) / clear.sum(1).clamp_min(1)
            errors = torch.stack([near, far, turned, wrong], -1)
            met = (errors <= errors.new_tensor(self.plan.goal)).all(-1)
            early = met.cpu().numpy() & (self.step < self.turn)
            self.turn = np.where(early, self.step, self.turn)
            self.stop = np.where(early, np.minimum(self.stop, self.step + self.plan.settle), self.stop)
        return float(near.mean()), float(far.mean())

    def hurry(self, possible: int) -> None:
        """Place decay and end so that `possible` updates in all suffice.

        Until the decay has begun the end moves both ways, since the first steps of a busy machine tell little; after
        that it only comes nearer.
        """
        possible = max(possible, self.step)
        begun = self.step >= self.turn
        self.stop = np.minimum(np.where(begun, self.stop, self.plan.steps), possible)
        open_ended = np.maximum(self.step, (self.stop * (1.0 - self.plan.decay)).astype(int))
        self.turn = np.where(begun, self.turn, open_ended)

    def retire(self) -> None:
        """Put aside the networks that are done, once they are half of the stack."""
        going = self.step < self.stop
        if 2 * going.sum() > len(going) or not going.any():
            return
        self._finish(~going)
        kept = torch.from_numpy(np.flatnonzero(going)).to(self.device)
        self._take([parameter[:, kept] for parameter in self.parameters])
        self.average = [mean[:, kept] for mean in self.average]
        self.optimiser.keep(kept, self.parameters)
        self.pool, self.check = self.pool.rows(kept), self.check.rows(kept)
        self.subjects = [subject for subject, stays in zip(self.subjects, going, strict=True) if stays]
        self.turn, self.stop, self.rate = self.turn[going], self.stop[going], self.rate[going]
        self.places = self.places[going]

    def _finish(self, chosen: np.ndarray) -> None:
        weights, biases = _layers(self.parameters, self.plan.activation)
        for row in np.flatnonzero(chosen):
            subject = self.subjects[row]
            sdf = MlpSdf(
                tuple(weight[row].cpu().clone() for weight in weights),
                tuple(bias[row].cpu().clone() for bias in biases),
                self.plan.activation,
                subject.frame,
                subject.oracle.bounds.copy(),
                subject.mirrors,
            )
            self.done[int(self.places[row])] = sdf, int(min(self.step, self.stop[row]))

    def results(self) -> list[tuple[MlpSdf, int]]:
        """Every network and its updates, in the order of the solids."""
        self._finish(np.ones(len(self.subjects), dtype=bool))
        return [self.done[place] for place in sorted(self.done)]

    def save(self, saved: Checkpoint) -> None:
        """Write the state of a single network's training."""
        progress = (self.step, int(self.turn[0]), int(self.stop[0]), float(self.rate[0]))
        saved.save(self.parameters, self.average, self.optimiser, self.generator, progress)

    def restore(self, saved: Checkpoint) -> None:
        """Go on from what `save` wrote, if it is there."""
        progress = saved.load(self.parameters, self.average, self.optimiser, self.generator)
        if progress is not None:
            self.step = int(progress[0])
            self.turn, self.stop = np.array([int(progress[1])]), np.array([int(progress[2])])
            self.rate = np.array([progress[3]])


def _initial(plan: Plan, count: int, generator: torch.Generator) -> list[torch.Tensor]:
    """First [1, S, W, 3], hidden [L - 2, S, W, W] and last [1, S, 1, W] weights; biases [L - 1, S, W, 1], [1, S, 1, 1].

    All `count` networks start alike. Equal layers are stacked for the optimiser. Periodic layers start with phases all
    around and the spread of inputs that sine layers have (Sitzmann et al. 2020); ReLU layers with He's variance.
    """
    width, hidden = plan.width, plan.layers - 2

    def uniform(bound: float, layers: int, *shape: int) -> torch.Tensor:
        one = (2.0 * torch.rand((layers, 1, *shape), generator=generator) - 1.0) * bound
        return one.repeat(1, count, 1, 1)

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


def _layers(parameters: list[torch.Tensor], activation: Activation) -> Layers:
    """What the networks compute with."""
    return _split([parameter * scale for parameter, scale in zip(parameters, _SCALES[activation], strict=True)])


def _split(parts: list[torch.Tensor]) -> Layers:
    first, hidden, last, biases, end = parts
    return [first[0], *hidden.unbind(), last[0]], [*biases[..., 0].unbind(), end[0, ..., 0]]
