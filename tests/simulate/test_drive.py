"""Joints that are driven while a scene runs: efforts, targets, and motors that are told otherwise."""

import numpy as np
import pytest

from sdfsim import Scene, SdfsimError, Simulator

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
