"""The explicit contact solve as a model: scenes as the compiled step wants them, and that step."""

from __future__ import annotations

import logging
import math
from collections import OrderedDict
from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch

from sdfsim.base.compiling import tell_compiling
from sdfsim.base.files import digest
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, Touch
from sdfsim.physics.options import Options
from sdfsim.physics.solver import distance as kinds
from sdfsim.physics.solver import world as compiled
from sdfsim.physics.solver.convex import BALL, BLOCK, DRUM, HULL, POINT, SEGMENT, THICKNESS, WIDTH, Convex
from sdfsim.physics.solver.record import Edges
from sdfsim.physics.solver.step import step as compiled_step
from sdfsim.physics.solver.survey import Touching, touching
from sdfsim.sdf.baked_grid import BakedGrid, baked, inwards, unseen_wall
from sdfsim.sdf.closed_forms import ClosedForm, PlaneSdf
from sdfsim.sdf.sdf import Sdf
from sdfsim.shape.convex_pieces import ConvexPiece, pieces_of
from sdfsim.shape.surface_nodes import ContactSurface, contact_surface

_log = logging.getLogger(__name__)
MOST_KEPT = 64  # shapes whose geometry stays at hand after their scenes are gone
FORMS = {
    "plane": kinds.PLANE, "sphere": kinds.SPHERE, "capsule": kinds.CAPSULE, "box": kinds.BOX,
    "cylinder": kinds.CYLINDER,
}  # fmt: skip
SOLIDS = {"sphere": POINT, "capsule": SEGMENT, "box": BLOCK, "cylinder": DRUM, "hull": HULL}
Clumps = list[list[np.ndarray]]
LEAF, CLUMP = 16, 256  # nodes that a leaf and a clump of leaves hold at most
# Penetration that is left as it is, so that what rests has contacts that do not come and go: model lengths, and less in
# inner steps below the usual 4 ms, which scenes of slender bodies have.
SLOP, SLOP_A_TIME = 5e-4, 0.125
TOUCHING = 1e-3  # model lengths, within which a point is told as a contact
COARSE = 0.01  # model times: in longer inner steps what is hit in their course is recorded as well
SLOW = 2.0  # an approach that gravity makes in so many inner steps ends at the surface without a rebound
# Of a solid's largest extent, from where its nodes look out, and of its thickness: not out of the other side of a wall.
INWARD, SHALLOW = 0.004, 0.4


class Compiled:
    """One scene, its bodies in model units, as the compiled step wants it."""

    def __init__(self, bodies: Bodies, state: State) -> None:
        tell_compiling(compiled_step, "the contact step", "two minutes")
        self.bodies = bodies
        self.shapes = compiled_shapes(bodies)
        self.place(state)

    def place(self, state: State) -> None:
        """Scenery lies where `state` has it."""
        self.world = compiled_world(self.bodies, state, self.shapes)
        n = len(self.bodies)
        self.work = compiled.Work(
            matrix=np.ascontiguousarray(pose.to_matrix(state.orientation.cpu()).numpy()), inverse=np.zeros((n, 3, 3)),
            free=np.zeros((n, 9)), change=np.zeros((n, 6)), shift=np.zeros((n, 6)), load=np.zeros((n, 6)),
            part=np.ones(n), ways=np.zeros(n), gone=np.zeros(n), low=np.zeros((n, 3)), high=np.zeros((n, 3)),
            beside=np.zeros(n, np.bool_), met=np.zeros(n, np.bool_),
            parent=np.zeros(n, np.int64), number=np.zeros(n, np.int64), latest=np.zeros(n, np.int64),
        )  # fmt: skip

    def run(
        self, motion: compiled.Motion, manifolds: compiled.Manifolds, rules: compiled.Rules
    ) -> tuple[compiled.Manifolds, Edges, tuple[int, ...]]:
        """One step: `motion` is written to; the contacts at its end, what they did, and what was counted."""
        return compiled_step(self.shapes, self.world, self.work, motion, rules, manifolds)


def solver_step(scene: Compiled, state: State, options: Options) -> tuple[State, Edges, tuple[int, ...]]:
    """Advance `state` by one step of the contact solve; scripted bodies have the velocities of the coming step. Returns
    what contacts did where that is recorded, and counts: pairs looked at, contacts, bodies that contacts moved."""
    rules, (motion, manifolds) = compiled_rules(options), taken_up(state)
    scene.work.load[:] = 0.0 if state.load is None else state.load.numpy()
    manifolds, edges, counts = scene.run(motion, manifolds, rules)
    known = (motion.touching, motion.quiet, motion.anchor, motion.island, *manifolds)
    after = replace(
        state,
        position=torch.from_numpy(motion.position),
        orientation=torch.from_numpy(motion.orientation),
        velocity=torch.from_numpy(motion.velocity),
        angular_velocity=torch.from_numpy(motion.angular),
        time=state.time + rules.inner * rules.steps,
        touch=Touch(*map(torch.from_numpy, known)),
    )
    return scene.bodies.led(after), edges, counts


def taken_up(state: State) -> tuple[compiled.Motion, compiled.Manifolds]:
    """Copies of a state as the compiled step writes to them."""
    poses = (state.position, state.orientation, state.velocity, state.angular_velocity)
    position, orientation, *velocities = (np.array(t.cpu().numpy(), dtype=np.float64, order="C") for t in poses)
    touch = state.touch
    if touch is None:
        still, nobody = np.zeros(len(position), np.int64), np.full(len(position), -1, np.int64)
        known = still > 0, still, np.concatenate([position, orientation, position, orientation], 1), nobody
    else:
        known = (np.array(t.numpy()) for t in (touch.touching, touch.quiet, touch.anchor, touch.island))
    return compiled.Motion(position, orientation, *velocities, *known), _manifolds(touch)


def disturbed(state: State, changed: np.ndarray, *, gravity: bool = False) -> State:
    """The state after somebody has changed the bodies `changed` [N] bool, or the `gravity` of all: they are awake, and
    so are those that slept with them or on them."""
    touch = state.touch
    if touch is None:
        return state
    island, quiet, touching = (np.array(t.numpy()) for t in (touch.island, touch.quiet, touch.touching))
    beside = touch.pair.numpy()[touch.count.numpy() > 0]
    restless = changed.copy()
    restless[beside[changed[beside[:, 1]], 0]] = True
    restless[beside[changed[beside[:, 0]], 1]] = True
    up = np.full(len(island), gravity) | np.isin(island, island[restless & (island >= 0)])
    island[up], quiet[up | changed], touching[changed] = -1, 0, False
    parts = {"island": island, "quiet": quiet, "touching": touching}
    return replace(state, touch=replace(touch, **{name: torch.from_numpy(part) for name, part in parts.items()}))


def contact_points(state: State) -> Touching:
    """Where bodies touch in a state."""
    return touching(_manifolds(state.touch), state.position.numpy(), state.orientation.numpy(), TOUCHING)


def compiled_rules(options: Options) -> compiled.Rules:
    """The options of a run as the compiled step wants them."""
    gravity, inner = options.gravity.cpu().numpy(), options.dt / options.substeps
    return compiled.Rules(
        gravity, inner, options.substeps, SLOW * math.hypot(*gravity) * inner, options.friction,
        options.restitution, options.rotation, options.sleep, options.margin, options.adds, options.cone,
        options.record, ahead=inner if options.record and inner > COARSE else 0.0, slop=min(SLOP, SLOP_A_TIME * inner),
    )  # fmt: skip


def _manifolds(touch: Touch | None) -> compiled.Manifolds:
    """The contacts that are known."""
    if touch is None:
        return compiled.Manifolds(
            np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros((0, compiled.POINTS, compiled.COLUMNS))
        )
    return compiled.Manifolds(touch.pair.numpy(), touch.count.numpy(), touch.point.numpy())


def compiled_shapes(bodies: Bodies) -> kinds.Shapes:
    """The shapes of a scene, baked where they have no closed form."""
    table = np.zeros((len(bodies.sdfs), kinds.FIELDS))
    table[:, kinds.THICKNESS], table[:, kinds.CELL], table[:, kinds.PATCH] = np.inf, 1.0, -1.0
    brick, sample, label = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)], [np.zeros(0, np.int16)]
    owner = {int(s): k for k, s in reversed(list(enumerate(bodies.shape.tolist()))) if s >= 0}
    every = list(zip(bodies.sdfs, bodies.pieces, bodies.hulls, strict=True))
    # Where all shapes are convex, or made of convex pieces, none is met as a surface.
    surfaces = any(not (isinstance(sdf, ClosedForm) or len(pieces) or len(hull)) for sdf, pieces, hull in every)
    known = [_geometry(_nodes_of(bodies, owner[s]), *some, surfaces=surfaces) for s, some in enumerate(every)]
    for row, sdf, (grid, surface, *_) in zip(table, bodies.sdfs, known, strict=True):
        if surface.nearest is not None:
            row[kinds.PATCH_LOW : kinds.PATCH_LOW + 3], row[kinds.PATCH_CELL] = surface.low, surface.cell
            row[kinds.PATCHES : kinds.PATCHES + 3], row[kinds.PATCH] = surface.nearest.shape, sum(map(len, label))
            label.append(surface.nearest.reshape(-1))
        if isinstance(sdf, ClosedForm):
            row[kinds.KIND], row[kinds.SIZE : kinds.SIZE + len(sdf.sizes)] = FORMS[sdf.KIND], sdf.sizes
            if sdf.sizes:
                row[kinds.THICKNESS] = np.ptp(sdf.bounds, axis=0).min()
        elif grid is not None:
            row[kinds.KIND], row[kinds.THICKNESS], row[kinds.CELL] = kinds.GRID, grid.thickness, grid.cell
            row[kinds.LOW : kinds.LOW + 3], row[kinds.BRICKS : kinds.BRICKS + 3] = grid.low, grid.brick.shape
            row[kinds.COARSE], row[kinds.BRICK] = sum(map(len, sample)), sum(map(len, brick))
            sample.append(grid.coarse.reshape(-1))
            first, size = sum(map(len, sample)), grid.fine[:1].size
            brick.append(np.where(grid.brick >= 0, grid.brick.astype(np.int64) * size + first, -1).reshape(-1))
            sample.append(grid.fine.reshape(-1))
    arrays = (np.concatenate(parts) for parts in (brick, sample))
    solids = [g.solids for g in known]
    for row, pieces in zip(table, solids, strict=True):
        if pieces and row[kinds.KIND] == kinds.GRID:
            row[kinds.THICKNESS] = min(piece.thickness for piece in pieces)
    parts = (table, *arrays, *_joined(known), np.concatenate(label), *_packed(solids))
    return kinds.Shapes(*parts)


def _packed(solids: list[tuple[ConvexPiece, ...]]) -> Convex:
    """The convex pieces of shapes, end to end."""
    pieces = [piece for some in solids for piece in some]
    table = np.zeros((len(pieces), WIDTH))
    for row, piece in zip(table, pieces, strict=True):
        row[0], row[BALL : BALL + 4], row[THICKNESS] = SOLIDS[piece.kind], piece.ball, piece.thickness
        row[1 : 1 + len(piece.sizes)] = piece.sizes

    def ends(lengths: list[int]) -> np.ndarray:
        return np.cumsum([0, *lengths], dtype=np.int64)

    def joined(parts: list[np.ndarray], like: np.ndarray) -> np.ndarray:
        return np.concatenate([like[:0], *parts])

    whole, places = np.zeros(0, np.int64), np.zeros((0, 3))
    vertex_start, face_start = (ends([len(getattr(p, what)) for p in pieces]) for what in ("vertices", "normals"))
    ahead = list(zip(pieces, vertex_start, face_start, strict=False))
    loop = [one + first for piece, first, _ in ahead for one in piece.loops]
    beside = [one + first for piece, first, _ in ahead for one in piece.beside]
    around = [one + first for piece, _, first in ahead for one in piece.around]
    return Convex(
        start=ends([len(some) for some in solids]), table=table,
        vertex_start=vertex_start, vertex=joined([piece.vertices for piece in pieces], places),
        face_start=face_start, face=joined([piece.normals for piece in pieces], places),
        loop_start=ends([len(one) for one in loop]), loop=joined(loop, whole),
        beside_start=ends([len(one) for one in beside]), beside=joined(beside, whole),
        around_start=ends([len(one) for one in around]), around=joined(around, whole),
    )  # fmt: skip


class Geometry(NamedTuple):
    """What the solve knows of a shape."""

    grid: BakedGrid | None  # where it has no closed form
    surface: ContactSurface
    cover: np.ndarray  # [K] m, how far the surface around a node goes that is nearer to it than to others
    inward: np.ndarray  # [K, 3] m, from its nodes to where they look out
    clumps: Clumps
    solids: tuple[ConvexPiece, ...]  # what it collides as, where it is convex or made of convex pieces


Pieces = tuple[np.ndarray, ...]
# With the nodes, the convex pieces and the hull that it is for.
_of_sdf: WeakKeyDictionary[Sdf, tuple[np.ndarray, Pieces, np.ndarray, bool, Geometry]] = WeakKeyDictionary()
_of_content: OrderedDict[str, Geometry] = OrderedDict()  # of the latest: workers get copies of shapes


def _geometry(nodes: np.ndarray, sdf: Sdf, pieces: Pieces, hull: np.ndarray, *, surfaces: bool) -> Geometry:
    """Made once for all scenes of a process; with a surface where a scene has some."""
    known, split, solid, met, kept = _of_sdf.get(sdf, (nodes, pieces, hull, surfaces, None))
    same = split is pieces and solid is hull and met >= surfaces and np.array_equal(known, nodes)
    if kept is None or not same:
        content = digest(sdf, nodes, pieces, hull, surfaces)
        kept = _of_content.pop(content, None) or _looked_at(sdf, nodes, pieces, hull, surfaces=surfaces)
        _of_sdf[sdf], _of_content[content] = (nodes, pieces, hull, surfaces, kept), kept
        if len(_of_content) > MOST_KEPT:
            _of_content.popitem(last=False)
    return kept


def _looked_at(sdf: Sdf, nodes: np.ndarray, pieces: Pieces, hull: np.ndarray, *, surfaces: bool) -> Geometry:
    grid = None if isinstance(sdf, ClosedForm) else baked(sdf, nodes, pieces)
    extent = 0.0 if isinstance(sdf, PlaneSdf) else float(np.ptp(sdf.bounds, axis=0).max())
    solids = pieces_of(sdf, pieces, hull)
    if grid and not solids and (wall := unseen_wall(sdf, grid)) is not None:
        _log.warning("a shape of %.2g m has walls of at most %.2g m: things may pass through", extent, wall)
    surface, cover = contact_surface(sdf, nodes if surfaces else nodes[:0], pieces, grid)
    thickness = grid.thickness if grid else 0.0 if extent == 0.0 else float(np.ptp(sdf.bounds, axis=0).min())
    inward = min(INWARD * extent, SHALLOW * thickness) * inwards(sdf, surface.nodes)
    return Geometry(grid, surface, cover, inward, _clumps(surface.nodes, surface.patch), solids)


def compiled_world(bodies: Bodies, state: State, shapes: kinds.Shapes) -> compiled.World:
    """The bodies of a scene."""
    names = (
        "shape", "scale", "com", "radius", "inverse_mass", "inertia", "friction", "restitution", "moves", "group",
        "world", "bounds",
    )  # fmt: skip
    # Copies: who changes a world, as a fit of coefficients does, must not change the bodies that it was made of.
    array = {name: getattr(bodies, name).cpu().numpy().copy() for name in names}
    array["allowed"] = bodies.allowed.cpu().numpy()  # as large as pairs of groups are many, and never changed
    bounds = np.where(np.isfinite(array["bounds"]), array["bounds"], 0.0)
    inertia = array["inertia"]
    moves = array["moves"]
    eigen = np.linalg.eigvalsh(inertia)
    isotropic = eigen[:, 2] - eigen[:, 0] <= 1e-9 * eigen[:, 2]
    scripted = np.zeros(len(moves), bool)
    if bodies.tracks is not None:
        scripted[bodies.tracks.body.cpu().numpy()] = True
    infinite = ~np.isfinite(array["radius"])
    plane = np.flatnonzero(infinite & (array["shape"] >= 0))
    still = np.flatnonzero(~infinite & ~moves & ~scripted & (array["shape"] >= 0))
    centre, half = bounds.mean(1), 0.5 * (bounds[:, 1] - bounds[:, 0])
    turn = pose.to_matrix(state.orientation.cpu()).numpy()[still]
    middle = state.position.cpu().numpy()[still] + np.einsum("nij,nj->ni", turn, centre[still])
    wide = np.einsum("nij,nj->ni", np.abs(turn), half[still])
    low, high = middle - wide, middle + wide
    axis = int(np.argmax(np.ptp(low, axis=0))) if len(still) else 0
    order = np.argsort(low[:, axis], kind="stable")
    low, high = low[order], high[order]
    return compiled.World(
        shape=array["shape"], scale=array["scale"], com=array["com"], centre=centre, half=half, radius=array["radius"],
        thickness=np.where(array["shape"] >= 0, shapes.table[array["shape"], kinds.THICKNESS] * array["scale"], np.inf),
        inverse_mass=array["inverse_mass"], inertia=inertia,
        inverse_inertia=np.linalg.inv(inertia) * moves[:, None, None], isotropic=isotropic,
        friction=array["friction"], restitution=array["restitution"], moves=moves, scripted=scripted,
        group=array["group"], allowed=array["allowed"], realm=array["world"],
        going=np.flatnonzero(moves | scripted), plane=plane, still=still[order],
        low=low, high=high, reach=np.maximum.accumulate(high[:, axis]) if len(still) else np.zeros(0), axis=axis,
    )  # fmt: skip


def _nodes_of(bodies: Bodies, k: int) -> np.ndarray:
    """[K, 3] surface nodes of the shape of body k, at scale 1 in the shape's own frame. Rounded to 12 digits, so that
    bodies of different scales know them as the same nodes."""
    first, last = int(bodies.node_start[k]), int(bodies.node_start[k + 1])
    nodes = ((bodies.node[first:last] + bodies.com[k]) / bodies.scale[k]).cpu().numpy()
    extent = np.ptp(nodes, axis=0).max() if len(nodes) else 0.0
    if not extent > 0.0:
        return nodes
    # Up to the power of ten that holds it, and no further where rounding has made it a little more than that power.
    return nodes.round(12 - math.ceil(math.log10(extent) - 1e-9))


def _clumps(nodes: np.ndarray, patch: np.ndarray) -> Clumps:
    """In clumps of leaves the numbers of the nodes that lie together; a leaf has nodes of one patch only."""
    if not len(nodes):
        return []
    clumps = _split(nodes, np.arange(len(nodes)), CLUMP)
    return [
        [leaf for p in np.unique(patch[clump]) for leaf in _split(nodes, clump[patch[clump] == p], LEAF)]
        for clump in clumps
    ]


def _split(nodes: np.ndarray, chosen: np.ndarray, most: int) -> list[np.ndarray]:
    """Halved along the longest side until no part has more than `most`."""
    if len(chosen) <= most:
        return [chosen]
    places = nodes[chosen]
    axis = int(np.argmax(np.ptp(places, axis=0)))
    order = chosen[np.argsort(places[:, axis], kind="stable")]
    middle = len(order) // 2
    return _split(nodes, order[:middle], most) + _split(nodes, order[middle:], most)


def _joined(known: list[Geometry]) -> tuple[np.ndarray, ...]:
    """The node arrays of `kinds.Shapes`."""
    node, inward, leaf_ball, clump_ball = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 4))], [np.zeros((0, 4))]
    cover = [np.zeros(0)]
    leaf_node, clump_start, clump_leaf, leaf_patch = [0], [0], [0], []
    for _, surface, around, within, clumps, _ in known:
        for leaves in clumps:
            for leaf in leaves:
                node.append(surface.nodes[leaf])
                cover.append(around[leaf])
                inward.append(within[leaf])
                leaf_node.append(leaf_node[-1] + len(leaf))
                leaf_ball.append(_ball(surface.nodes[leaf], around[leaf]))
                leaf_patch.append(surface.patch[leaf[0]])
            clump_leaf.append(clump_leaf[-1] + len(leaves))
            every = np.concatenate(leaves)
            clump_ball.append(_ball(surface.nodes[every], around[every]))
        clump_start.append(len(clump_leaf) - 1)

    def whole(numbers: list[int]) -> np.ndarray:
        return np.array(numbers, dtype=np.int64)

    return (
        np.concatenate(node), np.concatenate(cover), np.concatenate(inward), whole(leaf_node),
        np.concatenate(leaf_ball), whole(clump_start), whole(clump_leaf), np.concatenate(clump_ball),
        whole(leaf_patch),
    )  # fmt: skip


def _ball(places: np.ndarray, around: np.ndarray) -> np.ndarray:
    """[1, 4] middle and radius of a ball around the surface that nodes stand for."""
    middle = 0.5 * (places.min(0) + places.max(0))
    return np.array([[*middle, (np.linalg.norm(places - middle, axis=1) + around).max()]])
