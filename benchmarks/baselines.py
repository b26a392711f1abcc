"""The networks in the comparison of SDF-Sim's paper: FIGNet, FIGNet*, MeshGraphNets and DPI.

**FIGNet** (Allen et al., 2023, arXiv 2212.03574) and **FIGNet*** (Lopez-Guevara et al., 2024, arXiv 2401.11985): nodes
are the vertices of meshes and one node a body. Edges join neighbours on a mesh, vertices and their body's node, and the
faces of two bodies that are near each other. The features of a face edge include the closest points of the two faces;
its message has a part for each of the receiving face's three vertices, in the order of their distance to its closest
point. FIGNet* is FIGNet without mesh edges.

**MeshGraphNets** (Pfaff et al., 2021, arXiv 2010.03409) for rigid bodies, as SDF-Sim's paper compares it: mesh edges
join neighbours, world edges join vertices of different bodies within a radius, a small one in *mgn*, a large one in
*mgn-large*. There are no body nodes; shape matching makes motions rigid.

**DPI** (Li et al., 2019, arXiv 1810.01566) for rigid bodies: particles are joined to their body's root both ways, and
to particles of different bodies within a radius. Here they lie on the surface (in the paper they fill the body), and in
every step all kinds of edges pass messages at once, with weights of that step (in the paper one after the other, with
the same weights in every round).

All graphs are made from a state with its two earlier poses. In all of them vertices, particles and body nodes have the
features of SDF-Sim's nodes, contact edges reach farther by the distance that their ends close in a step, and an
infinite floor is one node below whatever is near it. The papers of the baselines differ in this, or do not say. Boxes
around bodies and then around their nodes or faces are compared, then true distances.

Importing this module adds the networks and their presets to those of sdfsim.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.learned import pose
from sdfsim.learned.families import FAMILIES, Family, points
from sdfsim.learned.message_passing import EdgeKind, EdgeSet, Features, Layout, MultiGraph, both_ways
from sdfsim.learned.surfaces import MESH, NODE, NODES, STAR, expanded, mesh_edges, motion_features, node_owner, star
from sdfsim.learned.tensors import BodyTensors, StateTensors
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.sdf.closed_forms import PlaneSdf
from sdfsim.shape.shape import Shape
from sdfsim.training.presets import PRESETS

PIERCING = 1e-9  # relative: smaller areas and denominators count as zero
FACE = Features(34, (0, 4, 7, 10, 16, 19, 22, 28, 31))
FIGNET_STAR = Layout(NODES, STAR | {"face": EdgeKind("node", "node", FACE, corners=3)})
FIGNET = Layout(NODES, FIGNET_STAR.edges | {"mesh": MESH})
WORLD = Features(4, (0,))
MGN = Layout({"node": NODE}, {"mesh": MESH, "world": EdgeKind("node", "node", WORLD)})
DPI = Layout(NODES, STAR | {"contact": EdgeKind("node", "node", WORLD)})
# The papers do not give the radii of MeshGraphNets and DPI. With these, graphs of MOVi-B have about as many edges
# between bodies as SDF-Sim's paper counts (docs/paper.md).
RADII = {"fignet": 0.1, "fignet-star": 0.1, "mgn": 0.02, "mgn-large": 0.38, "dpi": 0.3}


def particles(shape: Shape, count: int | None) -> Shape:
    """As `points`; an infinite plane gets one node, so that edges have an end there."""
    return replace(points(shape, count), nodes=np.zeros((1, 3))) if _endless(shape) else points(shape, count)


def vertices(shape: Shape, count: int | None) -> Shape:
    """The shape with the vertices of a mesh as nodes, at most about `count`; an infinite plane gets one node and one
    face.

    If the shape is made of convex pieces with at most `count` vertices, the mesh is that of their hulls: this is what
    PyBullet collides, and has as many vertices as the published graphs (their sizes fit 440 per body). Otherwise it is
    the shown mesh, reduced by quadric error to 2 `count` - 4 faces, as for example 76 hulls cannot have a mesh of 64
    vertices. The reduced mesh lacks what the reduction cuts off (up to 5 cm of the shapes of MOVi-B at 64).
    """
    if _endless(shape):
        return replace(shape, nodes=np.zeros((1, 3)), faces=np.zeros((1, 3), dtype=np.int64))
    hulls = [convex_hull(piece) for piece in shape.pieces]
    if hulls and (count is None or sum(len(hull.vertices) for hull in hulls) <= count):
        mesh = joined(hulls)
    else:
        mesh = _reduced(shape.mesh, count)
    return replace(shape, nodes=mesh.vertices, faces=mesh.faces)


def _reduced(mesh: Mesh, count: int | None) -> Mesh:
    """The mesh with doubled vertices merged, and at most about `count` vertices."""
    import open3d as o3d

    given = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    ).remove_duplicated_vertices()
    if count is not None and len(given.vertices) > count:
        given = given.simplify_quadric_decimation(2 * count - 4)
    given = given.remove_degenerate_triangles().remove_unreferenced_vertices()
    return Mesh(np.asarray(given.vertices), np.asarray(given.triangles).astype(np.int64))


def _endless(shape: Shape) -> bool:
    return isinstance(shape.sdf, PlaneSdf)


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


def fignet_star_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    p = pairs
    forth = _face_features(p.way, p.from_first, p.from_second, p.normal_first, p.normal_second)
    back = _face_features(-p.way, p.from_second, p.from_first, p.normal_second, p.normal_first)
    face = {"face": both_ways(forth, back, p.first, p.second)}
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | face)


def fignet_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    made = fignet_star_graph(bodies, state, pairs)
    return MultiGraph(made.nodes, made.edges | {"mesh": mesh_edges(bodies, state)})


def _face_features(way: Tensor, sending: Tensor, receiving: Tensor, normal: Tensor, other: Tensor) -> Tensor:
    """[E, 34]: vectors between the closest points and from these to the corners of both faces, with lengths; both
    normals."""
    corners = [part for face in (sending, receiving) for part in (face.flatten(1), face.norm(dim=-1))]
    return torch.cat([way, way.norm(dim=-1, keepdim=True), *corners, normal, other], -1)


def mgn_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    nodes = {"node": motion_features(bodies, state)["node"]}
    return MultiGraph(nodes, {"mesh": mesh_edges(bodies, state), "world": world_edges(pairs)})


def world_edges(pairs: Pairs) -> EdgeSet:
    """Edges both ways between nodes of different bodies: vector from sender to receiver, and its length."""
    length = pairs.way.norm(dim=-1, keepdim=True)
    forth, back = torch.cat([pairs.way, length], -1), torch.cat([-pairs.way, length], -1)
    return both_ways(forth, back, pairs.first, pairs.second)


def dpi_graph(bodies: BodyTensors, state: StateTensors, pairs: Pairs) -> MultiGraph:
    return MultiGraph(motion_features(bodies, state), star(bodies, state) | {"contact": world_edges(pairs)})


_no_faces, _no_nodes = partial(no_pairs, corners=3), partial(no_pairs, corners=1)
FAMILIES |= {
    "fignet": Family(FIGNET, vertices, face_pairs, _no_faces, fignet_graph),
    "fignet-star": Family(FIGNET_STAR, vertices, face_pairs, _no_faces, fignet_star_graph),
    "mgn": Family(MGN, vertices, node_pairs, _no_nodes, mgn_graph),
    "dpi": Family(DPI, particles, node_pairs, _no_nodes, dpi_graph),
}
PRESETS |= {
    name: replace(PRESETS["sdf-sim"], kind=name.removesuffix("-large"), reach=reach) for name, reach in RADII.items()
}
