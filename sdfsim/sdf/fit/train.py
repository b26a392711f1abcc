"""From exact distances to an SDF network: recipes, training points and the training loop."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.base.parallel import Progress, choose_threads
from sdfsim.geometry.mesh import normal_frame, sample_surface
from sdfsim.sdf.far_field import BOX
from sdfsim.sdf.fit import Recipe
from sdfsim.sdf.fit.certificate import SIGN_FROM, certify
from sdfsim.sdf.fit.soap import Soap
from sdfsim.sdf.mlp import MlpSdf, Tape, value_and_gradient
from sdfsim.sdf.reference import DistanceOracle
from sdfsim.sdf.sdf import Sdf

# Weights and biases per layer, [out, in] and [out].
Layers = tuple[list[torch.Tensor], list[torch.Tensor]]

# Points are also drawn slightly outside the box that is used: at the edge of its data a network's slope is poor.
MARGIN = 1.15
# A solid is fitted on one side only if its distances agree with their mirror images to this, relative to its size.
SAME = 1e-4
# During training a fit is checked on this many points of each of three kinds: with these spreads around the surface,
# and in the box.
CHECKED = 4000
CHECKED_SIGMAS = (0.006, 0.06)
# Weights of the first periodic layer are uniform in +- this, which sets the finest scale that a fit starts with.
FIRST = 8.0
WARMUP = 50  # updates
CHECK_EVERY = 100  # updates
# Seconds of a budget that are kept for the certificate, besides a tenth.
RESERVE = 2.0


@dataclass(frozen=True)
class FitOptions:
    """A recipe for fits; the defaults were chosen by measurements on scanned and thin-walled shapes.

    Lengths are relative to the shape's largest extent. Part of the points are in the box, and the loss is soft up to
    some hundredths of the size; without both, the far field would be wrong by as much.
    """

    width: int = 64  # width of the hidden layers
    layers: int = 6  # linear layers, the last one included
    lr: float = 1e-2  # step size
    decay: float = 0.5  # part of the steps, at the end, over which the step size falls to zero
    steps: int = 5000  # updates
    batch: int = 4096  # points per update
    # distance of points from the surface (standard deviation, log-uniform between the two)
    sigmas: tuple[float, float] = (0.002, 0.15)
    near: float = 0.8  # fraction of points near the surface; the others are uniform in the box
    pool: int = 400_000  # points in a pool
    soften: float = 0.04  # errors have the weight soften / (|distance| + soften)
    # errors of the averaged weights at which the decay begins early (the decay halves them): of the distance (means
    # within 0.01 and in the box), of the gradient (median cosine distance within 0.1) and of the sign (fraction wrong
    # farther than 0.002). None: never stop early
    goal: tuple[float, float, float, float] | None = (7e-4, 6e-3, 4e-3, 1.3e-3)
    settle: int = 1000  # steps of an early decay


RECIPES = {
    "default": FitOptions(),
    # A surface from a few minutes of reconstruction is not exact enough to be worth a full fit.
    "quick": FitOptions(steps=1500, settle=600, pool=200_000),
}


def fit_sdf(
    oracle: DistanceOracle,
    recipe: Recipe,
    budget: float | None,
    seed: int,
    pick: Callable[[Sdf], np.ndarray],
    on_progress: Progress,
    device: torch.device | str,
) -> tuple[MlpSdf, np.ndarray, dict]:
    """Fit a network to the distances of a solid within `budget` s (None: no limit). Returns the network, the nodes [K,
    3] m that `pick` takes from it, and its certificate. Raises SdfsimError if the budget is not positive."""
    if budget is not None and not budget > 0:
        raise SdfsimError(f"the budget of a fit must be > 0 seconds (got {budget})")
    started, options = time.monotonic(), RECIPES[recipe]
    on_progress(0.0, "sampling distances")
    fit = _Fit(oracle, options, seed, torch.device(device))
    if fit.device.type == "cpu":
        choose_threads(partial(fit.differentiate, torch.arange(options.batch) % options.pool))
    looping = time.monotonic()
    while fit.step < fit.stop:
        fit.update()
        if fit.step % CHECK_EVERY:
            continue
        near, far = fit.judge()
        if budget is not None:
            left = budget - min(0.1 * budget + RESERVE, 0.5 * budget) - (time.monotonic() - started)
            fit.hurry(fit.step + int(left * fit.step / (time.monotonic() - looping)))
        last = max(fit.stop, 1)
        on_progress(0.97 * fit.step / last, f"step {fit.step} of {last}, error {near:.2g} near, {far:.2g} in the box")
    on_progress(0.98, "measuring")
    sdf = fit.result()
    nodes = pick(sdf)
    certificate = certify(sdf, oracle, nodes=nodes)
    seconds = round(time.monotonic() - started, 2)
    certificate.update(recipe=recipe, seed=seed, steps=min(fit.step, fit.stop), seconds=seconds)
    but = certificate["reason"] or certificate["caveat"]
    on_progress(1.0, f"fitted, but {but}" if but else "fitted")
    return sdf, nodes, certificate


class Pool(NamedTuple):
    """Normalised points."""

    points: torch.Tensor  # [P, 3]
    distance: torch.Tensor  # [P] signed
    signed: torch.Tensor  # [P] bool, whether the sign of the distance is known
    direction: torch.Tensor  # [P, 3] unit, from the surface outwards; zero on the surface itself


class _Fit:
    """A network in training, and samples of its solid. The decay of the step size begins at update `turn` and ends at
    `stop`; an early stop or a short budget moves both forward."""

    def __init__(self, oracle: DistanceOracle, options: FitOptions, seed: int, device: torch.device) -> None:
        self.oracle, self.options, self.device = oracle, options, device
        self.frame = normal_frame(oracle.bounds)
        self.mirrors = self._mirrors()
        self.pool = self._pool(np.random.default_rng([seed, 0]))
        # Points for checks during training: `CHECKED` of each of three kinds.
        sigma = np.repeat(CHECKED_SIGMAS, CHECKED)[:, None]
        self.check = self._sample(sigma, CHECKED, np.random.default_rng([seed, 1]))
        # Drawn on the CPU, so that points and first weights do not depend on the device.
        self.generator = torch.Generator().manual_seed(seed)
        self.parameters = [p.to(device) for p in _initial(options, self.generator)]
        for parameter in self.parameters:
            parameter.grad = torch.zeros_like(parameter)
        self.average = [parameter.clone() for parameter in self.parameters]
        self.optimiser = Soap(self.parameters, options.lr)
        self.step = 0
        self.turn, self.stop = int(options.steps * (1.0 - options.decay)), options.steps
        self._tape = Tape(options.width, options.layers, self.parameters[0])

    def _pool(self, rng: np.random.Generator) -> Pool:
        """Training points."""
        options = self.options
        near = int(options.pool * options.near)
        low, high = np.log(options.sigmas)
        sigma = np.exp(rng.uniform(low, high, (near, 1)))
        return self._sample(sigma, options.pool - near, rng)

    def _sample(self, sigma: np.ndarray, elsewhere: int, rng: np.random.Generator) -> Pool:
        """N points with normal noise of `sigma` [N, 1] around the surface, then `elsewhere` points all over the box."""
        local = self.frame.inward(sample_surface(self.oracle.surface, len(sigma), rng)[0])
        around = local + sigma * rng.standard_normal((len(sigma), 3))
        local = np.concatenate([around, rng.uniform(-MARGIN * BOX, MARGIN * BOX, (elsewhere, 3))])
        local = np.clip(local, -MARGIN * BOX, MARGIN * BOX)
        truth = self.oracle(self.frame.outward(local))
        distance = truth.distance / self.frame.scale
        signed = truth.trusted | self.oracle.closed
        # This close to the surface the direction from it is only rounding error.
        clear = np.abs(distance) > 1e-4
        offset = local - self.frame.inward(truth.closest)
        direction = np.where(clear[:, None], offset / np.where(clear, distance, 1.0)[:, None], 0.0)
        # Points on the other side of a mirror plane are replaced by their images.
        side = np.where(np.asarray(self.mirrors) & (local < 0), -1.0, 1.0)
        where, away, along = (torch.from_numpy(x).float() for x in (local * side, distance, direction * side))
        return Pool(*(part.to(self.device) for part in (where, away, torch.from_numpy(signed), along)))

    def _mirrors(self) -> tuple[bool, bool, bool]:
        """For each plane of the frame, whether the solid is its own mirror image, by sampled distances."""
        rng = np.random.default_rng(0)
        local = self.frame.inward(sample_surface(self.oracle.surface, 2000, rng)[0])
        local = np.concatenate([local, local + rng.normal(0.0, 0.05, local.shape)])
        truth = self.oracle(self.frame.outward(local)).distance

        def same(axis: int) -> bool:
            image = self.frame.outward(local * np.where(np.arange(3) == axis, -1.0, 1.0))
            return bool(np.abs(self.oracle(image).distance - truth).max() < SAME * self.frame.scale)

        return same(0), same(1), same(2)

    def update(self) -> None:
        """One step of the optimiser."""
        options = self.options
        self.differentiate(torch.randint(options.pool, (options.batch,), generator=self.generator))
        late = min(max((self.step - self.turn) / max(self.stop - self.turn, 1), 0.0), 1.0)
        self.optimiser.step(min(1.0, (self.step + 1) / WARMUP) * 0.5 * (1.0 + math.cos(math.pi * late)))
        self.step += 1
        for mean, parameter in zip(self.average, self.parameters, strict=True):
            mean.lerp_(parameter, 0.02)

    def differentiate(self, chosen: torch.Tensor) -> None:
        """Fill the gradients of the weighted L1 loss at the `chosen` [T] points of the pool: of the signed distance, or
        of the unsigned one if the sign is not known."""
        points, distance, signed, _ = (part[chosen.to(self.device)] for part in self.pool)
        weights, biases = _layers(self.parameters)
        value = self._tape.forward(weights, biases, points)
        error = torch.where(signed, value - distance, value.abs() - distance.abs())
        soften = self.options.soften
        slope = error.sign() * torch.where(signed, 1.0, value.sign()) / len(chosen)
        slope = slope * (soften / (distance.abs() + soften))
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        self._tape.parameter_gradients(weights, points, slope, *_split(gradients))
        for gradient, scale in zip(gradients, _SCALES, strict=True):
            gradient.mul_(scale)

    def judge(self) -> tuple[float, float]:
        """Begin the decay if the goal is met. Returns mean errors near the surface and in the box."""
        layers = _layers(self.average)
        value, gradient = value_and_gradient(*layers, self.check.points)
        distance, signed = self.check.distance, self.check.signed
        error = torch.where(signed, value - distance, value.abs() - distance.abs()).abs()
        near, far = float(error[:CHECKED].mean()), float(error[2 * CHECKED :].mean())
        if self.options.goal is not None and self.step < self.turn:
            cosine = torch.nn.functional.cosine_similarity(gradient, self.check.direction, dim=-1)
            turned = 1.0 - float(cosine[CHECKED : 2 * CHECKED].median())
            clear = signed & (distance.abs() > SIGN_FROM)
            wrong = float((clear & (value * distance <= 0)).sum() / clear.sum().clamp_min(1))
            if all(e <= most for e, most in zip((near, far, turned, wrong), self.options.goal, strict=True)):
                self.turn, self.stop = self.step, min(self.stop, self.step + self.options.settle)
        return near, far

    def hurry(self, possible: int) -> None:
        """Set the start of the decay and the end so that at most `possible` updates are made in all. Until the decay
        has begun the end may move both ways, since the first steps on a busy machine predict little; after that it only
        moves nearer."""
        begun = self.step >= self.turn
        self.stop = min(self.stop if begun else self.options.steps, max(possible, self.step))
        if not begun:
            self.turn = max(self.step, int(self.stop * (1.0 - self.options.decay)))

    def result(self) -> MlpSdf:
        """The network."""
        parts = _layers(self.parameters)
        weights, biases = (tuple(part.cpu().clone() for part in layers) for layers in parts)
        return MlpSdf(weights, biases, self.frame, self.oracle.bounds.copy(), self.mirrors)


def _initial(options: FitOptions, generator: torch.Generator) -> list[torch.Tensor]:
    """First [1, W, 3], hidden [L - 2, W, W] and last [1, 1, W] weights; biases [L - 1, W, 1] and [1, 1, 1]: equal
    layers are stacked for the optimiser. Periodic layers start with phases all around and the spread of inputs that
    sine layers have (Sitzmann et al. 2020)."""
    width, hidden = options.width, options.layers - 2

    def uniform(bound: float, layers: int, *shape: int) -> torch.Tensor:
        return (2.0 * torch.rand((layers, *shape), generator=generator) - 1.0) * bound

    return [
        uniform(FIRST, 1, width, 3),
        uniform(math.sqrt(6.0 / width), hidden, width, width),
        uniform(math.sqrt(6.0 / width) / 10.0, 1, 1, width),
        uniform(math.pi, options.layers - 1, width, 1),
        uniform(0.05, 1, 1, 1),
    ]


# A wave of period 1 with the parameters of a sine of period 2 pi: they are trained at the sine's scale, on which
# equal steps of the optimiser suit all layers, and multiplied by these before every use. Its height is 1/8.
_SCALES = (0.5 / math.pi, 4.0 / math.pi, 8.0, 0.5 / math.pi, 1.0)


def _layers(parameters: list[torch.Tensor]) -> Layers:
    """The layers as networks use them."""
    return _split([parameter * scale for parameter, scale in zip(parameters, _SCALES, strict=True)])


def _split(parts: list[torch.Tensor]) -> Layers:
    first, hidden, last, biases, end = parts
    return [first[0], *hidden.unbind(), last[0]], [*biases[..., 0].unbind(), end[0, ..., 0]]
