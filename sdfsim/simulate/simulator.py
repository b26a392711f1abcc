"""`Simulator`: a scene and a model in, a rollout out."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sdfsim.base.compiling import running, say_compiling
from sdfsim.base.devices import check_device
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError, nearest
from sdfsim.base.parallel import Progress, parallel, silent, threads
from sdfsim.base.version import __version__
from sdfsim.learned.model import SOLVER, Model, load_model
from sdfsim.physics.bodies import Bodies, Moment, State, from_scene
from sdfsim.physics.joint_columns import TARGET
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.rollout import Rollout, join
from sdfsim.physics.steps import Frames, Steps
from sdfsim.physics.units import inner_steps
from sdfsim.physics.validity import Fault, check_nodes, check_sizes, first_fault
from sdfsim.scene.builder import loaded, plain, validated
from sdfsim.scene.plan import plan
from sdfsim.scene.scene import Body, Scene
from sdfsim.scene.schema import BodyTable
from sdfsim.simulate.body import BodyHandle, ContactPoint, LiveScene
from sdfsim.simulate.joint import JointHandle
from sdfsim.simulate.steppers import Carry, FreeFlight, energies_of, stacked, stepper_of

if TYPE_CHECKING:
    from sdfsim.physics.solver.prepare import SharedShapes
    from sdfsim.scene.builder import SceneBuilder

GLANCE = 0.1  # s between two progress reports
Variant = Mapping[str, Mapping[str, Any]]  # body -> field -> value
VARIED = ("position", "quat_xyzw", "velocity", "angular_velocity", "mass", "friction", "restitution")
CHUNKS = 16  # largest number of pieces that variants are cut into, so that all cores finish together


class SimulationError(SdfsimError):
    """The simulation reached an invalid state. The message names the step and the body; `rollout` has everything up to
    the last good state."""

    def __init__(self, message: str, rollout: Rollout) -> None:
        hint = "try another model, or look for bodies that overlap at the start"
        if rollout.joint_names:
            hint += "; light bodies that joints hold to heavy ones may need some damping in their joints"
        super().__init__(message, hint, exit_code=EXIT_QUALITY)
        self.rollout = rollout


class Simulator(LiveScene):
    """Simulates one scene.

        simulator = sdfsim.Simulator(sdfsim.load_scene("pile"))
        rollout = simulator.run(seconds=2.0)             # all of the motion: `Rollout`, arrays in SI units
        rollout.save("rollout.npz")

        simulator.reset()
        ball = simulator["ball"]                         # one body by its name: `BodyHandle`
        ball.velocity = (1.0, 0.0, 0.0)                  # m/s, from the next step on
        for state in simulator.steps(100):               # or `step(n)`: n steps at once
            print(state.time, ball.position, simulator.contact_points())

    Methods, in the order in which you may need them:

        run              all of the motion
        simulator[name]  a body: read it, set it, push it, pull it
        step, steps      make n steps: the state after all of them, or after each contact_points   contact points, with
        forces and normals joint            a joint by its name: its angle, its motor (`JointHandle`) reset back to the
        start state, restore   keep a state, and go back to it rollouts         many variants of the scene, on all cores
        frames           a run in pieces, to show it while it runs

    Args:
        scene: bodies, shapes, gravity. A scene written in Python, the path of a file or the name of a sample is loaded
            first.
        model: bundled name, path or `Model`; None: the scene's model, else the default.
        device: "cpu", "cuda" or "auto".
        seed: seed of torch's generator (recorded; no step uses random numbers today).
        dt: s, the step; None: the scene's, else by the size of the bodies (a model has a fixed step in its units).
        free_flight: "exact", or "learned": networks on surface nodes then predict it, as in the papers.

    Attributes:
        state: poses, velocities, contacts and more, model units; see `LiveScene`.
        options: gravity, the step and which effects are on, model units; assign to it to change them.
        stepper: the object that makes the steps.
        dt: s, the step in the scene's units.
        units: metres, seconds and kilograms per model unit.
        outside_training: in what ways the scene is beyond the model's training, one line each.

    Raises:
        SdfsimError: no such model or device, an invalid time step, a dynamic body without mass or without enough nodes
            to define its rotation, or a body that is too large, too far away or too fast.
    """

    def __init__(
        self,
        scene: Scene | SceneBuilder | Path | str,
        model: str | Path | Model | None = None,
        device: str = "cpu",
        seed: int | None = None,
        *,
        dt: float | None = None,
        free_flight: FreeFlight = "exact",
    ) -> None:
        say_compiling()
        self.scene = scene = loaded(scene)
        check_device(device)
        effects = plan(scene)
        model = model if model is not None else scene.model
        jointed = effects["joints"].on
        asked = effects["contact"].on or free_flight == "learned"
        model = model if isinstance(model, Model) else load_model(model, weights=asked)
        self._asked = {"dt": dt, "free_flight": free_flight}
        dt = scene.step if dt is None else dt
        stepper = stepper_of(model, contact=effects["contact"].on or jointed, free_flight=free_flight, device=device)
        if not stepper.forces:
            _check_inputs(scene, model.name, joints=jointed)
        self.stepper, self.model, self.device = stepper, stepper.model, str(stepper.device)
        self.seed = scene.seed if seed is None else seed
        self.units = stepper.units(scene, dt)
        self.dt = self.model.dt * self.units.time
        self.outside_training = stepper.unknown([scene], self.units)
        surfaces = tuple(stepper.surface(shape) for shape in scene.shapes)
        worked_on = replace(scene, shapes=surfaces, joints=scene.joints if jointed else ())
        check_nodes(worked_on)
        self.bodies, state = from_scene(worked_on, self.units)
        if jointed and not effects["contact"].on:
            self.bodies = replace(self.bodies, allowed=np.zeros_like(self.bodies.allowed))
        self._names = tuple(b.name for b in scene.bodies)
        self._joint_names = tuple(joint.name for joint in scene.joints)
        self._joint_unit = [1.0 if joint.kind in ("hinge", "ball") else self.units.length for joint in scene.joints]
        check_sizes(self.bodies, self._names, self.units.length)
        gravity = np.asarray(scene.gravity, dtype=np.float64) / self.units.acceleration
        self._carry: Carry | None = None
        self._shared: SharedShapes | None = None  # shared with simulators of other scenes
        self._si: tuple[State, Moment] | None = None  # a state, and the same in SI; later ones differ in some rows
        self._options = Options(
            gravity=gravity,
            dt=self.model.dt,
            friction=effects["friction"].on,
            restitution=effects["restitution"].on,
            rotation=effects["rotation"].on,
            substeps=inner_steps(scene),
            sleep=effects["sleep"].on and stepper.sleeps,
        )
        super().__init__(stepper.began(state, self.bodies, self._options))
        dynamic = self.bodies.moves
        weight = self.bodies.mass[dynamic] * np.linalg.norm(gravity)
        lift = float((weight * self.bodies.size[dynamic]).sum()) * self.units.energy
        self._meta = {
            "model": self.model.name,
            "seed": self.seed,
            "dt": self.dt,
            "device": self.device,
            "outside_training": self.outside_training,
            "free_flight": free_flight,
            "lift_energy": lift,
            "sdfsim": __version__,
            "python": platform.python_version(),
        }
        self.steps_done = 0
        self._given = 0.0  # energy from outside since the last frame, model units
        if broken := first_fault(self.state, self._options.dt):
            raise SdfsimError(self._described(broken))
        self._good = self._start = self.state

    def steps(self, count: int) -> Iterator[Moment]:
        """Advance by `count` steps, yielding the state after each (SI units). Raises SimulationError for an invalid
        state; its `rollout` has one frame here, the last good state."""
        for _ in range(_whole(count)):
            self._advance(1)
            yield self.si_state()

    def step(self, count: int = 1) -> Moment:
        """Advance by `count` steps, and return the state after them (SI units). Raises as `steps` does."""
        self._advance(_whole(count))
        return self.si_state()

    def frames(self, count: int, at_once: int | None = None) -> Iterator[Rollout]:
        """Advance by `count` steps, yielding new frames, several at a time, as a rollout. Raises as `steps` does, but
        the error's `rollout` has the frames since the last one that was yielded, up to the last good state; there may
        be none.

        `at_once` steps are made in one call of compiled code (None: as many as take about `GLANCE` seconds). This does
        not change results.
        """
        made, some = 0, max(1, at_once or 1)
        if count and not self.steps_done:
            self._advance(0, keep=True)  # so that compiling and loading do not count for the time of a step
        while made < count:
            some = min(some, count - made)
            started = running()
            kept = self._advance(some, keep=True).frames
            spent = running() - started
            yield self._rollout(cast("Frames", kept), 1e3 * spent / some)
            made += some
            if at_once is None:
                some = max(1, min(2 * some, int(some * GLANCE / max(spent, 1e-6))))

    @property
    def options(self) -> Options:
        return self._options

    @options.setter
    def options(self, options: Options) -> None:
        if not np.array_equal(options.gravity, self._options.gravity):
            self._accept()
            nobody = np.zeros(len(self.bodies), bool)
            self._state = self._good = self.stepper.announce(self._state, self.carry, nobody, nobody, gravity=True)
        self._options = options
        if self._carry is not None:
            self._carry.options, self._carry.weights, self._carry.tensors = options, None, None

    @property
    def carry(self) -> Carry:
        """What the stepper keeps from step to step; made on first use."""
        if self._carry is None:
            self._carry = self.stepper.init(self.bodies, self._state, self._options, self._shared)
            self._carry.checked = True
        return self._carry

    def reset(self) -> None:
        """Return to the start of the scene."""
        self.restore(self._start)

    def restore(self, state: State) -> None:
        """Continue from a state that steps have led to, in this or another simulator of the same scene. The motion
        continues as it would have there, bit by bit, and sleeping bodies sleep on. For a state that you have changed,
        set `state` instead. Raises SdfsimError for an invalid state, or a state of another scene."""
        self._fits(state)
        if broken := first_fault(state, self._options.dt):
            raise SdfsimError(self._described(broken))
        self._state = self._good = state
        self._handed = False
        self._changed.clear()
        self._carry, self._given = None, 0.0
        self.steps_done = round(state.time / self._options.dt)

    def __getitem__(self, name: str) -> BodyHandle:
        """A body by its name. Raises SdfsimError if no body has that name."""
        if name not in self._names:
            close = nearest(name, self._names)
            raise SdfsimError(f"there is no body {name!r}{close}", f"bodies are {', '.join(self._names[:20])}")
        return BodyHandle(self, self._names.index(name))

    def joint(self, name: str) -> JointHandle:
        """A joint by its name. Raises SdfsimError if no joint has that name."""
        names = [joint.name for joint in self.scene.joints]
        if name not in names:
            suggestion = nearest(name, names)
            known = f"joints are {', '.join(names[:20])}" if names else "the scene has no joints"
            raise SdfsimError(f"there is no joint {name!r}{suggestion}", known)
        return JointHandle(self, names.index(name))

    def contact_points(self) -> list[ContactPoint]:
        """The points where bodies touch in the present state, as the last step of the contact solve left them. Raises
        SdfsimError for networks, which report no impulses."""
        if not self.stepper.forces:
            raise SdfsimError("networks report no impulses of contacts", "use the solver")
        from sdfsim.physics.solver.prepare import contact_points

        found, u = contact_points(self.state), self.units
        return [
            ContactPoint(
                first=self._names[found.pair[k, 0]],
                second=self._names[found.pair[k, 1]],
                point=found.point[k] * u.length,
                normal=found.normal[k],
                impulse=found.impulse[k] * u.mass * u.velocity,
                force=found.impulse[k] * u.mass * u.velocity * self._options.substeps / self.dt,
                penetration=-float(found.gap[k]) * u.length,
            )
            for k in range(len(found.pair))
        ]

    def rollouts(
        self, variants: Sequence[Variant], seconds: float | None = None, steps: int | None = None,
        on_progress: Progress = silent,
    ) -> list[Rollout]:  # fmt: skip
        """Simulate the scene from its start, once for each variant, with some values changed, on all cores. The results
        are those of `run` of a `Simulator` for each changed scene, with the model, device, seed, step and free flight
        of this one.

        Variants map names of bodies to changed fields: position, quat_xyzw, velocity, angular_velocity, mass, friction,
        restitution (SI units), such as {"ball": {"velocity": (1, 0, 0)}}. `on_progress` is called as variants finish.
        Raises SdfsimError for an unknown body or field, or an invalid value, and SimulationError for an invalid state.
        """
        scenes = [varied(self.scene, variant) for variant in variants]
        same = {"device": self.device, "seed": self.seed, **self._asked}
        return run_all(scenes, self.model, seconds, steps, on_progress, **same)

    def run(self, seconds: float | None = None, steps: int | None = None, on_progress: Progress = silent) -> Rollout:
        """Simulate for `seconds` (default: the scene's duration; see `steps_in`) or `steps`, and keep all frames.
        `on_progress` is called a few times a second with the share that is done, 0 to 1, and a line of text.

        Raises SdfsimError if `seconds` is negative or not finite, and SimulationError for an invalid state; its
        `rollout` has the frames before.
        """
        if steps is None:
            steps = self.steps_in(self.scene.duration if seconds is None else seconds)
        parts = [self.initial_rollout()]
        try:
            for part in self.frames(steps):
                parts.append(part)
                done = sum(map(len, parts[1:])) + len(parts) - 1  # a rollout of k frames has k - 1 steps
                on_progress(done / steps, f"{done} of {steps} steps")
        except SimulationError as error:
            raise SimulationError(error.message, join([*parts, error.rollout])) from None
        return join(parts)

    def steps_in(self, seconds: float) -> int:
        """The number of steps nearest to `seconds`: none for 0 s, else at least one. Raises SdfsimError if `seconds` is
        negative or not finite."""
        check_seconds(seconds)
        return max(1, round(seconds / self.dt)) if seconds else 0

    def initial_rollout(self) -> Rollout:
        """The current state as a rollout of one frame. Raises as `steps` does."""
        self._accept()
        state, counts = self._state, {} if self._carry is None else self._carry.counts
        one = state, 0.0, counts, self.stepper.touching(state, self._carry)
        return self._rollout(stacked(state, [one], self.bodies, self._options), 0.0)

    def si_state(self) -> Moment:
        """Motion and time of the current state, in metres and seconds. To return to it later, keep `state` instead."""
        u, state = self.units, self.state

        def whole(state: State) -> Moment:
            moved: dict[str, Any] = u.in_si(state)
            return Moment(**moved, time=state.time * u.time)

        if (parts := state.parts) is None:
            return whole(state)
        before, rows, changed = parts
        if self._si is None or self._si[0] is not before:
            self._si = before, whole(before)
        moved = {name: changed[name] * unit for name, unit in u.motion.items() if name in changed}
        return self._si[1].with_rows(rows, moved, time=state.time * u.time)

    def _advance(self, count: int, *, keep: bool = False) -> Steps:
        """Make `count` steps, in one call if the stepper can."""
        self._accept(keep=keep)
        made = self.stepper.advance(self._state, self.carry, max(0, count), keep=keep)
        self._state = self._good = made.state
        self.steps_done += made.done
        if not keep:
            self._given += made.given
        if made.fault is not None:
            raise self._broke(self._described(made.fault), made.frames)
        return made

    def _accept(self, *, keep: bool = False) -> None:
        """Check the user's changes before anything is computed from them, and announce them to the stepper. Raises
        SimulationError for an invalid state; its rollout has no frames if the caller keeps the earlier ones
        (`keep`)."""
        if not (self._handed or self._changed):
            return
        state, good, changed = self._state, self._good, np.zeros(len(self.bodies), bool)
        changed[list(self._changed)] = True
        if self._handed:
            changed |= differing(self.bodies, state, good)
        self._handed = False
        self._changed.clear()
        found = first_fault(state, self._options.dt)
        broken = None if found is None else self._described(found)
        if broken is None and not np.isfinite(state.time):
            broken = "time is not finite"
        if broken:
            self._state = good
            raise self._broke(broken, stacked(good, [], self.bodies, self._options) if keep else None)
        gravity = self._options.gravity
        self._given += sum(energies_of(self.bodies, state, gravity)) - sum(energies_of(self.bodies, good, gravity))
        self._state = self._good = self.stepper.announce(state, self.carry, changed, differing_motion(state, good))

    def _described(self, fault: Fault) -> str:
        return f"body {self._names[fault.body]!r}: {fault.described(self.units, self._options.dt)}"

    def _broke(self, what: str, frames: Frames | None = None) -> SimulationError:
        """The error, with the `frames` up to the last good state, or that state alone."""
        last = f"the last good state is that of step {self.steps_done}, t = {self.steps_done * self.dt:.4g} s"
        message = f"step {self.steps_done + 1}: {what}; {last}"
        known = self.initial_rollout() if frames is None else self._rollout(frames, 0.0)
        return SimulationError(message, known)

    def _rollout(self, frames: Frames, milliseconds: float) -> Rollout:
        """Frames up to the present step in SI units, each of which took `milliseconds`."""
        u, k = self.units, len(frames.depth)
        given = frames.energy[:, 2].copy()
        if k:
            given[0] += self._given
            self._given = 0.0
        counters = {
            "kinetic_energy": frames.energy[:, 0] * u.energy,
            "potential_energy": frames.energy[:, 1] * u.energy,
            "energy_given": given * u.energy,
            "contacts": frames.touching.astype(float),
            "worst_penetration": frames.depth * u.length,
            **frames.counts,
            "step_ms": np.full(k, milliseconds),
        }
        return Rollout(
            time=np.arange(self.steps_done - k + 1, self.steps_done + 1) * self.dt,
            **u.in_si(frames),
            contact_count=frames.touching,
            contact_point=frames.point * u.length,
            contact_body=frames.pair,
            counters=counters,
            names=self._names,
            meta=self._meta,
            joint_names=self._joint_names if frames.joint.shape[1] else (),
            joint_position=frames.joint[:, :, 0] * self._joint_unit if frames.joint.shape[1] else frames.joint[:, :, 0],
            joint_force=frames.joint[:, :, 1:4] * u.mass * u.acceleration,
            joint_torque=frames.joint[:, :, 4:7] * u.energy,
        )


def _check_inputs(scene: Scene, model: str, *, joints: bool) -> None:
    """Raise SdfsimError if a scene has parts for which networks have no inputs."""
    paths = [b.name for b in scene.bodies if b.motion == "kinematic"]
    if joints:
        raise SdfsimError(f"{model}: a network has no inputs for joints", f"use {SOLVER}, or set effects.joints: off")
    if paths:
        raise SdfsimError(
            f"{model}: a network has no inputs for bodies on a path ({paths[0]!r})", f"use {SOLVER}, or make it static"
        )


def _whole(count: int) -> int:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
        raise SdfsimError(f"steps: must be a whole number >= 0 (got {count!r})", "steps_in(seconds) gives the number")
    return int(count)


def differing(bodies: Bodies, state: State, other: State) -> np.ndarray:
    """[N] bool, the bodies whose motion, pulling force or motors differ between the two states."""
    found = differing_motion(state, other)
    pulled = [np.zeros((1, 6)) if one.load is None else one.load for one in (state, other)]
    found |= np.any(pulled[0] != pulled[1], axis=-1)
    if bodies.joints is not None and state.joints is not None and other.joints is not None:
        numbers = [bodies.joints.number if one.drive is None else one.drive for one in (state, other)]
        driven = (state.joints[:, TARGET] != other.joints[:, TARGET]) | np.any(numbers[0] != numbers[1], axis=-1)
        held = bodies.joints.body[driven]
        found[held[held >= 0]] = True
    return found


def differing_motion(state: State, other: State) -> np.ndarray:
    """[N] bool, the bodies whose pose or velocities differ between the two states."""
    found = np.zeros(len(state.position), bool)
    for name in MOTION:
        found |= np.any(getattr(state, name) != getattr(other, name), axis=-1)
    return found


def varied(scene: Scene, variant: Variant) -> Scene:
    """The scene with some of the fields `VARIED` changed, in SI units, with the limits of a scene file. A body's own
    inertia scales with its mass. Raises SdfsimError for an unknown body or field, or an invalid value."""
    known = {body.name for body in scene.bodies}
    for name in variant:
        if name not in known:
            raise SdfsimError(f"variant: there is no body {name!r}{nearest(name, known)}")
    return replace(scene, bodies=tuple(_changed(body, variant.get(body.name, {})) for body in scene.bodies))


def _changed(body: Body, fields: Mapping[str, Any]) -> Body:
    what = f"variant: body {body.name!r}"
    for name in fields:
        if name not in VARIED:
            raise SdfsimError(f"{what}: {name}: no such field{nearest(name, VARIED)}; fields are {', '.join(VARIED)}")
        if body.motion != "dynamic" and name in ("velocity", "angular_velocity", "mass"):
            raise SdfsimError(f"{what}: is {body.motion}, so it has no {name}")
        if body.path is not None and name in ("position", "quat_xyzw"):
            raise SdfsimError(f"{what}: is on a path, so its {name} cannot be changed", "change the path in the scene")
    (table,) = validated(what, (BodyTable, plain({"name": body.name, "shape": "its own", **fields})))
    values = {name: getattr(table, name) for name in fields}
    new: dict[str, Any] = {name: np.array(v) if isinstance(v, list) else v for name, v in values.items()}
    if "mass" in new and body.inertia is not None:
        new["inertia"] = body.inertia * (new["mass"] / body.mass)
    return replace(body, **new)


def run_all(
    scenes: Sequence[Scene], model: Model | None = None, seconds: float | None = None, steps: int | None = None,
    on_progress: Progress = silent, **options: Any,
) -> list[Rollout]:  # fmt: skip
    """`run` of a `Simulator` for every scene, made with these options, on all cores: in threads if the steps are
    compiled code that does not need Python and has no threads of its own, else in processes. Raises as these do."""
    from sdfsim.physics.solver.prepare import CROWD, SharedShapes  # numba is slow to load

    model = model or load_model()
    few = all(sum(b.motion == "dynamic" for b in scene.bodies) < CROWD for scene in scenes)
    pieces = np.array_split(np.arange(len(scenes)), min(CHUNKS, max(1, len(scenes))))
    together = few and model.kind == SOLVER
    shared = SharedShapes() if together else None
    jobs = [([scenes[k] for k in piece], model, options, seconds, steps, shared) for piece in pieces]
    found: dict[int, list[Rollout]] = {}
    for k, ended in (threads if together else parallel)(_run_each, jobs):
        found[k] = ended
        done = sum(map(len, found.values()))
        on_progress(done / len(scenes), f"{done} of {len(scenes)} scenes")
    return [rollout for k in range(len(jobs)) for rollout in found[k]]


def _run_each(
    scenes: list[Scene], model: Model, options: dict[str, Any], seconds: float | None, steps: int | None,
    shared: SharedShapes | None,
) -> list[Rollout]:  # fmt: skip
    found = []
    for scene in scenes:
        simulator = Simulator(scene, model, **options)
        simulator._shared = shared
        found.append(simulator.run(seconds, steps))
    return found


def check_seconds(seconds: float) -> None:
    """Raises SdfsimError if `seconds` is negative or not finite."""
    if not 0.0 <= seconds < np.inf:
        raise SdfsimError(f"seconds: must be >= 0 and finite (got {seconds:g})")
