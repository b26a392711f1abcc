"""The teacher: PyBullet with Kubric's settings (an optional extra, `pip install sdfsim[data]`).

Line numbers are those of Kubric: `sim` is kubric/simulator/pybullet.py, `ab` and `c` are
challenges/movi/movi_*_worker.py. As there: maximal coordinates (sim:84, 100, 125, floor too; btRigidBody in place of
btMultiBody, so no damping), contacts at a distance <= 0 (sim:85, 101, 133), restitution from any speed on (sim:38:
threshold 0), impulses from 0 in each inner step (sim:38), split impulse below -40 mm, otherwise 8 % of a depth become
speed in each step (sim:39), no contact slop (sim:39), two bounds of friction, along the slip and across (sim:39; the
cone is read for btMultiBody only), deterministic pairs (sim:40), 50 iterations or a residual below 1e-7, no sleeping,
no rolling friction, products of the two bodies' friction and restitution, gravity of (0, 0, -10) (core/scene.py:67),
the inertia of the hulls' bounding box, and a margin of 1 mm around hulls. Recorded velocities are those that the next
inner step starts from.

Otherwise: inner steps of 1/250 s (1/240 s there, core/scene.py:66) and 50 or 60 frames a second (12 there, ab:72),
which they divide; the floor is a box with its top at z = 0 (there a dome, ab:87, c:95, whose margin lies on top of
it; rebounds are as high); spheres of our own recipes are exact. Before the first inner step the engine makes an extra
one, with the bodies far apart, because it uses the inertias of a mass of 1 kg in its first step; bodies that start in
the air move the same.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text
from sdfsim.base.lazy import optional

TEACHER_VERSION = 2  # written to `dataset.json`; datasets of another version are refused
DT = 0.02  # s, one recorded step
SUBSTEPS = 5  # inner steps in it
SUBSTEP = DT / SUBSTEPS  # s
ENGINE_SETTINGS = {
    "restitutionVelocityThreshold": 0.0,
    "warmStartingFactor": 0.0,
    "useSplitImpulse": True,
    "contactSlop": 0.0,
    "enableConeFriction": False,
    "deterministicOverlappingPairs": True,
}
BODY_SETTINGS = {"contactProcessingThreshold": 0.0}
MAXIMAL = {"useMaximalCoordinates": True}
FAR = (0.0, 0.0, -100.0)  # m, where bodies wait to be placed
UNTURNED = (0.0, 0.0, 0.0, 1.0)
APART = 1000.0  # m between bodies that must not touch
Vector = np.ndarray | tuple[float, ...]
URDF_TEMPLATE = """<robot name="body"><link name="base">
<inertial><origin xyz="0 0 0"/><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<collision><origin xyz="0 0 0"/><geometry>{geometry}</geometry></collision>
</link></robot>
"""


@dataclass(frozen=True)
class TeacherBody:
    """One body as the engine needs it."""

    urdf: Path  # file whose collision mesh is an OBJ with one convex piece per group, or an exact form
    scale: float  # uniform size factor
    mass: float  # kg (0 for static)
    friction: float  # lateral friction coefficient
    restitution: float  # coefficient of restitution


def import_pybullet():
    """The `pybullet` module. Raises NotInstalled."""
    return optional("pybullet", "PyBullet", "data")


def write_urdf(geometry: str, path: Path) -> Path:
    """Write the URDF of a body about its centre of mass; `geometry` is its element, such as '<sphere radius="1"/>' or
    '<mesh filename="NAME.obj"/>', where a relative path starts at the URDF."""
    write_text(path, URDF_TEMPLATE.format(geometry=geometry))
    return path


def engine_settings(step: float, substeps: int) -> dict:
    """The engine settings in `dataset.json`, for recorded steps of `step` s in `substeps` inner ones."""
    return ENGINE_SETTINGS | BODY_SETTINGS | MAXIMAL | {"timeStep": step / substeps}


def substeps_of(step: float) -> int:
    """Inner steps in a recorded step of `step` s. Raises SdfsimError if the teacher does not record at this rate."""
    if abs(step - DT) < 1e-9:
        return SUBSTEPS
    raise SdfsimError(f"a recorded step of {step:g} s: this teacher records steps of {DT:g} s")


class Teacher:
    """A PyBullet world under gravity [3] m/s^2 with recorded steps of `step` s in `substeps` inner ones, and an
    infinite floor at z = 0 with this friction and restitution, unless it is None."""

    def __init__(
        self, gravity: np.ndarray, floor: tuple[float, float] | None = (0.3, 0.5), *, step: float = DT,
        substeps: int = SUBSTEPS,
    ) -> None:  # fmt: skip
        self.pb = import_pybullet()
        self.substeps = substeps
        self.client = self.pb.connect(self.pb.DIRECT)
        self.bodies: list[int] = []  # the engine's handles, by body index
        self._floor: int | None = None
        self._settled = True
        self._gravity = gravity
        self._call("setPhysicsEngineParameter", **ENGINE_SETTINGS)
        self._call("setGravity", *gravity)
        self._call("setTimeStep", step / substeps)
        if floor is not None:
            shape = self._call("createCollisionShape", self.pb.GEOM_BOX, halfExtents=[100.0, 100.0, 1.0])
            self._floor = self._call("createMultiBody", 0.0, shape, basePosition=[0.0, 0.0, -1.0], **MAXIMAL)
            surface = {"lateralFriction": floor[0], "restitution": floor[1]}
            self._call("changeDynamics", self._floor, -1, **surface, **BODY_SETTINGS)

    def _call(self, name: str, *args, **kwargs):
        return getattr(self.pb, name)(*args, **kwargs, physicsClientId=self.client)

    def add(self, body: TeacherBody, position: Vector = FAR, quat: Vector = UNTURNED) -> int:
        """Add a body with its centre of mass at `position` [3] m, orientation `quat` [4] xyzw; returns its index."""
        # Added far away and then moved, because the engine's order of pairs depends on it.
        given = {"basePosition": FAR, "globalScaling": body.scale, "useFixedBase": int(body.mass == 0)}
        # Exact cylinders, not prisms of 32 sides.
        handle = self._call("loadURDF", str(body.urdf), flags=self.pb.URDF_USE_IMPLICIT_CYLINDER, **given, **MAXIMAL)
        surface = {"lateralFriction": body.friction, "restitution": body.restitution}
        self._call("changeDynamics", handle, -1, mass=body.mass, **surface, **BODY_SETTINGS)
        self.bodies.append(handle)
        self._settled = False
        index = len(self.bodies) - 1
        self.place(index, position, quat)
        return index

    def overlaps(self, index: int) -> bool:
        """Whether body `index` touches or penetrates anything; convex pieces have a margin of 1 mm."""
        mine = self.bodies[index]
        others = [other for other in (self._floor, *self.bodies) if other not in (None, mine)]
        return any(self._call("getClosestPoints", mine, other, 0.0) for other in others)

    def inertia(self, index: int) -> np.ndarray:
        """[3] kg m^2: the diagonal that the engine uses, body axes."""
        return np.array(self._call("getDynamicsInfo", self.bodies[index], -1)[2])

    def set_inertia(self, index: int, diagonal: np.ndarray) -> None:
        """Replace the inertia of body `index` by `diagonal` [3] kg m^2, body axes."""
        handle = self.bodies[index]
        # Without a mass the engine takes that of its previous command.
        mass = self._call("getDynamicsInfo", handle, -1)[0]
        self._call("changeDynamics", handle, -1, mass=mass, localInertiaDiagonal=list(diagonal))
        self._settled = False

    def place(self, index: int, position: Vector, quat: Vector) -> None:
        """Move body `index` to `position` [3] m, orientation `quat` [4] xyzw; its velocity becomes 0."""
        self._call("resetBasePositionAndOrientation", self.bodies[index], list(position), list(quat))

    def push(self, index: int, velocity: Vector, angular_velocity: Vector) -> None:
        """Set linear [3] m/s and angular [3] rad/s velocity, world frame."""
        self._call("resetBaseVelocity", self.bodies[index], list(velocity), list(angular_velocity))

    def run(self, steps: int) -> dict[str, np.ndarray]:
        """Simulate `steps` recorded steps: position [steps+1, N, 3] m, orientation [steps+1, N, 4], velocity and
        angular_velocity [steps+1, N, 3] in m/s and rad/s; entry 0 is the state at the call."""
        if not self._settled:
            self._settle()
        frames = [self._state()]
        for _ in range(steps):
            for _ in range(self.substeps):
                self._call("stepSimulation")
            frames.append(self._state())
        position, quat, velocity, angular = (np.array(a) for a in zip(*frames, strict=True))
        return {"position": position, "orientation": quat, "velocity": velocity, "angular_velocity": angular}

    def _state(self) -> tuple[list, list, list, list]:
        poses = [self._call("getBasePositionAndOrientation", b) for b in self.bodies]
        speeds = [self._call("getBaseVelocity", b) for b in self.bodies]
        return [p[0] for p in poses], [p[1] for p in poses], [s[0] for s in speeds], [s[1] for s in speeds]

    def _settle(self) -> None:
        """Make one inner step with the moving bodies far from everything, and put them back as they were.

        The engine converts inertias to world axes only at the end of a step. Bodies that touch something in their first
        step would react with the inertia of the URDF's 1 kg.
        """
        state = list(zip(*self._state(), strict=True))
        moving = [i for i, body in enumerate(self.bodies) if self._call("getDynamicsInfo", body, -1)[0] > 0]
        for i in moving:
            self.place(i, (APART * (i + 1), 0.0, -APART), state[i][1])
        self._call("setGravity", 0.0, 0.0, 0.0)
        self._call("stepSimulation")
        self._call("setGravity", *self._gravity)
        for i in moving:
            position, quat, velocity, angular = state[i]
            self.place(i, position, quat)
            self.push(i, velocity, angular)
        self._settled = True

    def __enter__(self) -> "Teacher":
        return self

    def __exit__(self, *_: object) -> None:
        self.pb.disconnect(self.client)
