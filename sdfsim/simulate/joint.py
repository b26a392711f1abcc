"""Joints of a running simulation by name: metres, radians, newtons and seconds, NumPy arrays."""

import warnings
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np

from sdfsim.base.errors import SdfsimError, nearest
from sdfsim.physics import pose
from sdfsim.physics.bodies import State
from sdfsim.physics.joint_columns import (
    BROKEN,
    COORD,
    DAMPING,
    FRICTION,
    GAIN,
    KINDS,
    MAX_FORCE,
    MOTOR,
    NOTHING,
    PULL,
    SPEED,
    TARGET,
    TIME,
    TO_PLACE,
    TO_SPEED,
    TWIST,
)
from sdfsim.physics.joint_space import JointSpace, columns
from sdfsim.physics.joints import EFFORT
from sdfsim.scene.scene import Joint, Keyframe, Motor
from sdfsim.simulate.body import BodyHandle, FrameHandle, LiveScene, Numbers, vector

EXACT = 1e-9  # rad, or model lengths: a reading of the joint may be this far beyond a limit


class JointHandle:
    """One joint of a simulator, by its `name`: read it, set it, and drive it by `target` or by `effort`, which take
    effect from the next step until you change them. Radians and N m for a hinge, metres and N for a slider.

    To set an angle, position, speed or `quat_xyzw` moves the bodies that the joint holds, and all that these hold, as
    if they were rigid; other joints keep their speeds. Where this would open a loop, the loop's other joints give way.
    Raises SdfsimError if the loop cannot close so, or if the joint is broken.
    """

    __slots__ = ("_row", "_simulator", "name")  # so that a misspelt name does not make a new attribute

    def __init__(self, simulator: "Jointed", row: int) -> None:
        self._simulator, self._row = simulator, row
        self.name = simulator.scene.joints[row].name

    @property
    def angle(self) -> float:
        """rad; for a hinge, the angle of the first body relative to the second, with full turns added up; for a ball,
        the angle between both axes, which cannot be set. Raises SdfsimError for any other joint."""
        self._need("angle", "hinge", "ball")
        return float(self._state[COORD])

    @angle.setter
    def angle(self, angle: float) -> None:
        self._need("angle to set", "hinge")
        self._put("angle", angle)

    @property
    def position(self) -> float:
        """m for a slider, the position of the first body relative to the second; rad for a hinge, its `angle`; m for a
        distance, its length, which cannot be set. Raises SdfsimError for any other joint."""
        self._need("position", "hinge", "slider", "distance")
        return float(self._state[COORD]) * self._unit

    @position.setter
    def position(self, position: float) -> None:
        self._need("position to set", "hinge", "slider")
        self._put("position", position)

    @property
    def quat_xyzw(self) -> np.ndarray:
        """[4] of a ball, the turn of the first body from the start of the scene, as the second body sees it, in the
        world's axes at the start; the ball's axis, if it has one, is x. Raises SdfsimError for any other joint."""
        self._need("quat_xyzw", "ball")
        return pose.from_rotvec(self._simulator.joint_positions[self._simulator.joint_columns[self.name]])

    @quat_xyzw.setter
    def quat_xyzw(self, quat: Numbers) -> None:
        self._need("quat_xyzw", "ball")
        turned = vector("quat_xyzw", quat, 4)
        if not np.any(turned):
            raise SdfsimError("quat_xyzw: must not be zero")
        turn = pose.to_rotvec(turned / np.linalg.norm(turned))
        self._simulator.move_joints({self._row: turn}, {})

    @property
    def speed(self) -> float:
        """rad/s or m/s: the rate of change of the angle or position. It can be set for a hinge or slider."""
        return float(self._state[SPEED]) * self._unit / self._simulator.units.time

    @speed.setter
    def speed(self, speed: float) -> None:
        self._need("speed to set", "hinge", "slider")
        self._simulator.move_joints({}, {self._row: self._finite("speed", speed)})

    @property
    def force(self) -> np.ndarray:
        """[3] N, world: the force of the joint on the first body in the last inner step, including its motor, spring,
        friction and limits; the second body gets the opposite."""
        u = self._simulator.units
        return self._state[PULL : PULL + 3] * u.mass * u.acceleration

    @property
    def torque(self) -> np.ndarray:
        """[3] N m, world: likewise, the torque about the joint's anchor."""
        return self._state[TWIST : TWIST + 3] * self._simulator.units.energy

    @property
    def broken(self) -> bool:
        """Whether the joint is broken: its load was more than it can bear."""
        return bool(self._state[BROKEN])

    @property
    def target(self) -> float | None:
        """Target of the motor: rad/s or m/s if it keeps a speed, else rad or m; None if none is set, and while the
        motor gives an `effort`. Setting None switches the motor off. Raises SdfsimError if there is no motor."""
        unit, does = self._aim, int(self._number[MOTOR])
        return float(self._told[TARGET]) * unit if does in (TO_SPEED, TO_PLACE) else None

    @target.setter
    def target(self, value: float | None) -> None:
        unit = self._aim
        if value is None:
            return self._tell({MOTOR: NOTHING}, 0.0)
        aim = self._finite("target", value)
        does = TO_SPEED if self._keeps_speed else TO_PLACE
        ends = self._joint.limits
        if does == TO_PLACE and ends is not None and max(ends[0] - aim, aim - ends[1]) > EXACT * self._unit:
            # Only a warning: a target out of reach is a way to press against a limit.
            message = f"joint {self.name!r}: target {aim:g} is beyond the limits, {ends[0]:.4g} to {ends[1]:.4g}"
            warnings.warn(message, stacklevel=2)
        return self._tell({MOTOR: does}, aim / unit)

    @property
    def effort(self) -> float | None:
        """The torque in N m about a hinge's axis, or the force in N along a slider's, that acts on the first body from
        now on, at any speed, until it is set again; None while the motor follows its `target` or does nothing. Setting
        `target`, or None, ends it. It is limited to the motor's `max_force`, if there is one. Raises SdfsimError for
        any other joint."""
        self._need("effort", "hinge", "slider")
        return float(self._told[TARGET]) * self._strength if self._number[MOTOR] == EFFORT else None

    @effort.setter
    def effort(self, value: float | None) -> None:
        self._need("effort", "hinge", "slider")
        if value is None:
            return self._tell({MOTOR: NOTHING}, 0.0)
        most = self._number[MAX_FORCE] or np.inf
        return self._tell({MOTOR: EFFORT}, float(np.clip(self._finite("effort", value) / self._strength, -most, most)))

    @property
    def max_force(self) -> float:
        """The largest torque in N m, or force in N, of the motor; 0 if there is none. Setting it adds a motor. Raises
        SdfsimError for any joint but a hinge or slider."""
        self._need("max_force", "hinge", "slider")
        return float(self._number[MAX_FORCE]) * self._strength

    @max_force.setter
    def max_force(self, value: float) -> None:
        self._need("max_force", "hinge", "slider")
        most = self._finite("max_force", value, least=0.0) / self._strength
        time = self._number[TIME] if self._number[MAX_FORCE] else Motor(1.0).time / self._simulator.units.time
        self._tell({MAX_FORCE: most, TIME: time})

    @property
    def time(self) -> float:
        """s, in which the distance to the target shrinks by a factor e. Raises SdfsimError if there is no motor that
        goes to a position."""
        _ = self._aim
        if self._keeps_speed:
            raise SdfsimError(f"joint {self.name!r}: keeps a speed, which has no time", "see joints[].motor.position")
        return float(self._number[TIME]) * self._simulator.units.time

    @time.setter
    def time(self, value: float) -> None:
        _ = self.time  # is one for positions
        self._tell({TIME: self._finite("time", value, least=0.0) / self._simulator.units.time})

    @property
    def gain(self) -> float | None:
        """The motor's torque or force for an error of its target: N m/rad or N/m for a position, N m s/rad or N s/m for
        a speed; None if it is as much as the target takes, up to `max_force`. Raises SdfsimError without a motor."""
        unit = self._strength / self._aim
        return float(self._number[GAIN]) * unit or None

    @gain.setter
    def gain(self, value: float | None) -> None:
        unit = self._strength / self._aim
        found = 0.0 if value is None else self._finite("gain", value, least=0.0)
        if value is not None and not found > 0.0:
            raise SdfsimError(f"joint {self.name!r}: gain: must be above 0, or None (got {value!r})")
        self._tell({GAIN: found / unit})

    @property
    def damping(self) -> float:
        """N m s/rad for a hinge or a ball, else N s/m. Raises SdfsimError for a fixed joint or a rod."""
        self._need("damping", "hinge", "slider", "ball", "distance")
        return float(self._number[DAMPING]) * self._strength / self._unit * self._simulator.units.time

    @damping.setter
    def damping(self, value: float) -> None:
        self._need("damping", "hinge", "slider", "ball", "distance")
        if self._joint.length is not None:
            raise SdfsimError(f"joint {self.name!r}: is a rod, which has no damping")
        found = self._finite("damping", value, least=0.0)
        self._tell({DAMPING: found * self._unit / self._strength / self._simulator.units.time})

    @property
    def friction(self) -> float:
        """N m for a hinge or a ball, N for a slider. Raises SdfsimError for any other joint."""
        self._need("friction", "hinge", "slider", "ball")
        return float(self._number[FRICTION]) * self._strength

    @friction.setter
    def friction(self, value: float) -> None:
        self._need("friction", "hinge", "slider", "ball")
        self._tell({FRICTION: self._finite("friction", value, least=0.0) / self._strength})

    @property
    def aims(self) -> bool:
        """Whether its motor goes to a position."""
        return bool(self._number[MOTOR] == TO_PLACE)

    def _put(self, what: str, value: float) -> None:
        found, ends = self._finite(what, value), self._joint.limits
        if ends is not None and max(ends[0] - found, found - ends[1]) > EXACT * self._unit:
            beyond = f"{what} {found:g} is beyond the limits, {ends[0]:.4g} to {ends[1]:.4g}"
            raise SdfsimError(f"joint {self.name!r}: {beyond}", "the limits are joints[].limits of the scene")
        self._simulator.move_joints({self._row: found}, {})

    @property
    def _joint(self) -> Joint:
        return self._simulator.scene.joints[self._row]

    @property
    def _state(self) -> np.ndarray:
        """[STATE], changes included."""
        return self._known(self._simulator.state)

    @property
    def _told(self) -> np.ndarray:
        """[STATE], in which the values that users set are up to date."""
        return self._known(self._simulator.now)

    def _known(self, state: State) -> np.ndarray:
        if state.joints is None:
            raise SdfsimError(f"joint {self.name!r}: joints are off in this scene", "see effects.joints")
        return state.joints[self._row]

    @property
    def _number(self) -> np.ndarray:
        """[NUMBERS], as set last."""
        state, joints = self._simulator.now, self._simulator.bodies.joints
        self._known(state)
        assert joints is not None
        return (joints.number if state.drive is None else state.drive)[self._row]

    def _tell(self, numbers: dict[int, float], target: float | None = None) -> None:
        """Change numbers of the joint and the target of its motor. Its bodies wake if this changes anything."""
        simulator, row = self._simulator, self._row
        known, number = self._told.copy(), self._number.copy()
        if target is not None:
            known[TARGET] = target
        for column, value in numbers.items():
            number[column] = value
        if np.array_equal(known, self._told) and np.array_equal(number, self._number):
            return
        state, joints = simulator.now, simulator.bodies.joints
        assert state.joints is not None and joints is not None
        states, drive = state.joints.copy(), (joints.number if state.drive is None else state.drive).copy()
        states[row], drive[row] = known, number
        for body in self._joint.bodies:
            if body >= 0 and simulator.bodies.moves[body]:
                simulator.change(body, joints=states, drive=drive)

    def _finite(self, name: str, value: float, *, least: float = -np.inf) -> float:
        if isinstance(value, bool) or not isinstance(value, Real) or not np.isfinite(value) or value < least:
            what = "a finite number" if least < 0.0 else "a finite number of at least 0"
            raise SdfsimError(f"joint {self.name!r}: {name}: must be {what} (got {value!r})")
        return float(value)

    @property
    def _unit(self) -> float:
        return 1.0 if self._joint.kind in ("hinge", "ball") else self._simulator.units.length

    @property
    def _strength(self) -> float:
        """One model unit of the joint's torque (N m) or force (N)."""
        return self._simulator.units.energy / self._unit

    @property
    def _keeps_speed(self) -> bool:
        return self._joint.motor is not None and self._joint.motor.speed is not None

    @property
    def _aim(self) -> float:
        """One model unit of the target: rad or m, or rad/s or m/s."""
        if not self._number[MAX_FORCE] > 0.0:
            hint = "give it one in the scene, joints[].motor, or set max_force; effort needs none"
            raise SdfsimError(f"joint {self.name!r}: has no motor", hint)
        return self._unit / self._simulator.units.time if self._keeps_speed else self._unit

    def _need(self, what: str, *kinds: str) -> None:
        if self._joint.kind not in kinds:
            hint = "read position" if what == "angle" and self._joint.kind in ("slider", "distance") else ""
            raise SdfsimError(f"joint {self.name!r}: is a {self._joint.kind}, which has no {what}", hint)


class Jointed(LiveScene):
    """The joints of a simulator: each by its name, and all of them as vectors.

    A hinge has one number in a vector (rad), a slider one (m), a ball three: the rotation vector of its first body's
    frame in the second's, and as velocity the angular velocity in the axes of the second's. Fixed joints and distances
    have none. Joints follow one another as in the scene; `joint_columns` has their places.
    """

    def joint(self, name: str) -> JointHandle:
        """A joint by its name. Raises SdfsimError if no joint has that name."""
        names = [joint.name for joint in self.scene.joints]
        if name not in names:
            suggestion = nearest(name, names)
            known = f"joints are {', '.join(names[:20])}" if names else "the scene has no joints"
            raise SdfsimError(f"there is no joint {name!r}{suggestion}", known)
        return JointHandle(self, names.index(name))

    @property
    def joint_columns(self) -> dict[str, slice]:
        """The place of each joint in the vectors below, by its name."""
        joints = self.scene.joints
        places = columns(np.array([KINDS.index(joint.kind) for joint in joints], int))
        return dict(zip((joint.name for joint in joints), places, strict=True))

    @property
    def joint_positions(self) -> np.ndarray:
        """[n] rad and m, of all hinges, sliders and balls."""
        return self._space.positions * self._joint_units

    @property
    def joint_velocities(self) -> np.ndarray:
        """[n] rad/s and m/s."""
        return self._space.velocities * self._joint_units / self.units.time

    def set_joints(self, positions: Numbers | None = None, velocities: Numbers | None = None) -> None:
        """Set all joints, [n] each, or only one of both. The world and free bodies that no joint holds stay as they
        are, and the others follow from them; see `JointHandle` for loops, in which all joints give way a little.
        Raises SdfsimError for vectors of another length, and if a loop cannot close."""
        space, units = self._space, self._joint_units
        given = [
            old if new is None else vector(name, new, len(units)) / units * scale
            for name, new, old, scale in (
                ("positions", positions, space.positions, 1.0),
                ("velocities", velocities, space.velocities, self.units.time),
            )
        ]
        self._follow(*space.set(*given))

    def move_joints(self, positions: Mapping[int, Any], velocities: Mapping[int, Any]) -> None:
        """Set some joints, by their numbers, see `JointHandle`."""
        space, places, units = self._space, list(self.joint_columns.values()), self._joint_units
        q, v = space.positions, space.velocities
        for j in (*positions, *velocities):
            if self.state.joints is not None and self.state.joints[j, BROKEN]:
                raise SdfsimError(f"joint {self.scene.joints[j].name!r}: is broken: it holds nothing")
        for j, value in positions.items():
            q[places[j]] = value / units[places[j]]
        for j, value in velocities.items():
            v[places[j]] = value / units[places[j]] * self.units.time
        self._follow(*space.set(q, v, {*positions, *velocities}))

    def _pose_as(self, key: Keyframe) -> None:
        """Move all bodies and joints to a keyframe, with its speeds."""
        q = self.joint_positions if self.bodies.joints is not None else np.zeros(0)
        for name, (position, quat, velocity, spin) in key.bodies.items():
            body = BodyHandle(self, name)
            body.quat_xyzw, body.position, body.velocity, body.angular_velocity = quat, position, velocity, spin
        if self.bodies.joints is None:
            return
        v, places = np.zeros(len(q)), self.joint_columns
        for name, value in key.joints.items():
            q[places[name]] = pose.to_rotvec(value) if np.ndim(value) else value
            handle = self.joint(name)
            if handle.aims and name not in key.targets:
                handle.target = float(value)
        for name, target in key.targets.items():
            self.joint(name).target = target
        for name, speed in key.speeds.items():
            v[places[name]] = speed
        self.set_joints(q, v)

    def frame(self, name: str) -> FrameHandle:
        """A frame of the scene by its name, such as a robot's `hand_tcp`. Raises SdfsimError if there is none."""
        names = [frame.name for frame in self.scene.frames]
        if name not in names:
            known = f"frames are {', '.join(names[:20])}" if names else "the scene has no frames"
            raise SdfsimError(f"there is no frame {name!r}{nearest(name, names)}", known)
        return FrameHandle(self, self.scene.frames[names.index(name)])

    def jacobian(self, body: str, point: Numbers | None = None, *, base: str | None = None) -> np.ndarray:
        """[6, n] the velocity (m/s, first three rows) of a body's `point` and the body's angular velocity (rad/s), in
        world axes, for each joint's velocity; for `base` see `mass_matrix`. `body` may also be a frame, and `point` [3]
        m, world, is by default the origin of its shape or of the frame. The joint that closes a loop has columns of
        zeros. Raises SdfsimError for unknown names."""
        named = [
            frame
            for frame in self.scene.frames
            if frame.name == body and body not in [b.name for b in self.scene.bodies]
        ]
        row = named[0].body if named else self._row(body)
        fast, spin = (part[row] for part in self._space.jacobian(self._base(base)))
        origin = self.frame(body).position if named else BodyHandle(self, body).position
        place = origin if point is None else vector("point", point)
        arm = place / self.units.length - (self.state.position[row] if row >= 0 else 0.0)
        made = np.concatenate([(fast + np.cross(spin, arm, axis=0)) * self.units.length, spin])
        return made / self._column_units(base)

    def mass_matrix(self, *, base: str | None = None) -> np.ndarray:
        """[n, n] kg m^2, kg m and kg: half of v M v is the kinetic energy at the joint velocities v. Free bodies stand
        still; with one as the `base` six columns come first, its velocity (of the centre of mass) and its angular
        velocity, world axes."""
        units = self._column_units(base)
        scale = self.units.mass * self.units.length**2
        return self._space.mass_matrix(self._base(base)) * scale / units / units[:, None]

    @property
    def _space(self) -> JointSpace:
        return JointSpace(self.bodies, self.state)

    @property
    def _joint_units(self) -> np.ndarray:
        """[n] one model unit of each position, rad or m."""
        units = {"hinge": [1.0], "slider": [self.units.length], "ball": [1.0] * 3}
        return np.array([unit for joint in self.scene.joints for unit in units.get(joint.kind, [])])

    def _column_units(self, base: str | None) -> np.ndarray:
        own = [] if base is None else [self.units.length] * 3 + [1.0] * 3
        return np.concatenate([own, self._joint_units])

    def _base(self, name: str | None) -> int | None:
        if name is None:
            return None
        row = self._row(name)
        if row not in self._space.roots:
            raise SdfsimError(f"base: body {name!r} is not free", "give the root of a robot that nothing holds")
        return row

    def _follow(self, state: State, rows: np.ndarray) -> None:
        """Go on from a state in which the bodies `rows` have changed."""
        self._state = state
        self._changed.update(rows.tolist())
