"""Joints of a running simulation by name: metres, radians, newtons and seconds, NumPy arrays."""

import warnings
from numbers import Real

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.bodies import State
from sdfsim.physics.joint_columns import (
    BROKEN,
    COORD,
    DAMPING,
    FRICTION,
    GAIN,
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
from sdfsim.physics.joints import EFFORT
from sdfsim.scene.scene import Joint, Motor
from sdfsim.simulate.body import LiveScene

EXACT = 1e-9  # rad, or model lengths: a reading of the joint may be this far beyond a limit


class JointHandle:
    """One joint of a simulator, by its `name`: read it, and drive it by `target` or by `effort`, which take effect from
    the next step until you change them. Radians and N m for a hinge, metres and N for a slider."""

    __slots__ = ("_row", "_simulator", "name")  # so that a misspelt name does not make a new attribute

    def __init__(self, simulator: LiveScene, row: int) -> None:
        self._simulator, self._row = simulator, row
        self.name = simulator.scene.joints[row].name

    @property
    def angle(self) -> float:
        """rad; for a hinge, the angle of the first body relative to the second, with full turns added up; for a ball,
        the angle between both axes. Raises SdfsimError for any other joint."""
        return self._coordinate("angle", "hinge", "ball")

    @property
    def position(self) -> float:
        """m; for a slider, the position of the first body relative to the second; for a distance, its length. Raises
        SdfsimError for any other joint."""
        return self._coordinate("position", "slider", "distance")

    @property
    def speed(self) -> float:
        """rad/s or m/s: the rate of change of the angle or position."""
        return float(self._state[SPEED]) * self._unit / self._simulator.units.time

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
            hint = {"angle": "read position", "position": "read angle"}.get(what, "")
            fits = self._joint.kind in ("hinge", "ball", "slider", "distance")
            raise SdfsimError(
                f"joint {self.name!r}: is a {self._joint.kind}, which has no {what}", hint if fits else ""
            )

    def _coordinate(self, what: str, *kinds: str) -> float:
        self._need(what, *kinds)
        return float(self._state[COORD]) * self._unit
