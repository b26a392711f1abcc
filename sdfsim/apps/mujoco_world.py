"""MuJoCo on a scene, through the file that `export` writes for it."""

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sdfsim.apps.export import STEP, Collide, export, plain_names
from sdfsim.base.errors import SdfsimError
from sdfsim.base.lazy import optional
from sdfsim.scene.scene import Scene

MEMORY = 2**31  # bytes; contacts of many pieces need more than the file asks for


class Unstable(SdfsimError):
    """An engine gave up on a motion."""


class MujocoWorld:
    """A scene in MuJoCo, at its start.

    Masses, inertias, velocities, joints and the coefficients of every pair are those of the file; the springs of its
    contacts, which give restitution, are as stiff as `step` allows.

    Args:
        step: s, of the engine.
        collide: convex pieces, or distances that MuJoCo samples from the meshes.
        contact: time constant, s, and damping relative to the critical one, of all contacts, in place of the file's.
        impratio: stiffness of friction relative to that across the contact; None: the file's.

    Raises:
        SdfsimError: MuJoCo is not installed, the scene has shapes without convex pieces, or MuJoCo refuses it.
    """

    def __init__(
        self, scene: Scene, step: float, *, collide: Collide = "pieces",
        cone: Literal["elliptic", "pyramidal"] = "elliptic", contact: tuple[float, float] | None = None,
        impratio: float | None = None,
    ) -> None:  # fmt: skip
        self.engine: Any = optional("mujoco", "MuJoCo", "bench")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.xml"
            export(scene, file, collide=collide)
            spec = self.engine.MjSpec.from_file(str(file))
            spec.memory, spec.option.timestep = MEMORY, step
            spec.option.cone = getattr(self.engine.mjtCone, f"mjCONE_{cone.upper()}")
            spec.option.impratio = impratio or spec.option.impratio
            if scene.effects.contact == "off":
                spec.option.disableflags |= self.engine.mjtDisableBit.mjDSBL_CONTACT
            try:
                self.model = spec.compile()
            except ValueError as error:
                raise SdfsimError(f"MuJoCo: {error}") from error
        for springs in (self.model.geom_solref, self.model.pair_solref):
            springs[:, 0] *= step / STEP
            if contact:
                springs[:] = max(contact[0], 2.0 * step), contact[1]
        names = zip(plain_names([body.name for body in scene.bodies]), scene.bodies, strict=True)
        self.moving = np.array([self.model.body(name).id for name, body in names if body.motion == "dynamic"])
        self.data: Any = self.engine.MjData(self.model)
        self.engine.set_mju_user_warning(lambda message: None)  # by default they go to a file in the working directory
        kinds = self.engine.mjtWarning
        self.unstable = [int(kind) for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)]
        self.reset()

    def reset(self) -> None:
        """Back to the start."""
        if self.model.nkey:
            self.engine.mj_resetDataKeyframe(self.model, self.data, 0)

    def advance(self, count: int) -> None:
        """Make `count` steps. Raises Unstable."""
        self.engine.mj_step(self.model, self.data, count)
        if any(self.data.warning[kind].number for kind in self.unstable):
            raise Unstable("MuJoCo found the motion unstable and reset it")

    def state(self) -> tuple[np.ndarray, ...]:
        """Of the dynamic bodies' centres of mass: positions [M, 3] m, orientations [M, 4] xyzw of the shapes' axes,
        velocities [M, 3] m/s and angular velocities [M, 3] rad/s, in the world."""
        for known in (self.engine.mj_kinematics, self.engine.mj_comPos, self.engine.mj_comVel):
            known(self.model, self.data)
        place, spin = self.data.xipos[self.moving], self.data.cvel[self.moving, :3]
        arm = place - self.data.subtree_com[self.model.body_rootid[self.moving]]
        speed = self.data.cvel[self.moving, 3:] + np.cross(spin, arm)
        return place, np.roll(self.data.xquat[self.moving], -1, axis=-1), speed, spin
