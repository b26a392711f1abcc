"""What training the *impulse* network means: batches of contact frames, and a loss on velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sdfsim.data.dataset import ranges_of
from sdfsim.learned import pose
from sdfsim.learned.contact_graph import ContactGraph, number_pairs
from sdfsim.learned.impulse import ImpulseNetwork, Velocities
from sdfsim.training.contact_cache import ContactFrames
from sdfsim.training.distributed import ALONE, Team

HUBER = 0.01  # m/s: below it errors count squared, above it by their size; what rests may creep by less than that
CALM_SHARE = 0.2  # how often frames in which nothing is hit are drawn, against those with the hardest hits


@dataclass(frozen=True)
class ContactBatch:
    """A graph, what happened, and which bodies count."""

    graph: ContactGraph  # the input
    truth: Velocities  # recorded velocities
    size: Tensor  # [N] m, turns an angular error into a speed
    counts: Tensor  # [N] bool, bodies that move and have a contact edge


class ImpulseTask:
    """Draws batches from contact frames, hard ones more often; on the CPU."""

    def __init__(self, frames: ContactFrames) -> None:
        self.frames = frames
        self.weight = _importance(frames)
        self.counts = frames.trajectories.tolist()  # trajectories of each set of frames
        self.dt = frames.dt
        self.gravity = float(np.linalg.norm(frames.gravity))

    def digest(self) -> str:
        """Changes with the data."""
        return self.frames.digest()

    def ranges(self) -> dict[str, list[float]]:
        """What the frames hold; see `ranges_of`."""
        f = self.frames
        moving = f.mass > 0
        heaviest = np.maximum.reduceat(f.mass, f.body_start[:-1])
        lightest = np.minimum.reduceat(np.where(moving, f.mass, np.inf), f.body_start[:-1])
        speed = np.linalg.norm(f.velocity[moving], axis=-1)
        ratios = (heaviest / lightest)[heaviest > 0]
        return ranges_of(f.size[moving], speed, ratios, f.friction, f.restitution, f.floor)

    def draw(self, rng: np.random.Generator, count: int, team: Team = ALONE) -> ContactBatch:
        """A batch of `count` frames, or the part of it that falls to one of a team."""
        picked = np.sort(rng.choice(len(self.frames), size=count, p=self.weight))
        return self.batch(picked[team.share(count)])

    def batch(self, picked: np.ndarray) -> ContactBatch:
        """The frames `picked` [K] as one graph whose last body is the floor."""
        f = self.frames
        rows, body_of = _ranges(f.body_start, picked)
        edges, edge_of = _ranges(f.edge_start, picked)
        base = np.concatenate([[0], np.cumsum(np.bincount(body_of, minlength=len(picked)))])
        floor = len(rows)
        first = f.first[edges] + base[edge_of]
        second = np.where(f.second[edges] < 0, floor, f.second[edges] + base[edge_of])

        def body(array: np.ndarray, fill: float | list[float] = 0.0) -> Tensor:
            last = np.broadcast_to(np.asarray(fill, dtype=np.float32), array.shape[1:])[None]
            return torch.from_numpy(np.concatenate([array[rows], last]))

        mass, velocity, angular = body(f.mass), body(f.velocity), body(f.angular)
        moves = mass > 0
        rotation = pose.to_matrix(body(f.orientation, [0.0, 0.0, 0.0, 1.0]))
        inverse_inertia = rotation * (1.0 / body(f.inertia, 1.0))[:, None] @ rotation.mT * moves[:, None, None]
        fall = torch.as_tensor(f.gravity * f.dt, dtype=torch.float32) * moves[:, None]
        index = torch.from_numpy(np.stack([first, second]).astype(np.int64))

        def edge(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array[edges])

        def product(own: np.ndarray, column: int) -> Tensor:
            """[E] of the coefficients of both bodies; every frame has a floor of its own."""
            one, other = body(own)[index]
            floors = torch.from_numpy(f.floor[picked][edge_of, column])
            return one * torch.where(index[1] == floor, floors, other)

        pair, pairs = number_pairs(index[0], index[1], len(mass))
        graph = ContactGraph(
            inverse_mass=torch.where(moves, 1.0 / mass.clamp_min(1e-9), torch.zeros_like(mass)),
            inverse_inertia=inverse_inertia,
            velocity=velocity,
            angular=angular,
            free_velocity=velocity + fall,
            free_angular=body(f.free_angular),
            solved_velocity=body(f.solved_velocity),
            solved_angular=body(f.solved_angular),
            mean_velocity=body(f.solved_moved),
            mean_angular=body(f.solved_turned),
            first=index[0],
            second=index[1],
            pair=pair,
            pairs=pairs,
            normal=edge(f.normal),
            arm_first=edge(f.arm_first),
            arm_second=edge(f.arm_second),
            impulse=edge(f.impulse),
            gap=edge(f.gap),
            when=edge(f.when),
            friction=product(f.friction, 0),
            restitution=product(f.restitution, 1),
            dt=f.dt,
        )
        truth = Velocities(body(f.end_velocity), body(f.end_angular), body(f.moved), body(f.turned))
        counts = torch.zeros_like(moves)
        counts[index.flatten()] = True
        return ContactBatch(graph, truth, body(f.size, 1.0), counts & moves)

    def loss(self, network: ImpulseNetwork, batch: ContactBatch, *, mirrored: bool = False) -> Tensor:
        """Mean pseudo-Huber error of end and mean velocities, angular ones times half the body's size."""
        predicted = network(batch.graph, mirrored=mirrored)
        lever = 0.5 * batch.size[:, None]
        terms = [
            _size(predicted.velocity - batch.truth.velocity),
            _size(predicted.mean_velocity - batch.truth.mean_velocity),
            _size((predicted.angular - batch.truth.angular) * lever),
            _size((predicted.mean_angular - batch.truth.mean_angular) * lever),
        ]
        return torch.stack(terms).mean(0)[batch.counts].sum() / max(1, int(batch.counts.sum()))

    def weight_of(self, batch: ContactBatch) -> int:
        """Over how many bodies a batch's loss is the mean."""
        return int(batch.counts.sum())


def _size(error: Tensor) -> Tensor:
    """[N] pseudo-Huber size of errors [N, 3] m/s."""
    return (error.square().sum(-1) + HUBER**2).sqrt() - HUBER


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
