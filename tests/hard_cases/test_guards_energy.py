"""Energy is watched in every step, a run that makes it without end is stopped, and `guard energy` lets it make none."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

import cli
from sdfsim.dynamics import energy
from sdfsim.dynamics.contacts import find_contacts
from sdfsim.dynamics.energy import ESCAPE, balance, hold_back
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.simulator import SimulationError, Simulator
from sdfsim.dynamics.step import drive, fly
from sdfsim.scene.scene import Waypoints
from tests.dynamics.conftest import make_body, random_model
from tests.hard_cases import gates

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


class Met:
    """Bodies that touch, before a step and after it in free flight, in model units."""

    def __init__(self, scene) -> None:
        self.sim = sim = Simulator(scene, random_model("impulse"))
        self.state = drive(sim.bodies, sim.state, sim.rules)
        self.flown = fly(sim.bodies, self.state, sim.rules)
        self.contacts = find_contacts(sim.bodies, self.state, sim.rules.gravity, 0.1, sim.rules.dt)
        assert len(self.contacts)

    def after(self, **changes):
        """The state that contact would lead to: free flight with the given [N, 3] added."""
        return replace(self.flown, **{k: getattr(self.flown, k) + v for k, v in changes.items()})

    def held(self, after, guard="none"):
        sim, memory = self.sim, Memory()
        found = hold_back(
            sim.bodies, self.state, self.flown, after, self.contacts, sim.rules.gravity, sim.rules.dt, guard, memory
        )
        return found, memory.counts

    def kinetic(self, state) -> float:
        rows = self.sim.bodies.moves.nonzero()[:, 0]
        motion = (state.velocity[rows], state.angular_velocity[rows])
        return float(energy.kinetic(self.sim.bodies, rows, state.orientation[rows], motion).sum())


def pair(**fields) -> Met:
    """Two cubes in free space, the first on its way to the second."""
    scene = gates.placed(gates.CUBE, [(0, 0, 0), (1.02, 0.1, 0)])
    first = replace(scene.bodies[0], velocity=np.array([2.0, 0.5, 0.0]), angular_velocity=np.array([0.0, 1.0, 2.0]))
    return Met(replace(scene, bodies=(first, replace(scene.bodies[1], mass=3.0, **fields))))


def impulse(met: Met, size: float) -> dict[str, torch.Tensor]:
    """Changes by an impulse of `size` along -x on the first body, and its reaction on the second, with some turning."""
    push = torch.zeros(2, 3, dtype=torch.float64)
    push[0, 0], push[1, 0] = -size, size
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.3, -1.0]], dtype=torch.float64) * size
    return {"velocity": push * met.sim.bodies.inverse_mass[:, None], "angular_velocity": turn}


def momentum(met: Met, state) -> torch.Tensor:
    return (met.sim.bodies.mass[:, None] * state.velocity).sum(0)


def test_what_contact_adds_is_counted_to_the_joule():
    met = pair()
    after = met.after(**impulse(met, 5.0))
    made = met.kinetic(after) - met.kinetic(met.flown)
    assert made > 1.0
    found = balance(met.sim.bodies, met.state, met.flown, after, met.contacts, met.sim.rules.gravity, met.sim.rules.dt)
    assert float(found.gain.sum()) == pytest.approx(made, rel=1e-12) and len(found.mass) == 1
    assert met.held(met.after(**impulse(met, 0.1)))[1]["energy_gain"] == 0.0  # it takes some away


def test_lifting_takes_energy_and_islands_do_not_pay_for_each_other():
    scene = gates.placed(gates.CUBE, [(0, 0, 0.5), (50, 0, 0.5)], floor=True)
    met = Met(scene)
    way = torch.zeros(3, 3, dtype=torch.float64)
    way[0, 2] = 0.05
    lifted = met.after(position=way, velocity=way * 1e-9)
    gravity = float(met.sim.rules.gravity.norm())
    mass = float(met.sim.bodies.mass[0])
    assert met.held(lifted)[1]["energy_gain"] == pytest.approx(mass * gravity * 0.05, rel=1e-6)
    # What the second one loses does not pay for it.
    speed = torch.zeros(3, 3, dtype=torch.float64)
    speed[1] = -met.flown.velocity[1]
    both = met.after(position=way, velocity=way * 1e-9 + speed)
    assert met.held(both)[1]["energy_gain"] == pytest.approx(mass * gravity * 0.05, rel=1e-6)


@pytest.mark.parametrize("size", [2.0, 50.0])
def test_the_guard_allows_no_gain_and_keeps_momentum(size):
    met = pair()
    wild = met.after(**impulse(met, size))
    after, counts = met.held(wild, "energy")
    assert counts["held_back"] == 2 and counts["energy_gain"] == 0.0
    assert met.kinetic(after) == pytest.approx(met.kinetic(met.flown), rel=1e-9)
    torch.testing.assert_close(momentum(met, after), momentum(met, wild), rtol=0, atol=1e-12)
    # All changes are smaller by one share, so what each impulse gives to one it takes from the other, turning included.
    share = (after.velocity - met.flown.velocity)[0, 0] / (wild.velocity - met.flown.velocity)[0, 0]
    assert 0 < float(share) < 1
    expected = torch.lerp(met.flown.angular_velocity, wild.angular_velocity, share)
    torch.testing.assert_close(after.angular_velocity, expected, rtol=0, atol=1e-12)
    assert torch.equal(after.position, wild.position)


def test_the_guard_leaves_what_takes_energy_away_alone():
    met = pair()
    for size in (0.0, 0.5, 1.0):
        calm = met.after(**impulse(met, size))
        assert met.kinetic(calm) <= met.kinetic(met.flown)
        assert met.held(calm, "energy")[0] is calm


def test_a_ball_that_would_be_thrown_up_bounces_as_if_elastic():
    scene = gates.placed(gates.BALL, [(0, 0, 0.5)], floor=True, velocity=np.array([0.0, 0.0, -3.0]))
    met = Met(scene)
    down = float(met.flown.velocity[0, 2])
    after, _ = met.held(met.after(velocity=torch.stack([40.0 * UP, 0.0 * UP])), "energy")
    assert float(after.velocity[0, 2]) == pytest.approx(-down, rel=1e-9)


def test_without_a_guard_a_speed_grows_by_so_much_in_a_step_and_no_more():
    scene = gates.placed(gates.BALL, [(0, 0, 0.5)], floor=True, velocity=np.array([0.0, 0.0, -3.0]))
    met = Met(scene)
    down = float(met.flown.velocity[0, 2])
    after, counts = met.held(met.after(velocity=torch.stack([40.0 * UP, 0.0 * UP])))
    assert float(after.velocity[0, 2]) == pytest.approx(-down + ESCAPE, rel=1e-9) and counts["held_back"] == 1
    within = met.after(velocity=torch.stack([(-2 * down + 0.9 * ESCAPE) * UP, 0.0 * UP]))
    assert met.held(within)[0] is within


def test_a_jump_through_the_step_is_held_back_too():
    met = Met(gates.placed(gates.BALL, [(0, 0, 0.5)], floor=True))
    after, counts = met.held(
        met.after(position=torch.stack([30.0 * UP, 0.0 * UP]), velocity=torch.stack([UP * 0.1, UP * 0]))
    )
    rise = float((after.position - met.state.position)[0, 2]) / met.sim.rules.dt
    assert counts["held_back"] == 1 and rise == pytest.approx(energy.LEAVE, rel=0.05)


def test_a_body_on_a_path_may_do_work():
    """A wall at speed V throws what it meets away at twice that, and no faster."""
    path = Waypoints(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [5.0, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    wall = make_body("wall", 0, [0, 0, 0], motion="kinematic", mass=0.0, path=path)
    scene = gates.placed(gates.CUBE, [(1.01, 0, 0)])
    met = Met(replace(scene, bodies=(*scene.bodies, wall)))
    speed = float(met.state.velocity[1, 0])
    assert speed > 1.0
    away = torch.zeros(2, 3, dtype=torch.float64)
    away[0, 0] = 2.0 * speed
    assert met.held(met.after(velocity=away), "energy")[1]["energy_gain"] == 0.0
    after, counts = met.held(met.after(velocity=1.5 * away), "energy")
    assert counts["held_back"] == 1 and float(after.velocity[0, 0]) == pytest.approx(2.0 * speed, rel=1e-9)


def runaway():
    """An untrained network whose contacts make energy without end."""
    return random_model("impulse", push=4.0)


def test_what_would_run_away_is_stopped_and_told(monkeypatch):
    scene = gates.heap()
    held = Simulator(scene, runaway()).run(steps=12)
    gates.assert_sound(held)
    assert held.counters["held_back"].sum() > 0
    speed = np.linalg.norm(held.velocity, axis=-1).max()
    guarded = Simulator(scene, runaway(), guard="energy").run(steps=12)
    assert guarded.counters["energy_gain"].sum() < 0.5 * held.counters["energy_gain"].sum()
    assert guarded.meta["guard"] == "energy"
    monkeypatch.setattr(energy, "ESCAPE", math.inf)
    monkeypatch.setattr(energy, "LEAVE", math.inf)
    try:
        free = np.linalg.norm(Simulator(scene, runaway()).run(steps=12).velocity, axis=-1).max()
    except SimulationError:
        free = math.inf
    assert free > 20 * speed


def test_simulate_tells_it_and_takes_the_guard(tmp_path):
    scene = tmp_path / "scene.yaml"
    # Two cubes, one half in the other.
    scene.write_text(
        "version: 1\nduration: 0.3\ngravity: [0, 0, 0]\nshapes: {cube: {box: {size: [1, 1, 1]}}}\nbodies:\n"
        "  - {name: a, shape: cube, position: [0, 0, 0]}\n  - {name: b, shape: cube, position: [0.5, 0, 0]}\n"
    )

    def run(out, *options):
        done = CliRunner().invoke(cli.app, ["simulate", str(scene), "-o", str(out), "--viewer", "none", *options])
        assert done.exit_code == 0, done.stderr
        return done.stdout, json.loads((out / "report.json").read_text())["energy_from_nothing"]

    told, made = run(tmp_path / "free")
    assert made["sum_J"] > 0 and f"energy from nothing: {made['sum_J']:.3g} J" in told
    told, guarded = run(tmp_path / "guarded", "--guard", "energy")
    assert guarded["sum_J"] < 1e-3 * made["sum_J"] and guarded["steps_held_back"] > 0
    assert f"held back: velocities in {guarded['steps_held_back']} steps" in told
    assert yaml.safe_load((tmp_path / "guarded" / "config.yaml").read_text())["guard"] == "energy"
