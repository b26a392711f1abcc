"""Row 11: bodies that start inside each other part, from coincident centres too, and nothing explodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sdfsim.dynamics.overlap import parting

from sdfsim.dynamics.contacts import find_contacts
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.simulator import Simulator
from sdfsim.shape import primitives
from sdfsim.shape.shape import analytic_shape, with_sdf
from tests.dynamics.conftest import make_body, random_model
from tests.hard_cases import gates

SHAPES = {"ball": gates.BALL, "cube": gates.CUBE}
EXIT = 3.0  # m/s, for bodies of about a metre


@pytest.mark.parametrize("offset", [0.0, 0.5], ids=["coincident", "50 %"])
@pytest.mark.parametrize("shape", SHAPES)
def test_two_bodies_part(every_model, device, shape, offset):
    scene = gates.placed(SHAPES[shape], [(0, 0, 0), (0.8 * offset, 0.6 * offset, 0)])
    rollout = Simulator(scene, every_model, device).run(seconds=1.3)
    gates.assert_sound(rollout)
    away = np.linalg.norm(rollout.position[:, 1] - rollout.position[:, 0], axis=-1)
    assert away[-1] > offset + 0.1  # how far is a quality of the model: cubes half in each other end at 0.64 m
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < EXIT
    # Equal and opposite: their common centre stays.
    assert np.abs(rollout.position.mean(1) - rollout.position[0].mean(0)).max() < 1e-3


@pytest.mark.parametrize("shape", SHAPES)
def test_a_body_half_in_the_floor_comes_up(model, shape):
    rollout = Simulator(gates.placed(SHAPES[shape], [(0, 0, 0.0)], floor=True), model).run(seconds=1.3)
    gates.assert_sound(rollout)
    assert rollout.position[-1, 0, 2] > 0.2 and np.linalg.norm(rollout.velocity, axis=-1).max() < EXIT


def test_a_heap_of_overlapping_cubes_comes_apart_and_stays_together(model):
    """Without the limit on what contact may add in a step this ends, in the fourth step, with 6,000 rad/s."""
    rollout = Simulator(gates.heap(), model).run(steps=60)
    gates.assert_sound(rollout)
    assert np.linalg.norm(rollout.velocity, axis=-1).max() < 15.0 and np.abs(rollout.position).max() < 20.0
    assert rollout.position[-1, :27, 2].min() > 0.2  # the floor holds them


def edges(scene):
    sim = Simulator(scene, random_model("impulse"))
    found = find_contacts(sim.bodies, sim.state, sim.rules.gravity, sim.model.reach, sim.rules.dt)
    return found, parting(sim.bodies, sim.state, found, Memory())


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_both_sides_of_a_swallowed_pair_are_pushed_opposite_ways(offset):
    found, parted = edges(gates.placed(gates.BALL, [(0, 0, 0), (offset, 0, 0)]))
    way = torch.tensor([1.0, 0, 0] if offset else [0, 0, 1.0], dtype=torch.float64)
    sign = torch.where(parted.owner == 0, -1.0, 1.0)[:, None] * (1 if offset else -1)
    torch.testing.assert_close(parted.normal, sign * way.expand(len(parted), 3))
    assert torch.equal(parted.distance, found.distance) and len(found) > 4


def test_bodies_that_only_touch_or_hold_each_other_keep_their_normals():
    """A ring on a peg: its centre of mass is inside the peg, which is where it belongs."""
    torus = primitives.torus(0.5, 0.15)
    from sdfsim.shape.mass import mass_properties

    volume, com, inertia = mass_properties(torus)
    ring = replace(
        with_sdf(replace(gates.CUBE, mesh=torus), "mesh"), volume=volume, com=com, inertia=inertia, nodes=torus.vertices
    )
    peg = analytic_shape("box", size=(0.45, 0.45, 2.0))
    bodies = (make_body("peg", 1, [0, 0, 0]), make_body("ring", 0, [0.05, 0, 0.3]))
    cases = [
        gates.Scene((ring, peg), bodies, np.zeros(3), 1.0),
        gates.placed(gates.CUBE, [(0, 0, 0), (0.95, 0.2, 0)]),
        gates.placed(gates.CUBE, [(0, 0, 0), (0.55, 0, 0)]),
    ]
    for scene in cases:
        found, parted = edges(scene)
        assert len(found) > 4 and torch.equal(found.normal, parted.normal)
