"""Graphs of the paper's baselines: what is near what against brute force, and what their edges say."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.baselines import FAMILIES, closest_points, face_pairs, node_pairs, vertices
from sdfsim.learned.pose import rotate
from sdfsim.learned.tensors import BodyTensors, StateTensors
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.free_flight import with_history
from sdfsim.physics.options import Options
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import in_torch, make_body

GRAVITY = np.array([0.0, 0.0, -10.0])
FLIP = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
DT, REACH = 0.02, 0.3


def bodies_of(kind: str, seed: int = 0) -> tuple[BodyTensors, StateTensors]:
    """Four tumbling bodies close to each other and to the floor."""
    rng = np.random.default_rng(seed)
    shapes = (
        analytic_shape("box", size=(1.0, 0.8, 0.6)),
        analytic_shape("sphere", radius=0.4),
        analytic_shape("plane"),
    )
    bodies = [make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0)]
    for k, place in enumerate(([0, 0, 0.6], [0.9, 0.2, 0.7], [0.1, 0.9, 0.5], [0.4, 0.4, 1.4])):
        quat = rng.normal(size=4)
        speeds = {name: rng.normal(size=3) for name in ("velocity", "angular_velocity")}
        bodies.append(make_body(f"{k}", k % 2, place, quat_xyzw=quat / np.linalg.norm(quat), mass=1.0 + k, **speeds))
    worked_on = tuple(FAMILIES[kind].surface(shape, 30) for shape in shapes)
    scene = Scene(worked_on, tuple(bodies), gravity=GRAVITY, duration=1.0)
    found, state = from_scene(scene, Units(1.0, 1.0, 1.0))
    return in_torch(found, with_history(state, found, Options(gravity=GRAVITY, dt=DT)))


def distances_by_projection(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[E] distances of triangles [E, 3, 3] by projecting a point onto one and the other in turn, many times."""
    import trimesh

    point = one.mean(1)
    for _ in range(3000):
        there = trimesh.triangles.closest_point(other, point)
        point = trimesh.triangles.closest_point(one, there)
    return np.linalg.norm(point - there, axis=1)


@pytest.mark.parametrize("apart", [0.0, 0.5, 3.0])
def test_closest_points_of_triangles_are_those_of_projecting_in_turn(apart):
    import trimesh

    rng = np.random.default_rng(1)
    one, other = rng.normal(size=(60, 3, 3)), rng.normal(size=(60, 3, 3)) + np.array([apart, 0.0, 0.0])
    ours = closest_points(torch.from_numpy(one), torch.from_numpy(other))
    found = (ours[0] - ours[1]).norm(dim=-1).numpy()
    np.testing.assert_allclose(found, distances_by_projection(one, other), rtol=0, atol=2e-3)
    for points, triangles in zip(ours, (one, other), strict=True):
        on = trimesh.triangles.closest_point(triangles, points.numpy())
        np.testing.assert_allclose(on, points.numpy(), rtol=0, atol=1e-9)
    if apart == 0.0:
        assert (found < 1e-12).sum() > 5 and (found > 0.05).sum() > 5  # crossing ones and others


def test_parallel_and_shared_sides_are_no_trouble():
    flat = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=torch.float64)
    for shift, wanted in (([0, 0, 0.5], 0.5), ([2.0, 0, 0], 1.0), ([0, 0, 0], 0.0), ([1.0, 0, 0], 0.0)):
        one, other = closest_points(flat, flat + torch.tensor(shift, dtype=torch.float64))
        assert float((one - other).norm()) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pairs_of_nodes_are_all_there_are(seed):
    bodies, state = bodies_of("mgn", seed)
    pairs = node_pairs(bodies, state, GRAVITY, REACH, DT)
    owner = torch.repeat_interleave(torch.arange(len(bodies)), bodies.node_start.diff())
    arm = rotate(state.orientation[owner], bodies.node)
    place, fall = state.position[owner] + arm, torch.from_numpy(GRAVITY) * DT * bodies.moves[:, None]
    speed = (state.velocity + fall)[owner] + torch.linalg.cross(state.angular_velocity[owner], arm)
    expected = set()
    for i in range(len(owner)):
        for j in range(len(owner)):
            one, other = int(owner[i]), int(owner[j])
            if one >= other or 0 == one:
                continue
            way = place[j] - place[i]
            closing = ((speed[i] - speed[j]) * way / way.norm()).sum().clamp_min(0.0)
            if way.norm() - closing * DT <= REACH:
                expected.add((i, j))
    floor = {int(i) for i, b in zip(pairs.first[:, 0], pairs.body, strict=True) if b == 0}
    assert floor == {
        i for i in range(len(owner)) if owner[i] > 0 and place[i, 2] + min(0.0, float(speed[i, 2])) * DT <= REACH
    }
    found = pairs.body > 0
    ends = torch.cat([pairs.first[found], pairs.second[found]], 1).sort(1).values
    assert {tuple(p) for p in ends.tolist()} == expected and len(ends) == len(expected) > 10


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_of_faces_are_all_that_are_nearer_than_reach(seed):
    bodies, state = bodies_of("fignet", seed)
    resting = replace(state, velocity=0 * state.velocity, angular_velocity=0 * state.angular_velocity)
    pairs = face_pairs(bodies, resting, 0 * GRAVITY, REACH, DT)
    owner = torch.repeat_interleave(torch.arange(len(bodies)), bodies.node_start.diff())
    place = state.position[owner] + rotate(state.orientation[owner], bodies.node)
    first, second = torch.triu_indices(len(bodies.face), len(bodies.face), 1)
    first_body, second_body = owner[bodies.face[first, 0]], owner[bodies.face[second, 0]]
    different = (first_body != second_body) & (first_body > 0) & (second_body > 0)
    first, second = first[different], second[different]
    triangles = place[bodies.face[first]].numpy(), place[bodies.face[second]].numpy()
    one, other = closest_points(*map(torch.from_numpy, triangles))
    near = (one - other).norm(dim=-1) <= REACH
    assert int((pairs.body > 0).sum()) == int(near.sum()) > 20
    lowest = place[bodies.face].amin(1)[:, 2]
    assert int((pairs.body == 0).sum()) == int((lowest[owner[bodies.face[:, 0]] > 0] <= REACH).sum()) > 5
    np.testing.assert_allclose(pairs.distance[pairs.body > 0], pairs.way[pairs.body > 0].norm(dim=-1), atol=1e-12)


@pytest.mark.parametrize("kind", [kind for kind in FAMILIES if kind != "sdf-sim"])
def test_the_mirrored_graph_is_the_graph_of_the_mirrored_scene(kind):
    """All but SDF-Sim, whose distances are those of shapes that nothing here mirrors."""
    bodies, state = bodies_of(kind)
    assert state.earlier_position is not None and state.earlier_orientation is not None
    turned = torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)  # axial: a mirrored turn goes the other way
    image = replace(
        state,
        position=state.position * FLIP,
        orientation=state.orientation * turned,
        velocity=state.velocity * FLIP,
        angular_velocity=-state.angular_velocity * FLIP,
        earlier_position=state.earlier_position * FLIP,
        earlier_orientation=state.earlier_orientation * turned,
    )
    family = FAMILIES[kind]
    made = family.graph(bodies, state, family.near(bodies, state, GRAVITY, REACH, DT, None)).mirrored(family.layout)
    mirrored = replace(bodies, node=bodies.node * FLIP, face=bodies.face[:, [0, 2, 1]])
    near = family.near(mirrored, image, GRAVITY, REACH, DT, None)
    theirs = family.graph(mirrored, image, near)
    for name, features in made.nodes.items():
        torch.testing.assert_close(features, theirs.nodes[name], rtol=0, atol=1e-5)
    for name, edges in made.edges.items():
        other = theirs.edges[name]
        torch.testing.assert_close(*map(_sorted, (edges, other)), rtol=0, atol=1e-4)


def _sorted(edges) -> torch.Tensor:
    """[E, *] float64: ends and features, in an order that only the ends decide."""
    ends = torch.cat([edges.sender.sort(1).values, edges.receiver.sort(1).values], 1)
    key = [tuple(row) for row in ends.tolist()]
    order = sorted(range(len(key)), key=key.__getitem__)
    lengths = edges.features[:, :4].square().sum(-1, keepdim=True)
    return torch.cat([ends.double(), edges.features[:, :4].double(), lengths.double()], 1)[order]


def test_mesh_edges_are_the_sides_of_faces_both_ways_and_the_star_is_without_them():
    bodies, state = bodies_of("fignet")
    near = face_pairs(bodies, state, GRAVITY, REACH, DT)
    whole, star = (FAMILIES[kind].graph(bodies, state, near) for kind in ("fignet", "fignet-star"))
    sides = {tuple(sorted((int(a), int(b)))) for f in bodies.face for a, b in zip(f, f.roll(1), strict=True) if a != b}
    assert len(whole.edges["mesh"].sender) == 2 * len(sides)
    assert whole.edge_count - star.edge_count == 2 * len(sides) and len(star) == len(whole)
    assert len(star.edges["intra_up"].sender) == len(bodies.node) == len(star.nodes["node"])


def test_meshes_are_reduced_to_about_what_is_wanted():
    import trimesh

    ball = analytic_shape("sphere", radius=0.4)
    for count in (30, 100):
        shape = vertices(ball, count)
        assert 0.8 * count <= len(shape.nodes) <= 1.2 * count
        mesh = trimesh.Trimesh(shape.nodes, shape.faces, process=False)
        assert mesh.is_watertight and mesh.volume > 0.8 * ball.volume
    floor = vertices(analytic_shape("plane"), 100)
    assert len(floor.nodes) == len(floor.faces) == 1
