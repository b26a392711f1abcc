"""Scenes of the hard cases, and what must hold of every rollout."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sdfsim.physics import pose
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape, load_shape
from tests.helpers.scenes import make_body

SAMPLES = Path(__file__).resolve().parents[2] / "samples"
EARTH = np.array([0.0, 0.0, -9.81])
BALL, CUBE = analytic_shape("sphere", radius=0.5), analytic_shape("box", size=(1.0, 1.0, 1.0))
PLANE = analytic_shape("plane")
TILTED = np.array([0.2, 0.1, 0.3, 1.0]) / np.linalg.norm([0.2, 0.1, 0.3, 1.0])


def placed(shape: Shape, places, *, floor: bool = False, gravity: np.ndarray | None = None, **fields) -> Scene:
    """Bodies `b0`, `b1`, ... of one shape, on a floor or in free space."""
    bodies = [make_body(f"b{k}", 0, place, **fields) for k, place in enumerate(places)]
    if floor:
        bodies.append(ground(1))
    none = EARTH if floor else np.zeros(3)
    return Scene((shape, PLANE), tuple(bodies), none if gravity is None else gravity, 1.0)


def ground(shape: int) -> Body:
    return make_body("floor", shape, [0, 0, 0], motion="static", mass=0.0)


def ring() -> Shape:
    """A fitted network, 1 m across."""
    from sdfsim.shape.shape import scaled

    shape = load_shape(SAMPLES / "shapes" / "ring")
    return scaled(shape, 1.0 / float(np.ptp(shape.sdf.bounds, axis=0).max()))


def mixed() -> Scene:
    """A box, a ball and a fitted ring that soon hit the floor and each other, nothing of it symmetric."""
    bodies = (
        ground(3),
        make_body("box", 0, [0.0, 0.0, 0.78], quat_xyzw=TILTED, velocity=np.array([1.0, 0.5, -3.0])),
        make_body("ball", 1, [0.95, 0.3, 0.6], angular_velocity=np.array([3.0, 0.0, 1.0]), mass=2.0),
        make_body("ring", 2, [0.3, 0.2, 1.5], quat_xyzw=TILTED[[1, 2, 0, 3]], velocity=np.array([0.0, 0.0, -4.0])),
    )
    box = analytic_shape("box", size=(1.0, 0.8, 0.6))
    return Scene((box, BALL, ring(), PLANE), bodies, EARTH, 1.0)


def heap() -> Scene:
    """27 cubes, each half inside its neighbours."""
    steps = (0.0, 0.5, 1.0)
    return placed(CUBE, [(x, y, 0.5 + z) for x in steps for y in steps for z in steps], floor=True)


def shot() -> Scene:
    """A small ball at 50 m/s against a plate of 1 cm."""
    plate = analytic_shape("box", size=(2.0, 2.0, 0.01))
    ball = make_body("ball", 1, [0.1, 0.05, 2.0], velocity=np.array([0.0, 0.0, -50.0]), scale=0.2)
    wall = make_body("plate", 0, [0, 0, 1], motion="static", mass=0.0)
    return Scene((plate, BALL), (ball, wall), EARTH, 1.0)


def unequal() -> Scene:
    """A thousand kilograms on one."""
    scene = placed(CUBE, [(0, 0, 0.5), (0.1, 0, 1.55)], floor=True)
    light, heavy, floor = scene.bodies
    return replace(scene, bodies=(light, replace(heavy, mass=1000.0), floor))


CASES: dict[str, Callable[[], Scene]] = {
    "mixed": mixed,
    "overlapping": lambda: placed(BALL, [(0, 0, 0.5), (0.5, 0, 0.6)], floor=True),
    "in the floor": lambda: placed(CUBE, [(0, 0, 0)], floor=True),
    "heap": heap,
    "shot": shot,
    "unequal": unequal,
    "thin": lambda: placed(analytic_shape("box", size=(1, 1, 0.01)), [(0, 0, 0.3)], floor=True, quat_xyzw=TILTED),
    "needle": lambda: placed(analytic_shape("box", size=(1, 0.01, 0.01)), [(0, 0, 0.4)], floor=True, quat_xyzw=TILTED),
}


def assert_sound(rollout: Rollout) -> None:
    """Finite throughout, and every orientation a rotation."""
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        assert np.isfinite(getattr(rollout, name)).all(), name
    turn = pose.to_matrix(rollout.orientation)
    assert np.abs(turn.swapaxes(-1, -2) @ turn - np.eye(3)).max() <= 1e-5
    assert np.linalg.det(turn).min() > 0


def moving(scene: Scene) -> list[int]:
    return [k for k, b in enumerate(scene.bodies) if b.motion == "dynamic"]
