"""The network on the solve in a simulation: what it is asked, and what it must never do."""

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory
from sdfsim.learned import inference
from sdfsim.learned.model import Model, load_model, new_network
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver import prepare
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body, random_model


def pile(seed: int, bodies: int = 5, **effects: str) -> Scene:
    """Boxes and balls of all masses and coefficients that fall onto each other; nothing is symmetric."""
    draw = np.random.default_rng(seed)
    box, ball = analytic_shape("box", size=(1.0, 0.8, 0.6)), analytic_shape("sphere", radius=0.4)
    moving = []
    for k in range(bodies):
        quat = draw.normal(size=4)
        moving.append(
            make_body(
                f"body{k}", int(k % 3 == 2), [*draw.uniform(-0.6, 0.6, 2), 0.6 + 0.7 * k],
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3) - np.array([0, 0, 2.0]),
                angular_velocity=2.0 * draw.normal(size=3), mass=10.0 ** draw.uniform(-1, 1),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    floor = make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0)
    shapes, played = (box, ball, analytic_shape("plane")), replace(Effects(), **effects)
    return Scene(shapes, (*moving, floor), np.array([0.7, 0.3, -9.0]), 1.0, effects=played)


def model_of(name: str, seed: int = 0) -> Model:
    if name == "small":
        return replace(load_model("small"), ranges={})  # whatever the scene is, it is not beyond them
    return random_model("impulse", seed, width=24, rounds=3, alone=int(name == "alone"))


def recordings(counts: tuple[int, ...]) -> list[Trajectory]:
    """One frame each of so many boxes."""
    draw = np.random.default_rng(4)

    def recording(count: int) -> Trajectory:
        quat, spread = draw.normal(size=(1, count, 4)), np.linspace(0.0, 1.0, count)[:, None] * [0.3, 0.2, 1.2]
        return Trajectory(
            position=spread[None] + [0.0, 0.0, 0.6], orientation=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
            velocity=draw.normal(size=(1, count, 3)), angular_velocity=draw.normal(size=(1, count, 3)),
            shape=np.array(["box"] * count), scale=np.ones(count), mass=draw.uniform(1, 5, count),
            inertia=draw.uniform(0.2, 0.3, (count, 3)), friction=draw.uniform(size=count),
            restitution=draw.uniform(size=count), static=np.zeros(count, bool), dt=0.02,
            gravity=np.array([0.0, 0.0, -10.0]),
        )  # fmt: skip

    return [recording(count) for count in counts]


def test_recordings_in_a_batch_move_as_each_alone(box_shape):
    group, model = recordings((2, 1, 3, 2)), model_of("random")
    together = roll_out(model, group, {"box": box_shape}, 8)
    for one, same in zip(group, together, strict=True):
        (alone,) = roll_out(model, [one], {"box": box_shape}, 8)
        np.testing.assert_allclose(alone.velocity, same.velocity, atol=1e-4)


def test_a_shape_off_its_centre_of_mass_is_made_ready_once_for_all_recordings(box_shape, monkeypatch):
    made, known = [], prepare.compiled_shapes
    monkeypatch.setattr(prepare, "compiled_shapes", lambda shapes, **how: made.append(shapes) or known(shapes, **how))
    box = replace(box_shape, com=np.array([0.01, 0.0, 0.0]))
    assert len(roll_out(load_model("solver"), recordings((2, 1, 3, 2)), {"box": box}, 2)) == 4
    assert len(made) == 1 and made[0][0] is box.contact


@pytest.mark.parametrize("impacts", [0, 1])
def test_without_trust_it_is_not_asked_and_with_little_it_adds_little(impacts, monkeypatch):
    added, real = [], inference.corrected

    def watched(network, bodies, before, solved, *rest):
        after = real(network, bodies, before, solved, *rest)
        added.append(np.abs(after.velocity - solved.velocity).max())
        return after

    monkeypatch.setattr(inference, "corrected", watched)

    def first(trust: float) -> float:
        """What is added in the first step that changes something."""
        added.clear()
        sim = Simulator(pile(1), random_model("impulse", width=24, rounds=3, impacts=impacts))
        sim.stepper = replace(sim.stepper, trust=trust)
        sim.run(steps=12)
        return next((change for change in added if change > 0.0), 0.0)

    whole, little = first(1.0), first(1e-6)
    assert first(0.0) == 0.0 and not added
    assert 0.0 < little < 1e-4 * whole


@pytest.mark.parametrize("effect", ["friction", "restitution", "rotation"])
def test_an_effect_that_is_off_stays_off(effect):
    sim = Simulator(pile(1, **{effect: "off"}), model_of("random"))
    start = sim.si_state()
    rollout = sim.run(steps=12)
    if effect == "rotation":
        np.testing.assert_array_equal(rollout.orientation[-1], start.orientation)
    assert np.isfinite(rollout.velocity).all() and sim.carry.counts["edges"] > 0


@pytest.mark.parametrize("impacts", [0, 1])
def test_whatever_it_adds_keeps_momentum(free_pair, impacts):
    model = random_model("impulse", push=5.0, width=16, rounds=2, impacts=impacts)
    sim, plain = Simulator(free_pair, model), Simulator(free_pair, replace(model, kind="solver"))
    mass = sim.bodies.mass[:, None]
    before = (mass * sim.state.velocity).sum(0)
    for one in (sim, plain):
        one.run(steps=20)
    assert np.abs(sim.state.velocity - plain.state.velocity).max() > 1e-2
    np.testing.assert_allclose((mass * sim.state.velocity).sum(0), before, rtol=0, atol=1e-13)


def test_the_same_steps_give_the_same_bits():
    one, other = (Simulator(pile(2), model_of("random")).run(steps=20) for _ in range(2))
    for name in MOTION:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("sizes", [{"width": 0}, {"rounds": 0}])
def test_a_network_of_nothing_is_refused(sizes):
    with pytest.raises(ValueError, match="at least 1"):
        new_network("impulse", sizes)
