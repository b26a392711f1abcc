"""Photos of one thing in two states: what is refused, how poses are shared, and the scene with its joint."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.cameras import Similarity
from pipeline.clearing import Cleared
from pipeline.mesh.bodies import Parts
from pipeline.mesh.joint import PART, Doubt, HeldPart, load_held
from pipeline.mesh.meshing import axis_ends
from pipeline.mesh.moving_part import tied
from pipeline.mesh.placement import Placement
from pipeline.scene_writer import holder_of, scene_text
from pipeline.states import reconstruct_states
from sdfsim.base.errors import EXIT_QUALITY, EXIT_USAGE, SdfsimError
from sdfsim.geometry.mesh import Mesh
from tests.helpers.command import run as command
from tests.helpers.photos import noise


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    shut, opened = (noise(tmp_path / name, ["0.png", "1.png", "2.png"], (80, 80)) for name in ("shut", "open"))
    return shut, opened


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["shut", "--joint"], "--joint takes two folders"),
        (["shut", "open"], "one folder too many"),
        (["shut", "shut", "--joint"], "is the folder of the first state as well"),
        (["shut", "open", "--joint", "--body", "cup=0.png:3,4"], "--body cannot be combined with --joint"),
        (["shut", "open", "--joint", "--crop", "0,0,0", "1,1,1"], "--crop cannot be combined with --joint"),
        (["shut", "none", "--joint"], "no such folder"),
        (["shut", "open", "--joint", "--distance", "0.png", "9.png", "1"], "no photo is called '9.png'"),
    ],
)
def test_what_makes_no_sense_is_one_line(two, tmp_path, given, said):
    words = [str(tmp_path / word) if word in ("shut", "open", "none") else word for word in given]
    run = command("reconstruct", *words, "-o", tmp_path / "out")
    assert run.exit_code in (1, EXIT_USAGE) and said in run.stderr
    assert len([line for line in run.stderr.splitlines() if line.startswith("error:")]) == 1


def test_masks_are_refused(two, tmp_path):
    shut, opened = two
    noise(opened / "masks", ["0.png", "1.png", "2.png"], (80, 80))
    with pytest.raises(SdfsimError, match="takes no masks"):
        reconstruct_states(shut, opened, tmp_path / "out")


@pytest.mark.parametrize("moved", [0.0, 0.3])
def test_states_are_tied_by_what_stands_still(moved: float):
    """A third of the places have moved, as on a door full of texture, and as many are wrong."""
    rng = np.random.default_rng(4)
    true = Similarity(1.7, Rotation.from_rotvec([0.4, -0.2, 1.1]).as_matrix(), np.array([0.3, -1.0, 0.2]))
    here = rng.uniform(-1, 1, (3000, 3))
    goes = np.repeat([moved, 0.0], [1000, 2000])[:, None] * [0, 1.0, 0]
    there = true.points(here + goes) + 0.004 * rng.normal(size=here.shape)
    wrong = rng.uniform(-1, 1, (1000, 3)), rng.uniform(-2, 2, (1000, 3))
    pairs = np.concatenate([here, wrong[0]]), np.concatenate([there, wrong[1]])
    found, patches = tied(*pairs, 0.02, 0.034)
    assert patches > 1000
    assert np.abs(found.points(here[1000:]) - true.points(here[1000:])).max() < 0.002
    assert found.scale == pytest.approx(true.scale, rel=1e-3)


def test_a_patch_has_one_vote_however_much_there_is_to_see_on_it():
    """Nine tenths of the places are on a small part that has moved."""
    rng = np.random.default_rng(5)
    still, door = rng.uniform(-1, 1, (600, 3)), rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 0.005], (5400, 3))
    pairs = np.concatenate([still, door]), np.concatenate([still, door + np.array([0.5, 0.2, 0])])
    found, _ = tied(*pairs, 0.02, 0.02)
    assert np.allclose(found.points(still), still, atol=1e-6)


def test_states_with_nothing_in_common_are_refused():
    rng = np.random.default_rng(6)
    with pytest.raises(SdfsimError, match="too little in common: they look alike in") as told:
        tied(rng.uniform(-1, 1, (900, 3)), rng.uniform(-1, 1, (900, 3)), 0.02, 0.02)
    assert told.value.exit_code == EXIT_QUALITY and "leave most of what the photos show as it is" in told.value.hint
    with pytest.raises(SdfsimError, match="they look alike in 0 places, 50 are needed"):
        tied(np.zeros((0, 3)), np.zeros((0, 3)), 0.02, 0.02)


SWING = Rotation.from_rotvec([0, 0, math.radians(-60)]).as_matrix()
HINGE = np.array([0.3, 0.0, 0.0])
HELD = HeldPart("hinge", np.array([0.3, 0, 0.2]), np.array([0, 0, 1.0]), math.radians(60), 0.001,
                Doubt(0.01, 0.002, 0.01), 0.97, 2.0, SWING, HINGE - SWING @ HINGE, 1.0, "given: widest side = 2 m",
                False)  # fmt: skip


def test_a_joint_moves_with_its_world_and_survives_its_file(tmp_path):
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    move = Similarity(3.0, turn, np.array([1.0, -2, 0.5]))
    moved = HELD.moved(move)
    points = np.random.default_rng(0).normal(size=(20, 3))
    home = points @ HELD.turn.T + HELD.shift
    assert np.allclose(move.points(points) @ moved.turn.T + moved.shift, move.points(home))
    # What lies on the axis stays there.
    assert np.allclose(moved.turn @ (moved.anchor + 0.7 * moved.axis) + moved.shift, moved.anchor + 0.7 * moved.axis)
    assert moved.metres == pytest.approx(1 / 3) and moved.travel == HELD.travel
    assert replace(HELD, kind="slider", travel=0.2).moved(move).travel == pytest.approx(0.6)
    moved.save(tmp_path / "joint.json")
    again = load_held(tmp_path / "joint.json")
    assert again is not None and again.line() == moved.line() and np.allclose(again.moved(move.inverse()).turn, SWING)
    assert load_held(tmp_path / "none.json") is None
    (tmp_path / "joint.json").write_text(json.dumps({"version": 1}))
    with pytest.raises(SdfsimError, match="damaged"):
        load_held(tmp_path / "joint.json")


def test_the_scene_starts_in_the_first_state_and_goes_to_the_second(tmp_path):
    """The meshes are those of the second state, in which the door, 0.6 m wide, is open by 60 degrees."""
    from sdfsim.scene.load import load_scene

    placement = Placement(Similarity(1.0, np.eye(3), np.zeros(3)), "plane", "given")
    origins = {PART: np.array([0.15, 0.26, 0.0]), "object1": np.array([0.0, -1.0, 0])}
    text = scene_text(placement, origins, None, scenery=False, held=HELD, holder="object1")
    for name in (PART, "object1"):
        text = text.replace(f"{name}: {{asset: assets/{name}}}", f"{name}: {{box: {{size: [0.1, 0.1, 0.1]}}}}")
    scene = load_scene(tmp_path / "scene.yaml", text=text)
    bodies = {body.name: body for body in scene.bodies}
    assert bodies["object1"].motion == "static" and bodies[PART].motion == "dynamic"
    assert np.allclose(bodies[PART].position, SWING @ (origins[PART] - HINGE) + HINGE, atol=1e-5)
    (joint,) = scene.joints
    assert joint.kind == "hinge" and joint.limits == pytest.approx((0, math.radians(60)), abs=1e-6)
    turned = Rotation.from_quat(bodies[PART].quat_xyzw).as_matrix()
    assert np.allclose(turned, SWING, atol=1e-6)
    # The joint's own frame is kept in the axes of the bodies: back in the world it lies where it was found.
    door, frame = (scene.bodies[index] for index in joint.bodies)
    assert (door.name, frame.name) == (PART, "object1")
    for body, anchor, quat in zip((door, frame), joint.anchor, joint.quat_xyzw, strict=True):
        pose = Rotation.from_quat(body.quat_xyzw)
        assert np.allclose(pose.apply(anchor) + body.position, HELD.anchor, atol=1e-5)
        assert np.allclose((pose * Rotation.from_quat(quat)).apply([1, 0, 0]), [0, 0, 1], atol=1e-6)


def test_a_part_does_not_touch_what_it_starts_in(tmp_path):
    """A door that photos put 3 mm into the floor cannot leave its hinge."""
    from sdfsim.scene.collision_filter import contact_groups
    from sdfsim.scene.load import load_scene

    placement = Placement(Similarity(1.0, np.eye(3), np.zeros(3)), "plane", "given")
    origins = {PART: np.array([0.15, 0.26, -0.003]), "object1": np.array([0.0, -1.0, 0]), "cup": np.array([0, 2.0, 0])}
    moved = {PART: Cleared(np.zeros(3), ("floor",), 0.003, held=True)}
    text = scene_text(placement, origins, None, scenery=False, held=HELD, holder="object1", moved=moved)
    for name in origins:
        text = text.replace(f"{name}: {{asset: assets/{name}}}", f"{name}: {{box: {{size: [0.1, 0.1, 0.1]}}}}")
    scene = load_scene(tmp_path / "scene.yaml", text=text)
    group, allowed = contact_groups(scene.bodies)
    number = {body.name: group[k] for k, body in enumerate(scene.bodies)}
    assert not allowed[number[PART], number["floor"]]
    assert allowed[number[PART], number["cup"]] and allowed[number["cup"], number["floor"]]


def test_what_is_beside_the_part_holds_it():
    def box(low: tuple, high: tuple) -> Mesh:
        corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                          [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
        return Mesh(np.array(low) + corner * (np.array(high) - np.array(low)), faces)

    part = box((0, 0, 0), (0.5, 0.02, 0.6))
    others = {"scenery": box((-2, -2, -0.1), (2, 2, -0.03)), "object1": box((-0.02, 0, 0), (0, 0.4, 0.6)),
              "object2": box((0.8, 0, 0), (1, 1, 1))}  # fmt: skip
    assert holder_of(part, others) == "object1"
    assert holder_of(part, {}) is None


def test_the_picture_of_names_shows_the_axis_along_the_part_and_the_way_of_a_slider():
    """The part hangs on the hinge at x = 0.3 in its second state; along the axis it goes from 0 to 0.6."""
    part = Mesh(np.array([[0.3, 0, 0], [0.3, 0, 0.6], [0.1, 0.35, 0.6]]), np.array([[0, 1, 2]]))
    parts = Parts(None, None, {PART: part}, 0.0)
    along = axis_ends(parts, HELD)
    assert along is not None and np.allclose(along, [[0.3, 0, 0], [0.3, 0, 0.6]])
    slides = replace(HELD, kind="slider", travel=0.2, turn=np.eye(3), shift=np.array([0, 0, -0.2]))
    ends = axis_ends(parts, slides)
    assert ends is not None and np.allclose(ends, [[0.3, 0, 0.4], [0.3, 0, 0.6]])
    assert axis_ends(parts, None) is None and axis_ends(Parts(None, None, {}, 0.0), HELD) is None


def test_photos_that_lie_where_results_go_are_refused(tmp_path):
    given = noise(tmp_path / "second" / "mesh", ["0.png", "1.png", "2.png"])
    noise(tmp_path / "open", ["0.png", "1.png", "2.png"])
    with pytest.raises(SdfsimError, match="where the result of the mesh stage belongs"):
        reconstruct_states(given, tmp_path / "open", tmp_path)
    assert sorted(path.name for path in given.iterdir()) == ["0.png", "1.png", "2.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["open", "second"]
