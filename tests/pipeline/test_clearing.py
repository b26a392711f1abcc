"""Bodies that start in others are moved out by the shortest way: judged by samples of trimesh's meshes in the signed
distances of Open3D, of which `clearing` uses neither."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import open3d as o3d  # noqa: TID253
import pytest
import trimesh  # noqa: TID253

from pipeline.clearing import Cleared, cleared
from sdfsim.geometry.mesh import Mesh
from sdfsim.scene.joints import held
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape, mesh_shape
from tests.helpers.scenes import make_body

MM = 1e-3
JAR = trimesh.creation.cylinder(radius=0.05, height=0.12, sections=64)
TABLE = trimesh.creation.box((1.0, 0.8, 0.04))
WALL = trimesh.creation.box((0.04, 0.8, 1.0))
FLOOR = ("floor", None, (0.0, 0.0, 0.0))

Thing = tuple[str, trimesh.Trimesh | None, tuple[float, float, float]]


def scene_of(still: Sequence[Thing], free: Sequence[Thing], joints: Sequence[str] = ()) -> Scene:
    """A scene of static and of dynamic things, by their names and places; those that `joints` name hang on a hinge."""
    shapes, bodies = [], []
    for number, (name, made, place) in enumerate([*still, *free]):
        shape = analytic_shape("plane") if made is None else mesh_shape(plain(made), name=name, kind="mesh")
        shapes.append(shape)
        motion = {"motion": "static", "mass": 0.0} if number < len(still) else {}
        bodies.append(make_body(name, number, place, **motion))
    index = {body.name: k for k, body in enumerate(bodies)}
    hinges = tuple(hinge(bodies, index[name]) for name in joints)
    return Scene(tuple(shapes), tuple(bodies), np.array([0.0, 0.0, -9.81]), 1.0, joints=hinges)


def plain(made: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(made.vertices, float), np.asarray(made.faces, np.int64))


def hinge(bodies: list[Body], number: int):
    anchor, axis = bodies[number].position, np.array([0.0, 0.0, 1.0])
    return held("hinge", "hinge", (number, -1), bodies, anchor=anchor, axis=axis)


def depth(scene: Scene, one: str, other: str, moved: dict[str, Cleared], count: int = 40_000) -> float:
    """m, how deep samples of each of two bodies' surfaces are in the other, once they are moved."""
    placed = []
    for name in (one, other):
        body = next(body for body in scene.bodies if body.name == name)
        mesh = scene.shapes[body.shape].mesh
        shift = moved[name].shift if name in moved else 0.0
        placed.append(trimesh.Trimesh(mesh.vertices + body.position + shift, mesh.faces, process=False))
    deepest = 0.0
    for mine, theirs in (placed, placed[::-1]):
        points = np.concatenate([mine.vertices, trimesh.sample.sample_surface(mine, count, seed=0)[0]])
        rays: Any = o3d.t.geometry.RaycastingScene()
        rays.add_triangles(np.asarray(theirs.vertices, np.float32), np.asarray(theirs.faces, np.uint32))
        deepest = max(
            deepest, -float(rays.compute_signed_distance(points.astype(np.float32), nsamples=9).numpy().min())
        )
    return deepest


def check(scene: Scene, wanted: dict[str, tuple[float, float, float]], *, within: float = 0.02 * MM
          ) -> dict[str, Cleared]:  # fmt: skip
    """That bodies are moved as wanted, mm, nothing else is, and nothing is in anything else afterwards."""
    moved = cleared(scene, {})
    assert {name: one.left for name, one in moved.items()} == dict.fromkeys(wanted, 0.0)
    for name, shift in wanted.items():
        assert moved[name].shift == pytest.approx(np.array(shift) * MM, abs=within), name
    for body in scene.bodies:
        if body.name in moved:
            for other in scene.bodies:
                if other.name not in (body.name, "floor"):
                    assert depth(scene, body.name, other.name, moved) < 0.01 * MM, (body.name, other.name)
    return moved


ON_TABLE = 0.06 + 0.02  # m, between the middle of a jar and that of the table below it


def test_what_touches_stays():
    things = [("jar", JAR, (0.1, 0.05, ON_TABLE)), ("ball", trimesh.creation.icosphere(radius=0.05), (0.4, 0.1, 0.3))]
    assert cleared(scene_of([("table", TABLE, (0, 0, 0))], things), {}) == {}


@pytest.mark.parametrize("deep", [0.05, 1.7, 4.0, 15.0])
def test_a_jar_in_a_table_is_lifted(deep):
    scene = scene_of([("table", TABLE, (0, 0, 0))], [("jar", JAR, (0.1, 0.05, ON_TABLE - deep * MM))])
    moved = check(scene, {"jar": (0, 0, deep)})
    assert moved["jar"].into == ("table",)


def test_gravity_says_which_way_is_up():
    """A shelf that is upside down: what rests on it does so from below."""
    scene = scene_of([("shelf", TABLE, (0, 0, 0))], [("jar", JAR, (0.1, 0.05, -ON_TABLE + 2 * MM))])
    check(replace(scene, gravity=np.array([0.0, 0.0, 9.81])), {"jar": (0, 0, -2)})


BARE, WALLED = [("table", TABLE, (0, 0, 0))], [("table", TABLE, (0, 0, 0)), ("wall", WALL, (0.3, 0, 0.52))]
STICKS = trimesh.creation.box((2.0, 0.01, 0.01)), trimesh.creation.box((0.01, 2.0, 0.01))
LID = ("lid", trimesh.creation.box((0.06, 0.06, 0.02)), (0.1, 0, 0.02 + 0.12 + 0.01 - 4 * MM))


@pytest.mark.parametrize(
    ("still", "free", "wanted"),
    [
        (WALLED, [("jar", JAR, (0.23 + MM, 0.05, ON_TABLE))], {"jar": (-1, 0, 0)}),
        (WALLED, [("jar", JAR, (0.23 + MM, 0.05, ON_TABLE - 2 * MM))], {"jar": (-1, 0, 2)}),
        (BARE, [LID, ("jar", JAR, (0.1, 0, ON_TABLE - 3 * MM))], {"jar": (0, 0, 3), "lid": (0, 0, 4)}),
        ([("lower", STICKS[0], (0, 0, 0))], [("upper", STICKS[1], (0.013, 0.017, 0.01 - MM))], {"upper": (0, 0, 1)}),
    ],
    ids=[
        "aside, not over the wall",
        "out of wall and table",
        "the lid follows its jar",
        "sticks without a corner inside",
    ],
)
def test_bodies_go_out_by_the_shortest_way(still, free, wanted):
    check(scene_of(still, free), wanted)


def test_of_two_jars_in_each_other_one_goes_aside():
    jars = [("one", JAR, (0.0, 0.0, ON_TABLE)), ("other", JAR, (0.1 - MM, 0.0, ON_TABLE))]
    check(scene_of(BARE, jars), {"other": (1, 0, 0)}, within=0.06 * MM)  # 64 sides


@pytest.mark.parametrize(("aside", "wanted"), [(0.0, 2.0), (12.0, 2.0)])
def test_a_ball_in_a_bowl_is_lifted(aside, wanted):
    """The bowl's inside is a part of a ball of 10 cm: one of 5 cm in it touches it where its middle is 5 cm from the
    bowl's; it starts 2 mm deeper, in the middle or beside it."""
    turn = np.linspace(0, 0.5 * np.pi, 60)
    outer = 0.11 * np.column_stack([np.sin(turn), -np.cos(turn)])
    inner = 0.10 * np.column_stack([np.sin(turn), -np.cos(turn)])[::-1]
    bowl = trimesh.creation.revolve(np.concatenate([outer, inner]), sections=180)
    bowl = bowl if bowl.volume > 0 else trimesh.Trimesh(bowl.vertices, bowl.faces[:, ::-1])
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    away = 0.05 + wanted * MM
    down = np.sqrt(away**2 - (aside * MM) ** 2)
    scene = scene_of([("bowl", bowl, (0, 0, 0))], [("ball", ball, (aside * MM, 0, -down))])
    up = 1000 * (down - np.sqrt(0.05**2 - (aside * MM) ** 2))
    check(scene, {"ball": (0, 0, up)}, within=0.1 * MM)


def test_what_hangs_on_a_joint_stays_and_what_is_in_it_goes():
    door = trimesh.creation.box((0.04, 0.6, 1.0))
    free = [("door", door, (0.3, 0, 0.52)), ("jar", JAR, (0.23 + MM, 0.05, ON_TABLE))]
    check(scene_of([("table", TABLE, (0, 0, 0))], free, joints=["door"]), {"jar": (-1, 0, 0)})


def test_a_door_in_the_floor_is_told_and_stays():
    door = trimesh.creation.box((0.04, 0.6, 1.0))
    moved = cleared(scene_of([FLOOR], [("door", door, (0.3, 0, 0.5 - 2 * MM))], joints=["door"]), {})
    assert moved["door"].held and moved["door"].into == ("floor",) and not moved["door"].shift.any()
    assert moved["door"].left == pytest.approx(2 * MM, rel=1e-3)


def test_what_is_too_large_for_its_hollow_stays_there_and_is_told():
    shelves = [("lower", TABLE, (0, 0, 0)), ("upper", TABLE, (0, 0, 0.16 - 2 * MM))]
    moved = cleared(scene_of(shelves, [("jar", JAR, (0, 0, ON_TABLE - MM))]), {})
    assert not moved["jar"].shift.any() and set(moved["jar"].into) == {"lower", "upper"}
    assert moved["jar"].left == pytest.approx(MM, rel=1e-3)


def test_the_mesh_of_a_shape_may_be_open_where_a_solid_is_given():
    """Of scenery the shape has what photos show: here the table's upper side alone."""
    scene = scene_of([("table", TABLE, (0, 0, 0))], [("jar", JAR, (0.1, 0.05, ON_TABLE - 3 * MM))])
    table = scene.shapes[0]
    top = Mesh(
        table.mesh.vertices,
        table.mesh.faces[trimesh.Trimesh(table.mesh.vertices, table.mesh.faces).face_normals[:, 2] > 0.9],
    )
    opened = replace(scene, shapes=(replace(table, mesh=top), *scene.shapes[1:]))
    assert cleared(opened, {"table": table.mesh})["jar"].shift == pytest.approx([0, 0, 3 * MM], abs=0.02 * MM)
