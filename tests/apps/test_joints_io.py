"""Joints in files of other programs: imports and exports, judged by MuJoCo, PyBullet, OpenUSD and by hand. What an
MJCF file says is done or named."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import mujoco  # noqa: TID253
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.robots import judge
from sdfsim import Simulator, load_scene
from sdfsim.apps.export import export
from sdfsim.apps.import_robot import import_robot
from sdfsim.apps.play.saved import save_scene
from sdfsim.apps.recording import ends, marks
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import load_mesh, wavefront
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.collision_filter import contact_groups
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import CylinderSdf
from sdfsim.shape.parts import GREY
from sdfsim.simulate.looks import body_colors
from sdfsim.simulate.record import at_frame
from tests.helpers.command import run
from tests.helpers.mujoco_start import at_start

LINK = """
  <link name="{0}">
    <inertial><origin xyz="{2}" rpy="{3}"/><mass value="{1}"/>
      <inertia ixx="{4[0]}" ixy="0" ixz="0" iyy="{4[1]}" iyz="0" izz="{4[2]}"/></inertial>
    <collision><origin xyz="{5}" rpy="{6}"/><geometry>{7}</geometry></collision>
  </link>"""
# A row a link: mass, its centre and the turn of its principal axes, moments; place, turn and form of what touches.
LINKS = {
    "base": (4, "0 0 0.1", "0 0 0", (0.04, 0.05, 0.03), "0 0 0.1", "0 0 0", '<box size="0.2 0.2 0.2"/>'),
    "upper": (1.5, "0.02 0 0.2", "0.3 0.2 -0.4", (0.02, 0.021, 0.004), "0 0 0.2", "0 0 0",
              '<cylinder radius="0.04" length="0.36"/>'),
    "slide": (0.7, "0 0.1 0", "0 0 0", (0.002, 0.001, 0.002), "0 0.1 0", "1.5707963 0 0",
              '<capsule radius="0.03" length="0.1"/>'),
    "tip": (0.2, "0 0 0.05", "0 0 0", (0.0002, 0.0002, 0.0001), "0 0 0.05", "0 0 0", '<sphere radius="0.04"/>'),
}  # fmt: skip
ARM = (
    '<robot name="arm">'
    + "".join(LINK.format(name, *row) for name, row in LINKS.items())
    + """
  <link name="tool0"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0.01 0.02 0.25" rpy="0.1 -0.2 0.3"/><axis xyz="0 0.6 0.8"/>
    <limit lower="0.2" upper="1.4" effort="20" velocity="3"/><dynamics damping="0.3" friction="0.05"/></joint>
  <joint name="rail" type="prismatic"><parent link="upper"/><child link="slide"/>
    <origin xyz="0 0 0.4" rpy="0 0.5 0"/><axis xyz="0 1 0"/><limit lower="-0.1" upper="0.2" effort="5" velocity="1"/>
  </joint>
  <joint name="spin" type="continuous"><parent link="slide"/><child link="tip"/>
    <origin xyz="0 0.2 0" rpy="0 0 0.7"/><axis xyz="0 0 -2"/></joint>
  <joint name="end" type="fixed"><parent link="tip"/><child link="tool0"/><origin xyz="0 0 0.1"/></joint>
  <transmission name="t"><type>simple</type></transmission>
</robot>"""
)


def write(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def imported(file: Path, **options) -> tuple[Scene, dict]:
    out = file.with_name("scene.yaml")
    report = import_robot(file, out, **options)
    return load_scene(out), report


def inertia(scene: Scene, name: str) -> np.ndarray:
    """[3, 3] kg m^2 about the centre of mass, in the world as all is at the start."""
    body = next(body for body in scene.bodies if body.name == name)
    shape, turn = scene.shapes[body.shape], Rotation.from_quat(body.quat_xyzw).as_matrix()
    own = body.mass / shape.volume * body.scale**2 * shape.inertia if body.inertia is None else body.inertia
    return turn @ own @ turn.T


def theirs(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
    """The same by MuJoCo."""
    principal = data.body(name).ximat.reshape(3, 3)
    return principal @ np.diag(model.body(name).inertia) @ principal.T


def mujoco_of(text: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    return spec.compile()


def test_urdf_has_the_poses_masses_and_inertias_that_mujoco_has(tmp_path: Path) -> None:
    file = write(tmp_path, "arm.urdf", ARM)
    scene, _ = imported(file, fixed=True)
    found = judge(file, scene, tries=10)
    assert found.links == 3 and max(found.apart, found.turned, found.mass) < 1e-8
    model = mujoco_of(ARM)
    data = mujoco.MjData(model)
    data.joint("shoulder").qpos[0] = 0.2  # the start of the scene, to which inertias belong
    mujoco.mj_forward(model, data)
    for name in ("upper", "slide", "tip"):
        assert inertia(scene, name) == pytest.approx(theirs(model, data, name), rel=1e-6, abs=1e-9)
    joints = {joint.name: joint for joint in scene.joints}
    assert joints["shoulder"].limits == pytest.approx((0.2, 1.4))
    assert (joints["shoulder"].damping, joints["shoulder"].friction) == pytest.approx((0.3, 0.05))
    assert joints["rail"].kind == "slider" and joints["rail"].limits == pytest.approx((-0.1, 0.2))
    assert joints["spin"].kind == "hinge" and joints["spin"].limits is None


def test_links_keep_their_colours_whether_they_move_or_not(tmp_path: Path) -> None:
    """Also where what is shown is what collides; a link without a colour is grey beside those that have one."""
    white = '<material name="white"><color rgba="1 1 1 1"/></material>'
    text = re.sub(
        r"<collision>(.*?)</collision>", rf"\g<0><visual>\g<1>{white}</visual>", ARM, count=2, flags=re.DOTALL
    )
    scene, _ = imported(write(tmp_path, "arm.urdf", text), fixed=True)
    colors = dict(zip((body.name for body in scene.bodies), body_colors(scene), strict=True))
    assert next(body for body in scene.bodies if body.name == "base").motion == "static"
    assert [colors[name] for name in ("base", "upper", "slide")] == [(255, 255, 255), (255, 255, 255), GREY]
    assert len(set(body_colors(imported(write(tmp_path / "plain", "arm.urdf", ARM), fixed=True)[0]))) > 2


def test_urdf_tells_what_it_leaves_out_and_what_it_made_otherwise(tmp_path: Path) -> None:
    scene, report = imported(write(tmp_path, "arm.urdf", ARM), fixed=True)
    assert [body.name for body in scene.bodies] == ["base", "upper", "slide", "tip"]
    assert scene.bodies[0].motion == "static"
    assert "<transmission> (1)" in report["left_out"]
    assert any("velocity of <limit>" in line for line in report["left_out"])
    (frame,) = (frame for frame in scene.frames if frame.name == "tool0")
    assert scene.bodies[frame.body].name == "tip" and frame.position[2] == pytest.approx(0.05)  # the ball is at 0.05
    assert any("shoulder starts at 0.2 rad" in line for line in report["notes"])


def test_links_that_overlap_avoid_each_other_and_nothing_else(tmp_path: Path) -> None:
    """A joint keeps its links apart by itself; what is added to a robot touches all of it."""
    free, _ = imported(write(tmp_path / "free", "arm.urdf", ARM), fixed=True)
    assert [body.collides_with for body in free.bodies] == [None] * 4
    thick = ARM.replace('<cylinder radius="0.04" length="0.36"/>', '<cylinder radius="0.3" length="0.7"/>')
    file = write(tmp_path / "crossed", "arm.urdf", thick)
    _, report = imported(file, fixed=True)
    assert any("overlap" in line and "upper and tip" in line for line in report["notes"])
    more = (
        SceneBuilder.read(file.with_name("scene.yaml")).add("ball", sphere={"radius": 0.1}, position=(0, 0, 3)).load()
    )
    group, allowed = contact_groups(more.bodies)
    row = {body.name: g for body, g in zip(more.bodies, group, strict=True)}
    assert not allowed[row["upper"], row["tip"]] and allowed[row["base"], row["tip"]]
    assert all(allowed[row["ball"], row[name]] for name in ("base", "upper", "slide", "tip"))


def test_a_urdf_with_efforts_can_be_driven_and_is_limp_until_then(tmp_path: Path) -> None:
    file = write(tmp_path, "arm.urdf", ARM)
    scene, _ = imported(file, fixed=True)
    shoulder = next(joint for joint in scene.joints if joint.name == "shoulder")
    assert shoulder.motor is not None and shoulder.motor.max_force == pytest.approx(20.0)
    assert shoulder.motor.position is None and shoulder.motor.speed is None
    limp, driven = Simulator(scene), Simulator(scene)
    driven.joint("shoulder").max_force = 5000.0
    driven.joint("shoulder").target = 0.8
    for sim in (limp, driven):
        sim.step(sim.steps_in(1.5))
    assert driven.joint("shoulder").angle == pytest.approx(0.8, abs=1e-3)
    assert abs(limp.joint("shoulder").angle - 0.8) > 0.05


ACTUATED = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1"><geom type="box" size=".1 .1 .1" mass="3"/>
      <body name="a" pos="0 0 .2"><joint name="ja" axis="0 1 0" range="10 90" limited="true"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
        <body name="b" pos=".3 0 0"><joint name="jb" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/>
          <body name="c" pos=".3 0 0"><joint name="jc" type="slide" axis="1 0 0"/>
            <geom type="box" size=".02 .02 .02" mass=".1"/></body></body></body>
    </body>
  </worldbody>
  <actuator>
    <position name="pa" joint="ja" kp="50" kv="5" gear="2"/>
    <motor name="mb" joint="jb" gear="-30" ctrlrange="-0.5 0.5" ctrllimited="true"/>
    <velocity name="vc" joint="jc" kv="7" forcerange="-3 3" forcelimited="true"/>
  </actuator>
</mujoco>
"""


def test_actuators_of_an_mjcf_become_motors_as_strong_as_theirs(tmp_path: Path) -> None:
    scene, report = imported(write(tmp_path, "robot.xml", ACTUATED))
    motors = {joint.name: joint.motor for joint in scene.joints}
    assert motors["ja"].position == pytest.approx(np.radians(10)) and motors["ja"].time == pytest.approx(0.1)
    assert (motors["jb"].max_force, motors["jb"].position, motors["jb"].speed) == (pytest.approx(15.0), None, None)
    assert (motors["jc"].max_force, motors["jc"].speed) == (pytest.approx(3.0), 0.0)
    # Torques at the joint: a gear of 2 multiplies both the place that the actuator sees and its force.
    assert (motors["ja"].gain, motors["jc"].gain) == (pytest.approx(200.0), pytest.approx(7.0))
    told = "\n".join(report["notes"])
    assert "bodies without a joint to the world stand still" in told and "base" in told
    assert "motors do nothing until an effort or a target of their joint is set (1: mb)" in told
    assert "actuators without a force limit get one of 1e+06 (1: pa)" in told
    assert next(body for body in scene.bodies if body.name == "base").motion == "static"
    sim = Simulator(scene)
    sim.joint("jb").target = 0.5
    sim.step(5)
    assert sim.joint("jb").speed > 0.1


def servos(armature: float) -> str:
    """An arm of seven links, light at its end, with servos as stiff as those of a real one."""
    bodies, ends, actuators = "", "", ""
    rows = [(3, 4500), (2.5, 4500), (2, 3500), (2, 3500), (2, 2000), (1, 2000), (0.1, 2000)]
    for k, (mass, kp) in enumerate(rows):
        axis = "0 0 1" if k in (0, 2, 4) else "0 1 0"
        bodies += (
            f'<body name="l{k}" pos="0.03 0 .15"><joint name="j{k}" axis="{axis}" range="-2.9 2.9" damping="1" '
            f'armature="{armature}"/><geom type="capsule" fromto="0 0 0 0 0 .1" size=".04" mass="{mass}" '
            'contype="0" conaffinity="0"/>'
        )
        ends += "</body>"
        actuators += (
            f'<general joint="j{k}" biastype="affine" gainprm="{kp}" biasprm="0 -{kp} -{kp // 10}" '
            f'forcerange="-{87 if k < 4 else 12} {87 if k < 4 else 12}"/>'
        )
    start = "0.1 0.6 -0.3 0.8 0.2 0.5 0.4"
    return f"""<mujoco><compiler autolimits="true" angle="radian"/><option integrator="implicitfast"/>
      <worldbody>{bodies}{ends}</worldbody><actuator>{actuators}</actuator>
      <keyframe><key name="start" qpos="{start}" ctrl="{start}"/></keyframe></mujoco>"""


def in_mujoco(file: Path, seconds: float) -> tuple[np.ndarray, int]:
    """Positions of joints at the end, and how often a motor's force changes its sign by more than a thousandth of the
    largest force."""
    model, data = at_start(file)
    forces = []
    while data.time < seconds:
        mujoco.mj_step(model, data)
        forces.append(data.actuator_force.copy())
    force = np.array(forces)
    sign = np.sign(np.where(np.abs(force) > 1e-3 * np.abs(force).max(), force, 0.0))
    return data.qpos.copy(), int((sign[1:] * sign[:-1] < 0).sum())


@pytest.mark.parametrize("armature", [0.1, 0.001])
def test_a_robot_with_stiff_servos_moves_alike_here_and_after_its_export(tmp_path: Path, armature: float) -> None:
    """All three sag by the same angles; MuJoCo's motors do not chatter."""
    source = write(tmp_path, "robot.xml", servos(armature))
    scene, _ = imported(source)
    export(tmp_path / "scene.yaml", tmp_path / "out.xml")
    (own, _), (exported, chatter) = in_mujoco(source, 2.0), in_mujoco(tmp_path / "out.xml", 2.0)
    sim = Simulator(scene)
    start = np.array([sim.joint(f"j{k}").angle for k in range(7)])
    sim.step(sim.steps_in(2.0))
    here = np.array([sim.joint(f"j{k}").angle for k in range(7)])
    assert np.abs(own - start).max() > 1e-3
    assert exported == pytest.approx(own, abs=1e-5) and here == pytest.approx(own, abs=1e-5)
    assert chatter <= 20


def test_motors_of_every_kind_move_alike_after_their_export(tmp_path: Path) -> None:
    scene = SceneBuilder(gravity=(0, 0, -9.81))
    motors = {
        "goes": ("hinge", {"position_deg": 40, "max_force": 60}),
        "quick": ("hinge", {"position_deg": 40, "max_force": 60, "time": 0.02}),
        "soft": ("hinge", {"position_deg": 40, "max_force": 60, "gain": 30, "time": 0.2}),
        "turns": ("hinge", {"speed": 2, "max_force": 60}),
        "drags": ("hinge", {"speed": 2, "max_force": 60, "gain": 5}),
        "lifts": ("slider", {"position": 0.2, "max_force": 60, "gain": 400, "time": 0.1}),
    }
    for k, (name, (kind, motor)) in enumerate(motors.items()):
        scene.add(name, box={"size": (0.3, 0.05, 0.05)}, position=(0.15, k, 2), mass=1.0, collides_with=[])
        axis = (0, 0, 1) if kind == "slider" else (0, 1, 0)
        scene.join(f"of {name}", kind, name, anchor=(0, k, 2), axis=axis, motor=motor)
    export(scene.save(tmp_path / "scene.yaml"), tmp_path / "out.xml")
    there, _ = in_mujoco(tmp_path / "out.xml", 2.0)
    sim = Simulator(load_scene(tmp_path / "scene.yaml"))
    sim.step(sim.steps_in(2.0))
    joints = [sim.joint(f"of {name}") for name in motors]
    here = [j.position if kind == "slider" else j.angle for j, (kind, _) in zip(joints, motors.values(), strict=True)]
    assert here == pytest.approx(there.tolist(), abs=0.02)


TURNS = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
  <inertia ixx=".01" iyy=".01" izz=".01"/></inertial><visual><geometry><box size=".3 .1 .1"/></geometry></visual></link>
  <joint name="pin" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <limit lower="{}" upper="{}" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize(("low", "high", "start"), [(0, 6.2832, 0), (-6.2832, 0, 0), (7, 9, 7), (-0.1, 12, 0)])
def test_a_urdf_s_joints_start_at_zero_or_the_limit_next_to_it(tmp_path: Path, low: float, high: float, start: float):
    """Its links are only seen: nothing in the scene can touch anything."""
    scene, _ = imported(write(tmp_path, "r.urdf", TURNS.format(low, high)))
    sim = Simulator(scene)
    sim.step(10)
    assert sim.joint("pin").angle == pytest.approx(start, abs=1e-4)


def test_limits_of_zero_and_zero_are_told(tmp_path: Path) -> None:
    _, report = imported(write(tmp_path, "r.urdf", TURNS.format(0, 0)))
    assert any("joint pin" in line and "lock" in line for line in report["notes"])


def test_an_mjcf_hinge_of_more_than_a_turn_falls_as_in_mujoco(tmp_path: Path) -> None:
    text = """<mujoco><compiler angle="degree" autolimits="true"/><worldbody><body pos="0 0 1">
      <joint name="pin" axis="0 1 0" range="0 400" damping=".3"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/></body></worldbody></mujoco>"""
    scene, _ = imported(write(tmp_path, "pin.xml", text))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    while data.time < 6.0:
        mujoco.mj_step(model, data)
    sim = Simulator(scene)
    sim.step(sim.steps_in(6.0))
    assert sim.joint("pin").angle == pytest.approx(data.qpos[0], abs=0.01)
    export(tmp_path / "scene.yaml", tmp_path / "out.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml")).key_qpos[0] == pytest.approx([0.0], abs=1e-9)


def test_what_other_readers_pass_over_is_passed_over(tmp_path: Path) -> None:
    text = "\n \n" + ARM.replace('xyz="0.01 0.02 0.25"', 'xyz="$(optenv NO_SUCH_VARIABLE 0.01 0.02 0.25)"')
    (tmp_path / "arm.urdf").write_bytes(text.encode() + b"\n\0")
    scene, _ = imported(tmp_path / "arm.urdf", fixed=True)
    plain, _ = imported(write(tmp_path / "plain", "arm.urdf", ARM), fixed=True)
    for one, other in zip(scene.bodies, plain.bodies, strict=True):
        assert one.position == pytest.approx(other.position, abs=1e-12)
    (tmp_path / "arm.urdf").write_text(text.replace("</robot>", "</robt>"))
    with pytest.raises(SdfsimError, match=rf"arm\.urdf:{text.count(chr(10)) + 1}: not valid XML"):
        import_robot(tmp_path / "arm.urdf", tmp_path / "scene.yaml")


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [
        ("gb2312", "GB2312"), ("shift_jis", "Shift_JIS"), ("utf-16", "utf-16"), ("utf-32", ""), ("utf-8-sig", "utf-8"),
        ("utf-8", "utf-16"), ("utf-8", ""),
    ],
)  # fmt: skip
@pytest.mark.parametrize("before", ["", "\n  "])
def test_a_urdf_is_read_in_any_encoding(tmp_path: Path, encoding: str, declared: str, before: str) -> None:
    text = f'<?xml version="1.0" encoding="{declared}"?>\n' if declared else ""
    text = before + text + ARM.replace('name="tip"', 'name="\u5de5\u5177"').replace('link="tip"', 'link="\u5de5\u5177"')
    (tmp_path / "arm.urdf").write_bytes(text.encode(encoding))
    scene, report = imported(tmp_path / "arm.urdf")
    assert [body.name for body in scene.bodies] == ["base", "upper", "slide", "\u5de5\u5177"]
    assert not any("bytes" in note for note in report["notes"])
    (tmp_path / "arm.urdf").write_bytes(text.replace('<axis xyz="0 0 -2"/>', '<axis xyz="0"/>').encode(encoding))
    line = text[: text.index('<axis xyz="0 0 -2"/>')].count("\n") + 1
    with pytest.raises(SdfsimError, match=rf"arm\.urdf:{line}: <axis> xyz must be 3 numbers"):
        import_robot(tmp_path / "arm.urdf", tmp_path / "scene.yaml")


def test_bytes_of_another_encoding_are_told_and_unknown_encodings_refused(tmp_path: Path) -> None:
    comment = "\n<!-- \u673a\u5668\u4eba -->".encode("gb2312")
    (tmp_path / "arm.urdf").write_bytes(ARM.encode().replace(b">", b">" + comment, 1))
    _, report = imported(tmp_path / "arm.urdf")
    assert "line 2 has bytes that are not utf-8: a mark replaces them, here and further on" in report["notes"]
    (tmp_path / "arm.urdf").write_text(f'<?xml version="1.0" encoding="klingon"?>{ARM}')
    with pytest.raises(SdfsimError, match=r"arm\.urdf:1: unknown encoding 'klingon'"):
        import_robot(tmp_path / "arm.urdf", tmp_path / "scene.yaml")


def test_a_floor_carries_only_what_touches(tmp_path: Path) -> None:
    """A visual that hangs far below, and a link without any geometry, for which a large ball stands in."""
    shown = '<link name="lamp"><inertial><mass value="0.1"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" '
    shown += 'izz="1e-3"/></inertial><visual><origin xyz="0 0 -3"/><geometry><sphere radius="0.1"/></geometry></visual>'
    shown += '</link><joint name="hang" type="continuous"><parent link="tip"/><child link="lamp"/></joint>'
    shown += '<link name="bare"><inertial><mass value="0.1"/><inertia ixx="9" ixy="0" ixz="0" iyy="9" iyz="0" izz="9"/>'
    shown += '</inertial></link><joint name="bar" type="continuous"><parent link="tip"/><child link="bare"/></joint>'
    scene, _ = imported(write(tmp_path, "arm.urdf", ARM.replace("</robot>", shown + "</robot>")), floor=True)
    base = next(body for body in scene.bodies if body.name == "base")
    assert base.position[2] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('<mass value="4"/>', '<mass value="four"/>', ":3: <mass> value must be a number (got 'four')"),
        ('type="revolute"', 'type="revolut"', "type must be one of revolute, continuous"),
        ('child link="upper"', 'child link="uper"', "no link is called 'uper' (did you mean 'upper'?)"),
        ('xyz="0 0.6 0.8"', 'xyz="0 0.6"', "<axis> xyz must be 3 numbers (got '0 0.6')"),
        ('child link="tool0"', 'child link="upper"', "held by two joints"),
        ("</robot>", "</robt>", "not valid XML (mismatched tag)"),
        ('<box size="0.2 0.2 0.2"/>', '<mesh filename="package://a/b.obj"/>', "no such file: package://a/b.obj"),
        ('<box size="0.2 0.2 0.2"/>', '<box size="0.2 -1 0.2"/>', "size must be above zero"),
        ('<box size="0.2 0.2 0.2"/>', "<cone/>", "must hold one of box, sphere"),
    ],
)
def test_faults_name_file_line_and_element(tmp_path: Path, old: str, new: str, told: str) -> None:
    file = write(tmp_path, "arm.urdf", ARM.replace(old, new))
    assert file.read_text() != ARM
    with pytest.raises(SdfsimError) as error:
        import_robot(file, tmp_path / "scene.yaml")
    assert (
        told in error.value.message and error.value.message.startswith(f"{file}:") and "\n" not in error.value.message
    )
    assert not (tmp_path / "scene.yaml").exists()


MJCF = """<mujoco model="crane">
  <compiler angle="degree" eulerseq="xyz" autolimits="true"/>
  <option gravity="0 0 -3.7"/>
  <default>
    <joint damping="0.2"/>
    <default class="arm"><geom type="capsule" size="0.03" density="700" friction="0.81"/>
      <joint damping="0.5"/></default>
  </default>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <body name="mast" pos="0 0 1" euler="10 20 30">
      <joint name="yaw" axis="0 0 1" range="-90 90" armature="0.1"/>
      <geom class="arm" fromto="0 0 0 0 0 0.5"/>
      <geom class="arm" fromto="0 0 0.5 0.3 0 0.5"/>
      <body name="boom" pos="0.3 0 0.5" axisangle="0 1 0 40" childclass="arm">
        <joint name="pitch" axis="0 1 0" range="-30 60" ref="10" stiffness="4" springref="20"/>
        <joint name="roll" axis="1 0 0" range="-45 45"/>
        <geom fromto="0 0 0 0.6 0 0"/>
        <body name="hook" pos="0.6 0 0" quat="0.8 0 0.6 0">
          <joint name="reel" type="slide" axis="0 0 1" range="-0.2 0.4" frictionloss="0.3"/>
          <geom type="box" size="0.05 0.04 0.03" pos="0 0 -0.1" euler="0 0 15" mass="0.4"/>
          <body name="load" pos="0 0 -0.2"><joint name="swing" type="ball"/><geom type="sphere" size="0.06"/></body>
        </body>
      </body>
    </body>
    <body name="crate" pos="1 1 0.2"><freejoint/><geom type="box" size="0.2 0.2 0.2" density="200"/></body>
  </worldbody>
  <contact><exclude body1="crate" body2="load"/></contact>
  <sensor><jointpos joint="yaw"/></sensor>
</mujoco>"""


def test_mjcf_has_the_poses_and_masses_that_mujoco_has(tmp_path: Path) -> None:
    file = write(tmp_path, "crane.xml", MJCF)
    scene, report = imported(file)
    found = judge(file, scene, tries=10)
    assert found.links == 5 and max(found.apart, found.turned, found.mass) < 1e-7
    model = mujoco.MjModel.from_xml_string(MJCF)
    bodies = {body.name: body for body in scene.bodies}
    small = [body for name, body in bodies.items() if name.startswith("boom_")]
    assert len(small) == 1 and small[0].mass == pytest.approx(0.02 * float(model.body("boom").mass[0]))
    joints = {joint.name: joint for joint in scene.joints}
    assert joints["yaw"].limits == pytest.approx((-math.pi / 2, math.pi / 2))
    assert (joints["pitch"].spring.stiffness, joints["pitch"].spring.rest) == pytest.approx((4.0, math.radians(20)))
    assert (joints["yaw"].damping, joints["roll"].damping, joints["reel"].friction) == pytest.approx((0.2, 0.5, 0.3))
    assert joints["swing"].kind == "ball"
    assert scene.gravity == pytest.approx([0, 0, -3.7])
    assert bodies["mast"].friction == pytest.approx(0.9)  # two of them: 0.81
    assert bodies["ground"].motion == "static"
    assert "sensors (1)" in report["left_out"] and not any("armature" in line for line in report["left_out"])
    assert [j.armature for j in scene.joints if j.armature] == [0.1]
    # Inertias are those of the whole links.
    data = mujoco.MjData(model)
    data.joint("pitch").qpos[0] = math.radians(10)
    mujoco.mj_forward(model, data)
    for name in ("mast", "hook"):
        assert inertia(scene, name) == pytest.approx(theirs(model, data, name), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (MJCF.replace('type="ball"', 'type="bal"'), r"bad\.xml:\d+: MuJoCo refuses it \(.*"),
        # As files are that other ones include: with defaults, assets or actuators alone.
        ('<mujoco><default><geom friction="1"/></default></mujoco>', r"bad\.xml: describes no bodies"),
    ],
)
def test_mjcf_that_mujoco_refuses_or_without_bodies_is_one_line_and_leaves_nothing(tmp_path, text, told) -> None:
    file = write(tmp_path, "bad.xml", text)
    with pytest.raises(SdfsimError, match=told) as error:
        import_robot(file, tmp_path / "scene.yaml")
    assert "\n" not in error.value.message and list(tmp_path.iterdir()) == [file]


def jointed() -> SceneBuilder:
    """A tree of every kind of joint with a start that is not zero, and a rope and a rod beside it."""
    scene = SceneBuilder().add("floor", plane={}, friction=0.7)
    scene.add("post", box={"size": [0.2, 0.2, 1.0]}, position=(0, 0, 0.5), motion="static", restitution=0.0)
    arm = {"box": {"size": [0.6, 0.06, 0.04]}, "restitution": 0.0}
    scene.add("arm", **arm, position=(0.45, 0, 0.8), euler_xyz_deg=(0, 15, 0), mass=2, angular_velocity=(0, 0.4, 0))
    scene.add("fore", **arm, position=(1.0, 0.1, 0.6), euler_xyz_deg=(10, 15, 30), mass=1)
    scene.add("bob", sphere={"radius": 0.08}, position=(1.4, 0.3, 0.4), mass=0.5, restitution=0.0)
    scene.add("kite", sphere={"radius": 0.05}, position=(1.4, 0.3, 1.4), mass=0.1, restitution=0.0)
    scene.add("cart", box={"size": [0.3, 0.2, 0.1]}, position=(0, 2, 0.3), mass=3, restitution=0.0)
    scene.add(
        "lid", box={"size": [0.3, 0.2, 0.02]}, position=(0, 2, 0.4), mass=0.3, inertia_factor=1.5, restitution=0.0
    )
    scene.join("shoulder", "hinge", "arm", "post", anchor=(0.15, 0, 0.85), axis=(0, 1, 0.1), start_deg=20,
               limits_deg=(-30, 70), damping=0.2, friction=0.1, spring={"stiffness": 3, "rest_deg": 10})  # fmt: skip
    scene.join("elbow", "hinge", "arm", "fore", anchor=(0.75, 0.0, 0.7), axis=(0, 0.2, 1), start_deg=-15)
    scene.join("wrist", "ball", "bob", "fore", anchor=(1.3, 0.25, 0.5), damping=0.01)
    scene.join("track", "slider", "cart", anchor=(0, 2, 0.3), axis=(1, 0, 0), start=0.1, limits=(-0.5, 1),
               motor={"position": 0.4, "max_force": 20, "time": 0.2})  # fmt: skip
    scene.join("weld", "fixed", "lid", "cart", anchor=(0, 2, 0.35))
    scene.join("string", "distance", "kite", "bob", anchor=(1.4, 0.3, 1.4), to=(1.4, 0.3, 0.4), rope=1.2)
    return scene


STARTS = {"shoulder": math.radians(20), "elbow": math.radians(-15), "track": 0.1}


@pytest.fixture
def crossed(tmp_path: Path) -> Scene:
    """That scene, read from `scene.yaml`."""
    return load_scene(jointed().save(tmp_path / "scene.yaml"))


def test_a_file_in_millimetres_moves_as_one_in_metres(tmp_path: Path) -> None:
    moved, lines = [], []
    for radius in (0.05, 0.0001):  # MuJoCo refuses the smaller one in metres
        scene = jointed().add("bead", sphere={"radius": radius}, position=(5, 0, 2))
        report = export(scene.save(tmp_path / "scene.yaml"), tmp_path / "out.xml")
        lines.append([line for line in report["left_out"] if "in mm" in line])
        model, data = at_start(tmp_path / "out.xml")
        mujoco.mj_step(model, data, 100)  # before anything touches
        names = [body.name for body in jointed().load().bodies] + ["bead"]
        moved.append([(data.body(name).xpos.copy(), data.body(name).xmat.copy()) for name in names[1:]])
    assert not lines[0] and len(lines[1]) == 1 and "bead" in lines[1][0] and "9810" in lines[1][0]
    for (place, turn), (finer, turned) in zip(*moved, strict=True):
        np.testing.assert_allclose(finer / 1000, place, atol=1e-9)
        np.testing.assert_allclose(turned, turn, atol=1e-9)


def in_the_world(scene: Scene, name: str) -> list:
    """What a joint is: its kind, what it holds, its place and axis in the world, and its numbers."""
    joint = next(joint for joint in scene.joints if joint.name == name)
    first = scene.bodies[joint.bodies[0]]
    turn = Rotation.from_quat(first.quat_xyzw)
    anchor = first.position + turn.apply(joint.anchor[0])
    axis = (turn * Rotation.from_quat(joint.quat_xyzw[0])).apply([1, 0, 0])
    held = {scene.bodies[k].name if k >= 0 else "world" for k in joint.bodies}
    numbers = [joint.damping, joint.friction, *(joint.limits or (0, 0)), joint.length or 0.0]
    numbers += [joint.spring.stiffness, joint.spring.rest] if joint.spring else [0, 0]
    motor = joint.motor
    numbers += [motor.max_force, motor.position or 0, motor.speed or 0, motor.time] if motor else [0, 0, 0, 0]
    return [joint.kind, held, anchor, axis if joint.kind in ("hinge", "slider") else np.zeros(3), np.array(numbers)]


def same_bodies(scene: Scene, other: Scene, names: list[str], *, moved: np.ndarray | None = None) -> None:
    for name in names:
        one, two = (next(b for b in s.bodies if b.name == name) for s in (scene, other))
        places = [
            b.position + Rotation.from_quat(b.quat_xyzw).apply(b.scale * s.shapes[b.shape].com)
            for b, s in ((one, scene), (two, other))
        ]
        assert places[0] == pytest.approx(places[1] if moved is None else places[1] + moved, abs=1e-8), name
        assert (one.motion, one.mass) == (two.motion, pytest.approx(two.mass, rel=1e-8)), name
        assert one.friction == pytest.approx(two.friction, rel=1e-6)
        if one.motion == "dynamic":
            assert inertia(scene, name) == pytest.approx(inertia(other, name), rel=1e-6, abs=1e-9), name


def test_exported_mjcf_has_the_same_joints_in_mujoco_and_comes_back_as_it_was(tmp_path: Path, crossed: Scene) -> None:
    report = export(tmp_path / "scene.yaml", tmp_path / "out.xml")
    model, data = at_start(tmp_path / "out.xml")
    for name, value in STARTS.items():
        # The elbow has the arm first, so MuJoCo's goes from the arm to the forearm about the other way of its axis.
        assert data.joint(name).qpos[0] == pytest.approx(value, abs=1e-9), name
    for body in crossed.bodies:
        shape = crossed.shapes[body.shape]
        assert data.body(body.name).xpos == pytest.approx(body.position, abs=1e-9)
        if body.motion == "dynamic":
            centre = body.position + Rotation.from_quat(body.quat_xyzw).apply(body.scale * shape.com)
            assert data.body(body.name).xipos == pytest.approx(centre, abs=1e-9)
    assert float(model.joint("shoulder").damping[0]) == pytest.approx(0.2)
    assert model.joint("shoulder").range == pytest.approx(np.radians([-30, 70]))
    assert data.ctrl[0] == pytest.approx(0.4) and model.actuator_forcerange[0] == pytest.approx([-20, 20])
    assert data.ten_length[0] == pytest.approx(1.0) and model.tendon_range[0] == pytest.approx([0, 1.2])
    assert not any("elbow" in line for line in report["left_out"])

    back, _ = imported(write(tmp_path / "back", "out.xml", (tmp_path / "out.xml").read_text()))
    for name in (joint.name for joint in crossed.joints if joint.name != "weld"):
        for one, two in zip(in_the_world(crossed, name), in_the_world(back, name), strict=True):
            if isinstance(one, np.ndarray):
                sign = -1.0 if name == "elbow" and np.allclose(one, -two, atol=1e-8) else 1.0
                assert one == pytest.approx(sign * two, abs=1e-8), name
            else:
                assert one == two, name
    assert sum(joint.kind == "fixed" for joint in back.joints) == 1
    same_bodies(crossed, back, [body.name for body in crossed.bodies if body.name != "floor"])
    fast = next(body for body in back.bodies if body.name == "arm")
    assert np.linalg.norm(fast.angular_velocity) > 0.3


def test_urdf_comes_back_as_it_was(tmp_path: Path, crossed: Scene) -> None:
    report = export(tmp_path / "scene.yaml", tmp_path / "out.urdf")
    assert any("string" in line and "distance" in line for line in report["left_out"])
    assert any("shoulder starts at" in line for line in report["left_out"])
    back, _ = imported(tmp_path / "out.cart.urdf")
    # The cart begins at zero, a tenth to the side.
    joints = {joint.name: joint for joint in back.joints}
    assert set(joints) == {"track", "weld"} and joints["track"].limits == pytest.approx((-0.5, 1.0))
    same_bodies(crossed, back, ["cart", "lid"], moved=np.array([0.1, 0, 0]))
    post = tmp_path / "out.post.urdf"
    model = mujoco_of(post.read_text())
    assert {model.joint(j).name for j in range(model.njnt)} >= {"shoulder", "elbow"}
    arm, _ = imported(post)
    kinds = {joint.name: joint.kind for joint in arm.joints}
    assert kinds == {"shoulder": "hinge", "elbow": "hinge", "wrist": "ball"}


def test_usd_joints_are_where_the_bodies_are(tmp_path: Path, crossed: Scene) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics

    export(tmp_path / "scene.yaml", tmp_path / "out.usda")
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    for joint in crossed.joints:
        prim = stage.GetPrimAtPath(f"/World/joints/{joint.name}")
        made = UsdPhysics.Joint(prim)
        frames = []
        for relation, place, turn in (
            (made.GetBody0Rel(), made.GetLocalPos0Attr(), made.GetLocalRot0Attr()),
            (made.GetBody1Rel(), made.GetLocalPos1Attr(), made.GetLocalRot1Attr()),
        ):
            targets, world = relation.GetTargets(), np.eye(4)
            if targets:
                xform = UsdGeom.Xformable(stage.GetPrimAtPath(targets[0]))
                world = np.array(xform.ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
            q = turn.Get()
            axes = Rotation.from_quat([*q.GetImaginary(), q.GetReal()]).as_matrix()
            frames.append((world[:3, :3] @ np.array(place.Get()) + world[:3, 3], world[:3, :3] @ axes))
        (here, one), (there, two) = frames
        change = Rotation.from_matrix(one.T @ two).as_rotvec()
        if joint.kind == "hinge":
            assert here == pytest.approx(there, abs=1e-6)
            assert change == pytest.approx([STARTS[joint.name], 0, 0], abs=1e-6)
        elif joint.kind == "slider":
            assert one.T @ (there - here) == pytest.approx([0.1, 0, 0], abs=1e-6)
        elif joint.kind == "distance":
            assert np.linalg.norm(here - there) == pytest.approx(1.0, abs=1e-6)
            assert UsdPhysics.DistanceJoint(prim).GetMaxDistanceAttr().Get() == pytest.approx(1.2)
        else:
            assert here == pytest.approx(there, abs=1e-6)
    hinge = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath("/World/joints/shoulder"))
    assert (hinge.GetLowerLimitAttr().Get(), hinge.GetUpperLimitAttr().Get()) == pytest.approx((-30, 70), abs=1e-4)
    drive = UsdPhysics.DriveAPI(hinge.GetPrim(), "angular")
    assert drive.GetStiffnessAttr().Get() == pytest.approx(math.radians(3)) and drive.GetTargetPositionAttr().Get() == (
        pytest.approx(10, abs=1e-4)
    )
    slider = UsdPhysics.DriveAPI(stage.GetPrimAtPath("/World/joints/track"), "linear")
    assert slider.GetMaxForceAttr().Get() == pytest.approx(20) and slider.GetTargetPositionAttr().Get() == (
        pytest.approx(0.4)
    )


def test_gltf_joints_are_where_the_bodies_are(tmp_path: Path, crossed: Scene) -> None:
    """By the metrics in the draft's appendix: of the connected node, seen from the node of the joint."""
    export(tmp_path / "scene.yaml", tmp_path / "out.glb")
    content = (tmp_path / "out.glb").read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    above = {child: k for k, node in enumerate(tree["nodes"]) for child in node.get("children", ())}

    def pose(k: int) -> tuple[np.ndarray, Rotation]:
        node = tree["nodes"][k]
        if "matrix" in node:  # the root
            return np.zeros(3), Rotation.identity()
        place, turn = pose(above[k])
        own = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1)))
        return place + turn.apply(node["translation"]), turn * own

    made = tree["extensions"]["KHR_physics_rigid_bodies"]["physicsJoints"]
    found = {}
    for k, node in enumerate(tree["nodes"]):
        if joint := node.get("extensions", {}).get("KHR_physics_rigid_bodies", {}).get("joint"):
            (here, one), (there, two) = pose(k), pose(joint["connectedNode"])
            told = made[joint["joint"]]
            found[told["name"]] = one.inv().apply(there - here), (one.inv() * two).as_rotvec(), told
            assert not joint["enableCollision"]
    assert set(found) == {joint.name for joint in crossed.joints}
    for name, (moved, turned, told) in found.items():
        for limit in told["limits"]:
            along, about = limit.get("linearAxes", []), limit.get("angularAxes", [])
            far = [moved[along[0]]] if len(along) == 1 else [np.linalg.norm(moved[along])] if along else turned[about]
            assert all(limit["min"] - 1e-6 <= value <= limit["max"] + 1e-6 for value in far), name
        if name in ("shoulder", "elbow", "track"):
            assert (turned + moved)[0] == pytest.approx(STARTS[name], abs=1e-6)
    shoulder, track, string = (found[name][2] for name in ("shoulder", "track", "string"))
    (swing,) = [limit for limit in shoulder["limits"] if limit.get("angularAxes") == [0]]
    assert (swing["min"], swing["max"]) == pytest.approx((math.radians(-30), math.radians(70)))
    spring, drag = shoulder["drives"]
    assert spring == {"type": "angular", "mode": "force", "axis": 0, "stiffness": 3.0,
                      "positionTarget": pytest.approx(math.radians(10))}  # fmt: skip
    assert (drag["velocityTarget"], drag["damping"]) == (0.0, 0.2)
    (motor,) = track["drives"]
    assert (motor["type"], motor["maxForce"], motor["positionTarget"]) == ("linear", 20.0, 0.4)
    assert string["limits"] == [{"linearAxes": [0, 1, 2], "min": 0.0, "max": pytest.approx(1.2)}]


def test_the_command_imports(tmp_path: Path) -> None:
    file = write(tmp_path, "arm.urdf", ARM)
    done = run("import", file, "-o", tmp_path / "scene.yaml", "--fixed", "--json")
    assert done.exit_code == 0, done.output
    assert load_scene(tmp_path / "scene.yaml").bodies[0].motion == "static"


def in_world(scene: Scene, body: int, points: np.ndarray) -> np.ndarray:
    """Points from a body's centre of mass in its axes, in the world at the start."""
    if body < 0:
        return points
    one = scene.bodies[body]
    turn = Rotation.from_quat(one.quat_xyzw)
    return one.position + turn.apply(points + one.scale * scene.shapes[one.shape].com)


def test_recordings_show_axes_and_limits_where_they_are(tmp_path: Path) -> None:
    scene = jointed().load()
    by_name = {joint.name: joint for joint in scene.joints}
    hinge = marks(scene, by_name["shoulder"])
    axis, arc, needle = (in_world(scene, m.body, m.strips[0]) for m in hinge)
    along = np.array([0, 1, 0.1]) / np.linalg.norm([0, 1, 0.1])
    anchor = np.array([0.15, 0, 0.85])
    assert (axis[1] - axis[0]) / np.linalg.norm(axis[1] - axis[0]) == pytest.approx(along)
    assert axis.mean(0) == pytest.approx(anchor)
    # The arc goes from the lower limit to the upper one, and the needle is at 20 of -30 to 70 degrees.
    points = arc[1:-1] - anchor
    turn = Rotation.from_rotvec(along * math.radians(50)).apply(points[0]) / np.linalg.norm(points[0])
    assert turn == pytest.approx((needle[1] - needle[0]) / np.linalg.norm(needle[1] - needle[0]))
    assert Rotation.from_rotvec(along * math.radians(100)).apply(points[0]) == pytest.approx(points[-1])
    slider = marks(scene, by_name["track"])
    way = in_world(scene, slider[0].body, slider[0].strips[0])
    assert way == pytest.approx(np.array([[-0.6, 2, 0.3], [0.9, 2, 0.3]]))  # it starts at 0.1 of -0.5 to 1
    place = np.array([[body.position for body in scene.bodies]])
    turns = np.array([[body.quat_xyzw for body in scene.bodies]])
    assert ends([by_name["string"]], place, turns, scene)[0, 0] == pytest.approx(
        np.array([[1.4, 0.3, 1.4], [1.4, 0.3, 0.4]])
    )


HAND = ARM.replace(
    '</joint>\n  <joint name="spin"',
    '<mimic joint="shoulder" multiplier="0.5" offset="-0.1"/></joint>\n  <joint name="spin"',
)
COUPLED = """<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/><geom size="0.1"/>
  <body name="a" pos="0.2 0 0"><joint name="ja" axis="0 1 0" ref="20" range="-60 60" limited="true"/>
    <geom type="box" size="0.05 0.05 0.1" pos="0 0 0.3"/><site name="tcp" pos="0 0 0.5" euler="0 30 0"/>
  <body name="b" pos="0 0 0.6"><joint name="jb" type="slide" axis="0 0 1"/><geom size="0.05"/>
  <body name="c" pos="0 0 0.3"><joint name="jc" type="ball"/><geom size="0.05" pos="0 0 0.1"/></body></body></body>
  </body></worldbody>
  <tendon><fixed name="t"><joint joint="ja" coef="2"/><joint joint="jb" coef="-1"/></fixed></tendon>
  <equality><joint joint1="jb" joint2="ja" polycoef="0.1 0.5 0 0 0"/><tendon tendon1="t"/></equality>
  <actuator><position joint="ja" kp="10" kv="1"/></actuator>
  <keyframe><key name="home" qpos="1 2 3 1 0 0 0 0.5 0.1 0.8 0.6 0 0"/><key name="zero"/></keyframe></mujoco>"""


def test_a_mimic_is_a_coupling_here_and_in_exports(tmp_path: Path) -> None:
    scene, _ = imported(write(tmp_path, "hand.urdf", HAND), fixed=True)
    (coupling,) = scene.couplings
    assert [scene.joints[j].name for j in coupling.joints] == ["rail", "shoulder"]
    assert (coupling.ratio, coupling.offset) == (0.5, -0.1)
    text = HAND.replace('offset="-0.1"', 'offset="0.05"')  # the other starts at its lower limit
    offset, _ = imported(write(tmp_path, "offset.urdf", text), fixed=True)
    rail, shoulder = (offset.joints[j] for j in coupling.joints)
    assert rail.start == pytest.approx(0.5 * shoulder.start + 0.05) != 0.0
    simulator = Simulator(offset)
    simulator.step()
    assert abs(simulator.joint("rail").speed) < 0.5
    for text, told in ((HAND.replace('joint="shoulder" mult', 'joint="rail" mult'), "rail cannot follow itself"),):
        with pytest.raises(SdfsimError, match=told):
            imported(write(tmp_path, "circle.urdf", text))
    export(scene, tmp_path / "back.urdf")
    (back,) = imported(next(tmp_path.glob("back*.urdf")), fixed=True)[0].couplings
    assert (back.ratio, back.offset) == (0.5, pytest.approx(-0.1))
    export(scene, tmp_path / "hand.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hand.xml"))
    data = mujoco.MjData(model)
    for angle in (0.2, 1.0):  # no violation where the coupling says
        data.joint("shoulder").qpos, data.joint("rail").qpos = angle, 0.5 * angle - 0.1
        mujoco.mj_forward(model, data)
        assert np.abs(data.efc_pos[: data.ne]).max() < 1e-9


def test_keyframes_sites_and_couplings_of_an_mjcf_are_those_of_mujoco(tmp_path: Path) -> None:
    scene, _ = imported(write(tmp_path, "robot.xml", COUPLED))
    simulator = Simulator(replace(scene, couplings=()))  # the keyframe is not where they hold
    simulator.reset(keyframe="home")
    _, data = at_start(mujoco.MjModel.from_xml_string(COUPLED))
    for name in "abc":
        np.testing.assert_allclose(simulator[name].centre, data.body(name).xipos, atol=1e-8)
    np.testing.assert_allclose(simulator.frame("tcp").position, data.site("tcp").xpos, atol=1e-8)
    np.testing.assert_allclose(
        np.abs(simulator.frame("c").quat_xyzw), np.abs(np.roll(data.body("c").xquat, -1)), atol=1e-8
    )
    assert simulator.joint("ja").target == pytest.approx(0.5)
    found = [(scene.joints[c.joints[0]].name, c.ratio, c.offset) for c in scene.couplings]
    assert found == [
        ("jb", 0.5, pytest.approx(0.1 - 0.5 * math.radians(20))),
        ("ja", 0.5, pytest.approx(math.radians(20))),
    ]


def moving_alike(simulator: Simulator, model: mujoco.MjModel, key: int) -> None:
    """Whether bodies a, b and c are and move as in MuJoCo's keyframe."""
    _, data = at_start(model, key)
    for name in "abc":
        speed = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body(name).id, speed, 0)
        np.testing.assert_allclose(simulator[name].centre, data.body(name).xipos, atol=1e-8)
        np.testing.assert_allclose(simulator[name].velocity, speed[3:], atol=1e-7)
        np.testing.assert_allclose(simulator[name].angular_velocity, speed[:3], atol=1e-7)
    assert simulator.joint("ja").target == pytest.approx(data.ctrl[0])


def test_keyframes_keep_velocities_targets_and_balls_here_in_exports_and_in_saved_scenes(tmp_path: Path) -> None:
    keys = 'qvel="1 -2 3 0.1 0.2 0.3 0.7 -0.4 3 2 1" ctrl="0.25"/>'
    text = re.sub(r"<equality>.*</equality>", "", COUPLED).replace('0.6 0 0"/>', '0.6 0 0" ' + keys)
    scene, report = imported(write(tmp_path, "robot.xml", text))
    assert not any("keyframe" in line for line in report["left_out"])
    simulator, theirs = Simulator(scene), mujoco.MjModel.from_xml_string(text)
    simulator.reset(keyframe="home")
    moving_alike(simulator, theirs, 0)
    export(tmp_path / "scene.yaml", tmp_path / "out.xml")
    out = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    moving_alike(simulator, out, out.key("home").id)
    turned = Simulator(scene)  # balls count from where bodies are when the scene is saved
    turned.joint("jc").quat_xyzw, turned.joint("ja").angle = (0.1, 0.7, -0.3, 0.5), 0.8
    with turned.record() as run:
        turned.step(1)
    file = save_scene(at_frame(scene, run.rollout), tmp_path / "saved")
    again = Simulator(load_scene(file))
    again.reset(keyframe="home")
    moving_alike(again, theirs, 0)


def test_armature_is_that_of_mujoco_in_the_mass_matrix_and_after_an_export(tmp_path: Path) -> None:
    text = COUPLED.replace('axis="0 1 0" ref', 'axis="0 1 0" armature="0.3" ref').replace(
        'type="ball"', 'type="ball" armature="0.02"'
    )
    text = text.replace('type="slide"', 'type="slide" armature="2"').replace("<freejoint/>", "")
    scene, _ = imported(write(tmp_path, "robot.xml", re.sub("<keyframe>.*</keyframe>", "", text)))
    export(tmp_path / "scene.yaml", tmp_path / "out.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    assert model.dof_armature == pytest.approx([0.3, 2, 0.02, 0.02, 0.02])
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, full, data.qM) if mujoco.__version__ < "3.4" else mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(Simulator(scene).mass_matrix()[:2, :2], full[:2, :2], atol=1e-9)
    assert np.trace(Simulator(scene).mass_matrix()) == pytest.approx(np.trace(full))


def test_a_tendon_of_coupled_joints_is_a_motor_of_the_one_they_follow(tmp_path: Path) -> None:
    """Fingers of a gripper under load, which MuJoCo holds by an equality and drives by a tendon."""
    text = """<mujoco><option timestep="0.0005"/><default><joint type="slide" axis="0 0 1" damping="2"/></default>
      <worldbody><body pos="0 0 1"><geom size=".01"/>
      <body pos="0 .1 0"><joint name="left"/><geom size=".02" mass=".2"/></body>
      <body pos="0 -.1 0"><joint name="right"/><geom size=".02" mass=".1"/></body></body></worldbody>
      <tendon><fixed name="both"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed></tendon>
      <equality><joint joint1="left" joint2="right" polycoef=".01 1 0 0 0" solref=".002 1"/></equality>
      <actuator><general tendon="both" gainprm="2" biastype="affine" biasprm=".3 -400 -4" forcerange="-50 50"/>
      </actuator><keyframe><key name="start" qpos=".01 0" ctrl="10"/></keyframe></mujoco>"""
    scene, report = imported(write(tmp_path, "gripper.xml", text))
    assert not any("actuator" in line or "tendon" in line for line in report["left_out"] if "soft" not in line)
    simulator = Simulator(replace(scene, step=0.001))
    model, data = at_start(mujoco.MjModel.from_xml_string(text))
    for time in (0.05, 0.05, 0.9):
        for _ in range(round(time / 0.0005)):
            mujoco.mj_step(model, data)
        simulator.step(simulator.steps_in(time))
        found = simulator.joint_positions
        assert found[0] - found[1] == pytest.approx(0.01, abs=1e-4)
        assert found == pytest.approx(data.qpos, abs=3e-4)


@pytest.mark.parametrize("up", ["X_UP", "Y_UP", "Z_UP"])
def test_a_robot_has_the_looks_of_its_collada_meshes(tmp_path: Path, up: str) -> None:
    """In a robot their axes are what they are, as in trimesh, MoveIt and RViz; else their up axis becomes z."""
    collada = pytest.importorskip("collada")
    file = collada.Collada()
    effect = collada.material.Effect("e", [], "lambert", diffuse=(1.0, 0.5, 0.0, 1.0))
    paint = collada.material.Material("m", "paint", effect)
    file.effects.append(effect)
    file.materials.append(paint)
    corners = np.array([[x, y, z] for x in (0, 100) for y in (0, 100) for z in (0, 100)], float)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                      [0, 6, 4], [1, 7, 3], [1, 5, 7]])  # fmt: skip
    places = collada.source.FloatSource("places", corners.ravel(), ("X", "Y", "Z"))
    shape = collada.geometry.Geometry(file, "g", "box", [places])
    inputs = collada.source.InputList()
    inputs.addInput(0, "VERTEX", "#places")
    shape.primitives.append(shape.createTriangleSet(faces.ravel(), inputs, "paint"))
    file.geometries.append(shape)
    used = collada.scene.GeometryNode(shape, [collada.scene.MaterialNode("paint", paint, inputs=[])])
    moved = collada.scene.Node("n", children=[used], transforms=[collada.scene.TranslateTransform(0, 0, 50)])
    file.scenes.append(scene := collada.scene.Scene("s", [moved]))
    file.assetInfo.upaxis, file.scene, file.assetInfo.unitname, file.assetInfo.unitmeter = up, scene, "mm", 0.001
    file.write(str(tmp_path / "box.dae"))
    mesh = '<geometry><mesh filename="box.dae"/></geometry>'
    text = f"""<robot name="r"><link name="one"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
      ixz="0" iyz="0"/></inertial><visual>{mesh}</visual><collision>{mesh}</collision></link></robot>"""
    scene = imported(write(tmp_path, "r.urdf", text))[0]
    shape = scene.shapes[0]
    np.testing.assert_allclose(shape.mesh.vertices.max(0), (0.1, 0.1, 0.15), atol=1e-9)
    theirs = pytest.importorskip("trimesh").load(tmp_path / "box.dae", force="mesh")
    np.testing.assert_allclose(
        shape.mesh.vertices.max(0), theirs.vertices.max(0) * (0.001 if theirs.extents.max() > 1 else 1)
    )
    # Of the file's box, its z goes from 50 to 150 mm, the others from 0 to 100.
    alone = load_mesh(tmp_path / "box.dae").vertices
    ends = {"X_UP": ((-0.1, -0.15, 0), (0, -0.05, 0.1)), "Y_UP": ((0, -0.15, 0), (0.1, -0.05, 0.1)),
            "Z_UP": ((0, 0, 0.05), (0.1, 0.1, 0.15))}  # fmt: skip
    np.testing.assert_allclose((alone.min(0), alone.max(0)), ends[up], atol=1e-9)
    assert shape.volume == pytest.approx(1e-3) and shape.skin is None
    assert (np.abs(np.subtract(scene.bodies[0].color, (255, 128, 0))) < 6).all()


def test_a_wheel_that_is_a_mesh_rolls_as_the_cylinder_that_it_is(tmp_path: Path) -> None:
    """Its axis along y and its middle beside its origin, as wheels are drawn; a hexagonal nut stays a nut."""
    for name, sides in (("wheel", 24), ("nut", 6)):
        made = primitives.cylinder(0.1, 0.05, sides)
        turned = Rotation.from_euler("x", 90, degrees=True).apply(made.vertices) + np.array([0, 0.03, 0])
        write(tmp_path, f"{name}.obj", wavefront([Mesh(turned, made.faces)]))
    links = [f'''<link name="{name}"><inertial><origin xyz="0 0.03 0"/><mass value="1"/><inertia ixx="0.003"
        iyy="0.005" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><mesh filename="{name}.obj"/>
        </geometry></collision></link>''' for name in ("wheel", "nut")]  # fmt: skip
    joint = '<joint name="j" type="floating"><parent link="wheel"/><child link="nut"/><origin xyz="0 1 0"/></joint>'
    scene, report = imported(write(tmp_path, "r.urdf", f'<robot name="r">{"".join(links)}{joint}</robot>'))
    forms = {body.name: scene.shapes[body.shape].sdf for body in scene.bodies}
    assert isinstance(forms["wheel"], CylinderSdf) and forms["wheel"].sizes == pytest.approx((0.1, 0.025), rel=1e-6)
    assert not isinstance(forms["nut"], CylinderSdf)
    assert "wheel: its mesh is a cylinder up to its facets" in " ".join(report["notes"])
    wheel = next(body for body in scene.bodies if body.name == "wheel")
    assert wheel.position == pytest.approx((0, 0.03, 0), abs=1e-9)
    assert abs(Rotation.from_quat(wheel.quat_xyzw).apply((0, 0, 1)) @ (0, 1, 0)) == pytest.approx(1.0)
    frame = next(frame for frame in scene.frames if frame.name == "wheel")  # that of the link
    back = Rotation.from_quat(wheel.quat_xyzw).apply(frame.position) + wheel.position
    assert back == pytest.approx((0, 0, 0), abs=1e-9)


def test_xacro_is_expanded_if_it_is_installed(tmp_path: Path) -> None:
    head, tail = ARM.split(">", 1)
    macro = '<xacro:property name="low" value="${0.1 * 2}"/>'
    text = (
        head + ' xmlns:xacro="http://www.ros.org/wiki/xacro">' + macro + tail.replace('lower="0.2"', 'lower="${low}"')
    )
    file = write(tmp_path, "arm.urdf.xacro", text)
    try:
        import xacro  # noqa: F401
    except ModuleNotFoundError:
        with pytest.raises(
            SdfsimError, match=r"holds xacro macros, and xacro is not installed\nhint: pip install xacro"
        ):
            imported(file)
    else:
        scene, report = imported(file, fixed=True)
        assert {joint.name: joint.start for joint in scene.joints}["shoulder"] == pytest.approx(0.2)
        assert any("xacro" in line for line in report["notes"])


def test_a_fixed_joint_whose_file_gives_it_damping_holds_all_the_same(tmp_path):
    """As Baxter's hands have it: a link with mass and shape on a fixed joint with <dynamics>."""
    text = ARM.replace('name="spin" type="continuous"', 'name="spin" type="fixed"')
    text = text.replace('<axis xyz="0 0 -2"/></joint>', '<axis xyz="0 0 -2"/><dynamics damping="0.7"/></joint>')
    plain, _ = imported(write(tmp_path / "plain", "arm.urdf", text.replace('<dynamics damping="0.7"/>', "")))
    scene, report = imported(write(tmp_path / "damped", "arm.urdf", text))
    assert [joint.kind for joint in scene.joints] == [joint.kind for joint in plain.joints]
    assert "<dynamics> of fixed joints (1)" in report["left_out"]


SCENE = """<mujoco><option {step}>{option}</option><worldbody>
  <geom name="ground" type="plane" size="1 1 1" {ground}/>
  <body name="arm" pos="0 0 1"><joint name="j" axis="0 1 0" range="-20 20" limited="true" stiffness="3" damping="0.4"
    frictionloss="0.2" {joint}/><geom name="rod" type="capsule" size="0.05" fromto="0 0 0 0.4 0 0" {rod}/></body>
  <body name="ball" pos="2 0 0.1"><joint type="free" name="free" {free}/><geom name="round" size="0.1" {ball}/></body>
  <body name="bob" pos="0.4 0 0.8"><freejoint/><geom name="bead" size="0.05"/></body>
  </worldbody><equality><connect name="pin" body1="arm" body2="bob" anchor="0.4 0 0" {pin}/></equality>
  <actuator><motor name="m" joint="j" {motor}/></actuator></mujoco>"""


def text(**said: str) -> str:
    places = dict.fromkeys(("step", "option", "ground", "joint", "rod", "free", "ball", "pin", "motor"), "")
    return SCENE.format(**places | said)


def features(scene: Scene) -> dict[str, bool]:
    joint = next(joint for joint in scene.joints if joint.name == "j")
    return {
        "gravity": bool(np.any(scene.gravity)),
        "limit": joint.limits is not None,
        "spring": joint.spring is not None,
        "damper": joint.damping > 0,
        "frictionloss": joint.friction > 0,
        "equality": any(joint.name == "pin" for joint in scene.joints),
        "contact": scene.effects.contact != "off",
        "actuation": joint.motor is not None,
    }


@pytest.mark.parametrize("flag", ["gravity", "limit", "spring", "damper", "frictionloss", "equality", "contact",
                                  "actuation", "constraint"])  # fmt: skip
def test_what_a_flag_switches_off_is_off_and_nothing_else(tmp_path: Path, flag: str) -> None:
    scene, report = imported(write(tmp_path, "scene.xml", text(option=f'<flag {flag}="disable"/>')))
    off = ["limit", "frictionloss", "equality", "contact"] if flag == "constraint" else [flag]
    assert features(scene) == {name: name not in off for name in features(scene)}
    assert f"the file switches off (1: {flag})" in report["notes"]


OF_PAIRS = "priority and solmix of geoms: the product of two bodies' coefficients counts here"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({}, []),
        ({"rod": 'margin="0.01"'}, ["margin and gap of geoms: bodies touch at their surface here (1: rod)"]),
        ({"ball": 'gap="0.01"'}, ["margin and gap of geoms: bodies touch at their surface here (1: round)"]),
        ({"rod": 'solmix="2"'}, [f"{OF_PAIRS} (1: rod)"]),
        ({"ball": 'priority="1"'}, [f"{OF_PAIRS} (1: round)"]),
        ({"ball": 'solimp="0.5 0.9 0.01"'}, ["solimp of geoms: contacts are rigid here (1: round)"]),
        ({"ball": 'condim="6"'}, ["friction against spinning and rolling (1: round)"]),
        ({"free": 'damping="0.1"'}, ["damping, stiffness and friction of free joints (1: free)"]),
        ({"free": 'stiffness="0.1"'}, ["damping, stiffness and friction of free joints (1: free)"]),
        ({"free": 'frictionloss="0.1"'}, ["damping, stiffness and friction of free joints (1: free)"]),
        ({"joint": 'solreflimit="0.1 1"'}, ["margin and softness of limits: they are rigid here (1: j)"]),
        ({"pin": 'solref="0.1 1"'}, ["softness of equalities and tendons: they are rigid here (1: pin)"]),
        ({"motor": 'user="4"'}, ["actuator_user of MuJoCo's model (1: m)"]),
        ({"option": '<flag gravity="enable"/>'}, []),
        ({"pin": 'active="false"'}, ["equalities that are switched off (1: pin)"]),
        ({"option": '<flag energy="enable" filterparent="disable" warmstart="disable"/>'},
         ["flags of MuJoCo (3: warmstart disable, filterparent disable, energy enable)"]),
        ({"step": 'timestep="0.004" cone="elliptic" wind="1 0 0"'},
         ["air: density, viscosity and wind", "options of MuJoCo's step (2: cone, timestep)"]),
    ],
)  # fmt: skip
def test_what_is_said_of_an_element_or_of_the_step_is_named(tmp_path: Path, said: dict[str, str], told: list[str]):
    left = imported(write(tmp_path, "scene.xml", text(**said)))[1]["left_out"]
    assert left == told


def test_a_body_slides_without_friction_if_all_of_its_contacts_do(tmp_path: Path) -> None:
    scene, report = imported(
        write(tmp_path, "scene.xml", text(ground='condim="1"', ball='condim="1"', rod='condim="1"'))
    )
    rough = {body.name: body.friction for body in scene.bodies}
    # The bead has friction, so it and all that it may touch keep theirs; only what it never touches slides.
    assert rough["ground"] > 0 and rough["ball"] > 0 and rough["bob"] > 0
    assert any(note.startswith("friction of ") for note in report["notes"])
    alone = text(ground='condim="1"', ball='condim="1"', rod='condim="1"').replace('"bead"', '"bead" condim="1"')
    scene, report = imported(write(tmp_path, "scene.xml", alone))
    assert all(body.friction == 0.0 for body in scene.bodies)
    assert not any("friction of" in note for note in report["notes"])
