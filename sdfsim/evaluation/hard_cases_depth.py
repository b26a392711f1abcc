"""How deep bodies are inside each other, on their exact geometry, in motions of whatever made them."""

from __future__ import annotations

import numpy as np

from sdfsim.data.dataset import Trajectory
from sdfsim.dynamics.rollout import Rollout
from sdfsim.evaluation.penetration import Solid, deepest
from sdfsim.scene.types import Scene
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.sdf import GridSdf, MeshSdf, PlaneSdf
from sdfsim.shape.shape import Shape, with_sdf


def penetration(scene: Scene, motion: Rollout, every: int = 5) -> np.ndarray:
    """[F] m, depth of the deepest node in those of every so many frames in which anything touches."""
    kept = [k for k, b in enumerate(scene.bodies) if not isinstance(scene.shapes[b.shape].sdf, PlaneSdf)]
    solids = {str(k): _solid(scene.shapes[k]) for k in {scene.bodies[b].shape for b in kept}}
    count = len(kept)
    track = Trajectory(
        position=motion.position[:, kept],
        quat_xyzw=motion.orientation[:, kept],
        velocity=motion.velocity[:, kept],
        angular_velocity=motion.angular_velocity[:, kept],
        shape=np.array([str(scene.bodies[k].shape) for k in kept]),
        scale=np.array([scene.bodies[k].scale for k in kept]),
        mass=np.ones(count),
        inertia=np.ones((count, 3)),
        friction=np.ones(count),
        restitution=np.ones(count),
        static=np.array([scene.bodies[k].motion == "static" for k in kept]),
        dt=float(motion.meta["dt"]),
        gravity=scene.gravity,
    )
    distance = deepest(track, solids, every)
    return np.maximum(0.0, -distance[np.isfinite(distance)])


def _solid(shape: Shape) -> Solid:
    exact = with_sdf(shape, "mesh") if isinstance(shape.sdf, MlpSdf | GridSdf) else shape
    sdf, com = exact.sdf, shape.com
    kind = "mesh" if isinstance(sdf, MeshSdf) else "closed form"
    return Solid(shape.nodes - com, np.asarray(sdf.bounds) - com, lambda points: np.asarray(sdf(points + com)[0]), kind)
