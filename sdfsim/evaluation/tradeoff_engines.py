"""What our simulator is compared with: the teacher at its own and at coarser steps, and MuJoCo, on the same pieces."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import DT
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.baselines import perturbed, started
from sdfsim.evaluation.tradeoff_cases import Cases
from sdfsim.evaluation.tradeoff_contenders import Prepared, Timed, together

SOFTEST = 3.0  # MuJoCo: time constant of a contact over the engine's step, at least 2 for it to be stable


@dataclass(frozen=True)
class Engine:
    """An engine at one step.

    Attributes:
        name: PyBullet or MuJoCo.
        substeps: of its steps in a recorded one.
        off: m/s, by which its starts differ from the recorded ones: with it, it is the chaos floor.
    """

    name: str
    substeps: int
    off: float = 0.0
    one_core: bool = True

    @property
    def kind(self) -> str:
        return "floor" if self.off else "engine"

    @property
    def key(self) -> str:
        return f"{self.name.lower()}__{self.substeps}" + (f"__off-{self.off:g}" if self.off else "")

    @property
    def label(self) -> str:
        off = f", starts {self.off:g} m/s off" if self.off else ""
        return f"{self.name} {1e3 * DT / self.substeps:.3g} ms{off}"

    def describe(self) -> dict[str, Any]:
        return {"engine": self.name, "substeps": self.substeps, "off": self.off}

    def prepare(self, cases: Cases) -> Prepared:
        """Raises SdfsimError when the engine is not installed, or the geometry that it needs is not at hand."""
        if abs(cases.recorded[0].dt - DT) > 1e-9:
            raise SdfsimError(f"recorded with another step than {DT} s")
        return _PyBullet(self, cases) if self.name == "PyBullet" else _MuJoCo(self, cases)


@dataclass
class _PyBullet:
    """See `Prepared`."""

    engine: Engine
    cases: Cases

    def __post_init__(self) -> None:
        if lacking := [name for name in self.cases.shapes if name not in self.cases.urdfs]:
            raise SdfsimError(f"no engine file of {', '.join(lacking)} at hand")
        self.starts = [perturbed(t, self.engine.off, [0, k]) for k, t in enumerate(self.cases.recorded)]

    def motions(self) -> list[Trajectory]:
        return [self._run(t, self.cases.steps)[0] for t in self.starts]

    def timed(self) -> Timed:
        return together([self._run(self.starts[k], self.cases.timed_steps)[1] for k in self.cases.timed])

    def fitted_s(self) -> float | None:
        return None

    def _run(self, start: Trajectory, steps: int) -> tuple[Trajectory, Timed]:
        with started(start, self.cases.urdfs, self.cases.floor, self.engine.substeps) as teacher:
            first, parts = time.perf_counter(), [teacher.run(1)]
            first = time.perf_counter() - first
            wall, cpu = time.perf_counter(), time.process_time()
            parts.append(teacher.run(steps - 1))
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        motion = {name: np.concatenate([parts[0][name][:1], parts[1][name]]) for name in parts[0]}
        return replace(start, **motion), _timed(start, motion["position"], wall, cpu, first, steps)


@dataclass
class _MuJoCo:
    """MuJoCo with the same convex pieces, masses, inertias and starts.

    It takes the larger of two coefficients of friction where the teacher multiplies, so the geoms that meet the floor
    carry the product with the floor's, and those that meet other bodies carry their square: exact for two bodies of one
    material. Its contacts are soft: the restitution wanted is that of a damped spring.
    """

    engine: Engine
    cases: Cases

    def __post_init__(self) -> None:
        try:
            import mujoco
        except ImportError as error:
            raise SdfsimError("MuJoCo is not installed", "pip install 'sdfsim[bench]'") from error
        if absent := [name for name, pieces in self.cases.pieces.items() if not pieces]:
            raise SdfsimError(f"no convex pieces of {', '.join(absent)} at hand")
        self.mujoco: Any = mujoco

    def motions(self) -> list[Trajectory]:
        return [self._run(t, self.cases.steps)[0] for t in self.cases.starts]

    def timed(self) -> Timed:
        cases = self.cases
        return together([self._run(cases.starts[k], cases.timed_steps)[1] for k in cases.timed])

    def fitted_s(self) -> float | None:
        return None

    def _run(self, start: Trajectory, steps: int) -> tuple[Trajectory, Timed]:
        mujoco, model = self.mujoco, self._model(start)
        data = mujoco.MjData(model)
        self._place(data, start)
        frames = [self._frame(data, start)]
        first = wall = cpu = 0.0
        for k in range(steps):
            began, ran = time.perf_counter(), time.process_time()
            for _ in range(self.engine.substeps):
                mujoco.mj_step(model, data)
            frames.append(self._frame(data, start))
            took = time.perf_counter() - began
            if k == 0:
                first = took
            else:
                wall, cpu = wall + took, cpu + time.process_time() - ran
        position, quat, velocity, angular = (np.array(part) for part in zip(*frames, strict=True))
        motion = replace(start, position=position, quat_xyzw=quat, velocity=velocity, angular_velocity=angular)
        return motion, _timed(start, position, wall, cpu, first, steps)

    def _model(self, start: Trajectory) -> Any:
        mujoco = self.mujoco
        spec = mujoco.MjSpec()
        spec.option.timestep = start.dt / self.engine.substeps
        spec.option.gravity = start.gravity
        floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1.0])
        floor.contype, floor.conaffinity, floor.friction[0], floor.solmix = 0, 1, 0.0, 1e-6
        for i, name in enumerate(start.shape):
            body = spec.worldbody.add_body(name=f"b{i}")
            if not start.static[i]:
                body.add_freejoint()
                body.explicitinertial = True
                body.mass, body.inertia, body.ipos = float(start.mass[i]), start.inertia[i], np.zeros(3)
            else:
                body.pos, body.quat = start.position[0, i], np.roll(start.quat_xyzw[0, i], 1)
            for k, piece in enumerate(self.cases.pieces[str(name)]):
                mesh = f"m{i}_{k}"
                spec.add_mesh(name=mesh, uservert=(piece.vertices * start.scale[i]).ravel())
                for meets_floor in (True, False):
                    self._geom(body, mesh, start, i, meets_floor)
        return spec.compile()

    def _geom(self, body: Any, mesh: str, start: Trajectory, i: int, meets_floor: bool) -> None:
        geom = body.add_geom(type=self.mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh)
        friction, restitution = self.cases.floor if meets_floor else (start.friction[i], start.restitution[i])
        geom.contype, geom.conaffinity = (1, 0) if meets_floor else (2, 2)
        geom.condim = 3
        geom.friction[0] = start.friction[i] * friction
        bounce = float(np.clip(start.restitution[i] * restitution, 1e-3, 1.0))
        damping = -np.log(bounce) / np.hypot(np.pi, np.log(bounce))
        geom.solref = [SOFTEST * start.dt / self.engine.substeps, max(damping, 1e-3)]

    def _place(self, data: Any, start: Trajectory) -> None:
        place, speed = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
        moving = np.flatnonzero(~start.static.astype(bool))
        place[:, :3], place[:, 3:] = start.position[0, moving], np.roll(start.quat_xyzw[0, moving], 1, axis=-1)
        speed[:, :3] = start.velocity[0, moving]
        speed[:, 3:] = Rotation.from_quat(start.quat_xyzw[0, moving]).apply(
            start.angular_velocity[0, moving], inverse=True
        )

    def _frame(self, data: Any, start: Trajectory) -> tuple[np.ndarray, ...]:
        moving = np.flatnonzero(~start.static.astype(bool))
        place, speed = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
        position, quat = start.position[0].copy(), start.quat_xyzw[0].copy()
        velocity, angular = np.zeros_like(position), np.zeros_like(position)
        position[moving], quat[moving] = place[:, :3], np.roll(place[:, 3:], -1, axis=-1)
        velocity[moving] = speed[:, :3]
        angular[moving] = Rotation.from_quat(quat[moving]).apply(speed[:, 3:])
        return position, quat, velocity, angular


def _timed(start: Trajectory, position: np.ndarray, wall: float, cpu: float, first: float, steps: int) -> Timed:
    scene = {"bodies": float((~start.static.astype(bool)).sum()), "ms": 1e3 * cpu / (steps - 1)}
    return Timed(wall, cpu, (steps - 1) * start.dt, 1e3 * first, position[-1], [scene])
