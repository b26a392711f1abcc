"""Where surfaces of two bodies are near each other: SDF-Sim's edges, and pairs of nodes and of faces for the baselines.

Surfaces are near if d - (closing speed) dt <= reach. With a fixed threshold a fast body could bounce inside one step
without ever having an edge. SDF-Sim evaluates the distances of other bodies at its nodes (`find_contacts`). For the
baselines, boxes around bodies and then around their nodes or faces are compared, then true distances. An infinite plane
has one node and one face, which lie wherever they are closest to the other part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from sdfsim.learned import pose
from sdfsim.learned.surfaces import expanded, node_owner
from sdfsim.learned.tensors import BodyTensors, StateTensors, state_arrays
from sdfsim.physics.solver.prepare import Compiled, nodes_near

PIERCING = 1e-9  # relative: smaller areas and denominators count as zero


@dataclass(frozen=True)
class Contacts:
    """E contact edges, each from a surface node to the closest point on another body; model units, world frame."""

    owner: Tensor  # [E] int64, the body whose node it is
    node: Tensor  # [E] int64, index into `Bodies.node`
    body: Tensor  # [E] int64, the body that it is near
    seen: Tensor  # [E, 3] float64, the node relative to the centre of mass of `body`
    distance: Tensor  # [E] float64, signed distance of the node from `body`
    normal: Tensor  # [E, 3] float64, unit outward normal of `body` at the closest point

    def __len__(self) -> int:
        return len(self.owner)

    def renumbered(self, body: Tensor, node: Tensor) -> Contacts:
        """The same among other bodies: `body` [N] and `node` [M] give their new numbers."""
        return replace(self, owner=body[self.owner], body=body[self.body], node=node[self.node])


def no_contacts(device: torch.device) -> Contacts:
    nobody = torch.zeros(0, dtype=torch.int64, device=device)
    nothing = torch.zeros(0, 3, dtype=torch.float64, device=device)
    return Contacts(nobody, nobody, nobody, nothing, nothing[:, 0], nothing)


def find_contacts(
    bodies: BodyTensors, state: StateTensors, gravity: np.ndarray, reach: float, dt: float, scene: Compiled | None
) -> Contacts:
    """All contact edges of a state within `reach` (the contact radius D) under gravity [3], found with the compiled
    `scene`; all in model units."""
    assert scene is not None
    found = nodes_near(scene, state_arrays(state), gravity, reach, dt)
    index, value = (torch.from_numpy(array).to(bodies.device) for array in found)
    owner, node, body = index.unbind(1)
    return Contacts(owner, node, body, seen=value[:, 4:], distance=value[:, 0], normal=value[:, 1:4])


def where(state: StateTensors, bodies: BodyTensors, contacts: Contacts | Pairs) -> Tensor:
    """[E, 3] positions of the nodes of contact edges in a state, world."""
    turned = pose.rotate(state.orientation[contacts.owner], bodies.node[contacts.node])
    return state.position[contacts.owner] + turned


@dataclass(frozen=True)
class Pairs:
    """E pairs of nodes (C = 1) or faces (C = 3) of two bodies, each pair once; model units, world frame."""

    # owner, body: [E] int64, the bodies of the first and of the second part; a plane is always second
    owner: Tensor
    body: Tensor
    # first, second: [E, C] int64, indices into `Bodies.node`; corners of faces by distance to the closest point
    first: Tensor
    second: Tensor
    distance: Tensor  # [E] float64; negative only behind a plane
    way: Tensor  # [E, 3] float64, from the closest point of the first to that of the second
    # from_first, from_second: [E, C, 3] float64, corners from their own closest point (0 for a plane)
    from_first: Tensor
    from_second: Tensor
    # normal_first, normal_second: [E, 3] float64, unit normals of the faces; 0 for nodes
    normal_first: Tensor
    normal_second: Tensor

    def __len__(self) -> int:
        return len(self.owner)

    @property
    def node(self) -> Tensor:
        """[E] int64, the node of the first body that represents the pair in recordings."""
        return self.first[:, 0]

    def renumbered(self, body: Tensor, node: Tensor) -> Pairs:
        """The same among other bodies: `body` [N] and `node` [M] give their new numbers."""
        ends = {"owner": body[self.owner], "body": body[self.body]}
        return replace(self, **ends, first=node[self.first], second=node[self.second])


def no_pairs(device: torch.device, corners: int) -> Pairs:
    """No pairs, of nodes (one corner) or of faces (three)."""
    nobody = torch.zeros(0, dtype=torch.int64, device=device)
    parts, way = nobody.reshape(0, 1).expand(-1, corners), torch.zeros(0, 3, dtype=torch.float64, device=device)
    arms = torch.zeros(0, corners, 3, dtype=torch.float64, device=device)
    return Pairs(nobody, nobody, parts, parts, way[:, 0], way, arms, arms, way, way)


def near_pairs(
    bodies: BodyTensors, state: StateTensors, gravity: np.ndarray, reach: float, dt: float,
    scene: Compiled | None = None, *, faces: bool,
) -> Pairs:  # fmt: skip
    """All pairs of nodes, or of `faces`, of different bodies within `reach` (model length) during a step, in the sense
    of `find_contacts`."""
    part = bodies.face if faces else torch.arange(len(bodies.node), device=bodies.device)[:, None]
    owner = node_owner(bodies)
    fall = torch.from_numpy(gravity * dt).to(bodies.device)
    velocity = state.velocity + fall * bodies.moves[:, None]
    arm = pose.rotate(state.orientation[owner], bodies.node)
    # Only differences of positions matter; relative to the mean they keep their precision far from the origin.
    place = (state.position - state.position[bodies.moves].mean(0))[owner] + arm if bodies.moves.any() else arm
    speed = velocity[owner] + torch.linalg.cross(state.angular_velocity[owner], arm)
    first, second = _near(bodies, part, owner, place, speed.norm(dim=-1) * dt + 0.5 * reach)
    a, b = part[first], part[second]
    endless = ~bodies.size[owner[b[:, 0]]].isfinite()
    one, other = place[a], place[b]
    mean, turn = place[b[:, 0]], state.orientation[owner[b[:, 0]]]
    up = pose.rotate(turn, torch.tensor([0.0, 0.0, 1.0], dtype=place.dtype, device=place.device).expand_as(mean))
    on_first, on_second = one[:, 0], other[:, 0]
    normal_first, normal_second = torch.zeros_like(up), torch.where(endless[:, None], up, 0.0)
    if part.shape[1] == 3:
        flat = ~endless
        normal_first, normal_second[flat] = _normals(one), _normals(other[flat])
        on_first, on_second = on_first.clone(), on_second.clone()
        on_first[flat], on_second[flat] = closest_points(one[flat], other[flat])
        height = ((one - mean[:, None]) * up[:, None]).sum(-1)
        lowest = one.gather(1, height.argmin(1)[:, None, None].expand(-1, 1, 3))[:, 0]
        on_first = torch.where(endless[:, None], lowest, on_first)
    below = ((on_first - mean) * up).sum(-1)
    on_second = torch.where(endless[:, None], on_first - below[:, None] * up, on_second)
    way = on_second - on_first
    distance = torch.where(endless, below, way.norm(dim=-1))
    # Where surfaces cross, distance and direction are 0: these pairs are near at any speed.
    along = torch.where(endless[:, None], -up, way / distance.abs().clamp_min(1e-12)[:, None])
    approach = _speed_at(bodies, state, velocity, owner[a[:, 0]], on_first - _centre(place, arm, a))
    approach = approach - _speed_at(bodies, state, velocity, owner[b[:, 0]], on_second - _centre(place, arm, b))
    near = distance - (approach * along).sum(-1).clamp_min(0.0) * dt <= reach
    a, from_first = _by_distance(a[near], (one - on_first[:, None])[near])
    b, from_second = _by_distance(b[near], torch.where(endless[:, None, None], 0.0, other - on_second[:, None])[near])
    values = (distance, way, normal_first, normal_second)
    distance, way, normal_first, normal_second = (value[near] for value in values)
    return Pairs(
        owner[a[:, 0]], owner[b[:, 0]], a, b, distance, way, from_first, from_second, normal_first, normal_second
    )


node_pairs = partial(near_pairs, faces=False)
face_pairs = partial(near_pairs, faces=True)


def _centre(place: Tensor, arm: Tensor, part: Tensor) -> Tensor:
    """[E, 3] centres of mass of the bodies of `part` [E, C]."""
    return place[part[:, 0]] - arm[part[:, 0]]


def _speed_at(bodies: BodyTensors, state: StateTensors, velocity: Tensor, body: Tensor, arm: Tensor) -> Tensor:
    """[E, 3] velocity of bodies [E] at `arm` [E, 3]; a plane moves as a whole."""
    turning = torch.linalg.cross(state.angular_velocity[body], arm)
    return velocity[body] + torch.where(bodies.size[body].isfinite()[:, None], turning, 0.0)


def _by_distance(part: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Corners [E, C] and their offsets [E, C, 3], the nearest first: their order in the mesh has no meaning."""
    order = offset.square().sum(-1).argsort(dim=1, stable=True)
    return part.gather(1, order), offset.gather(1, order[..., None].expand_as(offset))


def _normals(triangle: Tensor) -> Tensor:
    """[E, 3] unit normals of triangles [E, 3, 3]; 0 for those without an area."""
    normal = torch.linalg.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    return normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def _near(bodies: BodyTensors, part: Tensor, owner: Tensor, place: Tensor, margin: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (first, second) of parts [K, C] of bodies that may touch whose boxes, wider by `margin` [M], overlap."""
    of_part = owner[part[:, 0]]
    wide = margin[part].amax(1)[:, None]
    low, high = place[part].amin(1) - wide, place[part].amax(1) + wide
    start = torch.searchsorted(of_part, torch.arange(len(bodies) + 1, device=of_part.device))
    endless = ~bodies.size.isfinite()
    low[endless[of_part]], high[endless[of_part]] = -torch.inf, torch.inf  # planes are compared by height only
    index = of_part[:, None].expand_as(low)
    empty = torch.full((len(bodies), 3), torch.inf, dtype=low.dtype, device=low.device)
    lowest, highest = empty.scatter_reduce(0, index, low, "amin"), (-empty).scatter_reduce(0, index, high, "amax")
    one, other = torch.triu_indices(len(bodies), len(bodies), 1, device=low.device)
    one, other = torch.where(endless[one], other, one), torch.where(endless[one], one, other)
    meet = ((lowest[one] <= highest[other]) & (highest[one] >= lowest[other])).all(-1) & bodies.may_meet(one, other)
    one, other = one[meet], other[meet]
    # The parts of each body in the box of the other; then all pairs of these.
    pair, first = _inside(start, one, low, high, lowest[other], highest[other])
    number, second = _inside(start, other, low, high, lowest[one], highest[one])
    begins = torch.searchsorted(number, torch.arange(len(one) + 1, device=number.device))
    row, column = expanded(begins[pair], begins[pair + 1])
    first, second = first[row], second[column]
    near = ((low[first] <= high[second]) & (high[first] >= low[second])).all(-1)
    return first[near], second[near]


def _inside(
    start: Tensor, body: Tensor, low: Tensor, high: Tensor, lowest: Tensor, highest: Tensor
) -> tuple[Tensor, Tensor]:
    """For bodies [P] and boxes [P, 3] each, the parts that overlap the box: the number of the pair, and the part."""
    pair, part = expanded(start[body], start[body + 1])
    inside = ((low[part] <= highest[pair]) & (high[part] >= lowest[pair])).all(-1)
    return pair[inside], part[inside]


def closest_points(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Closest points [E, 3] on both triangles of pairs, [E, 3, 3] float64 with corners in rows.

    They are a corner and a point inside the other triangle, or points on two sides; if the triangles cross, a point
    where a side of one meets the other.
    """
    side_one, side_other = one.roll(-1, 1) - one, other.roll(-1, 1) - other
    firsts, seconds, distances = [], [], []

    def add(first: Tensor, second: Tensor, known: Tensor | None = None) -> None:
        """Add candidates [E, K, 3]; those that are not `known` [E, K] do not count."""
        far = (first - second).norm(dim=-1)
        firsts.append(first)
        seconds.append(second)
        distances.append(far if known is None else torch.where(known, far, torch.inf))

    add(*_on_sides(one, side_one, other, side_other))
    above, foot, inside = _feet(one, other)
    add(one, foot, inside)
    crossing, known = _crossing(one, side_one, above, other)
    add(crossing, crossing, known)
    above, foot, inside = _feet(other, one)
    add(foot, other, inside)
    crossing, known = _crossing(other, side_other, above, one)
    add(crossing, crossing, known)
    best = torch.cat(distances, 1).argmin(1)[:, None, None].expand(-1, 1, 3)
    return torch.cat(firsts, 1).gather(1, best)[:, 0], torch.cat(seconds, 1).gather(1, best)[:, 0]


def _feet(corner: Tensor, triangle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Heights [E, 3] of corners above a triangle's plane, their feet there [E, 3, 3], whether these are inside it."""
    normal = _normals(triangle)[:, None]
    above = ((corner - triangle[:, :1]) * normal).sum(-1)
    foot = corner - above[..., None] * normal
    return above, foot, _within(foot, triangle)


def _within(point: Tensor, triangle: Tensor) -> Tensor:
    """[E, K] whether points [E, K, 3] of a triangle's plane are inside it; none if it has no area."""
    u, v = (triangle[:, k] - triangle[:, 0] for k in (1, 2))
    w = point - triangle[:, :1]
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    wu, wv = (w * u[:, None]).sum(-1), (w * v[:, None]).sum(-1)
    area = (uu * vv - uv * uv)[:, None]
    s, t = vv[:, None] * wu - uv[:, None] * wv, uu[:, None] * wv - uv[:, None] * wu
    return (area > PIERCING * (uu * vv)[:, None]) & (s >= 0) & (t >= 0) & (s + t <= area)


def _crossing(corner: Tensor, side: Tensor, above: Tensor, triangle: Tensor) -> tuple[Tensor, Tensor]:
    """Where sides [E, 3, 3] from corners, at heights `above` [E, 3], meet a triangle's plane, and whether inside it."""
    end = above.roll(-1, 1)
    met = corner + (above / torch.where(above == end, 1.0, above - end))[..., None] * side
    return met, (above * end < 0) & _within(met, triangle)


def _on_sides(one: Tensor, u: Tensor, other: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Closest points [E, 9, 3] of every side of one triangle and every side of the other."""
    p, u = (x[:, :, None].expand(-1, 3, 3, 3).flatten(1, 2) for x in (one, u))
    q, v = (x[:, None].expand(-1, 3, 3, 3).flatten(1, 2) for x in (other, v))
    w = p - q
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    square = uu * vv - uv * uv
    s = torch.where(square > PIERCING * uu * vv, (uv * vw - vv * uw) / square.clamp_min(1e-30), 0.0).clamp(0.0, 1.0)
    t = ((uv * s + vw) / vv.clamp_min(1e-30)).clamp(0.0, 1.0)
    s = ((uv * t - uw) / uu.clamp_min(1e-30)).clamp(0.0, 1.0)
    return p + s[..., None] * u, q + t[..., None] * v
