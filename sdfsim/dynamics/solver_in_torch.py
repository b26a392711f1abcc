"""The contact solve in plain torch: the same step as `kernels`, written to be read, slow, and differentiable.

It is what the compiled step is tested against, and the path of gradients: with respect to start velocities, friction,
restitution and masses (which node touches and which contacts are kept are decisions, and have none). It looks at every
pair of bodies and at every node, one contact after the other. Left out is what changes no motion but for speed's sake
or in need: the broad phase, sleep, and the stop before walls that a body would cross within one inner step.

One step: look where bodies touch (`touching_points`), write down what their velocities want (`equations`), find the
impulses (`impulses`), move (`advance`); a few inner steps of these make a step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.free_flight import torque_free
from sdfsim.dynamics.kernels import collide as ways
from sdfsim.dynamics.kernels import distance as kinds
from sdfsim.dynamics.kernels import solve as solving
from sdfsim.dynamics.kernels.world import POINTS, Rules

ROUND = (kinds.SPHERE, kinds.CAPSULE)
NEARBY = 1e-6  # of a shape's metres, for the differences that are a distance's derivatives
NOTHING, NOWHERE = torch.zeros((), dtype=torch.float64), torch.zeros(3, dtype=torch.float64)


@dataclass(frozen=True)
class Point:
    """One contact of bodies a and b: places on either (about its centre of mass, in its axes), the normal from b to a,
    the distance, which patches meet, and what impulses it had."""

    first: Tensor
    second: Tensor
    normal: Tensor
    gap: Tensor
    key: int = 0
    push: Tensor = NOTHING
    drag: Tensor = NOWHERE

    def told_by_other(self) -> Point:
        """The same contact of b and a; of its key each half is a patch."""
        mine, theirs = divmod(self.key, ways.KEYS)
        key = theirs * ways.KEYS + mine
        return replace(self, first=self.second, second=self.first, normal=-self.normal, key=key)


Points = dict[tuple[int, int], list[Point]]  # of pairs of bodies, the first of which moves


@dataclass(frozen=True)
class Known:
    """What a step leaves to the next: [N] bool, whom contacts acted on in the last inner step; and the contacts."""

    touching: Tensor
    points: Points


@dataclass
class Row:
    """One equation: the `wanted` change of the velocities of a and b along an axis, as far as limits allow.

    `arm` and `other` are what a unit of impulse does to their angular momenta; `spin` and `counter` to their angular
    velocities; `mass` is the inverse of what it does to their relative velocity.
    """

    pair: tuple[int, int]
    axis: Tensor
    arm: Tensor
    other: Tensor
    spin: Tensor
    counter: Tensor
    mass: Tensor
    wanted: Tensor
    impulse: Tensor

    def speed(self, velocities: list[Tensor]) -> Tensor:
        """The relative velocity along the axis, of velocities [6] of all bodies."""
        one, other = (velocities[body] for body in self.pair)
        return self.axis @ (one[:3] - other[:3]) + self.arm @ one[3:] + self.other @ other[3:]


@dataclass
class Equations:
    """Those of one contact point: along the normal and two tangents. `grip` is the product of friction, `deep` the
    speed that resolves a penetration without staying, and `pushed` the impulse that has given it so far; `calm` the
    change that is wanted along the normal if nothing rebounds and no penetration is resolved, `before` the speed along
    it without contact, `push` the speed that resolves penetration and stays."""

    pair: tuple[int, int]
    number: int
    normal: Row
    tangents: list[Row]
    grip: Tensor
    deep: Tensor
    calm: Tensor
    before: Tensor
    push: Tensor
    pushed: Tensor = NOTHING

    @property
    def rows(self) -> list[Row]:
        return [self.normal, *self.tangents]


@dataclass
class Solve:
    """The solve of a scene: its shapes (of `solver.Compiled`), bodies and rules."""

    shapes: kinds.Shapes
    bodies: Bodies
    rules: Rules
    isotropic: Tensor = field(init=False)  # [N] bool, whether angular velocity is constant in free flight
    pairs: list[tuple[int, int]] = field(init=False)  # whoever may meet, first the one that moves

    def __post_init__(self) -> None:
        bodies = self.bodies
        least, _, most = torch.linalg.eigvalsh(bodies.inertia.detach()).unbind(1)
        self.isotropic = most - least <= 1e-9 * most
        a, b = torch.combinations(torch.arange(len(bodies))).T
        meet = bodies.may_meet(a, b) & (bodies.shape[a] >= 0) & (bodies.shape[b] >= 0)
        first, second = (torch.where(bodies.moves[a], *x)[meet].tolist() for x in ((a, b), (b, a)))
        self.pairs = sorted(zip(first, second, strict=True))

    def step(self, state: State, known: Known) -> tuple[State, Known]:
        """Advance by one step; see `kernels.step.step`."""
        state = self._shifted(state, known, -0.5)
        gone = torch.zeros(len(self.bodies), dtype=torch.float64)
        looked: dict[tuple[int, int], float] = {}
        for _ in range(self.rules.steps):
            points: Points = {}
            for pair in self.pairs:
                went = float(gone[list(pair)].sum())
                anew = went - looked.get(pair, -torch.inf) >= self.rules.still
                if anew:
                    looked[pair] = went
                points[pair] = self.touching_points(state, pair, known.points.get(pair, []), anew=anew)
            contacts = self.equations(state, points)
            change, shift = self.impulses(contacts)
            touching = self.bodies.moves & ((change != 0.0) | (shift != 0.0)).any(1)
            known = Known(touching, _remembered(points, contacts))
            before, state = state, self.advance(state, change, shift)
            gone += self._way(before, state)
        return self._shifted(state, known, 0.5), known

    def _way(self, before: State, after: State) -> Tensor:
        """[N] how far any point of a body has moved at most."""
        turned = pose.to_rotvec(pose.multiply(after.orientation, pose.conjugate(before.orientation)))
        way = (after.position - before.position).norm(dim=1) + turned.norm(dim=1) * self.bodies.radius
        return torch.where(self.bodies.radius.isfinite(), way, 0.0).detach()

    def _shifted(self, state: State, known: Known, part: float) -> State:
        """Velocities at an instant become those of the inner step before it, or back; what is touched has only one."""
        pulled = part * ~known.touching[:, None] * self._pulled(state)
        angular = state.angular_velocity + pulled[:, 3:] * self.rules.rotation
        return replace(state, velocity=state.velocity + pulled[:, :3], angular_velocity=angular)

    def _inverse(self, state: State) -> Tensor:
        """[N, 3, 3] inverse inertias in world axes."""
        frame = pose.to_matrix(state.orientation)
        return frame @ torch.linalg.inv(self.bodies.inertia) @ frame.mT * self.bodies.moves[:, None, None]

    def _pulled(self, state: State) -> Tensor:
        """[N, 6] what gravity and what pulls at a body add to its velocities in an inner step."""
        load = torch.zeros(len(self.bodies), 6).double() if state.load is None else state.load
        push = self.bodies.moves[:, None] * torch.from_numpy(self.rules.gravity)
        push = push + self.bodies.inverse_mass[:, None] * load[:, :3]
        return self.rules.inner * torch.cat([push, pose.apply(self._inverse(state), load[:, 3:])], 1)

    # Where bodies touch

    def touching_points(self, state: State, pair: tuple[int, int], old: list[Point], *, anew: bool) -> list[Point]:
        """The contact points of a pair: old ones that still hold, and where it is looked at `anew` further ones."""
        a, b = pair
        kinds_of = [self._kind(body) for body in pair]
        rounds = [kind in ROUND for kind in kinds_of]
        if any(rounds):
            side = rounds.index(True)
            one_ball = kinds_of[side] == kinds.SPHERE and not all(rounds)
            known = self._still_there(state, pair, old if one_ball else [])
            return self._spread(known, self._of_round(state, pair, side), rounded=True)
        known = self._still_there(state, pair, old)
        if not anew:
            return known
        if middle := self._swallowed(state, a, b):
            return [middle]
        if middle := self._swallowed(state, b, a):
            return [middle.told_by_other()]
        found = self._of_nodes(state, a, b) + [point.told_by_other() for point in self._of_nodes(state, b, a)]
        return self._spread(known, self._first_to_touch(found[: ways.FOUND]), rounded=False)

    def _kind(self, body: int) -> int:
        return int(self.shapes.table[self.bodies.shape[body], kinds.KIND])

    def _still_there(self, state: State, pair: tuple[int, int], old: list[Point]) -> list[Point]:
        """Old points at the present poses, less those that have parted or slid too far."""
        kept = []
        for point in old:
            ends, places = [], []
            for body, end, sign in ((pair[0], point.first, -1.0), (pair[1], point.second, 1.0)):
                turn = state.orientation[body]
                if self._kind(body) == kinds.SPHERE:  # is touched where the normal says, however it has rolled
                    radius = self.shapes.table[self.bodies.shape[body], kinds.SIZE] * self.bodies.scale[body]
                    end = pose.rotate(pose.conjugate(turn), sign * radius * point.normal) - self.bodies.com[body]
                ends.append(end)
                places.append(state.position[body] + pose.rotate(turn, end))
            apart = places[0] - places[1]
            gap = apart @ point.normal
            slid = apart - gap * point.normal
            if gap <= self.rules.reach and slid @ slid <= self.rules.reach**2:
                kept.append(replace(point, first=ends[0], second=ends[1], gap=gap))
        return kept

    def _into(self, state: State, a: int, b: int, p: Tensor) -> Tensor:
        """Points [P, 3] of the shape of body a in the frame of the shape of body b, both at scale 1."""
        own, back = state.orientation[a].expand(len(p), 4), pose.conjugate(state.orientation[b]).expand(len(p), 4)
        place = state.position[a] + pose.rotate(own, p * self.bodies.scale[a] - self.bodies.com[a])
        return (pose.rotate(back, place - state.position[b]) + self.bodies.com[b]) / self.bodies.scale[b]

    def _distance(self, body: int, p: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances [P] of a body's shape at places [P, 3] in its frame, and unit normals [P, 3]."""
        return Distance.apply(p, self.shapes, int(self.bodies.shape[body]))  # type: ignore[return-value]

    def _of_nodes(self, state: State, one: int, other: int) -> list[Point]:
        """Of each leaf of nodes of body `one` the deepest in the other's distances, then down along the own surface."""
        shapes, s = self.shapes, int(self.bodies.shape[one])
        leaves = range(int(shapes.clump_leaf[shapes.clump_start[s]]), int(shapes.clump_leaf[shapes.clump_start[s + 1]]))
        if not leaves:
            return []
        look = self.rules.look + 2.0 * self.rules.margin
        first, last = int(shapes.leaf_node[leaves[0]]), int(shapes.leaf_node[leaves[-1] + 1])
        node, inward = (torch.from_numpy(array[first:last]) for array in (shapes.node, shapes.inward))
        gap, facing = self._seen_from_within(state, one, other, node, inward)
        score = gap - ways.OUTWARD * self.bodies.scale[one] * node.norm(dim=-1)
        score = torch.where(gap <= look, score, torch.inf)
        chosen: list[tuple[float, int, int, Tensor]] = []  # depth, node, key, normal
        for leaf in leaves:
            of_leaf = score[shapes.leaf_node[leaf] - first : shapes.leaf_node[leaf + 1] - first]
            if not of_leaf.isfinite().any():
                continue
            u = int(of_leaf.argmin()) + int(shapes.leaf_node[leaf]) - first
            there = self._into(state, one, other, node[u : u + 1])[0].tolist()
            patch = kinds.patch_of(shapes.table, shapes.label, int(self.bodies.shape[other]), tuple(there))
            candidate = float(gap[u]), u, int(shapes.leaf_patch[leaf]) * ways.KEYS + patch, facing[u]
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
            p = self._down(state, one, other, node[u], inward[u])
            within = inward[u] if torch.equal(p, node[u]) else NOWHERE
            gap, normal = (x[0] for x in self._seen_from_within(state, one, other, p[None], within[None]))
            if gap <= look:
                foot = self._into(state, one, other, p[None])[0] * self.bodies.scale[other] - gap * normal
                points.append(self._point(state, one, other, p * self.bodies.scale[one], foot, normal, gap, key))
        return points

    def _point(
        self, state: State, one: int, other: int, mine: Tensor, theirs: Tensor, normal: Tensor, gap: Tensor, key: int
    ) -> Point:
        """A new contact: places from the origins of both shapes, the normal in the axes of the other."""
        turned, com = pose.rotate(state.orientation[other], normal), self.bodies.com
        return Point(mine - com[one], theirs - com[other], turned, gap, key)

    def _swallowed(self, state: State, one: int, other: int) -> Point | None:
        """The one contact of two bodies where the centre of `one` is inside both solids."""
        bodies = self.bodies
        away = (state.position[one] - state.position[other]).norm()
        if not bodies.moves[one] or not away < bodies.radius[other] < torch.inf:
            return None
        centre = (bodies.com[one] / bodies.scale[one])[None]
        there = self._into(state, one, other, centre)
        own, _ = self._distance(one, centre)
        d, n = (x[0] for x in self._distance(other, there))
        if own[0] >= 0 or d >= 0:
            return None
        k = bodies.scale[other]
        return self._point(state, one, other, bodies.com[one], k * (there[0] - d * n), n, k * d, 0)

    def _seen_from_within(self, state: State, one: int, other: int, p: Tensor, inward: Tensor) -> tuple[Tensor, Tensor]:
        """Distances [P] of nodes from the other, and normals [P, 3] in its axes, from a little within their solid."""
        at = self._into(state, one, other, p)
        back = self._into(state, one, other, p + inward) - at
        row = self.shapes.table[self.bodies.shape[other]]
        if row[kinds.KIND] == kinds.GRID:  # fine only so near to its surface
            most = ways.NEAR * row[kinds.CELL] / back.norm(dim=-1, keepdim=True).clamp_min(1e-30)
            back = back * most.clamp_max(1.0)
        d, n = self._distance(other, at + back)
        return self.bodies.scale[other] * (d - (back * n).sum(-1)), n

    @torch.no_grad()
    def _down(self, state: State, one: int, other: int, p: Tensor, inward: Tensor) -> Tensor:
        """From a node down the other's distance along the own surface, by steps that grow and shrink."""
        d, n = (x[0] for x in self._seen_from_within(state, one, other, p[None], inward[None]))
        d = d / self.bodies.scale[other]
        stride = ways.STRIDE * float(self.shapes.clump_ball[self.shapes.clump_start[self.bodies.shape[one]], 3])
        least = stride * (ways.FINEST / ways.STRIDE)
        _, own = self._distance(one, p[None])
        for _ in range(ways.ROUNDS):
            downhill = pose.rotate(state.orientation[other], n)
            downhill = pose.rotate(pose.conjugate(state.orientation[one]), downhill)
            downhill = downhill - (downhill @ own[0]) * own[0]
            slope = downhill.norm()
            if slope < 0.02:
                break
            better = False
            while stride > least and not better:
                q = p - stride / slope * downhill
                away, own = self._distance(one, q[None])
                q = q - away[0] * own[0]
                there, normal = self._distance(other, self._into(state, one, other, q[None]))
                better = bool(there[0] < d - 1e-9)
                stride *= 1.3 if better else 0.4
            if not better:
                break
            p, d, n = q, there[0], normal[0]
        return p

    def _of_round(self, state: State, pair: tuple[int, int], side: int) -> list[Point]:
        """A sphere or capsule against anything: the distance at its core, less its radius."""
        one, other = pair[side], pair[1 - side]
        k, own = self.bodies.scale[other], self.bodies.scale[one]
        radius, half, *_ = self.shapes.table[self.bodies.shape[one], kinds.SIZE :].tolist()
        heights = [0.0]
        if self._kind(one) == kinds.CAPSULE:
            heights = [-half, half]
            if self._kind(other) != kinds.PLANE:
                lowest = self._lowest(state, one, other, half)
                heights += [lowest] if half - abs(lowest) >= 0.05 * half else []
        points = []
        for height in heights:
            core = torch.tensor([[0.0, 0.0, height]], dtype=torch.float64)
            there = self._into(state, one, other, core)
            d, n = (x[0] for x in self._distance(other, there))
            gap = k * d - own * radius
            if gap > self.rules.reach:
                continue
            normal = pose.rotate(state.orientation[other], n)
            down = pose.rotate(pose.conjugate(state.orientation[one]), -own * radius * normal)
            point = self._point(state, one, other, core[0] * own + down, k * (there[0] - d * n), n, gap, 0)
            points.append(point if side == 0 else point.told_by_other())
        return points

    @torch.no_grad()
    def _lowest(self, state: State, one: int, other: int, half: float) -> float:
        """Where between -half and half of its axis a capsule is nearest to the other: a decision, as compiled."""
        origin, *axes = self._into(state, one, other, torch.cat([NOWHERE[None], torch.eye(3).double()]))
        w = tuple(map(tuple, (torch.stack(axes) - origin).T.tolist()))
        grids, shape = (self.shapes.table, self.shapes.brick, self.shapes.sample), int(self.bodies.shape[other])
        return ways._lowest(*grids, shape, w, tuple(origin.tolist()), half)

    def _first_to_touch(self, found: list[Point]) -> list[Point]:
        """Of points of one kind only the deepest, and those that are as deep: what an impact meets first."""

        def shadowed(point: Point) -> bool:
            return any(
                float(point.normal @ other.normal) > ways.ALIKE
                and point.key == other.key
                and float(other.gap) < float(point.gap) - self.rules.together
                for other in found
            )

        return [point for point in found if not shadowed(point)]

    def _spread(self, known: list[Point], found: list[Point], *, rounded: bool) -> list[Point]:
        """Old and new points in one manifold: the deepest, then always the one that is farthest from those chosen.

        A new point that nearly coincides with an old one takes its place and its impulses.
        """

        def coincide(old: Point, new: Point) -> bool:
            near = float((old.first - new.first).square().sum()) < self.rules.reach**2
            turned = float(old.normal @ new.normal)
            return (near and turned > 0.8) or (rounded and turned > 0.99)

        every = list(found)
        for old in known:
            twin = next((e for e, new in enumerate(found) if coincide(old, new)), None)
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
            farthest, chosen = self.rules.apart**2, None
            for e, point in enumerate(every):
                turned = float((point.normal - this.normal).square().sum())
                if turned < 0.02 and point.key == this.key:
                    alike[e] += 1
                away[e] = min(away[e], float((point.first - this.first).square().sum()) + 0.01 * turned)
                if away[e] > farthest and alike[e] < ways.EACH:
                    farthest, chosen = away[e], e
        return kept

    # What their velocities want

    def _free(self, state: State) -> Tensor:
        """[N, 6] what gravity, pulls and the gyroscopic torque make of the velocities in an inner step."""
        frame, inverse, w = pose.to_matrix(state.orientation), self._inverse(state), state.angular_velocity

        def turned(w: Tensor) -> Tensor:
            momentum = pose.apply(frame, pose.apply(self.bodies.inertia, pose.apply(frame.mT, w)))
            return self.rules.inner * pose.apply(inverse, torch.linalg.cross(momentum, w))

        turn = torch.where(self.isotropic[:, None], 0.0, turned(w + 0.5 * turned(w)))
        return self._pulled(state) + torch.cat([torch.zeros_like(turn), turn], 1)

    def equations(self, state: State, points: Points) -> list[Equations]:
        """Those of all points that act in this inner step."""
        bodies, rules, inverse, free = self.bodies, self.rules, self._inverse(state), self._free(state)
        gravity = torch.from_numpy(rules.gravity)
        found = []
        for pair, contacts in points.items():
            a, b = pair
            friction = bodies.friction[a] * bodies.friction[b] if rules.friction else NOTHING
            bounce = bodies.restitution[a] * bodies.restitution[b] if rules.restitution else NOTHING
            margin = rules.margin * int(bodies.radius[[a, b]].isfinite().sum())
            middle = _middle_of_face(contacts)

            def met(first: Tensor, second: Tensor, a: int = a, b: int = b) -> tuple[Tensor, Tensor]:
                """Where both feel the impulse, from either centre of mass: half way between the ends of a contact."""
                one, other = pose.rotate(state.orientation[a], first), pose.rotate(state.orientation[b], second)
                apart = state.position[a] + one - state.position[b] - other
                return one - 0.5 * apart, other + 0.5 * apart

            def relative(linear: Tensor, angular: Tensor, arms: Any, a: int = a, b: int = b) -> Tensor:
                one = linear[a] + torch.linalg.cross(angular[a], arms[0])
                return one - linear[b] - torch.linalg.cross(angular[b], arms[1])

            def row(arms: Any, axis: Tensor, wanted: Tensor, impulse: Tensor, a: int = a, b: int = b) -> Row:
                arm, other = torch.linalg.cross(arms[0], axis), torch.linalg.cross(axis, arms[1])
                spin, counter = inverse[a] @ arm, inverse[b] @ other
                mass = 1.0 / (bodies.inverse_mass[a] + bodies.inverse_mass[b] + arm @ spin + other @ counter)
                return Row((a, b), axis, arm, other, spin, counter, mass, wanted, impulse)

            for number, point in enumerate(contacts):
                n, gap, arms = point.normal, point.gap - margin, met(point.first, point.second)
                now = relative(state.velocity, state.angular_velocity, arms)
                then = now + relative(free[:, :3], free[:, 3:], arms)
                approach, before = now @ n, then @ n
                if gap > solving.TOUCH and (-approach > rules.slow or gap + before * rules.inner > 0.0):
                    continue
                target = -approach * bounce if -approach > rules.slow else NOTHING
                deep = push = rest = NOTHING
                if gap > solving.TOUCH:
                    target = rest = -gap / rules.inner
                elif gap <= -rules.split:
                    deep = -gap * rules.erp / rules.inner
                elif gap < -rules.slop:
                    push = (-gap - rules.slop) * rules.erp / rules.inner
                    target = torch.maximum(push, torch.minimum(target + push, -approach) if rules.adds else target)
                normal, tangents = row(arms, n, target - before, point.push), []
                if float(friction) > 0.0:
                    if middle is not None:
                        # A face presses all over, and resists being turned less than its corners would.
                        spread, centre = solving.SPREAD, met(*middle)
                        arms = [(1.0 - spread) * c + spread * arm for c, arm in zip(centre, arms, strict=True)]
                        then = relative(state.velocity + free[:, :3], state.angular_velocity + free[:, 3:], arms)
                    one = _along_slip(n, then - (then @ n) * n, gravity)
                    for axis in (one, torch.linalg.cross(n, one)):
                        most = friction * point.push
                        start = torch.clamp(point.drag @ axis, -most, most)
                        tangents.append(row(arms, axis, -(then @ axis), start))
                found.append(Equations(pair, number, normal, tangents, friction, deep, rest - before, before, push))
        return found

    # The impulses

    def impulses(self, contacts: list[Equations]) -> tuple[Tensor, Tensor]:
        """What contacts do, island by island.

        Returns:
            [N, 6] what contact adds to the velocities, and what only moves (of penetrations that are deep).
        """
        change, shift = ([torch.zeros(6).double() for _ in range(len(self.bodies))] for _ in range(2))
        for island in self._islands(contacts):
            self._solve(island, change, shift)
        return torch.stack(change), torch.stack(shift)

    def _islands(self, contacts: list[Equations]) -> list[list[Equations]]:
        """Contacts of bodies that move, joined by contacts, belong together."""
        island = list(range(len(self.bodies)))

        def root(b: int) -> int:
            return b if island[b] == b else root(island[b])

        for contact in contacts:
            a, b = contact.pair
            if self.bodies.moves[a] and self.bodies.moves[b]:
                island[max(root(a), root(b))] = min(root(a), root(b))
        numbers = dict.fromkeys(root(contact.pair[0]) for contact in contacts)
        return [[contact for contact in contacts if root(contact.pair[0]) == number] for number in numbers]

    def _solve(self, island: list[Equations], change: list[Tensor], shift: list[Tensor]) -> None:
        """One island, with less of what rebounds and pushes where it would gain energy from nothing."""
        for row in (row for contact in island for row in contact.rows):
            self._apply(change, row, row.impulse)
        self._part(island, shift)
        self._balance(island, change)
        for share in (0.5, 0.0):
            lively = any(contact.normal.wanted > contact.calm for contact in island)
            if not lively or not self._gains(island, change):
                return
            for contact in island:
                for body in contact.pair:
                    change[body] = torch.zeros(6).double()
                for row in contact.rows:
                    row.impulse = NOTHING
                contact.normal.wanted = contact.calm + share * (contact.normal.wanted - contact.calm)
                if contact.push > 0.0:
                    contact.deep = (1.0 - share) * contact.push
            self._part(island, shift)
            self._balance(island, change)

    def _gains(self, island: list[Equations], change: list[Tensor]) -> bool:
        """Whether contacts have given an island more energy than they may: impulses times mean velocities, added up."""
        work = spare = 0.0
        lift = 2.0 * float(torch.from_numpy(self.rules.gravity).norm()) * solving.LIFT * self.rules.slop
        for contact in island:
            most = solving.SPARE * contact.push**2 + solving.ROUNDING * contact.before**2 + lift
            spare += 0.5 * float(contact.normal.mass * most)
            work += float(contact.normal.impulse * (contact.before + 0.5 * contact.normal.speed(change)))
            work += sum(float(t.impulse * (0.5 * t.speed(change) - t.wanted)) for t in contact.tangents)
        return work > spare

    def _part(self, island: list[Equations], shift: list[Tensor]) -> None:
        """Part what is deep in each other, by velocities that move bodies once and are forgotten."""
        for _ in range(self.rules.rounds):
            worst = 0.0
            for contact in (contact for contact in island if contact.deep > 0.0):
                row = contact.normal
                total = (contact.pushed + (contact.deep - row.speed(shift)) * row.mass).clamp_min(0.0)
                self._apply(shift, row, total - contact.pushed)
                worst = max(worst, abs(float((total - contact.pushed) / row.mass)))
                contact.pushed = total
            if worst <= self.rules.exact:
                break

    def _balance(self, island: list[Equations], change: list[Tensor]) -> None:
        """All normals, then all friction, again and again, until no impulse changes a velocity by more than `exact`."""
        for _ in range(self.rules.rounds):
            worst = max(self._relax(change, contact.normal, None) for contact in island)
            for contact in island:
                for row in contact.tangents:
                    worst = max(worst, self._relax(change, row, contact.grip * contact.normal.impulse))
            if worst <= self.rules.exact:
                break

    def _relax(self, change: list[Tensor], row: Row, most: Tensor | None) -> float:
        """Bring one row to its wanted velocity: by pushing only, or by up to `most` either way."""
        total = row.impulse + (row.wanted - row.speed(change)) * row.mass
        total = total.clamp_min(0.0) if most is None else torch.minimum(torch.maximum(total, -most), most)
        step, row.impulse = total - row.impulse, total
        self._apply(change, row, step)
        return abs(float(step / row.mass))

    def _apply(self, velocities: list[Tensor], row: Row, impulse: Tensor) -> None:
        a, b = row.pair
        light = self.bodies.inverse_mass
        velocities[a] = velocities[a] + impulse * torch.cat([light[a] * row.axis, row.spin])
        velocities[b] = velocities[b] + impulse * torch.cat([-light[b] * row.axis, row.counter])

    # Motion

    def advance(self, state: State, change: Tensor, shift: Tensor) -> State:
        """Move all bodies by one inner step: positions with the new velocities."""
        span, moves, rotation = self.rules.inner, self.bodies.moves[:, None], self.rules.rotation
        added = self._pulled(state) + change
        velocity = state.velocity + added[:, :3]
        angular = torch.where(moves, (state.angular_velocity + added[:, 3:]) * rotation, state.angular_velocity)
        orientation, tops = state.orientation, moves[:, 0] & rotation & ~self.isotropic
        further = shift[:, 3:] * rotation + torch.where(tops[:, None], 0.0, angular)
        for b in tops.nonzero():  # each by as many stages as it takes
            turned = torque_free(orientation[b], angular[b], self.bodies.inertia[b], span)
            orientation, angular = orientation.index_copy(0, b, turned[0]), angular.index_copy(0, b, turned[1])
        return replace(
            state,
            position=state.position + span * (velocity + shift[:, :3]),
            orientation=pose.normalise(pose.multiply(pose.from_rotvec(further * span), orientation)),
            velocity=velocity,
            angular_velocity=angular,
        )


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


def _remembered(points: Points, contacts: list[Equations]) -> Points:
    """The contacts with the impulses that were found, none where a point did not act."""
    after = {pair: [replace(p, push=NOTHING, drag=NOWHERE) for p in some] for pair, some in points.items()}
    for contact in contacts:
        drag = sum((t.impulse * t.axis for t in contact.tangents), NOWHERE)
        some = after[contact.pair]
        some[contact.number] = replace(some[contact.number], push=contact.normal.impulse, drag=drag)
    return after


class Distance(torch.autograd.Function):
    """Distances [P] of shape s at places [P, 3], and unit normals [P, 3]: the compiled ones, with differences as their
    derivatives."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, shapes: kinds.Shapes, s: int) -> tuple[Tensor, Tensor]:
        ctx.given = p.detach(), shapes, s
        found = kinds.distances(shapes.table, shapes.brick, shapes.sample, s, p.detach().numpy())
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])

    @staticmethod
    def backward(ctx: Any, of_distance: Tensor, of_normal: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        p, shapes, s = ctx.given
        slopes = []
        for way in NEARBY * torch.eye(3).double():
            (ahead, forth), (behind, back) = (Distance.apply(q, shapes, s) for q in (p + way, p - way))  # type: ignore
            slopes.append(((ahead - behind) * of_distance + ((forth - back) * of_normal).sum(-1)) / (2.0 * NEARBY))
        return torch.stack(slopes, -1), None, None
