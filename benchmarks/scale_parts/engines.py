"""The same scenes in PyBullet and MuJoCo: spheres are spheres there, everything else is its convex pieces."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.scale_parts.ours import memory, peak_from_here
from sdfsim import load_scene
from sdfsim.data.pybullet_sim import BODY_SETTINGS, ENGINE_SETTINGS, MAXIMAL, import_pybullet
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.primitives import convex_pieces
from sdfsim.shape.sdf import PlaneSdf, SphereSdf

SUBSTEPS = 5
PRIMITIVE = {"can": "cylinder", "ring": "torus"}  # what the shapes of the samples are


def pieces_of(scene: Scene, body: Body) -> list[Mesh]:
    """The convex pieces of a body's shape at scale 1, about its centre of mass."""
    shape = scene.shapes[body.shape]
    return [Mesh(p.vertices - shape.com, p.faces) for p in convex_pieces(PRIMITIVE.get(shape.name, shape.name))]


def obj(meshes: list[Mesh]) -> str:
    """Wavefront text, a group a mesh."""
    lines, first = [], 1
    for k, mesh in enumerate(meshes):
        lines.append(f"o piece_{k}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + first]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def centre(scene: Scene, body: Body) -> np.ndarray:
    """[3] m, where its centre of mass is at the start."""
    return body.position + Rotation.from_quat(body.quat_xyzw).apply(body.scale * scene.shapes[body.shape].com)


def bullet(
    scene: Scene, dt: float, steps: int, *, concave: bool = False, push: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, list[float]]]:
    """Positions [N, 3] m of the bodies that move and the distances m of all contacts, at the start and after each step.

    Args:
        scene: what to simulate.
        dt: s, of a step of `SUBSTEPS` inner ones.
        steps: how many.
        concave: static bodies are their meshes instead of convex pieces.
        push: [N, 3] m/s, velocities at the start; at rest without.
    """
    pb = import_pybullet()
    client = pb.connect(pb.DIRECT)
    try:
        pb.setPhysicsEngineParameter(**ENGINE_SETTINGS)
        pb.setGravity(*scene.gravity)
        pb.setTimeStep(dt / SUBSTEPS)
        moving = []
        with tempfile.TemporaryDirectory() as folder:
            for body in scene.bodies:
                handle = _bullet_body(pb, scene, body, Path(folder), concave=concave and body.motion == "static")
                if body.motion == "dynamic":
                    moving.append(handle)
        for handle, velocity in zip(moving, [] if push is None else push.tolist(), strict=push is not None):
            pb.resetBaseVelocity(handle, velocity)
        for k in range(steps + 1):
            for _ in range(SUBSTEPS if k else 0):
                pb.stepSimulation()
            place = np.array([pb.getBasePositionAndOrientation(handle)[0] for handle in moving])
            yield place, [contact[8] for contact in pb.getContactPoints()]
    finally:
        pb.disconnect(client)


def _bullet_body(pb, scene: Scene, body: Body, folder: Path, *, concave: bool) -> int:
    shape = scene.shapes[body.shape]
    if isinstance(shape.sdf, PlaneSdf):
        form = pb.createCollisionShape(pb.GEOM_BOX, halfExtents=[100.0, 100.0, 1.0])
        handle = pb.createMultiBody(0.0, form, basePosition=[0.0, 0.0, -1.0], **MAXIMAL)
    else:
        if isinstance(shape.sdf, SphereSdf):
            form = pb.createCollisionShape(pb.GEOM_SPHERE, radius=shape.sdf.radius * body.scale)
        else:
            path = folder / f"{shape.name}{'_concave' if concave else ''}.obj"
            if not path.exists():
                whole = [Mesh(shape.mesh.vertices - shape.com, shape.mesh.faces)]
                path.write_text(obj(whole if concave else pieces_of(scene, body)))
            flags = pb.GEOM_FORCE_CONCAVE_TRIMESH if concave else 0
            form = pb.createCollisionShape(pb.GEOM_MESH, fileName=str(path), meshScale=[body.scale] * 3, flags=flags)
        place = centre(scene, body).tolist(), body.quat_xyzw.tolist()
        handle = pb.createMultiBody(body.mass, form, -1, *place, **MAXIMAL)
    pb.changeDynamics(handle, -1, lateralFriction=body.friction, restitution=body.restitution, **BODY_SETTINGS)
    return handle


def mujoco(scene: Scene, dt: float, steps: int) -> Iterator[tuple[np.ndarray, list[float]]]:
    """The same from MuJoCo, with its own default contact settings."""
    import mujoco as mj

    model = mj.MjModel.from_xml_string(_xml(scene, dt))
    data = mj.MjData(model)
    moving = [k + 1 for k, b in enumerate(b for b in scene.bodies if not _is_plane(scene, b)) if b.motion == "dynamic"]
    for k in range(steps + 1):
        for _ in range(SUBSTEPS if k else 0):
            mj.mj_step(model, data)
        if k == 0:
            mj.mj_forward(model, data)
        yield data.xpos[moving].copy(), data.contact.dist[: data.ncon].tolist()


def _is_plane(scene: Scene, body: Body) -> bool:
    return isinstance(scene.shapes[body.shape].sdf, PlaneSdf)


def _xml(scene: Scene, dt: float) -> str:
    """MJCF. Its bodies' frames sit at the centres of mass, as ours do."""
    assets, bodies = {}, []
    for body in scene.bodies:
        shape, friction = scene.shapes[body.shape], f'friction="{body.friction} 0.005 0.0001"'
        if _is_plane(scene, body):
            bodies.append(f'<geom type="plane" size="0 0 1" {friction}/>')
            continue
        if isinstance(shape.sdf, SphereSdf):
            geoms = [f'type="sphere" size="{shape.sdf.radius * body.scale}"']
            share = [body.mass]
        else:
            meshes = pieces_of(scene, body)
            names = [f"{shape.name}_{body.scale}_{k}" for k in range(len(meshes))]
            for name, mesh in zip(names, meshes, strict=True):
                corners = " ".join(f"{v:.6f}" for v in (mesh.vertices * body.scale).ravel())
                assets[name] = f'<mesh name="{name}" vertex="{corners}"/>'
            geoms = [f'type="mesh" mesh="{name}"' for name in names]
            share = [body.mass / len(meshes)] * len(meshes)
        quat = " ".join(str(v) for v in np.roll(body.quat_xyzw, 1))
        place = " ".join(str(v) for v in centre(scene, body))
        inner = "".join(
            f'<geom {geom} {friction} mass="{mass or 1.0}"/>' for geom, mass in zip(geoms, share, strict=True)
        )
        joint = "<freejoint/>" if body.motion == "dynamic" else ""
        bodies.append(f'<body pos="{place}" quat="{quat}">{joint}{inner}</body>')
    gravity = " ".join(str(v) for v in scene.gravity)
    return (
        f'<mujoco><option timestep="{dt / SUBSTEPS}" gravity="{gravity}"/><size memory="2G"/>'
        f"<asset>{''.join(assets.values())}</asset><worldbody>{''.join(bodies)}</worldbody></mujoco>"
    )


def run(engine: str, scene_file: str, dt: float, steps: int) -> dict:
    """Cost and quality of a scene in "bullet", "bullet concave" or "mujoco"; as `ours.run` tells them."""
    scene = load_scene(scene_file)
    before, began = peak_from_here(), time.process_time()
    if engine == "mujoco":
        stream = mujoco(scene, dt, steps)
    else:
        stream = bullet(scene, dt, steps, concave=engine == "bullet concave")
    place = next(stream)[0]
    ready, contacts, depth, every = time.process_time(), [], [], []
    for now, distances in stream:
        place = now
        contacts.append(len(distances))
        depth.append(max(0.0, -min(distances, default=0.0)))
        every.extend(max(0.0, -d) for d in distances)
    moving = [b for b in scene.bodies if b.motion == "dynamic"]
    return {
        "bodies": len(moving),
        "steps": steps,
        "ms": 1e3 * (time.process_time() - ready) / steps,
        "load_s": ready - began,
        "contacts": float(np.mean(contacts)),
        "penetration_95": float(np.percentile(depth, 95)),
        "overlap_95": float(np.percentile(every, 95)) if every else None,
        "peak_mib": memory("VmHWM") - before,
        "below": int((place[:, 2] < 0).sum()),
        "finite": bool(np.isfinite(place).all()),
    }
