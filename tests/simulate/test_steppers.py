"""The contract of steppers: steps in one call or one by one, states taken up again, and what is changed in between."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim import SdfsimError
from sdfsim.learned.model import load_model
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body, random_model, surface_model

MODELS = {
    "solver": load_model,
    "impulse": lambda: random_model("impulse", push=0.1),
    "sdf-sim": surface_model,
}
G = 9.81
NAMES = ("position", "orientation", "velocity", "angular_velocity")


def resting() -> Simulator:
    """A box asleep on a block, and one asleep on the floor far from it."""
    box = analytic_shape("box", size=(1.0, 1.0, 1.0))
    still = {"restitution": 0.0}
    bodies = (
        make_body("block", 0, [0, 0, 0.5], motion="static", mass=0.0, **still),
        make_body("box", 0, [0, 0, 1.5], **still),
        make_body("other", 0, [9, 0, 0.5], **still),
        make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0, **still),
    )
    sim = Simulator(Scene((box, analytic_shape("plane")), bodies, np.array([0.0, 0.0, -G]), 1.0))
    sim.step(60)
    assert sim["box"].asleep and sim["other"].asleep
    return sim


@pytest.mark.parametrize("contact", ["auto", "off"])
@pytest.mark.parametrize("kind", MODELS)
def test_steps_in_one_call_are_the_steps_one_by_one(dropped, kind, contact):
    sim = Simulator(replace(dropped, effects=Effects(contact=contact)), MODELS[kind]())
    at_once, carry = sim.stepper.advance(sim.state, sim.stepper.init(sim.bodies, sim.state, sim.options), 6)
    sim.step(6)
    for name in NAMES:
        assert torch.equal(getattr(at_once, name), getattr(sim.state, name)), name
    assert carry.counts["active"] == sim.carry.counts["active"]


@pytest.mark.parametrize("kind", MODELS)
def test_a_restored_state_goes_on_as_the_run_did_here_and_elsewhere(dropped, kind):
    sim, other = Simulator(dropped, MODELS[kind]()), Simulator(dropped, MODELS[kind]())
    sim.step(12)
    kept = sim.state
    once = sim.run(steps=12)
    for one in (sim, other):
        one.restore(kept)
        again = one.run(steps=12)
        for name in ("time", *NAMES):
            np.testing.assert_array_equal(getattr(again, name), getattr(once, name), err_msg=name)


def test_a_state_of_the_solver_is_taken_up_by_a_network_on_surface_nodes(dropped):
    one, other, third = (Simulator(dropped, surface_model()) for _ in range(3))
    bare = replace(one.state, earlier_position=None, earlier_orientation=None)
    other.restore(bare)
    third.state = bare
    one, other, third = (sim.run(steps=5) for sim in (one, other, third))
    np.testing.assert_array_equal(other.position, one.position)
    np.testing.assert_array_equal(third.position, one.position)


def test_a_state_that_cannot_be_is_not_restored(dropped):
    sim = Simulator(dropped)
    with pytest.raises(SdfsimError, match="body 'floor': velocity is not finite"):
        sim.restore(replace(sim.state, velocity=torch.full_like(sim.state.velocity, torch.nan)))


def by_handle(sim: Simulator) -> None:
    sim["block"].position = (0, -50, 0.5)


def by_state(sim: Simulator) -> None:
    position = sim.state.position.clone()
    position[0, 1] = -50 / sim.units.length
    sim.state = replace(sim.state, position=position)


@pytest.mark.parametrize("move", [by_handle, by_state])
def test_who_slept_on_what_is_moved_away_falls_and_the_others_sleep_on(move):
    sim = resting()
    move(sim)
    sim.step(5)
    assert not sim["box"].asleep and sim["other"].asleep
    # Free fall, but for a first inner step of a body at rest.
    assert sim["box"].velocity[2] == pytest.approx(-G * 5 * sim.dt, rel=0.05)


def test_a_state_that_is_given_unchanged_wakes_nobody():
    sim = resting()
    sim.state = replace(sim.state)
    sim.step(1)
    assert sim["box"].asleep and sim["other"].asleep


def test_all_wake_under_another_gravity():
    sim = resting()
    sim.options = replace(sim.options, gravity=-sim.options.gravity)
    sim.step(5)
    for name in ("box", "other"):
        assert not sim[name].asleep
        assert sim[name].velocity[2] == pytest.approx(G * 5 * sim.dt, rel=0.1)


def test_effects_may_be_changed_amid_a_run():
    sim = resting()
    before = sim.options
    sim.options = replace(before, friction=False)
    sim["other"].velocity = (1.0, 0, 0)
    sim.step(10)
    assert sim["other"].velocity[0] == pytest.approx(1.0, abs=1e-9)
    sim.options = before
    sim.step(10)
    mu = 0.5 * 0.5  # of box and floor
    assert sim["other"].velocity[0] == pytest.approx(1.0 - mu * G * 10 * sim.dt, rel=0.02)
