"""Contact points of round surfaces: where the surfaces are nearest, not where the nearest node happens to be.

Nodes sample a surface. Of a sphere on the ground none is at its lowest point, and a push that acts a few degrees aside
of it sets the sphere rolling. Where the surface around a node is smooth, its normal and curvature tell how it goes on:
the point whose normal is opposite to the other body's is found by secants, each asked of both SDFs. Corners and edges
need none of this: they are nodes, and nearest where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State
from sdfsim.dynamics.contacts import Contacts, distances, unit
from sdfsim.dynamics.memory import Memory

NEAR = 0.4  # of the contact radius: of a pair no point of which comes nearer in this step nothing needs to be known
FLAT = 0.05  # rad by which a node's piece of surface turns; below it there is nothing to find beyond the node
SHARP = 0.7  # rad; above it is an edge or a corner
UNEVEN = 0.25  # of a curvature: how much it may differ from side to side, and over twice the way
STEP = 0.25  # of a node's piece, over which its curvature is measured
WAY = 2.0  # pieces to go at most, as if the other surface were flat: between two alike it is half of that
SECANTS = 2  # after the first guess
ALIGNED = 1e-4  # rad; normals that are nearer to opposite are so but for rounding
OFF = 0.02  # of a piece, by which a point found may be farther from the other surface than the node was
SAME = 0.02  # of a body's radius: places nearer to one another than about this are one contact


@dataclass(frozen=True)
class Curvature:
    """The surface around the nodes of every shape that may be touched, at scale 1 in shape axes.

    Attributes:
        start: [S + 1] int64, the nodes of shape s are start[s] : start[s + 1], as many as its bodies have.
        normal: [K, 3] float64, unit, outward.
        bend: [K, 3, 3] float64 1/m, symmetric: how the normal changes along the surface.
        piece: [K] float64 m, how far the part of the surface reaches for which a node stands.
        smooth: [K] bool, whether all this says where the surface goes.
    """

    start: Tensor
    normal: Tensor
    bend: Tensor
    piece: Tensor
    smooth: Tensor


def curvature(bodies: Bodies) -> Curvature:
    """Measured on the SDFs, once for each shape."""
    count = bodies.node_start[1:] - bodies.node_start[:-1]
    parts, starts = [], [0]
    for shape in range(int(bodies.shape.max()) + 1):
        body = int((bodies.shape == shape).nonzero()[0, 0])
        begin = int(bodies.node_start[body])
        nodes = bodies.node[begin : begin + int(count[body])] + bodies.com[body]
        parts.append(_measured(bodies, shape, nodes / bodies.scale[body]))
        starts.append(starts[-1] + len(nodes))
    normal, bend, piece, smooth = (torch.cat(values) for values in zip(*parts, strict=True))
    return Curvature(torch.tensor(starts, device=bodies.device), normal, bend, piece, smooth)


def _measured(bodies: Bodies, shape: int, nodes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`Curvature` of nodes [K, 3] m of one shape, by the normals a little to either side of them."""
    from scipy.spatial import KDTree

    if len(nodes) < 5:  # too few to know for how much of the surface each of them stands
        nothing = nodes.new_zeros(len(nodes))
        return nodes, nodes[:, :, None] * nodes[:, None], nothing, nothing > 0
    place = nodes.cpu().numpy()
    piece = torch.as_tensor(KDTree(place).query(place, 5)[0][:, 4], device=nodes.device)
    index = torch.full((len(nodes),), shape, device=nodes.device)

    def normals(points: Tensor) -> Tensor:
        return unit(bodies.bank(index, points)[1], points)

    normal = normals(nodes)
    across = torch.linalg.cross(normal, torch.eye(3, dtype=nodes.dtype, device=nodes.device)[normal.abs().argmin(-1)])
    across = across / across.norm(dim=-1, keepdim=True)
    ways = (across, torch.linalg.cross(normal, across))
    along = torch.eye(3, dtype=nodes.dtype, device=nodes.device) - normal[:, :, None] * normal[:, None]

    def bent(step: Tensor) -> tuple[Tensor, Tensor]:
        """Change of the normal [K, 3, 3] over `step` [K, 1], and how much it differs [K] between the two sides."""
        bend, askew = torch.zeros_like(along), torch.zeros_like(piece)
        for way in ways:
            there, back = normals(nodes + step * way) - normal, normal - normals(nodes - step * way)
            bend = bend + (0.5 * (there + back) / step)[:, :, None] * way[:, None]
            askew = torch.maximum(askew, 0.5 * (there - back).norm(dim=-1) / step[:, 0])
        return (along @ (0.5 * (bend + bend.mT)) @ along).nan_to_num(), askew

    (bend, askew), (wider, _) = bent(STEP * piece[:, None]), bent(2 * STEP * piece[:, None])
    most = torch.linalg.eigvalsh(bend).abs().amax(-1)
    # Across an edge, however it is rounded, the normal turns no more over twice the way.
    same = torch.linalg.eigvalsh(bend - wider).abs().amax(-1) < UNEVEN * most
    turn = most * piece
    return normal, bend, piece, same & (askew < UNEVEN * most) & (turn > FLAT) & (turn < SHARP)


def round_off(bodies: Bodies, state: State, contacts: Contacts, reach: float, memory: Memory) -> Contacts:
    """The edges, with those from smooth surface where it is nearest to the other body, one for each such place.

    Args:
        bodies: N bodies.
        state: theirs.
        contacts: E edges.
        reach: contact radius D, model length.
        memory: of the run.
    """
    if not len(contacts):
        return contacts
    known = memory.curvature(bodies)
    place = known.start[bodies.shape[contacts.owner]] + contacts.node - bodies.node_start[contacts.owner]
    smooth = known.smooth[place]
    if not bool(smooth.any()):
        return contacts
    pair = torch.unique(contacts.owner * len(bodies) + contacts.body, return_inverse=True)[1]
    first = torch.full((int(pair.max()) + 1,), torch.inf, dtype=torch.float64, device=bodies.device)
    smooth = smooth & (first.scatter_reduce(0, pair, contacts.ahead, "amin")[pair] < NEAR * reach)
    rows = smooth.nonzero()[:, 0]
    if not len(rows):
        return contacts
    arc = _arcs(bodies, state, contacts.only(rows), known, place[rows])
    near = (arc.length < WAY * arc.piece).nonzero()[:, 0]
    rows, arc = rows[near], arc.only(near)
    some = contacts.only(rows)
    found, way = _search(bodies, state, some, arc)
    within, nearer = way.abs() < arc.piece, found.distance <= some.distance + OFF * arc.piece
    smooth = smooth.index_fill(0, rows[within & ~nearer], False)  # these did not go as foreseen: they stay as they are
    queries, good = contacts.queries + 2 * (SECANTS + 1) * len(rows), (within & nearer).nonzero()[:, 0]
    rows, found = rows[good], found.only(good)
    names = ("point", "arm", "foot", "normal", "distance", "ahead")
    moved = {name: getattr(contacts, name).index_copy(0, rows, getattr(found, name)) for name in names}
    contacts = replace(contacts, **moved, queries=queries)
    return contacts.only(_distinct(bodies, contacts, pair, smooth, rows))


def _search(bodies: Bodies, state: State, contacts: Contacts, arc: _Arcs) -> tuple[Contacts, Tensor]:
    """The edges [K] from where the two normals are opposite, and how far [K] along the arcs that is, by secants."""
    before, left = torch.zeros_like(arc.length), arc.turn
    way = 0.5 * arc.length  # all of it where the two are alike; by what is left to turn there, both are known
    for _ in range(SECANTS):
        now = _nearest(bodies, state, contacts, arc, way)[1]
        gone = (way - before) * now / (left - now)
        before, left = way, now
        way = torch.where(now.abs() > ALIGNED, way + gone, way).clamp(-arc.piece, WAY * arc.piece)
    return _nearest(bodies, state, contacts, arc, way)[0], way


def _distinct(bodies: Bodies, contacts: Contacts, pair: Tensor, smooth: Tensor, rows: Tensor) -> Tensor:
    """Which edges remain: all that are not `smooth` [E], of those that were moved, `rows` [K], the deepest at each
    place, and the deepest of each pair, whatever it is."""
    cell = (contacts.point[rows] / (SAME * bodies.radius[contacts.owner[rows], None])).round().long()
    here = torch.unique(torch.cat([pair[rows, None], cell], 1), dim=0, return_inverse=True)[1]
    kept = ~smooth
    kept[rows[_deepest(here, contacts.ahead[rows])]] = True
    kept[_deepest(pair, contacts.ahead)] = True
    return kept.nonzero()[:, 0]


def _deepest(group: Tensor, depth: Tensor) -> Tensor:
    """The row of the smallest `depth` [K] in each `group` [K] (0 ... G - 1), the first of equals."""
    order = torch.argsort(depth, stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    start = torch.cat([torch.ones_like(group[:1]), group[order].diff()]).nonzero()[:, 0]
    return order[start]


@dataclass(frozen=True)
class _Arcs:
    """Circles from nodes along their surface to where its normal is opposite to that of the other body; owner's axes.

    Attributes:
        point, normal, way: [K, 3] the node, its unit normal, and the direction in which the circle leaves.
        bend: [K] the circle's curvature.
        turn, length: [K] rad and model length of the way.
        piece: [K] how far the surface is known.
    """

    point: Tensor
    normal: Tensor
    way: Tensor
    bend: Tensor
    turn: Tensor
    length: Tensor
    piece: Tensor

    def only(self, rows: Tensor) -> _Arcs:
        """Those of `rows`."""
        return _Arcs(**{name: value[rows] for name, value in vars(self).items()})


def _arcs(bodies: Bodies, state: State, contacts: Contacts, known: Curvature, place: Tensor) -> _Arcs:
    scale, normal = bodies.scale[contacts.owner], known.normal[place]
    aim = _aim(state, contacts)
    rise = (aim * normal).sum(-1)
    way = aim - rise[:, None] * normal
    sine = way.norm(dim=-1)
    way = way / sine.clamp_min(1e-12)[:, None]
    bend = (way[:, None] @ known.bend[place] @ way[:, :, None])[:, 0, 0] / scale
    turn = torch.atan2(sine, rise)
    length = torch.where(bend > 0, turn / bend.clamp_min(1e-12), torch.inf)
    return _Arcs(bodies.node[contacts.node], normal, way, bend, turn, length, known.piece[place] * scale)


def _nearest(bodies: Bodies, state: State, contacts: Contacts, arc: _Arcs, length: Tensor) -> tuple[Contacts, Tensor]:
    """The edges [K] from the surface `length` [K] along the arcs; by how much [K] rad its normal has still to turn."""
    turn = (arc.bend * length)[:, None]
    normal = turn.cos() * arc.normal + turn.sin() * arc.way
    point = arc.point + (normal - arc.normal) / arc.bend[:, None]
    off, gradient = distances(bodies, contacts.owner, point)
    normal = unit(gradient, normal)
    point = point - off[:, None] * normal
    arm = pose.rotate(state.orientation[contacts.owner], point)
    offset = state.position[contacts.owner] - state.position[contacts.body] + arm
    local = pose.rotate(pose.conjugate(state.orientation[contacts.body]), offset)
    distance, gradient = distances(bodies, contacts.body, local)
    outward = pose.rotate(state.orientation[contacts.body], unit(gradient, local))
    half = 0.5 * distance[:, None] * outward
    ahead = contacts.ahead + distance - contacts.distance
    found = {"point": point, "arm": arm - half, "foot": offset - half, "normal": outward, "distance": distance}
    found = replace(contacts, **found, ahead=ahead)
    aim, way = _aim(state, found), arc.way - (arc.way * normal).sum(-1, keepdim=True) * normal
    return found, torch.atan2((aim * way).sum(-1) / way.norm(dim=-1), (aim * normal).sum(-1))


def _aim(state: State, contacts: Contacts) -> Tensor:
    """[E, 3] opposite to the other's normal, in the owner's axes."""
    return -pose.rotate(pose.conjugate(state.orientation[contacts.owner]), contacts.normal)
