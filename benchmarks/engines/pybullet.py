"""PyBullet with its default settings and joints, through the URDFs that `export` writes. The teacher, which makes our
recordings with other settings, is `bullet` of `sdfsim.evaluation.engines`."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.apps.export import export, plain_names
from sdfsim.apps.export_joints import speed_of, trees
from sdfsim.data.pybullet_sim import import_pybullet
from sdfsim.scene.scene import Scene


class BulletWorld:
    """A scene in PyBullet, at its start. What a URDF cannot say is set here: poses, velocities, the angles and friction
    of joints, and that bodies in flight lose no speed. Raises SdfsimError if PyBullet is not installed."""

    def __init__(self, scene: Scene, step: float) -> None:
        self.engine: Any = import_pybullet()
        self.here = {"physicsClientId": self.engine.connect(self.engine.DIRECT)}
        self.engine.setGravity(*scene.gravity, **self.here)
        self.engine.setTimeStep(step, **self.here)
        tree, names = trees(scene), plain_names([body.name for body in scene.bodies], ascii=True)
        self.of: dict[int, tuple[int, int]] = {}  # the engine's body and link
        with tempfile.TemporaryDirectory() as folder:
            export(scene, Path(folder) / "scene.urdf")
            for k in tree.order:
                if k not in tree.above:
                    self._load(scene, k, Path(folder) / f"scene.{names[k]}.urdf", names)
        for k, one in tree.above.items():
            robot, link = self.of[k]
            self.engine.resetJointState(robot, link, one.joint.start, *speed_of(scene, one, k), **self.here)
            drag = {"targetVelocity": 0.0, "force": one.joint.friction}
            self.engine.setJointMotorControl2(robot, link, self.engine.VELOCITY_CONTROL, **drag, **self.here)
        self.moving = [self.of[k] for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]

    def _load(self, scene: Scene, k: int, file: Path, names: list[str]) -> None:
        body, flags = scene.bodies[k], self.engine.URDF_USE_INERTIA_FROM_FILE | self.engine.URDF_USE_IMPLICIT_CYLINDER
        robot = self.engine.loadURDF(str(file), useFixedBase=body.motion != "dynamic", flags=flags, **self.here)
        self.of[k] = robot, -1
        for link in range(self.engine.getNumJoints(robot, **self.here)):
            self.of[names.index(self.engine.getJointInfo(robot, link, **self.here)[12].decode())] = robot, link
        com = Rotation.from_quat(body.quat_xyzw).apply(body.scale * scene.shapes[body.shape].com)
        self.engine.resetBasePositionAndOrientation(robot, body.position + com, body.quat_xyzw, **self.here)
        self.engine.resetBaseVelocity(robot, body.velocity, body.angular_velocity, **self.here)
        for link in range(-1, self.engine.getNumJoints(robot, **self.here)):
            self.engine.changeDynamics(robot, link, linearDamping=0.0, angularDamping=0.0, **self.here)

    def advance(self, count: int) -> None:
        for _ in range(count):
            self.engine.stepSimulation(**self.here)

    def state(self) -> tuple[np.ndarray, ...]:
        """Of the dynamic bodies' centres of mass: positions [M, 3] m, orientations [M, 4] xyzw of the principal axes,
        velocities [M, 3] m/s and angular velocities [M, 3] rad/s, in the world."""
        found = []
        for robot, link in self.moving:
            if link < 0:
                pose, speed = (of(robot, **self.here) for of in (
                    self.engine.getBasePositionAndOrientation, self.engine.getBaseVelocity
                ))  # fmt: skip
                found.append((*pose, *speed))
            else:
                known = self.engine.getLinkState(robot, link, 1, 1, **self.here)
                found.append((*known[:2], *known[6:8]))
        return tuple(map(np.array, zip(*found, strict=True)))

    def __enter__(self) -> "BulletWorld":
        return self

    def __exit__(self, *_: object) -> None:
        self.engine.disconnect(**self.here)
