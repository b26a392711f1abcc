"""Broad phase: the pairs of bodies that could come within reach in one step.

Bodies that stay put are sorted into cells once; each step costs what moves and what is near it, never N x N.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sdfsim.dynamics import pose
from sdfsim.dynamics.bodies import Bodies, State, awake

_HALF = 2**15  # cells on either side of the middle along each axis; what lies beyond shares the last one


@dataclass(frozen=True)
class Boxes:
    """K axis-aligned world boxes, each grown by what one step can move its body and by half the contact radius.

    Attributes:
        body: [K] int64.
        low, high: [K, 3] float64.
        level: [K] int64: a box is at most 4 ** level wide; cells of that level hold it with its neighbours.
        world: [K] int64.
    """

    body: Tensor
    low: Tensor
    high: Tensor
    level: Tensor
    world: Tensor

    def __len__(self) -> int:
        return len(self.body)

    def where(self, chosen: Tensor) -> Boxes:
        """The boxes that are `chosen` [K] bool."""
        if bool(chosen.all()):
            return self
        return Boxes(*(v[chosen] for v in (self.body, self.low, self.high, self.level, self.world)))


class Grid:
    """Boxes sorted by world and by the cell that holds their low corner.

    Args:
        boxes: none wider than 4 ** level.
        level: sets the size of the cells.
        split: whether worlds are kept apart already here.
    """

    def __init__(self, boxes: Boxes, level: int, *, split: bool) -> None:
        self._cell = 1.001 * 4.0**level
        self._middle = boxes.low.median(0).values
        self._split = split
        key, order = self._key(self._worlds(boxes), *self._place(boxes.low).unbind(-1)).sort()
        self._keys, self._body = key, boxes.body[order]
        self._low, self._high = boxes.low[order], boxes.high[order]

    def overlaps(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """Row of `boxes` and body of this grid [P] for all that overlap; boxes at most as wide as a cell."""
        low, high = self._place(boxes.low - self._cell), self._place(boxes.high)
        wide = high - low + 1
        row, column = expand(torch.zeros_like(wide[:, 0]), wide[:, 0] * wide[:, 1])
        x = low[row, 0] + torch.div(column, wide[row, 1], rounding_mode="floor")
        y, world = low[row, 1] + column % wide[row, 1], self._worlds(boxes)[row]
        # Along z the cells of a column follow each other.
        start = torch.searchsorted(self._keys, self._key(world, x, y, low[row, 2]))
        stop = torch.searchsorted(self._keys, self._key(world, x, y, high[row, 2]), right=True)
        which, other = expand(start, stop)
        row = row[which]
        meet = ((self._low[other] <= boxes.high[row]) & (self._high[other] >= boxes.low[row])).all(-1)
        return row[meet], self._body[other[meet]]

    def _place(self, corner: Tensor) -> Tensor:
        return ((corner - self._middle) / self._cell).floor().clamp(-_HALF, _HALF - 1).long() + _HALF

    def _worlds(self, boxes: Boxes) -> Tensor:
        return boxes.world % _HALF if self._split else torch.zeros_like(boxes.world)

    @staticmethod
    def _key(world: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return ((world * 2 * _HALF + x) * 2 * _HALF + y) * 2 * _HALF + z


class Still:
    """The bodies that stay put, sorted once for every size of what moves among them.

    Args:
        boxes: of them.
    """

    def __init__(self, boxes: Boxes) -> None:
        endless = ~boxes.low.isfinite().all(-1)
        self.endless = boxes.body[endless]
        self._boxes = boxes.where(~endless)
        self._grids: dict[int, list[Grid]] = {}

    def grids(self, level: int) -> list[Grid]:
        """The grids to ask for boxes of `level`."""
        if level not in self._grids:
            boxes = self._boxes
            sizes = sorted({max(level, size) for size in boxes.level.unique().tolist()})
            held = boxes.level.clamp_min(level)
            self._grids[level] = [Grid(boxes.where(held == size), size, split=False) for size in sizes]
        return self._grids[level]


def near_pairs(
    bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float, going: Tensor, still: Still
) -> tuple[Tensor, Tensor]:
    """Ordered pairs (owner of nodes, other) [P] whose swept, grown boxes overlap, in ascending order.

    Args:
        bodies: N bodies.
        state: theirs.
        gravity: [3].
        reach: contact radius.
        dt: the step.
        going: [A] int64, the bodies that do not stay put; at least one of a pair is among them.
        still: the others.
    """
    if not len(going):
        return going, going
    boxes = swept_boxes(bodies, state, gravity, reach, dt, going)
    found = [_against_endless(bodies, state, reach, boxes, still.endless)]
    for level in boxes.level.unique().tolist():
        mine = boxes.where(boxes.level == level)
        smaller = boxes.where(boxes.level <= level)
        row, other = Grid(mine, level, split=True).overlaps(smaller)
        # Two boxes of one level find each other twice.
        once = (smaller.level[row] < level) | (smaller.body[row] < other)
        found.append((smaller.body[row[once]], other[once]))
        for grid in still.grids(level):
            row, other = grid.overlaps(mine)
            found.append((mine.body[row], other))
    one, other = (torch.cat(side) for side in zip(*found, strict=True))
    meet = bodies.may_meet(one, other)
    one, other = one[meet], other[meet]
    first, second = torch.cat([one, other]), torch.cat([other, one])
    owns = bodies.node_start[first + 1] > bodies.node_start[first]
    first, second = first[owns], second[owns]
    order = (first * len(bodies) + second).argsort()
    return first[order], second[order]


def moving(bodies: Bodies, state: State) -> Tensor:
    """[A] int64, the bodies that do not stay put: awake dynamic ones, and kinematic ones on their way."""
    rows = awake(bodies, state)
    if bodies.tracks is None:
        return rows
    scripted = bodies.tracks.body
    on_the_way = (state.velocity[scripted] != 0).any(-1) | (state.angular_velocity[scripted] != 0).any(-1)
    return torch.cat([rows, scripted[on_the_way]])


def swept_boxes(bodies: Bodies, state: State, gravity: Tensor, reach: float, dt: float, rows: Tensor) -> Boxes:
    """World boxes of the bodies `rows` [K], grown by their motion in one step and by half the contact radius."""
    low, high = _world_boxes(bodies, state, rows)
    sweep = (state.velocity[rows] * dt).abs() + (gravity * dt * dt).abs() * bodies.moves[rows, None]
    grow = sweep + turning(bodies, state, rows)[:, None] * dt + 0.5 * reach
    low, high = low - grow, high + grow
    width = (high - low).amax(-1).clamp(1e-9, 1e18)
    level = (0.5 * width.log2()).ceil().long()
    return Boxes(rows, low, high, level, bodies.world[rows])


def turning(bodies: Bodies, state: State, rows: Tensor) -> Tensor:
    """[K] the fastest that turning moves any point of the bodies `rows`: |w| times the radius (0 for a plane)."""
    radius = bodies.radius[rows]
    speed = state.angular_velocity[rows].norm(dim=-1) * radius
    return torch.where(radius.isfinite(), speed, torch.zeros_like(speed))


def expand(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """For ranges start[k]:stop[k], the range index and the value of every element, in order."""
    count = stop - start
    which = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    first = torch.repeat_interleave(count.cumsum(0) - count, count)
    return which, start[which] + torch.arange(len(which), device=count.device) - first


def _world_boxes(bodies: Bodies, state: State, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Axis-aligned boxes [K, 3], [K, 3] of the turned bounds."""
    box = bodies.bounds[rows]
    finite = box.isfinite().all(-1).all(-1)
    box = torch.where(finite[:, None, None], box, torch.zeros_like(box))
    orientation = state.orientation[rows]
    centre = state.position[rows] + pose.rotate(orientation, box.mean(1))
    half = (pose.to_matrix(orientation).abs() @ (0.5 * (box[:, 1] - box[:, 0]))[..., None])[..., 0]
    half = torch.where(finite[:, None], half, torch.full_like(half, torch.inf))
    return centre - half, centre + half


def _against_endless(
    bodies: Bodies, state: State, reach: float, boxes: Boxes, endless: Tensor
) -> tuple[Tensor, Tensor]:
    """Pairs (body of `boxes`, plane) whose boxes overlap in the plane's own frame."""
    row = torch.arange(len(boxes), device=endless.device).repeat_interleave(len(endless))
    plane = endless.repeat(len(boxes))
    inverse = pose.conjugate(state.orientation[plane])
    centre = pose.rotate(inverse, 0.5 * (boxes.low + boxes.high)[row] - state.position[plane])
    half = (pose.to_matrix(inverse).abs() @ (0.5 * (boxes.high - boxes.low)[row])[..., None])[..., 0] + 0.5 * reach
    bounds = bodies.bounds[plane]
    meet = ((centre - half <= bounds[:, 1]) & (centre + half >= bounds[:, 0])).all(-1)
    return boxes.body[row[meet]], plane[meet]
