"""What training the *impulse* network means: batches of contact frames, and a loss on velocities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sdfsim.data.dataset import FLOOR, product_range
from sdfsim.dynamics import pose
from sdfsim.dynamics.graph import ContactGraph, number_pairs
from sdfsim.dynamics.impulse import ImpulseNetwork, Velocities
from sdfsim.training.contact_cache import ContactFrames
from sdfsim.training.distributed import ALONE, Team

HUBER = 0.01  # m/s: below it errors count squared, above it by their size; what rests may creep by less than that
CALM_SHARE = 0.2  # how often frames in which nothing is hit are drawn, against those with the hardest hits


@dataclass(frozen=True)
class Noise:
    """Disturbance of the inputs: standard deviations of a rigid displacement and of the velocities.

    Every frame is disturbed by a part of it, log-uniform from `least` to all. Small ones keep hits sharp, large ones
    teach what holds a loaded stack up and pushes bodies out of one another.

    Attributes:
        shift: m, of a body's position, and of its surface by turning.
        speed: m/s, of its velocity, and of its surface by spinning.
        least: the smallest part.
    """

    shift: float = 0.003
    speed: float = 0.03
    least: float = 0.05


@dataclass(frozen=True)
class Disturbance:
    """Draws of the noise for B bodies, [B, 3] each: displacements in m, those by turning at the bodies' surfaces, then
    velocities in m/s likewise."""

    shift: Tensor
    turn: Tensor
    push: Tensor
    spin: Tensor


@dataclass(frozen=True)
class Batch:
    """A graph, what happened, and which bodies count.

    Attributes:
        graph: the input.
        truth: recorded velocities.
        size: [N] m, turns an angular error into a speed.
        counts: [N] bool, bodies that move and have a contact edge.
    """

    graph: ContactGraph
    truth: Velocities
    size: Tensor
    counts: Tensor


class ImpulseTask:
    """Draws batches from contact frames, hard ones more often.

    Args:
        frames: of one split.
        device: where batches are made.
        noise: of training inputs; None for exact inputs.
    """

    def __init__(self, frames: ContactFrames, device: torch.device, noise: Noise | None) -> None:
        self.frames = frames
        self.device = device
        self.noise = noise
        self.weight = _importance(frames)

    def digest(self) -> str:
        """Changes with the data."""
        return self.frames.digest()

    @property
    def counts(self) -> list[int]:
        """Trajectories of each dataset."""
        return self.frames.trajectories.tolist()

    @property
    def dt(self) -> float:
        """s, the recorded step."""
        return self.frames.dt

    @property
    def gravity(self) -> float:
        """m/s^2, magnitude."""
        return float(np.linalg.norm(self.frames.gravity))

    def ranges(self) -> dict[str, list[float]]:
        """[low, high] of what the frames hold: coefficients as products of two bodies, SI units."""
        f = self.frames
        moving = f.mass > 0
        speed = np.linalg.norm(f.velocity[moving], axis=-1)
        return {
            "size": _span(f.size[moving]),
            "speed": [0.0, float(np.percentile(speed, 99.9))],
            "mass_ratio": [1.0, _mass_ratio(f)],
            "friction": product_range(f.friction, FLOOR[0]),
            "restitution": product_range(f.restitution, FLOOR[1]),
        }

    def draw(self, rng: np.random.Generator, count: int, team: Team = ALONE) -> Batch:
        """A batch of `count` frames, or the part of it that falls to one of a team."""
        picked = np.sort(rng.choice(len(self.frames), size=count, p=self.weight))
        return self.batch(picked[team.share(count)], self.noise_for(picked, rng, team))

    def batch(self, picked: np.ndarray, noise: Disturbance | None = None) -> Batch:
        """The frames `picked` [K] as one graph whose last body is the floor; disturbed when `noise` is given."""
        f = self.frames
        rows, body_of = _ranges(f.body_start, picked)
        edges, edge_of = _ranges(f.edge_start, picked)
        base = np.concatenate([[0], np.cumsum(np.bincount(body_of, minlength=len(picked)))])
        floor = len(rows)
        first = f.first[edges] + base[edge_of]
        second = np.where(f.second[edges] < 0, floor, f.second[edges] + base[edge_of])

        def body(array: np.ndarray, fill: float | list[float] = 0.0) -> Tensor:
            last = np.broadcast_to(np.asarray(fill, dtype=np.float32), array.shape[1:])[None]
            return torch.from_numpy(np.concatenate([array[rows], last])).to(self.device)

        mass, velocity, angular = body(f.mass), body(f.velocity), body(f.angular)
        moves = mass > 0
        rotation = pose.to_matrix(body(f.orientation, [0.0, 0.0, 0.0, 1.0]))
        inverse_inertia = rotation * (1.0 / body(f.inertia, 1.0))[:, None] @ rotation.mT * moves[:, None, None]
        fall = torch.as_tensor(f.gravity * f.dt, dtype=torch.float32, device=self.device) * moves[:, None]
        index = torch.from_numpy(np.stack([first, second]).astype(np.int64)).to(self.device)
        arm, other, normal = (torch.from_numpy(a[edges]).to(self.device) for a in (f.arm, f.other, f.normal))
        gap = torch.from_numpy(f.gap[edges]).to(self.device)
        pair, pairs = number_pairs(index[0], index[1], len(mass))
        coefficients = {
            "friction": _product(body(f.friction, FLOOR[0]), index),
            "restitution": _product(body(f.restitution, FLOOR[1]), index),
        }
        graph = ContactGraph(
            inverse_mass=torch.where(moves, 1.0 / mass.clamp_min(1e-9), torch.zeros_like(mass)),
            inverse_inertia=inverse_inertia,
            velocity=velocity,
            angular=angular,
            free_velocity=velocity + fall,
            free_angular=body(f.free_angular),
            mean_velocity=velocity + 0.5 * fall,
            mean_angular=body(f.mean_angular),
            first=index[0],
            second=index[1],
            pair=pair,
            pairs=pairs,
            normal=normal,
            arm_first=arm,
            arm_second=arm + other,
            gap=gap,
            substeps=torch.from_numpy(f.substeps[picked][edge_of].astype(np.float32)).to(self.device),
            dt=f.dt,
            **coefficients,
        )
        truth = Velocities(body(f.end_velocity), body(f.end_angular), body(f.moved), body(f.turned))
        counts = torch.zeros_like(moves)
        counts[index.flatten()] = True
        batch = Batch(graph, truth, body(f.size, 1.0), counts & moves)
        return batch if noise is None else disturbed(batch, noise)

    def loss(self, network: ImpulseNetwork, batch: Batch, *, mirrored: bool = False) -> Tensor:
        """Mean pseudo-Huber error of end and mean velocities, angular ones times half the body's size."""
        return self.error(network(batch.graph, mirrored=mirrored), batch)

    def error(self, predicted: Velocities, batch: Batch) -> Tensor:
        """The same of what a network has said."""
        lever = 0.5 * batch.size[:, None]
        terms = [
            self.size_of(predicted.velocity - batch.truth.velocity),
            self.size_of(predicted.mean_velocity - batch.truth.mean_velocity),
            self.size_of((predicted.angular - batch.truth.angular) * lever),
            self.size_of((predicted.mean_angular - batch.truth.mean_angular) * lever),
        ]
        return torch.stack(terms).mean(0)[batch.counts].sum() / max(1, int(batch.counts.sum()))

    @staticmethod
    def size_of(error: Tensor) -> Tensor:
        """[N] pseudo-Huber size of errors [N, 3] m/s."""
        return (error.square().sum(-1) + HUBER**2).sqrt() - HUBER

    def weight_of(self, batch: Batch) -> int:
        """Over how many bodies a batch's loss is the mean."""
        return int(batch.counts.sum())

    def noise_for(self, picked: np.ndarray, rng: np.random.Generator, team: Team) -> Disturbance | None:
        """Noise of the whole batch, so that it does not depend on the team's size; then this one's part of it."""
        if self.noise is None:
            return None
        counts = np.diff(self.frames.body_start)[picked]
        mine = np.zeros(len(picked), dtype=bool)
        mine[team.share(len(picked))] = True
        rows = np.repeat(mine, counts)
        part = np.repeat(self.noise.least ** rng.random(len(picked), dtype=np.float32), counts)[rows, None]

        def normal(scale: float) -> Tensor:
            draw = rng.standard_normal((len(rows), 3), dtype=np.float32)[rows] * part * np.float32(scale)
            return torch.from_numpy(np.concatenate([draw, np.zeros((1, 3), dtype=np.float32)])).to(self.device)

        shift, speed = self.noise.shift, self.noise.speed
        return Disturbance(normal(shift), normal(shift), normal(speed), normal(speed))


def disturbed(batch: Batch, noise: Disturbance) -> Batch:
    """Shift, turn and push bodies a little; mean velocities still lead to the recorded pose."""
    g = batch.graph
    moves, lever = (g.inverse_mass > 0)[:, None], 2.0 / batch.size[:, None]
    shift, push = noise.shift * moves, noise.push * moves
    turn, spin = noise.turn * moves * lever, noise.spin * moves * lever
    one = shift[g.first] + torch.linalg.cross(turn[g.first], g.arm_first)
    two = shift[g.second] + torch.linalg.cross(turn[g.second], g.arm_second)
    graph = replace(
        g,
        gap=g.gap + ((one - two) * g.normal).sum(-1),
        velocity=g.velocity + push,
        free_velocity=g.free_velocity + push,
        mean_velocity=g.mean_velocity + push,
        angular=g.angular + spin,
        free_angular=g.free_angular + spin,
        mean_angular=g.mean_angular + spin,
    )
    truth = replace(
        batch.truth,
        mean_velocity=batch.truth.mean_velocity - shift / g.dt,
        mean_angular=batch.truth.mean_angular - turn / g.dt,
    )
    return replace(batch, graph=graph, truth=truth)


def _span(values: np.ndarray) -> list[float]:
    return [float(values.min()), float(values.max())]


def _mass_ratio(f: ContactFrames) -> float:
    """The largest ratio of two masses that move in one frame."""
    heaviest = np.maximum.reduceat(f.mass, f.body_start[:-1])
    lightest = np.minimum.reduceat(np.where(f.mass > 0, f.mass, np.inf), f.body_start[:-1])
    return float((heaviest / lightest)[heaviest > 0].max())


def _product(coefficient: Tensor, index: Tensor) -> Tensor:
    return coefficient[index[0]] * coefficient[index[1]]


def _ranges(start: np.ndarray, picked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows start[k] : start[k + 1] of every picked k, and which of the picked each row belongs to."""
    count = start[picked + 1] - start[picked]
    which = np.repeat(np.arange(len(picked)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    return start[picked][which] + np.arange(len(which)) - first, which


def _importance(f: ContactFrames) -> np.ndarray:
    """[F] sampling weights: up to 1 / CALM_SHARE times more for frames whose bodies leave free flight by 1 m/s."""
    fall = (f.gravity * f.dt).astype(np.float32)
    hit = np.linalg.norm(f.end_velocity - f.velocity - fall, axis=-1)
    hit += 0.5 * f.size * np.linalg.norm(f.end_angular - f.free_angular, axis=-1)
    hardest = np.maximum.reduceat(np.where(f.mass > 0, hit, 0.0), f.body_start[:-1])
    weight = CALM_SHARE + (1.0 - CALM_SHARE) * np.clip(hardest, 0.0, 1.0)
    return weight / weight.sum()
