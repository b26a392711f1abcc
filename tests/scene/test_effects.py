"""The plan says what is in play, and respects what the file switches off."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sdfsim import load_scene
from sdfsim.scene.effects import may_touch, plan
from sdfsim.scene.types import Effects

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
    assert decided.contact.on and decided.friction.on and decided.restitution.on and decided.rotation.on
    assert decided.gravity.on and not decided.sleep.on
    assert decided.static == ("floor",) and decided.dynamic == ("a", "b", "c")


def test_pairs_need_both_sides(scene):
    bodies = {b.name: b for b in scene().bodies}
    assert may_touch(bodies["b"], bodies["c"])
    assert not may_touch(bodies["a"], bodies["b"])
    assert plan(scene()).pairs == 3  # a-floor, b-c, c-floor
    expected = sum(may_touch(x, y) for i, x in enumerate(scene().bodies) for y in scene().bodies[i + 1 :])
    assert expected == 3


def test_what_the_file_says_wins(scene):
    off = plan(scene(effects=Effects(contact="off", friction="on", rotation="off")))
    assert not off.contact.on and not off.rotation.on
    assert not off.friction.on and off.friction.why == "contact is off"
    frictionless = plan(scene(effects=Effects(friction="off")))
    assert frictionless.contact.on and not frictionless.friction.on and frictionless.friction.why == "the file says off"


def test_without_contact_only_spin_turns(scene):
    assert not plan(scene(effects=Effects(contact="off"))).rotation.on
    assert plan(scene("angular_velocity: [0, 0, 1]", effects=Effects(contact="off"))).rotation.on


def test_smooth_bodies_have_no_friction_to_compute(scene):
    made = scene()
    smooth = replace(made, bodies=tuple(replace(b, friction=0.0, restitution=0.0) for b in made.bodies))
    assert not plan(smooth).friction.on and not plan(smooth).restitution.on and plan(smooth).contact.on


def test_nothing_to_do(scene):
    made = scene()
    still = plan(replace(made, bodies=made.bodies[:1]))
    assert not still.contact.on and still.pairs == 0 and still.dynamic == ()
