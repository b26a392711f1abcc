"""`Simulator`: a scene and a model in, a rollout out."""

from __future__ import annotations

import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

import numpy as np

from sdfsim.base.compiling import running, say_compiling
from sdfsim.base.devices import check_device
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError, nearest
from sdfsim.base.parallel import Progress, parallel, silent, threads
from sdfsim.base.version import __version__
from sdfsim.learned.model import SOLVER, Model, load_model
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, Moment, State, Units, from_scene
from sdfsim.physics.joint_columns import BROKEN, COORD, DRIVE, TARGET
from sdfsim.physics.joints import speeds
from sdfsim.physics.motion import MOTION
from sdfsim.physics.options import Options
from sdfsim.physics.rollout import Rollout, join
from sdfsim.physics.steps import Frames
from sdfsim.physics.units import inner_steps
from sdfsim.physics.validity import Fault, check_nodes, check_sizes, first_fault
from sdfsim.scene.builder import BodyKeys, SceneBuilder, loaded, plain, validated
from sdfsim.scene.plan import plan
from sdfsim.scene.scene import Body, Keyframe, Scene
from sdfsim.scene.schema import BodyTable
from sdfsim.simulate.body import BodyHandle, ContactPoint
from sdfsim.simulate.joint import Jointed, JointHandle
from sdfsim.simulate.record import Recording
from sdfsim.simulate.steppers import Carry, FreeFlight, energies_of, stacked, stepper_of

if TYPE_CHECKING:
    from sdfsim.physics.solver.prepare import SharedShapes

GLANCE = 0.1  # s between two progress reports
Variant = Mapping[str, Mapping[str, Any]]  # body -> field -> value
VARIED = ("position", "quat_xyzw", "velocity", "angular_velocity", "mass", "friction", "restitution", "scale")
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


@dataclass(frozen=True)
class Snapshot:
    """A moment of a simulator with all that a `State` leaves out: the scene and the options at that time."""

    state: State
    attributes: Mapping[str, Any]


class Simulator(Jointed):
    """Simulates one scene.

        simulator = sdfsim.Simulator(sdfsim.load_scene("pile"))
        rollout = simulator.run(seconds=2.0)             # all of the motion: `Rollout`, arrays in SI units
        rollout.save("rollout.npz")

        simulator.reset()
        ball = simulator["ball"]                         # one body by its name: `BodyHandle`
        ball.velocity = (1.0, 0.0, 0.0)                  # m/s, from the next step on
        for state in simulator.steps(100):               # or `step(n)`: n steps at once
            print(state.time, ball.position, simulator.contact_points())

    What you may need, in this order:

        run                           all of the motion
        simulator[name]               a body: read it, set it, push it, pull it (`BodyHandle`)
        step, steps                   make n steps: the state after all of them, or after each
        contact_points                where bodies touch, with forces and normals
        joint, frame                  a joint with its motor (`JointHandle`), a named pose
        set_joints, jacobian, mass_matrix
        reset                         back to the start, or to a keyframe
        state, restore                keep a state, and go back to it
        snapshot, rewind              the same with the scene and the options
        record                        keep what your own steps do
        rollouts                      many variants of the scene, on all cores
        frames                        a run in pieces, to show it while it runs
        add, remove                   bodies, while it runs

    Args:
        scene: bodies, shapes, gravity. A scene written in Python, the path of a file or the name of a sample is loaded
            first.
        model: bundled name, path or `Model`; None: the scene's model, else the default.
        device: "cpu", "cuda" or "auto".
        seed: seed of torch's generator (recorded; no step uses random numbers).
        dt: s, the step; None: the scene's, else by the size of the bodies (a model has a fixed step in its units).
        free_flight: "exact", or "learned": networks on surface nodes then predict it, as in the papers.
        units: those of another simulator, for states that the two share; None: by the bodies.

    Attributes:
        state: poses, velocities, contacts and more, model units: `State`.
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
        units: Units | None = None,
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
        self.units = units or stepper.units(scene, dt)
        self.dt = self.model.dt * self.units.time
        self.outside_training = stepper.unknown([scene], self.units)
        surfaces = tuple(stepper.surface(shape) for shape in scene.shapes)
        worked_on = replace(scene, shapes=surfaces, joints=scene.joints if jointed else ())
        check_nodes(worked_on)
        self.bodies, state = from_scene(worked_on, self.units)
        if jointed and not effects["contact"].on:
            self.bodies = replace(self.bodies, allowed=np.zeros_like(self.bodies.allowed))
        self._names = tuple(b.name for b in scene.bodies)
        self._recordings: list[Recording] = []
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
            part = self._advance(some, keep=True)
            spent = running() - started
            yield cast("Rollout", part)
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
            if self._shared is None and self.stepper.distances:
                from sdfsim.physics.solver.prepare import SharedShapes

                self._shared = SharedShapes()  # so that `restore` and `add` do not compile shapes again
            self._carry = self.stepper.init(self.bodies, self._state, self._options, self._shared)
            self._carry.checked = True
        return self._carry

    def reset(self, keyframe: str | None = None) -> None:
        """Return to the start of the scene, with the joints and free bodies of a `keyframe` of the scene at rest there;
        motors that go to a position aim at it. Raises SdfsimError if no keyframe has that name."""
        known = self.scene.keyframes
        if keyframe is not None and keyframe not in known:
            there = f"keyframes are {', '.join(known)}" if known else "the scene has no keyframes"
            raise SdfsimError(f"there is no keyframe {keyframe!r}{nearest(keyframe, known)}", there)
        self._return(self._start)
        if keyframe is not None:
            self._pose_as(known[keyframe])
        self._cut()

    def restore(self, state: State) -> None:
        """Continue from a state that steps have led to, in this or another simulator of the same scene. The motion
        continues as it would have there, bit by bit, and sleeping bodies sleep on. For a state that you have changed,
        set `state` instead. Raises SdfsimError for an invalid state, or a state of another scene."""
        self._return(state)
        self._cut()

    def _return(self, state: State) -> None:
        self._fits(state)
        if broken := first_fault(state, self._options.dt):
            raise SdfsimError(self._described(broken))
        self._state = self._good = state
        self._handed = False
        self._changed.clear()
        self._carry, self._given = None, 0.0
        self.steps_done = round(state.time / self._options.dt)

    def _cut(self) -> None:
        for recording in self._recordings:
            recording.cut(self._driven(self.initial_rollout()))

    def snapshot(self) -> Snapshot:
        """This moment, with the scene and the options. `rewind` returns to it exactly, whatever was changed since."""
        left_out = ("_carry", "_recordings", "_shared", "_si")
        return Snapshot(self.state, {name: value for name, value in vars(self).items() if name not in left_out})

    def rewind(self, snapshot: Snapshot) -> None:
        """Return to a `snapshot` of this simulator: bodies that were added since are gone, and removed ones are
        back."""
        vars(self).update(snapshot.attributes, _si=None, _changed=set())
        self.restore(snapshot.state)

    @contextmanager
    def record(self) -> Iterator[Recording]:
        """Keep the frames of all steps that are made inside a `with` block. Its `rollout` has them so far, also after
        the block: `with simulator.record() as run: ...`."""
        recording = Recording(self._driven(self.initial_rollout()))
        self._recordings.append(recording)
        try:
            yield recording
        finally:
            self._recordings.remove(recording)

    def alter(self, name: str, **fields: float) -> None:
        """Give a body another mass, friction or restitution, from the next step on, with the limits of a scene file;
        its inertia scales with its mass. Handles of bodies do the same: `simulator["ball"].friction = 0.2`."""
        self._accept()
        row, old = self._row(name), self.scene
        body = _changed(old.bodies[row], fields, f"body {name!r}")
        self.scene = replace(old, bodies=(*old.bodies[:row], body, *old.bodies[row + 1 :]))
        ratio = body.mass / old.bodies[row].mass if "mass" in fields else 1.0
        gravity, before = self._options.gravity, self.bodies
        factors = {"mass": ratio, "inertia": ratio, "inverse_mass": 1.0 / ratio}
        arrays = {key: getattr(before, key).copy() for key in (*factors, "friction", "restitution")}
        for key, factor in factors.items():
            arrays[key][row] *= factor
        arrays["friction"][row], arrays["restitution"][row] = body.friction, body.restitution
        self.bodies = replace(before, **arrays)
        energy = [sum(energies_of(bodies, self._state, gravity)) for bodies in (before, self.bodies)]
        self._given += energy[1] - energy[0]
        if self._carry is not None:
            self._carry.bodies, self._carry.weights, self._carry.tensors = self.bodies, None, None
            if self._carry.scene is not None:
                self._carry.scene.revise(self.bodies)
        known, found = plan(old), plan(self.scene)
        switched = {key: found[key].on for key in ("friction", "restitution") if found[key].on != known[key].on}
        self.options = self._options._replace(**switched)
        self._changed.add(row)

    def add(self, name: str, **keys: Unpack[BodyKeys]) -> BodyHandle:
        """Add a body while the simulation runs, with the keys of `Scene.add`; `become` says what stays. Raises
        SdfsimError as `Scene.add` and `Simulator` do."""
        if name in self._names:
            raise SdfsimError(f"body {name!r}: two bodies have this name", "give each a name of its own")
        made, (shapes, bodies) = SceneBuilder().add(name, **keys).load(), (self.scene.shapes, self.scene.bodies)
        new = tuple(replace(body, shape=body.shape + len(shapes)) for body in made.bodies)
        self.become(replace(self.scene, shapes=shapes + made.shapes, bodies=bodies + new))
        return self[made.bodies[0].name]

    def remove(self, name: str) -> None:
        """Remove a body and its joints while the simulation runs; bodies that lay on it wake."""
        row, scene = self._row(name), self.scene
        number = {k: k - (k > row) for k in range(-1, len(scene.bodies))} | {-1: -1}
        kept = [k for k, joint in enumerate(scene.joints) if row not in joint.bodies]
        joints = [scene.joints[k] for k in kept]
        joints = [replace(j, bodies=(number[j.bodies[0]], number[j.bodies[1]])) for j in joints]
        names = {joint.name for joint in joints}
        keys = {
            key: Keyframe(**{
                field: {of: value for of, value in values.items() if of in names or (field == "bodies" and of != name)}
                for field, values in vars(known).items()
            })
            for key, known in scene.keyframes.items()
        }  # fmt: skip
        self.become(replace(
            scene, bodies=scene.bodies[:row] + scene.bodies[row + 1 :], joints=tuple(joints), keyframes=keys,
            frames=tuple(replace(f, body=number[f.body]) for f in scene.frames if f.body != row),
            couplings=tuple(
                replace(c, joints=(kept.index(c.joints[0]), kept.index(c.joints[1])))
                for c in scene.couplings if {*c.joints} <= {*kept}
            ),
        ))  # fmt: skip

    def become(self, scene: Scene) -> None:
        """Go on with another scene, in which bodies may be added at the end or removed. Bodies and joints of the same
        names go on as they are; so do contacts and sleep, unless the new bodies change the step. Recordings begin anew.
        Raises SdfsimError as `Simulator` does, and then nothing has changed."""
        self._accept()
        moment, was, before = self.si_state(), self._state, {name: k for k, name in enumerate(self._names)}
        row = np.array([before.get(body.name, -1) for body in scene.bodies])
        bodies = list(scene.bodies)
        for k in np.flatnonzero(row >= 0):
            arm = pose.rotate(moment.orientation[row[k]], self.bodies.com[row[k]]) * self.units.length
            bodies[k] = replace(
                bodies[k], position=moment.position[row[k]] - arm, quat_xyzw=moment.orientation[row[k]],
                velocity=moment.velocity[row[k]], angular_velocity=moment.angular_velocity[row[k]],
            )  # fmt: skip
        units = self.stepper.units(scene, self._asked["dt"])
        same = (units.length, units.time) == (self.units.length, self.units.time)
        units = replace(units, mass=self.units.mass)
        new = Simulator(replace(scene, bodies=tuple(bodies)), self.model, self.device, self.seed, units=units,
                        **self._asked)  # fmt: skip
        gone = np.setdiff1d(np.arange(len(before)), row)
        ratio = self.units.length / units.length
        state = replace(new._state, time=was.time * self.units.time / units.time)
        if was.load is not None:
            load = np.where(row[:, None] >= 0, was.load[row], 0.0) * self.units.acceleration / units.acceleration
            load[:, 3:] *= ratio
            state = replace(state, load=load if load.any() else None)
        if same:
            state = carried(self.bodies, was, state, row, gone)
        if state.joints is not None and was.joints is not None:
            state = self._with_joints(new, state, was, same=same)
        kept = {name: vars(self)[name] for name in ("_recordings", "_shared")}
        new._state = new._good = state
        new.steps_done = round(state.time / new._options.dt)
        vars(self).update(vars(new), **kept)  # handles, and whoever else knows this simulator, go on with it
        for recording in self._recordings:
            recording.begin(self._driven(self.initial_rollout()))

    def _with_joints(self, new: Simulator, state: State, was: State, *, same: bool) -> State:
        """The `state` of `new` with the joints of `was`. In other units (unless `same`) the impulses are unknown, and
        numbers of motors that a user has changed are again those of the scene."""
        assert was.joints is not None and state.joints is not None
        known = np.array([self._joint_names.index(name) for name in new._joint_names], int)
        joints = was.joints[known].copy()
        if not same:
            unit = np.array(self._joint_unit)[known] / np.array(new._joint_unit)
            joints = state.joints.copy()
            joints[:, COORD], joints[:, BROKEN] = was.joints[known, COORD] * unit, was.joints[known, BROKEN]
            joints[:, TARGET] = was.joints[known, TARGET] * unit
        return replace(state, joints=joints, drive=was.drive[known] if same and was.drive is not None else None)

    def __getitem__(self, name: str) -> BodyHandle:
        """A body by its name. Raises SdfsimError if no body has that name."""
        self._row(name)
        return BodyHandle(self, name)

    def _row(self, name: str) -> int:
        if name not in self._names:
            close = nearest(name, self._names)
            raise SdfsimError(f"there is no body {name!r}{close}", f"bodies are {', '.join(self._names[:20])}")
        return self._names.index(name)

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
        restitution, scale (SI units), such as {"ball": {"velocity": (1, 0, 0)}}. `on_progress` is called as variants
        finish. Raises SdfsimError for an unknown body or field, or an invalid value, and SimulationError for an invalid
        state.
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
        one, given = (state, 0.0, counts, self.stepper.touching(state, self._carry)), self._given
        first = self._rollout(stacked(state, [one], self.bodies, self._options), 0.0, told=True)
        self._given = given if self._recordings else 0.0  # a recording has yet to count it
        return first

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

    def _advance(self, count: int, *, keep: bool = False) -> Rollout | None:
        """Make `count` steps, in one call if the stepper can. Returns their frames with `keep`, or if somebody
        records."""
        if self._recordings and count > 1:  # one by one: efforts and forces are known after each
            return self._one_by_one(count, keep=keep)
        self._accept(keep=keep)
        started = running()
        made = self.stepper.advance(self._state, self.carry, max(0, count), keep=keep or bool(self._recordings))
        self._state = self._good = made.state
        self.steps_done += made.done
        part = None
        if made.frames is None:
            self._given += made.given
        else:
            spent = 1e3 * (running() - started) / max(made.done, 1)
            part = self._rollout(made.frames, spent, told=bool(self._recordings))
            for recording in self._recordings:
                recording.add(self._driven(part))
        if made.fault is not None:
            raise self._broke(self._described(made.fault), part if keep else None)
        return part

    def _one_by_one(self, count: int, *, keep: bool) -> Rollout | None:
        parts: list[Rollout] = []
        for _ in range(count):
            try:
                part = self._advance(1, keep=keep)
            except SimulationError as error:
                if not keep:
                    raise
                raise SimulationError(error.message, join([*parts, error.rollout])) from None
            parts += [] if part is None else [part]
        return join(parts) if keep else None

    def _driven(self, part: Rollout) -> Rollout:
        """The frames of steps in which motors did not change, with their targets and efforts as counters."""
        found = {}
        for k, joint in enumerate(self.scene.joints if part.joint_names else ()):
            if joint.kind in ("hinge", "slider"):
                handle = JointHandle(self, k)
                found[f"target_{joint.name}"] = handle.target if handle.max_force else None
                found[f"effort_{joint.name}"] = handle.effort
        counters = {key: np.full(len(part.time), np.nan if v is None else v) for key, v in found.items()}
        return replace(part, counters=part.counters | counters)

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
            nothing = stacked(good, [], self.bodies, self._options)
            raise self._broke(broken, self._rollout(nothing, 0.0) if keep else None)
        gravity = self._options.gravity
        self._given += sum(energies_of(self.bodies, state, gravity)) - sum(energies_of(self.bodies, good, gravity))
        self._state = self._good = self.stepper.announce(state, self.carry, changed, differing_motion(state, good))

    def _described(self, fault: Fault) -> str:
        return f"body {self._names[fault.body]!r}: {fault.described(self.units, self._options.dt)}"

    def _broke(self, what: str, frames: Rollout | None = None) -> SimulationError:
        """The error, with the `frames` up to the last good state, or that state alone."""
        last = f"the last good state is that of step {self.steps_done}, t = {self.steps_done * self.dt:.4g} s"
        message = f"step {self.steps_done + 1}: {what}; {last}"
        return SimulationError(message, self.initial_rollout() if frames is None else frames)

    def _rollout(self, frames: Frames, milliseconds: float, *, told: bool = False) -> Rollout:
        """Frames up to the present step in SI units, each of which took `milliseconds`; `told`: a single one has the
        efforts and forces of the present state."""
        u, k = self.units, len(frames.depth)
        given = frames.energy[:, 2].copy()
        if k:
            given[0] += self._given
            self._given = 0.0
        jointed, moved = frames.joint.shape[1] > 0, u.in_si(frames)
        force = np.full((len(frames.pair), 3), np.nan)
        effort = np.full(frames.joint.shape[:2], np.nan)
        if told and k == 1 and self.stepper.forces:
            force = np.array([contact.force for contact in self.contact_points()]).reshape(-1, 3)
            if jointed and self._state.joints is not None:
                strength = u.energy / np.array(self._joint_unit) * self._options.substeps / self._options.dt
                effort = self._state.joints[None, :, DRIVE + 1] * strength
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
            **moved,
            contact_count=frames.touching,
            contact_point=frames.point * u.length,
            contact_body=frames.pair,
            contact_force=force,
            counters=counters,
            names=self._names,
            meta=self._meta,
            joint_names=self._joint_names if jointed else (),
            joint_position=frames.joint[:, :, 0] * self._joint_unit if jointed else frames.joint[:, :, 0],
            joint_velocity=self._joint_speeds(frames) if jointed else frames.joint[:, :, 0],
            joint_effort=effort,
            joint_force=frames.joint[:, :, 1:4] * u.mass * u.acceleration,
            joint_torque=frames.joint[:, :, 4:7] * u.energy,
        )

    def _joint_speeds(self, frames: Frames) -> np.ndarray:
        """[K, J] rad/s and m/s."""
        assert self.bodies.joints is not None
        return speeds(self.bodies.joints, frames) * self._joint_unit / self.units.time


def _check_inputs(scene: Scene, model: str, *, joints: bool) -> None:
    """Raise SdfsimError if a scene has parts for which networks have no inputs."""
    paths = [b.name for b in scene.bodies if b.motion == "kinematic"]
    if joints:
        raise SdfsimError(f"{model}: a network has no inputs for joints", f"use {SOLVER}, or set effects.joints: off")
    if soft := [b.name for b in scene.bodies if math.isfinite(b.stiffness)]:
        hint = f"use {SOLVER}, or leave its stiffness out"
        raise SdfsimError(f"{model}: a network has no inputs for soft material ({soft[0]!r})", hint)
    if paths:
        raise SdfsimError(
            f"{model}: a network has no inputs for bodies on a path ({paths[0]!r})", f"use {SOLVER}, or make it static"
        )


def _whole(count: int) -> int:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
        raise SdfsimError(f"steps: must be a whole number >= 0 (got {count!r})", "steps_in(seconds) gives the number")
    return int(count)


def carried(bodies: Bodies, was: State, state: State, row: np.ndarray, gone: np.ndarray) -> State:
    """The `state` of other bodies, with poses, contacts and sleep of `was` for those that were among `bodies`: `row`
    [M] int64 is the former row of each, -1 for new ones. Those beside the bodies `gone` wake. Same units."""
    if was.touch is not None and len(gone):
        from sdfsim.physics.solver.prepare import disturbed

        was = disturbed(bodies, was, np.isin(np.arange(len(bodies)), gone), np.zeros(len(bodies), bool))
    known = row >= 0

    def rows(name: str, of: Any, like: np.ndarray) -> np.ndarray:
        like = like.copy()
        like[known] = getattr(of, name)[row[known]]
        return like

    arrays: dict[str, Any] = {name: rows(name, was, getattr(state, name)) for name in MOTION}
    touch = was.touch
    if touch is not None:
        number = np.full(len(bodies), -1)
        number[row[known]] = np.flatnonzero(known)
        pair = number[touch.pair]
        kept, still = (pair >= 0).all(1), np.zeros(len(row), int)
        place = np.concatenate([arrays["position"], arrays["orientation"]] * 2, 1)
        arrays["touch"] = replace(
            touch, quiet=rows("quiet", touch, still), anchor=rows("anchor", touch, place),
            island=rows("island", touch, still - 1), pair=pair[kept], count=touch.count[kept], point=touch.point[kept],
        )  # fmt: skip
    return replace(state, **arrays)


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
    inertia follows its mass and scale; its mass does not follow its scale. Raises SdfsimError for an unknown body or
    field, or an invalid value."""
    known = {body.name for body in scene.bodies}
    for name in variant:
        if name not in known:
            raise SdfsimError(f"variant: there is no body {name!r}{nearest(name, known)}")
    made = (_changed(body, variant.get(body.name, {}), f"variant: body {body.name!r}") for body in scene.bodies)
    return replace(scene, bodies=tuple(made))


def _changed(body: Body, fields: Mapping[str, Any], what: str) -> Body:
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
    if body.inertia is not None:
        heavier, larger = (new.get(key, getattr(body, key)) / getattr(body, key) for key in ("mass", "scale"))
        new["inertia"] = body.inertia * (heavier * larger**2)
    return replace(body, **new)


def run_all(
    scenes: Sequence[Scene], model: Model | None = None, seconds: float | None = None, steps: int | None = None,
    on_progress: Progress = silent, **options: Any,
) -> list[Rollout]:  # fmt: skip
    """`run` of a `Simulator` for every scene, made with these options, on all cores: in threads if the steps are
    compiled code that does not need Python and has no threads of its own, else in processes. Raises as these do."""
    from sdfsim.physics.solver.prepare import SharedShapes  # numba is slow to load
    from sdfsim.physics.solver.tolerances import CROWD

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
