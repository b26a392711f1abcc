"""The network on bodies in a simulation: what moves them, and what it must never do."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory
from sdfsim.learned.model import bundled_models, load_model, new_network
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver import prepare
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.helpers.scenes import make_body, random_model

MODEL = random_model("impulse", width=24, rounds=3)


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
    group, model = recordings((2, 1, 3, 2)), MODEL
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


@pytest.mark.parametrize("name", bundled_models())
def test_weights_decide_in_scenes_beyond_the_training_too(name):
    """Nothing stands in for a network: with other weights bodies move otherwise, whatever the scene is."""
    known = load_model(name)
    model = replace(known, ranges={quantity: [1e3, 2e3] for quantity in known.ranges})
    other = replace(model, network=deepcopy(model.network))
    for weight in other.network.parameters():
        weight.mul_(0.9)
    one, two = (Simulator(pile(1), m) for m in (model, other))
    assert len(one.outside_training) > 3
    ends = [sim.run(steps=30).position[-1, :-1] for sim in (one, two)]
    assert np.abs(ends[0] - ends[1]).max() > 1e-3


@pytest.mark.parametrize("name", bundled_models())
def test_a_network_does_not_know_how_the_solve_steps(name):
    """The solve's options change nothing."""
    model = load_model(name)
    one, two = Simulator(pile(3), model), Simulator(pile(3), model)
    two.options = two.options._replace(substeps=1)
    np.testing.assert_array_equal(one.run(steps=20).position, two.run(steps=20).position)


CARRIED = (
    "version: 1\nshapes: {{box: {{box: {{size: [1, 1, 1]}}}}}}\nbodies:\n"
    "  - {{name: one, shape: box, position: [0, 0, 1]}}\n  - {{name: two, shape: box{path}}}\n{joints}"
)
PATH = ", motion: kinematic, path: [{time: 0, position: [0, 0, 0]}, {time: 1, position: [1, 0, 0]}]"
JOINTS = "joints: [{name: pin, type: hinge, bodies: [one, two], anchor: [0, 0, 0.5], axis: [1, 0, 0]}]\n"


@pytest.mark.parametrize("name", bundled_models())
@pytest.mark.parametrize(("path", "joints", "what"), [(PATH, "", "bodies on a path"), ("", JOINTS, "joints")])
def test_what_a_network_has_no_inputs_for_is_refused(name, path, joints, what, tmp_path):
    (tmp_path / "scene.yaml").write_text(CARRIED.format(path=path, joints=joints))
    with pytest.raises(SdfsimError, match=f"no inputs for {what}") as caught:
        Simulator(tmp_path / "scene.yaml", name)
    assert caught.value.hint and "solver" in caught.value.hint


@pytest.mark.parametrize("name", bundled_models())
def test_forces_are_refused_and_no_impulses_are_reported(name):
    sim = Simulator(pile(1), name)
    with pytest.raises(SdfsimError, match="no inputs for forces"):
        sim["body0"].pull((0.0, 0.0, 1e-9))
    with pytest.raises(SdfsimError, match="no impulses"):
        sim.contact_points()


def test_whatever_it_adds_keeps_momentum(free_pair):
    sim = Simulator(free_pair, random_model("impulse", push=5.0, width=16, rounds=2))
    mass, start = sim.bodies.mass[:, None], sim.state.velocity.copy()
    sim.run(steps=20)
    assert np.abs(sim.state.velocity - start).max() > 1e-2
    np.testing.assert_allclose((mass * sim.state.velocity).sum(0), (mass * start).sum(0), rtol=0, atol=1e-13)


@pytest.mark.parametrize("push", [0.5, 5.0, 500.0])
def test_contacts_give_no_energy_whatever_the_weights(push):
    """Kinetic and potential energy of balls and cubes on the floor (whose inertia does not change with a turn), in SI
    units; a step may add that of a slow speed to a body."""
    scene, cube = pile(4), analytic_shape("box", size=(0.8, 0.8, 0.8))
    scene = replace(scene, shapes=(cube, *scene.shapes[1:]))
    sim = Simulator(scene, random_model("impulse", push=push, width=16, rounds=2))
    rollout = sim.run(steps=60)
    spare = 0.5 * (0.25 * 0.2 * sim.units.velocity) ** 2 * sum(b.mass for b in sim.scene.bodies)
    assert rollout.contact_count.sum() > 0
    gained = np.diff(rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"])
    assert gained.max() < 1.01 * spare


def test_the_same_steps_give_the_same_bits():
    one, other = (Simulator(pile(2), MODEL).run(steps=20) for _ in range(2))
    for name in MOTION:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("sizes", [{"width": 0}, {"rounds": 0}])
def test_a_network_of_nothing_is_refused(sizes):
    with pytest.raises(ValueError, match="at least 1"):
        new_network("impulse", sizes)
