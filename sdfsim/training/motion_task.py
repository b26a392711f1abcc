"""The task of training the *impulse* network on recorded motions, over several steps in a row.

Windows of recordings run side by side, each from a recorded state. The contact solve steps them, the network corrects
its impulses, and the next step starts from the result. Gradients flow through the network and through the effects of
its corrections: free motion, and contacts that hold. The solve's own result is treated as a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import digest
from sdfsim.data.dataset import ranges_of
from sdfsim.learned.contact_graph import ContactGraph, edge_frames, in_single
from sdfsim.learned.impulse import ImpulseNetwork
from sdfsim.learned.inference import changed, step_graph
from sdfsim.physics import pose
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import GRAVITY, LENGTH, Options
from sdfsim.physics.solver.record import Edges
from sdfsim.physics.units import scene_units
from sdfsim.physics.validity import FARTHEST, first_fault
from sdfsim.scene.scene import Scene
from sdfsim.simulate.batch import Copies, inner_of_frame
from sdfsim.training.distributed import ALONE, Team

if TYPE_CHECKING:
    from sdfsim.apps.observed import Recording

SOFT = 0.02  # relative to a body's size: smaller errors count squared, larger ones linearly
LOST = 0.3  # relative to a body's size: bound of an error's contribution, since motions this far off are chaotic
SLOW = 0.03  # model units of speed: slower bodies count as at rest
IMPACT = 3.0  # times the change of velocity by gravity in a frame: larger changes come from contacts
HORIZONS = 0.25, 0.5, 1.0  # model units of time: lengths of windows; each batch has one of them
NOISE = 2.0  # starts are disturbed by this many standard deviations of the tracker's noise
KNOWN = 0.1  # uncertainty of a fitted velocity, relative to the noise of a pose divided by the spacing of frames
HELD = 6  # every sixth recording is held out
LEAST = 4  # least number of recordings


@dataclass(frozen=True)
class Starts:
    """W windows of D bodies: poses and velocities at their first frames, and the following poses; SI units."""

    position: np.ndarray  # [W * D, 3]
    orientation: np.ndarray  # [W * D, 4]
    velocity: np.ndarray  # [W * D, 3]
    angular_velocity: np.ndarray  # [W * D, 3]
    goal: np.ndarray  # [K, W * D, 7], NaN for missing poses


class Stepped(NamedTuple):
    """One step: the poses after it, and the contact graph, or None if nothing touched."""

    position: np.ndarray  # [W * D, 3] model lengths
    orientation: np.ndarray  # [W * D, 4]
    rows: np.ndarray  # [A] int64, the bodies of the graph
    graph: ContactGraph | None


class Worlds(Copies):
    """Copies of a scene's bodies, moved by steps between the frames of a recording, `dt` s apart."""

    def __init__(self, scene: Scene, count: int, dt: float) -> None:
        super().__init__(scene, count)
        self.dt, pull = dt / self.units.time, np.asarray(scene.gravity) / self.units.acceleration
        self.options = Options(pull, self.dt, inner_of_frame(self.dt), record=True)
        self.carry = self.solver.init(self.bodies, self.start, self.options)

    def roll(
        self, network: ImpulseNetwork | None, starts: Starts, steps: int, *, mirrored: bool = False
    ) -> list[Stepped]:
        """Simulate from these starts with a network on the solve, or with the solve alone. Bodies that a network has
        thrown to an invalid state rest far away from then on, so that errors are large but finite."""
        found, lost = [], np.zeros(self.total, bool)
        state = self.begun(starts.position, starts.orientation, starts.velocity, starts.angular_velocity)
        for _ in range(steps):
            solved, _ = self.solver.advance(state, self.carry)
            edges, rows, graph = cast("Edges", self.carry.edges), np.zeros(0, np.int64), None
            before = state
            if len(edges.pair):
                rows, graph = step_graph(self.bodies, state, solved, edges, self.options, self.dt)
                graph = in_single(graph)
                if network is not None:
                    with torch.no_grad():
                        made = network(graph, mirrored=mirrored)
                    solved = changed(self.bodies, solved, rows, graph, made, self.options)
            state = solved
            while fault := first_fault(state, self.dt, np.flatnonzero(~lost), before):
                lost[fault.body] = True
            if lost.any():
                state = state.with_rows(gone := np.flatnonzero(lost), _far_away(gone))
            found.append(Stepped(state.position[: self.total], state.orientation[: self.total], rows, graph))
        return found


def _far_away(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Poses and velocities of bodies [K] int64 at rest, far from each other and from everything else; model units."""
    still, count = np.zeros((len(rows), 3)), len(rows)
    place = np.stack([np.full(count, FARTHEST / 2), 1e3 * rows, np.full(count, FARTHEST / 2)], 1)
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    return {"position": place, "orientation": turn, "velocity": still, "angular_velocity": still.copy()}


def joined(graphs: Sequence[ContactGraph]) -> ContactGraph:
    whole: dict[str, Any] = {"dt": graphs[0].dt, "pairs": sum(g.pairs for g in graphs)}
    bodies = np.cumsum([0, *(len(g.inverse_mass) for g in graphs)]).tolist()
    pairs = np.cumsum([0, *(g.pairs for g in graphs)]).tolist()
    shifts = {"first": bodies, "second": bodies, "pair": pairs}
    for field in fields(ContactGraph):
        if field.name not in whole:
            shift = shifts.get(field.name, [0] * len(graphs))
            whole[field.name] = torch.cat([getattr(g, field.name) + k for g, k in zip(graphs, shift, strict=False)])
    return ContactGraph(**whole)


class MotionTask:
    """Draws windows of recordings, and measures how far a network on the solve deviates from them; on the CPU."""

    def __init__(self, recordings: Sequence[Recording], scene: Scene, *, noisy: bool = False) -> None:
        self.recordings, self.scene, self.noisy = list(recordings), scene, noisy
        spacing = self.recordings[0].dt
        if any(abs(r.dt - spacing) > 1e-3 * spacing for r in self.recordings):
            raise SdfsimError("recordings to train on must have the same spacing of frames")
        self.worlds = cache(lambda count: Worlds(scene, count, spacing))
        self.units = scene_units(scene)
        self.dt, self.gravity, self.length = spacing / self.units.time, GRAVITY, LENGTH
        self.inner, self.counts = inner_of_frame(self.dt), [len(self.recordings)]
        self.begin = {horizon: self._begin(max(2, round(horizon / self.dt))) for horizon in HORIZONS}

    def _begin(self, steps: int) -> tuple[list[tuple[int, int]], np.ndarray]:
        """Where windows of `steps` steps may begin, and the probabilities: something touches in their first half, and
        half of them begin before the first impact, where velocities are known best and most of the motion follows."""
        begin, early = [], []
        for k, r in enumerate(self.recordings):
            speed = np.linalg.norm(r.velocity, axis=-1).max(1) / self.units.velocity
            touched = np.asarray(~r.flying.all(1))
            fall = np.asarray(self.scene.gravity) * r.dt
            sudden = np.linalg.norm(np.diff(r.velocity, axis=0) - fall, axis=-1).max(1) > IMPACT * np.linalg.norm(fall)
            touched[1:] |= sudden  # a sudden change between two frames of flight is an impact
            flown = int(touched.argmax())
            for t in np.flatnonzero(r.known[:-LEAST]):
                if speed[t] > SLOW and touched[t + 1 : t + 1 + max(2, steps // 2)].any():
                    begin.append((k, int(t)))
                    early.append(t < flown)
        if not begin:
            raise SdfsimError("no recording has a contact after a smooth stretch")
        first = np.array(early)
        weight = first / max(1, first.sum()) + ~first / max(1, (~first).sum())
        return begin, weight / weight.sum()

    def digest(self) -> str:
        motions = [(r.goal, r.position, r.velocity, r.angular_velocity) for r in self.recordings]
        of = ("name", "scale", "mass", "friction", "restitution", "position", "quat_xyzw")
        return digest(motions, [[getattr(b, name) for name in of] for b in self.scene.bodies])[:16]

    def ranges(self) -> dict[str, list[float]]:
        """The ranges of the recordings, in the solver's units; see `ranges_of`."""
        bodies = self.worlds(1).bodies
        moves = bodies.moves
        speed = np.concatenate([np.linalg.norm(r.velocity[r.known], axis=-1).ravel() for r in self.recordings])
        ratio = float(bodies.mass[moves].max() / bodies.mass[moves].min())
        fixed = np.stack([bodies.friction[~moves], bodies.restitution[~moves]], 1)
        return ranges_of(
            bodies.size[moves], speed / self.units.velocity, np.array([ratio]), bodies.friction[moves],
            bodies.restitution[moves], fixed,
        )  # fmt: skip

    def draw(self, rng: np.random.Generator, count: int, team: Team = ALONE) -> Starts:
        """Starts of `count` windows of one length."""
        horizon = float(rng.choice(HORIZONS))
        begin, weight = self.begin[horizon]
        picked = [begin[i] for i in rng.choice(len(begin), count, p=weight)]
        return self.starts(picked[team.share(count)], max(2, round(horizon / self.dt)), rng if self.noisy else None)

    def starts(self, picked: Sequence[tuple[int, int]], steps: int, rng: np.random.Generator | None = None) -> Starts:
        """Windows that begin in these recordings at these frames; if `rng` is given, disturbed like a tracker's
        noise."""
        some = [(self.recordings[k], t) for k, t in picked]
        position, turn, speed, spin = (np.concatenate([getattr(r, name)[t] for r, t in some]) for name in MOTION)
        many = some[0][0].seen.shape[1]
        goal = np.full((steps, len(some), many, 7), np.nan)
        for w, (r, t) in enumerate(some):
            rows = slice(t + 1, min(t + 1 + steps, len(r.known)))
            both = np.concatenate([r.goal[0][rows], r.goal[1][rows]], -1)
            goal[: len(both), w] = np.where(r.seen[rows][..., None], both, np.nan)
        if rng is not None:
            place, angle = NOISE * np.repeat([r.noise for r, _ in some], many, axis=0).T[..., None]
            shake = rng.standard_normal((4, *position.shape))
            position = position + place * shake[0]
            turn = pose.normalise(pose.multiply(pose.from_rotvec(angle * shake[1]), turn))
            speed = speed + KNOWN * place / some[0][0].dt * shake[2]
            spin = spin + KNOWN * angle / some[0][0].dt * shake[3]
        return Starts(position, turn, speed, spin, goal.reshape(steps, -1, 7))

    def loss(self, network: ImpulseNetwork, batch: Starts, *, mirrored: bool = False) -> Tensor:
        """Mean soft error of poses in body sizes, turns at half a size."""
        many = self.recordings[0].seen.shape[1]
        worlds = self.worlds(len(batch.position) // many)
        rolled = worlds.roll(network, batch, len(batch.goal), mirrored=mirrored)
        return loss_of(network, worlds, rolled, batch.goal, mirrored=mirrored)

    def weight_of(self, batch: Starts) -> int:
        """The number of windows of a body over which a batch's loss is averaged."""
        return len(batch.position)


def loss_of(
    network: ImpulseNetwork, worlds: Worlds, rolled: Sequence[Stepped], goal: np.ndarray, *, mirrored: bool = False
) -> Tensor:
    """Mean soft error of a network's steps against `goal` [K, W * D, 7] in metres."""
    total, dt = worlds.total, worlds.dt
    size = worlds.bodies.size[:total, None]
    place, turn = (np.stack([getattr(step, name) for step in rolled]) for name in ("position", "orientation"))
    away = pose.to_rotvec(pose.multiply(turn, pose.conjugate(goal[..., 3:])))
    off = np.concatenate([(place - goal[..., :3] / worlds.units.length) / size, 0.5 * away], -1)
    seen = torch.from_numpy(np.isfinite(off).all(-1))
    off = torch.from_numpy(np.nan_to_num(off).astype(np.float32))
    lengths = torch.from_numpy(np.concatenate([np.repeat(1.0 / size, 3, 1), np.full((total, 3), 0.5)], 1)).float()
    made = iter(_pushes(network, [step.graph for step in rolled if step.graph is not None], mirrored))
    # The effect of the network's corrections on twists and poses: its value is 0, its gradient is not.
    twist, shift = torch.zeros(len(worlds.bodies), 6), torch.zeros(len(worlds.bodies), 6)
    errors = []
    for t, step in enumerate(rolled):
        shift = shift + dt * twist
        if step.graph is not None:
            rows, (end, mean) = torch.from_numpy(step.rows), next(made)
            after = twist[rows] if network.config.alone else _held(step.graph, twist[rows])
            twist = twist.index_copy(0, rows, after + end)
            shift = shift.index_add(0, rows, dt * mean)
        error = off[t] + shift[:total] * lengths
        errors.append(_soft(error[:, :3]) + _soft(error[:, 3:]))
    return (torch.stack(errors) * seen).sum() / seen.sum().clamp_min(1)


def _pushes(network: ImpulseNetwork, graphs: list[ContactGraph], mirrored: bool) -> list[tuple[Tensor, Tensor]]:
    """For each graph the changes of twists [A, 6], at the end of the step and of its mean, minus their values."""
    if not graphs:
        return []
    made = network(joined(graphs), mirrored=mirrored)
    counts = [len(g.inverse_mass) for g in graphs]
    parts = [
        (both - both.detach()).split(counts)
        for both in (
            torch.cat([made.velocity, made.angular], -1), torch.cat([made.mean_velocity, made.mean_angular], -1)
        )
    ]  # fmt: skip
    return list(zip(*parts, strict=True))


def _held(graph: ContactGraph, twist: Tensor) -> Tensor:
    """Changes of twists [A, 6] after contacts that push: components along their normals are removed."""
    with torch.no_grad():
        frames = edge_frames(graph)
        hold = (frames.solved[:, 0] > 0).to(twist.dtype) * frames.mass[:, 0]
    seen = (frames.jacobian_first[:, 0] * twist[graph.first]).sum(-1)
    push = -(hold * (seen - (frames.jacobian_second[:, 0] * twist[graph.second]).sum(-1)))[:, None]
    twist = twist.index_add(0, graph.first, frames.response_first[..., 0] * push)
    return twist.index_add(0, graph.second, frames.response_second[..., 0] * push)


def _soft(error: Tensor) -> Tensor:
    """[N] sizes of errors [N, 3], squared below `SOFT`, and bounded by `LOST`."""
    size = (error.square().sum(-1) + SOFT**2).sqrt() - SOFT
    return size / (1.0 + size / LOST)
