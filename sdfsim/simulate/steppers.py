"""Steppers take a state to the next one: free flight alone, the contact solve, and the networks, all with one
interface.

`stepper_of` makes a stepper of a model. `init` gives a `Carry` for the bodies and the start of a run, `advance` makes
one step or many in one call, and `announce` reports what the user has changed between steps. Each stage computes only
what is needed: an effect that is off is not computed, a body without contact is not in a network's graph, and a
sleeping body costs nothing until something moves beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import numpy as np

from sdfsim.base.compiling import running
from sdfsim.base.devices import pick_device
from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import IMPULSE, SOLVER, Model
from sdfsim.learned.training_ranges import outside_training
from sdfsim.physics.bodies import Bodies, State, Units, awake
from sdfsim.physics.free_flight import driven, fly, with_history
from sdfsim.physics.joint_columns import COORD, PULL, STATE
from sdfsim.physics.joints import stored
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import SUBSTEPS, Options
from sdfsim.physics.steps import COUNTS, PHASES, Frames, Steps
from sdfsim.physics.units import scene_units
from sdfsim.physics.validity import NO_LIMITS, first_fault, limits
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import Shape

if TYPE_CHECKING:  # numba and torch are slow to load
    from sdfsim.learned.impulse import ImpulseNetwork
    from sdfsim.learned.surfaces import BodyTensors, Contacts
    from sdfsim.physics.solver.prepare import Compiled, SharedShapes

FreeFlight = Literal["exact", "learned"]
LONGEST = 0.01  # s, the longest inner step of the contact solve that its laws were checked with


@dataclass
class Carry:
    """What a stepper keeps from step to step, besides the state. None of it changes results."""

    bodies: Bodies
    options: Options
    checked: bool = False  # whether `advance` ends at an invalid state
    counts: dict[str, float] = field(default_factory=lambda: dict.fromkeys((*COUNTS, *PHASES), 0.0))  # of the last step
    scene: Compiled | None = None  # the bodies for compiled code, if the stepper uses any
    # weights: a network on bodies, in double precision; tensors: the bodies, for a network on surface nodes. Both also
    # depend on the options.
    weights: ImpulseNetwork | None = None
    tensors: BodyTensors | None = None
    near: Contacts | None = None  # where a network on surface nodes found bodies near each other
    touched: tuple[np.ndarray, np.ndarray, float] | None = None  # where one on bodies did, as `touching` returns it

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time that a block takes to a phase."""
        started = running()
        yield
        self.counts[phase] += 1e3 * (running() - started)


@dataclass(frozen=True)
class Stepper:
    """The interface of all steppers. This class itself lets all bodies fly freely."""

    model: Model
    mean: bool = False  # whether model units follow the mean size of the bodies that move, not the smallest

    on_surfaces: ClassVar[bool] = False  # whether it works on surface nodes: on CUDA too, in steps of its own length
    # whether bodies can be pulled, held by joints and moved along paths, and contacts report impulses
    forces: ClassVar[bool] = True
    sleeps: ClassVar[bool] = False  # whether it freezes bodies at rest
    network: ClassVar[bool] = False  # whether a network takes part
    solids: ClassVar[bool] = False  # whether shapes with convex pieces collide as these

    @property
    def distances(self) -> bool:
        """Whether it uses the compiled distances of a scene."""
        return False

    @property
    def device(self) -> Any:
        """Where it computes: "cpu", or the device of the network's weights."""
        return "cpu"

    def units(self, scene: Scene, dt: float | None = None) -> Units:
        """Model units of a scene, see `scene_units`."""
        known = {"step": self.model.dt, "gravity": self.model.gravity, "length": self.model.length}
        return scene_units(scene, dt, **known, mean=self.mean)

    def surface(self, shape: Shape) -> Shape:
        """The shape with the surface nodes that the stepper uses."""
        return shape

    def unknown(self, scenes: Sequence[Scene], units: Units) -> list[str]:
        """A line for each way in which scenes are beyond what the stepper was trained or checked on."""
        return outside_training(scenes, self.model, units)

    def began(self, state: State, bodies: Bodies, options: Options) -> State:
        """A start state, completed with everything that the first step needs."""
        return state

    def init(self, bodies: Bodies, state: State, options: Options, shared: SharedShapes | None = None) -> Carry:
        """The carry of a run that starts from `state`. Runs of many scenes can share their shapes."""
        if not self.distances:
            return Carry(bodies, options)
        from sdfsim.physics.solver.prepare import Compiled

        return Carry(bodies, options, scene=Compiled(bodies, state, shared, grids=not self.solids))

    def announce(
        self, state: State, carry: Carry, changed: np.ndarray, moved: np.ndarray, *, gravity: bool = False
    ) -> State:
        """The state after the user has changed pose, velocities, load or motors of the bodies `changed` [N] bool, pose
        or velocities of those that he `moved` [N], or gravity. Data precomputed from static bodies is made again if one
        of them has changed."""
        scene = carry.scene
        if scene is not None and (changed & ~(scene.world.moves | scene.world.scripted)).any():
            scene.place(state)
        return state

    def advance(self, state: State, carry: Carry, n: int = 1, *, keep: bool = False) -> Steps:
        """Make `n` steps, and `keep` their frames. A `checked` carry ends them at the first invalid state. The counts
        of the carry are those of the last step that is kept."""
        bodies, dt, rows, kept = carry.bodies, carry.options.dt, carry.bodies.movers, []
        done, fault, total = 0, None, 0.0
        for _ in range(n):
            known = carry.counts, carry.near, carry.touched
            carry.counts = dict.fromkeys(carry.counts, 0.0)
            after = self._step(driven(bodies, state, dt), carry)
            asleep = np.zeros(len(rows), bool) if after.touch is None else after.touch.rows_of("island", rows) >= 0
            if carry.checked:
                fault = first_fault(after, dt, rows[~asleep], state)
                if fault is not None:
                    carry.counts, carry.near, carry.touched = known
                    break
            carry.counts |= {"asleep": asleep.sum(), "free": len(rows) - asleep.sum() - carry.counts["active"]}
            given = _given(state, after, rows, dt)
            done, state, total = done + 1, after, total + given
            if keep:
                kept.append((after, given, carry.counts, self.touching(after, carry)))
        return Steps(
            state, done, fault, total, carry.counts, stacked(state, kept, bodies, carry.options) if keep else None
        )

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        """Points [C, 3] where bodies touch, pairs of bodies [C, 2], and the deepest penetration, model units; before
        the first step `carry` is None."""
        return np.zeros((0, 3)), np.zeros((0, 2), dtype=np.int64), 0.0

    def _step(self, state: State, carry: Carry) -> State:
        """The next state; scripted bodies have the velocities of the coming step."""
        with carry.timed("flight_ms"):
            return fly(carry.bodies, state, carry.options)


class Solver(Stepper):
    """The contact solve."""

    distances = True  # type: ignore[assignment]
    sleeps = solids = True

    def unknown(self, scenes: Sequence[Scene], units: Units) -> list[str]:
        """The solve has no training. A line if its inner step is longer than any that its laws were checked with."""
        inner = self.model.dt * units.time / SUBSTEPS
        if inner <= LONGEST:
            return []
        return [f"inner step: {1e3 * inner:.3g} ms here, checked up to {1e3 * LONGEST:g} ms (small bodies shorten it)"]

    def announce(
        self, state: State, carry: Carry, changed: np.ndarray, moved: np.ndarray, *, gravity: bool = False
    ) -> State:
        from sdfsim.physics.solver.prepare import disturbed

        return disturbed(carry.bodies, super().announce(state, carry, changed, moved), changed, moved, gravity=gravity)

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        from sdfsim.physics.solver.prepare import contact_points

        found = contact_points(state)
        return found.point, found.pair, float((-found.gap).max(initial=0.0))

    def advance(self, state: State, carry: Carry, n: int = 1, *, keep: bool = False) -> Steps:
        """All steps in one call of compiled code."""
        most = limits(carry.options.dt) if carry.checked else NO_LIMITS
        made = cast("Compiled", carry.scene).advance(state, carry.options, n, most, keep=keep)
        carry.counts |= made.counts
        return made


class OnBodies(Stepper):
    """The *impulse* network: free flight, and its impulses at the points where bodies are near each other."""

    network = solids = True
    distances = True  # type: ignore[assignment]
    forces = False

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        """The points were found at the start of the step."""
        return super().touching(state, carry) if carry is None or carry.touched is None else carry.touched

    def _step(self, state: State, carry: Carry) -> State:
        from sdfsim.learned.inference import doubled, stepped
        from sdfsim.physics.solver.prepare import points_near
        from sdfsim.physics.solver.tolerances import REPORTED

        bodies, options, free = carry.bodies, carry.options, super()._step(state, carry)
        with carry.timed("contact_ms"):
            pair, value = points_near(cast("Compiled", carry.scene), state, options)
        touch = (value[:, 9] <= REPORTED) & (value[:, 10] == 0.0)
        point = state.rows_of("position", pair[touch, 0]) + value[touch, :3]
        carry.touched = point, pair[touch], float((-value[touch, 9]).max(initial=0.0))
        if not len(pair):
            return free
        with carry.timed("network_ms"):
            if carry.weights is None:
                carry.weights = doubled(self.model.network)
            after = stepped(carry.weights, bodies, state, free, (pair, value), options, self.model.dt)
        rows = np.unique(pair)
        carry.counts |= {"active": int(bodies.moves[rows].sum()), "contacts": int(touch.sum())}
        carry.counts |= {"nodes": len(rows), "edges": len(pair), "pairs": len(np.unique(pair, axis=0))}
        return after


@dataclass(frozen=True)
class OnSurfaces(Stepper):
    """The network on surface nodes: the step of the paper for bodies that are near another, free flight for the
    others, which the network may predict too (`learned`)."""

    contact: bool = True
    learned: bool = False

    on_surfaces = network = True
    forces = False

    @property
    def distances(self) -> bool:
        return self.contact

    @property
    def device(self) -> Any:
        return next(iter(self.model.network.state_dict().values())).device

    def surface(self, shape: Shape) -> Shape:
        """The shape with its first nodes: the outermost ones, then the most evenly spread."""
        return replace(shape, nodes=shape.nodes[: self.model.nodes])

    def began(self, state: State, bodies: Bodies, options: Options) -> State:
        return with_history(state, bodies, options)

    def announce(
        self, state: State, carry: Carry, changed: np.ndarray, moved: np.ndarray, *, gravity: bool = False
    ) -> State:
        """The earlier positions of changed bodies are computed from their velocities."""
        return with_history(super().announce(state, carry, changed, moved), carry.bodies, carry.options, changed)

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        """The edges were found at the start of the step; their points are returned for the poses of `state`."""
        if carry is None or carry.near is None or not len(near := carry.near):
            return super().touching(state, carry)
        from sdfsim.learned.surfaces import state_tensors, where

        pairs = np.stack([near.owner.cpu().numpy(), near.body.cpu().numpy()], -1)
        points = where(state_tensors(state, self.device), self._tensors(carry), near).cpu().numpy()
        return points, pairs, float((-near.distance).clamp_min(0.0).max())

    def _tensors(self, carry: Carry) -> BodyTensors:
        from sdfsim.learned.surfaces import body_tensors

        if carry.tensors is None:
            bodies = carry.bodies
            if not carry.options.friction:
                bodies = replace(bodies, friction=np.zeros_like(bodies.friction))
            if not carry.options.restitution:
                bodies = replace(bodies, restitution=np.zeros_like(bodies.restitution))
            carry.tensors = body_tensors(bodies, self.device)
        return carry.tensors

    def _step(self, state: State, carry: Carry) -> State:
        import torch

        from sdfsim.learned.surfaces import (
            compact,
            find_contacts,
            no_contacts,
            predict,
            sdf_sim_graph,
            state_tensors,
        )

        options, tensors = carry.options, self._tensors(carry)
        if state.earlier_position is None:  # from a stepper that needs no earlier positions
            state = self.began(state, carry.bodies, options)
        free = super()._step(state, carry)
        with torch.no_grad():
            now = state_tensors(state, self.device)
            with carry.timed("contact_ms"):
                near = no_contacts(self.device)
                if self.contact:
                    near = find_contacts(tensors, now, options.gravity, self.model.reach, options.dt, carry.scene)
            ends = [near.owner, near.body]
            if self.learned:
                ends.append(torch.from_numpy(awake(carry.bodies, state)).to(self.device))
            active = torch.unique(torch.cat(ends))
            chosen = tensors.moves[active]
            carry.near = near
            carry.counts |= {"active": int(chosen.sum()), "contacts": len(near)}
            if not bool(chosen.any()):
                return free
            with carry.timed("network_ms"):
                some, start, among = compact(tensors, now, near, active)
                graph = sdf_sim_graph(some, start, among)
                predicted = predict(cast("Any", self.model.network), graph, some, start, options.dt)
                moved = {name: getattr(predicted, name)[chosen].cpu().numpy() for name in MOTION}
        carry.counts |= {"nodes": len(graph), "edges": graph.edge_count}
        rows = active[chosen].cpu().numpy()
        if not options.rotation:
            moved |= {"orientation": state.orientation[rows], "angular_velocity": np.zeros((len(rows), 3))}
        arrays = {name: getattr(free, name).copy() for name in MOTION}
        for name, values in moved.items():
            arrays[name][rows] = values
        return replace(free, **arrays)


def _given(before: State, after: State, rows: np.ndarray, dt: float) -> float:
    """The work of pulling forces and torques on the bodies `rows` in a step."""
    if before.load is None:
        return 0.0
    force, torque = before.load[rows, :3], before.load[rows, 3:]
    place, spin = (
        [state.rows_of(name, rows) for state in (before, after)] for name in ("position", "angular_velocity")
    )
    return float((force * (place[1] - place[0])).sum() + (torque * (0.5 * dt * (spin[0] + spin[1]))).sum())


def energies_of(bodies: Bodies, state: State, gravity: np.ndarray) -> tuple[float, float]:
    """Kinetic and potential energy of all dynamic bodies, model units."""
    from sdfsim.physics.solver.survey import energies

    moved = (np.ascontiguousarray(getattr(state, name)) for name in MOTION)
    kinetic, potential = energies(bodies.mass, bodies.inertia, gravity, *moved)
    if bodies.joints is not None and state.joints is not None:
        potential += stored(bodies.joints, state.joints)
    return kinetic, potential


def stacked(like: State, kept: list[tuple[State, float, dict, tuple]], bodies: Bodies, options: Options) -> Frames:
    """The frames of single steps, as many as `kept` has: for each the state after it, the work of pulls, counts, and
    where bodies touch."""
    states = [state for state, *_ in kept]
    arrays = {
        name: np.stack([getattr(s, name) for s in states]) if states else getattr(like, name)[None][:0]
        for name in MOTION
    }
    energy = [(*energies_of(bodies, state, options.gravity), given) for state, given, *_ in kept]
    points, pairs, depths = zip(*(found for *_, found in kept), strict=True) if kept else ((), (), ())
    counts = {name: np.array([counts.get(name, 0.0) for _, _, counts, _ in kept], float) for name in (*COUNTS, *PHASES)}
    return Frames(
        **arrays,
        energy=np.array(energy).reshape(-1, 3),
        depth=np.array(depths, float),
        touching=np.array([len(one) for one in pairs], np.int64),
        pair=np.concatenate([np.zeros((0, 2), np.int64), *pairs]),
        point=np.concatenate([np.zeros((0, 3)), *points]),
        counts=counts,
        joint=np.stack([joint_frame(s) for s in states]) if states else joint_frame(like)[None][:0],
    )


def joint_frame(state: State) -> np.ndarray:
    """[J, 7], see `Frames.joint`."""
    known = np.zeros((0, STATE)) if state.joints is None else state.joints
    return np.concatenate([known[:, COORD, None], known[:, PULL : PULL + 6]], 1)


def stepper_of(
    model: Model, *, contact: bool = True, free_flight: FreeFlight = "exact", device: str | None = None
) -> Stepper:
    """The stepper of a model, for scenes with `contact` or without. Networks on surface nodes work on the `device`
    (None: where their weights are), others on the CPU. Only networks on surface nodes have "learned" free flight;
    raises SdfsimError for it with any other model."""
    learned, on_surfaces = free_flight == "learned", model.kind not in (SOLVER, IMPULSE)
    if learned and not on_surfaces:
        raise SdfsimError("only networks on surface nodes have free_flight 'learned'", "give a model of that kind")
    if not contact and not learned:
        return Stepper(model, mean=on_surfaces)
    if device is not None:
        model = model.to(str(pick_device(device)) if on_surfaces else "cpu")
    if on_surfaces:
        return OnSurfaces(model, True, contact=contact, learned=learned)
    return Solver(model) if model.kind == SOLVER else OnBodies(model)
