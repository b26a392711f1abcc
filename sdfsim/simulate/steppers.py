"""What takes a state to the next one: free flight alone, the contact solve, and the networks, all by one contract.

`stepper_of` makes a stepper of a model. `init` gives a `Carry` for the bodies and the start of a run, `advance` makes
steps, and `announce` is told what somebody has changed between steps. Each stage sees only what is in play: an effect
that is off is not computed, a body without contact is not in a network's graph, and what sleeps is not looked at until
something moves beside it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import numpy as np
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import SOLVER, SURFACE, Model
from sdfsim.learned.training_ranges import outside_training
from sdfsim.physics.bodies import Bodies, State, Units, awake
from sdfsim.physics.free_flight import MOTION, driven, fly, with_rows
from sdfsim.physics.options import SUBSTEPS, Options
from sdfsim.physics.units import scene_units
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import Shape

if TYPE_CHECKING:  # numba takes its time to load
    from sdfsim.learned.families import Family
    from sdfsim.learned.near import Contacts, Pairs
    from sdfsim.physics.solver.impulse import Weights
    from sdfsim.physics.solver.prepare import Compiled
    from sdfsim.physics.solver.record import Edges

FreeFlight = Literal["exact", "learned"]
LONGEST = 0.01  # s, an inner step of the contact solve
COUNTS = {
    "pairs": "pairs of bodies that the broad phase let through",
    "contacts": "contact points that the solve held",
    "nodes": "nodes of the graph that the network saw",
    "edges": "edges of that graph",
    "free": "dynamic bodies in free flight",
    "active": "dynamic bodies awake that contacts moved",
    "asleep": "dynamic bodies asleep",
}
PHASES = {
    "flight_ms": "free flight",
    "contact_ms": "contact solve",
    "network_ms": "network",
}


@dataclass
class Carry:
    """What a stepper keeps of one run from step to step, beside the state. None of it changes a result."""

    bodies: Bodies
    options: Options
    counts: dict[str, float] = field(default_factory=lambda: dict.fromkeys((*COUNTS, *PHASES), 0.0))  # of a step
    scene: Compiled | None = None  # as compiled code wants it, where any is asked
    weights: Weights | None = None  # likewise of a network on the solve
    edges: Edges | None = None  # what contacts did in the latest step, where `options.record`
    near: Contacts | Pairs | None = None  # where a network on surface nodes saw bodies near each other

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Add the time that a block takes to a phase."""
        started = time.perf_counter()
        yield
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.counts[phase] += 1e3 * (time.perf_counter() - started)


@dataclass(frozen=True)
class Stepper:
    """The contract; free flight of all bodies is what it does by itself."""

    model: Model
    mean: bool = False  # whether model units follow the mean size of the bodies that move, not the smallest

    on_surfaces: ClassVar[bool] = False  # whether it works on surface nodes: on CUDA too, in steps of its own length
    forces: ClassVar[bool] = True  # whether it knows forces that pull at bodies, and tells impulses of contacts
    sleeps: ClassVar[bool] = False  # whether it freezes what rests
    network: ClassVar[bool] = False  # whether one has its say in it

    @property
    def distances(self) -> bool:
        """Whether it asks the compiled distances of a scene."""
        return False

    def units(self, scene: Scene, dt: float | None = None) -> Units:
        """Model units of a scene, see `scene_units`."""
        known = {"step": self.model.dt, "gravity": self.model.gravity, "length": self.model.length}
        return scene_units(scene, dt, **known, mean=self.mean)

    def surface(self, shape: Shape) -> Shape:
        """The shape with the surface nodes, and the faces between them, that it works on."""
        return shape

    def unknown(self, scenes: Sequence[Scene], units: Units) -> list[str]:
        """One line for everything in scenes that is beyond what it was trained or checked with."""
        return outside_training(scenes, self.model, units)

    def distrusted(self) -> Stepper:
        """As it steps scenes that are beyond its training."""
        return self

    def began(self, state: State, bodies: Bodies, options: Options) -> State:
        """A state that no step has led to, with what the first one needs."""
        return state

    def init(self, bodies: Bodies, state: State, options: Options) -> Carry:
        """What it keeps of a run that starts from `state`."""
        if not self.distances:
            return Carry(bodies, options)
        from sdfsim.physics.solver.prepare import Compiled

        return Carry(bodies, options, scene=Compiled(bodies, state))

    def announce(self, state: State, carry: Carry, changed: np.ndarray, *, gravity: bool = False) -> State:
        """The state after somebody has changed pose, velocities or load of the bodies `changed` [N] bool, or gravity.
        What was made of scenery is made anew where it is one of these."""
        scene = carry.scene
        if scene is not None and (changed & ~(scene.world.moves | scene.world.scripted)).any():
            scene.place(state)
        return state

    @torch.no_grad()
    def advance(self, state: State, carry: Carry, n: int = 1) -> tuple[State, Carry]:
        """Make `n` steps; the counts of the carry are then those of the last one."""
        bodies = carry.bodies
        for _ in range(n):
            carry.counts = dict.fromkeys(carry.counts, 0.0)
            state = self._step(driven(bodies, state, carry.options.dt), carry)
            asleep = 0 if state.touch is None else int(np.count_nonzero(state.touch.island.numpy() >= 0))
            moving = np.count_nonzero(bodies.moves.cpu().numpy())
            carry.counts |= {"asleep": asleep, "free": moving - asleep - carry.counts["active"]}
        return state, carry

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        """Points [C, 3] where bodies touch, pairs of bodies [C, 2], and the deepest penetration, model units; before
        the first step there is no carry."""
        return np.zeros((0, 3)), np.zeros((0, 2), dtype=np.int64), 0.0

    def _step(self, state: State, carry: Carry) -> State:
        """The next state; scripted bodies have the velocities of the coming step."""
        with carry.timed("flight_ms"):
            return fly(carry.bodies, state, carry.options)


class Solver(Stepper):
    """The contact solve."""

    distances = True  # type: ignore[assignment]
    sleeps = True

    def unknown(self, scenes: Sequence[Scene], units: Units) -> list[str]:
        """It has seen no training: it says where its inner step is longer than any that its laws were checked with."""
        inner = self.model.dt * units.time / (self.model.inner or SUBSTEPS)
        if inner <= LONGEST:
            return []
        return [f"inner step: {1e3 * inner:.3g} ms here, checked up to {1e3 * LONGEST:g} ms (small bodies shorten it)"]

    def announce(self, state: State, carry: Carry, changed: np.ndarray, *, gravity: bool = False) -> State:
        from sdfsim.physics.solver.prepare import disturbed

        return disturbed(super().announce(state, carry, changed), changed, gravity=gravity)

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        from sdfsim.physics.solver.prepare import contact_points

        found = contact_points(state)
        return found.point, found.pair, float((-found.gap).max(initial=0.0))

    def _step(self, state: State, carry: Carry) -> State:
        from sdfsim.physics.solver.prepare import solver_step

        with carry.timed("contact_ms"):
            after, carry.edges, counts = solver_step(cast("Compiled", carry.scene), state, carry.options)
        carry.counts |= dict(zip(("pairs", "contacts", "active"), counts, strict=True))
        return after


@dataclass(frozen=True)
class OnSolver(Solver):
    """The *impulse* network: it corrects what the contact solve makes of a step."""

    trust: float = 1.0  # in what the network adds to the solve; 0 where a scene is beyond its training

    network = True
    unknown = Stepper.unknown

    def distrusted(self) -> Stepper:
        return replace(self, trust=0.0)

    def _step(self, state: State, carry: Carry) -> State:
        # No network has seen forces in its training.
        asked = self.trust > 0.0 and state.load is None
        carry.options = replace(carry.options, record=asked)
        solved, edges = super()._step(state, carry), cast("Edges", carry.edges)
        if not (asked and len(edges.pair)):
            return solved
        from sdfsim.learned.inference import corrected, packed, terms_of

        with carry.timed("network_ms"):
            if carry.weights is None:
                carry.weights = packed(cast("Any", self.model.network), friction=carry.options.friction)
            terms, world = terms_of(carry.options, self.model.dt, self.trust), cast("Compiled", carry.scene).world
            after = corrected(carry.weights, world, state, solved, edges, terms)
        carry.counts |= {"nodes": len(np.unique(edges.pair)), "edges": len(edges.pair)}
        return after


@dataclass(frozen=True)
class OnSurfaces(Stepper):
    """The networks on surface nodes: a published step of the bodies that are near another, free flight of the others,
    which they may predict too (`learned`)."""

    family: Family = field(kw_only=True)
    contact: bool = True
    learned: bool = False

    on_surfaces = network = True
    forces = False

    @property
    def distances(self) -> bool:
        return self.contact and self.family.distances

    def surface(self, shape: Shape) -> Shape:
        return self.family.surface(shape, self.model.nodes)

    def began(self, state: State, bodies: Bodies, options: Options) -> State:
        from sdfsim.learned.surfaces import with_history

        return with_history(state, bodies, options)

    def announce(self, state: State, carry: Carry, changed: np.ndarray, *, gravity: bool = False) -> State:
        """Bodies that were changed have come from where their velocities lead from."""
        from sdfsim.learned.surfaces import with_history

        rows = torch.from_numpy(changed).to(carry.bodies.device)
        return with_history(super().announce(state, carry, changed), carry.bodies, carry.options, rows)

    def touching(self, state: State, carry: Carry | None) -> tuple[np.ndarray, np.ndarray, float]:
        """The edges were found at the start of the step; their points are told where `state` has the bodies."""
        if carry is None or carry.near is None or not len(near := carry.near):
            return super().touching(state, carry)
        from sdfsim.learned.near import where

        pairs = torch.stack([near.owner, near.body], -1).cpu().numpy()
        return where(state, carry.bodies, near).cpu().numpy(), pairs, float((-near.distance).clamp_min(0.0).max())

    def _step(self, state: State, carry: Carry) -> State:
        from sdfsim.learned.surfaces import compact, predict

        bodies, options, family = carry.bodies, carry.options, self.family
        if state.earlier_position is None:  # of a stepper that needs none
            state = self.began(state, bodies, options)
        free = super()._step(state, carry)
        with carry.timed("contact_ms"):
            near = family.none(bodies.device)
            if self.contact:
                near = family.near(bodies, state, options.gravity, self.model.reach, options.dt, carry.scene)
        active = torch.unique(torch.cat([near.owner, near.body, *([awake(bodies, state)] if self.learned else [])]))
        chosen = bodies.moves[active]
        carry.near = near
        carry.counts |= {"active": int(chosen.sum()), "contacts": len(near)}
        if not bool(chosen.any()):
            return free
        if not options.friction:
            bodies = replace(bodies, friction=torch.zeros_like(bodies.friction))
        if not options.restitution:
            bodies = replace(bodies, restitution=torch.zeros_like(bodies.restitution))
        with carry.timed("network_ms"):
            some, start, among = compact(bodies, state, near, active)
            graph = family.graph(some, start, among)
            predicted = predict(cast("Any", self.model.network), graph, some, start, options.dt)
        carry.counts |= {"nodes": len(graph), "edges": graph.edge_count}
        rows = active[chosen]
        orientation, angular = predicted.orientation[chosen], predicted.angular_velocity[chosen]
        if not options.rotation:
            orientation, angular = state.orientation[rows], torch.zeros_like(angular)
        now = {name: getattr(free, name) for name in MOTION}
        moved = (predicted.position[chosen], orientation, predicted.velocity[chosen], angular)
        return replace(free, **with_rows(now, rows, moved))


def stepper_of(model: Model, *, contact: bool = True, free_flight: FreeFlight = "exact") -> Stepper:
    """How a model steps scenes with `contact` or without. Only networks on surface nodes
    know "learned" free flight; raises SdfsimError for any other model."""
    learned, on_surfaces = free_flight == "learned", model.kind in SURFACE
    if learned and not on_surfaces:
        raise SdfsimError(
            "free_flight 'learned' exists for networks on surface nodes only", "give a model of that kind"
        )
    if not contact and not learned:
        return Stepper(model, mean=on_surfaces)
    if on_surfaces:
        from sdfsim.learned.families import FAMILIES

        return OnSurfaces(model, True, family=FAMILIES[model.kind], contact=contact, learned=learned)
    return Solver(model) if model.kind == SOLVER else OnSolver(model)
