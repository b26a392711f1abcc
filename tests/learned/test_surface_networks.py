"""Networks on surface nodes: their graph against a slow readable twin, what is off is off, free flight exact or
learned, history a rigid motion."""

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
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import load_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import contact_edges, make_body, random_model, surface_model
from tests.helpers.shapes import SHAPES


def test_exact_free_flight_leaves_the_high_body_to_gravity_and_learned_does_not(dropped):
    exact = Simulator(dropped, surface_model()).run(steps=5)
    learned = Simulator(dropped, surface_model(), free_flight="learned").run(steps=5)
    high = dropped.bodies[3]
    t = exact.time[:, None]
    fall = high.position + 0.5 * dropped.gravity * t**2
    np.testing.assert_allclose(exact.position[:, 3], fall, atol=1e-9)
    assert np.abs(learned.position[:, 3] - fall).max() > 1e-4


def test_learned_free_flight_reaches_the_network_without_any_contact(dropped):
    alone = replace(dropped, bodies=(dropped.bodies[3],))
    learned = Simulator(alone, surface_model(), free_flight="learned").run(steps=3)
    fall = alone.bodies[0].position + 0.5 * alone.gravity * learned.time[:, None] ** 2
    assert np.abs(learned.position[:, 0] - fall).max() > 1e-4


def test_rotation_off_keeps_every_orientation(dropped):
    for model in (surface_model(), random_model("impulse", push=0.05)):
        scene = replace(dropped, effects=Effects(rotation="off"))
        rollout = Simulator(scene, model).run(steps=8)
        assert rollout.contact_count.sum() > 0
        np.testing.assert_array_equal(rollout.orientation, np.broadcast_to(rollout.orientation[0], (9, 4, 4)))
        assert (rollout.angular_velocity[1:] == 0).all()


def test_friction_and_restitution_off_equal_bodies_without_them(dropped):
    model = surface_model()
    off = Simulator(replace(dropped, effects=Effects(friction="off", restitution="off")), model).run(steps=6)
    bare = tuple(replace(b, friction=0.0, restitution=0.0) for b in dropped.bodies)
    none = Simulator(replace(dropped, bodies=bare), model).run(steps=6)
    np.testing.assert_array_equal(off.position, none.position)
    assert np.abs(off.position - Simulator(dropped, model).run(steps=6).position).max() > 1e-6


def test_a_body_that_is_changed_goes_on_as_its_new_state_says_and_the_others_as_before(dropped):
    calm = surface_model(push=2e-6)
    changed, plain = (Simulator(dropped, calm, free_flight="learned") for _ in range(2))
    for sim in (changed, plain):
        list(sim.steps(3))
    velocity, position = changed.state.velocity.copy(), changed.state.position.copy()
    velocity[3] = (4.0, 0.0, 1.0)
    position[3, 0] += 7.0
    changed.state = replace(changed.state, velocity=velocity, position=position)
    ((after,), (kept,)) = (list(sim.steps(1)) for sim in (changed, plain))
    step = changed.options.dt
    # Half a step of gravity is in the pose that the velocity leads from.
    way = changed.state.position[3] - position[3] - velocity[3] * step
    assert np.linalg.norm(way) < 10.0 * step**2
    np.testing.assert_array_equal(after.position[:3], kept.position[:3])


def test_a_state_of_another_run_keeps_its_own_history_and_one_without_gets_one(dropped):
    one, other, bare = (Simulator(dropped, surface_model(), free_flight="learned") for _ in range(3))
    list(one.steps(3))
    other.restore(one.state)
    bare.state = replace(one.state, earlier_position=None, earlier_orientation=None)
    (went,), (same,), (near,) = (list(sim.steps(1)) for sim in (one, other, bare))
    np.testing.assert_array_equal(went.position, same.position)
    np.testing.assert_allclose(went.position, near.position, rtol=0, atol=0.02)


def test_far_from_the_origin_a_step_is_the_same(dropped):
    """Only differences of poses enter; the floor is infinite, so scenes may be anywhere above it."""
    far = np.array([1e4, -2e4, 0.0])
    moved = replace(dropped, bodies=tuple(replace(b, position=b.position + far) for b in dropped.bodies))
    here, there = (Simulator(scene, surface_model(), free_flight="learned") for scene in (dropped, moved))
    (one,), (other,) = (list(sim.steps(1)) for sim in (here, there))
    np.testing.assert_allclose(other.position - far, one.position, rtol=0, atol=1e-6)


def test_the_order_of_bodies_does_not_matter(dropped):
    """Where surfaces do not cross: of crossing faces any common point is the closest."""
    apart = replace(dropped.bodies[2], position=np.array([0.85, 0.95, 0.8]))
    bodies, order = (*dropped.bodies[:2], apart, dropped.bodies[3]), [2, 0, 3, 1]
    scenes = (replace(dropped, bodies=b) for b in (bodies, tuple(bodies[k] for k in order)))
    one, other = (next(Simulator(s, surface_model(), free_flight="learned").steps(1)) for s in scenes)
    np.testing.assert_allclose(other.position, one.position[order], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind_of", ["paper", "impulse", "solver"])
def test_scenery_that_was_moved_is_met_where_it_is(kind_of):
    """A block is put under a ball that hangs in the air, after a step in which it was elsewhere; and taken away."""
    ball, block = analytic_shape("sphere", radius=0.5), analytic_shape("box", size=(2.0, 2.0, 1.0))
    bodies = (make_body("ball", 0, [0, 0, 1.02]), make_body("block", 1, [50, 0, 0], motion="static", mass=0.0))
    scene = Scene((ball, block), bodies, np.zeros(3), 1.0)
    model = surface_model() if kind_of == "paper" else random_model("impulse") if kind_of == "impulse" else "solver"
    sim = Simulator(scene, model)
    start = sim.state

    def meets() -> bool:
        sim["ball"].velocity = (0, 0, -0.5)
        sim.step(4)
        free = abs(sim["ball"].velocity[2] + 0.5) < 1e-9
        sim["ball"].position = (0, 0, 1.02)
        return not free

    assert not meets()
    sim["block"].position = (0, 0, 0)
    assert meets()
    sim["block"].position = (0, -50, 0)
    assert not meets()
    sim["block"].position = (0, 0, 0)
    sim.state = replace(sim.state, touch=None)
    assert meets()
    sim.state = start  # where the block is elsewhere, as the contacts of that state have known it
    assert not meets()


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


FAR, STEP = 0.05, 0.02


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
    _, _, found = contact_edges(bodies, state, np.zeros(3), FAR, STEP)
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
