"""Newton on the CPU, by XPBD on triangle meshes; spheres and boxes are exact."""

from typing import Any

import numpy as np

from sdfsim.base.lazy import optional
from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import SUBSTEPS
from sdfsim.evaluation.engines import Start, Timing, engine_motion, form_of

ITERATIONS = 10  # of XPBD in an inner step


def newton(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """Newton's motion on the CPU, by XPBD on triangle meshes, contacts searched in every inner step.

    It takes the mean of two coefficients of friction. So every moving body gets its square, and floor and static bodies
    the value for the median body: exact if all moving bodies have one friction, of at most twice the others'. Its
    kernels compile for a minute on a machine's first run.

    Raises:
        SdfsimError: Newton is not installed, or the motion fails.
    """
    warp, lib = (optional(name, "Newton", "rivals") for name in ("warp", "newton"))
    warp.config.quiet = True
    t, builder = start.motion, lib.ModelBuilder(gravity=tuple(map(float, start.motion.gravity)))

    def surface(friction: float) -> Any:
        return lib.ModelBuilder.ShapeConfig(mu=friction, density=0.0)

    moves = t.friction[~t.static] if (~t.static).any() else t.friction

    def beside(friction: float) -> float:
        return max(0.0, float(np.median(2.0 * friction * moves - moves**2)))

    if start.floor:
        builder.add_ground_plane(cfg=surface(beside(start.floor[0])))
    meshes, moving = {}, []
    for i, name in enumerate(map(str, t.shape)):
        kind, sizes = form_of(start.urdfs[name])
        scale, body, place = float(t.scale[i]), -1, warp.transform(t.position[0, i], t.orientation[0, i])
        if not t.static[i]:
            inertia = warp.mat33(np.diag(t.inertia[i]))
            body = builder.add_body(xform=place, mass=float(t.mass[i]), inertia=inertia, lock_inertia=True)
            moving.append(i)
        friction = beside(t.friction[i]) if t.static[i] else float(t.friction[i] ** 2)
        shape = {"cfg": surface(friction), "xform": place if body < 0 else None}
        if kind == "sphere":
            builder.add_shape_sphere(body, radius=scale * float(sizes[0]), **shape)
        elif kind == "box":
            half = 0.5 * scale * sizes
            builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2], **shape)
        else:
            if name not in meshes:
                mesh = start.meshes[name]
                meshes[name] = lib.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32).ravel())
            builder.add_shape_mesh(body, mesh=meshes[name], scale=(scale,) * 3, **shape)
    model = builder.finalize(device="cpu")
    solver = lib.solvers.SolverXPBD(model, iterations=ITERATIONS)
    pipeline = lib.CollisionPipeline(model)
    contacts, now, then = pipeline.contacts(), model.state(), model.state()
    speeds = np.concatenate([t.velocity[0, moving], t.angular_velocity[0, moving]], axis=1).astype(np.float32)
    now.body_qd.assign(speeds)

    def advance() -> None:
        nonlocal now, then
        for _ in range(substeps):
            now.clear_forces()
            pipeline.collide(now, contacts)
            solver.step(now, then, None, contacts, t.dt / substeps)
            now, then = then, now

    def state() -> tuple[np.ndarray, ...]:
        places, speeds = now.body_q.numpy().astype(float), now.body_qd.numpy().astype(float)
        return places[:, :3], places[:, 3:], speeds[:, :3], speeds[:, 3:]

    return engine_motion(t, steps, advance, state)
