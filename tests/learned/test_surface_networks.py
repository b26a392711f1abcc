"""The step of networks on surface nodes: what is off is off, free flight exact or learned, history a rigid motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.learned.surfaces import advance, node_owner, state_arrays
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import angle_between, in_torch, make_body, random_model, surface_model


def test_without_acceleration_every_body_goes_on_as_it_came(dropped):
    """Zero acceleration of every node is uniform motion: translation exactly, rotation to the order of the step."""
    sim = Simulator(dropped, surface_model())
    zero = torch.zeros(len(sim.bodies.node), 3, dtype=torch.float64)
    after = state_arrays(advance(*in_torch(sim.bodies, sim.state), zero, sim.options.dt))
    moves = sim.bodies.moves
    before = sim.state.earlier_position[1]
    np.testing.assert_allclose(
        after.position[moves], (2 * sim.state.position - before)[moves], rtol=0, atol=2e-3 * sim.options.dt
    )
    np.testing.assert_array_equal(after.position[~moves], sim.state.position[~moves])


def test_a_common_acceleration_moves_the_centre_by_it(free_pair):
    sim = Simulator(free_pair, surface_model())
    push = torch.tensor([[0.01, -0.02, 0.03], [0.0, 0.05, 0.0]], dtype=torch.float64)
    bodies, state = in_torch(sim.bodies, sim.state)
    owner = node_owner(bodies)
    with_push, without = (
        state_arrays(advance(bodies, state, acceleration[owner], sim.options.dt))
        for acceleration in (push, torch.zeros_like(push))
    )
    np.testing.assert_allclose(with_push.position - without.position, push, rtol=0, atol=1e-9)
    assert angle_between(with_push.orientation, without.orientation).max() < 1e-6


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
