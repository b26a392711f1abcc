"""The task of training the *impulse* network: batches of contact frames, and a loss on velocities."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sdfsim.data.dataset import ranges_of
from sdfsim.learned.contact_graph import OF_BODIES, OF_EDGES, ContactGraph, number_pairs
from sdfsim.learned.impulse import ImpulseNetwork, Velocities
from sdfsim.physics.options import LENGTH
from sdfsim.training.contact_frames import ENDS, STEP, ContactFrames

HUBER = 0.01  # m/s: smaller errors count squared, larger ones linearly; bodies at rest may creep more slowly than this
CALM_SHARE = 0.2  # how often frames without a hit are drawn, relative to those with the hardest hits


@dataclass(frozen=True)
class ContactBatch:
    """A graph, the recorded result, and the bodies that count."""

    graph: ContactGraph  # the input
    truth: Velocities  # recorded velocities
    size: Tensor  # [N] m, turns an angular error into a speed
    counts: Tensor  # [N] bool, dynamic bodies with a contact edge


class ImpulseTask:
    """Draws batches from contact frames, those with hard hits more often; on the CPU."""

    def __init__(self, frames: ContactFrames) -> None:
        self.frames = frames
        self.weight = _importance(frames)
        self.counts = frames.trajectories.tolist()  # trajectories of each set of frames
        self.dt, self.length = STEP, LENGTH  # the smallest body of a scene gets this size, as with the solve
        self.gravity = float(np.linalg.norm(frames.gravity))

    def digest(self) -> str:
        return self.frames.digest()

    def ranges(self) -> dict[str, list[float]]:
        """The ranges of the frames; see `ranges_of`."""
        f = self.frames
        moving = f.mass > 0
        heaviest = np.maximum.reduceat(f.mass, f.body_start[:-1])
        lightest = np.minimum.reduceat(np.where(moving, f.mass, np.inf), f.body_start[:-1])
        speed = np.linalg.norm(f.bodies["velocity"][moving], axis=-1)
        ratios = (heaviest / lightest)[heaviest > 0]
        return ranges_of(f.size[moving], speed, ratios, f.friction, f.restitution, f.floor)

    def draw(self, rng: np.random.Generator, count: int) -> ContactBatch:
        """A batch of `count` frames."""
        picked = np.sort(rng.choice(len(self.frames), size=count, p=self.weight))
        return self.batch(picked)

    def batch(self, picked: np.ndarray) -> ContactBatch:
        """The frames `picked` [K] as one graph whose last body is the floor."""
        f = self.frames
        rows, body_of = _ranges(f.body_start, picked)
        edges, edge_of = _ranges(f.edge_start, picked)
        base = np.concatenate([[0], np.cumsum(np.bincount(body_of, minlength=len(picked)))])[edge_of]
        ends = [f.edges[name][edges] for name in ENDS]
        ends = torch.from_numpy(np.stack([np.where(end < 0, len(rows), end + base) for end in ends]).astype(np.int64))

        def body(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.concatenate([array[rows], np.zeros_like(array[:1])]))

        pair, pairs = number_pairs(ends[0], ends[1], len(rows) + 1)
        graph = ContactGraph(
            **{name: body(f.bodies[name]) for name in OF_BODIES},
            **{name: torch.from_numpy(f.edges[name][edges]) for name in OF_EDGES},
            **dict(zip(ENDS, ends, strict=True)),
            pair=pair,
            pairs=pairs,
            dt=STEP,
        )
        counts = torch.zeros(len(rows) + 1, dtype=torch.bool)
        counts[ends.flatten()] = True
        truth = Velocities(**{name: body(array) for name, array in f.truth.items()})
        return ContactBatch(graph, truth, body(f.size), counts & (graph.inverse_mass > 0))

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


def _size(error: Tensor) -> Tensor:
    """[N] pseudo-Huber size of errors [N, 3] m/s."""
    return (error.square().sum(-1) + HUBER**2).sqrt() - HUBER


def _ranges(start: np.ndarray, picked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows start[k] : start[k + 1] of every picked k, and for each row the index of its k in `picked`."""
    count = start[picked + 1] - start[picked]
    which = np.repeat(np.arange(len(picked)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    return start[picked][which] + np.arange(len(which)) - first, which


def _importance(f: ContactFrames) -> np.ndarray:
    """[F] sampling weights: up to 1 / CALM_SHARE times more for frames whose bodies leave free flight by 1 m/s."""
    hit = np.linalg.norm(f.truth["velocity"] - f.bodies["free_velocity"], axis=-1)
    hit += 0.5 * f.size * np.linalg.norm(f.truth["angular"] - f.bodies["free_angular"], axis=-1)
    hardest = np.maximum.reduceat(np.where(f.mass > 0, hit, 0.0), f.body_start[:-1])
    weight = CALM_SHARE + (1.0 - CALM_SHARE) * np.clip(hardest, 0.0, 1.0)
    return weight / weight.sum()
