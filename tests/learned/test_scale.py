"""Shapes with many nodes: no edge is missed."""

import numpy as np
from scipy.spatial.transform import Rotation

from sdfsim.physics.bodies import Units, from_scene
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import load_shape
from tests.helpers.scenes import contact_edges, make_body
from tests.helpers.shapes import SHAPES

REACH, DT = 0.05, 0.02


def test_fitted_shapes_with_many_nodes_keep_every_edge():
    """Balls of nodes are left out by distances that are not exact: none may hold a node that has an edge."""
    ring = load_shape(SHAPES / "ring")
    size = float(np.ptp(ring.sdf.bounds, axis=0).max())
    rng = np.random.default_rng(0)
    bodies = [
        make_body(f"b{k}", 0, rng.uniform(-0.5, 0.5, 3), scale=1 / size, quat_xyzw=Rotation.random(rng=rng).as_quat())
        for k in range(6)
    ]
    bodies, state = from_scene(Scene((ring,), tuple(bodies), np.zeros(3), 1.0), Units(1.0, 1.0, 1.0))
    _, _, found = contact_edges(bodies, state, np.zeros(3), REACH, DT)
    missing = 0
    for j in range(6):
        turned = Rotation.from_quat(state.orientation)
        for i in range(6):
            if i == j:
                continue
            mine = slice(int(bodies.node_start[i]), int(bodies.node_start[i + 1]))
            world = state.position[i] + turned[i].apply(bodies.node[mine])
            local = turned[j].inv().apply(world - state.position[j]) + bodies.com[j]
            near = np.asarray(ring.sdf(local * size)[0]) / size <= 0.0499
            held = found.node[(found.owner == i) & (found.body == j)] - mine.start
            missing += int((~np.isin(np.flatnonzero(near), held.numpy())).sum())
    assert missing == 0 and len(found) > 100
