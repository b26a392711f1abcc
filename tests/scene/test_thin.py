"""What comes so fast that a step is longer than the other is thick is told by `plan`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sdfsim.planning import describe, plan_lines
from sdfsim.scene.thin import may_pass_through, thickness
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.shape import analytic_shape, shape_from_primitive

DT = 0.02


def body(name: str, shape: int, height: float, speed: float = 0.0, **fields) -> Body:
    defaults = {"motion": "dynamic", "scale": 1.0, "mass": 1.0, "friction": 0.5, "restitution": 0.5}
    pose = {"position": np.array([0, 0, height]), "quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0])}
    moving = {"velocity": np.array([0, 0, -speed]), "angular_velocity": np.zeros(3)}
    return Body(name, shape, **(defaults | pose | moving | fields))  # type: ignore[arg-type]


def scene(speed: float, thick: float, **fields) -> Scene:
    """A ball whose lowest point is 1.25 m above a plate: dropped, it comes at 5 m/s."""
    shapes = (analytic_shape("sphere", radius=0.5), analytic_shape("box", size=(9, 9, thick)), analytic_shape("plane"))
    bodies = (
        body("ball", 0, 1.75 + thick / 2, speed, **fields),
        body("plate", 1, 0.0, motion="static"),
        body("floor", 2, -1.0, motion="static"),
    )
    return Scene(shapes, bodies, gravity=np.array([0, 0, -10.0]), duration=1.0)


@pytest.mark.parametrize(
    ("speed", "thick", "told"), [(0, 0.11, False), (0, 0.09, True), (12, 0.27, False), (12, 0.25, True)]
)
def test_a_step_longer_than_the_plate_is_thick_is_told(speed, thick, told):
    arrival = np.hypot(speed, 5.0)  # 5 and 13 m/s: 0.1 and 0.26 m a step
    found = may_pass_through(scene(speed, thick), DT)
    assert len(found) == told
    if told:
        assert "'plate'" in found[0] and "'ball'" in found[0] and f"{arrival * DT:.3g} m a step" in found[0]


def test_what_cannot_touch_the_plate_does_not_count():
    assert may_pass_through(scene(12, 0.25, collides_with=("floor",)), DT) == []
    low = replace(scene(0, 0.09), gravity=np.array([0, 0, 10.0]))
    assert may_pass_through(low, DT) == [], "it falls the other way"


def test_two_bodies_that_fly_apart_or_together_count_with_their_relative_speed():
    one = scene(0, 9.0)
    thin = (analytic_shape("sphere", radius=0.05),)
    pair = (body("a", 0, 0.0, 4.0), body("b", 0, 0.0, -4.0))
    found = may_pass_through(replace(one, shapes=thin, bodies=pair, gravity=np.zeros(3)), DT)
    assert len(found) == 1 and "8 m/s" in found[0]
    alike = (pair[0], body("b", 0, 0.0, 4.0))
    assert may_pass_through(replace(one, shapes=thin, bodies=alike, gravity=np.zeros(3)), DT) == []


def test_thickness_is_that_of_the_largest_ball_inside():
    assert thickness(analytic_shape("box", size=(3, 2, 0.01))) == pytest.approx(0.01, rel=0.02)
    assert thickness(analytic_shape("sphere", radius=0.5)) == pytest.approx(1.0, rel=0.15)
    assert thickness(analytic_shape("plane")) == np.inf
    bowl = shape_from_primitive("bowl", sdf="mesh")  # 1 m wide, its wall 6 cm
    assert thickness(bowl) == pytest.approx(0.06, rel=0.1)


def test_plan_says_it(tmp_path):
    file = tmp_path / "scene.yaml"
    text = """
version: 1
shapes:
  ball: {{sphere: {{radius: 0.1}}}}
  plate: {{box: {{size: [3, 3, 0.01]}}}}
bodies:
  - {{name: plate, shape: plate, motion: static}}
  - {{name: ball, shape: ball, position: [0, 0, 0.12], velocity: [0, 0, {speed}]}}
"""
    for speed, told in ((-5.0, True), (0.0, False)):
        file.write_text(text.format(speed=speed))
        report = describe(file, model=None, device="cpu", on_progress=lambda *_: None)
        assert bool(report["may_pass_through"]) == told
        assert any(line.startswith("may pass through: 'plate'") for line in plan_lines(report)) == told
