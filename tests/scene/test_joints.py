"""Joints of scene files: what is refused, with its line, and what the others become."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Scene, SceneError
from sdfsim.scene.plan import plan
from sdfsim.scene.scene import Motor, Spring, fingerprints
from tests.helpers.scene_files import problems_of

TOP = """version: 1
shapes:
  box: {box: {size: [0.2, 0.2, 0.2]}}
bodies:
  - {name: floor, plane: {offset: -2}}
  - {name: leaf, shape: box, position: [1, 0, 0], euler_xyz_deg: [0, 0, 90]}
  - {name: crate, shape: box, position: [2, 0, 0]}
  - {name: crates, shape: box, position: [0, 3, 0], count: 2, arrange: {grid: [2, 1, 1], spacing: 1}}
joints:
"""
HINGE = "name: door, type: hinge, anchor: [0.9, 0, 0], axis: [0, 0, 1]"


@pytest.mark.parametrize(
    ("joint", "told"),
    [
        ("{HINGE, bodies: [leaf]}", "bodies: must be 2 names (got 1)"),
        ("{HINGE, bodies: [leaf, craet]}", "bodies[1]: no body is called 'craet' (did you mean 'crate'?)"),
        ("{HINGE, bodies: [leaf, leaf]}", "bodies: must be two (got 'leaf' twice)"),
        ("{HINGE, bodies: [world, leaf]}", "bodies[0]: world must be the second: it holds the first"),
        ("{HINGE, bodies: [floor, world]}", "bodies: holds nothing: one of the two must be dynamic"),
        ("{HINGE, bodies: [leaf, crates]}", "bodies[1]: there are 2 bodies 'crates': give one, such as crates[0]"),
        ("{name: a, type: hinge, bodies: [leaf, world], axis: [1, 0, 0]}", "anchor: is required: this is a hinge"),
        ("{HINGE, bodies: [leaf, world], limits: [0, 1]}", "limits: is for slider only (this is a hinge; give"),
        ("{HINGE, bodies: [leaf, world], limits_deg: [9, 1]}", "limits_deg: must not be below the first (got 9 to 1)"),
        (
            "{HINGE, bodies: [leaf, world], limits_deg: [10, 20]}",
            "limits_deg: is beyond the limits, 10 to 20 degrees (got 0 degrees)",
        ),
        ("{HINGE, bodies: [leaf, world], friction: -1}", "friction: must be >= 0 (got -1)"),
        ("{HINGE, bodies: [leaf, world], spring: {rest_deg: 3}}", "spring.stiffness: is required"),
        (
            "{HINGE, bodies: [leaf, world], spring: {stiffness: 1, rest: 3}}",
            "spring.rest: is not for a hinge: give rest_deg",
        ),
        ("{HINGE, bodies: [leaf, world], motor: {most: 3, speed: 1, position_deg: 2}}", "motor.position_deg: give"),
        ("{HINGE, bodies: [leaf, world], motor: {speed: 3}}", "motor.max_force: is required"),
        ("{HINGE, bodies: [leaf, world], breaks_at: {}}", "breaks_at: force or torque is required"),
        ("{HINGE, bodies: [leaf, world], frame: crate}", "frame: must be world, leaf or world (got 'crate')"),
        ("{HINGE, bodies: [leaf, world], restitution: 0.5}", "restitution: is for limits or a rope only"),
        (
            "{name: a, type: distance, bodies: [leaf, world], anchor: [1, 0, 0], to: [0, 0, 0]}",
            "one of rod, rope, spring is required: this is a distance",
        ),
        (
            "{name: a, type: distance, bodies: [leaf, world], anchor: [1, 0, 0], to: [0, 0, 0], rope: 0.5}",
            "rope: must be at least the distance of its ends at the start, 1 m (got 0.5 m)",
        ),
        (
            "{name: a, type: distance, bodies: [leaf, world], anchor: [1, 0, 0], to: [0, 0, 0], rod: 1.5}",
            "rod: must be the distance of its ends at the start, 1 m (got 1.5 m)",
        ),
        (
            "{name: a, type: ball, bodies: [leaf, world], anchor: [1, 0, 0], cone_deg: 20}",
            "axis: is required: cone_deg is measured from it",
        ),
        (
            "{name: a, type: weld, bodies: [leaf, world]}",
            "type: must be one of hinge, slider, ball, fixed, distance (got 'weld')",
        ),
    ],
)  # fmt: skip
def test_a_fault_of_a_joint_is_told_with_its_line(load, joint: str, told: str):
    assert any(
        line.startswith("scene.yaml:10: joints[0]") and told in line
        for line in problems_of(load, f"{TOP}  - {joint.replace('HINGE', HINGE)}\n")
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            TOP
            + "  - {name: a, type: fixed, bodies: [leaf, world]}\n  - {name: a, type: fixed, bodies: [crate, leaf]}\n",
            "scene.yaml:11: joints[1].name: two joints are called 'a' (the first is joints[0])",
        ),
        (
            TOP.replace("name: crate,", "name: world,") + "  - {name: a, type: fixed, bodies: [leaf, world]}\n",
            "scene.yaml:10: joints[0].bodies[1]: a body is called 'world' too: give it another name",
        ),
    ],
)
def test_joints_of_one_name_and_a_body_that_is_called_world_are_refused(load, text, told):
    assert problems_of(load, text) == [told]


def test_a_hinge_has_a_frame_at_each_body(load):
    text = f"{TOP}  - {{{HINGE}, bodies: [leaf, crate], start_deg: 30, limits_deg: [0, 90]}}\n"
    (joint,) = load(text).joints
    assert joint.bodies == (1, 2) and joint.limits == pytest.approx((0.0, math.pi / 2))
    leaf, crate = Rotation.from_euler("z", 90, degrees=True), Rotation.identity()
    one, other = leaf * Rotation.from_quat(joint.quat_xyzw[0]), crate * Rotation.from_quat(joint.quat_xyzw[1])
    assert one.apply([1, 0, 0]) == pytest.approx([0, 0, 1]) and other.apply([1, 0, 0]) == pytest.approx([0, 0, 1])
    assert (other.inv() * one).as_rotvec() == pytest.approx([math.radians(30), 0, 0])
    assert leaf.apply(joint.anchor[0]) == pytest.approx([-0.1, 0, 0])
    assert joint.anchor[1] == pytest.approx([-1.1, 0, 0])


def test_points_may_be_told_in_a_body(load):
    own = "name: door, type: slider, anchor: [0, 0.1, 0], axis: [1, 0, 0], frame: leaf, start: 0.25"
    (joint,) = load(f"{TOP}  - {{{own}, bodies: [leaf, world]}}\n").joints
    assert joint.anchor[0] == pytest.approx([0, 0.1, 0])
    axis = Rotation.from_quat(joint.quat_xyzw[1]).apply([1, 0, 0])
    assert axis == pytest.approx([0, 1, 0])
    # It starts a quarter of a metre along its axis.
    assert joint.anchor[1] == pytest.approx(np.array([0.9, 0.0, 0.0]) - 0.25 * axis)


def test_what_pulls_and_drives_is_kept_in_radians(load):
    given = "spring: {stiffness: 3, rest_deg: 90}, motor: {position_deg: 180, max_force: 2, time: 0.3}"
    (joint,) = load(f"{TOP}  - {{{HINGE}, bodies: [leaf, world], {given}}}\n").joints
    assert joint.spring == Spring(3.0, math.radians(90))
    assert joint.motor == Motor(2.0, None, math.radians(180), 0.3)


def test_joints_written_in_python_are_those_of_the_file(load):
    built = Scene()
    built.add("leaf", box={"size": (0.2, 0.2, 0.2)}, position=(1, 0, 0))
    built.join("door", "hinge", "leaf", anchor=(0.9, 0, 0), axis=(0, 0, 1), limits_deg=(0, 90))
    written, (joint,) = load(str(built)), built.load().joints
    assert joint.bodies == (0, -1) and np.array_equal(joint.anchor, written.joints[0].anchor)
    with pytest.raises(SceneError, match="did you mean 'limits_deg'"):
        built.join("other", "hinge", "leaf", limit_deg=(0, 90))


def test_the_plan_knows_joints(load):
    text = f"{TOP}  - {{{HINGE}, bodies: [leaf, world]}}\n"
    assert plan(load(text))["joints"].on and not plan(load(TOP.replace("joints:\n", "")))["joints"].on
    off = plan(load(text.replace("version: 1", "version: 1\neffects: {joints: off}")))["joints"]
    assert not off.on and off.why == "the file says off"


def test_another_joint_makes_another_scene(load):
    text = f"{TOP}  - {{{HINGE}, bodies: [leaf, world], friction: 1}}\n"
    one, same, other = (fingerprints(load(t)) for t in (text, text, text.replace("friction: 1", "friction: 2")))
    assert one == same and one["bodies"] != other["bodies"]
