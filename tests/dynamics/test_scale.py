"""Shapes with many nodes: no edge is missed. And when everything rests."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sdfsim.dynamics.bodies import Units, from_scene
from sdfsim.dynamics.models.near import find_contacts
from sdfsim.dynamics.rest import STEPS, STRAY, Rest
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape, load_shape
from tests.dynamics.conftest import make_body

SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"
GRAVITY = torch.tensor([0.0, 0.0, -10.0], dtype=torch.float64)
REACH, DT = 0.1, 0.02


def bodies_of(scene: Scene):
    return from_scene(scene, Units(1.0, 1.0, 1.0), torch.device("cpu"))


def ball(nodes: int):
    """A sphere of diameter 1 m with so many nodes, evenly along a spiral."""
    k = np.arange(nodes) + 0.5
    turn, height = np.pi * (1 + 5**0.5) * k, 1 - 2 * k / nodes
    wide = np.sqrt(1 - height**2)
    points = 0.5 * np.stack([wide * np.cos(turn), wide * np.sin(turn), height], 1)
    return replace(analytic_shape("sphere", radius=0.5), nodes=points)


def stacks(count: int, nodes: int = 64, spacing: float = 3.0) -> Scene:
    """Balls on a floor, each with another on top."""
    floor = make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)
    spots = [(spacing * (k % 30), spacing * (k // 30)) for k in range(count)]
    balls = [make_body(f"{k}/{h}", 0, [x, y, 0.5 + h]) for k, (x, y) in enumerate(spots) for h in range(2)]
    return Scene((ball(nodes), analytic_shape("plane")), (floor, *balls), GRAVITY.numpy(), 1.0)


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


def test_rest_is_when_nothing_strays_for_long_enough():
    bodies, state = bodies_of(stacks(2))
    rest, told = Rest(), []
    for k in range(STEPS + 2):
        rest = rest.after(bodies, replace(state, position=state.position + 0.2 * STRAY * (-1) ** k))
        told.append(rest.settled)
    assert told == [False] * STEPS + [True, True]
    moved = state.position.clone()
    moved[3, 0] += 2 * STRAY
    assert not rest.after(bodies, replace(state, position=moved)).settled
    fallen = state.position.clone()
    fallen[0, 2] -= 1.0  # the floor is not asked
    rest, told = Rest(), []
    for position in (state.position, fallen, *(fallen * 0 + k for k in range(STEPS + 3))):
        rest = rest.after(bodies, replace(state, position=position))
        told.append(rest.settled)
    assert not any(told)
