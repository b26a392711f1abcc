"""Joints of a running simulation by name: metres, radians, newtons and seconds, NumPy arrays."""

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics.joint_columns import BROKEN, COORD, PULL, SPEED, TARGET, TWIST
from sdfsim.scene.scene import Joint
from sdfsim.simulate.body import LiveScene


class JointHandle:
    """One joint of a simulator, by its `name`: read it, and tell its motor what to aim at, which counts from the next
    step on."""

    __slots__ = ("_row", "_simulator", "name")  # so that a name that is misspelt is no new attribute

    def __init__(self, simulator: LiveScene, row: int) -> None:
        self._simulator, self._row = simulator, row
        self.name = simulator.scene.joints[row].name

    @property
    def angle(self) -> float:
        """rad, of a hinge: of the first body against the second, turns added up; of a ball: between both axes. Raises
        SdfsimError for any other joint."""
        return self._coordinate("angle", "hinge", "ball")

    @property
    def position(self) -> float:
        """m, of a slider: of the first body against the second; of a distance: its length. Raises SdfsimError for any
        other joint."""
        return self._coordinate("position", "slider", "distance")

    @property
    def speed(self) -> float:
        """rad/s or m/s: how fast the angle or position changes."""
        return float(self._state[SPEED]) * self._unit / self._simulator.units.time

    @property
    def force(self) -> np.ndarray:
        """[3] N, world: what the joint did to the first body in the last inner step, its motor, spring, friction and
        limits included; the opposite to the second."""
        u = self._simulator.units
        return self._state[PULL : PULL + 3] * u.mass * u.acceleration

    @property
    def torque(self) -> np.ndarray:
        """[3] N m, world: likewise the torque about the joint's anchor."""
        return self._state[TWIST : TWIST + 3] * self._simulator.units.energy

    @property
    def broken(self) -> bool:
        """Whether it has had to bear more than it can."""
        return bool(self._state[BROKEN])

    @property
    def target(self) -> float:
        """What the motor aims at: rad/s or m/s where it keeps a speed, else rad or m. Raises SdfsimError where there is
        no motor."""
        return float(self._state[TARGET]) * self._aim

    @target.setter
    def target(self, value: float) -> None:
        if not np.isfinite(value):
            raise SdfsimError(f"joint {self.name!r}: target: must be a finite number (got {value!r})")
        simulator, unit = self._simulator, self._aim
        assert simulator.state.joints is not None
        known = simulator.state.joints.copy()
        known[self._row, TARGET] = value / unit
        # Its bodies are told of, so that they wake.
        for body in self._joint.bodies:
            if body >= 0 and simulator.bodies.moves[body]:
                simulator.change(body, joints=known)

    @property
    def _joint(self) -> Joint:
        return self._simulator.scene.joints[self._row]

    @property
    def _state(self) -> np.ndarray:
        known = self._simulator.state.joints
        if known is None:
            raise SdfsimError(f"joint {self.name!r}: joints are off in this scene", "see effects.joints")
        return known[self._row]

    @property
    def _unit(self) -> float:
        return 1.0 if self._joint.kind in ("hinge", "ball") else self._simulator.units.length

    @property
    def _aim(self) -> float:
        """rad or m, or rad/s or m/s, in one model unit of the target."""
        motor = self._joint.motor
        if motor is None or self._simulator.bodies.joints is None:
            raise SdfsimError(f"joint {self.name!r}: has no motor", "give it one in the scene: joints[].motor")
        return self._unit if motor.speed is None else self._unit / self._simulator.units.time

    def _coordinate(self, what: str, *kinds: str) -> float:
        if self._joint.kind not in kinds:
            raise SdfsimError(f"joint {self.name!r}: is a {self._joint.kind}, which has no {what}")
        return float(self._state[COORD]) * self._unit
