"""The teacher: PyBullet with Kubric's settings (an optional extra, `pip install sdfsim[data]`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdfsim.errors import SdfsimError
from sdfsim.files import write_text

SUBSTEP = 1.0 / 250.0  # s
SUBSTEPS = 5
DT = SUBSTEP * SUBSTEPS  # s, one recorded step
ENGINE_SETTINGS = {
    "restitutionVelocityThreshold": 0.0,
    "warmStartingFactor": 0.0,
    "useSplitImpulse": True,
    "contactSlop": 0.0,
    "enableConeFriction": False,
    "deterministicOverlappingPairs": True,
}
FAR = (0.0, 0.0, -100.0)  # m, where bodies wait to be placed
URDF_TEMPLATE = """<robot name="body"><link name="base">
<inertial><origin xyz="0 0 0"/><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<collision><origin xyz="{x} {y} {z}"/><geometry><mesh filename="{mesh}"/></geometry></collision>
</link></robot>
"""


@dataclass(frozen=True)
class TeacherBody:
    """One body as the engine needs it.

    Attributes:
        urdf: file whose collision mesh is an OBJ with one convex piece per group.
        scale: uniform size factor.
        mass: kg (0 for static).
        friction: lateral friction coefficient.
        restitution: coefficient of restitution.
    """

    urdf: Path
    scale: float
    mass: float
    friction: float
    restitution: float


def import_pybullet():
    """The `pybullet` module. Raises SdfsimError when the `data` extra is not installed."""
    try:
        import pybullet
    except ImportError as error:
        raise SdfsimError("PyBullet is not installed", "pip install 'sdfsim[data]'") from error
    return pybullet


def write_urdf(mesh: Path, com: np.ndarray, path: Path) -> Path:
    """Write a URDF whose base frame sits at the centre of mass `com` [3] m of `mesh` (an OBJ).

    A relative `mesh` is looked for from the folder of the URDF, so that both can be moved together.
    """
    write_text(path, URDF_TEMPLATE.format(mesh=mesh, x=-com[0], y=-com[1], z=-com[2]))
    return path


class Teacher:
    """A PyBullet world with an optional infinite floor at z = 0.

    Args:
        gravity: [3] m/s^2.
        floor: (friction, restitution) of the floor, or None for no floor.
        substeps: of the engine in one recorded step; the recordings have `SUBSTEPS`.
    """

    def __init__(
        self, gravity: np.ndarray, floor: tuple[float, float] | None = (0.3, 0.5), substeps: int = SUBSTEPS
    ) -> None:
        self.pb = import_pybullet()
        self.substeps = substeps
        self.client = self.pb.connect(self.pb.DIRECT)
        self.bodies: list[int] = []
        self._call("setPhysicsEngineParameter", **ENGINE_SETTINGS)
        self._call("setGravity", *gravity)
        self._call("setTimeStep", DT / substeps)
        if floor is not None:
            # A very large box, as in Kubric: its upper face is z = 0.
            shape = self._call("createCollisionShape", self.pb.GEOM_BOX, halfExtents=[100.0, 100.0, 1.0])
            ground = self._call("createMultiBody", 0.0, shape, basePosition=[0.0, 0.0, -1.0])
            self._call("changeDynamics", ground, -1, lateralFriction=floor[0], restitution=floor[1])

    def _call(self, name: str, *args, **kwargs):
        return getattr(self.pb, name)(*args, **kwargs, physicsClientId=self.client)

    def add(
        self,
        body: TeacherBody,
        position: np.ndarray | tuple[float, ...] = FAR,
        quat: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
    ) -> int:
        """Add a body with its centre of mass at `position` [3] m, orientation `quat` [4] xyzw; returns its index."""
        handle = self._call(
            "loadURDF",
            str(body.urdf),
            basePosition=list(position),
            baseOrientation=list(quat),
            globalScaling=body.scale,
            useFixedBase=int(body.mass == 0),
        )
        self._call(
            "changeDynamics",
            handle,
            -1,
            mass=body.mass,
            lateralFriction=body.friction,
            restitution=body.restitution,
            linearDamping=0.0,
            angularDamping=0.0,
            activationState=self.pb.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        self.bodies.append(handle)
        return len(self.bodies) - 1

    def overlaps(self, index: int) -> bool:
        """Whether body `index` touches or penetrates anything."""
        self._call("performCollisionDetection")
        return bool(self._call("getContactPoints", self.bodies[index]))

    def penetrates(self, index: int) -> bool:
        """Whether body `index` is inside anything; to touch is allowed."""
        self._call("performCollisionDetection")
        return any(contact[8] < 0.0 for contact in self._call("getContactPoints", self.bodies[index]))

    def inertia(self, index: int) -> np.ndarray:
        """[3] kg m^2: the diagonal that the engine uses, body axes."""
        return np.array(self._call("getDynamicsInfo", self.bodies[index], -1)[2])

    def place(self, index: int, position: np.ndarray, quat: np.ndarray) -> None:
        """Move body `index` without giving it a velocity."""
        self._call("resetBasePositionAndOrientation", self.bodies[index], list(position), list(quat))

    def push(self, index: int, velocity: np.ndarray, angular_velocity: np.ndarray) -> None:
        """Set linear [3] m/s and angular [3] rad/s velocity, world frame."""
        self._call("resetBaseVelocity", self.bodies[index], list(velocity), list(angular_velocity))

    def run(self, steps: int) -> dict[str, np.ndarray]:
        """Simulate `steps` recorded steps of `DT`.

        Returns:
            position [steps+1, N, 3] m, quat_xyzw [steps+1, N, 4], velocity and angular_velocity
            [steps+1, N, 3] in m/s and rad/s; entry 0 is the state at the call.
        """
        frames = [self._state()]
        for _ in range(steps):
            for _ in range(self.substeps):
                self._call("stepSimulation")
            frames.append(self._state())
        position, quat, velocity, angular = (np.array(a) for a in zip(*frames, strict=True))
        return {"position": position, "quat_xyzw": quat, "velocity": velocity, "angular_velocity": angular}

    def _state(self) -> tuple[list, list, list, list]:
        poses = [self._call("getBasePositionAndOrientation", b) for b in self.bodies]
        speeds = [self._call("getBaseVelocity", b) for b in self.bodies]
        return [p[0] for p in poses], [p[1] for p in poses], [s[0] for s in speeds], [s[1] for s in speeds]

    def close(self) -> None:
        """Leave the engine."""
        self.pb.disconnect(self.client)

    def __enter__(self) -> Teacher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
