"""Distances that wait: fewer are asked, and every edge is the same to the last bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim import load_scene
from sdfsim.dynamics.bodies import Units, from_scene
from sdfsim.dynamics.contacts import ARRAYS, find_contacts
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.simulator import Simulator
from sdfsim.scene.scene import Limits, Scene
from sdfsim.shape.shape import load_shape, with_sdf
from tests.dynamics.conftest import make_body, random_model
from tests.dynamics.test_contacts import heap

SHAPES = Path(__file__).resolve().parents[2] / "samples" / "shapes"


@pytest.mark.parametrize("seed", range(3))
def test_a_run_that_lets_distances_wait_is_the_same_run(seed):
    model = random_model("impulse", push=0.05)
    patient, eager = (Simulator(heap(seed), model) for _ in range(2))
    waited = asked = 0
    for _ in range(25):
        eager.memory = Memory()  # forgets everything
        patient.run(steps=1)
        eager.run(steps=1)
        for name in ARRAYS:
            assert torch.equal(getattr(patient.contacts, name), getattr(eager.contacts, name)), name
        assert torch.equal(patient.state.position, eager.state.position)
        assert torch.equal(patient.state.orientation, eager.state.orientation)
        mine, theirs = patient.memory.counts, eager.memory.counts
        assert mine["sdf_queries"] + mine["sdf_waiting"] == theirs["sdf_queries"] and theirs["sdf_waiting"] == 0
        waited, asked = waited + mine["sdf_waiting"], asked + theirs["sdf_queries"]
    assert 0 < waited < asked


@pytest.mark.parametrize("kind", [None, "grid"])
@pytest.mark.parametrize("name", ["ring", "bowl"])
def test_fitted_and_sampled_shapes_keep_their_edges(name, kind):
    """A ball wanders through and around a shape, with small steps, turns and leaps."""
    shape = load_shape(SHAPES / name)
    shape = with_sdf(shape, kind, resolution=32) if kind else shape
    size = float(np.ptp(shape.sdf.bounds, axis=0).max())
    bodies = (make_body("it", 0, [0, 0, 0], scale=1 / size), make_body("other", 0, [0, 0, 0], scale=0.5 / size))
    bodies, state = from_scene(Scene((shape,), bodies, np.zeros(3), 1.0), Units(1.0, 1.0, 1.0), torch.device("cpu"))
    rng, memory = np.random.default_rng(0), Memory()
    gravity, waited, met = torch.zeros(3, dtype=torch.float64), 0, 0
    for k in range(150):
        leap = 0.3 if k % 40 == 0 else 0.01
        way = torch.from_numpy(rng.normal(size=3) * leap)
        place = (state.position[1] + way).clamp(-0.7, 0.7)
        turn = state.orientation[1] + torch.from_numpy(rng.normal(size=4) * 0.02)
        state = replace(
            state,
            position=torch.stack([state.position[0], place]),
            orientation=torch.stack([state.orientation[0], turn / turn.norm()]),
        )
        patient = find_contacts(bodies, state, gravity, 0.05, 0.02, memory)
        eager = find_contacts(bodies, state, gravity, 0.05, 0.02)
        for each in ("owner", "node", "body"):
            assert torch.equal(getattr(patient, each), getattr(eager, each))
        torch.testing.assert_close(patient.distance, eager.distance, rtol=0, atol=1e-5)
        waited, met = waited + patient.waiting, met + len(eager)
    assert waited > 1000 and met > 1000


def test_little_memory_gives_the_same_result_in_pieces():
    scene, model = heap(0), random_model("impulse", push=0.05)
    whole = Simulator(scene, model)
    tight = Simulator(replace(scene, limits=Limits(1e-4)), model)
    assert tight.rules.rows == 26
    asked = []
    bank = tight.bodies.bank

    class Counting:
        trust = bank.trust

        def __call__(self, index, points):
            asked.append(len(points))
            return bank(index, points)

    tight.bodies = replace(tight.bodies, bank=Counting())
    one, other = whole.run(steps=8), tight.run(steps=8)
    assert (one.contact_count == other.contact_count).all() and one.contact_count.sum() > 100
    np.testing.assert_allclose(other.position, one.position, atol=1e-6)
    nodes = (tight.bodies.node_start[1:] - tight.bodies.node_start[:-1]).max()
    assert len(asked) > 30 and max(asked) <= int(nodes)


def test_pieces_of_a_search_are_the_whole_search_bit_for_bit():
    bodies, state = from_scene(heap(1), Units(1.0, 1.0, 1.0), torch.device("cpu"))
    gravity = torch.tensor([0.0, 0.0, -10.0], dtype=torch.float64)
    whole = find_contacts(bodies, state, gravity, 0.1, 0.02)
    for rows in (1, 100, 1000):
        pieces = find_contacts(bodies, state, gravity, 0.1, 0.02, rows=rows)
        assert all(torch.equal(getattr(whole, k), getattr(pieces, k)) for k in ARRAYS)
        assert pieces.queries == whole.queries


@pytest.mark.parametrize("sample", ["pile", "spheres_in_bowl", "tower"])
def test_the_samples_have_the_same_contacts_whether_distances_wait_or_not(sample):
    simulator = Simulator(load_scene(SHAPES.parent / f"{sample}.yaml"))
    waited = met = 0
    for number in range(90):  # the balls land after 60 steps
        before = simulator.state
        simulator.run(steps=1)
        waited += simulator.memory.counts["sdf_waiting"]
        if number % 6:
            continue
        rules, reach = simulator.rules, simulator.model.reach
        eager = find_contacts(simulator.bodies, before, rules.gravity, reach, rules.dt, thin=True)
        assert simulator.contacts is not None
        for name in ("owner", "node", "body"):
            assert torch.equal(getattr(simulator.contacts, name), getattr(eager, name)), (number, name)
        # A fitted network's answers depend in their last digits on how many are asked together.
        torch.testing.assert_close(simulator.contacts.distance, eager.distance, rtol=0, atol=1e-5)
        met += len(eager)
    assert met > 0 and (waited > 0 or sample == "tower")  # the tower stands from the start: nobody comes near
