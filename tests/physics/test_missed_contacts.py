"""Pairs of bodies that just touch, put into scenes of two: does a step tell the contact? Where they touch is found on
their true surfaces alone (`true_surfaces`), which know nothing of the contact search. And bodies that slide from one
support to the next: seams and gaps at equal height are no walls, everything else is."""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim import Rollout, Simulator
from sdfsim.evaluation.true_surfaces import Placed, TrueSurface, gaps, true_surface
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull
from sdfsim.scene.builder import SceneBuilder
from sdfsim.scene.scene import Scene
from sdfsim.sdf.baked_grid import baked
from sdfsim.shape.make import analytic_shape, mesh_shape
from sdfsim.shape.shape import Shape, load_shape, with_sdf
from tests.helpers.scenes import make_body as body
from tests.helpers.shapes import SHAPES, joined

CONVEX = ("box", "stick", "plate", "sphere", "capsule", "cylinder", "disc", "hull", "cube mesh", "ball mesh")
HOLLOW = ("ring", "bowl", "can", "torus mesh", "gear mesh", "bowl mesh")
AGAINST = ("sphere", "capsule", "box", "stick", "cylinder")
FEW, MANY = 2, 150  # pairs of two kinds, in the fast suite and in the slow one
DEPTH = 2e-3  # of the smaller one's thickness: how deep they are in each other


@cache
def shape(kind: str) -> Shape:
    """One of each kind, about 1 m wide."""
    if kind in ("ring", "bowl", "can"):
        return with_sdf(load_shape(SHAPES / kind), "mesh")
    sizes = {"box": (1.0, 0.7, 0.5), "stick": (1.0, 0.05, 0.05), "plate": (1.0, 0.7, 0.02)}
    if kind in sizes:
        return analytic_shape("box", size=sizes[kind])
    if kind == "sphere":
        return analytic_shape("sphere", radius=0.5)
    if kind == "capsule":
        return analytic_shape("capsule", radius=0.15, height=0.7)
    if kind == "cylinder":
        return analytic_shape("cylinder", radius=0.2, height=1.0)
    if kind == "disc":
        return analytic_shape("cylinder", radius=0.5, height=0.05)
    meshes = {
        "cube mesh": primitives.box, "ball mesh": lambda: primitives.sphere(0.5, 2), "torus mesh": primitives.torus,
        "gear mesh": primitives.gear, "bowl mesh": primitives.bowl, "hull": lump,
    }  # fmt: skip
    return mesh_shape(meshes[kind](), name=kind, kind="mesh")


def lump() -> Mesh:
    points = np.random.default_rng(5).normal(size=(24, 3))
    return convex_hull(0.5 * points / np.linalg.norm(points, axis=1, keepdims=True) * [1.0, 0.6, 0.4])


@cache
def truth(kind: str) -> TrueSurface:
    return true_surface(shape(kind))


@cache
def bake_error(kind: str) -> float:
    """m, how wrong the distances of a shape are that is met as a surface."""
    return baked(shape(kind).sdf, shape(kind).nodes).error if kind in HOLLOW else 0.0


def touching(kinds: tuple[str, str], count: int, seed: int) -> tuple[Placed, Placed, np.ndarray]:
    """Pairs that are a little in each other, somewhere on their surfaces; and how deep they are [P] m."""
    draw, solids = np.random.default_rng(seed), [truth(kind) for kind in kinds]
    more = 3 * count + 6
    scale = np.stack([np.ones(more), 10.0 ** draw.uniform(-1.3 if kinds[0] in CONVEX else -0.7, 0.3, more)], 1)
    turn = Rotation.random(2 * more, random_state=draw).as_matrix().reshape(more, 2, 3, 3)
    extent = np.ptp(solids[0].bounds, axis=0)
    scale[:, 1] *= extent.max() / np.ptp(solids[1].bounds, axis=0).max()
    place = solids[0].bounds.mean(0) + draw.uniform(-0.9, 0.9, (more, 3)) * extent
    first = Placed(np.zeros(more, int), scale[:, 0], np.zeros((more, 3)), turn[:, 0])
    second = Placed(np.ones(more, int), scale[:, 1], np.einsum("pij,pj->pi", turn[:, 0], place), turn[:, 1])
    thick = np.minimum(solids[0].thickness, solids[1].thickness * scale[:, 1])
    depth = np.maximum(DEPTH * thick, 2.0 * bake_error(kinds[0]))
    most = np.full(more, np.inf)
    # Those that are apart come nearer along the shortest way, until they touch.
    found = gaps(solids, first, second, most)
    rows = np.flatnonzero((found.apart > 0) & (found.surely > 0) & (depth < 0.1 * thick))[: count + 1]
    first, second, depth = first[rows], second[rows], depth[rows]
    for k in range(8):
        found = gaps(solids, first, second, most[: len(rows)])
        wanted = -depth if k > 5 else 0.0 * depth
        way = found.normal * (found.sign * (found.apart - wanted))[:, None]
        second = Placed(second.solid, second.scale, second.origin + way, second.turn)
    deep = -gaps(solids, first, second, most[: len(rows)]).apart
    good = np.flatnonzero(np.abs(deep - depth) < 0.5 * depth)[:count]
    return first[good], second[good], deep[good]


def told(kinds: tuple[str, str], first: Placed, second: Placed, k: int) -> float | None:
    """How deep the two bodies of a scene are in each other, as a step tells it; None without a contact."""
    bodies = [
        body(name, n, p.origin[k], 1.0, scale=float(p.scale[k]), quat_xyzw=Rotation.from_matrix(p.turn[k]).as_quat(),
             restitution=0.0, motion="static" if n == 0 else "dynamic")
        for n, (name, p) in enumerate((("first", first), ("second", second)))
    ]  # fmt: skip
    simulator = Simulator(Scene(tuple(map(shape, kinds)), tuple(bodies), np.zeros(3), 1.0), "solver")
    simulator.step()
    found = [point.penetration for point in simulator.contact_points()]
    return max(found) if found else None


PAIRS = [*combinations_with_replacement(CONVEX, 2), *((one, other) for one in HOLLOW for other in AGAINST)]


def missed(kinds: tuple[str, str], count: int, seed: int) -> tuple[int, list[str]]:
    """How many pairs were asked, and those without a contact, or with one that is far from the truth."""
    first, second, deep = touching(kinds, count, seed)
    wrong = []
    for k in range(len(deep)):
        found = told(kinds, first, second, k)
        thick = min(truth(kinds[0]).thickness, float(second.scale[k]) * truth(kinds[1]).thickness)
        place = f"pair {k} of {kinds}, seed {seed}, scale {second.scale[k]:.3g}"
        if found is None:
            wrong.append(f"{place}: missed")
        elif not abs(found - deep[k]) < deep[k] + 5e-3 * thick:  # crossing edges have no point that is as deep
            wrong.append(f"{place}: {found / thick:.3g} of the thickness deep, truth {deep[k] / thick:.3g}")
    return len(deep), wrong


@pytest.mark.parametrize(("count", "least"), [(FEW, 0), pytest.param(MANY, FEW, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kinds", PAIRS, ids=" on ".join)
def test_a_step_tells_every_contact(kinds, count, least):
    asked, wrong = missed(kinds, count, seed=least)
    assert asked > least and not wrong, f"{len(wrong)} of {asked}:\n" + "\n".join(wrong[:10])


LOW = ((0.4, -0.3, 0.0), (1.0, 0.3, 0.8))  # a block that is lower than the one beside it
LEG = ((0.2, -0.05, 0.5), (0.3, 0.05, 1.01))  # of a hook that hangs down in front of the low block


@pytest.mark.parametrize("speed", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("pieces", [True, False])
def test_what_hangs_below_its_support_meets_walls(pieces, speed):
    """A hook slides on the higher of two blocks, which are one body; its leg stops at the lower one, all of which is
    below the plane that the hook stands on. Such a block is no wall only for what is above that plane."""
    hook = joined("hook", [((-1.2, -0.05, 1.0), (0.35, 0.05, 1.1)), LEG], pieces=pieces)
    blocks = joined("blocks", [((-1.3, -0.3, 0.0), (0.0, 0.3, 1.0)), LOW], pieces=True)
    bodies = [
        body("blocks", 0, np.zeros(3), 1.0, restitution=0.0, motion="static"),
        body("hook", 1, np.zeros(3), 1.0, restitution=0.0, friction=0.0, velocity=(speed, 0.0, 0.0)),
    ]
    simulator = Simulator(Scene((blocks, hook), tuple(bodies), np.array([0.0, 0.0, -9.81]), 1.0), "solver")
    low, high = np.array(LEG)
    corners = low + (high - low) * np.stack(np.meshgrid([0, 1], [0, 1], np.linspace(0, 1, 20)), -1).reshape(-1, 3)
    for state in simulator.steps(4 + round(8 / speed)):  # enough for 16 cm, where the gap is 10 cm
        there = state.position[1] + Rotation.from_quat(state.orientation[1]).apply(corners - hook.com)
        beyond = np.maximum(there - np.array(LOW)[1], np.array(LOW)[0] - there).max(1)
        assert beyond.min() > -0.005


JACK = [
    ((-0.5, -0.1, -0.1), (0.5, 0.1, 0.1)),
    ((-0.1, -0.5, -0.1), (0.1, 0.5, 0.1)),
    ((-0.1, -0.1, -0.5), (0.1, 0.1, 0.5)),
]
TABLE = [((-0.5, -0.4, -0.05), (0.5, 0.4, 0.05))]
TABLE += [((x - 0.06, y - 0.06, -0.6), (x + 0.06, y + 0.06, 0.05)) for x in (-0.4, 0.4) for y in (-0.3, 0.3)]


def deepest(boxes: list, points: np.ndarray) -> float:
    """m, how deep the deepest of points [P, 3] is in any of some boxes."""
    return float(
        max((-np.maximum(np.array(low) - points, points - np.array(high)).max(-1)).max() for low, high in boxes)
    )


def spread(boxes: list, count: int = 12) -> np.ndarray:
    """Points [P, 3] on the surfaces of boxes, `count` along an edge."""
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, count)] * 3, indexing="ij"), -1).reshape(-1, 3)
    grid = grid[((grid == 0) | (grid == 1)).any(1)]
    return np.concatenate([np.array(low) + np.subtract(high, low) * grid for low, high in boxes])


def test_bodies_of_several_pieces_do_not_pass_into_each_other():
    """Jacks and tables that fly and spin into each other, 8 m/s at most. When contacts with parts below the plane of
    another contact were given up, a quarter of such pairs went 2 to 10 cm into each other; now they go 5 mm at most."""
    draw, kinds, bodies = np.random.default_rng(3), (JACK, TABLE), []
    shapes = [joined(name, boxes, pieces=True) for name, boxes in zip(("jack", "table"), kinds, strict=True)]
    for k in range(20):
        way = draw.normal(size=3)
        way, speed = way / np.linalg.norm(way), draw.uniform(2, 6)
        for side in (0, 1):
            place = [20.0 * k, 0, 0] + side * (2.0 * way + draw.uniform(-0.3, 0.3, 3))
            bodies.append(body(
                f"{k} {side}", int(draw.integers(2)), place, 1.0, restitution=0.0, friction=0.3,
                quat_xyzw=Rotation.random(random_state=draw).as_quat(), velocity=-side * speed * way,
                angular_velocity=draw.uniform(-4, 4, 3),
            ))  # fmt: skip
    simulator = Simulator(Scene(tuple(shapes), tuple(bodies), np.zeros(3), 1.0), "solver")
    points, worst, met = [spread(boxes) for boxes in kinds], 0.0, set()
    for state in simulator.steps(60):
        turn = Rotation.from_quat(state.orientation)
        met |= {point.first.split()[0] for point in simulator.contact_points()}
        for one in range(len(bodies)):
            other = one ^ 1
            s, t = bodies[one].shape, bodies[other].shape
            place = state.position[one] + turn[one].apply(points[s] - shapes[s].com)
            worst = max(
                worst, deepest(kinds[t], turn[other].inv().apply(place - state.position[other]) + shapes[t].com)
            )
    assert len(met) > 10  # of 20 pairs
    assert worst < 0.01


NEAR = ((-1.0, -0.3, -0.1), (0.0, 0.3, 0.0))  # a support whose top is at height 0 and that ends at x = 0
APART = ((-0.05, -0.05, -1.05), (0.05, 0.05, -0.95))  # a piece that touches nothing
BOX = [((-0.3, -0.15, 0.0), (0.3, 0.15, 0.1))]
DESK = [((-0.3, -0.15, 0.06), (0.3, 0.15, 0.1))]
DESK += [((x, -0.15, 0.0), (x + 0.1, 0.15, 0.06)) for x in (-0.3, 0.2)]


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


@pytest.mark.parametrize("boxes", [BOX, DESK], ids=["box", "table"])
@pytest.mark.parametrize(("gap", "speed", "size"), [(1e-3, 0.5, 1.0), (0.01, 0.5, 1.0), (0.05, 0.5, 1.0),
                                                    (0.02, 3.0, 1.0), (0.02, 0.1, 1.0), (0.02, 0.5, 0.05),
                                                    (0.02, 0.5, 20.0)])  # fmt: skip
def test_a_gap_between_two_supports_is_no_wall(boxes, gap, speed, size):
    """The body is always supported: its centre is on the first support until its front is on the second."""
    it = joined("it", boxes, pieces=True)
    check_speed(slid([one(NEAR), one(far(gap))], it, speed, size, 0.9 / speed), speed, size)


def test_slats_are_a_floor():
    slats = [one(((x, -0.3, -0.05), (x + 0.08, 0.3, 0.0))) for x in np.arange(-1.0, 1.2, 0.12)]
    for boxes in (BOX, DESK):
        check_speed(slid(slats, joined("it", boxes, pieces=True), 1.0, 1.0, 1.2), 1.0, 1.0)


@pytest.mark.parametrize("gap", [0.0, 0.05])
@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("boxes", [BOX, DESK], ids=["box", "table"])
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


G = 9.81


@pytest.fixture
def tube(tmp_path):
    """A tube of 96 facets whose walls are two and a half cells of its grid: its bore is 49.97 mm from the axis."""
    file = tmp_path / "tube.obj"
    import trimesh

    trimesh.creation.annulus(0.05, 0.06, height=0.5, sections=96).export(file)
    return file


@pytest.mark.parametrize("sdf", ["mesh", "grid"])
@pytest.mark.parametrize("radius", [0.0495, 0.049, 0.04])
@pytest.mark.parametrize("scale", [0.1, 1.0, 100.0])
def test_a_ball_falls_through_a_tube_that_it_fits(tube, sdf, radius, scale):
    scene = SceneBuilder()
    scene.add("tube", mesh=tube, sdf=sdf, scale=scale, motion="static", friction=0, restitution=0)
    scene.add("ball", sphere={"radius": scale * radius}, position=(0, 0, 0.15 * scale), friction=0, restitution=0)
    ran = Simulator(scene).run(seconds=0.2 * np.sqrt(scale))
    fallen = 0.5 * G * ran.time[-1] ** 2
    assert 0.15 * scale - ran.position[-1, 1, 2] == pytest.approx(fallen, rel=0.01)


def test_nodes_between_others_lie_on_the_surface(tube):
    """Within a twentieth of a cell, but for what is next to an edge, which the grid rounds off."""
    scene = SceneBuilder()
    scene.add("tube", mesh=tube, sdf="mesh", motion="static")
    node = scene.load().shapes[0].contact.surface.node
    radius = np.hypot(node[:, 0], node[:, 1])[np.abs(node[:, 2]) < 0.24]
    away = np.minimum(np.abs(radius - 0.05), np.abs(radius - 0.06))
    assert len(radius) > 500
    assert away.max() < 2e-4
