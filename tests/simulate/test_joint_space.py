"""Joints as coordinates: positions and velocities that are set, keyframes, frames, Jacobians and the mass matrix."""

import math
from pathlib import Path

import numpy as np
import pytest

from sdfsim import Scene, SdfsimError, Simulator, export
from tests.helpers.mujoco_start import at_start

POSITIONS = np.array([0.5, 0.1, 0.3, -0.4, 0.8, 1.0])
VELOCITIES = np.array([0.7, -0.2, 1.1, 0.4, -0.6, 0.9])


def robot() -> Scene:
    """A free base with a hinge, a slider and a ball in a row, and an arm on the world."""
    scene = Scene(model="solver", gravity=(0, 0, 0))
    scene.add("base", box={"size": (0.3, 0.3, 0.2)}, position=(0, 0, 1), mass=3.0)
    scene.add(
        "upper", capsule={"radius": 0.05, "height": 0.4}, position=(0.1, 0, 1.3), mass=1.0, euler_xyz_deg=(0, 20, 0)
    )
    scene.add("lower", box={"size": (0.1, 0.2, 0.3)}, position=(0.1, 0.1, 1.6), mass=0.5)
    scene.add("head", box={"size": (0.1, 0.2, 0.15)}, position=(0.1, 0.1, 1.9), mass=0.7)
    scene.join(
        "turn",
        "hinge",
        "upper",
        "base",
        anchor=(0, 0, 1.1),
        axis=(0, 1, 0.3),
        motor={"position_deg": 0, "max_force": 9},
    )
    scene.join("rail", "slider", "lower", "upper", axis=(0.2, 0, 1))
    scene.join("neck", "ball", "head", "lower", anchor=(0.1, 0.1, 1.8))
    scene.add("arm", box={"size": (0.1, 0.2, 0.15)}, position=(2.1, 0.1, 1.9), mass=0.7)
    scene.join("wall", "hinge", "arm", anchor=(2.1, 0.0, 1.8), axis=(1, 1, 0), start_deg=20)
    scene.frame("tool", "head", position=(0.0, 0.1, 0.2), euler_xyz_deg=(0, 0, 90))
    scene.keyframe(
        "bent", angles_deg={"turn": 30, "wall": -40}, positions={"rail": 0.05},
        quats_xyzw={"neck": (0, 0, math.sin(0.2), math.cos(0.2))}, bodies={"base": {"position": (1, 2, 3)}},
    )  # fmt: skip
    return scene


def posed(simulator: Simulator) -> np.ndarray:
    state = simulator.state
    parts = state.position, state.orientation, state.velocity, state.angular_velocity
    return np.concatenate([part.ravel() for part in parts])


def four_bar() -> Scene:
    """A crank of 0.2 m, a rod and a rocker of 0.5 m on pivots that are 0.5 m apart."""
    scene = Scene(model="solver", gravity=(0, 0, 0))
    places = {"crank": ((0, 0), (0, 0.2)), "rod": ((0, 0.2), (0.5, 0.5)), "rocker": ((0.5, 0), (0.5, 0.5))}
    for name, ends in places.items():
        one, other = np.array(ends)
        angle = math.degrees(math.atan2(*(other - one)[::-1]))
        middle = (*0.5 * (one + other), 0)
        size = (float(np.linalg.norm(other - one)), 0.02, 0.02)
        scene.add(name, box={"size": size}, position=middle, euler_xyz_deg=(0, 0, angle), mass=0.3)
    scene.join("motor", "hinge", "crank", anchor=(0, 0, 0), axis=(0, 0, 1))
    scene.join("first", "hinge", "rod", "crank", anchor=(0, 0.2, 0), axis=(0, 0, 1))
    scene.join("second", "hinge", "rod", "rocker", anchor=(0.5, 0.5, 0), axis=(0, 0, 1))
    scene.join("out", "hinge", "rocker", anchor=(0.5, 0, 0), axis=(0, 0, 1))
    return scene


def test_joints_are_set_and_read_as_vectors() -> None:
    simulator = Simulator(robot())
    base = simulator["base"].position
    simulator.set_joints(POSITIONS, VELOCITIES)
    np.testing.assert_allclose(simulator.joint_positions, POSITIONS, atol=1e-12)
    np.testing.assert_allclose(simulator.joint_velocities, VELOCITIES, atol=1e-12)
    np.testing.assert_array_equal(simulator["base"].position, base)
    assert simulator.joint_columns["neck"] == slice(2, 5)
    assert simulator.joint("rail").position == pytest.approx(0.1)
    assert simulator.joint("turn").speed == pytest.approx(0.7)
    # The step goes on from there: without forces each position changes by its velocity.
    simulator.step()
    np.testing.assert_allclose(simulator.joint("wall").angle, 1.0 + 0.9 * simulator.dt, rtol=1e-6)


def test_a_joint_that_is_set_carries_what_it_holds() -> None:
    simulator = Simulator(robot())
    simulator.set_joints(POSITIONS, VELOCITIES)
    head, lower = simulator["head"], simulator["lower"]
    before = np.linalg.norm(head.position - lower.position)
    simulator.joint("turn").position = -0.2
    expected = POSITIONS.copy()
    expected[0] = -0.2
    np.testing.assert_allclose(simulator.joint_positions, expected, atol=1e-12)
    np.testing.assert_allclose(simulator.joint_velocities, VELOCITIES, atol=1e-12)
    assert np.linalg.norm(head.position - lower.position) == pytest.approx(before, abs=1e-12)
    simulator.joint("neck").quat_xyzw = (0, 0, 0, -2)
    np.testing.assert_allclose(simulator.joint("neck").quat_xyzw, (0, 0, 0, 1), atol=1e-12)
    simulator.joint("rail").speed = 0.5
    assert simulator.joint_velocities[1] == pytest.approx(0.5)
    # More than a turn adds up, and stays.
    simulator.joint("wall").angle = 7.0
    simulator.step()
    assert simulator.joint("wall").angle == pytest.approx(7.0 + 0.9 * simulator.dt, abs=1e-4)


@pytest.mark.parametrize("base", [None, "base"])
def test_jacobians_and_masses_are_those_of_mujoco(tmp_path: Path, base: str | None) -> None:
    import mujoco

    scene = robot()
    export(scene.load(), tmp_path / "robot.xml")
    (model, data), simulator = at_start(tmp_path / "robot.xml"), Simulator(scene)
    simulator.set_joints(POSITIONS)
    for name, place in simulator.joint_columns.items():
        at = model.jnt_qposadr[model.joint(name).id]
        quat = np.roll(simulator.joint("neck").quat_xyzw, 1) if name == "neck" else POSITIONS[place]
        data.qpos[at : at + len(quat)] = quat
    mujoco.mj_forward(model, data)
    rows = model.body("head").id
    point = data.xpos[rows] + np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(data.xpos[rows], simulator["head"].position, atol=1e-9)
    jac, full = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
    mujoco.mj_jac(model, data, jac[:3], jac[3:], point, rows)
    mujoco.mj_fullM(model, data, full) if mujoco.__version__ >= "4" else mujoco.mj_fullM(model, full, data.qM)
    # Ours is T times MuJoCo's velocities.
    columns = [] if base is None else list(range(6))
    columns += [
        model.jnt_dofadr[model.joint(n).id] + k
        for n, p in simulator.joint_columns.items()
        for k in range(p.stop - p.start)
    ]
    change = np.eye(len(columns))
    neck = simulator.joint_columns["neck"].start + len(columns) - len(POSITIONS)
    turn = np.array(data.xmat[rows]).reshape(3, 3).T @ np.array(data.xmat[model.body("lower").id]).reshape(3, 3)
    change[neck : neck + 3, neck : neck + 3] = turn
    if base is not None:
        change[3:6, 3:6] = np.array(data.xmat[model.body("base").id]).reshape(3, 3).T
    ours = simulator.jacobian("head", point, base=base)
    np.testing.assert_allclose(ours, jac[:, columns] @ change, atol=1e-8)
    np.testing.assert_allclose(
        simulator.mass_matrix(base=base), change.T @ full[np.ix_(columns, columns)] @ change, atol=1e-8
    )


def test_a_jacobian_is_the_difference_of_positions_and_masses_give_the_energy() -> None:
    simulator = Simulator(robot())
    simulator.set_joints(POSITIONS, VELOCITIES)
    slope, masses = simulator.jacobian("tool"), simulator.mass_matrix()
    tool = simulator.frame("tool")
    np.testing.assert_allclose(slope @ VELOCITIES, np.concatenate([tool.velocity, tool.angular_velocity]), atol=1e-12)
    energy = simulator.initial_rollout().counters["kinetic_energy"][0]
    assert 0.5 * VELOCITIES @ masses @ VELOCITIES == pytest.approx(energy, rel=1e-12)
    for k in (0, 1, 5):
        ends = []
        for sign in (1, -1):
            moved = POSITIONS.copy()
            moved[k] += sign * 1e-5
            simulator.set_joints(moved)
            ends.append(tool.position)
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-5, slope[:3, k], atol=1e-8)


def test_a_frame_has_the_pose_of_its_body() -> None:
    simulator = Simulator(robot())
    np.testing.assert_allclose(simulator.frame("tool").position, (0.1, 0.2, 2.1), atol=1e-12)
    np.testing.assert_allclose(np.abs(simulator.frame("tool").quat_xyzw), (0, 0, 0.5**0.5, 0.5**0.5), atol=1e-12)
    with pytest.raises(SdfsimError, match=r"there is no frame 'tol' \(did you mean 'tool'"):
        simulator.frame("tol")


def rocker(crank: float) -> np.ndarray:
    """[2] m, where the rod holds the rocker, by the circles around both."""
    one, other = 0.2 * np.array([-math.sin(crank), math.cos(crank)]), np.array([0.5, 0.0])
    rod, out = math.hypot(0.5, 0.3), 0.5
    way = other - one
    apart = float(np.linalg.norm(way))
    along = (rod**2 - out**2 + apart**2) / (2 * apart)
    side = np.array([-way[1], way[0]]) / apart
    return one + along * way / apart + math.sqrt(rod**2 - along**2) * side


@pytest.mark.parametrize("joint", ["motor", "out"])
def test_a_loop_closes_when_one_of_its_joints_is_set(joint: str) -> None:
    simulator = Simulator(four_bar())
    wanted = simulator.joint(joint)
    for angle in (0.3, -0.1):
        wanted.angle = angle
        assert wanted.angle == pytest.approx(angle, abs=1e-9)
        crank = simulator.joint("motor").angle
        end = rocker(crank) - np.array([0.5, 0.0])
        leaned = math.atan2(-end[0], end[1])
        assert simulator.joint("out").angle == pytest.approx(leaned, abs=1e-8)
    wanted.speed = 2.0
    before = simulator.joint_velocities
    simulator.step(20)
    assert max(np.abs(simulator["rod"].position[:2])) < 0.7
    assert before[0] != 0.0 and simulator.joint("first").broken is False
    with pytest.raises(SdfsimError, match="a loop or coupling stays open by"):
        simulator.joint("out").angle = -2.0


def test_a_coupled_joint_follows_the_one_that_is_set() -> None:
    simulator = Simulator(robot().couple("wall", "rail", ratio=3.0, offset_deg=10))
    simulator.joint("rail").position = 0.1
    assert simulator.joint("wall").angle == pytest.approx(0.3 + math.radians(10), abs=1e-9)
    simulator.joint("wall").speed = 0.6
    np.testing.assert_allclose(simulator.joint_velocities[[1, 5]], (0.2, 0.6), atol=1e-9)
    simulator.remove("head")  # with the frame on it, and in keyframes the ball
    assert not simulator.scene.frames and simulator.joint("wall").angle == pytest.approx(0.3 + math.radians(10))
    simulator.reset("bent")
    assert simulator.joint("rail").position * 3.0 + math.radians(10) == pytest.approx(simulator.joint("wall").angle)


def test_a_keyframe_is_the_same_as_a_fresh_start_in_it() -> None:
    simulator, fresh = Simulator(robot()), Simulator(robot())
    start = posed(simulator)
    fresh.reset(keyframe="bent")
    kept = posed(fresh)
    assert fresh.joint("turn").angle == pytest.approx(math.radians(30))
    assert fresh.joint("turn").target == pytest.approx(math.radians(30))
    np.testing.assert_allclose(fresh["base"].position, (1, 2, 3), atol=1e-12)
    np.testing.assert_allclose(fresh.joint("neck").quat_xyzw, (0, 0, math.sin(0.2), math.cos(0.2)), atol=1e-12)
    simulator.set_joints(POSITIONS, VELOCITIES)
    simulator.step(7)
    with simulator.record() as run:
        simulator.reset(keyframe="bent")
        np.testing.assert_array_equal(posed(simulator), kept)
        simulator.step(5)
        fresh.step(5)
        np.testing.assert_array_equal(posed(simulator), posed(fresh))
    assert len(run.rollout) == 5 and run.rollout.position[0, 0, 2] == pytest.approx(3.0)
    simulator.reset()
    np.testing.assert_array_equal(posed(simulator), start)
    with pytest.raises(SdfsimError, match=r"there is no keyframe 'bend' \(did you mean 'bent'"):
        simulator.reset("bend")


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda s: s.set_joints([1.0]), "positions: must be 6 finite numbers"),
        (lambda s: setattr(s.joint("neck"), "speed", 1.0), "'neck': is a ball, which has no speed to set"),
        (lambda s: setattr(s.joint("neck"), "quat_xyzw", (0, 0, 0, 0)), "must not be zero"),
        (lambda s: s.mass_matrix(base="head"), "base: body 'head' is not free"),
        (lambda s: s.jacobian("hat"), "there is no body 'hat' .did you mean 'head'"),
    ],
)
def test_what_cannot_be_set_is_one_line(act, message: str) -> None:
    with pytest.raises(SdfsimError, match=message):
        act(Simulator(robot()))
