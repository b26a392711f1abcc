"""SDF-Sim's graph: contact edges against a slow readable twin that asks every node about every other body, and the
graph's mirror image."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.surfaces import SDF_SIM, sdf_sim_graph
from sdfsim.physics.bodies import Units, from_scene
from sdfsim.physics.free_flight import with_history
from sdfsim.physics.options import Options
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape
from tests.helpers.scenes import contact_edges, make_body

GRAVITY = np.array([0.0, 0.0, -10.0])
REACH, DT = 0.1, 0.02


def heap(seed: int) -> Scene:
    """Boxes and balls, some overlapping, thrown about above a floor and around a static block."""
    rng = np.random.default_rng(seed)
    shapes = (
        analytic_shape("box", size=(1.0, 0.7, 0.5)),
        analytic_shape("sphere", radius=0.4),
        analytic_shape("plane"),
    )
    bodies = [
        make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0),
        make_body("block", 0, [0, 0, 0.3], motion="static", mass=0.0),
    ]
    for k in range(8):
        bodies.append(
            make_body(
                f"b{k}",
                k % 2,
                rng.uniform([-1, -1, 0.2], [1, 1, 1.5]),
                scale=rng.uniform(0.5, 1.2),
                quat_xyzw=Rotation.random(rng=rng).as_quat(),
                velocity=rng.normal(size=3) * 4,
                angular_velocity=rng.normal(size=3) * 3,
            )
        )
    return Scene(shapes, tuple(bodies), gravity=GRAVITY, duration=1.0)


def slow_twin(scene: Scene, allowed=lambda one, other: True) -> dict[tuple[int, int, int], float]:
    """(owner, node of the owner, other) -> distance of every edge there should be."""
    edges = {}
    for i, one in enumerate(scene.bodies):
        shape = scene.shapes[one.shape]
        turn = Rotation.from_quat(one.quat_xyzw)
        for j, other in enumerate(scene.bodies):
            if i == j or (one.motion == other.motion == "static") or not len(shape.nodes) or not allowed(one, other):
                continue
            to, back = scene.shapes[other.shape], Rotation.from_quat(other.quat_xyzw)
            for k, node in enumerate(shape.nodes):
                world = one.position + turn.apply(node * one.scale)
                d, g = to.sdf(back.inv().apply(world - other.position)[None] / other.scale)
                d, normal = d[0] * other.scale, back.apply(g[0] / np.linalg.norm(g[0]))
                speeds = []
                for body, point in ((one, world), (other, world - d * normal)):
                    falls = GRAVITY * DT if body.motion == "dynamic" else 0.0
                    speeds.append(body.velocity + falls + np.cross(body.angular_velocity, point - body.position))
                if d + min(0.0, (speeds[0] - speeds[1]) @ normal) * DT <= REACH:
                    edges[i, k, j] = d
    return edges


def found(scene: Scene):
    bodies, _, contacts = contact_edges(*from_scene(scene, Units(1.0, 1.0, 1.0)), GRAVITY, REACH, DT)
    return bodies, contacts


def as_edges(bodies, contacts) -> dict[tuple[int, int, int], float]:
    node = contacts.node - bodies.node_start[contacts.owner]
    keys = zip(contacts.owner.tolist(), node.tolist(), contacts.body.tolist(), strict=True)
    return dict(zip(keys, contacts.distance.tolist(), strict=True))


@pytest.mark.parametrize("seed", range(4))
def test_the_same_edges_as_asking_every_node(seed):
    scene = heap(seed)
    bodies, contacts = found(scene)
    expected, got = slow_twin(scene), as_edges(bodies, contacts)
    # An edge within rounding of the threshold may fall on either side.
    assert set(got) ^ set(expected) == set() and len(expected) > 50
    np.testing.assert_allclose([got[k] for k in expected], list(expected.values()), atol=1e-6)


def test_collides_with_is_kept_by_both_sides():
    scene = heap(0)
    only = ("floor", "b1")
    chosen = tuple(replace(b, collides_with=only) if b.name == "b0" else b for b in scene.bodies)
    scene = replace(scene, bodies=chosen)
    bodies, contacts = found(scene)

    def allowed(one, other):
        return all(b.collides_with is None or a.name in b.collides_with for a, b in ((one, other), (other, one)))

    assert set(as_edges(bodies, contacts)) == set(slow_twin(scene, allowed))


def test_the_mirrored_graph_is_the_graph_of_the_mirrored_scene():
    """Boxes and balls are their own mirror images; their nodes are mirrored with the scene."""
    bodies, state = from_scene(heap(0), Units(1.0, 1.0, 1.0))
    state = with_history(state, bodies, Options(gravity=GRAVITY, dt=DT))
    # axial: a mirrored turn goes the other way
    flip, turned = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
    image = replace(
        state,
        position=state.position * flip,
        orientation=state.orientation * turned,
        velocity=state.velocity * flip,
        angular_velocity=-state.angular_velocity * flip,
        earlier_position=state.earlier_position * flip,
        earlier_orientation=state.earlier_orientation * turned,
    )
    both = ((bodies, state), (replace(bodies, node=bodies.node * flip), image))
    made, theirs = (sdf_sim_graph(*contact_edges(*one, GRAVITY, REACH, DT)) for one in both)
    made = made.mirrored(SDF_SIM)
    for name, features in made.nodes.items():
        torch.testing.assert_close(features, theirs.nodes[name], rtol=0, atol=1e-5)
    assert len(made.edges["contact_up"].sender) > 50
    for name, edges in made.edges.items():
        torch.testing.assert_close(*map(_sorted, (edges, theirs.edges[name])), rtol=0, atol=1e-4)


def _sorted(edges) -> torch.Tensor:
    """[E, *] ends and features, in an order that only the ends decide."""
    order = np.lexsort((edges.receiver, edges.sender))
    return torch.cat([edges.sender[:, None], edges.receiver[:, None], edges.features], 1)[order]


def test_fast_bodies_have_an_edge_before_they_arrive():
    """At 20 m/s a body covers 0.4 m a step: it is seen four times the contact radius away."""
    floor = make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)
    shapes = (analytic_shape("sphere", radius=0.4), analytic_shape("plane"))
    ball = make_body("ball", 0, [0, 0, 0.8], velocity=np.array([0.0, 0.0, -20.0]))
    assert len(found(Scene(shapes, (floor, ball), GRAVITY, 1.0))[1]) > 0
    assert len(found(Scene(shapes, (floor, replace(ball, velocity=np.zeros(3))), GRAVITY, 1.0))[1]) == 0


def test_a_moving_body_needs_mass_and_nodes():
    plane = Scene((analytic_shape("plane"),), (make_body("sheet", 0, [0, 0, 0]),), GRAVITY, 1.0)
    weightless = Scene((analytic_shape("sphere", radius=1.0),), (make_body("b", 0, [0, 0, 0], mass=0.0),), GRAVITY, 1.0)
    for scene in (plane, weightless):
        with pytest.raises(SdfsimError, match="needs a mass"):
            from_scene(scene, Units(1.0, 1.0, 1.0))
