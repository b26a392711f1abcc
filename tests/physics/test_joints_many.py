"""Joints by the dozen, with contacts, and what holds of every run: equilibria, collisions, sleep, and the same bits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from sdfsim import Rollout, Scene, SdfsimError, Simulator
from sdfsim.evaluation.instruments import judged
from sdfsim.physics.motion import MOTION
from sdfsim.simulate.simulator import SimulationError

G = 9.81


def scene(**settings) -> Scene:
    return Scene(model="solver", **({"effects": {"sleep": "off"}} | settings))


def energy_of(rollout: Rollout) -> np.ndarray:
    return rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]


def hanging(count: int, length: float, span: float) -> tuple[np.ndarray, float]:
    """The slopes [count] rad of equal rigid links between two points at one height, and the pull across in weights of a
    link: where moments about a link's middle are in balance, its slope is half of the pulls up at both ends over that
    across."""
    up = np.arange(count) - 0.5 * (count - 1)

    def slopes(pull: float) -> np.ndarray:
        return np.arctan(up / pull)

    pull = float(np.array(brentq(lambda h: length * np.cos(slopes(h)).sum() - span, 1e-3, 1e6)))
    return slopes(pull), pull


def linked(built: Scene, slopes: np.ndarray, size: tuple[float, float, float], mass: float, kind: str, **keys) -> None:
    """Links along x, joined at their ends and to the world, with `slopes` [K] rad."""
    length, count = size[0], len(slopes)
    way = length * np.stack([np.cos(slopes), np.zeros(count), np.sin(slopes)], 1)
    ends = np.concatenate([np.zeros((1, 3)), np.cumsum(way, 0)])
    for k, slope in enumerate(slopes):
        place, turn = 0.5 * (ends[k] + ends[k + 1]), (0, -math.degrees(slope), 0)
        form = {"shape": "link0"} if k else {"box": {"size": size}}  # a shape of its own each would take longer
        built.add(f"link{k}", **form, position=place, euler_xyz_deg=turn, mass=mass, friction=0.8)
    for k in range(count + 1):
        one, other = (f"link{k}", f"link{k - 1}") if k < count else (f"link{k - 1}", "world")
        built.join(f"joint{k}", kind, one, "world" if k == 0 else other, anchor=ends[k], **keys)


def test_a_chain_of_a_hundred_links_hangs_as_its_own_equilibrium():
    slopes, pull = hanging(100, 0.05, 3.5)
    built = scene()
    linked(built, slopes, (0.05, 0.01, 0.01), 0.02, "ball", damping=1e-4)
    simulator = Simulator(built)
    start = simulator.state.position * simulator.units.length
    rollout = simulator.run(2.0)
    sag = -start[:, 2].min()
    assert abs(rollout.position - start).max() <= 1e-3 * sag
    ends = np.array([0.02 * G * pull, 0.0, 0.02 * G * 50.0])
    assert simulator.joint("joint0").force == pytest.approx(ends * [-1, 1, 1], abs=2e-3 * float(np.linalg.norm(ends)))


def test_a_chain_that_is_let_go_aside_falls_into_its_equilibrium():
    slopes, _ = hanging(30, 0.1, 2.2)
    built = scene()
    bent = np.where(np.arange(30) < 15, -1.0, 1.0) * math.acos(2.2 / 3.0)
    linked(built, bent, (0.1, 0.02, 0.02), 0.1, "ball", damping=0.08)
    rollout = Simulator(built).run(20.0)
    way = 0.1 * np.stack([np.cos(slopes), np.zeros(30), np.sin(slopes)], 1)
    middle = np.cumsum(way, 0) - 0.5 * way
    assert rollout.position[-1] == pytest.approx(middle, abs=1e-3 * 3.0)


def test_a_bridge_of_forty_planks_carries_a_tonne():
    slopes, _ = hanging(40, 0.25, 9.6)
    built = scene()
    linked(built, slopes, (0.25, 1.2, 0.05), 12.5, "hinge", axis=(0, 1, 0), damping=40.0)
    lowest = 0.25 * np.sin(slopes[:20]).sum()
    built.add("tonne", box={"size": (1.0, 1.0, 0.6)}, position=(4.8, 0, lowest + 0.36), mass=1000.0, friction=0.8)
    simulator = Simulator(built)
    rollout = simulator.run(6.0)
    later = rollout.time > 3.0  # a mean, as it still swings a little
    carried = rollout.joint_force[later, 0, 2].mean() + rollout.joint_force[later, 40, 2].mean()
    assert carried == pytest.approx((40 * 12.5 + 1000) * G, rel=1e-2)
    assert rollout.position[-1, -1, 2] == pytest.approx(rollout.position[-50, -1, 2], abs=2e-3)
    assert not judged(simulator.scene, rollout, every=10).broken


def test_a_cradle_throws_off_as_many_balls_as_come_in():
    built = scene(effects={"sleep": "off"})
    swing = math.radians(30.0)
    for k in range(5):
        top = np.array([k * 0.100001, 0.0, 0.0])
        angle = -swing if k == 0 else 0.0
        place = top + 0.5 * np.array([math.sin(angle), 0.0, -math.cos(angle)])
        built.add(f"ball{k}", sphere={"radius": 0.05}, position=place, mass=0.5, friction=0.0, restitution=1.0)
        built.join(f"rod{k}", "distance", f"ball{k}", anchor=place, to=top, rod=0.5)
    rollout = Simulator(built).run(1.1)
    height = rollout.position[:, :, 2] + 0.5
    full = 0.5 * (1.0 - math.cos(swing))
    assert height[:, 4].max() == pytest.approx(full, rel=0.03)
    assert height[:, 1:4].max() <= 0.02 * full
    energy = energy_of(rollout)
    assert energy == pytest.approx(energy[0], abs=0.02 * 0.5 * G * full)


def test_gears_turn_as_their_teeth_count():
    built, built_tooth = scene(gravity=(0, 0, 0)), False
    for name, teeth, pitch, x, first in (("small", 8, 0.2, 0.0, 0.0), ("large", 12, 0.3, 0.5, math.pi)):
        hub = {"cylinder": {"radius": pitch - 0.08, "height": 0.1}}
        built.add(name, **hub, position=(x, 0, 0), mass=1.0)
        for k in range(teeth):
            angle = first + 2.0 * math.pi * (k + (0.5 if name == "large" else 0.0)) / teeth
            place = np.array([x, 0, 0]) + (pitch - 0.005) * np.array([math.cos(angle), math.sin(angle), 0.0])
            tooth = {"shape": "small 0"} if built_tooth else {"box": {"size": (0.09, 0.05, 0.1)}}
            tooth, built_tooth = tooth | {"euler_xyz_deg": (0, 0, math.degrees(angle))}, True
            built.add(f"{name} {k}", **tooth, position=place, mass=0.1, friction=0.1, restitution=0.0)
            built.join(f"{name} tooth {k}", "fixed", f"{name} {k}", name)
    motor = {"speed": 2.0, "max_force": 50.0}
    built.join("drive", "hinge", "small", anchor=(0, 0, 0), axis=(0, 0, 1), motor=motor)
    built.join("driven", "hinge", "large", anchor=(0.5, 0, 0), axis=(0, 0, 1), friction=0.2)
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(4.0))
    turned = simulator.joint("drive").angle
    assert turned == pytest.approx(8.0, rel=0.05)
    assert simulator.joint("driven").angle == pytest.approx(-turned * 8 / 12, abs=0.2)


@pytest.mark.parametrize("rate", [9.0, 11.0])
def test_the_balls_of_watts_governor_rise_as_its_speed_says(rate: float):
    """Arms and rods of one length from the spindle to two balls and on to a sleeve: w^2 h = g (m + M) / m."""
    length, ball, sleeve = 0.4, 1.0, 1.5
    lean = math.acos(G * (ball + sleeve) / (ball * rate**2 * length)) + 0.05
    built = scene()
    built.add("spindle", cylinder={"radius": 0.02, "height": 1.2}, position=(0, 0, -0.5), mass=2.0)
    low = (0.0, 0.0, -2.0 * length * math.cos(lean))
    built.add(
        "sleeve", cylinder={"radius": 0.05, "height": 0.1}, position=low, mass=sleeve, angular_velocity=(0, 0, rate)
    )
    built.join("shaft", "hinge", "spindle", anchor=(0, 0, 0), axis=(0, 0, 1), motor={"speed": rate, "max_force": 500.0})
    built.join("guide", "slider", "sleeve", "spindle", anchor=low, axis=(0, 0, 1), damping=20.0)
    for k, side in enumerate((1.0, -1.0)):
        place = np.array([side * length * math.sin(lean), 0.0, -length * math.cos(lean)])
        velocity, spin = (0.0, rate * place[0], 0.0), (0, 0, rate)
        built.add(
            f"ball{k}", sphere={"radius": 0.05}, position=place, mass=ball, velocity=velocity, angular_velocity=spin
        )
        built.join(f"arm{k}", "hinge", f"ball{k}", "spindle", anchor=(0, 0, 0), axis=(0, 1, 0))
        built.join(f"rod{k}", "distance", f"ball{k}", "sleeve", anchor=place, to=low, rod=length)
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(4.0))
    height = G * (ball + sleeve) / (ball * rate**2)
    assert simulator["ball0"].centre[2] == pytest.approx(-height, rel=2e-3)


@pytest.mark.parametrize("ratio", [100.0, 0.01])
def test_masses_of_one_to_a_hundred_hang_on_each_other(ratio: float):
    built = scene()
    for k in range(6):
        mass = 1.0 if k < 5 else ratio
        built.add(f"link{k}", box={"size": (0.1, 0.1, 0.3)}, position=(0, 0, -0.15 - 0.3 * k), mass=mass)
        built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=(0, 0, -0.3 * k))
    simulator = Simulator(built)
    simulator["link5"].push((0.5 * ratio, 0, 0))
    rollout = simulator.run(3.0)
    assert not [law for law in judged(simulator.scene, rollout).broken if "joint" in law]
    energy = energy_of(rollout) - rollout.counters["energy_given"].cumsum()
    assert energy == pytest.approx(energy[0], abs=1e-3 * (5 + ratio) * G * 0.1)


@pytest.mark.parametrize("ratio", [100.0, 1000.0])
def test_a_load_swings_on_a_taut_rope_of_light_links(ratio: float):
    """As one pendulum, which has turned by as much on the way back when a period is over."""
    built = scene()
    way = np.array([math.sin(0.5), 0.0, -math.cos(0.5)])
    for k in range(20):
        turn = (0, -math.degrees(0.5), 0)
        built.add(f"link{k}", capsule={"radius": 0.01, "height": 0.1}, position=(0.1 * k + 0.05) * way,
                  euler_xyz_deg=turn, mass=0.1)  # fmt: skip
        built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=0.1 * k * way)
    built.add("load", sphere={"radius": 0.1}, position=2.1 * way, mass=0.1 * ratio)
    built.join("hook", "ball", "load", "link19", anchor=2.0 * way)
    simulator = Simulator(built)
    rollout = simulator.run(6.0)
    assert not judged(simulator.scene, rollout, every=50).broken
    energy = energy_of(rollout)
    assert energy == pytest.approx(energy[0], abs=1e-4 * 0.1 * ratio * G * 2.1 * (1.0 - math.cos(0.5)))


def test_a_light_rope_that_goes_taut_under_a_heavy_load_holds_with_some_damping():
    """The load falls beside the rope's end and jerks it straight."""
    built = scene()
    for k in range(20):
        built.add(f"link{k}", capsule={"radius": 0.01, "height": 0.1}, position=(0.1 * k + 0.05, 0, 0),
                  euler_xyz_deg=(0, 90, 0), mass=0.1)  # fmt: skip
        other = f"link{k - 1}" if k else "world"
        built.join(f"joint{k}", "ball", f"link{k}", other, anchor=(0.1 * k, 0, 0), damping=0.02)
    built.add("load", sphere={"radius": 0.1}, position=(1.0, 0, -0.3), mass=10.0)
    built.join("hook", "distance", "link10", "load", anchor=(1.0, 0, 0), to=(1.0, 0, -0.3), rope=0.3)
    rollout = Simulator(built).run(1.5)
    energy = energy_of(rollout)
    assert energy.max() <= energy[0] + 1e-3 * 10.0 * G * 0.3
    assert "damping" in str(SimulationError("step 2: too fast", rollout).hint)
    loose = Scene(model="solver").add("ball", sphere={"radius": 0.1})
    assert "damping" not in str(SimulationError("step 2: too fast", Simulator(loose).run(0.01)).hint)


def test_a_joint_breaks_at_its_load_and_not_before():
    built = scene()
    for name, mass, x in (("light", 1.0, 0.0), ("heavy", 3.0, 1.0)):
        built.add(name, sphere={"radius": 0.1}, position=(x, 0, -0.5), mass=mass)
        built.join(name, "fixed", name, anchor=(x, 0, -0.5), breaks_at={"force": 20.0})
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(0.5))
    assert simulator.joint("heavy").broken and not simulator.joint("light").broken
    assert simulator["light"].centre[2] == pytest.approx(-0.5, abs=1e-6)
    assert simulator["heavy"].centre[2] < -1.5


def test_what_breaks_in_an_impact_does_not_hold_against_it():
    """A block that is bolted by too weak a joint takes the blow as one that is free."""
    moved = []
    for bolted in (True, False):
        built = scene(gravity=(0, 0, 0))
        built.add("block", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 0), mass=2.0, restitution=0.5)
        ball = {"sphere": {"radius": 0.1}, "position": (-0.5, 0, 0), "velocity": (5, 0, 0)}
        built.add("ball", **ball, mass=1.0, restitution=1.0)
        if bolted:
            built.join("bolt", "fixed", "block", breaks_at={"force": 50.0})
        moved.append(Simulator(built).run(0.3).velocity[-1])
    assert moved[0] == pytest.approx(moved[1], abs=1e-9)
    assert moved[0][0, 0] == pytest.approx(1.5 * 5.0 / 3.0, rel=1e-6)


def test_what_a_joint_holds_does_not_touch_but_where_it_is_asked_to():
    for collide, passes in (("off", True), ("on", False)):
        built = scene()
        built.add("base", box={"size": (0.4, 0.4, 0.1)}, motion="static", position=(0, 0, -0.05))
        built.add("flap", box={"size": (0.5, 0.2, 0.04)}, position=(0.25, 0, 0.03), mass=1.0)
        built.join("edge", "hinge", "flap", "base", anchor=(0, 0, 0.03), axis=(0, -1, 0), collide=collide)
        rollout = Simulator(built).run(0.6)
        assert bool(rollout.position[:, 1, 2].min() < 0.0) == passes


def test_a_damped_pendulum_falls_asleep_and_wakes_when_it_is_pushed():
    built = Scene(model="solver")
    built.add("bob", sphere={"radius": 0.1}, position=(0.02, 0, -0.5), mass=1.0)
    built.join("pin", "hinge", "bob", anchor=(0, 0, 0), axis=(0, 1, 0), damping=2.0)
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(6.0))
    assert simulator["bob"].asleep
    simulator["bob"].push((1.0, 0, 0))
    simulator.step(5)
    assert not simulator["bob"].asleep and simulator.joint("pin").speed < -0.1


def test_a_motor_that_is_told_another_place_wakes_what_it_drives():
    built = Scene(model="solver")
    built.add("arm", box={"size": (0.4, 0.1, 0.1)}, position=(0.2, 0, 0), mass=1.0)
    motor = {"position_deg": 0.0, "max_force": 30.0}
    built.join("shoulder", "hinge", "arm", anchor=(0, 0, 0), axis=(0, 1, 0), motor=motor)
    simulator = Simulator(built)
    simulator.step(simulator.steps_in(3.0))
    assert simulator["arm"].asleep
    simulator.joint("shoulder").target = 0.3
    simulator.step(simulator.steps_in(2.0))
    assert simulator.joint("shoulder").angle == pytest.approx(0.3, abs=1e-4)


def tumbling() -> Scene:
    """Three boxes on joints that fall onto a floor, with a motor, a limit and friction."""
    built = Scene(model="solver")
    built.add("floor", plane={}, friction=0.7)
    for k in range(3):
        built.add(
            f"box{k}", box={"size": (0.2, 0.1, 0.08)}, position=(0.22 * k, 0, 0.4 + 0.01 * k), velocity=(0, 0.5, 0)
        )
    built.join(
        "one", "hinge", "box1", "box0", anchor=(0.11, 0, 0.4), axis=(0, 1, 0), limits_deg=(-60, 60), friction=0.05
    )
    built.join("two", "ball", "box2", "box1", anchor=(0.33, 0, 0.41), axis=(1, 0, 0), cone_deg=50, damping=0.01)
    return built


def same(one, other) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in MOTION)


def test_a_run_goes_on_from_any_state_with_the_same_bits():
    whole, part = Simulator(tumbling()), Simulator(tumbling())
    whole.step(30)
    middle = whole.state
    whole.step(50)
    part.restore(middle)
    part.step(50)
    known, again = (np.array(simulator.state.joints) for simulator in (whole, part))
    assert same(whole.state, part.state) and np.array_equal(known, again)


def test_steps_in_one_call_and_one_by_one_are_the_same_bits():
    at_once, single = (Simulator(tumbling()) for _ in range(2))
    frames = list(at_once.frames(60, 60))
    for _ in range(60):
        single.step()
    assert same(at_once.state, single.state)
    assert frames[0].joint_position.shape == (60, 2)


def test_variants_of_a_scene_in_one_call_move_as_each_by_itself():
    simulator = Simulator(tumbling())
    variant = {"box1": {"velocity": (0.3, 0.0, 1.0)}}
    many = simulator.rollouts([{}, variant], steps=40)
    assert np.array_equal(many[0].position, Simulator(tumbling()).run(steps=40).position)
    assert not np.array_equal(many[0].position, many[1].position)


def test_joints_that_are_off_leave_a_scene_as_it_is_without_them():
    free = Scene(model="solver")
    held = Scene(model="solver", effects={"joints": "off"})
    for built in (free, held):
        built.add("floor", plane={})
        built.add("box", box={"size": (0.2, 0.1, 0.08)}, position=(0, 0, 0.3))
    held.join("pin", "ball", "box", anchor=(0.1, 0, 0.3))
    one, other = (Simulator(built) for built in (free, held))
    assert same(one.step(40), other.step(40))
    with pytest.raises(SdfsimError, match="joints are off"):
        _ = other.joint("pin").speed


def test_joints_hold_where_contact_is_off():
    built = scene(effects={"contact": "off", "sleep": "off"})
    built.add("bob", sphere={"radius": 0.1}, position=(1, 0, 0))
    built.join("pin", "hinge", "bob", anchor=(0, 0, 0), axis=(0, 1, 0))
    rollout = Simulator(built).run(1.0)
    assert np.linalg.norm(rollout.position[:, 0], axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_a_body_on_a_path_leads_what_hangs_on_it():
    built = scene()
    path = [{"time": 0.0, "position": (0, 0, 0)}, {"time": 2.0, "position": (1, 0, 0)}]
    built.add("hand", box={"size": (0.1, 0.1, 0.1)}, motion="kinematic", path=path)
    built.add("bob", sphere={"radius": 0.05}, position=(0, 0, -0.5), mass=1.0)
    built.join("string", "distance", "bob", "hand", anchor=(0, 0, -0.5), to=(0, 0, 0), rod=0.5)
    rollout = Simulator(built).run(2.0)
    # Set off at once, it swings about its point as one that is pushed.
    rate = math.sqrt(G / 0.5)
    lag = rollout.position[:, 1, 0] - rollout.position[:, 0, 0]
    assert lag == pytest.approx(-0.5 / rate * np.sin(rate * rollout.time), abs=0.01)
    assert rollout.joint_position[:, 0] == pytest.approx(0.5, abs=1e-6)


def test_a_state_that_is_set_by_hand_is_taken_up_by_joints():
    built = scene(gravity=(0, 0, 0))
    built.add("bob", sphere={"radius": 0.1}, position=(1, 0, 0))
    built.join("pin", "hinge", "bob", anchor=(0, 0, 0), axis=(0, 0, 1))
    simulator = Simulator(built)
    simulator.step(3)
    simulator.state = replace(simulator.state, velocity=simulator.state.velocity + np.array([[0.0, 1.0, 0.0]]))
    simulator.step(1)
    # Turning about the pin takes in the ball's own inertia.
    speed = simulator.joint("pin").speed * simulator.units.time
    assert speed == pytest.approx(simulator.units.length / (1.0 + 0.4 * 0.1**2), rel=1e-6)
