"""Random pairs of convex solids through the contact search, against truths that share no code with it."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import fcl
import numpy as np
import pytest
from numba import njit
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sdfsim.physics.solver.clipping import polygons_room, touching_points
from sdfsim.physics.solver.convex import Convex, Pair, closest, outermost, simplex_room
from sdfsim.physics.solver.prepare import _packed
from sdfsim.sdf.closed_forms import BoxSdf, CapsuleSdf, ConeSdf, CylinderSdf, SphereSdf
from sdfsim.shape.convex_pieces import ConvexPiece, closed_form, hull
from tests.reference.solids import KINDS, Solid, across, is_sharp, least_depth, overlap, placed, views, width

BLOCK, BLOCKS, MANY = 500, 3, 200  # pairs of a test; tests of the fast suite, and of both: 1,500 and 100,000 pairs
GAPS = (0.0, 1e-6, 1e-3, 0.1, 1.0, -1e-6, -1e-3, -1e-2, -3e-2)  # of the smaller thickness
REACH = 0.015  # of the smaller body: points are told of gaps up to here
FORMS = {"sphere": SphereSdf, "capsule": CapsuleSdf, "cylinder": CylinderSdf, "cone": ConeSdf}


@njit
def ask(convex, matrix, pair, reach):
    """What the kernels say of two pieces at first sight: gap, normal, closest points, and the points picked."""
    polygons, n = polygons_room(), (0.0, 0.0, 1.0)
    gap, n, own, his = closest(convex, matrix, pair, n, False, np.inf, simplex_room())
    if gap > reach:
        return gap, n, own, his, polygons.clipped[:0].copy(), polygons.gap[:0].copy()
    picked, _ = touching_points(convex, matrix, pair, False, False, gap, n, own, his, reach, polygons)
    chosen = polygons.picked[:picked]
    return gap, n, own, his, polygons.clipped[chosen].copy(), polygons.gap[chosen].copy()


class Case(NamedTuple):
    """Two solids as they lie, the second with its origin at that of the world."""

    kinds: tuple[str, str]
    sizes: tuple[np.ndarray, np.ndarray]
    scales: tuple[float, float]
    turns: np.ndarray  # [2, 3, 3]
    offset: np.ndarray  # [3]

    def solids(self) -> tuple[Solid, Solid]:
        offsets = (self.offset, np.zeros(3))
        one, other = (
            placed(*some) for some in zip(self.kinds, self.sizes, self.turns, offsets, self.scales, strict=True)
        )
        return one, other


def drawn_shape(draw: np.random.Generator, kind: str = "") -> tuple[str, np.ndarray]:
    """A kind and its sizes, or its vertices; aspects up to 1:100."""
    kind = kind or str(draw.choice(KINDS, p=[0.08, 0.12, 0.3, 0.2, 0.3]))
    sizes = 10.0 ** draw.uniform(-2.0, 0.0, 3)
    if kind != "hull":
        return kind, sizes[: {"sphere": 1, "box": 3}.get(kind, 2)]
    form = draw.integers(4)
    if form == 0:  # an odd lump
        points = draw.normal(size=(draw.integers(4, 20), 3))
    elif form == 1:  # round, with small faces
        points = draw.normal(size=(draw.choice([12, 30, 100]), 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    else:  # a prism, or one whose ends differ
        corners = draw.integers(3, 12)
        angle = 2.0 * np.pi * np.arange(corners) / corners
        top = 1.0 if form == 2 else draw.uniform(0.3, 1.0)
        ring = np.stack([np.cos(angle), np.sin(angle), np.ones(corners)], 1)
        points = np.concatenate([ring * [1, 1, -1], ring * [top, top, 1]])
    return kind, points * sizes


def drawn(seed: int, kind: str = "") -> Case:
    """Touching, near, or a little in each other; at random, aligned, or nearly so. The first is of a `kind`."""
    draw = np.random.default_rng(seed)
    (one, other), turns = (
        (drawn_shape(draw, kind), drawn_shape(draw)),
        Rotation.random(2, random_state=draw).as_matrix(),
    )
    ratio = 10.0 ** draw.uniform(-1.5, 1.5)
    scales = (ratio, 1.0) if draw.random() < 0.5 else (1.0, ratio)
    if draw.random() < 0.6:
        tilt = draw.choice([0.0, 1e-9, 1e-6, 1e-3, 1e-2], p=[0.4, 0.15, 0.15, 0.15, 0.15]) * draw.normal(size=3)
        quarter = Rotation.from_euler("xyz", 0.5 * np.pi * draw.integers(0, 4, 3))
        about = Rotation.from_rotvec([0.0, 0.0, draw.choice([0.0, draw.uniform(0, 6)])])
        turns[0] = turns[1] @ (Rotation.from_rotvec(tilt) * quarter * about).as_matrix()
    case = Case((one[0], other[0]), (one[1], other[1]), scales, turns, np.zeros(3))
    a, b = case.solids()
    ways = np.concatenate([draw.normal(size=(1, 3)), a.planes[:, :3], b.planes[:, :3], _crosses(draw, a, b)])
    way = ways[0] if draw.random() < 0.3 else ways[draw.integers(len(ways))]
    way = way / np.linalg.norm(way)
    # Somewhere in the one over somewhere in the other.
    there = _within(draw, b) - _within(draw, a)
    gap = draw.choice(GAPS) * min(a.thickness, b.thickness)
    lift = gap - width(a, b, way[None])[0]
    case = case._replace(offset=there - (there @ way) * way + lift * way)
    # Another normal may show more.
    if len(a.core) > 1 and len(b.core) > 1 and draw.random() < 0.8:
        n, seen = views(*case.solids())
        best = int(seen.argmax())
        if seen[best] > gap:
            case = case._replace(offset=case.offset + (gap - seen[best]) * n[best])
    return case


def _crosses(draw: np.random.Generator, a: Solid, b: Solid) -> np.ndarray:
    if not len(a.edges) or not len(b.edges):
        return np.zeros((0, 3))
    found = np.cross(a.edges[draw.integers(len(a.edges), size=4)], b.edges[draw.integers(len(b.edges), size=4)])
    return found[np.linalg.norm(found, axis=1) > 1e-6]


def _within(draw: np.random.Generator, solid: Solid) -> np.ndarray:
    """A point of a solid, often at its rim."""
    share = draw.dirichlet(np.full(len(solid.core), draw.choice([0.2, 1.0])))
    beside = np.cross(solid.axis, draw.normal(size=3))
    return share @ solid.core + solid.disc * draw.random() * beside / np.linalg.norm(beside)


def piece(kind: str, sizes: np.ndarray) -> ConvexPiece:
    if kind == "hull":
        return hull(sizes)
    found = closed_form(BoxSdf(tuple(sizes)) if kind == "box" else FORMS[kind](*map(float, sizes)))
    assert found is not None
    return found


def packed(case: Case) -> tuple[Convex, Pair]:
    convex = _packed([(piece(k, s),) for k, s in zip(case.kinds, case.sizes, strict=True)])
    return convex, Pair(0, 1, 0, 1, *map(float, case.scales), tuple(map(float, case.offset)))


def faults(case: Case) -> list[str]:
    """What the contact search gets wrong of a pair, in words; in front of each its kind."""
    a, b = case.solids()
    convex, pair = packed(case)
    thick, extent = min(a.thickness, b.thickness), max(a.extent, b.extent)
    reach = REACH * min(a.extent, b.extent)
    gap, n, own, his, points, gaps = ask(convex, np.ascontiguousarray(case.turns), pair, reach)
    n, own, his = map(np.array, (n, own, his))
    tol, found = max(1e-3 * thick, 1e-9 * extent), []

    def check(kind: str, wrong: float, most: float) -> None:
        if not abs(wrong) <= most:
            found.append(f"{kind}: {wrong / thick:.2g} of the thickness (at most {most / thick:.2g})")

    check("unit normal", float(np.linalg.norm(n)) - 1.0, 1e-9)
    check("gap along the normal", gap - float(width(a, b, n[None])[0]), tol)
    check("first witness on its surface", float(a.outside(own[None])[0]), tol)
    check("second witness on its surface", float(b.outside(his[None])[0]), tol)
    check("witnesses apart by the gap", float(np.linalg.norm(own - his - gap * n)), tol)
    # Of cores that are apart the normal and the two points prove the distance.
    apart = gap + a.round + b.round
    cores = [solid.outside((p + way * solid.round * n)[None])[0] + solid.round
             for solid, p, way in ((a, own, 1.0), (b, his, -1.0))]  # fmt: skip
    proved = apart > 0 and max(cores) <= tol
    if not proved:
        truth = least_depth(a, b)[0]
        check("gap", gap - truth if gap < truth else 0.0, tol)
    flat = np.concatenate([-a.planes[:, :3], b.planes[:, :3]])
    for face in flat[flat @ n > np.cos(0.01)]:
        at_face, at_n = width(a, b, np.stack([face, n]))
        if at_face >= at_n - 1e-12 * extent and is_sharp(a, b, face):
            check("normal of a face", float(np.linalg.norm(n - face)) * thick, 1e-6 * thick)
    if gap > reach:
        return found
    if not len(points):
        return [*found, "missed: no point"]
    check("a point has the pair's gap", gaps.min() - gap, tol)
    for p, one in zip(points, gaps, strict=True):
        there = p - one * n
        # The higher end of a slanted capsule is told as if it were level: within its solid, by less than it is higher.
        slanted = max(one - gap, 0.0)
        check("point on its surface", float(a.outside(p[None])[0]), tol + slanted * (a.kind == "capsule"))
        check("point's gap", float(b.outside(there[None])[0]), tol + slanted * (b.kind == "capsule"))
        above = float(b.outside((there + 0.01 * thick * n)[None])[0])
        check("point's gap, wrong side", min(0.0, above), tol + slanted * (b.kind == "capsule"))
    mine, theirs = a.face(-n), b.face(n)
    if mine is not None and theirs is not None:
        common = overlap(mine, theirs, n)
        # The rim of a drum may be told as a polygon, which leaves out a few hundredths of the end.
        least = 0.03 if a.disc or b.disc else 1e-6
        if common > least * min(overlap(face, face, n) for face in (mine, theirs)):
            spanned = overlap(points, 2.0 * extent * _square(n) + points.mean(0), n) if len(points) > 2 else 0.0
            check("span of a face", min(0.0, spanned / common - 0.4) * thick, 0.0)
    return found


def _square(n: np.ndarray) -> np.ndarray:
    u, w = across(n)
    return np.stack([u + w, w - u, -u - w, u - w])


@pytest.mark.parametrize(
    "block", [pytest.param(k, marks=[pytest.mark.slow] if k >= BLOCKS else []) for k in range(MANY)]
)
@pytest.mark.parametrize("kind", ["", "cone"])
def test_no_contact_of_convex_solids_is_missed_or_wrong(block, kind):
    wrong, kinds = [], Counter()
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        case = drawn(seed, kind)
        for fault in faults(case):
            wrong.append(f"{seed} {' on '.join(case.kinds)}: {fault}")
            kinds[fault.split(":")[0]] += 1
    assert not wrong, f"{len(wrong)} of {BLOCK}: {dict(kinds)}\n" + "\n".join(wrong[:20])


@njit
def outermost_of(convex: Convex, d: tuple[float, float, float]) -> int:
    return outermost(convex, 0, d)


@pytest.mark.parametrize("count", [4, 47, 48, 49, 96, 97, 300])
def test_the_farthest_corner_of_a_hull_is_found_among_all(count):
    draw = np.random.default_rng(count)
    corners = draw.normal(size=(count, 3))
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)  # all of them are corners of the hull
    convex = _packed([(hull(corners * [1.0, 0.3, 0.1]),)])
    for d in draw.normal(size=(200, 3)):
        found = outermost_of(convex, tuple(d.tolist()))
        assert convex.vertex[found] @ d == pytest.approx((convex.vertex @ d).max(), abs=1e-12)


def fcl_shape(kind: str, sizes: np.ndarray, scale: float) -> fcl.CollisionGeometry:
    sizes = scale * sizes
    if kind == "hull":
        found = ConvexHull(sizes)
        faces, corner = found.simplices.copy(), sizes[found.simplices]
        out = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        inwards = (out * found.equations[:, :3]).sum(1) < 0
        faces[inwards] = faces[inwards][:, ::-1]
        return fcl.Convex(sizes, len(faces), np.column_stack([np.full(len(faces), 3), faces]).reshape(-1))
    if kind == "sphere":
        return fcl.Sphere(sizes[0])
    if kind == "box":
        return fcl.Box(*(2.0 * sizes))
    return (fcl.Capsule if kind == "capsule" else fcl.Cylinder)(sizes[0], 2.0 * sizes[1])


def test_another_library_finds_the_same_distances_and_none_that_is_less():
    """Pairs that are apart, against the flexible collision library. It ends early on slender bodies, with distances
    that are up to some percent of a thickness too large; a distance that is less than ours would be our fault."""
    compared = alike = 0
    for seed in range(1000):
        case = drawn(seed)
        a, b = case.solids()
        thick, extent = min(a.thickness, b.thickness), max(a.extent, b.extent)
        convex, pair = packed(case)
        gap = ask(convex, np.ascontiguousarray(case.turns), pair, 0.0)[0]
        placed_at = zip(case.kinds, case.sizes, case.scales, case.turns, (case.offset, np.zeros(3)), strict=True)
        bodies = [fcl.CollisionObject(fcl_shape(*some), fcl.Transform(turn, at)) for *some, turn, at in placed_at]
        other = fcl.distance(*bodies, fcl.DistanceRequest(), fcl.DistanceResult())
        if other < 0.01 * thick:
            continue  # it knows no depth
        compared += 1
        assert gap < other + 1e-3 * thick + 1e-6 * extent, (seed, gap, other)
        alike += gap > other - 1e-3 * thick - 1e-5 * extent
    assert compared > 300 and alike > 0.95 * compared
