"""Random scenes through the contact solve: finite, momentum kept, no energy from nothing."""

import numpy as np
import pytest

from sdfsim import Simulator
from sdfsim.scene.types import Scene
from sdfsim.shape.asset import analytic_shape, load_shape
from tests.dynamics.test_laws import body
from tests.dynamics.test_waits import SHAPES

FEW, MANY = range(60), range(2000)


def shapes() -> tuple:
    """One of each kind, about a metre wide, then the floor."""
    return (
        analytic_shape("box", size=(1.0, 0.7, 0.5)), analytic_shape("sphere", radius=0.5),
        analytic_shape("capsule", radius=0.3, height=1.2), analytic_shape("cylinder", radius=0.4, height=0.8),
        load_shape(SHAPES / "ring"), load_shape(SHAPES / "can"), analytic_shape("plane"),
    )  # fmt: skip


KINDS = shapes()
SIZE = [float(np.ptp(s.nodes, axis=0).max()) if len(s.nodes) else 1.0 for s in KINDS]
RNG = np.random.default_rng


def scene(seed: int, *, floor: bool) -> Scene:
    """Two to six bodies that fly into one another, or fall onto a floor; some start in one another."""
    draw = RNG(seed)
    bodies = []
    for k in range(draw.integers(2, 7)):
        kind = int(draw.integers(0, len(KINDS) - 1))
        scale = draw.uniform(0.5, 2.0) / SIZE[kind]
        quat = draw.normal(size=4)
        place = draw.uniform(-1.2, 1.2, 3) + (np.array([0.0, 0.0, 2.5]) if floor else 0.0)
        bodies.append(
            body(
                str(k), kind, place, 10.0 ** draw.uniform(-1.5, 1.5), scale=scale,
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3) * draw.choice([0.3, 3.0, 20.0])
                - (0.0 if floor else 2.0) * place, angular_velocity=draw.normal(size=3) * draw.choice([0.0, 1.0, 10.0]),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    if floor:
        ground = body("floor", len(KINDS) - 1, [0, 0, 0], 0.0, motion="static", friction=0.8, restitution=1.0)
        bodies.append(ground)
    return Scene(KINDS, tuple(bodies), np.array([0.0, 0.0, -9.81 if floor else 0.0]), 1.0)
