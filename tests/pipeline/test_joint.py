"""Joints between two states of one thing, whose truth is known: the meshes are made by moving a part."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh  # noqa: TID253
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import cli
from pipeline.cameras import View
from pipeline.mesh.joint import FoundJoint, find_joint, scene_keys
from pipeline.mesh.moving_part import State
from pipeline.mesh.visibility import Visibility
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import write_ply


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


@pytest.mark.parametrize(("degrees", "noise"), [(25.0, 0.0), (70.0, 0.001), (-110.0, 0.001)])
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


def test_what_does_not_move_or_has_nothing_in_common_is_told() -> None:
    one = whole([*CABINET, *DOOR])
    with pytest.raises(SdfsimError, match="nothing moves"):
        find_joint(one, one)
    with pytest.raises(SdfsimError, match="everything moves"):
        find_joint(one, Mesh(one.vertices + np.array([3.0, 0, 0]), one.faces))


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
        eye, target = np.array([2.2 * math.cos(azimuth), 2.2 * math.sin(azimuth), height]), np.array([0, 0, 0.4])
        ahead = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(ahead, [0, 0, 1.0]) / np.linalg.norm(np.cross(ahead, [0, 0, 1.0]))
        turn = np.stack([right, np.cross(ahead, right), ahead])
        views.append(View(str(k), str(k), 640, 480, 560.0, 320.0, 240.0, 0.0, turn, -turn @ eye))
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
HINGE, UP = np.array([-0.28, -0.02, 0.4]), np.array([0, 0, 1.0])


@pytest.mark.parametrize("backwards", [False, True])
def test_a_door_seen_from_outside_only_is_a_hinge(backwards: bool) -> None:
    """What was inside and comes into sight has not moved; in whichever order the states are given."""
    swing = Rotation.from_rotvec(-UP * math.radians(50))
    shut = photographed([*SHELL, *DOOR], 1)
    opened = photographed([*SHELL, *(moved(part, swing, HINGE) for part in DOOR)], 2)
    found = found_in(opened, shut) if backwards else found_in(shut, opened)
    angle, beside = axis_error(found, UP if backwards else -UP, HINGE)
    assert found.kind == "hinge" and angle < 1.0 and beside < 0.01
    assert math.degrees(found.travel) == pytest.approx(50, abs=1.0)
    assert found.follows > 0.9
    # The doubt that it tells is of the size of its error.
    assert math.radians(angle) < 4 * found.doubt.axis + 0.002 and beside < 4 * found.doubt.place + 0.002


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
    both = [*SHELL[:-1], crate, *(moved(part, swing, HINGE) for part in DOOR)]
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
    other = photographed([*SHELL, *(moved(part, swing, HINGE) for part in plate)], 2)

    def paired(part: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(5)
        true = part[rng.choice(len(part), 40)]
        right = swing.apply(true - HINGE) + HINGE + 0.003 * rng.normal(size=true.shape)
        wrong = part[rng.choice(len(part), 300)], there[rng.choice(len(there), 300)]
        return np.concatenate([true, wrong[0]]), np.concatenate([right, wrong[1]])

    found = found_in(one, other, paired=paired)
    angle, beside = axis_error(found, -UP, HINGE)
    assert angle < 1.0 and beside < 0.01 and math.degrees(found.travel) == pytest.approx(140, abs=1.0)
