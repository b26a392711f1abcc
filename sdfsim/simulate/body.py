"""Bodies of a running simulation by name, and their contact points: metres, kilograms and seconds, NumPy arrays."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, Units
from sdfsim.physics.options import Options
from sdfsim.scene.scene import Frame, Scene
from sdfsim.simulate.steppers import Stepper

Numbers = Sequence[float] | np.ndarray


class LiveScene(ABC):
    """A scene in motion, in model units. It records which bodies the user changes, and announces them to the
    stepper."""

    scene: Scene
    units: Units
    bodies: Bodies
    stepper: Stepper
    options: Options

    def __init__(self, state: State) -> None:
        self._state, self._handed = state, False
        self._changed: set[int] = set()

    @property
    def state(self) -> State:
        """Everything that is needed to continue a run: poses and velocities, pulling forces, contacts, sleep, joints
        with the targets of their motors, and the time. `restore` continues from it, and `state.save("state.npz")`
        writes it to a file. It contains neither `options` (such as gravity) nor the scene.

        Set it to start from another state, or to change bodies, as in `simulator.state = replace(simulator.state,
        time=0.0)`. Its arrays must not be written to. Raises SimulationError if the new state is invalid.
        """
        self._accept()  # a saved state must include every change, or sleeping bodies would sleep on
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        self._fits(state)
        self._state, self._handed = state, True

    def _fits(self, state: State) -> None:
        """Raises SdfsimError if `state` is not a state of this scene."""
        if not isinstance(state, State):
            message = f"state: must be a State, such as simulator.state was before (got a {type(state).__name__})"
            raise SdfsimError(message, "what step() returns is in metres and seconds, and not enough to continue from")
        given = len(state.position), 0 if state.joints is None else len(state.joints)
        known = len(self.bodies), 0 if self.bodies.joints is None else len(self.bodies.joints)
        if given != known:
            message = "state: is of another scene (it has {} bodies and {} joints, this one {} and {})"
            raise SdfsimError(message.format(*given, *known))

    @property
    def now(self) -> State:
        """The state, with changes since the last step that the stepper does not know yet: many changes are announced
        together."""
        return self._state

    @abstractmethod
    def alter(self, name: str, **fields: float) -> None:
        """Give a body another mass, friction or restitution."""

    @abstractmethod
    def _row(self, name: str) -> int:
        """The row of a body; raises SdfsimError if there is none of this name."""

    def change(self, row: int, **fields: np.ndarray | None) -> None:
        """Replace fields of the state that differ only in the row of one body."""
        self._state = replace(self._state, **fields)
        self._changed.add(row)

    @abstractmethod
    def _accept(self) -> None:
        """Check the user's changes, and announce them to the stepper."""


@dataclass(frozen=True)
class ContactPoint:
    """A point where two bodies touch.

    Attributes:
        first, second: names of the bodies.
        point: [3] m, world, on the surface of the first.
        normal: [3] unit vector from the second to the first.
        impulse: [3] N s on the first body in the last inner step of the contact solve; the second gets the opposite.
        force: [3] N, the mean in that inner step. If a body touches at many points, physics determines only the sum of
            the forces and their moment; their distribution over the points is one choice of many.
        penetration: m, depth of the overlap; below 0 if the bodies are still apart.
    """

    first: str
    second: str
    point: np.ndarray
    normal: np.ndarray
    impulse: np.ndarray
    force: np.ndarray
    penetration: float


class BodyHandle:
    """One body of a simulator, by its `name`: read it, set it, push and pull it. Changes take effect from the next step
    on."""

    __slots__ = ("_simulator", "name")  # so that a misspelt name does not make a new attribute

    def __init__(self, simulator: LiveScene, name: str) -> None:
        self._simulator, self.name = simulator, name

    @property
    def _row(self) -> int:
        return self._simulator._row(self.name)

    @property
    def centre(self) -> np.ndarray:
        """[3] m, the centre of mass, world."""
        return self._of("position") * self._simulator.units.length

    @property
    def position(self) -> np.ndarray:
        """[3] m, the origin of the body's shape, world, as in a scene file."""
        return self.centre - self._arm(self._of("orientation"))

    @position.setter
    def position(self, place: Numbers) -> None:
        arm = self._arm(self._of("orientation"))
        self._set("position", (vector("position", place) + arm) / self._simulator.units.length)

    @property
    def quat_xyzw(self) -> np.ndarray:
        """[4] unit quaternion, the shape's axes -> world; setting it turns the body about its centre of mass."""
        return self._of("orientation")

    @quat_xyzw.setter
    def quat_xyzw(self, quat: Numbers) -> None:
        turned = vector("quat_xyzw", quat, 4)
        length = np.linalg.norm(turned)
        if not length > 0:
            raise SdfsimError("quat_xyzw: must not be zero")
        self._set("orientation", turned / length)

    @property
    def velocity(self) -> np.ndarray:
        """[3] m/s, velocity of the centre of mass, world."""
        return self._of("velocity") * self._simulator.units.velocity

    @velocity.setter
    def velocity(self, velocity: Numbers) -> None:
        self._set("velocity", vector("velocity", velocity) / self._simulator.units.velocity)

    @property
    def angular_velocity(self) -> np.ndarray:
        """[3] rad/s, world."""
        return self._of("angular_velocity") / self._simulator.units.time

    @angular_velocity.setter
    def angular_velocity(self, angular: Numbers) -> None:
        self._set("angular_velocity", vector("angular_velocity", angular) * self._simulator.units.time)

    @property
    def mass(self) -> float:
        """kg; 0 for a body that is not dynamic. Setting it scales the inertia."""
        return float(self._simulator.bodies.mass[self._row]) * self._simulator.units.mass

    @mass.setter
    def mass(self, mass: float) -> None:
        self._simulator.alter(self.name, mass=mass)

    @property
    def friction(self) -> float:
        """Coulomb coefficient; a contact has the product of both bodies'."""
        return self._simulator.scene.bodies[self._row].friction

    @friction.setter
    def friction(self, friction: float) -> None:
        self._simulator.alter(self.name, friction=friction)

    @property
    def restitution(self) -> float:
        """Coefficient of restitution; a contact has the product of both bodies'."""
        return self._simulator.scene.bodies[self._row].restitution

    @restitution.setter
    def restitution(self, restitution: float) -> None:
        self._simulator.alter(self.name, restitution=restitution)

    @property
    def inertia(self) -> np.ndarray:
        """[3, 3] kg m^2, about the centre of mass, in the shape's axes; has no meaning for a body that is not
        dynamic."""
        sim = self._simulator
        return sim.bodies.inertia[self._row] * sim.units.mass * sim.units.length**2

    @property
    def asleep(self) -> bool:
        """Whether the body sleeps: it is at rest, and costs nothing until something disturbs it."""
        touch = self._simulator.state.touch
        return touch is not None and bool(touch.island[self._row] >= 0)

    def push(self, impulse: Numbers, at: Numbers | None = None) -> None:
        """Change the body's velocities now by an impulse [3] N s that acts at the point `at` [3] m, world, or at the
        centre of mass. Raises SdfsimError if the body is not dynamic."""
        self._must_move("be pushed")
        given = vector("impulse", impulse)
        self.velocity = self.velocity + given / self.mass
        if at is not None and self._simulator.options.rotation:
            sim, row = self._simulator, self._row
            turn = np.cross(vector("at", at) - self.centre, given)
            axes = pose.to_matrix(sim.now.orientation[row])
            self.angular_velocity = self.angular_velocity + np.linalg.solve(axes @ self.inertia @ axes.T, turn)

    def pull(
        self, force: Numbers = (0.0, 0.0, 0.0), at: Numbers | None = None, torque: Numbers = (0.0, 0.0, 0.0)
    ) -> None:
        """Apply a force [3] N and a torque [3] N m, in world axes, from now until the next call or `reset`; `pull()`
        ends both.

        The force acts at the point `at` [3] m, world, or at the centre of mass. Its moment about the centre of mass
        stays the same however the body moves: call again after a step to follow the point. The torque is added to it.
        Raises SdfsimError if the body is not dynamic, or if the model does not support forces.
        """
        self._must_move("be pulled")
        sim = self._simulator
        if not sim.stepper.forces:
            raise SdfsimError("networks have no inputs for forces", "use the solver")
        given, moment = vector("force", force), vector("torque", torque)
        if at is not None:
            moment = moment + np.cross(vector("at", at) - self.centre, given)
        u, state = sim.units, sim.now
        load = np.zeros((len(sim.bodies), 6)) if state.load is None else state.load.copy()
        load[self._row, :3] = given / (u.mass * u.acceleration)
        load[self._row, 3:] = moment / u.energy
        sim.change(self._row, load=load if load.any() else None)

    def _of(self, name: str) -> np.ndarray:
        return getattr(self._simulator.now, name)[self._row].copy()

    def _arm(self, quat: np.ndarray) -> np.ndarray:
        """[3] m from the shape's origin to the centre of mass, world."""
        sim = self._simulator
        return pose.rotate(quat, sim.bodies.com[self._row]) * sim.units.length

    def _set(self, name: str, value: np.ndarray) -> None:
        sim = self._simulator
        if sim.scene.bodies[self._row].motion == "kinematic" or "velocity" in name:
            self._must_move(f"be given a {name.replace('_', ' ')}")
        array = getattr(sim.now, name).copy()
        array[self._row] = value
        sim.change(self._row, **{name: array})

    def _must_move(self, what: str) -> None:
        motion = self._simulator.scene.bodies[self._row].motion
        if motion != "dynamic":
            raise SdfsimError(f"body {self.name!r}: is {motion}, so it cannot {what}")


class FrameHandle:
    """A frame of a simulator, by its `name`: a pose that moves with a body."""

    __slots__ = ("_frame", "_simulator", "name")

    def __init__(self, simulator: LiveScene, frame: Frame) -> None:
        self._simulator, self._frame, self.name = simulator, frame, frame.name

    @property
    def position(self) -> np.ndarray:
        """[3] m, world."""
        body = self._body
        if body is None:
            return self._frame.position + 0.0
        return body.position + pose.rotate(body.quat_xyzw, self._frame.position)

    @property
    def quat_xyzw(self) -> np.ndarray:
        """[4] unit quaternion, the frame's axes -> world."""
        own, body = self._frame.quat_xyzw, self._body
        return own + 0.0 if body is None else pose.multiply(body.quat_xyzw, own)

    @property
    def velocity(self) -> np.ndarray:
        """[3] m/s, of the frame's origin, world."""
        body = self._body
        if body is None:
            return np.zeros(3)
        return body.velocity + np.cross(body.angular_velocity, self.position - body.centre)

    @property
    def angular_velocity(self) -> np.ndarray:
        """[3] rad/s, world."""
        return np.zeros(3) if self._body is None else self._body.angular_velocity

    @property
    def _body(self) -> BodyHandle | None:
        row = self._frame.body
        return None if row < 0 else BodyHandle(self._simulator, self._simulator.scene.bodies[row].name)


def vector(name: str, values: Numbers, length: int = 3) -> np.ndarray:
    """[length] float64. Raises SdfsimError for anything else than finite numbers of this count."""
    found = np.asarray(values, dtype=np.float64)
    if found.shape != (length,) or not np.isfinite(found).all():
        raise SdfsimError(f"{name}: must be {length} finite numbers (got {values!r})")
    return found
