"""Photos of one thing in two states: what is refused, how poses are shared, which joint moves it, and the scene with
it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh  # noqa: TID253
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import cli
from pipeline.cameras import Similarity
from pipeline.clearing import Cleared
from pipeline.mesh.joint import PART, Doubt, FoundJoint, HeldPart, find_joint, load_held, scene_keys
from pipeline.mesh.moving_part import State, tied
from pipeline.mesh.placement import Placement
from pipeline.mesh.visibility import Visibility
from pipeline.scene_writer import holder_of, scene_text
from pipeline.states import reconstruct_states
from sdfsim.base.errors import EXIT_QUALITY, EXIT_USAGE, SdfsimError
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.scene.load import load_scene
from tests.helpers.command import run as command
from tests.helpers.photos import noise
from tests.helpers.surfaces import look_at


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


def test_photos_that_lie_where_results_go_are_refused(tmp_path):
    given = noise(tmp_path / "second" / "mesh", ["0.png", "1.png", "2.png"])
    noise(tmp_path / "open", ["0.png", "1.png", "2.png"])
    with pytest.raises(SdfsimError, match="where the result of the mesh stage belongs"):
        reconstruct_states(given, tmp_path / "open", tmp_path)
    assert sorted(path.name for path in given.iterdir()) == ["0.png", "1.png", "2.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["open", "second"]


def box(size, place) -> trimesh.Trimesh:
    made = trimesh.creation.box(size)
    made.apply_translation(place)
    return made


def whole(parts: list[trimesh.Trimesh]) -> Mesh:
    made: Any = trimesh.util.concatenate([part.subdivide_to_size(0.08) for part in parts])
    return Mesh(np.array(made.vertices, np.float64), np.array(made.faces, np.int64))


def moved(part: trimesh.Trimesh, turn: Rotation, about: np.ndarray, shift=(0, 0, 0)) -> trimesh.Trimesh:
    made = part.copy()
    made.vertices = turn.apply(made.vertices - about) + about + np.asarray(shift)
    return made


CABINET = [box((0.6, 0.02, 0.8), (0, 0.4, 0.4)), box((0.02, 0.4, 0.8), (-0.29, 0.2, 0.4)),
           box((0.02, 0.4, 0.8), (0.29, 0.2, 0.4)), box((0.6, 0.4, 0.02), (0, 0.2, 0.01)),
           box((0.6, 0.4, 0.02), (0, 0.2, 0.79)), box((0.2, 0.1, 0.3), (0.5, 0.2, 0.15))]  # fmt: skip
DOOR = [box((0.56, 0.02, 0.76), (0, -0.01, 0.4)), box((0.03, 0.05, 0.12), (0.22, -0.045, 0.45))]
DRAWER = [box((0.5, 0.02, 0.2), (0, -0.01, 0.5)), box((0.48, 0.3, 0.01), (0, 0.15, 0.41)),
          box((0.1, 0.04, 0.02), (0, -0.04, 0.5))]  # fmt: skip


@pytest.mark.parametrize(
    ("degrees", "noise"), [(25.0, 0.0), *(pytest.param(d, 0.001, marks=pytest.mark.slow) for d in (70.0, -110.0))]
)
def test_a_door_is_a_hinge_to_a_degree_and_a_hundredth_of_its_size(degrees: float, noise: float) -> None:
    rng = np.random.default_rng(3)
    tilt = Rotation.from_rotvec([0.2, -0.3, 0.5])  # nothing is along an axis of the frame
    about, axis = np.array([-0.28, -0.02, 0.4]), np.array([0, 0, 1.0])
    swing = Rotation.from_rotvec(axis * math.radians(degrees))
    shut, opened = whole([*CABINET, *DOOR]), whole([*CABINET, *(moved(part, swing, about) for part in DOOR)])
    shut, opened = (
        Mesh(tilt.apply(mesh.vertices) + rng.normal(size=mesh.vertices.shape) * noise, mesh.faces)
        for mesh in (shut, opened)
    )
    found = find_joint(shut, opened)
    size = float(np.linalg.norm(np.ptp(shut.vertices, axis=0)))
    true_axis = tilt.apply(axis) * np.sign(degrees)
    assert found.kind == "hinge"
    assert math.degrees(math.acos(min(1.0, float(found.axis @ true_axis)))) < 1.0
    apart = found.anchor - tilt.apply(about)
    assert np.linalg.norm(apart - true_axis * (apart @ true_axis)) < 0.01 * size
    assert math.degrees(found.travel) == pytest.approx(abs(degrees), abs=1.0)
    assert scene_keys(found)["limits_deg"] == pytest.approx([0.0, abs(degrees)], abs=1.0)


def test_a_drawer_is_a_slider_to_a_degree_and_a_hundredth_of_its_size(tmp_path: Path) -> None:
    tilt = Rotation.from_rotvec([-0.4, 0.2, 0.3])
    opened = [moved(part, Rotation.identity(), np.zeros(3), (0, -0.22, 0)) for part in DRAWER]
    one, other = (
        Mesh(tilt.apply(mesh.vertices), mesh.faces) for mesh in (whole([*CABINET, *DRAWER]), whole([*CABINET, *opened]))
    )
    for name, mesh in (("shut", one), ("open", other)):
        (tmp_path / f"{name}.ply").write_bytes(write_ply(mesh))
    run = CliRunner().invoke(cli.app, ["joint", str(tmp_path / "shut.ply"), str(tmp_path / "open.ply"), "--json"])
    told = json.loads(run.stdout)
    assert told["type"] == "slider" and told["limits"] == pytest.approx([0.0, 0.22], abs=0.01)
    found = find_joint(one, other)
    assert found.kind == "slider"
    assert math.degrees(math.acos(min(1.0, float(found.axis @ tilt.apply([0, -1, 0]))))) < 1.0
    assert found.travel == pytest.approx(0.22, abs=0.01)
    # The front of the drawer moves, the back of the cabinet does not.
    front = tilt.inv().apply(one.vertices[one.faces[found.moving]].mean(1))
    assert len(front) and front[:, 1].max() < 0.35 and found.moving.mean() < 0.5


def test_a_screw_is_neither() -> None:
    swing = Rotation.from_rotvec([0, 0, math.radians(80)])
    about = np.array([-0.28, -0.02, 0.4])
    opened = [moved(part, swing, about, (0, 0, 0.3)) for part in DOOR]
    with pytest.raises(SdfsimError, match="neither a hinge nor a slider"):
        find_joint(whole([*CABINET, *DOOR]), whole([*CABINET, *opened]))


def photographed(parts: list[trimesh.Trimesh], seed: int, noise: float = 0.002) -> State:
    """What twelve cameras in front show of some parts on a floor: with noise, bumps, holes and blobs, and nothing of
    what lies hidden."""
    rng = np.random.default_rng(seed)
    whole_of = whole([*parts, box((1.6, 1.6, 0.02), (0, 0.1, -0.03))])
    bumps = sum(np.sin(whole_of.vertices @ rng.normal(size=3) * 40 + 6 * rng.random()) for _ in range(5)) / 5
    moved_by = noise * (rng.normal(size=whole_of.vertices.shape) + np.outer(bumps, rng.normal(size=3)))
    closed = Mesh(whole_of.vertices + moved_by, whole_of.faces)
    views = []
    for k in range(12):
        azimuth, height = -math.pi / 2 + math.radians(-75 + 150 * (k + 0.7 * rng.random()) / 12), (0.5, 1.2, 2.0)[k % 3]
        eye = np.array([2.2 * math.cos(azimuth), 2.2 * math.sin(azimuth), height])
        views.append(look_at(eye, (0, 0, 0.4), name=str(k), focal=560.0))
    sight, seen = Visibility(closed, 0.004), np.zeros(len(closed.vertices), int)
    for view in views:
        seen[sight.of_view(view)[0]] += 1
    kept, middle = (seen > 1)[closed.faces].sum(1) >= 2, closed.vertices[closed.faces].mean(1)
    hole = np.array([-0.28, -0.02, 0.5])  # beside the hinge
    for place in [hole, *middle[rng.choice(len(middle), 3)]]:
        kept &= np.linalg.norm(middle - place, axis=1) > 0.05
    visible = [Mesh(closed.vertices, closed.faces[kept])]
    for place in middle[rng.choice(len(middle), 3)]:
        blob = trimesh.creation.icosphere(2, 0.03)
        visible.append(Mesh(blob.vertices + place, np.array(blob.faces, np.int64)))
    return State(joined(visible), closed, views, Path(), 0.006, np.array([0, 0, 0.4]), 1.1)


def found_in(one: State, other: State, **more) -> FoundJoint:
    return find_joint(one.visible, other.visible, near=0.018, empty=(one.empty, other.empty), **more)


def axis_error(found: FoundJoint, axis: np.ndarray, about: np.ndarray | None) -> tuple[float, float]:
    """Degrees, and m beside the true axis."""
    apart = np.zeros(3) if about is None else found.anchor - about
    angle = math.degrees(math.acos(min(1.0, float(found.axis @ axis))))
    return angle, float(np.linalg.norm(apart - axis * (apart @ axis)))


SHELL = [board.copy() for board in CABINET]
PIN, UP = np.array([-0.28, -0.02, 0.4]), np.array([0, 0, 1.0])


@pytest.mark.parametrize("backwards", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_door_seen_from_outside_only_is_a_hinge(backwards: bool) -> None:
    """What was inside and comes into sight has not moved; in whichever order the states are given."""
    swing = Rotation.from_rotvec(-UP * math.radians(50))
    shut = photographed([*SHELL, *DOOR], 1)
    opened = photographed([*SHELL, *(moved(part, swing, PIN) for part in DOOR)], 2)
    found = found_in(opened, shut) if backwards else found_in(shut, opened)
    angle, beside = axis_error(found, UP if backwards else -UP, PIN)
    assert found.kind == "hinge" and angle < 1.0 and beside < 0.01
    assert math.degrees(found.travel) == pytest.approx(50, abs=1.0)
    assert found.follows > 0.9
    # The doubt that it tells is of the size of its error.
    assert math.radians(angle) < 4 * found.doubt.axis + 0.002 and beside < 4 * found.doubt.place + 0.002


@pytest.mark.slow
def test_a_drawer_of_which_most_was_hidden_is_a_slider() -> None:
    parts = [*DRAWER, box((0.01, 0.3, 0.16), (-0.235, 0.15, 0.5)), box((0.01, 0.3, 0.16), (0.235, 0.15, 0.5))]
    rails = [board for k, board in enumerate(SHELL)] + [box((0.56, 0.36, 0.02), (0, 0.2, 0.62)),
                                                       box((0.56, 0.02, 0.18), (0, 0.0, 0.71)),
                                                       box((0.56, 0.02, 0.38), (0, 0.0, 0.2))]  # fmt: skip
    pulled = [moved(part, Rotation.identity(), np.zeros(3), (0, -0.2, 0)) for part in parts]
    found = found_in(photographed([*rails, *parts], 3), photographed([*rails, *pulled], 4))
    angle, _ = axis_error(found, np.array([0, -1.0, 0]), None)
    assert found.kind == "slider" and angle < 1.0 and found.travel == pytest.approx(0.2, abs=0.005)


def test_nothing_and_two_things_that_move_are_told() -> None:
    shut = photographed([*SHELL, *DOOR], 1)
    with pytest.raises(SdfsimError, match="nothing moves"):
        found_in(shut, photographed([*SHELL, *DOOR], 2))
    swing = Rotation.from_rotvec(-UP * math.radians(50))
    crate = moved(SHELL[-1], Rotation.identity(), np.zeros(3), (0.12, -0.45, 0))
    both = [*SHELL[:-1], crate, *(moved(part, swing, PIN) for part in DOOR)]
    try:
        found = found_in(shut, photographed(both, 2))
    except SdfsimError as error:
        assert "only one part has moved" in f"{error.message} {error.hint}"
    else:
        assert found.follows < 0.9 and "of the moved surface does not follow the motion" in found.line()


def test_places_that_look_alike_tell_how_a_plain_plate_has_turned() -> None:
    """A plate fits itself in many ways; a tenth of the places that look alike are enough to tell which it is."""
    plate = [box((0.56, 0.02, 0.76), (0, -0.01, 0.4))]
    swing = Rotation.from_rotvec(-UP * math.radians(140))
    one = photographed([*SHELL, *plate], 1)
    other = photographed([*SHELL, *(moved(part, swing, PIN) for part in plate)], 2)

    def paired(part: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(5)
        true = part[rng.choice(len(part), 40)]
        right = swing.apply(true - PIN) + PIN + 0.003 * rng.normal(size=true.shape)
        wrong = part[rng.choice(len(part), 300)], there[rng.choice(len(there), 300)]
        return np.concatenate([true, wrong[0]]), np.concatenate([right, wrong[1]])

    found = found_in(one, other, paired=paired)
    angle, beside = axis_error(found, -UP, PIN)
    assert angle < 1.0 and beside < 0.01 and math.degrees(found.travel) == pytest.approx(140, abs=1.0)
