"""Joints that are driven, changed or switched off while a scene runs, asleep, and the same bits; the laws of their
motion are in `sdfsim.evaluation.laws.joints`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sdfsim import Scene, SdfsimError, Simulator
from sdfsim.physics.motion import MOTION
from sdfsim.simulate.simulator import SimulationError

G = 9.81


def scene(**settings) -> Scene:
    return Scene(model="solver", **({"effects": {"sleep": "off"}} | settings))


def rod(joint: dict, gravity: float = G, **more) -> Simulator:
    """A rod of 0.5 m and 2 kg, level, on a hinge at its end about y."""
    built = scene(gravity=(0, 0, -gravity))
    built.add("rod", box={"size": (0.5, 0.05, 0.05)}, position=(0.25, 0, 0), mass=2.0, **more)
    built.join("pin", "hinge", "rod", anchor=(0, 0, 0), axis=(0, 1, 0), **joint)
    return Simulator(built)


@pytest.mark.parametrize(
    ("limits", "start"),
    [((0, 720), 0), ((-720, 0), 0), ((0, 720), 400), ((-900, 10), -500), ((0, 360), 0), ((0, 360), 360), (None, 270)],
)
def test_a_hinge_starts_at_the_angle_that_is_given(limits, start):
    """A pose shows an angle up to full turns only."""
    ends = {"limits_deg": limits} if limits else {"spring": {"stiffness": 5.0, "rest_deg": start}}
    simulator = rod({"start_deg": start, **ends}, gravity=0.0)
    for _ in range(2):
        assert math.degrees(simulator.joint("pin").angle) == pytest.approx(start, abs=1e-9)
        assert simulator.joint("pin").speed == pytest.approx(0.0, abs=1e-9)
        simulator.step(20)


def test_a_target_at_the_joint_s_own_reading_is_within_its_limits(recwarn):
    simulator = rod({"limits_deg": (0, 90), "motor": {"position_deg": 0, "max_force": 50.0}})
    simulator.step(100)
    for _ in range(20):
        simulator.joint("pin").target = simulator.joint("pin").angle
        simulator.step(1)
    assert not recwarn
    with pytest.warns(UserWarning, match="beyond the limits"):
        simulator.joint("pin").target = -0.01


def test_an_effort_acts_beside_the_gain_of_a_motor():
    pushed = rod({"motor": {"position_deg": 60, "max_force": 1.0, "gain": 1e-5, "time": 0.02}}, gravity=0.0)
    pushed.joint("pin").effort = 0.8
    pushed.step(20)
    about = 2.0 * ((0.5**2 + 0.05**2) / 12 + 0.25**2)
    assert pushed.joint("pin").speed == pytest.approx(0.8 * pushed.steps_done * pushed.dt / about, rel=1e-6)


def test_a_run_that_fails_asks_for_damping_where_joints_have_none():
    loose, held = (scene().add("ball", sphere={"radius": 0.1}) for _ in range(2))
    held.join("pin", "hinge", "ball", anchor=(0, 0, 1), axis=(0, 1, 0))
    hints = [str(SimulationError("step 2: too fast", Simulator(built).run(0.01)).hint) for built in (loose, held)]
    assert ["damping" in hint for hint in hints] == [False, True]


def test_what_a_joint_holds_does_not_touch_but_where_it_is_asked_to():
    for collide, passes in ((False, True), (True, False)):
        built = scene()
        built.add("base", box={"size": (0.4, 0.4, 0.1)}, motion="static", position=(0, 0, -0.05))
        built.add("flap", box={"size": (0.5, 0.2, 0.04)}, position=(0.25, 0, 0.03), mass=1.0)
        built.join("edge", "hinge", "flap", "base", anchor=(0, 0, 0.03), axis=(0, -1, 0), collide=collide)
        rollout = Simulator(built).run(0.6)
        assert bool(rollout.position[:, 1, 2].min() < 0.0) == passes


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


def test_steps_in_one_call_and_one_by_one_are_the_same_bits():
    at_once, single = (Simulator(tumbling()) for _ in range(2))
    frames = list(at_once.frames(60, 60))
    for _ in range(60):
        single.step()
    assert same(at_once.state, single.state)
    assert frames[0].joint_position.shape == (60, 2)


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


MASS, SIZE = 2.0, (0.6, 0.2, 0.1)
INERTIA = MASS / 12.0 * (SIZE[0] ** 2 + SIZE[1] ** 2)  # kg m^2, about z through the middle


def free(kind: str, gravity=(0, 0, 0), **keys) -> Simulator:
    """A box on a joint through its middle, along or about z, that nothing else acts on."""
    scene = Scene(model="solver", gravity=gravity)
    scene.add("box", box={"size": SIZE}, mass=MASS)
    scene.join("joint", kind, "box", anchor=(0, 0, 0), axis=(0, 0, 1), **keys)
    return Simulator(scene)


@pytest.mark.parametrize(("kind", "heft"), [("hinge", INERTIA), ("slider", MASS)])
@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_effort_speeds_up_what_it_acts_on_by_newtons_law(kind, heft, friction, sign):
    sim = free(kind, **({"friction": friction} if friction else {}))
    joint = sim.joint("joint")
    joint.effort = sign * 0.8
    sim.step(60)
    time, net = 60 * sim.dt, 0.8 - friction
    assert joint.speed == pytest.approx(sign * net / heft * time, rel=1e-6)
    where = joint.angle if kind == "hinge" else joint.position
    assert where == pytest.approx(sign * 0.5 * net / heft * time**2, rel=1e-3)
    assert joint.effort == pytest.approx(sign * 0.8)
    joint.effort = 0.0
    speed = joint.speed
    sim.step(10)
    lost = friction / heft * 10 * sim.dt
    assert joint.speed == pytest.approx(sign * max(0.0, abs(speed) - lost), rel=1e-6)


def test_friction_holds_a_smaller_effort_and_a_slider_holds_its_weight():
    sim = free("hinge", friction=0.5)
    sim.joint("joint").effort = 0.45
    sim.step(40)
    assert abs(sim.joint("joint").angle) < 1e-9
    lift = free("slider", gravity=(0, 0, -9.81))
    lift.joint("joint").effort = MASS * 9.81
    lift.step(40)
    assert abs(lift.joint("joint").position) < 1e-9
    assert lift.joint("joint").force[2] == pytest.approx(MASS * 9.81)


def test_a_motor_may_be_given_and_its_strength_changed():
    sim = free("hinge")
    joint = sim.joint("joint")
    assert joint.max_force == 0.0
    with pytest.raises(SdfsimError, match=r"'joint': has no motor\nhint: .*set max_force"):
        joint.target = 0.5
    joint.max_force = 20.0
    assert joint.target is None
    joint.target = 0.5
    sim.step(sim.steps_in(2.0))
    assert joint.angle == pytest.approx(0.5, abs=1e-4)
    # Weaker than a steady torque against it, it lets go.
    joint.max_force = 1.0
    sim["box"].pull(torque=(0, 0, 3.0))
    speed = joint.speed
    sim.step(10)
    assert joint.speed - speed == pytest.approx(2.0 / INERTIA * 10 * sim.dt, rel=1e-5)
    joint.target = None
    speed = joint.speed
    sim.step(10)
    assert joint.speed - speed == pytest.approx(3.0 / INERTIA * 10 * sim.dt, rel=1e-5)


def test_the_time_of_a_motor_is_that_in_which_the_way_shrinks_by_e():
    sim = free("hinge", motor={"position_deg": 0.0, "max_force": 1e4})
    joint = sim.joint("joint")
    joint.time, joint.target = 0.25, 1.0
    assert joint.time == pytest.approx(0.25)
    sim.step(5)
    first = 1.0 - joint.angle
    steps = sim.steps_in(0.5)
    sim.step(steps)
    assert (1.0 - joint.angle) / first == pytest.approx(np.exp(-steps * sim.dt / 0.25), rel=0.03)


@pytest.mark.parametrize(("kind", "heft"), [("hinge", INERTIA), ("slider", MASS)])
def test_damping_and_friction_change_while_it_runs(kind, heft):
    sim = free(kind)
    joint, box = sim.joint("joint"), sim["box"]
    spin = "angular_velocity" if kind == "hinge" else "velocity"
    setattr(box, spin, (0, 0, 1.0))
    joint.damping = 0.3
    assert joint.damping == pytest.approx(0.3)
    sim.step(50)
    assert joint.speed == pytest.approx(np.exp(-0.3 / heft * 50 * sim.dt), rel=1e-3)
    joint.damping, joint.friction = 0.0, 0.05
    assert joint.friction == pytest.approx(0.05)
    speed = joint.speed
    sim.step(20)
    assert joint.speed == pytest.approx(max(0.0, speed - 0.05 / heft * 20 * sim.dt), rel=1e-4, abs=1e-9)


def test_a_target_beyond_the_limits_is_told():
    sim = free("hinge", limits_deg=(-90, 90), motor={"max_force": 20.0})
    with pytest.warns(UserWarning, match=r"joint 'joint': target 2 is beyond the limits, -1\.571 to 1\.571"):
        sim.joint("joint").target = 2.0


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda j: setattr(j, "target", "open"), "joint 'joint': target: must be a finite number.*got 'open'"),
        (lambda j: setattr(j, "target", (1, 2)), "target: must be a finite number"),
        (lambda j: setattr(j, "effort", np.nan), "effort: must be a finite number"),
        (lambda j: setattr(j, "max_force", -1), "max_force: must be a finite number of at least 0"),
        (lambda j: setattr(j, "time", -1), "time: must be a finite number of at least 0"),
        (lambda j: setattr(j, "friction", True), "friction: must be a finite number of at least 0"),
        (lambda j: j.quat_xyzw, "is a hinge, which has no quat_xyzw"),
    ],
)
def test_what_cannot_be_told_is_refused_in_a_line(act, message):
    with pytest.raises(SdfsimError, match=message):
        act(free("hinge", motor={"max_force": 20.0}).joint("joint"))


def test_what_a_joint_does_not_have_is_said():
    scene = Scene(model="solver").add("box", box={"size": SIZE}).add("other", box={"size": SIZE}, position=(2, 0, 0))
    scene.join("ball", "ball", "box", anchor=(0, 0, 0)).join("rail", "slider", "other", axis=(1, 0, 0))
    sim = Simulator(scene)
    with pytest.raises(SdfsimError, match="'ball': is a ball, which has no effort"):
        sim.joint("ball").effort = 1.0
    with pytest.raises(SdfsimError, match="'rail': is a slider, which has no angle\nhint: read position"):
        _ = sim.joint("rail").angle


def test_reset_forgets_what_motors_were_told():
    sim = free("hinge", motor={"max_force": 20.0})
    joint = sim.joint("joint")
    joint.max_force, joint.damping, joint.target = 5.0, 2.0, 1.0
    sim.step(3)
    sim.reset()
    assert (joint.max_force, joint.damping, joint.target) == (pytest.approx(20.0), 0.0, None)
