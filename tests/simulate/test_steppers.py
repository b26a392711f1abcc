"""The contract of steppers: steps in one call or one by one, states taken up again, and what is changed in between."""

from dataclasses import fields, replace

import numpy as np
import pytest

from sdfsim import SdfsimError
from sdfsim.learned.model import load_model
from sdfsim.physics.rollout import Rollout, join
from sdfsim.physics.steps import COUNTS, PHASES
from sdfsim.physics.validity import FARTHEST, FASTEST
from sdfsim.scene.scene import Scene, Waypoints
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import SimulationError, Simulator
from tests.helpers.scenes import make_body, random_model, surface_model

MODELS = {"solver": load_model, "impulse": lambda: random_model("impulse", push=0.1), "sdf-sim": surface_model}
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


def busy() -> Scene:
    """A pile that falls together, a paddle that comes into it, a box that only lies there, one to be pulled, and a ball
    that nothing may touch."""
    box, ball = analytic_shape("box", size=(1.0, 0.8, 0.6)), analytic_shape("sphere", radius=0.4)
    tilt = np.array([0.1, 0.2, 0.05, 1.0]) / np.linalg.norm([0.1, 0.2, 0.05, 1.0])
    path = Waypoints(
        np.array([0.2, 0.6, 1.2]), np.array([[-3.0, 0, 0.5], [1.0, 0.2, 0.5], [-2.0, 0, 0.5]]),
        np.array([[0.0, 0, 0, 1], [0.0, 0, 0.6, 0.8], [0.0, 0, 0, 1]]),
    )  # fmt: skip
    bodies = (
        make_body("low", 0, [0.0, 0.0, 0.5], quat_xyzw=tilt),
        make_body("mid", 1, [0.1, 0.05, 1.25], velocity=np.array([0.0, 0.0, -1.0]), restitution=0.1),
        make_body("top", 0, [0.0, -0.1, 2.0], angular_velocity=np.array([1.0, 2.0, 0.5]), mass=3.0),
        make_body("still", 0, [9.0, 0.0, 0.3], restitution=0.0),
        make_body("pulled", 0, [0.0, 9.0, 0.3], friction=0.1, restitution=0.0),
        make_body("alone", 1, [0.0, -9.0, 5.0], collides_with=()),
        make_body("paddle", 0, path.position[0], motion="kinematic", mass=0.0, path=path),
        make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0),
    )
    return Scene((box, ball, analytic_shape("plane")), bodies, np.array([0.0, 0.0, -G]), 1.0)


def busy_simulator(kind: str) -> Simulator:
    scene = busy()
    if kind != "solver":  # networks have no inputs for paths
        still = [replace(b, motion="static", path=None) if b.path is not None else b for b in scene.bodies]
        scene = replace(scene, bodies=tuple(still))
    sim = Simulator(scene, MODELS[kind]())
    if sim.stepper.forces:
        sim["pulled"].pull((4.0, 1.0, 0.0), torque=(0.0, 0.0, 0.3))
    return sim


def followed(sim: Simulator, steps: int, at_once: int) -> tuple[Rollout, str]:
    """What is kept of so many steps in chunks of `at_once`, and the error that ends them."""
    parts, told = [sim.initial_rollout()], ""
    try:
        for part in sim.frames(steps, at_once):
            parts.append(part)
            assert len(part.time) <= at_once
    except SimulationError as error:
        told = error.message
        parts.append(error.rollout)
    return join(parts), told


def assert_same(one: Rollout, other: Rollout) -> None:
    """To the last bit, but for how long it took."""
    for name in ("time", *NAMES, "contact_count", "contact_point", "contact_body"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.counters.keys() == other.counters.keys()
    for name in one.counters.keys() - {*PHASES, "step_ms"}:
        np.testing.assert_array_equal(one.counters[name], other.counters[name], err_msg=name)


def assert_same_state(one: Simulator, other: Simulator) -> None:
    assert one.steps_done == other.steps_done and one.state.time == other.state.time
    for name in NAMES:
        np.testing.assert_array_equal(getattr(one.state, name), getattr(other.state, name), err_msg=name)
    assert [one.carry.counts[name] for name in COUNTS] == [other.carry.counts[name] for name in COUNTS]
    a, b = one.state.touch, other.state.touch
    if a is None or b is None:
        assert a is b
        return
    for name in (field.name for field in fields(a) if field.name != "point"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    known = np.arange(a.point.shape[1]) < a.count[:, None]  # the rest of a pair's rows is nothing
    np.testing.assert_array_equal(a.point[known], b.point[known])


@pytest.mark.parametrize("at_once", [7, 60])
@pytest.mark.parametrize("kind", MODELS)
def test_chunks_of_steps_keep_what_single_steps_do(kind, at_once):
    one, other = busy_simulator(kind), busy_simulator(kind)
    single, chunks = followed(one, 60, 1)[0], followed(other, 60, at_once)[0]
    assert len(single) == 60 and single.contact_count.max() > 3
    assert_same(single, chunks)
    assert_same_state(one, other)
    touched = {tuple(sorted(pair)) for pair in single.contact_body.tolist()}
    assert touched
    if kind == "solver":
        assert {(0, 1), (1, 2), (0, 7)} <= touched and any(6 in pair for pair in touched)
        assert single.counters["asleep"].max() > 0 and one.options.sleep
    if one.stepper.forces:
        assert np.abs(single.counters["energy_given"]).max() > 0
        whole = busy_simulator(kind)
        whole.step(35)
        whole.step(25)
        assert_same_state(one, whole)
        assert one["still"].asleep == whole["still"].asleep
        given = whole.initial_rollout().counters["energy_given"][0]
        assert given == pytest.approx(single.counters["energy_given"].sum(), rel=1e-12)


def too_fast(sim: Simulator) -> None:
    """In its eleventh step `alone` is faster than any body may be."""
    u = sim.units
    sim["alone"].pull(np.array([FASTEST * u.velocity / (10.5 * sim.dt), 0.0, 0.0]) * sim["alone"].mass)


def too_far(sim: Simulator) -> None:
    """In its eleventh step `alone` is farther away than any body may be."""
    far, speed = FARTHEST * sim.units.length, 1e3 * sim.units.velocity
    sim["alone"].position = (far - 10.5 * speed * sim.dt, 0.0, 0.0)
    sim["alone"].velocity = (speed, 0.0, 0.0)


@pytest.mark.parametrize("at_once", [3, 10, 20])
@pytest.mark.parametrize(
    ("kind", "spoil", "told"),
    [
        *((kind, too_far, "m from the origin, too far to be placed exactly") for kind in MODELS),
        ("solver", too_fast, "m/s, too fast for any contact"),
    ],
)
def test_a_state_that_cannot_be_amid_a_chunk_ends_it_as_it_ends_single_steps(kind, spoil, told, at_once):
    one, other, silent = (busy_simulator(kind) for _ in range(3))
    for sim in (one, other, silent):
        spoil(sim)
    (single, message), (chunks, same) = followed(one, 20, 1), followed(other, 20, at_once)
    assert message == same and message.startswith("step 11: body 'alone': ") and told in message
    assert f"the last good state is that of step 10, t = {10 * one.dt:.4g} s" in message
    assert len(single) == one.steps_done == 10
    assert_same(single, chunks)
    assert_same_state(one, other)
    with pytest.raises(SimulationError) as caught:
        silent.step(20)
    assert caught.value.message == message
    assert_same_state(one, silent)
    last = caught.value.rollout
    for name in ("time", *NAMES, "contact_point"):
        kept = single.frames(10, 11)
        np.testing.assert_array_equal(getattr(last, name), getattr(kept, name), err_msg=name)
    # From the last good state it goes on once the cause is gone.
    for sim in (one, other):
        sim["alone"].position = (0.0, -9.0, 5.0)
        sim["alone"].velocity = (0.0, 0.0, 0.0)
        if sim.stepper.forces:
            sim["alone"].pull((0.0, 0.0, 0.0))
    assert_same(followed(one, 5, 1)[0], followed(other, 5, 4)[0])
    assert one.steps_done == 15


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


def test_a_state_that_cannot_be_is_not_restored(dropped):
    sim = Simulator(dropped)
    with pytest.raises(SdfsimError, match="body 'floor': velocity is not finite"):
        sim.restore(replace(sim.state, velocity=np.full_like(sim.state.velocity, np.nan)))


def by_handle(sim: Simulator) -> None:
    sim["block"].position = (0, -50, 0.5)


def by_state(sim: Simulator) -> None:
    position = sim.state.position.copy()
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
    sim.options = sim.options._replace(gravity=-sim.options.gravity)
    sim.step(5)
    for name in ("box", "other"):
        assert not sim[name].asleep
        assert sim[name].velocity[2] == pytest.approx(G * 5 * sim.dt, rel=0.1)
