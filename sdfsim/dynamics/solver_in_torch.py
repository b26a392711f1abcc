"""The contact solve in plain torch: the same step as `kernels`, written to be read, slow, and differentiable.

It is what the compiled step is tested against, and the path of gradients: with respect to start velocities, friction,
restitution and masses (which node touches and which contacts are kept are decisions, and have none). It looks at every
pair of bodies and at every node, one contact after the other. Left out is what changes no motion but for speed's sake
or in need: the broad phase, sleep, and the stop before walls that a body would cross within one inner step.

One step: look where bodies touch (`touching_points`), write down what their velocities want (`equations`), find the
impulses (`sequential_impulses`), move (`advance`); a few inner steps of these make a step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.kernels import collide as ways
from sdfsim.dynamics.kernels import distance as kinds
from sdfsim.dynamics.kernels import solve as solving
from sdfsim.dynamics.kernels.step import MOST_TURN
from sdfsim.dynamics.kernels.world import POINTS, Manifolds, Motion, Rules
from sdfsim.dynamics.solver import Compiled

ROUND = (kinds.SPHERE, kinds.CAPSULE)


@dataclass(frozen=True)
class Bodies:
    """What stays of N bodies: see `kernels.world.World`, whose fields these are, as tensors that may have gradients."""

    shape: list[int]
    scale: Tensor
    com: Tensor
    inverse_mass: Tensor
    inertia: Tensor
    inverse_inertia: Tensor
    friction: Tensor
    restitution: Tensor
    moves: list[bool]
    isotropic: list[bool]
    infinite: list[bool]
    radius: Tensor
    meets: Tensor
    load: Tensor


@dataclass(frozen=True)
class Moving:
    """How N bodies are and move: position [N, 3], orientation [N, 4] xyzw, velocity and angular [N, 3], and whether
    contacts acted in the last inner step."""

    position: Tensor
    orientation: Tensor
    velocity: Tensor
    angular: Tensor
    touching: list[bool]


@dataclass(frozen=True)
class Point:
    """One contact of bodies a and b: places on either (about its centre of mass, in its axes), the normal from b to a,
    the distance, what impulses it had, and which patches meet."""

    first: Tensor
    second: Tensor
    normal: Tensor
    gap: Tensor
    key: int = 0
    push: Tensor = field(default_factory=lambda: torch.zeros((), dtype=torch.float64))
    drag: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))


Contacts = dict[tuple[int, int], list[Point]]


@dataclass
class Row:
    """One equation: `change` of the velocities of a and b along an axis, as far as limits allow.

    `arm` and `other` are what a unit of impulse does to their angular momenta; `spin` and `counter` to their angular
    velocities; `mass` is the inverse of what it does to their relative velocity.
    """

    axis: Tensor
    arm: Tensor
    other: Tensor
    spin: Tensor
    counter: Tensor
    mass: Tensor
    wanted: Tensor
    impulse: Tensor


@dataclass
class Equations:
    """The rows of one contact point: along the normal and two tangents, the product of friction, the speed that
    resolves a penetration without staying, and what `kernels.solve.System.calm` has of it."""

    pair: tuple[int, int]
    number: int
    normal: Row
    tangents: list[Row]
    grip: Tensor
    deep: Tensor
    calm: tuple[Tensor, Tensor, Tensor]


def of_compiled(scene: Compiled, motion: Motion) -> tuple[Bodies, Moving]:
    """The twin's bodies and motion of those of the compiled step."""
    world = scene.world
    meets = torch.zeros(len(world.shape), len(world.shape), dtype=torch.bool)
    for a, b in combinations(range(len(world.shape)), 2):
        one, other = world.realm[a], world.realm[b]
        together = one == other or one < 0 or other < 0
        touch = world.allowed[world.group[a], world.group[b]] and world.shape[a] >= 0 and world.shape[b] >= 0
        meets[a, b] = bool(together and touch and (world.moves[a] or world.moves[b]))
    bodies = Bodies(
        shape=world.shape.tolist(),
        meets=meets,
        moves=world.moves.tolist(),
        isotropic=world.isotropic.tolist(),
        infinite=(world.radius == float("inf")).tolist(),
        load=torch.from_numpy(scene.work.load.copy()),
        **{name: torch.from_numpy(getattr(world, name).copy()) for name in _TENSORS},
    )
    moving = Moving(
        *(
            torch.from_numpy(getattr(motion, name).copy())
            for name in ("position", "orientation", "velocity", "angular")
        ),
        touching=motion.touching.tolist(),
    )
    return bodies, moving


_TENSORS = ("scale", "com", "radius", "inverse_mass", "inertia", "inverse_inertia", "friction", "restitution")


def step(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, rules: Rules, contacts: Contacts
) -> tuple[Moving, Contacts]:
    """Advance by one step; see `kernels.step.step`."""
    gravity = torch.from_numpy(rules.gravity)
    moving = _shifted(bodies, moving, rules, -0.5)
    gone = torch.zeros(len(bodies.moves), dtype=torch.float64)
    looked: dict[tuple[int, int], float] = {}
    for _ in range(rules.steps):
        kept = {}
        for pair in _pairs(bodies):
            went = float(gone[list(pair)].sum())
            anew = went - looked.get(pair, -torch.inf) >= rules.still
            if anew:
                looked[pair] = went
            if points := touching_points(shapes, bodies, moving, rules, pair, contacts.get(pair, []), anew=anew):
                kept[pair] = points
        contacts = kept
        free = _free(bodies, moving, rules)
        rows = equations(bodies, moving, rules, gravity, free, contacts)
        change, shift = torch.zeros_like(free), torch.zeros_like(free)
        for island in _islands(bodies, rows):
            change, shift = sequential_impulses(bodies, rules, island, change, shift)
        contacts = _remembered(contacts, rows)
        before, moving = moving, advance(bodies, moving, rules, change, shift)
        gone += _way(bodies, before, moving)
    return _shifted(bodies, moving, rules, 0.5), contacts


def _way(bodies: Bodies, before: Moving, after: Moving) -> Tensor:
    """[N] how far any point of a body has moved at most."""
    turned = pose.to_rotvec(pose.multiply(after.orientation, pose.conjugate(before.orientation)))
    way = (after.position - before.position).norm(dim=1) + turned.norm(dim=1) * bodies.radius
    return torch.where(torch.tensor(bodies.infinite), 0.0, way).detach()


def _shifted(bodies: Bodies, moving: Moving, rules: Rules, part: float) -> Moving:
    """Velocities at an instant become those of the inner step before it, or back; what is touched has only one."""
    flies = torch.tensor([not t for t in moving.touching])[:, None]
    pulled = part * flies * _pulled(bodies, moving, rules)
    spun = pulled[:, 3:] * float(rules.rotation)
    return replace(moving, velocity=moving.velocity + pulled[:, :3], angular=moving.angular + spun)


def _pulled(bodies: Bodies, moving: Moving, rules: Rules) -> Tensor:
    """[N, 6] what gravity and what pulls at a body add to its velocities in an inner step."""
    gravity = torch.from_numpy(rules.gravity)
    rows = []
    for b, moves in enumerate(bodies.moves):
        push = float(moves) * gravity + bodies.inverse_mass[b] * bodies.load[b, :3]
        rows.append(torch.cat([push, _inverse(bodies, moving, b) @ bodies.load[b, 3:]]))
    return rules.inner * torch.stack(rows)


def _pairs(bodies: Bodies) -> list[tuple[int, int]]:
    """Whoever may meet, first the one that moves; in the order of the compiled step."""
    found = []
    for a, b in bodies.meets.nonzero().tolist():
        found.append((a, b) if bodies.moves[a] else (b, a))
    return sorted(found)


# Where bodies touch


def touching_points(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, rules: Rules, pair: tuple[int, int], old: list[Point], *,
    anew: bool,
) -> list[Point]:  # fmt: skip
    """The contact points of a pair: old ones that still hold, and where it is looked at `anew` further ones."""
    a, b = pair
    round_a, round_b = (_kind(shapes, bodies, body) in ROUND for body in pair)
    if round_a or round_b:
        found = _of_round(shapes, bodies, moving, rules, pair, 0 if round_a else 1)
        ball = _kind(shapes, bodies, a if round_a else b) == kinds.SPHERE
        known = _still_there(shapes, bodies, moving, rules, pair, old if ball and not (round_a and round_b) else [])
        return _spread(rules, known, found, rounded=True)
    known = _still_there(shapes, bodies, moving, rules, pair, old)
    if not anew:
        return known
    for one, other in ((a, b), (b, a)):
        if middle := _swallowed(shapes, bodies, moving, one, other):
            return [middle if one == a else _turned(middle)]
    found = _of_nodes(shapes, bodies, moving, rules, a, b) + [
        _turned(point) for point in _of_nodes(shapes, bodies, moving, rules, b, a)
    ]
    return _spread(rules, known, _first_to_touch(rules, found[: ways.FOUND]), rounded=False)


def _kind(shapes: kinds.Shapes, bodies: Bodies, body: int) -> int:
    return int(shapes.table[bodies.shape[body], kinds.KIND])


def _turned(point: Point) -> Point:
    """The same contact, told by the other body; of its key each half is a patch."""
    mine, theirs = divmod(point.key, ways.KEYS)
    key = theirs * ways.KEYS + mine
    return replace(point, first=point.second, second=point.first, normal=-point.normal, key=key)


def _still_there(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, rules: Rules, pair: tuple[int, int], old: list[Point]
) -> list[Point]:
    """Old points at the present poses, less those that have parted or slid too far."""
    kept = []
    for point in old:
        ends = []
        for body, end, sign in ((pair[0], point.first, -1.0), (pair[1], point.second, 1.0)):
            if _kind(shapes, bodies, body) == kinds.SPHERE:
                radius = shapes.table[bodies.shape[body], kinds.SIZE] * bodies.scale[body]
                inwards = pose.rotate(pose.conjugate(moving.orientation[body]), sign * radius * point.normal)
                end = inwards - bodies.com[body]
            ends.append(end)
        apart = _place(moving, pair[0], ends[0]) - _place(moving, pair[1], ends[1])
        gap = apart @ point.normal
        slid = apart - gap * point.normal
        if gap <= rules.reach and slid @ slid <= rules.reach**2:
            kept.append(replace(point, first=ends[0], second=ends[1], gap=gap))
    return kept


def _place(moving: Moving, body: int, end: Tensor) -> Tensor:
    return moving.position[body] + pose.rotate(moving.orientation[body], end)


def _into(bodies: Bodies, moving: Moving, a: int, b: int, p: Tensor) -> Tensor:
    """Points [P, 3] of the shape of body a in the frame of the shape of body b, both at scale 1."""
    world = moving.position[a] + pose.rotate(
        moving.orientation[a].expand(len(p), 4), p * bodies.scale[a] - bodies.com[a]
    )
    back = pose.conjugate(moving.orientation[b]).expand(len(p), 4)
    return (pose.rotate(back, world - moving.position[b]) + bodies.com[b]) / bodies.scale[b]


def _of_nodes(shapes: kinds.Shapes, bodies: Bodies, moving: Moving, rules: Rules, one: int, other: int) -> list[Point]:
    """Of each leaf of nodes of body `one` the deepest in the other's distances, then down along the own surface."""
    s, t = bodies.shape[one], bodies.shape[other]
    leaves = range(int(shapes.clump_leaf[shapes.clump_start[s]]), int(shapes.clump_leaf[shapes.clump_start[s + 1]]))
    if not leaves:
        return []
    first, last = int(shapes.leaf_node[leaves[0]]), int(shapes.leaf_node[leaves[-1] + 1])
    node, inward = (torch.from_numpy(array[first:last]) for array in (shapes.node, shapes.inward))
    gap, facing = _seen_from_within(shapes, bodies, moving, one, other, node, inward)
    score = gap - ways.OUTWARD * bodies.scale[one] * node.norm(dim=-1)
    score = torch.where(gap <= rules.look, score, torch.inf)
    chosen: list[tuple[float, int, int, Tensor]] = []  # depth, node, key, normal
    for leaf in leaves:
        of_leaf = score[shapes.leaf_node[leaf] - first : shapes.leaf_node[leaf + 1] - first]
        if not of_leaf.isfinite().any():
            continue
        u = int(of_leaf.argmin()) + int(shapes.leaf_node[leaf]) - first
        there = _patch(shapes, t, _into(bodies, moving, one, other, node[u : u + 1])[0])
        candidate = float(gap[u]), u, int(shapes.leaf_patch[leaf]) * ways.KEYS + there, facing[u]
        alike = [
            e for e, (_, _, key, normal) in enumerate(chosen)
            if key == candidate[2] and float(normal @ candidate[3]) > ways.ALIKE
        ]  # fmt: skip
        if len(alike) < ways.EACH and len(chosen) < ways.SIDE:
            chosen.append(candidate)
            continue
        shallowest = max(alike if len(alike) >= ways.EACH else range(len(chosen)), key=lambda e: chosen[e][0])
        if candidate[0] < chosen[shallowest][0]:
            chosen[shallowest] = candidate
    points = []
    for _, u, key, _ in chosen:
        p = _down(shapes, bodies, moving, one, other, node[u], inward[u])
        within = inward[u] if torch.equal(p, node[u]) else torch.zeros(3, dtype=torch.float64)
        gap, normal = (x[0] for x in _seen_from_within(shapes, bodies, moving, one, other, p[None], within[None]))
        if gap > rules.look:
            continue
        mine = p * bodies.scale[one] - bodies.com[one]
        foot = _into(bodies, moving, one, other, p[None])[0] * bodies.scale[other] - gap * normal
        points.append(Point(mine, foot - bodies.com[other], pose.rotate(moving.orientation[other], normal), gap, key))
    return points


def _swallowed(shapes: kinds.Shapes, bodies: Bodies, moving: Moving, one: int, other: int) -> Point | None:
    """The one contact of two bodies where the centre of `one` is inside both solids."""
    away = (moving.position[one] - moving.position[other]).norm()
    if not bodies.moves[one] or bodies.infinite[other] or away >= bodies.radius[other]:
        return None
    centre = (bodies.com[one] / bodies.scale[one])[None]
    there = _into(bodies, moving, one, other, centre)
    own, _ = distance(shapes, bodies.shape[one], centre)
    d, n = (x[0] for x in distance(shapes, bodies.shape[other], there))
    if own[0] >= 0 or d >= 0:
        return None
    k = bodies.scale[other]
    return Point(
        first=torch.zeros_like(centre[0]), second=k * (there[0] - d * n) - bodies.com[other],
        normal=pose.rotate(moving.orientation[other], n), gap=k * d,
    )  # fmt: skip


def _seen_from_within(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, one: int, other: int, p: Tensor, inward: Tensor
) -> tuple[Tensor, Tensor]:
    """Distances [P] of nodes from the other body, and normals [P, 3] in its axes, from a little within their solid."""
    at = _into(bodies, moving, one, other, p)
    back = _into(bodies, moving, one, other, p + inward) - at
    row = shapes.table[bodies.shape[other]]
    if row[kinds.KIND] == kinds.GRID:  # fine only so near to its surface
        back = back * (ways.NEAR * row[kinds.CELL] / back.norm(dim=-1, keepdim=True).clamp_min(1e-30)).clamp_max(1.0)
    d, n = distance(shapes, bodies.shape[other], at + back)
    return bodies.scale[other] * (d - (back * n).sum(-1)), n


@torch.no_grad()
def _down(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, one: int, other: int, p: Tensor, inward: Tensor
) -> Tensor:
    """From a node down the other's distance along the own surface, by steps that grow and shrink."""
    s, t, k = bodies.shape[one], bodies.shape[other], bodies.scale[other]
    d, n = (x[0] for x in _seen_from_within(shapes, bodies, moving, one, other, p[None], inward[None]))
    d = d / k
    stride = ways.STRIDE * float(shapes.clump_ball[shapes.clump_start[s], 3])
    least = stride * (ways.FINEST / ways.STRIDE)
    _, own = distance(shapes, s, p[None])
    for _ in range(ways.ROUNDS):
        downhill = pose.rotate(pose.conjugate(moving.orientation[one]), pose.rotate(moving.orientation[other], n))
        downhill = downhill - (downhill @ own[0]) * own[0]
        slope = downhill.norm()
        if slope < 0.02:
            break
        better = False
        while stride > least:
            q = p - stride / slope * downhill
            away, own = distance(shapes, s, q[None])
            q = q - away[0] * own[0]
            there, normal = distance(shapes, t, _into(bodies, moving, one, other, q[None]))
            if there[0] < d - 1e-9:
                better, p, d, n = True, q, there[0], normal[0]
                stride *= 1.3
                break
            stride *= 0.4
        if not better:
            break
    return p


def _of_round(
    shapes: kinds.Shapes, bodies: Bodies, moving: Moving, rules: Rules, pair: tuple[int, int], side: int
) -> list[Point]:
    """A sphere or capsule against anything: the distance at its core, less its radius."""
    one, other = pair[side], pair[1 - side]
    s, t = bodies.shape[one], bodies.shape[other]
    k, own = bodies.scale[other], bodies.scale[one]
    radius, half = shapes.table[s, kinds.SIZE], 0.0
    heights = [0.0]
    if shapes.table[s, kinds.KIND] == kinds.CAPSULE:
        half = float(shapes.table[s, kinds.SIZE + 1])
        heights = [-half, half]
        if shapes.table[t, kinds.KIND] != kinds.PLANE:
            lowest = _lowest(shapes, bodies, moving, one, other, half)
            heights += [lowest] if half - abs(lowest) >= 0.05 * half else []
    points = []
    for height in heights:
        core = torch.tensor([[0.0, 0.0, height]], dtype=torch.float64)
        there = _into(bodies, moving, one, other, core)
        d, n = (x[0] for x in distance(shapes, t, there))
        gap = k * d - own * radius
        if gap > rules.reach:
            continue
        normal = pose.rotate(moving.orientation[other], n)
        down = pose.rotate(pose.conjugate(moving.orientation[one]), -own * radius * normal)
        mine, theirs = core[0] * own + down - bodies.com[one], k * there[0] - k * d * n - bodies.com[other]
        point = Point(mine, theirs, normal, gap)
        points.append(point if side == 0 else _turned(point))
    return points


@torch.no_grad()
def _lowest(shapes: kinds.Shapes, bodies: Bodies, moving: Moving, one: int, other: int, half: float) -> float:
    """Where between -half and half of its axis a capsule is nearest to the other: golden section."""

    def ask(height: float) -> float:
        there = _into(bodies, moving, one, other, torch.tensor([[0.0, 0.0, height]], dtype=torch.float64))
        return float(distance(shapes, bodies.shape[other], there)[0][0])

    golden = 0.6180339887498949
    low, high = -half, half
    x, y = high - golden * (high - low), low + golden * (high - low)
    f, g = ask(x), ask(y)
    for _ in range(30):
        if f <= g:
            high, y, g = y, x, f
            x = high - golden * (high - low)
            f = ask(x)
        else:
            low, x, f = x, y, g
            y = low + golden * (high - low)
            g = ask(y)
    return 0.5 * (low + high)


def _first_to_touch(rules: Rules, found: list[Point]) -> list[Point]:
    """Of points of one kind only the deepest, and those that are as deep: what an impact meets first."""

    def shadowed(point: Point) -> bool:
        return any(
            float(point.normal @ other.normal) > ways.ALIKE
            and point.key == other.key
            and float(other.gap) < float(point.gap) - rules.together
            for other in found
        )

    return [point for point in found if not shadowed(point)]


def _spread(rules: Rules, known: list[Point], found: list[Point], *, rounded: bool) -> list[Point]:
    """Old and new points in one manifold: the deepest, then always the one that is farthest from those chosen.

    A new point that nearly coincides with an old one takes its place and its impulses.
    """
    every = list(found)
    for old in known:
        twin = None
        for e, new in enumerate(every[: len(found)]):
            near = float((old.first - new.first).square().sum()) < rules.reach**2
            turned = float(old.normal @ new.normal)
            if (near and turned > 0.8) or (rounded and turned > 0.99):
                twin = e
                break
        if twin is None:
            every.append(old)
        elif float(every[twin].push) == 0.0:
            every[twin] = replace(every[twin], push=old.push, drag=old.drag)
    if not every:
        return []
    away, alike = [float("inf")] * len(every), [0] * len(every)
    score = [float(p.gap) - ways.OUTWARD * float(p.first.norm()) for p in every]
    chosen, kept = score.index(min(score)), []
    while chosen is not None and len(kept) < POINTS:
        this = every[chosen]
        kept.append(this)
        farthest, following = rules.apart**2, None
        for e, point in enumerate(every):
            turned = float((point.normal - this.normal).square().sum())
            if turned < 0.02 and point.key == this.key:
                alike[e] += 1
            away[e] = min(away[e], float((point.first - this.first).square().sum()) + 0.01 * turned)
            if away[e] > farthest and alike[e] < ways.EACH:
                farthest, following = away[e], e
        chosen = following
    return kept


# What their velocities want


def _free(bodies: Bodies, moving: Moving, rules: Rules) -> Tensor:
    """[N, 6] what gravity, pulls and the gyroscopic torque make of the velocities in an inner step."""
    rows = []
    pulled = _pulled(bodies, moving, rules)
    for b, moves in enumerate(bodies.moves):
        turn = torch.zeros(3, dtype=torch.float64)
        if moves and not bodies.isotropic[b]:
            inverse, w = _inverse(bodies, moving, b), moving.angular[b]
            frame = pose.to_matrix(moving.orientation[b])

            def momentum(w: Tensor, frame: Tensor = frame, b: int = b) -> Tensor:
                return frame @ (bodies.inertia[b] @ (frame.T @ w))

            middle = w + 0.5 * rules.inner * (inverse @ torch.linalg.cross(momentum(w), w))
            turn = rules.inner * (inverse @ torch.linalg.cross(momentum(middle), middle))
        rows.append(pulled[b] + torch.cat([torch.zeros_like(turn), turn]))
    return torch.stack(rows)


def _inverse(bodies: Bodies, moving: Moving, b: int) -> Tensor:
    """[3, 3] inverse inertia in world axes."""
    frame = pose.to_matrix(moving.orientation[b])
    return frame @ bodies.inverse_inertia[b] @ frame.T


def equations(
    bodies: Bodies, moving: Moving, rules: Rules, gravity: Tensor, free: Tensor, contacts: Contacts
) -> list[Equations]:
    """The rows of all points that act in this inner step."""
    nothing = torch.zeros((), dtype=torch.float64)
    found = []
    for (a, b), points in contacts.items():
        friction = bodies.friction[a] * bodies.friction[b] if rules.friction else nothing
        bounce = bodies.restitution[a] * bodies.restitution[b] if rules.restitution else nothing
        margin = rules.margin * ((not bodies.infinite[a]) + (not bodies.infinite[b]))
        middle = _middle_of_face(points)

        def met(ends: tuple[Tensor, Tensor], a: int = a, b: int = b) -> tuple[Tensor, Tensor]:
            """Where both feel the impulse, from either centre of mass: half way between the ends of a contact."""
            one, other = (pose.rotate(moving.orientation[x], end) for x, end in zip((a, b), ends, strict=True))
            apart = moving.position[a] + one - moving.position[b] - other
            return one - 0.5 * apart, other + 0.5 * apart

        for number, point in enumerate(points):
            n, gap = point.normal, point.gap - margin
            arms = met((point.first, point.second))

            def relative(linear: Tensor, angular: Tensor, arms: tuple = arms, a: int = a, b: int = b) -> Tensor:
                one = linear[a] + torch.linalg.cross(angular[a], arms[0])
                return one - linear[b] - torch.linalg.cross(angular[b], arms[1])

            now = relative(moving.velocity, moving.angular)
            then = now + relative(free[:, :3], free[:, 3:])
            approach = now @ n
            if gap > solving.TOUCH and (-approach > rules.slow or gap + (then @ n) * rules.inner > 0.0):
                continue
            target = -approach * bounce if -approach > rules.slow else nothing
            deep = push = rest = nothing
            if gap > solving.TOUCH:
                target = rest = -gap / rules.inner
            elif gap <= -rules.split:
                deep = -gap * rules.erp / rules.inner
            elif gap < -rules.slop:
                push = (-gap - rules.slop) * rules.erp / rules.inner
                target = torch.maximum(push, torch.minimum(target + push, -approach) if rules.adds else target)
            before = then @ n
            normal = _row(bodies, moving, a, b, arms, n, target - before, point.push)
            tangents = []
            if float(friction) > 0.0:
                slip = then - (then @ n) * n
                if middle is not None:
                    # A face presses all over, and resists being turned less than its corners would.
                    arms = tuple(
                        (1.0 - solving.SPREAD) * end + solving.SPREAD * arm
                        for end, arm in zip(met(middle), arms, strict=True)
                    )
                    then = relative(moving.velocity, moving.angular, arms) + relative(free[:, :3], free[:, 3:], arms)
                    slip = then - (then @ n) * n
                one = _along_slip(n, slip, gravity)
                for axis in (one, torch.linalg.cross(n, one)):
                    most = friction * point.push
                    start = torch.clamp(point.drag @ axis, -most, most)
                    tangents.append(_row(bodies, moving, a, b, arms, axis, -(then @ axis), start))
            calm = (rest - before, before, push)
            found.append(Equations((a, b), number, normal, tangents, friction, deep, calm))
    return found


def _middle_of_face(points: list[Point]) -> tuple[Tensor, Tensor] | None:
    """The middle of points that bound a face, from either centre of mass in the body's axes."""
    if len(points) < 3 or any(float(p.normal @ points[0].normal) < 0.95 for p in points):
        return None
    return torch.stack([p.first for p in points]).mean(0), torch.stack([p.second for p in points]).mean(0)


def _along_slip(n: Tensor, slip: Tensor, gravity: Tensor) -> Tensor:
    """The first direction of friction: along the slip, else along gravity's tangential part, else any."""
    if slip @ slip < solving.AT_REST:
        slip = gravity - (gravity @ n) * n
        if slip @ slip < 1e-6 * (gravity @ gravity) + 1e-30:
            axis = [1.0, 0.0, 0.0] if abs(float(n[0])) < 0.7 else [0.0, 1.0, 0.0]
            slip = torch.linalg.cross(n, torch.tensor(axis, dtype=torch.float64))
    return slip / slip.norm()


def _row(
    bodies: Bodies, moving: Moving, a: int, b: int, arms: tuple, axis: Tensor, wanted: Tensor, impulse: Tensor
) -> Row:
    arm, other = torch.linalg.cross(arms[0], axis), torch.linalg.cross(axis, arms[1])
    spin, counter = _inverse(bodies, moving, a) @ arm, _inverse(bodies, moving, b) @ other
    mass = 1.0 / (bodies.inverse_mass[a] + bodies.inverse_mass[b] + arm @ spin + other @ counter)
    return Row(axis, arm, other, spin, counter, mass, wanted, impulse)


# The impulses


def _islands(bodies: Bodies, rows: list[Equations]) -> list[list[Equations]]:
    """Contacts of bodies that move, joined by contacts, belong together."""
    island = list(range(len(bodies.moves)))

    def root(b: int) -> int:
        return b if island[b] == b else root(island[b])

    for row in rows:
        a, b = row.pair
        if bodies.moves[a] and bodies.moves[b]:
            island[max(root(a), root(b))] = min(root(a), root(b))
    numbers = dict.fromkeys(root(row.pair[0]) for row in rows)
    return [[row for row in rows if root(row.pair[0]) == number] for number in numbers]


def sequential_impulses(
    bodies: Bodies, rules: Rules, island: list[Equations], change: Tensor, shift: Tensor
) -> tuple[Tensor, Tensor]:
    """What contacts of one island do, with less of what rebounds and pushes where it would gain energy from nothing.

    Returns:
        [N, 6] what contact adds to the velocities, and what only moves (of penetrations that are deep).
    """
    parts, shifts = list(change), list(shift)
    for contact in island:
        for row in [contact.normal, *contact.tangents]:
            _apply(bodies, parts, contact.pair, row, row.impulse)
    pushed = [torch.zeros_like(contact.deep) for contact in island]
    _part(bodies, rules, island, shifts, pushed)
    _balance(bodies, rules, island, parts)
    for share in (0.5, 0.0):
        if not any(contact.normal.wanted > contact.calm[0] for contact in island) or not _gains(rules, island, parts):
            break
        parts = list(change)
        for contact in island:
            for row in [contact.normal, *contact.tangents]:
                row.impulse = torch.zeros_like(row.impulse)
            calm, _, push = contact.calm
            contact.normal.wanted = calm + share * (contact.normal.wanted - calm)
            if push > 0.0:
                contact.deep = (1.0 - share) * push
        _part(bodies, rules, island, shifts, pushed)
        _balance(bodies, rules, island, parts)
    return torch.stack(parts), torch.stack(shifts)


def _gains(rules: Rules, island: list[Equations], parts: list[Tensor]) -> bool:
    """Whether contacts have given an island more energy than they may: impulses times mean velocities, added up."""
    work = spare = 0.0
    lift = 2.0 * float(torch.from_numpy(rules.gravity).norm()) * solving.LIFT * rules.slop
    for contact in island:
        _, before, push = contact.calm
        most = solving.SPARE * push * push + solving.ROUNDING * before * before + lift
        spare += 0.5 * float(contact.normal.mass * most)
        work += float(contact.normal.impulse * (before + 0.5 * _speed(parts, contact.pair, contact.normal)))
        work += sum(float(t.impulse * (0.5 * _speed(parts, contact.pair, t) - t.wanted)) for t in contact.tangents)
    return work > spare


def _part(bodies: Bodies, rules: Rules, island: list[Equations], shifts: list[Tensor], pushed: list[Tensor]) -> None:
    """Part what is deep in each other, by velocities that move bodies once and are forgotten."""
    for _ in range(rules.rounds):
        worst = 0.0
        for c, contact in enumerate(island):
            if contact.deep > 0.0:
                short = contact.deep - _speed(shifts, contact.pair, contact.normal)
                total = (pushed[c] + short * contact.normal.mass).clamp_min(0.0)
                _apply(bodies, shifts, contact.pair, contact.normal, total - pushed[c])
                worst = max(worst, abs(float((total - pushed[c]) / contact.normal.mass)))
                pushed[c] = total
        if worst <= rules.exact:
            break


def _balance(bodies: Bodies, rules: Rules, island: list[Equations], parts: list[Tensor]) -> None:
    """All normals, then all friction, again and again, until no impulse changes a velocity by more than `exact`."""
    for _ in range(rules.rounds):
        worst = 0.0
        for contact in island:
            worst = max(worst, _relax(bodies, parts, contact.pair, contact.normal, None))
        for contact in island:
            for row in contact.tangents:
                worst = max(worst, _relax(bodies, parts, contact.pair, row, contact.grip * contact.normal.impulse))
        if worst <= rules.exact:
            break


def _relax(bodies: Bodies, parts: list[Tensor], pair: tuple[int, int], row: Row, most: Tensor | None) -> float:
    """Bring one row to its wanted velocity: by pushing only, or by up to `most` either way."""
    total = row.impulse + (row.wanted - _speed(parts, pair, row)) * row.mass
    total = total.clamp_min(0.0) if most is None else torch.minimum(torch.maximum(total, -most), most)
    step = total - row.impulse
    row.impulse = total
    _apply(bodies, parts, pair, row, step)
    return abs(float(step / row.mass))


def _speed(parts: list[Tensor], pair: tuple[int, int], row: Row) -> Tensor:
    one, other = parts[pair[0]], parts[pair[1]]
    return row.axis @ (one[:3] - other[:3]) + row.arm @ one[3:] + row.other @ other[3:]


def _apply(bodies: Bodies, parts: list[Tensor], pair: tuple[int, int], row: Row, impulse: Tensor) -> None:
    a, b = pair
    parts[a] = parts[a] + impulse * torch.cat([bodies.inverse_mass[a] * row.axis, row.spin])
    parts[b] = parts[b] + impulse * torch.cat([-bodies.inverse_mass[b] * row.axis, row.counter])


def _remembered(contacts: Contacts, rows: list[Equations]) -> Contacts:
    """The contacts with the impulses that were found, none where a point did not act."""
    nothing = torch.zeros((), dtype=torch.float64)
    after = {
        pair: [replace(p, push=nothing, drag=torch.zeros(3).double()) for p in ps] for pair, ps in contacts.items()
    }
    for row in rows:
        drag = sum((t.impulse * t.axis for t in row.tangents), torch.zeros(3, dtype=torch.float64))
        points = after[row.pair]
        points[row.number] = replace(points[row.number], push=row.normal.impulse, drag=drag)
    return after


# Motion


def advance(bodies: Bodies, moving: Moving, rules: Rules, change: Tensor, shift: Tensor) -> Moving:
    """Move all bodies by one inner step: positions with the new velocities."""
    position, orientation, velocity, angular, touching = [], [], [], [], []
    pulled = _pulled(bodies, moving, rules)
    for b, moves in enumerate(bodies.moves):
        x, q, v, w = moving.position[b], moving.orientation[b], moving.velocity[b], moving.angular[b]
        touched = bool((change[b] != 0.0).any() or (shift[b] != 0.0).any()) and moves
        if moves:
            v = v + pulled[b, :3] + change[b, :3]
            w = (w + pulled[b, 3:] + change[b, 3:]) * float(rules.rotation)
        x = x + rules.inner * (v + shift[b, :3])
        further = shift[b, 3:] * float(rules.rotation)
        if moves and rules.rotation and not bodies.isotropic[b]:
            q, w = _torque_free(bodies, b, q, w, rules.inner)
        else:
            further = further + w
        q = pose.multiply(pose.from_rotvec(further * rules.inner), q)
        for series, value in zip((position, orientation, velocity, angular), (x, q / q.norm(), v, w), strict=True):
            series.append(value)
        touching.append(touched)
    return Moving(*(torch.stack(x) for x in (position, orientation, velocity, angular)), touching=touching)


def _torque_free(bodies: Bodies, b: int, q: Tensor, w: Tensor, span: float) -> tuple[Tensor, Tensor]:
    """Rotation without torque: angular momentum is kept, the pose to fourth order (Runge-Kutta-Munthe-Kaas)."""
    speed = float(w.norm())
    if speed == 0.0:
        return q, w
    frame = pose.to_matrix(q)
    momentum = frame @ bodies.inertia[b] @ frame.T @ w
    stages = max(1, int(-(-min(speed * span, 100.0) // MOST_TURN)))
    h = span / stages

    def at(q: Tensor) -> Tensor:
        frame = pose.to_matrix(q)
        return frame @ (bodies.inverse_inertia[b] @ (frame.T @ momentum))

    def slope(u: Tensor, q: Tensor) -> Tensor:
        w = at(pose.multiply(pose.from_rotvec(u), q))
        one = torch.linalg.cross(u, w)
        return h * (w - 0.5 * one + torch.linalg.cross(u, one) / 12.0)

    for _ in range(stages):
        k1 = h * w
        k2 = slope(0.5 * k1, q)
        k3 = slope(0.5 * k2, q)
        k4 = slope(k3, q)
        q = pose.multiply(pose.from_rotvec((k1 + k4 + 2.0 * (k2 + k3)) / 6.0), q)
        q = q / q.norm()
        w = at(q)
    return q, w


# Distances


def distance(shapes: kinds.Shapes, s: int, p: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distances [P] of shape s at places [P, 3], and unit normals [P, 3]; see `kernels.distance`."""
    row = shapes.table[s]
    kind, (a, b, c) = int(row[kinds.KIND]), row[kinds.SIZE : kinds.SIZE + 3]
    if kind == kinds.GRID:
        return _grid(shapes, s, p)
    if kind == kinds.PLANE:
        return p[:, 2], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(p), 3)
    if kind == kinds.CAPSULE:
        p = torch.stack([p[:, 0], p[:, 1], p[:, 2] - p[:, 2].clamp(-b, b)], 1)
    if kind in ROUND:
        length = p.norm(dim=-1)
        return length - a, p / length[:, None]
    if kind == kinds.BOX:
        side = torch.where(p < 0.0, -1.0, 1.0)
        beyond = side * p - torch.tensor([a, b, c])
        out = beyond.clamp_min(0.0)
        length = out.norm(dim=-1)
        nearest = torch.nn.functional.one_hot(beyond.argmax(-1), 3)
        outside = (length > kinds.TINY)[:, None]
        d = torch.where(outside[:, 0], length, beyond.amax(-1))
        return d, side * torch.where(outside, out / length.clamp_min(kinds.TINY)[:, None], nearest.double())
    r = p[:, :2].norm(dim=-1)
    rim = p[:, :2] / r.clamp_min(kinds.TINY)[:, None]
    side = torch.where(p[:, 2] < 0.0, -1.0, 1.0)
    beyond = torch.stack([r - a, side * p[:, 2] - b], 1)
    length = beyond.norm(dim=-1)
    corner = (beyond > 0.0).all(-1)
    d = torch.where(corner, length, beyond.amax(-1))
    share = torch.nn.functional.one_hot((beyond[:, 0] <= beyond[:, 1]).long(), 2).double()
    share = torch.where(corner[:, None], beyond / length.clamp_min(kinds.TINY)[:, None], share)
    return d, torch.cat([rim * share[:, :1], (side * share[:, 1])[:, None]], 1)


def _grid(shapes: kinds.Shapes, s: int, p: Tensor) -> tuple[Tensor, Tensor]:
    """Trilinear in the brick around p, or between the corners of bricks; the distance to the box adds beyond it."""
    row = shapes.table[s]
    cell, count = float(row[kinds.CELL]), torch.from_numpy(row[kinds.BRICKS : kinds.BRICKS + 3]).long()
    place = (p - torch.from_numpy(row[kinds.LOW : kinds.LOW + 3])) / cell
    inside = torch.minimum(place.clamp_min(0.0), 8.0 * count)
    beyond = (place - inside) * cell
    block = torch.minimum((inside / 8.0).long(), count - 1)
    first = int(row[kinds.BRICK]) + (block[:, 0] * count[1] + block[:, 1]) * count[2] + block[:, 2]
    fine = torch.from_numpy(shapes.brick)[first]
    near = fine >= 0
    local = torch.where(near[:, None], inside - 8.0 * block, inside / 8.0 - block)
    corner = torch.where(near[:, None], local.long().clamp_max(7), torch.zeros_like(block))
    part = local - corner
    strides = torch.where(
        near[:, None],
        torch.tensor([81, 9, 1]),
        torch.stack([(count[1] + 1) * (count[2] + 1), count[2] + 1, torch.ones_like(count[0])]),
    )
    start = torch.where(near, fine, torch.full_like(fine, int(row[kinds.COARSE]))) + (
        torch.where(near[:, None], corner, block) * strides
    ).sum(-1)
    sample = torch.from_numpy(shapes.sample)
    value = torch.zeros(len(p), dtype=torch.float64)
    slope = torch.zeros(len(p), 3, dtype=torch.float64)
    for bits in torch.cartesian_prod(*[torch.arange(2)] * 3):
        weight = torch.where(bits == 1, part, 1.0 - part)
        sign = 2.0 * bits - 1.0
        here = sample[start + (strides * bits).sum(-1)].double()
        value = value + weight.prod(-1) * here
        others = torch.stack([weight[:, 1] * weight[:, 2], weight[:, 0] * weight[:, 2], weight[:, 0] * weight[:, 1]], 1)
        slope = slope + sign * others * here[:, None]
    length = slope.norm(dim=-1, keepdim=True)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normal = torch.where(length < kinds.TINY, up, slope / length.clamp_min(kinds.TINY))
    far = beyond.square().sum(-1)
    out = far > 0.0
    # The solid lies within the box, which is convex: it is no nearer than this.
    lifted = value.clamp_min(0.0)
    reached = torch.where(out, far + lifted.square(), torch.ones_like(far)).sqrt()
    outward = (beyond + lifted[:, None] * normal) / reached[:, None]
    outward = outward / outward.norm(dim=-1, keepdim=True).clamp_min(kinds.TINY)
    return torch.where(out, reached, value), torch.where(out[:, None], outward, normal)


def _patch(shapes: kinds.Shapes, s: int, p: Tensor) -> int:
    """The patch of shape s that is nearest to p."""
    row = shapes.table[s]
    if row[kinds.PATCH] < 0:
        return 0
    count = row[kinds.PATCHES : kinds.PATCHES + 3].astype(int)
    place = (p.detach().numpy() - row[kinds.PATCH_LOW : kinds.PATCH_LOW + 3]) / row[kinds.PATCH_CELL]
    i, j, k = (min(max(int(x + 0.5), 0), n - 1) for x, n in zip(place, count, strict=True))
    return int(shapes.label[int(row[kinds.PATCH]) + (i * count[1] + j) * count[2] + k])


def contacts_of(manifolds: Manifolds) -> Contacts:
    """The twin's contacts of those of the compiled step."""
    from sdfsim.dynamics.kernels.world import DRAG, GAP, KEY, NORMAL, PUSH, SECOND

    found: Contacts = {}
    for m, (a, b) in enumerate(manifolds.pair.tolist()):
        rows = [torch.from_numpy(row.copy()) for row in manifolds.point[m, : manifolds.count[m]]]
        if rows:
            found[a, b] = [
                Point(r[:SECOND], r[SECOND:NORMAL], r[NORMAL:GAP], r[GAP], int(r[KEY]), r[PUSH], r[DRAG : DRAG + 3])
                for r in rows
            ]
    return found
