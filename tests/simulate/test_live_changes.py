"""A simulator that is changed while it runs: materials, bodies, recordings, snapshots; and a state that is kept, from
which a run goes on as it went on there."""

import numpy as np
import pytest

from sdfsim import Scene, SdfsimError, Simulator, State, save_run
from sdfsim.apps.run import read_run
from tests.helpers.runs import same

SLOPE = 20.0  # degrees


def sliding(friction: float) -> Simulator:
    """A box that slides down a slope, as fast as its friction allows."""
    scene = Scene(model="solver")
    lean = np.radians(SLOPE)
    scene.add("slope", plane={"normal": (np.sin(lean), 0, np.cos(lean))}, friction=1.0, restitution=0.0)
    place = 0.05 * np.array([np.sin(lean), 0, np.cos(lean)])
    scene.add("box", box={"size": (0.3, 0.3, 0.1)}, position=place, euler_xyz_deg=(0, SLOPE, 0), friction=friction,
              restitution=0.0, mass=2.0)  # fmt: skip
    return Simulator(scene)


def test_friction_set_while_it_runs_acts_as_in_a_scene_that_has_it():
    simulator = sliding(0.8)
    simulator.step(simulator.steps_in(0.5))
    box = simulator["box"]
    assert np.linalg.norm(box.velocity) < 1e-3
    box.friction = 0.1
    assert box.friction == 0.1
    simulator.step(simulator.steps_in(0.5))
    lean, seconds = np.radians(SLOPE), simulator.steps_in(0.5) * simulator.dt
    wanted = 9.81 * (np.sin(lean) - 0.1 * np.cos(lean)) * seconds
    assert np.linalg.norm(box.velocity) == pytest.approx(wanted, rel=0.03)
    box.friction = 0.0  # the effect is computed again when some friction is back
    box.friction = 1.0
    simulator.step(simulator.steps_in(1.0))
    assert np.linalg.norm(box.velocity) < 1e-3


def test_restitution_and_mass_set_while_it_runs():
    scene = Scene(model="solver").add("floor", plane={}, restitution=1.0)
    scene.add("ball", sphere={"radius": 0.1}, position=(0, 0, 1.1), restitution=0.0, mass=1.0)
    simulator = Simulator(scene)
    ball = simulator["ball"]
    ball.restitution, ball.mass = 0.8, 3.0
    assert ball.mass == pytest.approx(3.0)
    assert ball.inertia[0, 0] == pytest.approx(0.4 * 3.0 * 0.01)
    fall = np.sqrt(2 * 1.0 / 9.81)
    rollout = simulator.run(seconds=fall + 0.8 * fall)
    assert rollout.position[:, 1, 2].max() == pytest.approx(1.1)
    assert rollout.position[-1, 1, 2] - 0.1 == pytest.approx(0.64, rel=0.03)
    ball.velocity = (0, 0, 0)
    ball.push((3.0, 0, 0))
    assert ball.velocity[0] == pytest.approx(1.0)
    for field, value in (("friction", -1.0), ("restitution", 1.5), ("mass", 0.0)):
        with pytest.raises(SdfsimError, match=f"body 'ball'.*{field}"):
            setattr(ball, field, value)
    with pytest.raises(SdfsimError, match="is static, so it has no mass"):
        simulator["floor"].mass = 1.0


def test_work_of_a_change_of_mass_is_in_the_account():
    simulator = sliding(0.8)
    simulator["box"].velocity = (1.0, 0, 0)
    with simulator.record() as run:
        simulator["box"].mass = 4.0
        simulator.step(1)
    height = run.rollout.position[0, 1, 2]  # heights count from 0
    assert run.rollout.counters["energy_given"][1] == pytest.approx(0.5 * 2.0 * 1.0 + 2.0 * 9.81 * height)


def test_bodies_are_added_and_removed_and_others_go_on_as_they_are():
    scene = Scene(model="solver").add("floor", plane={})
    for k in range(3):
        scene.add(f"box{k}", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 0.1 + 0.2 * k), restitution=0.0)
    simulator = Simulator(scene)
    simulator.step(simulator.steps_in(2.0))
    assert simulator["box2"].asleep
    before, top = simulator.si_state(), simulator["box2"]
    ball = simulator.add("ball", sphere={"radius": 0.15}, position=(2, 0, 0.5), velocity=(1, 0, 0), mass=0.3)
    assert ball.mass == pytest.approx(0.3) and simulator["box2"].asleep  # sleeps on
    np.testing.assert_allclose(simulator.si_state().position[:4], before.position, rtol=0, atol=1e-15)
    simulator.step(simulator.steps_in(0.2))
    assert ball.velocity[2] < -1.5 and ball.velocity[0] == pytest.approx(1.0)
    simulator.remove("box0")
    simulator.step(simulator.steps_in(1.0))
    np.testing.assert_allclose(top.position, (0, 0, 0.3), atol=2e-3)  # the handle follows its body to another row
    with pytest.raises(SdfsimError, match="two bodies have this name"):
        simulator.add("ball", sphere={"radius": 0.1})
    with pytest.raises(SdfsimError, match="no body 'box0'"):
        simulator.remove("box0")
    # A much smaller body shortens the step; everything else goes on all the same.
    dt, place = simulator.dt, top.position
    simulator.add("pea", sphere={"radius": 0.01}, position=(0, 3, 0.01))
    assert simulator.dt < 0.6 * dt
    simulator.step(simulator.steps_in(0.5))
    np.testing.assert_allclose(top.position, place, atol=2e-3)


def test_joints_keep_their_turns_and_targets_when_a_body_is_added():
    for radius in (0.5, 0.02):  # in the same units, and in others
        simulator = resting()
        door = simulator.joint("door")
        door.target = 1.0
        simulator.step(simulator.steps_in(1.5))
        angle = door.angle
        simulator.add("new", sphere={"radius": radius}, position=(5, 5, 1))
        assert door.angle == pytest.approx(angle, abs=1e-6) and door.target == pytest.approx(1.0)
        simulator.step(simulator.steps_in(0.3))
        assert door.angle == pytest.approx(1.0, abs=0.02)
        simulator.remove("leaf")
        simulator.step(5)
        assert [joint.name for joint in simulator.scene.joints] == ["rail"]


def test_a_rewind_restores_bits_also_across_changes_of_the_scene():
    simulator = resting()
    simulator.joint("door").target = 0.8
    simulator.step(20)
    snapshot, friction = simulator.snapshot(), simulator["box"].friction
    simulator.step(30)
    wanted = simulator.state
    simulator.rewind(snapshot)
    simulator["box"].friction = 0.0
    simulator["box"].push((5, 0, 0))
    simulator.add("pea", sphere={"radius": 0.02}, position=(3, 0, 1))
    simulator.step(40)
    simulator.rewind(snapshot)
    assert simulator["box"].friction == friction
    simulator.step(30)
    assert same(simulator.state, wanted)


def test_a_recording_has_what_is_done_between_steps(tmp_path):
    simulator = resting()
    simulator.step(3)
    with simulator.record() as run:
        for k in range(40):
            simulator.joint("door").target = 0.02 * k
            if k == 10:
                simulator.joint("rail").effort = 5.0
                simulator["box"].push((4.0, 0, 0))
            simulator.step()
            if k == 30:
                kept = simulator.state
        simulator.restore(kept)
        simulator.step(4)
    simulator.step(5)
    rollout = run.rollout
    assert len(rollout) == 35
    np.testing.assert_allclose(np.diff(rollout.time), simulator.dt)
    np.testing.assert_allclose(rollout.counters["target_door"][:31], 0.02 * np.r_[0, np.arange(30)], atol=1e-12)
    assert np.isnan(rollout.counters["effort_rail"][:11]).all() and rollout.counters["effort_rail"][12] == 5.0
    assert np.isnan(rollout.counters["target_rail"][12])
    assert rollout.counters["energy_given"][11] > 3.9  # J, of the push: 4^2 / (2 x 2)
    # Joints' speeds, motors' efforts and contacts' forces are those of every step.
    names, ends = rollout.joint_names, np.cumsum(rollout.contact_count)
    door, rail = names.index("door"), names.index("rail")
    assert rollout.joint_effort[12, rail] == pytest.approx(5.0) and rollout.joint_effort[0, rail] == 0.0
    assert 0.0 < abs(rollout.joint_effort[20, door]) <= simulator.joint("door").max_force
    fast = np.gradient(rollout.joint_position[:, door], rollout.time)
    np.testing.assert_allclose(fast[14:30], rollout.joint_velocity[14:30, door], rtol=0.05)
    last = slice(ends[-2], ends[-1])
    carried = np.isin(rollout.contact_body[last], rollout.names.index("box")).any(1)
    assert abs(rollout.contact_force[last][carried].sum(0)[2]) == pytest.approx(2.0 * 9.81, rel=0.05)
    # As a run folder the commands read it.
    save_run(simulator, run, tmp_path / "run")
    scene, kept = read_run(tmp_path / "run")
    for name in ("joint_position", "joint_effort", "contact_force"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(rollout, name))
    assert scene.bodies[0].name == rollout.names[0]
    # The same steps without a recording.
    again = resting()
    again.step(3)
    for k in range(10):
        again.joint("door").target = 0.02 * k
        again.step()
    np.testing.assert_array_equal(again.si_state().position, rollout.position[10])


STEPS = 25


def resting() -> Simulator:
    """A door, a drawer and a box on a floor, all asleep; nothing but the box touches anything."""
    scene = Scene(model="solver")
    scene.add("floor", plane={}, friction=0.8)
    scene.add("box", box={"size": (0.2, 0.2, 0.2)}, position=(3, 0, 0.1), mass=2.0, restitution=0.0)
    scene.add("leaf", box={"size": (0.8, 0.04, 1.0)}, position=(0.4, 0, 1.0), mass=5.0)
    scene.add("drawer", box={"size": (0.3, 0.3, 0.1)}, position=(0, 2, 1.0), mass=3.0)
    motor = {"position_deg": 0.0, "max_force": 60.0}
    scene.join("door", "hinge", "leaf", anchor=(0, 0, 1), axis=(0, 0, 1), limits_deg=(-10, 110), motor=motor)
    scene.join("rail", "slider", "drawer", axis=(1, 0, 0), motor={"position": 0.0, "max_force": 80.0})
    made = Simulator(scene)
    made.step(made.steps_in(2.0))
    assert all(made[name].asleep for name in ("box", "leaf", "drawer"))
    return made


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return resting()


ACTS = {
    "target": lambda sim: setattr(sim.joint("door"), "target", 1.2),
    "target of a slider": lambda sim: setattr(sim.joint("rail"), "target", 0.3),
    "effort": lambda sim: setattr(sim.joint("door"), "effort", 3.0),
    "most and target": lambda sim: (
        setattr(sim.joint("door"), "max_force", 90.0), setattr(sim.joint("door"), "target", 0.7)
    ),
    "push": lambda sim: sim["box"].push((4.0, 0, 0)),
    "push of what is held": lambda sim: sim["leaf"].push((0, 2.0, 0)),
    "pull": lambda sim: sim["box"].pull((40.0, 0, 0)),
    "torque": lambda sim: sim["leaf"].pull(torque=(0, 0, 90.0)),
    "velocity": lambda sim: setattr(sim["drawer"], "velocity", (0.5, 0, 0)),
    "position": lambda sim: setattr(sim["box"], "position", (3, 0, 0.4)),
}  # fmt: skip


@pytest.mark.parametrize("act", ACTS)
@pytest.mark.parametrize("awake", [False, True])
def test_act_save_step_restore_step_gives_the_same_bits(simulator, act, awake, tmp_path):
    simulator.reset()
    simulator.step(7 if awake else simulator.steps_in(2.0))
    assert simulator["leaf"].asleep is not awake
    before = simulator.state
    ACTS[act](simulator)
    kept = simulator.state
    simulator.step(STEPS)
    first = simulator.state
    assert any(not np.array_equal(getattr(first, name), getattr(before, name)) for name in ("position", "orientation"))
    simulator.restore(kept)
    simulator.step(STEPS)
    assert same(simulator.state, first)

    other = Simulator(simulator.scene)
    other.restore(State.read(kept.save(tmp_path / "kept.npz")))
    other.step(STEPS)
    assert same(other.state, first)


@pytest.mark.parametrize("what", ["load", "target"])
def test_a_state_that_pulls_or_drives_otherwise_wakes_what_it_moves(simulator, what):
    simulator.reset()
    simulator.step(simulator.steps_in(2.0))
    from dataclasses import replace

    asleep, other = simulator.state, Simulator(simulator.scene)
    other.restore(asleep)
    ACTS["pull" if what == "load" else "target"](other)
    told = other.state
    new = {"load": told.load} if what == "load" else {"joints": told.joints}
    simulator.state = replace(asleep, **new)
    simulator.step(STEPS)
    name = "box" if what == "load" else "leaf"
    assert np.linalg.norm(simulator[name].centre - other[name].centre) > 0.01


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda sim: sim.step(), "state: must be a State.*got a Moment"),
        (lambda sim: sim.run(steps=1), "state: must be a State.*got a Rollout"),
        (lambda sim: None, "got a NoneType"),
        (lambda sim: Simulator(Scene().add("ball", sphere={"radius": 0.1})).state, "of another scene"),
    ],
)  # fmt: skip
def test_what_is_no_state_of_the_scene_is_refused(simulator, given, message):
    wrong = given(simulator)
    with pytest.raises(SdfsimError, match=message):
        simulator.restore(wrong)
    with pytest.raises(SdfsimError, match=message):
        simulator.state = wrong


def test_a_file_that_holds_no_state_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name, told in (("other.npz", "not a state of this version"), ("none.npz", "no such file")):
        with pytest.raises(SdfsimError, match=f"{name}: {told}"):
            State.read(tmp_path / name)
