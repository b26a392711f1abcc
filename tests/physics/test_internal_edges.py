"""Bodies that slide from one support to the next: seams and gaps at equal height are no walls, everything else is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Rollout, Simulator
from sdfsim.geometry.primitives import torus
from sdfsim.physics.solver.world import GAP, VOID
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.shape.shape import Shape
from tests.helpers.scenes import make_body as body
from tests.physics.test_missed_contacts import deepest, joined, spread

NEAR = ((-1.0, -0.3, -0.1), (0.0, 0.3, 0.0))  # a support whose top is at height 0 and that ends at x = 0
APART = ((-0.05, -0.05, -1.05), (0.05, 0.05, -0.95))  # a piece that touches nothing
BOX = [((-0.3, -0.15, 0.0), (0.3, 0.15, 0.1))]
TABLE = [((-0.3, -0.15, 0.06), (0.3, 0.15, 0.1))]
TABLE += [((x, -0.15, 0.0), (x + 0.1, 0.15, 0.06)) for x in (-0.3, 0.2)]


def far(gap: float, height: float = 0.0) -> tuple[tuple, tuple]:
    """The next support, after a gap, and that much higher."""
    return ((gap, -0.3, -0.1), (gap + 1.0, 0.3, height))


def slid(floor: list[tuple[Shape, np.ndarray]], it: Shape, speed: float, size: float, seconds: float) -> Rollout:
    """A body that starts 0.5 m before the end of the first support; lengths are `size` times as large."""
    shapes = [shape for shape, _ in floor]
    bodies = [
        body(f"floor{k}", k, size * place, motion="static", friction=0.0, restitution=0.0, scale=size)
        for k, (_, place) in enumerate(floor)
    ]
    start = size * np.array([-0.5, 0.01, 0.0])
    moving = {"velocity": (speed * np.sqrt(size), 0, 0), "friction": 0.0, "restitution": 0.0, "scale": size}
    bodies.append(body("it", len(shapes), start, 1.0, **moving))
    scene = Scene((*shapes, it), tuple(bodies), np.array([0, 0, -9.81]), 10.0)
    return Simulator(scene, "solver").run(seconds * np.sqrt(size))


def one(box: tuple[tuple, tuple]) -> tuple[Shape, np.ndarray]:
    """A box as a shape of its own, with the place of its centre."""
    low, high = np.array(box)
    return analytic_shape("box", size=tuple(high - low)), (low + high) / 2


def one_body(boxes: list) -> list[tuple[Shape, np.ndarray]]:
    return [(joined("floor", boxes, pieces=True), np.zeros(3))]


def check_speed(rollout: Rollout, speed: float, size: float, within: float = 1e-3) -> None:
    assert rollout.position[-1, -1, 0] > 0.2 * size  # it is across
    assert rollout.velocity[:, -1] == pytest.approx(
        np.tile([speed * np.sqrt(size), 0, 0], (len(rollout.time), 1)), abs=within * speed * np.sqrt(size)
    )


@pytest.mark.parametrize("order", ["AB", "BA", "CAB", "ACB", "BAC"])
@pytest.mark.parametrize("gap", [0.0, 0.02])
def test_the_order_of_pieces_does_not_matter(order, gap):
    pieces = {"A": NEAR, "B": far(gap), "C": APART}
    floor = one_body([pieces[name] for name in order])
    check_speed(slid(floor, joined("it", BOX, pieces=True), 0.5, 1.0, 1.8), 0.5, 1.0)


@pytest.mark.parametrize("boxes", [BOX, TABLE], ids=["box", "table"])
@pytest.mark.parametrize(("gap", "speed", "size"), [(1e-3, 0.5, 1.0), (0.01, 0.5, 1.0), (0.05, 0.5, 1.0),
                                                    (0.02, 3.0, 1.0), (0.02, 0.1, 1.0), (0.02, 0.5, 0.05),
                                                    (0.02, 0.5, 20.0)])  # fmt: skip
def test_a_gap_between_two_supports_is_no_wall(boxes, gap, speed, size):
    """The body is always supported: its centre is on the first support until its front is on the second."""
    it = joined("it", boxes, pieces=True)
    check_speed(slid([one(NEAR), one(far(gap))], it, speed, size, 0.9 / speed), speed, size)


def test_slats_are_a_floor():
    slats = [one(((x, -0.3, -0.05), (x + 0.08, 0.3, 0.0))) for x in np.arange(-1.0, 1.2, 0.12)]
    for boxes in (BOX, TABLE):
        check_speed(slid(slats, joined("it", boxes, pieces=True), 1.0, 1.0, 1.2), 1.0, 1.0)


@pytest.mark.parametrize("gap", [0.0, 0.05])
@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("boxes", [BOX, TABLE], ids=["box", "table"])
def test_a_step_up_is_a_wall(boxes, gap, together, speed=0.5):
    pieces = [NEAR, far(gap, height=0.01)]
    floor = one_body(pieces) if together else [one(piece) for piece in pieces]
    rollout = slid(floor, joined("it", boxes, pieces=True), speed, 1.0, 2.0)
    assert rollout.velocity[-1, -1, 0] == pytest.approx(0.0, abs=0.03)  # it is hit below its centre, and rocks
    assert rollout.position[:, -1, 0].max() == pytest.approx(gap - 0.3, abs=1e-3)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_who_falls_into_a_gap_meets_its_far_side(together, speed):
    """A gap in which the body has room: its front sinks below the far edge, or it falls in, and what it then meets is a
    wall. It never gets deep into one of the supports."""
    deep = [((-1.0, -0.3, -1.0), (0.0, 0.3, 0.0)), ((0.7, -0.3, -1.0), (1.7, 0.3, 0.0))]
    floor = one_body(deep) if together else [one(piece) for piece in deep]
    it = joined("it", BOX, pieces=True)
    rollout = slid(floor, it, speed, 1.0, 1.5)
    points, worst = spread(BOX), 0.0
    for place, turn in zip(rollout.position[:, -1], rollout.orientation[:, -1], strict=True):
        worst = max(worst, deepest(deep, place + Rotation.from_quat(turn).apply(points - it.com)))
    assert worst < 0.003
    assert rollout.position[-1, -1, 2] < -0.1  # it did fall


def test_contacts_of_linked_rings_do_not_void_each_other():
    """Each point of a round surface is below the planes of the others. If all of them were internal edges, rings that
    overlap would fall through each other."""
    ring, deep = mesh_shape(torus(1.0, 0.2, 96, 32), name="ring", kind="mesh"), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3)) * Rotation.from_euler("yx", [90, 90], degrees=True)
        moving = {"velocity": rng.normal(0, 1, 3), "angular_velocity": rng.normal(0, 30, 3)}
        bodies = (
            body("upper", 0, (0, 0, 0), quat_xyzw=Rotation.from_euler("x", 90, degrees=True).as_quat()),
            body("lower", 0, (0, 0, -1.55), quat_xyzw=turn.as_quat(), **moving),
        )
        simulator = Simulator(Scene((ring,), bodies, np.zeros(3), 1.0), "solver")
        simulator.step(1)
        found = simulator.carry.scene._manifolds
        points = found.point[0, : found.count[0]]
        deep.append(points[points[:, GAP] < -1e-3])
    deepest = np.concatenate(deep)
    assert len(deepest) > 10 and not (deepest[:, VOID] > 0).any()
