"""The plan says what is in play, and respects what the file switches off."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from sdfsim import SceneError, SdfsimError, load_scene
from sdfsim.scene import collision_filter
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.collision_filter import contact_groups, count_pairs
from sdfsim.scene.plan import plan
from sdfsim.scene.scene import Body, Effects

TEXT = """
version: 1
shapes:
  ball: {sphere: {radius: 0.5}}
bodies:
  - {name: floor, plane: {}}
  - {name: a, shape: ball, FIELDS}
  - {name: b, shape: ball, position: [2, 0, 0], collides_with: [c]}
  - {name: c, shape: ball, position: [4, 0, 0], collides_with: [floor, b]}
"""


@pytest.fixture
def scene(tmp_path):
    def make(fields: str = "mass: 1", **changes):
        (tmp_path / "scene.yaml").write_text(TEXT.replace("FIELDS", fields))
        return replace(load_scene(tmp_path / "scene.yaml"), **changes)

    return make


def test_everything_is_on_where_it_matters(scene):
    decided = plan(scene())
    assert decided["contact"].on and decided["friction"].on and decided["restitution"].on and decided["rotation"].on
    assert decided["gravity"].on and decided["sleep"].on


def test_what_a_body_avoids_it_does_not_touch_and_all_else_it_does():
    """By name, copies too; whichever of two bodies says so, and beside a list of partners."""
    scene = SceneBuilder().add("floor", plane={}).add("a", sphere={"radius": 0.1}, avoids=["many"])
    scene.add("many", shape="a", arrange={"grid": [2, 1, 1], "spacing": 1}, position=(3, 0, 1))
    scene.add("b", shape="a", position=(9, 0, 1), avoids=["many[1]", "floor"], collides_with=["floor", "a", "many"])
    bodies = scene.load().bodies
    group, allowed = contact_groups(bodies)
    apart = {
        (x.name, y.name) for i, x in enumerate(bodies) for j, y in enumerate(bodies) if not allowed[group[i], group[j]]
    }
    one_way = {("a", "many[0]"), ("a", "many[1]"), ("b", "many[1]"), ("b", "floor")}
    assert {pair for pair in apart if pair[0] != pair[1]} == one_way | {(y, x) for x, y in one_way}


def test_groups_and_counts_say_what_every_single_pair_says(scene):
    bodies = list(scene().bodies)
    rng = np.random.default_rng(0)
    lists = [None, None, ("a", "floor"), ("b", "x3", "x7"), ()]
    for k in range(12):
        changes = {
            "name": f"x{k}",
            "motion": str(rng.choice(["static", "dynamic"])),
            "collides_with": lists[rng.integers(len(lists))],
            "friction": float(rng.integers(2)),
            "restitution": float(rng.integers(2)),
        }
        bodies.append(replace(bodies[1], **changes))
    group, allowed = contact_groups(bodies)
    found = {"possible": 0, "frictional": 0, "bouncy": 0, "unmoved": 0}
    for i, x in enumerate(bodies):
        for j, y in enumerate(bodies[i + 1 :], i + 1):
            moves = "dynamic" in (x.motion, y.motion)
            # At least one is dynamic, and each lists the other, or all.
            touch = moves and all(a.collides_with is None or b.name in a.collides_with for a, b in ((x, y), (y, x)))
            assert touch == (moves and bool(allowed[group[i], group[j]]))
            found["possible"] += touch
            found["unmoved"] += not moves
            found["frictional"] += touch and x.friction * y.friction > 0
            found["bouncy"] += touch and x.restitution * y.restitution > 0
    counted = vars(count_pairs(bodies))
    assert found == {name: counted[name] for name in found} and found["possible"] > found["frictional"] > 0
    assert counted["total"] == counted["possible"] + counted["unmoved"] + counted["excluded"]


def many(count: int, listed, motion=lambda k: "dynamic") -> list[Body]:
    """Bodies b0, b1, ... on a floor, each with a list of its own, or None."""
    floor = Body("floor", 0, "static", 1.0, *np.zeros((4, 3)), 0.0, 0.5, 0.5)
    lists = [listed(k) for k in range(count)]
    own = [None if names is None else tuple(names) for names in lists]
    return [floor, *(replace(floor, name=f"b{k}", motion=motion(k), collides_with=own[k]) for k in range(count))]


LISTS = {
    "the floor": lambda k, n: ["floor"],
    "the floor and oneself": lambda k, n: ["floor", f"b{k}"],
    "the floor and the next": lambda k, n: ["floor", f"b{(k + 1) % n}"],
    "the floor and a partner": lambda k, n: ["floor", f"b{k ^ 1}"],
    "the floor and both neighbours": lambda k, n: ["floor", f"b{(k - 1) % n}", f"b{(k + 1) % n}"],
    "all others of ten": lambda k, n: [f"b{j}" for j in range(k - k % 10, k - k % 10 + 10) if j != k],
    "nobody": lambda k, n: [],
}


@pytest.mark.parametrize(
    ("name", "groups"),
    [
        ("the floor", 2),
        ("the floor and oneself", 2),
        ("the floor and the next", 2),
        ("nobody", 2),
        ("the floor and a partner", 1001),
        ("all others of ten", 201),
        ("the floor and both neighbours", 2001),
    ],
)
def test_two_thousand_lists_take_no_time_and_make_no_more_groups_than_they_need(name, groups):
    bodies = many(2000, lambda k: LISTS[name](k, 2000))
    took = []
    for _ in range(3):
        began = time.process_time()
        _, allowed = contact_groups(bodies)
        took.append(time.process_time() - began)
    assert len(allowed) == groups and min(took) < 0.1  # quadratic in the bodies it was 1.6 s


def test_more_groups_than_a_table_can_hold_are_refused(monkeypatch):
    monkeypatch.setattr(collision_filter, "MOST", 100)
    with pytest.raises(SdfsimError, match=r"collides_with splits them into 201 groups \(at most 100\)"):
        contact_groups(many(200, lambda k: LISTS["the floor and both neighbours"](k, 200)))


def test_what_the_file_says_wins(scene):
    off = plan(scene(effects=Effects(contact="off", friction="on", rotation="off")))
    assert not off["contact"].on and not off["rotation"].on
    assert not off["friction"].on and off["friction"].why == "contact is off"
    frictionless = plan(scene(effects=Effects(friction="off")))
    assert frictionless["contact"].on and not frictionless["friction"].on
    assert frictionless["friction"].why == "the file says off"


def test_every_effect_says_why_and_what_would_change_it(scene):
    for made in (scene(), scene(effects=Effects(contact="off", sleep="on")), scene(gravity=np.zeros(3))):
        effects = plan(made)
        assert len(effects) == 10 and all(e.why and e.field for e in effects.values())
    assert "off saves nothing" in plan(scene())["restitution"].why
    assert plan(scene(effects=Effects(sleep="on")))["sleep"].on
    assert not plan(scene(gravity=np.zeros(3)))["gravity"].on


PATH = "motion: kinematic, path: [{time: 0, position: [0, 0, 1]}, {time: 2, position: [1, 0, 1]}]"


def test_bodies_by_how_they_move(scene):
    assert plan(scene(PATH))["kinematic"].on and not plan(scene())["kinematic"].on
    assert count_pairs(scene(PATH).bodies).unmoved == 1  # the floor and what moves along a path do not meet
    body = scene(PATH).bodies[1]
    assert body.mass == 0 and body.position.tolist() == [0, 0, 1] and body.path.time.tolist() == [0, 2]


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ("motion: kinematic", "bodies[1].path: is required"),
        (PATH + ", mass: 1", "bodies[1].mass: cannot be given with motion: kinematic"),
        (PATH.replace("time: 2", "time: 0"), "bodies[1].path[1]: must be later than the pose before it"),
    ],
)
def test_faulty_paths_are_reported(scene, fields, told):
    with pytest.raises(SceneError, match=re.escape(told)):
        scene(fields)
