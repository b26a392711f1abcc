"""Contacts of bodies that come from afar: what touches, where and along which normal, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.dynamics.contacts import ARRAYS, find_contacts
from sdfsim.dynamics.impact import at_impact
from sdfsim.dynamics.simulator import Simulator
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import make_body, random_model

RADIUS, REACH = 0.5, 0.1
NOTHING = torch.zeros(3, dtype=torch.float64)


def ball(count: int):
    """A sphere with evenly spread nodes."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    nodes = RADIUS * np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    return replace(analytic_shape("sphere", radius=RADIUS), nodes=nodes)


def spheres(offset: float, speed: float, gap: float):
    """Two spheres `gap` apart along x, `offset` apart along y, the second coming at `speed` along -x."""
    across = np.sqrt((2 * RADIUS) ** 2 - offset**2)
    bodies = (
        make_body("one", 0, [0.0, 0.0, 0.0]),
        make_body("two", 0, [across + gap, offset, 0.0], velocity=np.array([-speed, 0.0, 0.0])),
    )
    shapes = (ball(2000),)
    scene = Scene(shapes, bodies, gravity=np.zeros(3), duration=1.0)
    return Simulator(scene, random_model("impulse"))


def edges(simulator: Simulator):
    dt = simulator.rules.dt
    found = find_contacts(simulator.bodies, simulator.state, NOTHING, REACH, dt)
    return found, at_impact(simulator.bodies, simulator.state, NOTHING, dt, found)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.6])
def test_the_normal_is_the_line_of_centres_at_the_impact(offset):
    simulator = spheres(offset, speed=8.0, gap=0.08)
    before, after = edges(simulator)
    across = np.sqrt((2 * RADIUS) ** 2 - offset**2)
    line = np.array([across, offset, 0.0]) / (2 * RADIUS)  # from one to two when they touch

    def miss(contacts):
        mine = contacts.owner == 1
        deepest = contacts.ahead[mine].argmin()
        return float(np.linalg.norm(contacts.normal[mine][deepest].numpy() - line)), contacts, mine, deepest

    wrong = miss(before)[0]
    right, contacts, mine, deepest = miss(after)
    assert right < 0.04  # nodes are some 0.04 m apart
    assert right < 0.5 * wrong or wrong < 0.04
    # There the point of contact is on both surfaces, and the gap at the start is what the impact's time leaves to go.
    foot = contacts.foot[mine][deepest].numpy()
    np.testing.assert_allclose(np.linalg.norm(foot), RADIUS, atol=2e-3)
    np.testing.assert_allclose(float(contacts.distance[mine][deepest]), 0.08 * line[0], atol=4e-3)


def test_slow_bodies_are_seen_as_they_are():
    before, after = edges(spheres(0.3, speed=0.05, gap=0.01))
    assert len(before) > 0
    assert all(torch.equal(getattr(before, name), getattr(after, name)) for name in ARRAYS)


def test_bodies_that_part_are_seen_as_they_are():
    simulator = spheres(0.3, speed=8.0, gap=0.01)
    simulator.state = replace(simulator.state, velocity=-simulator.state.velocity)
    before, after = edges(simulator)
    assert len(before) > 0
    assert all(torch.equal(getattr(before, name), getattr(after, name)) for name in ARRAYS)


def test_a_plane_is_met_along_its_normal_wherever_one_comes_from():
    """Against a plane the start is as good as the impact: distances are linear."""
    bodies = (
        make_body("floor", 1, [0.0, 0.0, 0.0], motion="static"),
        make_body("ball", 0, [0.0, 0.0, RADIUS + 0.06], velocity=np.array([5.0, 0.0, -6.0])),
    )
    shapes = (ball(500), analytic_shape("plane"))
    simulator = Simulator(Scene(shapes, bodies, gravity=np.zeros(3), duration=1.0), random_model("impulse"))
    before, after = edges(simulator)
    assert len(before) > 0
    torch.testing.assert_close(after.distance, before.distance, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.normal, before.normal, rtol=0, atol=1e-12)
