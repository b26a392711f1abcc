"""The explicit contact solve as a model: scenes as the compiled step wants them, and that step."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import torch

from sdfsim.dynamics import kernels, pose
from sdfsim.dynamics.bodies import Bodies, State, Touch
from sdfsim.dynamics.kernels import distance as kinds
from sdfsim.dynamics.kernels import record
from sdfsim.dynamics.kernels import world as compiled
from sdfsim.dynamics.kernels.step import step as compiled_step
from sdfsim.files import digest
from sdfsim.shape.baked_grid import WALL, BakedGrid, baked, inwards
from sdfsim.shape.sdf import BoxSdf, CapsuleSdf, CylinderSdf, PlaneSdf, Sdf, SphereSdf
from sdfsim.shape.surface_nodes import Surface, surface_of

if TYPE_CHECKING:
    from sdfsim.dynamics.run_memory import Memory
    from sdfsim.dynamics.step import StepOptions

_log = logging.getLogger(__name__)
MOST_KEPT = 64  # shapes whose geometry stays at hand after their scenes are gone
ANALYTIC = PlaneSdf | SphereSdf | BoxSdf | CapsuleSdf | CylinderSdf
Clumps = list[list[np.ndarray]]
LEAF, CLUMP = 16, 256  # nodes that a leaf and a clump of leaves hold at most
TOUCHING = 1e-3  # model lengths, within which a point is told as a contact
COARSE = 0.01  # model times: in longer inner steps what is hit in their course is told to a network as well
INWARD = 0.004  # of a solid's largest extent, from where its nodes look out


@dataclass(frozen=True)
class SolverRules:
    """What the solve is made of; lengths and speeds in model units, in which the smallest bodies are about 1.4 wide."""

    # contacts are kept up to this distance, and while they have slid by no more; look: new ones are looked for up to
    # this one
    reach: float = 0.02
    look: float = 0.004
    still: float = 1e-4  # pairs that have moved by less within a step are not looked at again
    together: float = 1e-4  # points that are deeper than the deepest less this meet in one impact
    erp: float = 0.08  # the share of a penetration that an inner step resolves, through velocity
    slop: float = 5e-4  # penetration that is left as it is, so that what rests has contacts that do not come and go
    split: float = 0.04  # deeper penetration than this is resolved without a lasting velocity
    # g times the inner step times this is the approach that ends at the surface without a rebound (in
    # `kernels.world.Rules` it is that speed)
    slow: float = 2.0
    rounds: int = 50  # of sequential impulses at most
    exact: float = 1e-4  # they end when no impulse changes a velocity by more
    apart: float = 0.03  # points of a manifold are at least so far from each other
    # stray, rest: who stays within `stray` for so many steps falls asleep
    stray: float = 0.005
    rest: int = 25


class Compiled:
    """One scene, its bodies in model units, as the compiled step wants it."""

    def __init__(self, bodies: Bodies, state: State) -> None:
        if not kernels.compiled():
            _log.warning("compiling the contact step, once for this version: about two minutes")
        self.bodies = bodies
        self.shapes = compiled_shapes(bodies)
        self.place(state)

    def place(self, state: State) -> None:
        """Scenery lies where `state` has it."""
        self.world = compiled_world(self.bodies, state)
        n = len(self.bodies)
        self.work = compiled.Work(
            matrix=pose.to_matrix(state.orientation.cpu()).numpy(), inverse=np.zeros((n, 3, 3)),
            free=np.zeros((n, 6)), change=np.zeros((n, 6)), shift=np.zeros((n, 6)), load=np.zeros((n, 6)),
            part=np.ones(n), ways=np.zeros(n), gone=np.zeros(n), low=np.zeros((n, 3)), high=np.zeros((n, 3)),
            beside=np.zeros(n, np.bool_), met=np.zeros(n, np.bool_),
            parent=np.zeros(n, np.int64), number=np.zeros(n, np.int64),
        )  # fmt: skip

    def run(
        self, motion: compiled.Motion, manifolds: compiled.Manifolds, rules: compiled.Rules
    ) -> tuple[compiled.Manifolds, record.Edges, tuple[int, ...]]:
        """One step: `motion` is written to; the contacts at its end, what they did, and what was counted."""
        return compiled_step(self.shapes, self.world, self.work, motion, rules, manifolds)


def warm() -> None:
    """Have the step and the network on top of it compiled now, so that nobody waits for them later."""
    from sdfsim.dynamics.bodies import Units, from_scene
    from sdfsim.dynamics.model import Model
    from sdfsim.dynamics.models.impulse import ImpulseConfig, ImpulseNetwork
    from sdfsim.dynamics.step import StepOptions, step
    from sdfsim.scene.scene import Body, Scene
    from sdfsim.shape.shape import analytic_shape

    still = np.zeros(3)
    one = Body("one", 0, "dynamic", 1.0, still, np.array([0.0, 0.0, 0.0, 1.0]), still, still, 1.0, 0.5, 0.5)
    other = replace(one, name="other", position=np.array([0.9, 0.0, 0.0]))
    pair = Scene((analytic_shape("sphere", radius=0.5),), (one, other), still, 0.0)
    network = ImpulseNetwork(ImpulseConfig(width=1, rounds=1))
    model = Model("untrained", "impulse", network, dt=0.02, gravity=10.0, length=1.0, reach=0.0)
    step(
        model, *from_scene(pair, Units(1.0, 1.0, 1.0), torch.device("cpu")), StepOptions(torch.zeros(3).double(), 0.02)
    )


@dataclass(frozen=True)
class Acts:
    """What contacts did in a step, at E places where bodies met or nearly met; model units, world axes."""

    # first, second: [E] int64, the two bodies; the first one moves
    first: torch.Tensor
    second: torch.Tensor
    # arm_first, arm_second: [E, 3] from their centres of mass to the contact
    arm_first: torch.Tensor
    arm_second: torch.Tensor
    normal: torch.Tensor  # [E, 3] from the second to the first
    impulse: torch.Tensor  # [E, 3] on the first, opposite on the second; 0 where they only were near
    gap: torch.Tensor  # [E] the distance when it was first looked at
    when: torch.Tensor  # [E] the part of the step that was over by then

    def __len__(self) -> int:
        return len(self.first)


_nobody, _nothing, _nowhere = torch.zeros(0, dtype=torch.int64), torch.zeros(0), torch.zeros(0, 3)
NO_ACTS = Acts(_nobody, _nobody, _nowhere, _nowhere, _nowhere, _nowhere, _nothing, _nothing)


def acts_of(edges: record.Edges, steps: int) -> Acts:
    """What the compiled step noted, `steps` inner steps long."""
    count = int(edges.count[0])
    if not count:
        return NO_ACTS
    pair, value = torch.from_numpy(edges.pair[:count]), torch.from_numpy(edges.value[:count])

    def vector(column: int) -> torch.Tensor:
        return value[:, column : column + 3]

    return Acts(
        first=pair[:, 0],
        second=pair[:, 1],
        arm_first=vector(record.ARM),
        arm_second=vector(record.OTHER),
        normal=vector(record.AXIS),
        impulse=vector(record.GIVEN),
        gap=value[:, record.APART],
        when=value[:, record.WHEN] / steps,
    )


def solver_step(
    bodies: Bodies, state: State, rules: StepOptions, memory: Memory, *, note: bool = False
) -> tuple[State, Acts]:
    """Advance `state` by one step of the contact solve; scripted bodies have the velocities of the coming step. What
    contacts did is told where it is wanted (`note`)."""
    scene = memory.compiled(bodies, state)
    inside = compiled_rules(
        rules.gravity.cpu().numpy(), rules.dt, rules.substeps, friction=rules.friction,
        restitution=rules.restitution, rotation=rules.rotation, sleep=rules.sleep, margin=rules.margin, adds=rules.adds,
        note=note,
    )  # fmt: skip
    with memory.timed("contact_ms"):
        after, edges, counts = _solve(bodies, state, scene, inside)
    memory.count(pairs=counts[0], contacts=counts[1], active=counts[3])
    return after, acts_of(edges, rules.substeps)


def _solve(
    bodies: Bodies, state: State, scene: Compiled, rules: compiled.Rules
) -> tuple[State, record.Edges, tuple[int, ...]]:
    motion, manifolds = taken_up(bodies, state, scene, rules)
    scene.work.load[:] = 0.0 if state.load is None else state.load.numpy()
    manifolds, edges, counts = scene.run(motion, manifolds, rules)
    after = replace(
        state,
        position=torch.from_numpy(motion.position),
        orientation=torch.from_numpy(motion.orientation),
        velocity=torch.from_numpy(motion.velocity),
        angular_velocity=torch.from_numpy(motion.angular),
        time=state.time + rules.inner * rules.steps,
    )
    if bodies.tracks is not None:
        place, orientation = bodies.tracks.at(after.time)
        at = bodies.tracks.body
        after = replace(
            after,
            position=after.position.index_copy(0, at, place),
            orientation=after.orientation.index_copy(0, at, orientation),
        )
    touch = Touch(
        touching=torch.from_numpy(motion.touching),
        quiet=torch.from_numpy(motion.quiet),
        anchor=torch.from_numpy(motion.anchor),
        island=torch.from_numpy(motion.island),
        pair=torch.from_numpy(manifolds.pair),
        count=torch.from_numpy(manifolds.count),
        point=torch.from_numpy(manifolds.point),
        held=held(after),
        gravity=torch.from_numpy(rules.gravity),
    )
    return replace(after, touch=touch), edges, counts


def taken_up(
    bodies: Bodies, state: State, scene: Compiled, rules: compiled.Rules
) -> tuple[compiled.Motion, compiled.Manifolds]:
    """Copies of a state as the compiled step writes to them; whoever was changed from outside is awake, and so are
    those that slept with it or on it."""
    position, orientation, velocity, angular = (
        np.array(t.cpu().numpy(), dtype=np.float64, order="C")
        for t in (state.position, state.orientation, state.velocity, state.angular_velocity)
    )
    n, touch = len(position), state.touch
    if touch is None:
        anchor = np.concatenate([position, orientation], 1)
        still, nobody = np.zeros(n, np.int64), np.full(n, -1, np.int64)
        motion = compiled.Motion(position, orientation, velocity, angular, still > 0, still, anchor, nobody)
        return motion, no_manifolds()
    island, quiet = np.array(touch.island.numpy()), np.array(touch.quiet.numpy())
    touching = np.array(touch.touching.numpy())
    if (touch.gravity.numpy() != rules.gravity).any():
        island[:], quiet[:] = -1, 0
    changed = (np.concatenate([position, orientation, velocity, angular], -1) != touch.held.numpy()).any(-1)
    if scene.world.scripted.any():
        changed &= ~scene.world.scripted
    if changed.any():
        if (changed & ~scene.world.moves).any():
            scene.place(state)
        beside = touch.pair.numpy()[touch.count.numpy() > 0]
        restless = changed.copy()
        restless[beside[changed[beside[:, 1]], 0]] = True
        restless[beside[changed[beside[:, 0]], 1]] = True
        up = np.isin(island, island[restless & (island >= 0)])
        island[up], quiet[up | changed] = -1, 0
        touching[changed] = False
    motion = compiled.Motion(
        position, orientation, velocity, angular, touching, quiet, np.array(touch.anchor.numpy()), island
    )
    return motion, compiled.Manifolds(touch.pair.numpy(), touch.count.numpy(), touch.point.numpy())


def held(state: State) -> torch.Tensor:
    """[N, 13] poses and velocities, by which a state that somebody changed is known."""
    return torch.cat([state.position, state.orientation, state.velocity, state.angular_velocity], -1)


@dataclass(frozen=True)
class Touching:
    """E places where bodies touch, model units."""

    pair: np.ndarray  # [E, 2] int64, the two bodies
    point: np.ndarray  # [E, 3] on the first, world; normal: [E, 3] from the second to the first
    normal: np.ndarray
    impulse: np.ndarray  # [E, 3] on the first in the last inner step
    gap: np.ndarray  # [E] below 0 where they are in each other


def contact_points(state: State) -> Touching:
    """Where bodies touch in a state."""
    touch = state.touch
    if touch is None or not len(touch.pair):
        nothing = np.zeros((0, 3))
        return Touching(np.zeros((0, 2), np.int64), nothing, nothing, nothing, nothing[:, 0])
    point = touch.point.numpy()
    there = np.arange(compiled.POINTS) < touch.count.numpy()[:, None]
    m, k = (there & (point[..., compiled.GAP] <= TOUCHING)).nonzero()
    pair, point = touch.pair.numpy()[m], point[m, k]
    first = pair[:, 0]
    turn = pose.to_matrix(state.orientation).numpy()[first]
    place = state.position.numpy()[first] + (turn @ point[:, :3, None])[..., 0]
    normal = point[:, compiled.NORMAL : compiled.NORMAL + 3]
    impulse = normal * point[:, compiled.PUSH, None] + point[:, compiled.DRAG : compiled.DRAG + 3]
    return Touching(pair, place, normal, impulse, point[:, compiled.GAP])


def compiled_rules(
    gravity: np.ndarray, dt: float, substeps: int, *, friction: bool = True, restitution: bool = True,
    rotation: bool = True, sleep: bool = False, margin: float = 0.0, adds: bool = False, note: bool = False,
    own: SolverRules | None = None,
) -> compiled.Rules:  # fmt: skip
    """The rules of a run, model units."""
    own = own or SolverRules()
    inner = dt / substeps
    slow = own.slow * float(np.linalg.norm(gravity)) * inner
    made: dict[str, Any] = vars(own) | {"look": own.look + 2.0 * margin, "slow": slow}
    return compiled.Rules(
        gravity=np.asarray(gravity, dtype=np.float64), inner=inner, steps=substeps, friction=friction,
        restitution=restitution, rotation=rotation, sleep=sleep, margin=margin, adds=adds, note=note,
        ahead=inner if note and inner > COARSE else 0.0, **made,
    )  # fmt: skip


def no_manifolds() -> compiled.Manifolds:
    """Nothing is known of any contact."""
    return compiled.Manifolds(
        np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros((0, compiled.POINTS, compiled.COLUMNS))
    )


def compiled_shapes(bodies: Bodies) -> kinds.Shapes:
    """The shapes of a scene, baked where they have no closed form."""
    sdfs: Sequence[Sdf] = bodies.sdfs
    count = len(sdfs)
    table = np.zeros((count, kinds.FIELDS))
    table[:, kinds.THICKNESS], table[:, kinds.CELL], table[:, kinds.PATCH] = np.inf, 1.0, -1.0
    brick, sample, trees = [np.zeros(0, np.int32)], [np.zeros(0, np.float32)], []
    label = [np.zeros(0, np.int16)]
    owner = {int(s): k for k, s in reversed(list(enumerate(bodies.shape.tolist()))) if s >= 0}
    for s, sdf in enumerate(sdfs):
        grid, surface, inward, clumps = _geometry(sdf, _nodes_of(bodies, owner[s]), bodies.pieces[s])
        trees.append((surface, inward, clumps))
        row = table[s]
        if surface.nearest is not None:
            row[kinds.PATCH_LOW : kinds.PATCH_LOW + 3], row[kinds.PATCH_CELL] = surface.low, surface.cell
            row[kinds.PATCHES : kinds.PATCHES + 3], row[kinds.PATCH] = surface.nearest.shape, sum(map(len, label))
            label.append(surface.nearest.reshape(-1))
        sizes, walls = row[kinds.SIZE : kinds.SIZE + 3], slice(kinds.THICKNESS, kinds.THICKNESS + 1)
        if isinstance(sdf, PlaneSdf):
            row[kinds.KIND] = kinds.PLANE
        elif isinstance(sdf, SphereSdf):
            row[kinds.KIND], sizes[0], row[walls] = kinds.SPHERE, sdf.radius, 2.0 * sdf.radius
        elif isinstance(sdf, BoxSdf):
            row[kinds.KIND], sizes[:], row[walls] = kinds.BOX, sdf.half, 2.0 * min(sdf.half)
        elif isinstance(sdf, CapsuleSdf):
            row[kinds.KIND], sizes[:2], row[walls] = kinds.CAPSULE, (sdf.radius, sdf.half), 2.0 * sdf.radius
        elif isinstance(sdf, CylinderSdf):
            row[kinds.KIND], sizes[:2] = kinds.CYLINDER, (sdf.radius, sdf.half)
            row[walls] = 2.0 * min(sdf.radius, sdf.half)
        elif grid is not None:
            row[kinds.KIND], row[walls], row[kinds.CELL] = kinds.GRID, grid.thickness, grid.cell
            row[kinds.LOW : kinds.LOW + 3], row[kinds.BRICKS : kinds.BRICKS + 3] = grid.low, grid.brick.shape
            row[kinds.COARSE], row[kinds.BRICK] = sum(map(len, sample)), sum(map(len, brick))
            sample.append(grid.coarse.reshape(-1))
            first, size = sum(map(len, sample)), grid.fine[:1].size
            brick.append(np.where(grid.brick >= 0, grid.brick.astype(np.int64) * size + first, -1).reshape(-1))
            sample.append(grid.fine.reshape(-1))
    return kinds.Shapes(
        table,
        np.concatenate(brick).astype(np.int64),
        np.concatenate(sample),
        *_joined(trees),
        label=np.concatenate(label),
    )


Geometry = tuple[np.ndarray, BakedGrid | None, Surface, np.ndarray, Clumps]
_known: WeakKeyDictionary[Sdf, Geometry] = WeakKeyDictionary()
_latest: OrderedDict[str, Geometry] = (
    OrderedDict()
)  # by content: scenes that reach a worker have copies of their shapes


def _geometry(
    sdf: Sdf, nodes: np.ndarray, pieces: tuple[np.ndarray, ...]
) -> tuple[BakedGrid | None, Surface, np.ndarray, Clumps]:
    """The grid of an SDF that has no closed form, its surface, from where its nodes look out, and these in leaves. Made
    once for all scenes of a process."""
    kept = _known.get(sdf)
    if kept is None or kept[0].shape != nodes.shape or (kept[0] != nodes).any():
        content = digest(sdf, nodes, pieces)
        kept = _latest.pop(content, None) or _looked_at(sdf, nodes, pieces)
        _known[sdf] = _latest[content] = kept
        if len(_latest) > MOST_KEPT:
            _latest.popitem(last=False)
    return kept[1:]


def _looked_at(sdf: Sdf, nodes: np.ndarray, pieces: tuple[np.ndarray, ...]) -> Geometry:
    grid = None if isinstance(sdf, ANALYTIC) else baked(sdf, nodes, pieces)
    if grid and grid.thickness <= 1.001 * WALL * grid.cell:
        told = "a shape of %.2g m has walls of at most %.2g m: things may pass through; --thicken helps"
        _log.warning(told, _extent(sdf), grid.thickness)
    surface = surface_of(sdf, nodes, pieces)
    inward = INWARD * _extent(sdf) * inwards(sdf, surface.nodes)
    return nodes, grid, surface, inward, _clumps(surface.nodes, surface.patch)


def compiled_world(bodies: Bodies, state: State) -> compiled.World:
    """The bodies of a scene."""
    array = {name: getattr(bodies, name).cpu().numpy() for name in _ARRAYS}
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
        inverse_mass=array["inverse_mass"], inertia=inertia,
        inverse_inertia=np.linalg.inv(inertia) * moves[:, None, None], isotropic=isotropic,
        friction=array["friction"], restitution=array["restitution"], moves=moves, scripted=scripted,
        group=array["group"], allowed=array["allowed"], realm=array["world"],
        going=np.flatnonzero(moves | scripted), plane=plane, still=still[order],
        low=low, high=high, reach=np.maximum.accumulate(high[:, axis]) if len(still) else np.zeros(0), axis=axis,
    )  # fmt: skip


_ARRAYS = (
    *("shape", "scale", "com", "bounds", "radius", "inverse_mass", "inertia", "friction", "restitution", "moves"),
    *("group", "allowed", "world"),
)


def _nodes_of(bodies: Bodies, k: int) -> np.ndarray:
    """[K, 3] surface nodes of the shape of body k, at scale 1 in the shape's own frame. Rounded to 1e-12 m, so that
    bodies of different scales know them as the same nodes."""
    first, last = int(bodies.node_start[k]), int(bodies.node_start[k + 1])
    return ((bodies.node[first:last] + bodies.com[k]) / bodies.scale[k]).cpu().numpy().round(12)


def _extent(sdf: Sdf) -> float:
    low, high = sdf.bounds
    return float((high - low).max()) if np.isfinite(high).all() else 0.0


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


def _joined(trees: list[tuple[Surface, np.ndarray, Clumps]]) -> tuple[np.ndarray, ...]:
    """The node arrays of `kinds.Shapes`."""
    node, inward = [np.zeros((0, 3))], [np.zeros((0, 3))]
    leaf_node, leaf_ball = [0], [np.zeros((0, 4))]
    clump_start, clump_leaf, clump_ball = [0], [0], [np.zeros((0, 4))]
    leaf_patch = []
    for surface, within, clumps in trees:
        nodes = surface.nodes
        for leaves in clumps:
            for leaf in leaves:
                node.append(nodes[leaf])
                inward.append(within[leaf])
                leaf_node.append(leaf_node[-1] + len(leaf))
                leaf_ball.append(_ball(nodes[leaf]))
                leaf_patch.append(surface.patch[leaf[0]])
            clump_leaf.append(clump_leaf[-1] + len(leaves))
            clump_ball.append(_ball(nodes[np.concatenate(leaves)]))
        clump_start.append(len(clump_leaf) - 1)
    whole = [np.array(x, dtype=np.int64) for x in (leaf_node, clump_start, clump_leaf)]
    return (
        np.concatenate(node), np.concatenate(inward), whole[0], np.concatenate(leaf_ball), whole[1], whole[2],
        np.concatenate(clump_ball), np.array(leaf_patch, dtype=np.int64),
    )  # fmt: skip


def _ball(places: np.ndarray) -> np.ndarray:
    middle = 0.5 * (places.min(0) + places.max(0))
    return np.array([[*middle, np.linalg.norm(places - middle, axis=1).max()]])
