"""Depth of bodies in each other and in the floor, measured on their exact geometry."""

from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.data.dataset import Trajectory
from sdfsim.evaluation.engines import Ran, dataset_urdf
from sdfsim.geometry.mesh_io import load_pieces
from sdfsim.sdf.grid import GridSdf
from sdfsim.sdf.mesh_sdf import MeshSdf
from sdfsim.sdf.mlp import MlpSdf
from sdfsim.sdf.reference import PiecesDistance
from sdfsim.shape.shape import Shape, with_sdf

TOUCH = 0.01  # relative to the mean size of the dynamic bodies: a node this near to another surface is in contact
EVERY = 10  # every how many frames one is measured


@dataclass(frozen=True)
class ExactSolid:
    """A shape's exact geometry, relative to its centre of mass, at scale 1."""

    nodes: np.ndarray  # [K, 3] m, surface nodes
    bounds: np.ndarray  # [2, 3] m, box of the solid (infinite for a plane)
    distance: Callable[[np.ndarray], np.ndarray]  # [P, 3] m -> [P] m, negative inside
    # "pieces" (the convex pieces that an engine collides), "mesh" (the shape's), "shown mesh" (the same, if the engine
    # collided pieces that are missing) or "closed form"
    kind: str


def exact_solids(data: Path, shapes: dict[str, Shape]) -> dict[str, ExactSolid]:
    """The exact geometry of every shape of a dataset.

    A shape that was fitted to an engine's convex pieces is measured on those pieces, if the dataset's engine file names
    them; its mesh is only for display. Other learned or sampled distances are replaced by those of the mesh.
    """
    solids = {}
    for name, shape in shapes.items():
        # A dataset's body frames are at the centre of mass, and so are its shapes' origins.
        solids[name] = _exact(shape)
        if shape.source.get("kind") == "pieces" and isinstance(shape.sdf, MlpSdf | GridSdf):
            solids[name] = replace(solids[name], kind="shown mesh")
            with suppress(SdfsimError):
                oracle = PiecesDistance(load_pieces(dataset_urdf(data, name).with_suffix(".obj")))
                distance = lambda points, oracle=oracle: oracle(points).distance  # noqa: E731
                solids[name] = ExactSolid(shape.nodes, oracle.bounds, distance, "pieces")
    return solids


def deepest(motion: Trajectory, solids: dict[str, ExactSolid], every: int = EVERY) -> np.ndarray:
    """[F] m, signed distance of the deepest node of any body in another, or in the floor z = 0, in every `every`-th
    frame: negative inside, infinite if nothing touches. Pairs of static bodies, and static bodies in the floor, do not
    count."""
    kept = slice(every, None, every)
    position = motion.position[kept]
    frames, bodies = position.shape[:2]
    turn = Rotation.from_quat(motion.orientation[kept].reshape(-1, 4)).as_matrix().reshape(frames, bodies, 3, 3)
    own = [solids[str(name)] for name in motion.shape]
    moving = ~motion.static
    bounds = motion.scale[:, None, None] * np.stack([solid.bounds for solid in own])
    touch = TOUCH * float(np.ptp(bounds[moving], axis=1).max(-1).mean())
    lowest = np.full(frames, np.inf)
    for i in np.flatnonzero(moving):
        heights = position[:, i, None, 2] + motion.scale[i] * turn[:, i, 2] @ own[i].nodes.T
        lowest = np.minimum(lowest, heights.min(1, initial=np.inf))
    questions = defaultdict(list)
    for f, i, j in zip(*np.nonzero(_near(position, turn, bounds, moving, touch)), strict=True):
        world = position[f, i] - position[f, j] + motion.scale[i] * own[i].nodes @ turn[f, i].T
        local = world @ turn[f, j]
        low, high = bounds[j]
        inside = local[((local >= low - touch) & (local <= high + touch)).all(1)]
        if len(inside):
            questions[str(motion.shape[j])].append((f, motion.scale[j], inside))
    for name, asked in questions.items():  # all of one shape at once, as each call has a fixed cost
        frame, scale = (np.repeat([q[k] for q in asked], [len(q[2]) for q in asked]) for k in (0, 1))
        distance = scale * solids[name].distance(np.concatenate([q[2] for q in asked]) / scale[:, None])
        np.minimum.at(lowest, frame, distance)
    return np.where(lowest <= touch, lowest, np.inf)


def penetration(motions: list[Trajectory], solids: dict[str, ExactSolid]) -> dict:
    """Penetration in m over the frames of all `motions` in which something touches: percentile_95 and worst of the
    depth of a frame's deepest node (None if nothing touches), and steps_with_contact."""
    depth = _touching(np.concatenate([deepest(motion, solids) for motion in motions]))
    return {
        "percentile_95": float(np.percentile(depth, 95)) if len(depth) else None,
        "worst": float(depth.max()) if len(depth) else None,
        "steps_with_contact": len(depth),
    }


def depths(run: Ran, every: int = 5) -> np.ndarray:
    """[F] m, depth of the deepest node, in every `every`-th frame in which bodies touch. The only plane of the scene,
    if any, is the floor z = 0."""
    solids = {}
    for name in set(run.motion.shape.tolist()):
        shape = run.scene.shapes[int(name)]
        solids[name] = _exact(replace(shape, nodes=shape.nodes - shape.com), shape.com)
    return _touching(deepest(run.motion, solids, every))


def _touching(distance: np.ndarray) -> np.ndarray:
    """[F] m, depths of those frames of `deepest` in which anything touches."""
    return np.maximum(0.0, -distance[np.isfinite(distance)])


def _near(position: np.ndarray, turn: np.ndarray, bounds: np.ndarray, moving: np.ndarray, touch: float) -> np.ndarray:
    """[F, N, N] bool: the boxes around two bodies are within `touch` m, and one of the two is dynamic."""
    finite = np.asarray(np.isfinite(bounds).all((1, 2)))
    bounds = np.where(finite[:, None, None], bounds, 0.0)
    centre = position + (turn @ bounds.mean(1)[..., None])[..., 0]
    half = (np.abs(turn) @ (0.5 * (bounds[:, 1] - bounds[:, 0]))[..., None])[..., 0] + 0.5 * touch
    half = np.where(finite[:, None], half, np.inf)
    gap = np.abs(centre[:, :, None] - centre[:, None]) - half[:, :, None] - half[:, None]
    pairs = (moving[:, None] | moving[None]) & ~np.eye(len(bounds), dtype=bool)
    return (gap <= 0).all(-1) & pairs


def _exact(shape: Shape, com: np.ndarray | float = 0.0) -> ExactSolid:
    """The geometry behind a shape's distances, with the origin at `com` [3] m."""
    sdf = with_sdf(shape, "mesh").sdf if isinstance(shape.sdf, MlpSdf | GridSdf) else shape.sdf
    kind = "mesh" if isinstance(sdf, MeshSdf) else "closed form"
    return ExactSolid(shape.nodes, np.asarray(sdf.bounds) - com, lambda points: np.asarray(sdf(points + com)[0]), kind)
