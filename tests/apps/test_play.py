"""What a person does to a running scene: hands, throws, time, materials, bodies, saved scenes and runs."""

import time
from pathlib import Path

import numpy as np
import pytest

from sdfsim import Rollout, Scene, SdfsimError, Simulator, load_scene
from sdfsim.apps.observed import load_recordings
from sdfsim.apps.play import opened, show
from sdfsim.apps.play.session import Session
from sdfsim.apps.run import read_run
from sdfsim.physics import pose
from tests.helpers.runs import same


def tabletop(**settings) -> Scene:
    scene = Scene(model="solver", **settings)
    scene.add("floor", plane={}, friction=0.8)
    scene.add("table", box={"size": (0.8, 0.5, 0.04)}, motion="static", position=(0, 0, 0.53), friction=0.8)
    scene.add("cup", asset="samples/shapes/can", position=(0.1, 0, 0.62), mass=0.4, friction=0.7, restitution=0.2)
    scene.add("cube", box={"size": (0.1, 0.1, 0.1)}, position=(-0.2, 0, 0.6), mass=0.5, friction=0.7, restitution=0.2)
    return scene


def arm() -> Scene:
    """Two links on a pillar, with motors."""
    scene = Scene(model="solver")
    scene.add("floor", plane={})
    scene.add("upper", box={"size": (0.5, 0.08, 0.08)}, position=(0.25, 0, 1.0), mass=2.0)
    scene.add("lower", box={"size": (0.4, 0.06, 0.06)}, position=(0.7, 0, 1.0), mass=1.0)
    motor = {"position_deg": 0.0, "max_force": 80.0}
    limits = (-120, 120)
    scene.join("shoulder", "hinge", "upper", anchor=(0, 0, 1), axis=(0, 1, 0), limits_deg=limits, motor=motor)
    scene.join("elbow", "hinge", "lower", "upper", anchor=(0.5, 0, 1), axis=(0, 1, 0), limits_deg=limits, motor=motor)
    return scene


def after(session: Session, seconds: float) -> None:
    session.step(session.simulator.steps_in(seconds))


@pytest.fixture
def session() -> Session:
    made = Session(Simulator(tabletop()))
    after(made, 0.5)
    return made


# --- hands ---


def test_a_dragged_body_follows_the_pointer_by_the_point_that_was_taken(session):
    cube = session.simulator["cube"]
    corner = np.add(cube.centre, 0.05)
    session.grab("cube", corner)
    for k in range(60):
        session.drag("cube", corner + np.array([-0.4, 0.0, 0.3]) * (k + 1) / 60)
        after(session, 1 / 60)
    after(session, 2.0)
    # It hangs from the corner, below the pointer: held by just its weight.
    grip = cube.centre + pose.rotate(cube.quat_xyzw, session.hands["cube"].grip)
    np.testing.assert_allclose(grip, np.add(corner, (-0.4, 0.0, 0.3)), atol=2e-3)
    np.testing.assert_allclose(cube.centre[:2], grip[:2], atol=5e-3)
    assert grip[2] - cube.centre[2] == pytest.approx(0.05 * np.sqrt(3), rel=0.02)
    assert np.linalg.norm(cube.velocity) < 0.02
    height = cube.centre[2]
    session.release("cube")
    before, seconds = session.simulator.si_state().time, 0.1
    after(session, seconds)
    seconds = session.simulator.si_state().time - before
    assert height - cube.centre[2] == pytest.approx(0.5 * 9.81 * seconds**2, rel=0.1)
    assert session.hands == {} and session.simulator.now.load is None


def test_the_spring_is_as_strong_as_the_body_is_heavy():
    """Both follow alike; against a wall, both press with the same number of weights."""
    ways = []
    for mass in (0.2, 20.0):
        scene = Scene(model="solver").add("floor", plane={}, friction=0.5)
        scene.add("cube", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 0.1), mass=mass)
        session = Session(Simulator(scene))
        after(session, 0.2)
        session.grab("cube", (0, 0, 0.15), (0.5, 0, 0.6))
        after(session, 0.4)
        ways.append(session.simulator["cube"].centre)
        session.drag("cube", (0, 0, -50))
        after(session, 0.5)
        force = sum(contact.force[2] for contact in session.simulator.contact_points())
        ways[-1] = np.r_[ways[-1], force / (9.81 * mass)]
    np.testing.assert_allclose(ways[0], ways[1], rtol=0.05, atol=0.01)
    assert 3.0 < ways[0][3] < 14.0  # the most, and the body's own weight


def test_a_key_turns_a_body_and_it_is_held_so_until_it_is_let_go(session):
    cube = session.simulator["cube"]
    session.grab("cube", cube.centre, np.add(cube.centre, (-0.3, 0, 0.3)))
    after(session, 0.5)
    for _ in range(6):
        session.turn("cube", (0, 0, 1), np.radians(15))
        after(session, 0.1)
    after(session, 1.0)
    turned = pose.to_rotvec(cube.quat_xyzw)
    np.testing.assert_allclose(turned, (0, 0, np.pi / 2), atol=0.02)
    session.release("cube")
    session.hold("cube", held=True)
    place = cube.centre
    session.push("cube", cube.centre, (1, 0, 0))
    after(session, 2.0)
    np.testing.assert_allclose(cube.centre, place, atol=2e-3)
    session.hold("cube", held=False)
    after(session, 0.3)
    assert cube.centre[2] < place[2] - 0.2


def test_a_link_of_a_robot_is_dragged_against_its_motors_and_sliders_set_their_targets():
    session = Session(Simulator(arm()))
    session.target("elbow", 1.0)
    after(session, 1.5)
    assert session.simulator.joint("elbow").angle == pytest.approx(1.0, abs=0.05)
    tip = session.simulator["lower"].centre
    for joint in ("elbow", "shoulder"):
        session.simulator.joint(joint).target = None
    session.grab("lower", tip, np.add(tip, (-0.2, 0, 0.4)))
    after(session, 2.0)
    assert np.linalg.norm(session.simulator["lower"].centre - tip - (-0.2, 0, 0.4)) < 0.1
    assert session.look(*session.seen_since(0.5)) == []


def test_a_network_that_takes_no_forces_is_dragged_by_velocities():
    scene = Scene().add("floor", plane={}).add("cube", box={"size": (0.3, 0.3, 0.3)}, position=(0, 0, 0.15))
    session = Session(Simulator(scene, "gnn"))
    session.step(3)
    cube = session.simulator["cube"]
    session.grab("cube", cube.centre, (0.5, 0, 0.9))
    after(session, 1.5)
    np.testing.assert_allclose(cube.centre, (0.5, 0, 0.9), atol=0.05)
    session.release("cube")
    after(session, 0.2)
    assert cube.centre[2] < 0.9


def test_a_thrown_ball_hits_what_was_clicked_and_a_push_gives_a_speed(session):
    origin = np.array([1.5, -2.0, 1.5])
    aim = session.simulator["cube"].centre
    name = session.throw(origin, aim - origin)
    dt, hit = session.simulator.dt, False
    still = session.simulator["cube"].centre
    for _ in range(session.simulator.steps_in(1.0)):
        session.step()
        names = [(c.first, c.second) for c in session.simulator.contact_points()]
        hit |= any({name, "cube"} == set(pair) for pair in names)
    assert hit and dt > 0.0
    assert np.linalg.norm(session.simulator["cube"].centre - still) > 0.05
    session.reset()
    assert [body.name for body in session.simulator.scene.bodies] == ["floor", "table", "cup", "cube"]
    cup = session.simulator["cup"]
    session.push("cup", cup.centre, (3.0, 0, 0))
    assert cup.velocity[0] == pytest.approx(1.5 * np.sqrt(9.81 * session.size("cup")))
    for name, act in (("table", session.push), ("floor", session.grab)):
        with pytest.raises(SdfsimError, match=f"{name}.*is static, so it cannot be moved"):
            act(name, (0, 0, 0), (1, 0, 0))


# --- time ---


def test_a_reset_restores_the_start_bit_for_bit_whatever_was_done(session):
    session.reset()
    start = session.simulator.state
    after(session, 0.3)
    wanted = session.simulator.state
    session.set("cube", "friction", 0.0)
    session.set("cup", "mass", 2.0)
    session.throw((1, 1, 1), (-1, -1, -0.3))
    session.delete("cup")
    after(session, 0.3)
    session.reset()
    arrays, wanted_arrays = session.simulator.state.arrays(), start.arrays()
    assert all(np.array_equal(arrays[name], wanted_arrays[name]) for name in wanted_arrays)
    assert session.simulator["cube"].friction == 0.7 and session.simulator["cup"].mass == pytest.approx(0.4)
    after(session, 0.3)
    assert same(session.simulator.state, wanted)


def test_one_goes_back_exactly_and_on_from_there():
    session = Session(Simulator(tabletop()))
    states = {}
    for _ in range(30):
        states[round(session.simulator.si_state().time, 6)] = session.simulator.state
        session.step(session.simulator.steps_in(0.05))
    when = session.back(0.8)
    near = min(states, key=lambda t: abs(t - when))
    if abs(near - when) < 1e-6:
        assert same(session.simulator.state, states[near])
    now = session.simulator.si_state().time
    session.step(7)
    first = session.simulator.state
    session.back(session.simulator.si_state().time - now)
    assert session.simulator.si_state().time == now
    session.step(7)
    assert same(session.simulator.state, first)


def test_time_passes_as_fast_as_it_should_and_none_is_left_out():
    session = Session(Simulator(tabletop()))
    session.playing, dt = True, session.simulator.dt
    steps = [session.advance(0.011) for _ in range(100)]
    assert sum(steps) == pytest.approx(1.1 / dt, abs=2)
    session.set_speed(0.25)
    slow = sum(session.advance(0.011) for _ in range(100))
    assert slow == pytest.approx(0.25 * sum(steps), abs=2)
    rollout = session.recording.rollout
    np.testing.assert_allclose(np.diff(rollout.time), dt)
    session.pause()
    assert session.advance(1.0) == 0


def test_the_thread_keeps_to_real_time_and_runs_commands_between_steps():
    seen = []
    session = Session(Simulator(tabletop()), on_step=lambda simulator: seen.append(simulator.si_state().time))
    session.begin()
    session.call(lambda: session.pause(paused=False))
    time.sleep(1.0)
    now = session.call(lambda: session.simulator.si_state().time)
    assert 0.02 < now < 1.5  # of a second, beside other programs
    with pytest.raises(SdfsimError, match="no body 'nobody'"):
        session.call(session.grab, "nobody", (0, 0, 0))
    session.close()
    np.testing.assert_allclose(np.diff(seen), session.simulator.dt, atol=1e-12)


# --- laws ---


def test_a_broken_law_is_named_and_a_hand_is_not_one(session):
    session.grab("cube", session.simulator["cube"].centre, (-0.4, 0, 1.2))
    after(session, 1.5)
    assert session.look(*session.seen_since(0.0)) == []
    scene, motion, pulled = session.seen_since(0.0)
    cup = [body.name for body in scene.bodies].index("cup")
    sunk = motion.position.copy()
    sunk[:, cup, 2] -= 0.03  # into the table
    lines = session.look(scene, Rollout(**{**vars(motion), "position": sunk}), pulled)
    assert any(line.startswith("overlap") and "'cup'" in line for line in lines)
    for line in lines:
        session._tell(line)
    assert session.look(scene, Rollout(**{**vars(motion), "position": sunk}), pulled) == []  # said already


def test_an_impossible_state_pauses_and_is_told(session):
    session.playing = True
    session.simulator["cube"].velocity = (1e9, 0, 0)
    session.step()
    assert not session.playing and "too fast" in session.broken[-1]
    session.reset()
    session.step()


def chances(session: Session, rng: np.random.Generator) -> dict:
    """What a person may do next to a body by chance."""
    names = [body.name for body in session.simulator.scene.bodies if body.motion == "dynamic"]
    name, at = str(rng.choice(names)), rng.normal(size=3) * (0.3, 0.2, 0.1) + (0, 0, 0.7)
    return {  # each is run before the next round
        "grab": lambda: session.grab(name, session.simulator[name].centre + rng.normal(size=3) * 0.03, at),
        "drag": lambda: session.drag(name, at),
        "release": lambda: session.release(name),
        "turn": lambda: session.turn(name, rng.normal(size=3), rng.normal()),
        "hold": lambda: session.hold(name, held=bool(rng.random() < 0.5)),
        "push": lambda: session.push(name, session.simulator[name].centre, rng.normal(size=3)),
        "throw": lambda: session.throw(
            np.add(rng.normal(size=3), (0, 0, 2.0)), np.add(rng.normal(size=3), (0, 0, -1.0))
        ),
        "friction": lambda: session.set(name, "friction", float(rng.uniform(0, 1.2))),
        "restitution": lambda: session.set(name, "restitution", float(rng.uniform(0, 0.9))),
        "mass": lambda: session.set(name, "mass", float(rng.uniform(0.1, 2.0))),
        "back": lambda: session.back(float(rng.uniform(0, 1.0))),
        "reset": session.reset,
        "copy": lambda: len(names) < 8 and session.copy(name),
        "delete": lambda: len(names) > 2 and session.delete(name),
    }


def test_random_commands_end_without_an_error_or_an_unreported_broken_law():
    rng, session = np.random.default_rng(5), Session(Simulator(tabletop()))
    session.playing = True
    for k in range(1000):
        acts = chances(session, rng)
        rare = ("throw", "back", "reset", "copy", "delete", "mass", "hold")
        weights = np.array([0.2 if act in rare else 1.0 for act in acts])
        if rng.random() < 0.2:
            acts[str(rng.choice(list(acts), p=weights / weights.sum()))]()
        session.step(2)
        if k % 100 == 99:
            for line in session.look(*session.seen_since(session.simulator.si_state().time - 1.0)):
                session._tell(line)
    assert session.broken == []
    assert np.isfinite(session.simulator.si_state().position).all()


# --- the scene ---


def test_added_bodies_lie_free_and_uploaded_meshes_become_bodies(session, tmp_path):
    spot = (0.0, 0.1, 0.55)
    names = [session.add("box", spot, box={"size": (0.1, 0.1, 0.1)}) for _ in range(3)]
    assert names == ["box", "box 2", "box 3"]
    names.append(session.add("ring", spot, asset=Path("samples/shapes/ring"), wanted=0.12))
    assert session.size("ring") == pytest.approx(0.12)
    file = tmp_path / "wedge.obj"
    corners = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1) if not (x and z)]
    from scipy.spatial import ConvexHull

    hull = ConvexHull(np.array(corners))
    outward = [(s if np.dot(np.cross(*(hull.points[s[1:]] - hull.points[s[0]])), q[:3]) > 0 else s[::-1])
               for s, q in zip(hull.simplices, hull.equations, strict=True)]  # fmt: skip
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f {} {} {}".format(*(f + 1)) for f in outward]
    file.write_text("\n".join(lines))
    names.append(session.add("wedge", (0.3, 0.1, 0.55), mesh=file, sdf="mesh"))
    names.append(session.copy("cup"))
    after(session, 1.0)
    assert session.look(*session.seen_since(0.0)) == []
    session.delete("box 2")
    after(session, 0.2)
    assert {"box", "box 3", "ring", "wedge", "cup copy"} <= {body.name for body in session.simulator.scene.bodies}


def test_a_saved_scene_goes_on_as_it_was(session, tmp_path):
    session.push("cube", session.simulator["cube"].centre, (0, 1, 0.5))
    session.set("cup", "friction", 0.3)
    after(session, 0.05)
    file = session.save_scene(tmp_path / "out")
    scene = load_scene(file)
    assert [body.friction for body in scene.bodies if body.name == "cup"] == [0.3]
    again = Simulator(scene)
    np.testing.assert_allclose(again.si_state().position, session.simulator.si_state().position, atol=1e-12)
    np.testing.assert_allclose(again.si_state().velocity, session.simulator.si_state().velocity, atol=1e-12)
    again.step(20)
    session.step(20)
    np.testing.assert_allclose(again.si_state().position, session.simulator.si_state().position, atol=2e-3)


@pytest.mark.parametrize("sample", ["door", "ragdoll", "paddle", "cradle", "knocked_vase"])
def test_samples_are_saved_as_they_are(sample, tmp_path):
    session = Session(Simulator(sample))
    session.step(5)
    again = Simulator(load_scene(session.save_scene(tmp_path / "out")))
    np.testing.assert_allclose(again.si_state().position, session.simulator.si_state().position, atol=1e-9)
    again.step(3)
    session.step(3)
    np.testing.assert_allclose(again.si_state().position, session.simulator.si_state().position, atol=1e-3)


def test_a_saved_run_is_read_by_the_other_commands(tmp_path):
    session = Session(Simulator(tabletop()))
    after(session, 0.3)
    session.set("cube", "friction", 0.4)  # another scene: the run begins here
    session.push("cube", session.simulator["cube"].centre, (0, 1, 0))
    after(session, 0.5)
    out = session.save_run(tmp_path / "run")
    scene, rollout = read_run(out)
    assert rollout.time[0] == 0.0 and rollout.time[-1] == pytest.approx(0.5, abs=0.02)
    assert [body.friction for body in scene.bodies if body.name == "cube"] == [0.4]
    motions, known = load_recordings([out], None)
    assert len(motions) == 1 and len(known.bodies) == 4
    with pytest.raises(SdfsimError, match="not from an earlier `sdfsim play`"):
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "report.json").write_text("{}")
        session.save_run(tmp_path / "other")


def test_a_mesh_a_shape_a_room_and_a_robot_are_opened(tmp_path):
    assert [body.name for body in Simulator(opened("samples/shapes/can")).scene.bodies] == ["floor", "can"]
    robot = tmp_path / "robot.urdf"
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    box = '<collision><geometry><box size="0.1 0.1 0.3"/></geometry></collision>'
    link = f'<link name="{{0}}"><inertial><mass value="1"/>{inertia}</inertial>{box}</link>'
    limit = '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="3"/>'
    ends = '<parent link="base"/><child link="tip"/><origin xyz="0 0 0.4"/>'
    joint = f'<joint name="hinge" type="revolute">{ends}{limit}</joint>'
    robot.write_text(f'<robot name="r">{link.format("base")}{link.format("tip")}{joint}</robot>')
    session = Session(Simulator(opened(robot)))
    scene = session.simulator.scene
    session.grab("tip", session.simulator["tip"].centre, (0.3, 0, 0.5))
    after(session, 0.2)
    assert [joint.name for joint in scene.joints] == ["hinge"]
    (tmp_path / "room").mkdir()
    session.save_scene(tmp_path / "room")
    assert [body.name for body in Simulator(opened(tmp_path / "room")).scene.bodies] == [
        body.name for body in scene.bodies
    ]
    with pytest.raises(SdfsimError, match="neither a room"):
        opened(tmp_path)


def test_a_run_is_shown_in_a_page_of_its_own(tmp_path, monkeypatch):
    opened_pages = []
    monkeypatch.setattr("webbrowser.open", opened_pages.append)
    scene = tabletop().load()
    show(Simulator(scene).run(seconds=0.1), scene)
    (page,) = opened_pages
    assert "__VISER_EMBED_DATA__" in Path(page.removeprefix("file://")).read_text()
    with pytest.raises(SdfsimError, match="does not hold its scene"):
        show(Simulator(scene).run(seconds=0.1))
