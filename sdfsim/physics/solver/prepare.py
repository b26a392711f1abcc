"""The contact solve as a model: prepares scenes for the compiled step, and calls it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from threading import Lock
from typing import Any

import numba
import numpy as np
from numba import int64, typeof

from sdfsim.base.compiling import compile_before, running, uninterrupted
from sdfsim.physics import joint_columns, pose
from sdfsim.physics import joints as jointed
from sdfsim.physics.bodies import Bodies, State, Touch, Tracks
from sdfsim.physics.free_flight import fly
from sdfsim.physics.motion import MOTION, Motion
from sdfsim.physics.options import Options
from sdfsim.physics.solver import distance as kinds
from sdfsim.physics.solver import world as compiled
from sdfsim.physics.solver.convex import BALL, BLOCK, CONE, DRUM, HULL, POINT, SEGMENT, THICKNESS, WIDTH, Convex
from sdfsim.physics.solver.edges import nodes_within, points_within
from sdfsim.physics.solver.joints import Each, Joints, Trial
from sdfsim.physics.solver.manifold import scratch_room
from sdfsim.physics.solver.narrow_phase import Near, Parts
from sdfsim.physics.solver.pieces import Piece, Pieces, chosen
from sdfsim.physics.solver.references import Reference
from sdfsim.physics.solver.rows import WIDTH as OF_ROW
from sdfsim.physics.solver.run import Kept, Script, run_steps
from sdfsim.physics.solver.survey import Touching, touching
from sdfsim.physics.solver.tolerances import AGREED, CROWD, REPORTED, SIDED, SLOP, SLOP_A_TIME, SLOW, Rules
from sdfsim.physics.solver.tree import EQUATIONS, Factors, Graph, Held
from sdfsim.physics.solver.triangles import Triangles, signed_distances
from sdfsim.physics.steps import COUNTS, PHASES, Frames, Steps
from sdfsim.physics.validity import NO_LIMITS, fault_of
from sdfsim.sdf.baked_grid import BakedGrid, interpolated
from sdfsim.sdf.closed_forms import ClosedForm, PlaneSdf
from sdfsim.shape.contact_geometry import NO_SURFACE, ContactGeometry, ContactSurface
from sdfsim.shape.convex_pieces import ConvexPiece
from sdfsim.shape.triangle_tree import TriangleTree

FORMS = {
    "plane": kinds.PLANE, "sphere": kinds.SPHERE, "capsule": kinds.CAPSULE, "box": kinds.BOX,
    "cylinder": kinds.CYLINDER, "cone": kinds.CONE, "torus": kinds.TORUS,
}  # fmt: skip
SOLIDS = {"sphere": POINT, "capsule": SEGMENT, "box": BLOCK, "cylinder": DRUM, "cone": CONE, "hull": HULL}
INSTANTS = 4  # of a step, at which networks look for contacts
NO_PARTS = Parts(
    np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros(0, np.int32),
    np.zeros(0),
)  # fmt: skip
NOTHING_NEAR = Near(
    np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 3)),
    np.zeros(0), np.zeros(0), np.zeros(0, np.int32), np.zeros(0), np.zeros(0, np.bool_), np.zeros((0, 3)),
    np.zeros(0, np.bool_), np.zeros(0, np.bool_), np.zeros(0, np.int64),
)  # fmt: skip
NO_SCRIPT = Script(np.zeros(0, np.int64), np.zeros((0, 0, 7)), np.zeros((0, 0, 0, 6)))


class SharedShapes:
    """Compiled shapes that many scenes share, also in threads: scenes with the same shapes, or some of them, reuse
    those of earlier scenes."""

    def __init__(self) -> None:
        self._lock = Lock()
        # Separate for scenes in which shapes meet as surfaces, and for others, which need no surfaces and often no
        # grids.
        self._known: dict[tuple[bool, bool], tuple[tuple[ContactGeometry, ...], kinds.Shapes]] = {}

    def of(self, contact: Sequence[ContactGeometry], *, grids: bool = True) -> tuple[kinds.Shapes, np.ndarray]:
        """Compiled shapes, and the index [S] int64 of each shape of a scene among them; `grids` as for `Compiled`."""
        with self._lock:
            met = meet_as_surfaces(contact)
            kind = met, grids or met
            known, shapes = self._known.get(kind, ((), None))
            if shapes is None or not set(contact) <= set(known):
                known = tuple(dict.fromkeys((*known, *contact)))
                shapes = compiled_shapes(known, grids=grids)
                self._known[kind] = known, shapes
        place = {shape: k for k, shape in enumerate(known)}
        return shapes, np.array([place[shape] for shape in contact], np.int64)


class Compiled:
    """One scene in the form that the compiled step needs, in model units. Scenes can share shapes. Without `grids` no
    distances are baked if all shapes collide as solids."""

    def __init__(self, bodies: Bodies, state: State, shared: SharedShapes | None = None, *, grids: bool = True) -> None:
        self.bodies = bodies
        self.shapes, row = (shared or SharedShapes()).of(bodies.contact, grids=grids)
        self._shape = np.where(bodies.shape >= 0, row[bodies.shape], -1) if len(row) else bodies.shape
        self.place(state)

    def place(self, state: State) -> None:
        """Place static bodies as in `state`."""
        self.world = compiled_world(replace(self.bodies, shape=self._shape), state, self.shapes)
        self.threads = bool(np.count_nonzero(self.world.moves) >= CROWD)
        if self.threads:
            numba.get_num_threads()  # starts the threads: cached code relies on that
        n = len(self.bodies)
        self.work = compiled.Work(
            matrix=pose.to_matrix(state.orientation), inverse=np.zeros((n + 1, 3, 3)),
            inverse_mass=np.append(self.world.inverse_mass, 0.0),
            matrix_before=pose.to_matrix(state.orientation), position_before=np.array(state.position),
            twist=np.zeros((n + 1, 6)),
            free=np.zeros((n + 1, 9)), change=np.zeros((n + 1, 6)), shift=np.zeros((n + 1, 6)),
            wrench=np.zeros((n, 6)), part=np.ones(n), motion_bound=np.zeros(n), moved=np.zeros(n),
            low=np.zeros((n, 3)), high=np.zeros((n, 3)),
            beside=np.zeros(n, np.bool_), acted=np.zeros(n, np.bool_), met=np.zeros(n, np.bool_),
            parent=np.zeros(n, np.int64), number=np.zeros(n, np.int64), latest=np.zeros(n, np.int64),
            turned=np.zeros((1, 4)), frame=np.zeros((1, 3, 3)), scratch=scratch_room(),
        )  # fmt: skip
        self.joints = joints_of(self.bodies)
        # Threads are used for all kinds of pairs alike.
        self.surfaces = self.threads or bool(meet_as_surfaces(self.bodies.contact))
        self.seen: compiled.Motion | None = None  # motion in which `points_near` searches
        self.searches: Pieces | None = None  # its pieces, once they are compiled
        self.pieces: Pieces | None = None  # those of the step, once they are compiled
        self._load: np.ndarray | None = None
        self._options: Options | None = None  # the options from which `_rules` were made
        self._latest: State | None = None  # the state whose arrays are `_motion` and `_manifolds`

    def revise(self, bodies: Bodies) -> None:
        """Take over other masses, inertias, friction and restitution of the same bodies."""
        self.bodies, world = bodies, self.world
        for name in ("friction", "restitution", "compliance", "damping", "inverse_mass", "inertia"):
            getattr(world, name)[:] = getattr(bodies, name)
        self.work.inverse_mass[:-1] = bodies.inverse_mass
        world.inverse_inertia[:] = np.linalg.inv(bodies.inertia) * bodies.moves[:, None, None]

    def run(
        self, motion: compiled.Motion, manifolds: compiled.Manifolds, rules: Rules, steps: int = 1,
        script: Script = NO_SCRIPT, most: np.ndarray = NO_LIMITS, *, keep: bool = False,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Make `steps` steps and write to `motion`. Returns what `run_steps` does, and last the `Kept` of each step."""
        n, count = steps if keep else 0, len(self.bodies)
        joints = len(self.joints.each.body)
        kept = Kept(
            np.empty((n, count, 3)), np.empty((n, count, 4)), np.empty((n, count, 3)), np.empty((n, count, 3)),
            np.empty((n, 3)), np.empty((n, 5), np.int64), np.empty(n), np.empty((n, joints, 7)),
        )  # fmt: skip
        arguments = (self.shapes, self.world, self.work, motion, rules, manifolds, self.joints)
        # An integer of another type would cause another compilation.
        others = script, most, kept, REPORTED, int(steps)
        if self.pieces is None:
            used = chosen(surfaces=self.surfaces, threads=self.threads, joints=joints > 0)
            self.pieces = _compiled("the contact step", run_steps, arguments, others, used)
        with uninterrupted():
            return *run_steps(*arguments, self.pieces, *others), kept

    def advance(self, state: State, options: Options, steps: int, most: np.ndarray, *, keep: bool = False) -> Steps:
        """Make `steps` steps of the contact solve from `state`, or fewer if one leads to a state beyond the limits
        `most` (see `survey.broken`), and `keep` their frames."""
        started = running()
        if state is not self._latest:
            self._motion, self._manifolds = taken_up(state)
            self._before = replace(state, touch=state.touch or _touch(self._motion, self._manifolds))
            if state.joints is not None and self.bodies.joints is not None:
                each = self.joints.each
                each.state[:] = state.joints
                each.number[:], each.state[:, joint_columns.TARGET] = jointed.driven(
                    self.bodies.joints, state.joints, state.drive
                )
        if state.load is not self._load:
            self.work.wrench[:] = 0.0 if state.load is None else state.load
            self._load = state.load
        if options is not self._options:
            self._options, self._rules = options, compiled_rules(options)
        rules, motion = self._rules, self._motion
        script, time = scripted(self.bodies.tracks, state.time, rules, steps)
        self._latest = None  # in case the rest raises an error
        manifolds, counts, done, body, wrong, before, given, pair, point, kept = self.run(
            motion, self._manifolds, rules, steps, script, most, keep=keep
        )
        spent, frames = 1e3 * (running() - started) / max(steps, 1), None
        if keep:
            arrays = {name: getattr(kept, name)[:done] for name in kept._fields}
            known = arrays.pop("count")
            numbers = self._counts(known[:, :4], spent)
            frames = Frames(**arrays, touching=known[:, 4], pair=pair, point=point, counts=numbers)
        if body >= 0:
            found = Motion(motion.position, motion.orientation, motion.velocity, motion.angular)
            fault = fault_of(body, wrong, found, np.array(before), options.dt)
            if not done:
                return Steps(state, 0, fault, 0.0, {}, frames)
            # The motion is one step beyond the last good state: repeat all steps but the last.
            return replace(self.advance(state, options, done, NO_LIMITS), fault=fault, frames=frames)
        self._manifolds, rows = manifolds, self.world.going
        assert self._before.touch is not None
        touch = self._before.touch.with_rows(
            rows,
            {
                "quiet": motion.quiet[rows], "anchor": motion.anchor[rows], "island": motion.island[rows],
            },
            pair=manifolds.pair, count=manifolds.count, point=manifolds.point,
        )  # fmt: skip
        arrays = (motion.position, motion.orientation, motion.velocity, motion.angular)
        moved = {name: array[rows] for name, array in zip(MOTION, arrays, strict=True)}
        known = state.joints
        if state.joints is not None:
            known = self.joints.each.state.copy()
            known[:, joint_columns.TARGET] = state.joints[:, joint_columns.TARGET]  # as `driven` received it
        self._latest = self._before.with_rows(rows, moved, touch=touch, time=time, load=state.load, joints=known)
        last = self._counts(np.array([[*counts, (motion.island[rows] >= 0).sum()]]), spent) if done else {}
        return Steps(self._latest, done, None, given, {name: float(value[0]) for name, value in last.items()}, frames)

    def _counts(self, known: np.ndarray, spent: float) -> dict[str, np.ndarray]:
        """[K] each of `COUNTS` and `PHASES`, for K steps of `spent` ms: from [K, 4] pairs tested, contacts, bodies that
        contacts moved, and sleeping ones."""
        pairs, contacts, active, asleep = known.T.astype(float)
        free = len(self.bodies.movers) - asleep - active
        counts = {"pairs": pairs, "contacts": contacts, "active": active, "asleep": asleep, "free": free}
        counts["contact_ms"] = np.full(len(known), spent)
        return {name: counts.get(name, np.zeros(len(known))) for name in (*COUNTS, *PHASES)}


def _compiled(what: str, function: Any, arguments: tuple, others: tuple, used: dict[str, Piece]) -> Pieces:
    """Make sure that a compiled function, which takes `arguments`, pieces and `others`, and its pieces are compiled.
    Returns the addresses of the pieces that are `used`."""
    shapes, world, work, motion, rules, manifolds, *joints = (Reference(typeof(each)) for each in arguments)
    near = (shapes, world, work, motion, rules)
    types = {
        "near": (*near, Reference(typeof(NO_PARTS))),
        "collide": (*near, manifolds, Reference(typeof(NOTHING_NEAR))),
        "assemble": (*near[1:], *joints, int64),
        "solve": (*near[1:], manifolds, *joints, int64),
    }
    types["impact"] = types["collide"]
    nowhere = Pieces(0, 0, 0, 0, 0)
    whole = tuple(typeof(each) for each in (*arguments, nowhere, *others))
    jobs = [(piece, types[of]) for of, piece in used.items()]
    compile_before([(function, whole), *jobs], what)
    return nowhere._replace(**{of: piece.address(types[of]) for of, piece in used.items()})


def scripted(tracks: Tracks | None, time: float, rules: Rules, steps: int) -> tuple[Script, float]:
    """Poses and velocities of paths for `steps` steps, and the time after them. Velocities change in each inner step:
    if they jumped once a step, bodies on an accelerating tray would slip. The last is that at the end of the step."""
    inner, count = rules.substep_dt, rules.options.substeps
    times = [time]
    for _ in range(steps):
        times.append(times[-1] + inner * count)  # added up as single steps do, bit by bit
    if tracks is None or not steps:
        return NO_SCRIPT, times[-1]
    instants = np.array([[t + inner * k for k in range(count)] for t in times[:-1]])
    after, half = np.array(times[1:])[:, None], 0.5 * inner
    place, turn = tracks.at(np.concatenate([instants, after, after - half, after + half], 1))
    speeds = np.empty((steps, count + 1, len(tracks.body), 6))
    for k, (one, other) in enumerate([*((k, k + 1) for k in range(count)), (count + 1, count + 2)]):
        speeds[:, k, :, :3] = place[:, other] - place[:, one]
        speeds[:, k, :, 3:] = pose.to_rotvec(pose.multiply(turn[:, other], pose.conjugate(turn[:, one])))
    # An array of another layout would cause another compilation.
    ends = np.ascontiguousarray(np.concatenate([place, turn], -1)[:, count])
    return Script(tracks.body, ends, speeds / inner), times[-1]


def taken_up(state: State) -> tuple[compiled.Motion, compiled.Manifolds]:
    """Copies of a state's arrays, for the compiled step to write to."""
    poses = (state.position, state.orientation, state.velocity, state.angular_velocity)
    position, orientation, *velocities = (np.array(array, dtype=np.float64, order="C") for array in poses)
    touch = state.touch
    if touch is None:
        still, nobody = np.zeros(len(position), np.int64), np.full(len(position), -1, np.int64)
        known = still, np.concatenate([position, orientation, position, orientation], 1), nobody
    else:
        known = (array.copy() for array in (touch.quiet, touch.anchor, touch.island))
    return compiled.Motion(position, orientation, *velocities, *known), _manifolds(touch)


def _touch(motion: compiled.Motion, manifolds: compiled.Manifolds) -> Touch:
    return Touch(
        quiet=motion.quiet.copy(), anchor=motion.anchor.copy(), island=motion.island.copy(),
        pair=manifolds.pair, count=manifolds.count, point=manifolds.point,
    )  # fmt: skip


def disturbed(bodies: Bodies, state: State, changed: np.ndarray, moved: np.ndarray, *, gravity: bool = False) -> State:
    """The state after a user has changed the bodies `changed` [N] bool, or `gravity`: these bodies are woken, and so
    are those that slept with them or on them. Pose or velocities of the bodies `moved` [N] have changed, not only what
    acts on them."""
    touch = state.touch
    if bodies.joints is not None and state.joints is not None and moved.any():
        place = jointed.coordinates(
            bodies.joints, state.joints[:, joint_columns.COORD], state.position, state.orientation
        )
        known = state.joints.copy()
        known[:, joint_columns.COORD] = place
        state = replace(state, joints=known)
    if touch is None:
        return state
    island, quiet = touch.island.copy(), touch.quiet.copy()
    beside = touch.pair[touch.count > 0]
    restless = changed.copy()
    restless[beside[changed[beside[:, 1]], 0]] = True
    restless[beside[changed[beside[:, 0]], 1]] = True
    up = np.full(len(island), gravity) | np.isin(island, island[restless & (island >= 0)])
    island[up], quiet[up | changed] = -1, 0
    return replace(state, touch=replace(touch, island=island, quiet=quiet))


def contact_points(state: State) -> Touching:
    """Where bodies touch in a state."""
    return touching(_manifolds(state.touch), state.position, state.orientation, REPORTED)


def nodes_near(
    scene: Compiled, state: State, gravity: np.ndarray, reach: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Surface nodes that come within `reach` of other bodies in a step of `dt` under `gravity` [3], model units; see
    `edges.nodes_within`."""
    rules = compiled_rules(Options(gravity, dt, 1))._replace(contact_margin=reach)
    motion, bodies = taken_up(state)[0], scene.bodies
    return nodes_within(scene.shapes, scene.world, scene.work, motion, rules, bodies.node, bodies.node_start)


def points_near(scene: Compiled, state: State, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """Points at which bodies meet, or nearly meet, in a step of free flight: for each pair of bodies those at the first
    of `INSTANTS` instants after which it is near within the time to the next one.

    Returns:
        [E, 2] int64, the two bodies; [E, 11], model units: the contact point about the centre of mass of each, the
        normal from the second to the first (all along world axes), the distance, and the part of the step that has
        passed by then.
    """
    state = state if state.touch is None else replace(state, touch=None)
    if scene.seen is None:
        scene.seen = taken_up(state)[0]
    going, motion = scene.world.going, scene.seen
    known, pairs, values = np.zeros(0, np.int64), [], []
    for k in range(INSTANTS):
        part = k / INSTANTS
        at = fly(scene.bodies, state, options._replace(dt=part * options.dt)) if k else state
        arrays = (motion.position, motion.orientation, motion.velocity, motion.angular)
        for name, array in zip(MOTION, arrays, strict=True):  # static bodies stay as they are
            array[going] = at.rows_of(name, going)
        rules = compiled_rules(options)._replace(ahead=(1.0 - part) * options.dt)
        soon = options.dt / INSTANTS
        arguments = (scene.shapes, scene.world, scene.work, motion, rules, _manifolds(None))
        if scene.searches is None:
            used = chosen(surfaces=scene.surfaces, threads=False, joints=False)
            used = {of: used[of] for of in ("near", "collide")}
            scene.searches = _compiled("the search for contacts", points_within, arguments, (soon,), used)
        pair, value = points_within(*arguments, scene.searches, soon)
        key = pair[:, 0] * len(scene.bodies) + pair[:, 1]
        due = np.setdiff1d(key[value[:, 10] <= rules.contact_margin], known)
        fresh = np.isin(key, due)
        value[:, 10] = part
        pairs.append(pair[fresh])
        values.append(value[fresh])
        known = np.concatenate([known, due])
    return np.concatenate(pairs), np.concatenate(values)


def compiled_rules(options: Options) -> Rules:
    """The options of a run in the form that the compiled step needs."""
    inner = options.dt / options.substeps
    return Rules(
        options,
        inner,
        SLOW * math.hypot(*options.gravity) * inner,
        slop=min(SLOP, SLOP_A_TIME * inner),
    )


def _manifolds(touch: Touch | None) -> compiled.Manifolds:
    """The known contacts."""
    if touch is None:
        return compiled.Manifolds(
            np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros((0, compiled.POINTS, compiled.COLUMNS))
        )
    return compiled.Manifolds(touch.pair, touch.count, touch.point)


def meet_as_surfaces(shapes: Sequence[ContactGeometry]) -> bool:
    """Whether any of the shapes collides as a surface. Planes, shapes that are convex, and those made of convex pieces
    collide as solids."""
    return any(not (isinstance(shape.sdf, PlaneSdf) or shape.solids) for shape in shapes)


def compiled_shapes(shapes: Sequence[ContactGeometry], *, grids: bool = True) -> kinds.Shapes:
    """The shapes of a scene; those without a closed form are baked, if any meets as a surface or with `grids`."""
    table = np.zeros((len(shapes), kinds.FIELDS))
    table[:, kinds.CELL], table[:, kinds.PATCH] = 1.0, -1.0
    brick, sample, label = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)], [np.zeros(0, np.int16)]
    met = meet_as_surfaces(shapes)
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
            continue
        row[kinds.KIND] = kinds.GRID
        if (met or grids) and (grid := shape.grid) is not None:
            row[kinds.CELL] = grid.cell
            row[kinds.LOW : kinds.LOW + 3], row[kinds.BRICKS : kinds.BRICKS + 3] = grid.low, grid.brick.shape
            row[kinds.COARSE], row[kinds.BRICK] = sum(map(len, sample)), sum(map(len, brick))
            sample.append(grid.coarse.reshape(-1))
            first, size = sum(map(len, sample)), grid.fine[:1].size
            brick.append(np.where(grid.brick >= 0, grid.brick.astype(np.int64) * size + first, -1).reshape(-1))
            sample.append(grid.fine.reshape(-1))
    arrays = (np.concatenate(parts) for parts in (brick, sample))
    solids, trees = [shape.solids for shape in shapes], [shape.triangles if met else None for shape in shapes]
    for k, (row, tree) in enumerate(zip(table, trees, strict=True)):
        if tree is not None and (grid := shapes[k].grid) is not None:
            row[kinds.ERROR] = grid.error
            trees[k] = tree if _bounds_solid(tree, grid) else None
    return kinds.Shapes(
        table, *arrays, *_joined(surfaces), label=np.concatenate(label), solids=_packed(solids),
        triangles=_planted(trees),
    )  # fmt: skip


def _bounds_solid(tree: TriangleTree, grid: BakedGrid) -> bool:
    """Whether triangles tell inside from outside as the grid does, which counts how often the surface goes around."""
    places = tree.corner.mean(1)[np.random.default_rng(0).integers(len(tree.corner), size=SIDED)]
    places = places + grid.cell * np.random.default_rng(1).uniform(-1.5, 1.5, places.shape)
    known = interpolated(grid, places)
    found, _ = signed_distances(_planted([tree]), 0, places, 4.0 * grid.cell)
    clear = (np.abs(known) > grid.error) & np.isfinite(found)
    return bool((found * known >= 0.0)[clear].mean() >= AGREED) if clear.any() else False


def _planted(trees: Sequence[TriangleTree | None]) -> Triangles:
    """The triangles of shapes, end to end."""
    some = [tree for tree in trees if tree is not None]

    def starts(lengths: list[int]) -> np.ndarray:
        return np.cumsum([0, *lengths], dtype=np.int64)

    def joined(name: str, *shape: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, *shape)), *(getattr(tree, name) for tree in some)])

    return Triangles(
        level=np.array([-1 if tree is None else tree.level for tree in trees], dtype=np.int64),
        first=starts([0 if tree is None else len(tree.corner) for tree in trees]),
        root=starts([0 if tree is None else len(tree.box) for tree in trees]),
        size=np.array([0.0 if tree is None else (tree.box[0, 3:] - tree.box[0, :3]).max() for tree in trees]),
        box=joined("box", 6), corner=joined("corner", 3, 3), normal=joined("normal", 7, 3),
    )  # fmt: skip


def _joined(surfaces: list[ContactSurface]) -> tuple[np.ndarray, ...]:
    """The node arrays of `kinds.Shapes`."""

    def ends(name: str) -> np.ndarray:
        """Where parts begin when all are stored end to end."""
        parts = [getattr(surface, name) for surface in surfaces]
        first = np.cumsum([0, *(part[-1] for part in parts)])
        return np.concatenate([[0], *(part[1:] + at for part, at in zip(parts, first, strict=False))]).astype(np.int64)

    def whole(name: str) -> np.ndarray:
        return np.concatenate([getattr(surface, name) for surface in [NO_SURFACE, *surfaces]])

    clumps = np.cumsum([0, *(len(surface.clump_ball) for surface in surfaces)])
    return (
        whole("node"), whole("cover"), ends("leaf_node"), whole("leaf_ball"), clumps,
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
        "shape", "scale", "com", "radius", "inverse_mass", "inertia", "friction", "restitution", "compliance",
        "damping", "moves", "group", "world", "bounds",
    )  # fmt: skip
    # Copies: code that changes a world, such as a fit of coefficients, must not change the bodies that it was made
    # from.
    array = {name: getattr(bodies, name).copy() for name in names}
    array["allowed"] = bodies.allowed  # not copied: its size grows with the pairs of groups, and it never changes
    bounds = np.where(np.isfinite(array["bounds"]), array["bounds"], 0.0)
    inertia = array["inertia"]
    moves = array["moves"]
    eigen = np.linalg.eigvalsh(inertia)
    isotropic = eigen[:, 2] - eigen[:, 0] <= 1e-9 * eigen[:, 2]
    touched = array["shape"] >= 0
    thickness = np.full(len(moves), np.inf)
    thickness[touched] = shapes.table[array["shape"][touched], kinds.THICKNESS] * array["scale"][touched]
    scripted = np.zeros(len(moves), bool)
    if bodies.tracks is not None:
        scripted[bodies.tracks.body] = True
    infinite = ~np.isfinite(array["radius"])
    plane = np.flatnonzero(infinite & touched)
    still = np.flatnonzero(~infinite & ~moves & ~scripted & touched)
    centre, half = bounds.mean(1), 0.5 * (bounds[:, 1] - bounds[:, 0])
    turn = pose.to_matrix(state.orientation[still])
    middle = state.position[still] + np.einsum("nij,nj->ni", turn, centre[still])
    wide = np.einsum("nij,nj->ni", np.abs(turn), half[still])
    low, high = middle - wide, middle + wide
    axis = int(np.argmax(np.ptp(low, axis=0))) if len(still) else 0
    order = np.argsort(low[:, axis], kind="stable")
    low, high = low[order], high[order]
    return compiled.World(
        shape=array["shape"], scale=array["scale"], com=array["com"], centre=centre, half=half, radius=array["radius"],
        thickness=thickness,
        inverse_mass=array["inverse_mass"], inertia=inertia,
        inverse_inertia=np.linalg.inv(inertia) * moves[:, None, None], isotropic=isotropic,
        friction=array["friction"], restitution=array["restitution"], compliance=array["compliance"],
        damping=array["damping"], moves=moves, scripted=scripted,
        group=array["group"], allowed=array["allowed"], world=array["world"],
        going=np.flatnonzero(moves | scripted), plane=plane, still=still[order],
        low=low, high=high, reach=np.maximum.accumulate(high[:, axis]) if len(still) else np.zeros(0), axis=axis,
        apart=np.zeros(0, np.int64) if bodies.joints is None else jointed.apart(bodies.joints, len(bodies)),
    )  # fmt: skip


def joints_of(bodies: Bodies) -> Joints:
    """The joints of a scene, with buffers for an inner step."""
    joints = bodies.joints if bodies.joints is not None else jointed.joints_of((), bodies.com, length=1, time=1, mass=1)
    order = jointed.ordered(joints, bodies.moves)
    n, j, k, f = len(bodies), len(joints), len(order.node), len(order.row)

    def room(*shape: int) -> np.ndarray:
        return np.zeros(shape)

    return Joints(
        graph=Graph(**vars(order)),
        factors=Factors(room(k, 6, 6), room(k, 6, 6), room(f, 6, 6), room(f, 6, 6), room(k, 6)),
        each=Each(
            joints.body, joints.kind, joints.anchor, joints.axes, joints.number.copy(), room(j, joint_columns.STATE),
            room(j, OF_ROW), joints.coupled, joints.coupling,
        ),
        held=Held(
            joints.body, room(j, EQUATIONS, OF_ROW), np.zeros((j, EQUATIONS), np.int64),
            *(room(j, EQUATIONS) for _ in range(5)),
        ),
        trial=Trial(room(n, 3), room(n, 4), room(n, 3), room(n, 3, 3)),
        reply=room(n + 1, 6),
    )  # fmt: skip
