"""Drake, with hydroelastic contact of tetrahedra from fTetWild, and boxes with point contact."""

import tempfile
from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.files import write_text
from sdfsim.base.lazy import optional
from sdfsim.data.dataset import Trajectory
from sdfsim.data.pybullet_sim import SUBSTEPS
from sdfsim.evaluation.engines import Start, Timing, engine_motion, form_of
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import wavefront
from sdfsim.scene.scene import Scene

MODULUS = 1e7  # Pa, of compliant bodies: Drake's own default
TETRAHEDRA = 0.05  # their edges over the diagonal of a shape's box


def drake(start: Start, steps: int, substeps: int = SUBSTEPS) -> tuple[Trajectory, Timing]:
    """Drake's motion with hydroelastic contact: bodies that move are compliant tetrahedra, others rigid triangles.

    It combines two coefficients of friction by their harmonic mean; PyBullet multiplies them. So every body gets its
    own square (a single moving body the product with the roughest body that it may meet), and floor and static bodies
    get the value for the median body: exact if all moving bodies have one friction, of at least half of the others'.
    Restitution is 0.

    Raises:
        SdfsimError: Drake or fTetWild are not installed, or the motion fails.
    """
    lib = optional("pydrake.all", "Drake", "rivals")
    t, builder = start.motion, lib.DiagramBuilder()
    settings = lib.MultibodyPlantConfig(time_step=t.dt / substeps, contact_model="hydroelastic_with_fallback")
    plant, _ = lib.AddMultibodyPlant(settings, builder)
    plant.mutable_gravity_field().set_gravity_vector(t.gravity)

    def surface(friction: float, compliant: bool, size: float) -> Any:
        found = lib.ProximityProperties()
        lib.AddContactMaterial(dissipation=None, friction=lib.CoulombFriction(friction, friction), properties=found)
        if compliant:
            lib.AddCompliantHydroelasticProperties(0.25 * size, MODULUS, found)
        else:
            lib.AddRigidHydroelasticProperties(0.25 * size, found)
        return found

    moving = ~t.static if (~t.static).any() else t.static
    others = [*t.friction[t.static], *(start.floor or ())[:1]]
    own = t.friction * (max(others, default=1.0) if (~t.static).sum() == 1 else t.friction)

    def beside(friction: float) -> float:
        wanted = friction * t.friction[moving]
        return float(np.median(wanted * own[moving] / np.maximum(2.0 * own[moving] - wanted, 1e-3)))

    if start.floor:
        world, friction = (plant.world_body(), lib.RigidTransform()), beside(start.floor[0])
        plant.RegisterCollisionGeometry(*world, lib.HalfSpace(), "floor", surface(friction, False, 1.0))
    bodies = []
    with tempfile.TemporaryDirectory() as scratch:  # files are read while the simulator is made
        for i, name in enumerate(map(str, t.shape)):
            kind, sizes = form_of(start.urdfs[name])
            place = lib.RigidTransform(lib.Quaternion(np.roll(t.orientation[0, i], 1)), t.position[0, i])
            scale, moves = float(t.scale[i]), not t.static[i]
            if kind == "mesh":
                file, mesh = Path(scratch) / (f"{name}.vtk" if moves else f"{name}.obj"), start.meshes[name]
                if not file.exists():
                    write_text(file, _tetrahedra(mesh, start.urdfs[name]) if moves else wavefront([mesh]))
                form, smallest = lib.Mesh(str(file), scale), np.ptp(mesh.vertices, axis=0).min()
            else:
                known = {"sphere": lib.Sphere, "box": lib.Box, "cylinder": lib.Cylinder, "capsule": lib.Capsule}
                form, smallest = known[kind](*(scale * sizes)), sizes.min()
            friction = float(own[i]) if moves else beside(float(t.friction[i]))
            properties = surface(friction, moves, scale * float(smallest))
            if not moves:
                plant.RegisterCollisionGeometry(plant.world_body(), place, form, f"g{i}", properties)
                continue
            inertia = lib.UnitInertia(*(t.inertia[i] / t.mass[i]))
            body = plant.AddRigidBody(f"b{i}", lib.SpatialInertia(float(t.mass[i]), np.zeros(3), inertia))
            plant.RegisterCollisionGeometry(body, lib.RigidTransform(), form, f"g{i}", properties)
            bodies.append((i, body, place))
        plant.Finalize()
        simulator = lib.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for i, body, place in bodies:
        plant.SetFreeBodyPose(context, body, place)
        speed = lib.SpatialVelocity(t.angular_velocity[0, i], t.velocity[0, i])
        plant.SetFreeBodySpatialVelocity(context=context, body=body, V_JpJc=speed)
    simulator.Initialize()

    def state() -> tuple[np.ndarray, ...]:
        return _state(plant, context, [body for _, body, _ in bodies])

    return engine_motion(t, steps, lambda: simulator.AdvanceTo(round(context.get_time() / t.dt + 1) * t.dt), state)


class DrakeWorld:
    """Boxes of a scene above a plane of friction 1, by Drake's discrete point contact: its contacts have no rebound,
    but a stiffness, N/m, and a dissipation, s/m. Raises NotInstalled."""

    def __init__(self, scene: Scene, step: float, stiffness: float, dissipation: float) -> None:
        lib = optional("pydrake.all", "Drake", "rivals")
        self.plant, _ = lib.AddMultibodyPlantSceneGraph(builder := lib.DiagramBuilder(), step)
        self.plant.mutable_gravity_field().set_gravity_vector(scene.gravity)
        ground, *boxes = scene.bodies
        table = lib.ProximityProperties()
        lib.AddContactMaterial(0.0, 1e9, lib.CoulombFriction(1.0, 1.0), table)
        place = lib.RigidTransform(ground.position)
        self.plant.RegisterCollisionGeometry(self.plant.world_body(), place, lib.HalfSpace(), "table", table)
        self.boxes, self.step, self.made = [], step, 0
        for box in boxes:
            form: Any = scene.shapes[box.shape].sdf
            # Drake combines two coefficients a, b to 2 a b / (a + b): with 1 for the table this value gives the wanted
            # friction.
            mu = box.friction / (2.0 - box.friction)
            touch = lib.ProximityProperties()
            lib.AddContactMaterial(dissipation, stiffness, lib.CoulombFriction(mu, mu), touch)
            assert box.inertia is not None
            unit = lib.UnitInertia(*(np.diagonal(box.inertia) / box.mass))
            body = self.plant.AddRigidBody(box.name, lib.SpatialInertia(box.mass, np.zeros(3), unit))
            sides = lib.Box(*(2.0 * box.scale * np.array(form.half)))
            self.plant.RegisterCollisionGeometry(body, lib.RigidTransform(), sides, box.name, touch)
            self.boxes.append(body)
        self.plant.Finalize()
        self.simulator = lib.Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        for body, box in zip(self.boxes, boxes, strict=True):
            pose = lib.RigidTransform(lib.Quaternion(np.roll(box.quat_xyzw, 1)), box.position)
            self.plant.SetFreeBodyPose(self.context, body, pose)
            speed = lib.SpatialVelocity(box.angular_velocity, box.velocity)
            self.plant.SetFreeBodySpatialVelocity(context=self.context, body=body, V_JpJc=speed)

    def advance(self, count: int) -> None:
        self.made += count
        self.simulator.AdvanceTo(self.made * self.step)

    def state(self) -> tuple[np.ndarray, ...]:
        return _state(self.plant, self.context, self.boxes)


def _state(plant: Any, context: Any, bodies: Sequence[Any]) -> tuple[np.ndarray, ...]:
    places = [plant.EvalBodyPoseInWorld(context, body) for body in bodies]
    speeds = [plant.EvalBodySpatialVelocityInWorld(context, body) for body in bodies]
    quat = np.roll([place.rotation().ToQuaternion().wxyz() for place in places], -1, axis=-1)
    velocities = (np.array([getattr(v, of)() for v in speeds]) for of in ("translational", "rotational"))
    return np.array([place.translation() for place in places]), quat, *velocities


def _tetrahedra(mesh: Mesh, beside: Path) -> str:
    """A VTK file of tetrahedra that fill a closed mesh, kept next to the shape's URDF."""
    kept = beside.with_suffix(".vtk").resolve()
    if not kept.exists():
        filler = optional("pytetwild", "fTetWild", "rivals")
        with tempfile.TemporaryDirectory() as scratch, chdir(scratch):  # it leaves a file in its working folder
            points, cells = filler.tetrahedralize(
                mesh.vertices.astype(float), mesh.faces.astype(np.int32), edge_length_fac=TETRAHEDRA
            )
        corner = points[cells[:, 0], None]
        volume = np.linalg.det(points[cells[:, 1:]] - corner)
        cells = np.where(volume[:, None] < 0, cells[:, [0, 2, 1, 3]], cells)[np.abs(volume) > 0]
        lines = ["# vtk DataFile Version 3.0", "tetrahedra", "ASCII", "DATASET UNSTRUCTURED_GRID"]
        lines += [f"POINTS {len(points)} double", *(" ".join(f"{x:.9g}" for x in point) for point in points)]
        lines += [f"CELLS {len(cells)} {5 * len(cells)}", *("4 " + " ".join(map(str, cell)) for cell in cells)]
        lines += [f"CELL_TYPES {len(cells)}", *["10"] * len(cells)]
        write_text(kept, "\n".join(lines) + "\n")
    return kept.read_text(encoding="utf-8")
