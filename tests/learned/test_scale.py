"""Shapes with many nodes: no edge is missed."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sdfsim.learned.near import find_contacts
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import load_shape
from tests.helpers.scenes import make_body
from tests.helpers.shapes import SHAPES

GRAVITY = torch.tensor([0.0, 0.0, -10.0], dtype=torch.float64)
REACH, DT = 0.1, 0.02


def bodies_of(scene: Scene):
    return from_scene(scene, Units(1.0, 1.0, 1.0), torch.device("cpu"))


def test_fitted_shapes_with_many_nodes_keep_every_edge():
    """Balls of nodes are left out by distances that are not exact: none may hold a node that has an edge."""
    ring = load_shape(SHAPES / "ring")
    size = float(np.ptp(ring.sdf.bounds, axis=0).max())
    rng = np.random.default_rng(0)
    bodies = [
        make_body(f"b{k}", 0, rng.uniform(-0.5, 0.5, 3), scale=1 / size, quat_xyzw=Rotation.random(rng=rng).as_quat())
        for k in range(6)
    ]
    bodies, state = bodies_of(Scene((ring,), tuple(bodies), np.zeros(3), 1.0))
    found = find_contacts(bodies, state, 0 * GRAVITY, 0.05, DT)
    missing = 0
    for j in range(6):
        turned = Rotation.from_quat(state.orientation.numpy())
        for i in range(6):
            if i == j:
                continue
            mine = slice(int(bodies.node_start[i]), int(bodies.node_start[i + 1]))
            world = state.position[i].numpy() + turned[i].apply(bodies.node[mine].numpy())
            local = turned[j].inv().apply(world - state.position[j].numpy()) + bodies.com[j].numpy()
            near = np.asarray(ring.sdf(local * size)[0]) / size <= 0.0499
            held = found.node[(found.owner == i) & (found.body == j)] - mine.start
            missing += int((~np.isin(np.flatnonzero(near), held.numpy())).sum())
    assert missing == 0 and len(found) > 100
