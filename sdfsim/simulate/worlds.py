"""`Batch`: many worlds of one scene in one compiled call, for learning."""

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numba import int64, typeof

from sdfsim.base.compiling import compile_before
from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.base.files import read_json
from sdfsim.physics import joint_columns as col
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, from_scene
from sdfsim.physics.joint_space import JointSpace
from sdfsim.physics.joints import NEVER, initial
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver.prepare import NO_SCRIPT, Compiled, SharedShapes, compiled_rules, scripted, taken_up
from sdfsim.physics.solver.run import Kept
from sdfsim.physics.validity import limits
from sdfsim.physics.worlds import Stored, Told, run_worlds, untouched
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.plan import plan
from sdfsim.scene.scene import Frame, Scene
from sdfsim.simulate.camera import Camera, Image, Style
from sdfsim.simulate.joint import JointHandle
from sdfsim.simulate.simulator import Simulator, Variant, varied
from sdfsim.simulate.steppers import Solver

# Numbers in each field of a body's motion.
WIDTHS = {"position": 3, "quat_xyzw": 4, "velocity": 3, "angular_velocity": 3}
AXES = ("hinge", "slider")
ACTS = {"target": 1, "effort": 1, "force": 3, "torque": 3}
OBSERVED = {**WIDTHS, "force": 3, "joint_position": 1, "joint_velocity": 1}
PLAIN = Style()
PIECES = 4  # of the worlds for each thread, so that all threads finish together
Ranges = Mapping[str, Mapping[str, Any]]


class Batch:
    """Many worlds of one scene. They never meet; each moves as a `Simulator` of its own would, bit by bit, and one
    compiled call advances all of them, on all cores.

        batch = sdfsim.Batch("arm.yaml", 256, act=["target elbow"], observe=["position cup", "joint_position elbow"])
        seen = batch.reset()                        # [256, 4]
        for _ in range(100):
            seen = batch.step(actions)              # [256, 1] -> [256, 4]
        batch.reset([3, 7])                         # these worlds begin anew

    Args:
        scene: as for `Simulator`; it needs contacts or joints.
        worlds: their number, W.
        act: what the columns of actions are, each a kind and a name: `target` of a joint's motor (rad or m; rad/s or
            m/s if it keeps a speed), `effort` of a joint (N m or N), `force` on a body (3 columns, N, at the centre of
            mass, world axes) and `torque` (3, N m). An action lasts until the next one. It wakes bodies if it differs.
        observe: likewise of observations: `position` (3, m), `quat_xyzw` (4), `velocity` (3, m/s) and
            `angular_velocity` (3, rad/s) of a body or a frame, `force` (3, N: of all contacts of a body together, in
            the last inner step), `joint_position` and `joint_velocity` of a hinge or slider. None: poses and velocities
            of all moving bodies, then all hinges and sliders.
        vary: what each world draws at a reset: body -> field -> (lowest, highest) or one value. Fields are those of
            `Simulator.rollouts`, and `yaw`, rad, a turn about z; for a hinge or slider `position`, rad or m: bodies
            that joints hold follow. Or the `identify.json` of a fit: the intervals of its frictions, restitutions and
            masses.
        seed: of the draws: the n-th reset of a world draws the same in every batch with this seed.
        dt: s, the step, as for `Simulator`.
        threads: their number; None: as many as there are cores.

    Attributes:
        columns, observed: the places of the entries of `act` in actions, and of `observe` in observations.
        drawn: for each world what its last reset drew. For bodies a `Variant`: `Simulator(varied(scene, variant),
            units=batch.units)` moves in the same way.
        scenes: for each world its scene, with what was drawn except poses and velocities.
        failed: [W] bool, worlds whose state became invalid, as of bodies that are too fast. They go back to the state
            before that call, and stand still until their reset.
        draws: [W] how often each world has drawn.
        scene, units, dt, simulator: those of a single simulator of the scene, at its start.

    Raises:
        SdfsimError: unknown names or fields, impossible values, or a scene that the contact solve cannot run.
    """

    def __init__(
        self, scene: Scene | SceneBuilder | Path | str, worlds: int = 1000, *, act: Sequence[str] = (),
        observe: Sequence[str] | None = None, vary: Ranges | Path | str | None = None, seed: int = 0,
        dt: float | None = None, threads: int | None = None,
    ) -> None:  # fmt: skip
        if isinstance(worlds, bool) or not isinstance(worlds, int | np.integer) or worlds < 1:
            raise SdfsimError(f"worlds: must be a whole number above 0 (got {worlds!r})")
        self.simulator = one = Simulator(scene, "solver", dt=dt)
        if not isinstance(one.stepper, Solver):
            raise SdfsimError("a batch needs the contact solve", "switch on effects.contact, or add joints")
        self.scene, self.units, self.dt, self.seed = one.scene, one.units, one.dt, seed
        self._vary = self._checked(_intervals(Path(vary)) if isinstance(vary, str | Path) else vary or {})
        highest = {
            name: {f: ends[1].tolist() for f, ends in fields.items() if f in ("friction", "restitution")}
            for name, fields in self._vary.items() if name in one._names
        }  # fmt: skip
        effects = plan(varied(self.scene, highest))
        on = {name: effects[name].on for name in ("friction", "restitution")}
        self._options, self._start = one.options._replace(**on), one.state
        self._shared = one._shared = SharedShapes()
        one.step(0)  # compiles
        model: Any = one.carry.scene
        self._threads = 1 if model.threads else threads or os.cpu_count() or 1  # many bodies use all cores themselves
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._pieces, self._rules = model.pieces, compiled_rules(self._options)
        count, n, j = int(worlds), len(one.bodies), 0 if self._start.joints is None else len(self._start.joints)
        self.scenes, self.drawn = [self.scene] * count, cast("list[Variant]", [{}]) * count
        self.draws, self.failed, self._fixed = np.zeros(count, np.int64), np.zeros(count, bool), np.zeros(count, bool)
        self._com, self._wrench = np.tile(one.bodies.com, (count, 1, 1)), np.zeros((count, n, 6))
        self._number, self._joint = np.zeros((count, j, col.NUMBERS)), np.zeros((count, j, col.STATE))
        self._told = Told(
            np.ones(count, bool), np.zeros((count, n), bool), np.zeros(count, np.int64), np.zeros((count, n, 3)),
            self.failed,
        )  # fmt: skip
        parts = [self._parts(w, one.bodies, self._start) for w in range(count)]
        self._shapes, self._stored = Stored([model.shapes]), [Stored(list(some)) for some in zip(*parts, strict=True)]
        first = taken_up(self._start)[0]
        self._motion = type(first)(*(np.repeat(array[None], count, axis=0) for array in first))
        self._motions = Stored([type(first)(*(array[w] for array in self._motion)) for w in range(count)])
        sizes = (0, n, 3), (0, n, 4), (0, n, 3), (0, n, 3), (0, 3)
        nothing: list[Any] = [*map(np.empty, sizes), np.empty((0, 5), np.int64), np.empty(0), np.empty((0, j, 7))]
        self._kept = Kept(*nothing)
        self._script, self._ended = NO_SCRIPT, 0
        compile_before([(untouched, (int64,))], "the batch")
        self._held = untouched(count)
        self.columns, self._acts = self._places("act", act, ACTS)
        if observe is None:
            moving = [body.name for body in self.scene.bodies if body.motion == "dynamic"]
            hinges = [joint.name for joint in self.scene.joints if joint.kind in AXES]
            observe = [f"{kind} {name}" for name in moving for kind in WIDTHS]
            observe += [f"joint_{kind} {name}" for name in hinges for kind in ("position", "velocity")]
        self.observed, self._seen = self._places("observe", observe, OBSERVED)
        self._advance(0)  # compiles

    def __len__(self) -> int:
        return len(self.failed)

    def reset(
        self, worlds: Sequence[int] | np.ndarray | None = None, variants: Sequence[Ranges] | None = None,
        *, seed: int | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Begin anew in these worlds (None: all), given by their numbers or [W] bool; others go on. Each draws from
        `vary`, unless `variants` has values for it. A `seed` begins the draws anew, too. Returns the observations of
        all worlds, [W, O]. Raises SdfsimError for unknown names or fields and impossible values."""
        if seed is not None:
            self.seed, self.draws[:] = seed, 0
        rows = np.arange(len(self))[slice(None) if worlds is None else np.asarray(worlds)]
        if variants is not None and len(variants) != len(rows):
            raise SdfsimError(f"variants: must be one for each world ({len(rows)}, got {len(variants)})")
        for k, w in enumerate(rows.tolist()):
            rng = np.random.default_rng([self.seed, w, int(self.draws[w])])
            self._begin(w, self._draw(self._vary if variants is None else self._checked(variants[k]), rng))
            self.draws[w] += variants is None
        return self.observe()

    def step(self, actions: np.ndarray | None = None, count: int = 1) -> np.ndarray:
        """Make `count` steps of `dt` in all worlds under these actions, [W, A] (None: as before). Returns the
        observations [W, O] after them. Raises SdfsimError for actions of another shape, or that are not finite."""
        if actions is not None:
            self._act(np.asarray(actions, float))
        self._advance(count)
        return self.observe()

    def observe(self) -> np.ndarray:
        """[W, O] the present observations."""
        found = [self._read(*entry) for entry in self._seen]
        return np.concatenate([np.zeros((len(self), 0)), *found], 1)

    def image(self, camera: Camera, world: int, style: Style = PLAIN) -> Image:
        """What a camera sees of a world."""
        place = self._motion.position[world] * self.units.length
        return camera.picture(self.scenes[world], place, self._motion.orientation[world], style)

    # --- names ---

    def _places(self, what: str, entries: Sequence[str], kinds: Mapping[str, int]) -> tuple[dict[str, slice], list]:
        """The columns of entries, and each with its kind, its row among bodies or joints, and columns; for frames the
        frame too."""
        places, found, start = {}, [], 0
        for entry in entries:
            kind, _, name = str(entry).partition(" ")
            if kind not in kinds:
                known = ", ".join(kinds)
                raise SdfsimError(f"{what}: {entry!r}: no such kind{nearest(kind, kinds)}", f"kinds are {known}")
            frame = next((f for f in self.scene.frames if f.name == name and kind in WIDTHS), None)
            if kind in ("target", "effort") or kind.startswith("joint_"):
                handle: Any = self.simulator.joint(name)
                handle._need(kind, *AXES)
                _ = handle._told, handle._aim if kind == "target" else 0.0  # joints are on, and it has a motor
                row = handle._row
            else:
                row = self.simulator._row(name) if frame is None else frame.body
            if row < 0 or (what == "act" and kind in ("force", "torque") and not self.simulator.bodies.moves[row]):
                raise SdfsimError(f"{what}: {entry!r}: {name!r} does not move")
            places[entry] = slice(start, start + kinds[kind])
            found.append((kind, row, frame if what == "observe" else places[entry]))
            start += kinds[kind]
        return places, found

    # --- reading ---

    def _read(self, kind: str, row: int, frame: Frame | None) -> np.ndarray:
        """[W, 1, 3 or 4] of a body, frame or joint, SI units."""
        u, motion = self.units, self._motion
        if kind.startswith("joint_"):
            unit = self.simulator._joint_unit[row]
            known = self._joint[:, row, [col.COORD if kind == "joint_position" else col.SPEED]] * unit
            return known if kind == "joint_position" else known / u.time
        if kind == "force":
            return self._told.force[:, row] * (u.mass * u.velocity * self._options.substeps / self.dt)
        turn, spin = motion.orientation[:, row], motion.angular[:, row] / u.time
        if kind == "quat_xyzw":
            return turn if frame is None else pose.multiply(turn, frame.quat_xyzw)
        if kind == "angular_velocity":
            return spin
        fast, centre = motion.velocity[:, row] * u.velocity, motion.position[:, row] * u.length
        if kind == "velocity" and frame is None:
            return fast
        place = centre - pose.rotate(turn, self._com[:, row]) * u.length
        if frame is not None:
            place = place + pose.rotate(turn, frame.position)
        return place if kind == "position" else fast + pose.cross(spin, place - centre)

    # --- acting ---

    def _act(self, actions: np.ndarray) -> None:
        width = sum(place.stop - place.start for place in self.columns.values())
        if actions.shape != (len(self), width) or not np.isfinite(actions).all():
            shape = f"[{len(self)}, {width}]"
            raise SdfsimError(f"actions: must be finite numbers {shape} (got shape {list(actions.shape)})")
        u, changed = self.units, self._told.changed
        for kind, row, place in self._acts:
            values = actions[:, place]
            if kind in ("force", "torque"):
                known = self._wrench[:, row, :3] if kind == "force" else self._wrench[:, row, 3:]
                new = values / (u.mass * u.acceleration if kind == "force" else u.energy)
                changed[:, row] |= (known != new).any(1)
                known[:] = new
                continue
            handle: Any = JointHandle(self.simulator, row)
            number, target, value = self._number[:, row], self._joint[:, row, col.TARGET], values[:, 0]
            before = np.column_stack([number, target])
            if kind == "target":
                number[:, col.MOTOR] = col.TO_SPEED if handle._keeps_speed else col.TO_PLACE
                target[:] = value / handle._aim
            else:
                most = handle._number[col.MAX_FORCE] or np.inf
                value = np.clip(value / handle._strength, -most, most)
                number[:, [col.MOTOR, col.GAIN]], number[:, col.MAX_FORCE] = (col.TO_SPEED, 0.0), np.abs(value)
                target[:] = NEVER * np.sign(value)
            new = (before != np.column_stack([number, target])).any(1)
            for body in self.scene.joints[row].bodies:
                if body >= 0 and self.simulator.bodies.moves[body]:
                    changed[:, body] |= new

    def _advance(self, count: int) -> None:
        tracks = self.simulator.bodies.tracks
        if tracks is not None and len(self._script.pose) < self._ended + count:
            ends = tracks.time[np.isfinite(tracks.time)]
            self._ended = math.ceil(ends.max() / self._options.dt) + 2
            self._script = scripted(tracks, 0.0, self._rules, self._ended + count)[0]
        ahead: tuple[Any, ...] = (
            self._shapes, *self._stored, self._motions, self._rules, self._held, self._pieces, self._script,
            limits(self._options.dt), self._kept, self._told,
        )  # fmt: skip
        rows = np.array_split(np.arange(len(self)), min(len(self), PIECES * self._threads))
        if not count:
            kinds = (*map(typeof, (*ahead, rows[0])), int64)
            compile_before([(run_worlds, kinds)], "the batch")
            return
        run: Any = run_worlds
        calls = self._pool.map if self._pool is not None and len(rows) > 1 else map
        for _ in calls(lambda some: run(*ahead, some, int(count)), rows):
            pass

    # --- beginning anew ---

    def _checked(self, ranges: Ranges) -> dict[str, dict[str, np.ndarray]]:
        """[2, ...] the lowest and highest value of each field. Raises SdfsimError if a scene cannot have these."""
        found: dict[str, dict[str, np.ndarray]] = {}
        for name, fields in ranges.items():
            for field, value in fields.items():
                place = f"vary: {name!r}: {field}"
                held = name in self.simulator._joint_names
                if held and (field != "position" or self.simulator.joint(name)._joint.kind not in AXES):
                    raise SdfsimError(f"{place}: of a joint, only the position of a hinge or slider can vary")
                shape = (WIDTHS[field],) if field in WIDTHS and not held else ()
                try:
                    ends = np.array(value, float)
                    ends = np.stack([ends, ends]) if ends.shape == shape else ends
                except (TypeError, ValueError):
                    ends = np.zeros(0)
                if ends.shape != (2, *shape) or not (np.isfinite(ends).all() and (ends[0] <= ends[1]).all()):
                    what = f"{shape[0]} numbers" if shape else "a number"
                    raise SdfsimError(f"{place}: must be {what}, or a pair (lowest, highest) of such (got {value!r})")
                found.setdefault(name, {})[field] = ends
        for k in range(2):
            varied(self.scene, {
                name: {field: ends[k].tolist() for field, ends in fields.items() if field != "yaw"}
                for name, fields in found.items() if name not in self.simulator._joint_names
            })  # fmt: skip
        return found

    def _draw(self, ranges: Mapping[str, Mapping[str, np.ndarray]], rng: np.random.Generator) -> Variant:
        """Values between those that `_checked` gave."""
        variant: dict[str, dict[str, Any]] = {}
        for name, fields in ranges.items():
            found = {field: low + (high - low) * rng.random(low.shape) for field, (low, high) in fields.items()}
            if "yaw" in found:
                base = found.get("quat_xyzw", self.scene.bodies[self.simulator._row(name)].quat_xyzw)
                turned = pose.multiply(pose.from_rotvec(np.array([0.0, 0.0, float(found.pop("yaw"))])), base)
                found["quat_xyzw"] = pose.normalise(turned)
            variant[name] = {field: v if v.ndim else float(v) for field, v in found.items()}
        return variant

    def _begin(self, w: int, variant: Variant) -> None:
        """Put a world at its start, with these values."""
        one, scene, start = self.simulator, self.scene, self._start
        of_bodies = {name: fields for name, fields in variant.items() if name in one._names}
        posed = varied(scene, of_bodies)
        bodies, state = one.bodies, start
        if any({*fields} - {*WIDTHS} for fields in of_bodies.values()):
            like = zip(scene.bodies, posed.bodies, strict=True)
            scene = replace(scene, bodies=tuple(replace(b, **{f: getattr(a, f) for f in WIDTHS}) for a, b in like))
            joints = scene.joints if start.joints is not None else ()
            bodies, state = from_scene(replace(scene, joints=joints), self.units)
            bodies = replace(bodies, allowed=one.bodies.allowed)
        arrays = {name: getattr(state, name).copy() for name in MOTION}
        for name in of_bodies:
            b = one._row(name)
            body = posed.bodies[b]
            arrays["orientation"][b] = body.quat_xyzw
            arrays["position"][b] = body.position / self.units.length + pose.rotate(body.quat_xyzw, bodies.com[b])
            arrays["velocity"][b] = body.velocity / self.units.velocity
            arrays["angular_velocity"][b] = body.angular_velocity * self.units.time
        state = replace(state, **arrays)
        if bodies.joints is not None:
            state = replace(state, joints=initial(bodies.joints, state))
            held = [name for name in variant if name not in of_bodies]
            if moved := {one.joint(name)._row: variant[name]["position"] for name in held}:
                space = JointSpace(bodies, state)
                positions, places = space.positions, [*one.joint_columns.values()]
                for row, value in moved.items():
                    positions[places[row]] = value / one._joint_unit[row]
                state = space.set(positions, space.velocities, set(moved))[0]
            self._joint[w], self._number[w] = state.joints, bodies.joints.number
        fixed = any(self.scene.bodies[one._row(name)].motion == "static" for name in of_bodies)
        if scene is not self.scenes[w] or fixed or self._fixed[w]:
            for stored, part in zip(self._stored, self._parts(w, bodies, state), strict=True):
                stored.put(w, part)
        self._fixed[w], self.scenes[w], self.drawn[w] = fixed, scene, variant
        for array, value in zip(self._motion, taken_up(state)[0], strict=True):
            array[w] = value
        self._com[w], self._wrench[w] = bodies.com, 0.0
        told = self._told
        told.fresh[w], told.changed[w], told.number[w], told.force[w], told.failed[w] = True, False, 0, 0.0, False

    def _parts(self, w: int, bodies: Bodies, state: State) -> tuple[Any, ...]:
        """What compiled code needs of a world, with actions and joints in the arrays of all worlds."""
        made = Compiled(bodies, state, self._shared, grids=False)
        each = made.joints.each._replace(number=self._number[w], state=self._joint[w])
        return made.world, made.work._replace(wrench=self._wrench[w]), made.joints._replace(each=each)


def _intervals(report: Path) -> Ranges:
    """The intervals of `sdfsim identify --json`, as ranges of the bodies' own values."""
    found, ranges = read_json(report), {}
    for name, values in found.get("scene", {}).items():
        for key, kinds in {"friction": "own_friction friction", "restitution": "own_restitution restitution",
                           "mass": "mass", "scale": "size"}.items():  # fmt: skip
            known = next((e for kind in kinds.split() if (e := found.get(kind, {}).get(name))), None)
            if key in values and known and known["interval"] and known["value"]:
                ranges.setdefault(name, {})[key] = [values[key] * end / known["value"] for end in known["interval"]]
    return ranges
