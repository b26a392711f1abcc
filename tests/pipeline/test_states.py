"""Photos of one thing in two states: what is refused, how poses are shared, and the scene with its joint."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.cameras import Similarity, View, load_poses, save_views
from pipeline.mesh.bodies import Parts
from pipeline.mesh.joint import PART, Doubt, HeldPart, load_held
from pipeline.mesh.meshing import axis_ends
from pipeline.mesh.placement import Placement
from pipeline.scene_writer import holder_of, scene_text
from pipeline.sfm.worker import of_one_state
from pipeline.states import check_tied, merge, reconstruct_states, take_poses
from sdfsim.base.errors import EXIT_QUALITY, EXIT_USAGE, SdfsimError
from sdfsim.base.files import write_arrays, write_json
from sdfsim.geometry.mesh import Mesh
from tests.helpers.command import run as command
from tests.helpers.photos import NAMES, noise, write_transforms


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
        (["shut", "open", "--joint", "--body", "cup=0.png:3,4"], "--body goes without --joint"),
        (["shut", "open", "--joint", "--crop", "0,0,0", "1,1,1"], "--crop goes without --joint"),
        (["shut", "none", "--joint"], "no such folder"),
        (["shut", "open", "--joint", "--distance", "0.png", "9.png", "1"], "no photo is called '9.png'"),
    ],
)
def test_what_makes_no_sense_is_one_line(two, tmp_path, given, said):
    words = [str(tmp_path / word) if word in ("shut", "open", "none") else word for word in given]
    run = command("reconstruct", *words, "-o", tmp_path / "out")
    assert run.exit_code in (1, EXIT_USAGE) and said in run.stderr
    assert len([line for line in run.stderr.splitlines() if line.startswith("error:")]) == 1


def test_photos_that_lie_where_results_go_are_refused(tmp_path):
    given = noise(tmp_path / "second" / "mesh", ["0.png", "1.png", "2.png"])
    noise(tmp_path / "open", ["0.png", "1.png", "2.png"])
    with pytest.raises(SdfsimError, match="where the result of the mesh stage belongs"):
        reconstruct_states(given, tmp_path / "open", tmp_path)
    assert sorted(path.name for path in given.iterdir()) == ["0.png", "1.png", "2.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["open", "second"]


def test_photos_with_nothing_in_common_are_not_posed_together(two, tmp_path):
    with pytest.raises(SdfsimError, match="cannot be posed together: camera poses: only 0 of 6 photos") as told:
        reconstruct_states(two[0], two[1], tmp_path / "out")
    assert told.value.exit_code == EXIT_QUALITY and "leave most of what the photos show as it is" in told.value.hint


def test_masks_and_known_cameras_are_refused(two, tmp_path):
    shut, opened = two
    noise(opened / "masks", ["0.png", "1.png", "2.png"], (80, 80))
    with pytest.raises(SdfsimError, match="takes no masks"):
        reconstruct_states(shut, opened, tmp_path / "out")
    noise(tmp_path / "posed", NAMES)
    with pytest.raises(SdfsimError, match="takes none that are known"):
        reconstruct_states(write_transforms(tmp_path / "posed"), shut, tmp_path / "other")


def camera(name: str) -> View:
    return View(name, name, 80, 80, 90.0, 40.0, 40.0, 0.0, np.eye(3), np.array([float(name[:4]), 0, 3.0]))


@pytest.fixture
def posed(tmp_path) -> tuple[list[Any], Any]:
    """Two states of four photos each, posed together: photo 3 (of the first state) has no pose. Point 0 is seen in both
    states, 1 in the first alone, 2 by one photo of each."""
    from pipeline import stages
    from pipeline.inputs.photos import prepare_photos

    states = []
    for name in ("shut", "open"):
        given = noise(tmp_path / name, [f"{name}{k}.png" for k in range(4)], (80, 80))
        state = stages.Project(tmp_path / "out" / name, stages.options_of(photos=str(given)))
        prepare_photos(given, state.place("photos"))
        states.append(state)
    together = stages.Project(tmp_path / "out" / "together", stages.options_of(photos="x"))
    together.place("photos").mkdir(parents=True)
    merge(states, together.place("photos"))
    place = together.place("poses")
    place.mkdir()
    save_views([camera(f"{k:04d}.jpg") for k in range(8) if k != 3], place / "cameras.json")
    seen = [(0, 0), (0, 1), (0, 3), (0, 4), (1, 0), (1, 2), (2, 1), (2, 5)]  # point and view
    write_arrays(place / "sparse.npz", {
        "xyz": np.arange(9.0).reshape(3, 3), "rgb": np.zeros((3, 3), np.uint8), "error": np.ones(3),
        "point_of": np.array([point for point, _ in seen]), "view_of": np.array([view for _, view in seen]),
    })  # fmt: skip
    left = [{"photo": "first/shut3.png", "why": "dark"}, {"photo": "second/x.png", "why": "blurred"}]
    record = {"fingerprint": "", "inputs": "", "made": "", "seconds": 0.0, "report": {"left_out": left, "photos": 8}}
    write_json(place / "stage.json", record)
    return states, together


def test_each_state_takes_its_own_cameras_and_points(posed, tmp_path):
    states, together = posed
    for number, (names, xyz, point_of) in enumerate([
        (["shut0.png", "shut1.png", "shut2.png"], [[0, 1, 2], [3, 4, 5]], [0, 0, 1, 1]),
        (["open0.png", "open1.png", "open2.png", "open3.png"], [[0, 1, 2]], [0, 0]),
    ]):  # fmt: skip
        work = tmp_path / f"poses{number}"
        work.mkdir()
        report = take_poses(states, together, number, work)
        found = load_poses(work)
        assert [view.source for view in found.views] == names
        assert [view.name for view in found.views] == [f"{k:04d}.jpg" for k in range(len(names))]
        assert [view.translation[0] for view in found.views] == ([0, 1, 2], [4, 5, 6, 7])[number]
        assert found.sparse.xyz.tolist() == xyz and found.sparse.point_of.tolist() == point_of
        assert report["posed"] == len(names) and report["photos"] == 4
        assert [one["photo"] for one in report["left_out"]] == (["shut3.png"], ["x.png"])[number]


def test_poses_of_mostly_one_state_or_without_common_points_are_refused(posed):
    states, together = posed
    with pytest.raises(SdfsimError, match="only 2 points are seen in both states"):
        check_tied(states, together)
    views = load_poses(together.place("poses")).views
    save_views(views[:4], together.place("poses") / "cameras.json")
    sparse = {"xyz": np.zeros((1, 3)), "rgb": np.zeros((1, 3), np.uint8), "error": np.ones(1),
              "point_of": np.array([0]), "view_of": np.array([0])}  # fmt: skip
    write_arrays(together.place("poses") / "sparse.npz", sparse)
    with pytest.raises(SdfsimError, match="only 1 of 4 photos could be posed with the other state's"):
        check_tied(states, together)


def test_poses_are_judged_by_photos_of_one_state():
    """What has moved between two states contradicts the right poses."""
    pairs = [("a", "b", 1, 2), ("a", "c", 3, 4), ("d", "c", 5, 6)]
    assert of_one_state({"states": {"a": 0, "b": 0, "c": 1, "d": 1}}, pairs) == [pairs[0], pairs[2]]


SWING = Rotation.from_rotvec([0, 0, math.radians(-60)]).as_matrix()
HINGE = np.array([0.3, 0.0, 0.0])
HELD = HeldPart("hinge", np.array([0.3, 0, 0.2]), np.array([0, 0, 1.0]), math.radians(60), SWING, HINGE - SWING @ HINGE,
                1.0, "given: widest side = 2 m", False, 0.001, Doubt(0.01, 0.002, 0.01), 0.97, 2.0)  # fmt: skip


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
    assert np.allclose(axis_ends(parts, HELD), [[0.3, 0, 0], [0.3, 0, 0.6]])
    slides = replace(HELD, kind="slider", travel=0.2, turn=np.eye(3), shift=np.array([0, 0, -0.2]))
    ends = axis_ends(parts, slides)
    assert ends is not None and np.allclose(ends, [[0.3, 0, 0.4], [0.3, 0, 0.6]])
    assert axis_ends(parts, None) is None and axis_ends(Parts(None, None, {}, 0.0), HELD) is None
