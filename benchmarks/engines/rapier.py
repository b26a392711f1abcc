"""Rapier, with convex pieces; spheres, boxes, cylinders and capsules are exact."""

from typing import Any

import numpy as np

from sdfsim.base.lazy import optional
from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import SUBSTEPS
from sdfsim.evaluation.engines import Start, Timing, engine_motion, form_of
from sdfsim.geometry.mesh_io import load_pieces

UPRIGHT = (0.5 * np.pi, 0.0, 0.0)  # turns Rapier's cylinders, whose axis is y, to z


def rapier(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """Rapier's motion on one thread with its default settings, in float32, with the same masses, inertias and starts.
    Coefficients multiply, as in PyBullet. Gyroscopic forces, off by default, are on.

    Raises:
        SdfsimError: Rapier is not installed, a shape's engine file cannot be read, or the motion fails.
    """
    lib = optional("rapier3d", "Rapier", "rivals")
    t = start.motion
    world = lib.PhysicsWorld(gravity=tuple(map(float, t.gravity)))
    world.integration_parameters.dt = t.dt / substeps
    world.set_num_threads(1)
    multiply = lib.CoefficientCombineRule.MULTIPLY

    def surface(form: Any, friction: float, restitution: float) -> Any:
        form = form.density(0.0).friction(friction).restitution(restitution)
        return form.friction_combine_rule(multiply).restitution_combine_rule(multiply)

    if start.floor:
        world.add_collider(surface(lib.Collider.halfspace((0.0, 0.0, 1.0)), *start.floor))
    moving = []
    for i, name in enumerate(map(str, t.shape)):
        x, y, z, w = map(float, t.orientation[0, i])
        body = lib.RigidBody.fixed() if t.static[i] else lib.RigidBody.dynamic()
        body = body.position(lib.Isometry3(t.position[0, i], lib.Rotation3(w, x, y, z))).can_sleep(False)
        if not t.static[i]:
            given = lib.MassProperties((0.0, 0.0, 0.0), float(t.mass[i]), t.inertia[i])
            body = body.additional_mass_properties(given).gyroscopic_forces(True)
            body = body.linvel(t.velocity[0, i]).angvel(t.angular_velocity[0, i])
        forms = _forms(lib, start.urdfs[name], float(t.scale[i]))
        surfaces = [surface(form, float(t.friction[i]), float(t.restitution[i])) for form in forms]
        handle = world.add_body(body, surfaces)
        if not t.static[i]:
            moving.append(world.rigid_bodies[handle])

    def state() -> tuple[np.ndarray, ...]:
        places, turns = ([getattr(body, of) for body in moving] for of in ("translation", "rotation"))
        quat = np.array([(turn.i, turn.j, turn.k, turn.w) for turn in turns])
        speeds = (np.array([tuple(getattr(body, of)) for body in moving]) for of in ("linvel", "angvel"))
        return np.array([tuple(place) for place in places]), quat, *speeds

    def advance() -> None:
        for _ in range(substeps):
            world.step()

    return engine_motion(t, steps, advance, state)


def _forms(lib: Any, urdf: Any, scale: float) -> list[Any]:
    """Builders of the colliders of a shape: its closed form, or its convex pieces."""
    kind, sizes = form_of(urdf)
    sizes = [float(scale * size) for size in sizes]
    if kind == "sphere":
        return [lib.Collider.ball(sizes[0])]
    if kind == "box":
        return [lib.Collider.cuboid(*(0.5 * size for size in sizes))]
    if kind == "cylinder":
        return [lib.Collider.cylinder(0.5 * sizes[1], sizes[0]).rotation(UPRIGHT)]
    if kind == "capsule":
        return [lib.Collider.capsule_z(0.5 * sizes[1], sizes[0])]
    return [lib.Collider.convex_hull(scale * piece.vertices) for piece in load_pieces(urdf.with_suffix(".obj"))]
