"""The explicit contact solve as a model: scenes as the compiled step wants them, and that step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from sdfsim.base.compiling import tell_compiling
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State, Touch
from sdfsim.physics.options import Options
from sdfsim.physics.solver import distance as kinds
from sdfsim.physics.solver import world as compiled
from sdfsim.physics.solver.advance import advance as compiled_step
from sdfsim.physics.solver.convex import BALL, BLOCK, DRUM, HULL, POINT, SEGMENT, THICKNESS, WIDTH, Convex
from sdfsim.physics.solver.record import Edges
from sdfsim.physics.solver.survey import Touching, touching
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.contact_geometry import NO_SURFACE, ContactGeometry, ContactSurface
from sdfsim.shape.convex_pieces import ConvexPiece

FORMS = {
    "plane": kinds.PLANE, "sphere": kinds.SPHERE, "capsule": kinds.CAPSULE, "box": kinds.BOX,
    "cylinder": kinds.CYLINDER,
}  # fmt: skip
SOLIDS = {"sphere": POINT, "capsule": SEGMENT, "box": BLOCK, "cylinder": DRUM, "hull": HULL}
# Penetration that is left as it is, so that what rests has contacts that do not come and go: model lengths, and less in
# inner steps below the usual 4 ms, which scenes of slender bodies have.
SLOP, SLOP_A_TIME = 5e-4, 0.125
TOUCHING = 1e-3  # model lengths, within which a point is told as a contact
COARSE = 0.01  # model times: in longer inner steps what is hit in their course is recorded as well
SLOW = 2.0  # an approach that gravity makes in so many inner steps ends at the surface without a rebound


class Compiled:
    """One scene, its bodies in model units, as the compiled step wants it. Many scenes of the same shapes can share
    their compiled `shapes`."""

    def __init__(self, bodies: Bodies, state: State, shapes: kinds.Shapes | None = None) -> None:
        tell_compiling(compiled_step, "the contact step", "two minutes")
        self.bodies = bodies
        self.shapes = shapes or compiled_shapes(bodies.contact)
        self.place(state)

    def place(self, state: State) -> None:
        """Scenery lies where `state` has it."""
        self.world = compiled_world(self.bodies, state, self.shapes)
        n = len(self.bodies)
        self.work = compiled.Work(
            matrix=np.ascontiguousarray(pose.to_matrix(state.orientation.cpu()).numpy()), inverse=np.zeros((n, 3, 3)),
            free=np.zeros((n, 9)), change=np.zeros((n, 6)), shift=np.zeros((n, 6)), wrench=np.zeros((n, 6)),
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
    scene.work.wrench[:] = 0.0 if state.load is None else state.load.numpy()
    manifolds, edges, counts = scene.run(motion, manifolds, rules)
    known = (motion.touching, motion.quiet, motion.anchor, motion.island, *manifolds)
    after = replace(
        state,
        position=torch.from_numpy(motion.position),
        orientation=torch.from_numpy(motion.orientation),
        velocity=torch.from_numpy(motion.velocity),
        angular_velocity=torch.from_numpy(motion.angular),
        time=state.time + rules.substep_dt * rules.substeps,
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


def compiled_shapes(shapes: Sequence[ContactGeometry]) -> kinds.Shapes:
    """The shapes of a scene, baked where they have no closed form."""
    table = np.zeros((len(shapes), kinds.FIELDS))
    table[:, kinds.CELL], table[:, kinds.PATCH] = 1.0, -1.0
    brick, sample, label = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)], [np.zeros(0, np.int16)]
    # Where all shapes are convex, or made of convex pieces, none is met as a surface.
    met = any(not (isinstance(shape.sdf, ClosedForm) or shape.solids) for shape in shapes)
    surfaces = [shape.surface if met else NO_SURFACE for shape in shapes]
    for row, shape, surface in zip(table, shapes, surfaces, strict=True):
        row[kinds.THICKNESS] = shape.thickness
        if surface.label.size:
            row[kinds.PATCH_LOW : kinds.PATCH_LOW + 3], row[kinds.PATCH_CELL] = surface.label_low, surface.label_cell
            row[kinds.PATCHES : kinds.PATCHES + 3], row[kinds.PATCH] = surface.label.shape, sum(map(len, label))
            label.append(surface.label.reshape(-1))
        if isinstance(shape.sdf, ClosedForm):
            sizes = shape.sdf.sizes
            row[kinds.KIND], row[kinds.SIZE : kinds.SIZE + len(sizes)] = FORMS[shape.sdf.KIND], sizes
        elif (grid := shape.grid) is not None:
            row[kinds.KIND], row[kinds.CELL] = kinds.GRID, grid.cell
            row[kinds.LOW : kinds.LOW + 3], row[kinds.BRICKS : kinds.BRICKS + 3] = grid.low, grid.brick.shape
            row[kinds.COARSE], row[kinds.BRICK] = sum(map(len, sample)), sum(map(len, brick))
            sample.append(grid.coarse.reshape(-1))
            first, size = sum(map(len, sample)), grid.fine[:1].size
            brick.append(np.where(grid.brick >= 0, grid.brick.astype(np.int64) * size + first, -1).reshape(-1))
            sample.append(grid.fine.reshape(-1))
    arrays = (np.concatenate(parts) for parts in (brick, sample))
    solids = [shape.solids for shape in shapes]
    parts = (table, *arrays, *_joined(surfaces), np.concatenate(label), *_packed(solids))
    return kinds.Shapes(*parts)


def _joined(surfaces: list[ContactSurface]) -> tuple[np.ndarray, ...]:
    """The node arrays of `kinds.Shapes`."""

    def ends(name: str) -> np.ndarray:
        """Where parts begin, as if all lay end to end."""
        parts = [getattr(surface, name) for surface in surfaces]
        first = np.cumsum([0, *(part[-1] for part in parts)])
        return np.concatenate([[0], *(part[1:] + at for part, at in zip(parts, first, strict=False))]).astype(np.int64)

    def whole(name: str) -> np.ndarray:
        return np.concatenate([getattr(surface, name) for surface in [NO_SURFACE, *surfaces]])

    clumps = np.cumsum([0, *(len(surface.clump_ball) for surface in surfaces)])
    return (
        whole("node"), whole("cover"), whole("inward"), ends("leaf_node"), whole("leaf_ball"), clumps,
        ends("clump_leaf"), whole("clump_ball"), whole("leaf_patch"),
    )  # fmt: skip


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
        group=array["group"], allowed=array["allowed"], world=array["world"],
        going=np.flatnonzero(moves | scripted), plane=plane, still=still[order],
        low=low, high=high, reach=np.maximum.accumulate(high[:, axis]) if len(still) else np.zeros(0), axis=axis,
    )  # fmt: skip
