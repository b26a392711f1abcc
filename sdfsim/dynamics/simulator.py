"""`Simulator`: a scene and a model in, a rollout out."""

from __future__ import annotations

import platform
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

import sdfsim
from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State, awake, from_scene
from sdfsim.dynamics.body_handle import BodyHandle, ContactPoint
from sdfsim.dynamics.earlier_poses import history_told, with_history
from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.models.contact_graph import SUBSTEPS
from sdfsim.dynamics.rollout import Rollout, join
from sdfsim.dynamics.run_memory import Memory
from sdfsim.dynamics.step import FreeFlight, StepOptions, step
from sdfsim.dynamics.training_ranges import deep_starts, outside_training
from sdfsim.dynamics.units import scene_units
from sdfsim.dynamics.validity import check_nodes, check_sizes, fault
from sdfsim.dynamics.variants import Variant, rollouts
from sdfsim.errors import EXIT_QUALITY, SdfsimError, nearest
from sdfsim.scene.effects import plan
from sdfsim.scene.scene import Limits, Scene

if TYPE_CHECKING:
    from sdfsim.dynamics.models.families import Near
    from sdfsim.scene import written

BYTES_AN_EDGE = 4096  # of the network, while it is worked on


class SimulationError(SdfsimError):
    """The state broke: the message names the step and the body, `rollout` has everything up to the last good state."""

    def __init__(self, message: str, rollout: Rollout) -> None:
        super().__init__(
            message, "try another model, or look for bodies that overlap at the start", exit_code=EXIT_QUALITY
        )
        self.rollout = rollout


class Simulator:
    """Simulates one scene.

    Args:
        scene: bodies, shapes, gravity; one written in Python is loaded first.
        model: bundled name, path or `Model`; None takes the scene's, else the default one.
        device: "cpu", "cuda" or "auto".
        seed: of torch's generator (nothing in a step draws from it today; it is recorded).
        dt: s, the step; None lets the size of the bodies decide (the model owns the step in its own units).
        free_flight: "exact", or "learned" for the own formulation of networks on surface nodes.

    Attributes:
        state: bodies and how they move, model units. Give it another one to start from there, or to change a body:
            `simulator.state = replace(simulator.state, velocity=...)`; its tensors are not to be written into.
        dt: s, the step in the scene's units.
        units: metres, seconds and kilograms per model unit.
        outside_training: what of the scene the model has not seen in training, one line each.

    Raises:
        SdfsimError: no such model or device, a step that is none, a body that moves without mass or without nodes
            that tell how it turns, one that is too large, too far away or too fast.
    """

    def __init__(
        self,
        scene: Scene | written.Scene,
        model: str | Path | Model | None = None,
        device: str = "cpu",
        seed: int | None = None,
        *,
        dt: float | None = None,
        free_flight: FreeFlight = "exact",
    ) -> None:
        scene = scene if isinstance(scene, Scene) else scene.load()
        self.scene = scene
        self.device = pick_device(device)
        effects = plan(scene)
        model = model if model is not None else scene.model
        asked = effects.contact.on or free_flight == "learned"
        self.model = model if isinstance(model, Model) else load_model(model, weights=asked)
        self.model = self.model.to(self.device)
        if not self.model.on_surfaces:
            self.device = torch.device("cpu")  # the compiled step has no other; a network on top may
        if free_flight == "learned" and not self.model.on_surfaces:
            raise SdfsimError(
                "free_flight 'learned' exists for networks on surface nodes only", "give a model of that kind"
            )
        self.seed = scene.seed if seed is None else seed
        self.units, self._dt = scene_units(scene, self.model, dt), dt
        self.dt = self.model.dt * self.units.time
        self.outside_training = outside_training([scene], self.model, self.units)
        gravity = torch.tensor(scene.gravity / self.units.acceleration, dtype=torch.float64, device=self.device)
        self.rules = StepOptions(
            gravity=gravity,
            dt=self.model.dt,
            falls=effects.gravity.on,
            contact=effects.contact.on,
            friction=effects.friction.on,
            restitution=effects.restitution.on,
            rotation=effects.rotation.on,
            free_flight=free_flight,
            substeps=self.model.inner or SUBSTEPS,
            rows=_rows(scene.limits),
            sleep=effects.sleep.on and not self.model.on_surfaces,
        )
        worked_on = replace(scene, shapes=tuple(self.model.surface(shape) for shape in scene.shapes))
        check_nodes(worked_on)
        self.bodies, self.state = from_scene(worked_on, self.units, self.device)
        self._names = tuple(b.name for b in scene.bodies)
        check_sizes(self.bodies, self._names, self.units.length)
        if effects.contact.on and self.model.ranges:
            self.outside_training += deep_starts(self.bodies, self.state, self._names, self.units.length)
        if self.outside_training:
            self.rules = replace(self.rules, trust=0.0)
        if self.model.on_surfaces:
            self.state = with_history(self.state, self.bodies, self.rules)
        self.memory = Memory()
        dynamic = self.bodies.moves
        weight = self.bodies.mass[dynamic] * self.rules.gravity.norm()
        self._lift = float((weight * self.bodies.size[dynamic]).sum()) * self.units.energy
        self.contacts: Near | None = None
        self.steps_done = 0
        if broken := self._fault(self.state, everybody(self.bodies)):
            raise SdfsimError(broken)
        self._good = self._start = self.state

    def steps(self, count: int) -> Iterator[State]:
        """Advance by `count` steps, yielding the state after each (SI units). Raises SimulationError for a state that
        cannot be; its `rollout` is one frame here, the last good state."""
        for _ in range(count):
            self._step()
            yield self.si_state()

    def frames(self, count: int) -> Iterator[Rollout]:
        """Advance by `count` steps, yielding a rollout of one frame after each; raises as `steps` does."""
        for _ in range(count):
            started = time.perf_counter()
            self._step()
            yield self._frame(1e3 * (time.perf_counter() - started))

    def step(self, count: int = 1) -> State:
        """Advance by `count` steps; the state after them (SI units). Raises as `steps` does."""
        for _ in range(count):
            self._step()
        return self.si_state()

    def reset(self) -> None:
        """Go back to the start of the scene."""
        self.state = self._good = self._start
        self.memory, self.contacts, self.steps_done = Memory(), None, 0

    def __getitem__(self, name: str) -> BodyHandle:
        """A body by its name. Raises SdfsimError where there is none of that name."""
        if name not in self._names:
            told = nearest(name, self._names)
            raise SdfsimError(f"there is no body {name!r}{told}", f"there are {', '.join(self._names[:20])}")
        return BodyHandle(self, self._names.index(name))

    def contact_points(self) -> list[ContactPoint]:
        """Where bodies touch in the present state, as the last step of the contact solve has left it. Raises
        SdfsimError for networks on surface nodes, which know no impulses."""
        if self.model.on_surfaces:
            raise SdfsimError(
                "networks on surface nodes tell no impulses", "take the solver, or a network on top of it"
            )
        from sdfsim.dynamics.solver import contact_points

        found, u = contact_points(self.state), self.units
        return [
            ContactPoint(
                first=self._names[found.pair[k, 0]],
                second=self._names[found.pair[k, 1]],
                point=found.point[k] * u.length,
                normal=found.normal[k],
                impulse=found.impulse[k] * u.mass * u.velocity,
                penetration=-float(found.gap[k]) * u.length,
            )
            for k in range(len(found.pair))
        ]

    def rollouts(
        self, variants: Sequence[Variant], seconds: float | None = None, steps: int | None = None
    ) -> list[Rollout]:
        """The scene from its start with some values changed, once for each variant, on all cores; the same as `run` of
        a `Simulator` of each changed scene.

        Variants map names of bodies to changed fields: position, quat_xyzw, velocity, angular_velocity, mass, friction,
        restitution (SI units), such as {"ball": {"velocity": (1, 0, 0)}}. Raises SdfsimError for no such body or field,
        or a value that it cannot have; SimulationError where a state broke.
        """
        return rollouts(self.scene, variants, self.model, seconds=seconds, steps=steps, dt=self._dt)

    def run(self, seconds: float | None = None, steps: int | None = None) -> Rollout:
        """Simulate for so many seconds (default: the scene's duration; see `steps_in`) or steps, and keep everything.

        Raises SdfsimError for a length of time that is negative or not finite; SimulationError where the state broke,
        with what was computed in its `rollout`.
        """
        if steps is None:
            steps = self.steps_in(self.scene.duration if seconds is None else seconds)
        frames = [self.initial_rollout()]
        try:
            for frame in self.frames(steps):
                frames.append(frame)
        except SimulationError as error:
            raise SimulationError(error.message, join(frames)) from None
        return join(frames)

    def steps_in(self, seconds: float) -> int:
        """The number of steps that comes nearest to `seconds`: none for 0 s, else at least one. Raises SdfsimError
        where that is negative or not finite."""
        check_seconds(seconds)
        return max(1, round(seconds / self.dt)) if seconds else 0

    def initial_rollout(self) -> Rollout:
        """The present state as a rollout of one frame; raises as `steps` does."""
        self._accept()
        return self._frame(0.0)

    def si_state(self) -> State:
        """The present state in metres and seconds, on the CPU."""
        s, u = self.state, self.units
        return State(
            position=(s.position * u.length).cpu(),
            orientation=s.orientation.cpu(),
            velocity=(s.velocity * u.velocity).cpu(),
            angular_velocity=(s.angular_velocity / u.time).cpu(),
            time=s.time * u.time,
        )

    def _step(self) -> None:
        self._accept()
        after, contacts = step(self.model, self.bodies, self.state, self.rules, self.memory)
        if broken := self._fault(after, awake(self.bodies, after), self.state):
            raise self._broke(broken)
        self.state, self.contacts = after, contacts
        self._good = after
        self.steps_done += 1

    def _accept(self) -> None:
        """A state that came from outside is looked at before anything is computed from it."""
        if self.state is self._good:
            return
        broken = self._fault(self.state, everybody(self.bodies))
        if broken is None and not np.isfinite(self.state.time):
            broken = "time is not finite"
        if broken:
            self.state = self._good
            raise self._broke(broken)
        if self.model.on_surfaces:
            self.state = history_told(self.state, self._good, self.bodies, self.rules)
        self._good = self.state

    def _fault(self, state: State, rows: torch.Tensor, before: State | None = None) -> str | None:
        found = fault(state, rows, self.rules.dt, self.units, before)
        return None if found is None else f"body {self._names[found[0]]!r}: {found[1]}"

    def _broke(self, what: str) -> SimulationError:
        last = f"the last good state is that of step {self.steps_done}, t = {self.steps_done * self.dt:.4g} s"
        return SimulationError(f"step {self.steps_done + 1}: {what}; {last}", self.initial_rollout())

    def _frame(self, milliseconds: float) -> Rollout:
        state, c, u = self.si_state(), self.contacts, self.units
        count = 0 if c is None else len(c)
        points, pairs, depth = np.zeros((0, 3)), np.zeros((0, 2), dtype=np.int64), 0.0
        if self.state.touch is not None:
            from sdfsim.dynamics.solver import contact_points

            found = contact_points(self.state)
            points, pairs, count = found.point * u.length, found.pair, len(found.pair)
            depth = float((-found.gap).max(initial=0.0)) * u.length
        if c is not None and count:
            from sdfsim.dynamics.models.paper_edges import where

            # The edges were found at the start of the step; their points are told where this frame has the bodies.
            points = (where(self.state, self.bodies, c) * u.length).cpu().numpy()
            pairs = torch.stack([c.owner, c.body], -1).cpu().numpy()
            depth = float((-c.distance).clamp_min(0.0).max()) * u.length
        counters = {
            **self._energies(),
            "contacts": float(count),
            "worst_penetration": depth,
            **self.memory.counts,
            "step_ms": milliseconds,
        }
        return Rollout(
            time=np.array([self.steps_done * self.dt]),
            position=state.position.numpy()[None],
            orientation=state.orientation.numpy()[None],
            velocity=state.velocity.numpy()[None],
            angular_velocity=state.angular_velocity.numpy()[None],
            contact_count=np.array([count]),
            contact_point=points,
            contact_body=pairs,
            counters={k: np.array([v]) for k, v in counters.items()},
            names=self._names,
            meta={
                "model": self.model.name,
                "seed": self.seed,
                "dt": self.dt,
                "device": str(self.device),
                "outside_training": self.outside_training,
                "free_flight": self.rules.free_flight,
                "lift_energy": self._lift,
                "sdfsim": sdfsim.__version__,
                "torch": torch.__version__,
                "python": platform.python_version(),
            },
        )

    def _energies(self) -> dict[str, float]:
        """Kinetic and potential energy in joules of all dynamic bodies."""
        s, b, joule = self.state, self.bodies, self.units.energy
        velocity, mass, inertia = (t.cpu().numpy() for t in (s.velocity, b.mass, b.inertia))
        # Bodies that are not dynamic have no mass, and an inertia that means nothing.
        spin = s.angular_velocity.cpu().numpy()[:, None] @ pose.to_matrix(s.orientation).cpu().numpy()
        turning = ((spin @ inertia)[:, 0] * spin[:, 0]).sum(-1)[b.moves.cpu().numpy()]
        moving = 0.5 * (mass @ np.square(velocity).sum(-1) + turning.sum())
        potential = -mass @ (s.position.cpu().numpy() @ self.rules.gravity.cpu().numpy())
        return {"kinetic_energy": float(moving) * joule, "potential_energy": float(potential) * joule}


def _rows(limits: Limits) -> int | None:
    """How many edges a network may work on at once, so that a step keeps to its memory; None for all."""
    return None if limits.memory_gib is None else max(1, int(limits.memory_gib * 2**30 / BYTES_AN_EDGE))


def everybody(bodies: Bodies) -> torch.Tensor:
    """[N] int64, all of them."""
    return torch.arange(len(bodies), device=bodies.device)


def check_seconds(seconds: float) -> None:
    """Raises SdfsimError where `seconds` is no length of time."""
    if not 0.0 <= seconds < np.inf:
        raise SdfsimError(f"seconds: must be >= 0 and finite (got {seconds:g})")


def pick_device(name: str) -> torch.device:
    """A device: "auto", "cpu", "cuda" or "cuda:0". Raises SdfsimError for another name, or where there is no CUDA."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name, re.ASCII):
        raise SdfsimError(f"device: {name!r} is not auto, cpu or cuda")
    place = torch.device(name)
    there = torch.cuda.is_available() and (place.index is None or place.index < torch.cuda.device_count())
    if place.type == "cuda" and not there:
        raise SdfsimError(f"--device {name}: no CUDA device here", "use --device cpu")
    return place
