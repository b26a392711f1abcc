"""Joints between two states of one thing, whose truth is known: the meshes are made by moving a part."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh  # noqa: TID253
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import cli
from pipeline.mesh.joint import find_joint, scene_keys, split
from sdfsim.base.errors import SdfsimError
from sdfsim.geometry.mesh import Mesh
from sdfsim.geometry.mesh_io import write_ply


def box(size, place) -> trimesh.Trimesh:
    made = trimesh.creation.box(size)
    made.apply_translation(place)
    return made


def whole(parts: list[trimesh.Trimesh]) -> Mesh:
    made = trimesh.util.concatenate([part.subdivide_to_size(0.08) for part in parts])
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
    part, rest = split(one, found.moving)
    # The front of the drawer moves, the back of the cabinet does not.
    front = tilt.inv().apply(part.vertices[part.faces].mean(1))
    assert len(front) and front[:, 1].max() < 0.35 and len(rest.faces) > len(part.faces)


def test_what_does_not_move_or_has_nothing_in_common_is_told() -> None:
    one = whole([*CABINET, *DOOR])
    with pytest.raises(SdfsimError, match="nothing moves"):
        find_joint(one, one)
    with pytest.raises(SdfsimError, match="all moves"):
        find_joint(one, Mesh(one.vertices + np.array([3.0, 0, 0]), one.faces))


def test_a_screw_is_neither() -> None:
    swing = Rotation.from_rotvec([0, 0, math.radians(80)])
    about = np.array([-0.28, -0.02, 0.4])
    opened = [moved(part, swing, about, (0, 0, 0.3)) for part in DOOR]
    with pytest.raises(SdfsimError, match="neither a hinge nor a slider"):
        find_joint(whole([*CABINET, *DOOR]), whole([*CABINET, *opened]))
