"""The task of training a network on surface nodes: recorded steps of whole scenes, and a loss on node accelerations."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sdfsim.base.files import digest
from sdfsim.data.batching import centred, merged, state_at
from sdfsim.data.dataset import Trajectory, check_alike, conditions_of, load_shapes, ranges_of, trajectory_files
from sdfsim.learned.message_passing import GraphNetwork, MultiGraph, flipped
from sdfsim.learned.surfaces import (
    TARGET,
    body_tensors,
    find_contacts,
    node_owner,
    sdf_sim_graph,
    state_tensors,
    target_acceleration,
)
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, Units, largest_extent
from sdfsim.physics.solver.prepare import Compiled, SharedShapes
from sdfsim.training.batches import moved
from sdfsim.training.presets import Preset

CPU = torch.device("cpu")
WARM_BATCHES = 20  # batches that set the feature statistics before the first step


@dataclass(frozen=True)
class Batch:
    """A graph, the recorded accelerations [M, 3], and which nodes move [M]."""

    graph: MultiGraph
    target: Tensor
    moves: Tensor


class SurfaceTask:
    """Draws recorded steps of random trajectories, turned by a random yaw, and if `noisy` with rigid noise on the input
    poses; on the CPU, since contacts are found there."""

    def __init__(self, data: Path, split: str, plan: Preset, *, noisy: bool = False) -> None:
        files = trajectory_files(data, split)
        self.trajectories, self.floor = [Trajectory.load(f) for f in files], conditions_of(files[0].parent).floor
        check_alike(f"{data / split}", self.trajectories)
        names = {str(n) for t in self.trajectories for n in t.shape}
        self.nodes = plan.nodes
        self.shapes = {k: replace(centred(s), nodes=s.nodes[: plan.nodes]) for k, s in load_shapes(data, names).items()}
        self.reach, self.noise = plan.reach, plan.noise if noisy else None
        self.counts = [len(self.trajectories)]
        self.dt = self.trajectories[0].dt
        self.gravity = float(np.linalg.norm(self.trajectories[0].gravity))
        self.shared = SharedShapes()

    def digest(self) -> str:
        return digest(self.floor, self.trajectories, {name: shape.nodes for name, shape in self.shapes.items()})[:16]

    def prepare(self, network: GraphNetwork, rng: np.random.Generator, device: torch.device) -> None:
        """Set the feature statistics of a network, which is on `device`, from a few batches."""
        for _ in range(WARM_BATCHES):
            batch = moved(self.draw(rng, 4), device)
            network.observe(batch.graph)
            network.target.observe(batch.target[batch.moves])

    def draw(self, rng: np.random.Generator, count: int) -> Batch:
        """`count` recorded steps as one graph, or this process's part of them."""
        bodies, state, after = self.scenes(rng, count)
        scene = Compiled(bodies, state, self.shared)
        bodies, state = body_tensors(bodies, CPU), state_tensors(state, CPU)
        # The target leads from the disturbed poses to the recorded one, so that the network learns to undo errors.
        target = target_acceleration(bodies, state, *map(torch.from_numpy, after))
        gravity = np.asarray(self.trajectories[0].gravity, dtype=np.float64)
        graph = sdf_sim_graph(bodies, state, find_contacts(bodies, state, gravity, self.reach, self.dt, scene))
        return Batch(graph, target.float(), bodies.moves[node_owner(bodies)])

    def scenes(self, rng: np.random.Generator, count: int) -> tuple[Bodies, State, tuple[np.ndarray, np.ndarray]]:
        """Bodies of `count` recorded steps side by side, their motion before, and their poses [N, *] after."""
        picked = [self.trajectories[i] for i in rng.integers(len(self.trajectories), size=count)]
        frames = [int(rng.integers(2, len(t.position) - 1)) for t in picked]
        yaw = pose.from_rotvec(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))
        noise = self._noise(picked, rng)
        units = Units(1.0, 1.0, 1.0)
        bodies, state = merged(picked, frames, self.shapes, units, self.floor)
        recorded = [state_at(picked, [k + offset for k in frames], state) for offset in (-2, -1, 0, 1)]
        yaw = np.broadcast_to(yaw, state.orientation.shape)
        poses = [(pose.rotate(yaw, one.position), pose.multiply(yaw, one.orientation)) for one in recorded]
        noisy = poses if noise is None else _disturbed(poses, bodies, noise)
        state = State(
            position=noisy[2][0],
            orientation=noisy[2][1],
            velocity=(noisy[2][0] - noisy[1][0]) / self.dt,
            angular_velocity=pose.to_rotvec(pose.multiply(noisy[2][1], pose.conjugate(noisy[1][1]))) / self.dt,
            earlier_position=np.stack([noisy[0][0], noisy[1][0]]),
            earlier_orientation=np.stack([noisy[0][1], noisy[1][1]]),
        )
        return bodies, state, poses[3]

    def loss(self, network: GraphNetwork, batch: Batch, *, mirrored: bool = False) -> Tensor:
        """Mean squared error of the standardised accelerations; a mirror image reverses the y axis of the world."""
        graph, target = batch.graph, batch.target
        if mirrored:
            graph, target = graph.mirrored(network.layout), flipped(target, TARGET)
        error = network(graph) - network.target(target)
        return error[batch.moves].square().mean()

    @property
    def length(self) -> float:
        """The middle of the bodies' sizes: those of a scene have it on average."""
        return float(np.mean(self.ranges()["size"]))

    def ranges(self) -> dict[str, list[float]]:
        """The ranges of the trajectories; see `ranges_of`."""
        extent = {name: largest_extent(shape) for name, shape in self.shapes.items()}
        moving = [(t, ~t.static) for t in self.trajectories if not t.static.all()]
        return ranges_of(
            np.concatenate([(np.array([extent[str(n)] for n in t.shape]) * t.scale)[m] for t, m in moving]),
            np.concatenate([np.linalg.norm(t.velocity[:, m], axis=-1).ravel() for t, m in moving]),
            np.array([t.mass[m].max() / t.mass[m].min() for t, m in moving]),
            np.concatenate([t.friction for t in self.trajectories]),
            np.concatenate([t.restitution for t in self.trajectories]),
            np.array([self.floor]),
        )

    def _noise(self, picked: list[Trajectory], rng: np.random.Generator) -> np.ndarray | None:
        """Noise [3, 2, N + 1, 3] m for each input pose: shifts, and turns measured at the surface, for bodies and the
        floor."""
        if self.noise is None:
            return None
        # Steps of size 1 / sqrt(3), so that the last pose of the walk deviates by `noise`.
        count = 1 + sum(t.position.shape[1] for t in picked)
        return rng.normal(scale=self.noise / np.sqrt(3), size=(3, 2, count, 3))


def _disturbed(poses: list[tuple[np.ndarray, np.ndarray]], bodies: Bodies, noise: np.ndarray):
    """Displace the three input poses rigidly by a random walk with the steps `noise` [3, 2, N, 3] m."""
    lever = np.where(bodies.moves, 2.0 / bodies.size, 0.0)[:, None]
    shift, turn = (noise * bodies.moves[:, None]).cumsum(0).swapaxes(0, 1)
    walked = [
        (position + s, pose.multiply(pose.from_rotvec(t * lever), quat))
        for (position, quat), s, t in zip(poses, shift, turn, strict=False)
    ]
    return [*walked, poses[3]]
