"""Large scenes: work goes with what touches, memory with a piece, and nothing is done body by body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from sdfsim.dynamics.clusters import layers
from sdfsim.dynamics.sleep import STEPS, STRAY, Rest
from torch.utils._python_dispatch import TorchDispatchMode

from sdfsim.dynamics.bodies import Units, from_scene
from sdfsim.dynamics.contacts import ARRAYS, find_contacts, thin_contacts
from sdfsim.dynamics.memory import Memory
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape, load_shape
from tests.dynamics.conftest import make_body
from tests.dynamics.test_contacts import heap

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


class Watched(TorchDispatchMode):
    """Counts operations and remembers the largest array they made."""

    def __init__(self) -> None:
        super().__init__()
        self.count = self.largest = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        self.count += 1
        for each in made if isinstance(made, tuple | list) else (made,):
            if isinstance(each, torch.Tensor):
                self.largest = max(self.largest, each.untyped_storage().nbytes() // each.element_size())
        return made


@pytest.mark.parametrize("seed", range(2))
def test_every_ball_holds_what_is_below_it(seed):
    scene = replace(heap(seed), shapes=(ball(500), load_shape(SHAPES / "ring"), analytic_shape("plane")))
    bodies, _ = bodies_of(scene)
    whole, patches, nodes = layers(bodies)
    assert sorted(nodes.node.tolist()) == list(range(len(bodies.node)))
    assert torch.equal(nodes.centre, bodies.node[nodes.node]) and float(nodes.radius.max()) == 0.0
    for above, below in ((whole, patches), (patches, nodes)):
        parent = torch.repeat_interleave(torch.arange(len(above)), below.start[1:] - below.start[:-1])
        assert len(parent) == len(below) > len(above)
        far = (below.centre - above.centre[parent]).norm(dim=-1) + (below.radius if below is nodes else 0.0)
        assert bool((far <= above.radius[parent] + 1e-12).all())
    # A ball of a body holds nodes of that body: it begins where the body's nodes do.
    held = nodes.start[patches.start]
    assert torch.equal(torch.diff(held), torch.diff(bodies.node_start)[torch.diff(whole.start) > 0])
    sizes = torch.diff(nodes.start).double()
    assert 6 < float(sizes.mean()) < 48


def test_more_nodes_cost_what_is_near_of_them():
    """A ball in a bowl: all of it is within the bowl's box, a small part near the wall."""
    bowl = load_shape(SHAPES / "bowl")
    radius = 0.5 * float(np.ptp(bowl.sdf.bounds[:, 0]))
    asked, edges = [], []
    for nodes in (64, 4096):
        vessel = make_body("bowl", 1, [0, 0, 0], motion="static", mass=0.0, scale=2 / radius)
        scene = Scene((ball(nodes), bowl), (vessel, make_body("ball", 0, [0, 0, -1.2])), np.zeros(3), 1.0)
        bodies, state = bodies_of(scene)
        found = find_contacts(bodies, state, 0 * GRAVITY, REACH, DT)
        asked.append(found.queries - int((found.owner == 0).sum()))
        edges.append(int((found.owner == 1).sum()))
    assert edges[1] > 20 * edges[0] > 0
    assert asked[1] < 4096 / 2


def test_as_many_operations_for_many_bodies_as_for_few():
    counts, largest = [], []
    for count in (20, 600):
        bodies, state = bodies_of(stacks(count))
        memory = Memory()
        find_contacts(bodies, state, GRAVITY, REACH, DT, memory, thin=True)
        with Watched() as watched:
            find_contacts(bodies, state, GRAVITY, REACH, DT, memory, thin=True)
        counts.append(watched.count)
        largest.append(watched.largest / count)
    assert counts[1] <= 1.1 * counts[0]
    # Far below N x N: an array of it would hold 2,400 numbers a stack.
    assert largest[1] < 2 * largest[0]


def test_edges_chosen_in_pieces_are_those_chosen_from_all_and_take_less():
    bodies, state = bodies_of(stacks(40, 500, spacing=1.02))
    tree, sizes = Memory(), []
    tree.tree(bodies)
    everything = find_contacts(bodies, state, GRAVITY, REACH, DT)
    expected = thin_contacts(bodies, everything)
    for rows in (2_000, 2**18):
        with Watched() as watched:
            got = find_contacts(bodies, state, GRAVITY, REACH, DT, Memory(), rows, thin=True, rounded=False)
        assert all(torch.equal(getattr(got, k), getattr(expected, k)) for k in ARRAYS)
        sizes.append(watched.largest)
    assert sizes[0] < 3 * bodies.node.numel() < sizes[1]


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
