"""Divides a connected solid into several touching bodies: the body of each part of the surface, and the seams between.

Masks decide this, or else the shape: touching bodies meet in a sharp groove. No photo shows the seam through the
inside. It is assumed to be flat: the plane through the line on the surface where the parts meet. If that line is not
flat, the inside belongs to the part with the nearest surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.signal import fftconvolve
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from scipy.spatial import ConvexHull, KDTree

from pipeline.cameras import View, frame_of
from pipeline.grids.connected import largest
from pipeline.inputs.labels import UNKNOWN
from pipeline.mesh.extraction import Volume
from pipeline.mesh.visibility import Visibility
from sdfsim.geometry.mesh import Mesh, vertex_normals

# All set by hand on `touching` (a cup against a vase, and three books), where they are also measured (docs/objects.md),
# unless another set is named.
# A patch of one label that is smaller than this share of the label's largest is a mistake in a mask.
STRAY = 0.1
# Smallest share of the surface for a separate part without masks, and for a part with masks.
REST, NAMED = 0.1, 0.02
# Radius of the ball, in samples, for finding grooves; the share of it beyond a half that is solid in a groove, and the
# mean of this along a seam. In a sharp right angle it is 0.25; trained fields fill their grooves.
BALL, GROOVE, DEEP = 3, 0.03, 0.055
# Colours are means within this many samples. The cost of a cut falls by a factor e for a groove of the first value, or
# for a difference of colour of the second value between vertices.
HUE, SOFT = 1.5, (0.03, 0.015)
# Least share of all the surface that a part has, and of the seam's border that lies in a groove.
LEAST_PART, ALL_ALONG = 0.08, 0.65
# Least share of a seam that is within the solid, because a groove also surrounds the floor of a cup.
THROUGH = 0.6
# Two parts are separate if their seam is smaller than this share of the smaller one's surface, or if their colours
# differ.
NARROW, COLORS = 0.06, 0.12
# If colours differ twice as much, this share of a groove is enough.
SHALLOW = 0.75
# Largest distance of the line where parts meet from a plane, as a share of its width, in addition to a sample.
FLAT = 0.1
# Parts with this many neighbouring samples touch (not tuned).
MEET = 12
# The samples fill grooves: the true line is this many samples below the surface.
FILLED = 0.45
# A seam is moved into a surface that is parallel to it to this cosine, within this many samples of its plane, between
# these distances in samples outside its rim, that has at least this share of the rim's number of vertices, and faces
# one way.
PARALLEL, COVER, BESIDE, AROUND, ONE_SIDED = 0.97, 1.2, (0.7, 5.0), 0.3, 0.8
# Within this many samples of its plane a seam stops the flood fill through the inside (not tuned).
WALL = 0.9


@dataclass(frozen=True)
class Votes:
    """The photos' votes on the object of each vertex of a surface."""

    names: list[str]  # of the objects
    # [V, 1 + names] share of the photos' votes for no object, and for each object; 0 where no photo votes
    share: np.ndarray

    @property
    def winner(self) -> np.ndarray:
        """[V] number of the object with most votes, counted from 1; 0 for no object, -1 where no photo votes."""
        return np.where(self.share.any(1), self.share.argmax(1), -1)


def count_votes(sight: Visibility, faces: np.ndarray, views: Sequence[View],
                labels_of: Callable[[str], np.ndarray | None], names: list[str]) -> Votes:  # fmt: skip
    """Lets every photo with labels vote for the vertices that it sees, weighted as in `look`; strays are left out.
    `labels_of` is like `load_labels`, by the name of the prepared photo."""
    votes = np.zeros((len(sight.vertices), len(names) + 1))
    for view in views:
        labels = labels_of(view.name)
        if labels is None:
            continue
        index, pixels, cosine = sight.of_view(view)
        column, row = pixels.astype(int).T
        found = labels[np.clip(row, 0, labels.shape[0] - 1), np.clip(column, 0, labels.shape[1] - 1)]
        weight = cosine**2 / np.linalg.norm(view.center - sight.vertices[index], axis=1) ** 2
        said = found != UNKNOWN
        votes[index[said], found[said]] += weight[said]
    total = votes.sum(1, keepdims=True)
    share = votes / np.where(total > 0, total, 1)
    winner = np.where(total[:, 0] > 0, share.argmax(1), -1)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = ends[winner[ends[:, 0]] == winner[ends[:, 1]]]
    graph = coo_matrix((np.ones(len(ends), np.int8), tuple(ends.T)), shape=(len(winner),) * 2)
    patch = connected_components(graph, directed=False)[1]
    size = np.bincount(patch)
    largest = np.zeros(len(names) + 2)
    np.maximum.at(largest, winner, size[patch])
    share[size[patch] < STRAY * largest[winner]] = 0
    return Votes(names, share)


@dataclass(frozen=True)
class Part:
    """One of the bodies in a solid."""

    number: int  # of the name in `Votes`; 0: no name
    seam: Volume  # negative within the part; zero at the seams. Its slope is roughly that of a distance.
    neighbours: list[int]  # indices, in the list of the parts, of touching parts


@dataclass(frozen=True)
class Seam:
    """One connected seam between two parts."""

    pair: tuple[int, int]  # numbers of the two parts
    rim: np.ndarray  # [R, 3] points on the surface where they meet
    point: np.ndarray  # [3] its middle
    normal: np.ndarray  # [3] unit, from the first part to the second
    flat: bool  # whether the rim lies in a plane
    sides: np.ndarray  # [S, 3] the lines (a, b, c) around the seam in its plane: a x + b y + c <= 0 within

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Distances [P] of points [P, 3] from the plane, positive towards the second part."""
        return (points - self.point) @ self.normal

    def outside(self, points: np.ndarray) -> np.ndarray:
        """Distance [P] of the feet of points [P, 3] in the plane outside the rim; negative within."""
        flat = (points - self.point) @ frame_of(self.normal)[:2].T
        return (flat @ self.sides[:, :2].T + self.sides[:, 2]).max(1)


@dataclass(frozen=True)
class ConnectedSolid:
    """One connected solid."""

    volume: Volume  # samples of the signed distance around it
    inside: np.ndarray  # [X, Y, Z] bool, those within it
    index: np.ndarray  # [P] its vertices in the mesh of everything
    points: np.ndarray  # [P, 3] these vertices
    normals: np.ndarray  # [P, 3] unit, outwards
    faces: np.ndarray  # [F, 3] between them

    @property
    def border(self) -> np.ndarray:
        """[X, Y, Z] bool, samples within it next to samples outside."""
        return self.inside & np.logical_not(ndimage.binary_erosion(self.inside))


def solid_of(volume: Volume, inside: np.ndarray, mesh: Mesh) -> ConnectedSolid:
    """The solid of the samples `inside` [X, Y, Z], with the vertices of the mesh of everything that lie at it."""
    at = np.round((mesh.vertices - volume.low) / volume.cell).astype(int)
    within = np.flatnonzero(((at >= 0) & (at < inside.shape)).all(1))
    index = within[np.asarray(ndimage.binary_dilation(inside), bool)[tuple(at[within].T)]]
    place = np.full(len(mesh.vertices), -1)
    place[index] = np.arange(len(index))
    faces = place[mesh.faces]
    faces = faces[(faces >= 0).all(1)]
    normals = vertex_normals(Mesh(mesh.vertices[index], faces))
    return ConnectedSolid(volume, inside, index, mesh.vertices[index], normals, faces)


def parts_by_votes(solid: ConnectedSolid, votes: Votes) -> tuple[list[Part], int]:
    """The parts of a solid that masks separate, empty if there are not two; and the name's number for the whole solid,
    else 0."""
    winner = votes.winner[solid.index]
    count = np.bincount(winner[winner >= 0], minlength=len(votes.names) + 1)
    least = np.full(len(count), NAMED)
    least[0] = REST
    there = np.flatnonzero(count >= np.maximum(least * count.sum(), 1))
    if len(there) < 2:
        return [], int(there[0]) if len(there) else 0
    share = owners(solid.points, votes.share[solid.index][:, there], solid.volume.cell)
    return cut(solid, share.argmax(1), seams(solid, share), there.tolist()), 0


def part_of_name(solid: ConnectedSolid, votes: Votes, number: int) -> Part | None:
    """The part with this number in the masks of a larger solid, of which only a box with an empty border is given; None
    if there is none."""
    mine = votes.share[solid.index, number]
    if not mine.any():
        return None
    share = np.stack([votes.share[solid.index].sum(1) - mine, mine], 1)
    share = owners(solid.points, share, solid.volume.cell)
    parts = cut(solid, share.argmax(1), seams(solid, share), [0, number])
    return parts[1] if parts else None


def parts_by_shape(solid: ConnectedSolid, colors: np.ndarray, least: float) -> list[Part]:
    """The parts of a solid by `shape_labels`; empty for a single body."""
    label = shape_labels(solid, colors, least)
    if not label.any():
        return []
    share = owners(solid.points, np.eye(label.max() + 1)[label], solid.volume.cell)
    return cut(solid, label, seams(solid, share), [0] * (label.max() + 1))


def shape_labels(solid: ConnectedSolid, colors: np.ndarray, least: float) -> np.ndarray:
    """The part [P] of each vertex, from 0 on: parts meet in a continuous groove, and their seam is narrow or their
    colours [P, 3] differ. Parts are at least `least` long in every direction."""
    groove = grooves(solid)
    label = np.zeros(len(groove), int)
    waiting = [0]
    while waiting:
        number = waiting.pop()
        trial, new = label.copy(), label.max() + 1
        trial[_half(solid, label == number, groove, colors)] = new
        share = owners(solid.points, np.eye(new + 1)[trial], solid.volume.cell)
        if _apart(solid, trial, seams(solid, share), (number, new), colors, groove, least):
            label = trial
            waiting += [number, new]
    return label


def _half(solid: ConnectedSolid, mine: np.ndarray, groove: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """One side [N] of the best division of some vertices [P] bool in two, through grooves and where colours change. The
    normalised cut of Shi and Malik (2000), from the second eigenvector of the surface's Laplacian."""
    place = np.cumsum(mine) - 1
    ends, deep, apart = steps(solid, mine, groove, colors)
    weight = np.exp(-deep - apart) + 1e-3
    index = place[ends]
    count = int(mine.sum())
    link = coo_matrix((np.tile(weight, 2), (np.r_[index[:, 0], index[:, 1]], np.r_[index[:, 1], index[:, 0]])),
                      shape=(count, count)).tocsr()  # fmt: skip
    patch = connected_components(link, directed=False)[1]
    whole = np.flatnonzero(patch == np.bincount(patch).argmax())
    link = link[whole][:, whole]
    degree = np.asarray(link.sum(1)).ravel()
    root = diags(degree**-0.5)
    start = np.random.default_rng(0).normal(size=len(whole))
    laplacian = (identity(len(whole)) - root @ link @ root).tocsc()
    # The smallest two eigenvalues are close; of the inverse they are far apart.
    values, vectors = eigsh(laplacian, k=2, sigma=-1e-6, which="LM", v0=start)
    value = vectors[:, values.argmax()] * degree**-0.5
    limits = np.quantile(value, np.linspace(LEAST_PART, 1 - LEAST_PART, 60))
    row, column = link.nonzero()
    strength = np.asarray(link[row, column]).ravel()
    costs = []
    for limit in limits:
        side = value > limit
        across = strength[side[row] != side[column]].sum() / 2
        costs.append(across / max(min(degree[side].sum(), degree[~side].sum()), 1e-9))
    return np.flatnonzero(mine)[whole[value > limits[int(np.argmin(costs))]]]


def steps(solid: ConnectedSolid, mine: np.ndarray, groove: np.ndarray, colors: np.ndarray
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The edges [E, 2] between some vertices [P] bool of a solid, and their resistance to a cut: the depth of the
    `groove` [P] there [E], and the difference in colour [P, 3] of their ends [E]."""
    ends = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    ends = ends[mine[ends].all(1)]
    around = KDTree(solid.points).query_ball_point(solid.points, HUE * solid.volume.cell)
    rows = np.repeat(np.arange(len(around)), [len(each) for each in around])
    mean = coo_matrix((np.ones(len(rows)), (rows, np.concatenate(around)))).tocsr() @ colors.astype(float)
    hue = _hue(mean / np.bincount(rows)[:, None])
    deep = np.maximum(groove[ends].max(1), 0) / SOFT[0]
    return ends, deep, np.linalg.norm(hue[ends[:, 0]] - hue[ends[:, 1]], axis=1) / SOFT[1]


def grooves(solid: ConnectedSolid) -> np.ndarray:
    """Depth of the groove at each vertex [P]: the solid share of a ball around it minus a half. 0 on a plane, 0.25 in a
    sharp right angle, less on an edge."""
    volume = solid.volume
    axis = np.arange(-BALL, BALL + 1)
    x, y, z = np.meshgrid(axis, axis, axis)
    ball = (x**2 + y**2 + z**2 <= BALL**2).astype(np.float32)
    filled = np.clip(0.5 - volume.values / volume.cell, 0, 1) * ndimage.binary_dilation(solid.inside)
    share = fftconvolve(np.pad(filled, BALL), ball / ball.sum(), mode="same").astype(np.float32)
    return Volume(share, volume.low - BALL * volume.cell, volume.cell).at(solid.points) - 0.5


def owners(points: np.ndarray, share: np.ndarray, cell: float) -> np.ndarray:
    """Membership of each vertex in each part, [P, K], from the votes [P, K] around it."""
    voting = np.flatnonzero(share.sum(1) > 0)
    away, near = KDTree(points[voting]).query(points, k=min(8, len(voting)))
    away, near = away.reshape(len(points), -1), near.reshape(len(points), -1)
    weight = np.exp(-np.minimum((away**2 - away[:, :1] ** 2) / cell**2, 50))
    return (share[voting][near] * weight[..., None]).sum(1) / weight.sum(1, keepdims=True)


def seams(solid: ConnectedSolid, share: np.ndarray) -> list[Seam]:
    """The seams between the parts of a solid, from the membership of each vertex in each part [P, K]."""
    label = share.argmax(1)
    ends = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    ends = ends[label[ends[:, 0]] < label[ends[:, 1]]]
    found = []
    for a, b in np.unique(label[ends], axis=0):
        mine = ends[(label[ends] == (a, b)).all(1)]
        lead = share[mine, a] - share[mine, b]
        at = (lead[:, 0] / np.maximum(lead[:, 0] - lead[:, 1], 1e-9))[:, None]
        middle = (1 - at) * solid.points[mine[:, 0]] + at * solid.points[mine[:, 1]]
        middle = middle - FILLED * solid.volume.cell * solid.normals[mine].mean(1)
        near = KDTree(middle).sparse_distance_matrix(KDTree(middle), 3 * solid.volume.cell)
        piece = connected_components(near, directed=False)[1]
        for k in range(piece.max() + 1):
            rim, across = middle[piece == k], np.diff(solid.points[mine[piece == k]], axis=1)[:, 0].mean(0)
            if np.ptp(rim, axis=0).max() > 3 * solid.volume.cell:
                found.append(_laid(solid, _seam((int(a), int(b)), rim, across, solid.volume.cell)))
    return found


def _seam(pair: tuple[int, int], rim: np.ndarray, across: np.ndarray, cell: float) -> Seam:
    """The seam of a rim [R, 3]; `across` [3] points from the first part to the second."""
    point = (rim.min(0) + rim.max(0)) / 2
    spread, axes = np.linalg.eigh(np.cov((rim - rim.mean(0)).T))
    # A rim as thin as a line lies in many planes: use the one that faces the other part.
    free = axes[:, : 2 if spread[1] < (1.5 * cell) ** 2 else 1]
    normal = free @ (free.T @ across) if free.shape[1] > 1 else free[:, 0] * np.sign(free[:, 0] @ across or 1.0)
    normal /= np.linalg.norm(normal)
    point = rim.mean(0)
    off = np.sqrt(np.mean(((rim - point) @ normal) ** 2))
    flat = off < cell + FLAT * np.sqrt(spread[2])
    return Seam(pair, rim, point, normal, bool(flat), _sides(rim, point, normal))


def _sides(rim: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The lines [S, 3] around a rim [R, 3] in the plane through a point, see `Seam`."""
    return ConvexHull((rim - point) @ frame_of(normal)[:2].T, qhull_options="QJ").equations


def _laid(solid: ConnectedSolid, seam: Seam) -> Seam:
    """The seam moved into the flat surface around it, if there is one: a body on the cover of a book ends at the cover,
    which is seen more exactly than the groove around the body."""
    if not seam.flat:
        return seam
    cell = solid.volume.cell
    near = np.abs(seam.beyond(solid.points)) < COVER * cell
    near[near] = np.abs(solid.normals[near] @ seam.normal) > PARALLEL
    outside = seam.outside(solid.points[near]) / cell
    near[near] = (outside > BESIDE[0]) & (outside < BESIDE[1])
    side = np.sign(solid.normals[near] @ seam.normal)
    # Two round bodies face each other from both sides.
    if near.sum() < AROUND * len(seam.rim) or abs(side.mean()) < ONE_SIDED:
        return seam
    normal = np.median(solid.normals[near] * side[:, None], axis=0)
    normal /= np.linalg.norm(normal)
    point = seam.point + np.median((solid.points[near] - seam.point) @ normal) * normal
    return replace(seam, point=point, normal=normal, sides=_sides(seam.rim, point, normal))


def _walled(solid: ConnectedSolid, seam: Seam) -> tuple[np.ndarray, np.ndarray]:
    """Samples [N] of a solid within the rim of a seam, and their distance [N] from its plane, both within 3 samples."""
    cell = solid.volume.cell
    at = np.argwhere(solid.inside)
    points = solid.volume.low + cell * at
    beyond = seam.beyond(points)
    close = np.flatnonzero(np.abs(beyond) < 3 * cell)
    close = close[seam.outside(points[close]) < 1.5 * cell]
    return at[close], beyond[close]


def flood(solid: ConnectedSolid, label: np.ndarray, found: list[Seam]) -> np.ndarray:
    """Part [X, Y, Z] of each sample: that of the nearest vertex through the inside, without crossing a flat seam; -1
    outside. Each part is connected."""
    from skimage.segmentation import watershed

    cell = solid.volume.cell
    at = np.argwhere(solid.border)
    away, near = KDTree(solid.points).query(solid.volume.low + cell * at)
    marks = np.zeros(solid.inside.shape, np.int32)
    marks[tuple(at.T)] = np.where(away < 1.5 * cell, label[near] + 1, 0)
    free = solid.inside.copy()
    walls = []
    for seam in found:
        if seam.flat:
            place, beyond = _walled(solid, seam)
            marks[tuple(place.T)] = 0
            wall = np.abs(beyond) < WALL * cell
            free[tuple(place[wall].T)] = False
            walls.append((tuple(place[wall].T), np.where(beyond[wall] > 0, seam.pair[1], seam.pair[0]) + 1))
    part = watershed(np.zeros(marks.shape, np.uint8), marks * free, mask=free)
    for place, side in walls:
        part[place] = side
    # A body is in one piece: a pocket of one within another comes from vertices at a flaw inside the solid.
    for number in np.unique(part[part > 0]):
        here = part == number
        part[here & ~largest(here)[0]] = 0
    return np.where(solid.inside, _spread(part, part > 0) - 1, -1)


def _spread(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values [X, Y, Z], with those not known [X, Y, Z] bool replaced by the nearest known one."""
    nearest: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def cut(solid: ConnectedSolid, label: np.ndarray, found: list[Seam], numbers: list[int]) -> list[Part]:
    """The parts of a solid from the part of each vertex [P] and the seams between; `numbers` of their names."""
    cell, part = solid.volume.cell, flood(solid, label, found)
    spread = _spread(part, part >= 0)
    points = solid.volume.points().reshape(-1, 3)
    there = [k for k in range(len(numbers)) if (part == k).any()]
    parts = []
    for k in there:
        value = -2 * cell * ndimage.gaussian_filter(np.where(spread == k, 1.0, -1.0), 1.0)
        for seam in found:
            if seam.flat and k in seam.pair:
                beyond = seam.beyond(points) * (1 if k == seam.pair[0] else -1)
                close = (np.abs(beyond) < 2.5 * cell) & np.isin(spread.ravel(), seam.pair)
                close[close] = seam.outside(points[close]) < 0.3 * cell
                value.reshape(-1)[close] = beyond[close]
        # Parts that only meet at an edge do not touch.
        around = np.asarray(ndimage.binary_dilation(part == k), bool) & (part >= 0)
        beside = np.bincount(part[around], minlength=len(numbers)) >= MEET
        beside[k] = False
        parts.append(Part(numbers[k], Volume(value.astype(np.float32), solid.volume.low, cell),
                          [there.index(int(other)) for other in np.flatnonzero(beside)]))  # fmt: skip
    return parts if len(parts) > 1 else []


def _apart(solid: ConnectedSolid, label: np.ndarray, found: list[Seam], pair: tuple[int, int], colors: np.ndarray,
           groove: np.ndarray, least: float) -> bool:  # fmt: skip
    """Whether two parts are two bodies: they meet in one flat seam, in a continuous groove, which is narrow or between
    two colours."""
    between = [seam for seam in found if seam.pair == pair]
    if len(between) != 1 or not between[0].flat:
        return False
    seam, cell, part = between[0], solid.volume.cell, flood(solid, label, found)
    if any(not (part == k).any() or np.ptp(np.argwhere(part == k), axis=0).min() * cell < least for k in pair):
        return False
    first, second = (_hue(colors[label == k].mean(0)) for k in pair)
    differ = float(np.linalg.norm(first - second))
    deep, enough = groove[KDTree(solid.points).query(seam.rim)[1]], SHALLOW if differ > 2 * COLORS else 1.0
    along = (deep > GROOVE).mean() > enough * ALL_ALONG and deep.mean() > enough * DEEP
    beyond = _walled(solid, seam)[1]
    area = (np.abs(beyond) < WALL * cell).sum() * cell**2 / (2 * WALL)
    ring = ConvexHull((seam.rim - seam.point) @ frame_of(seam.normal)[:2].T, qhull_options="QJ").volume
    skin = min((solid.border & (part == k)).sum() * cell**2 for k in pair)
    return bool(along and area > THROUGH * ring and (area < NARROW * skin or differ > COLORS))


def _hue(color: np.ndarray) -> np.ndarray:
    """Hue and a little of the brightness [..., 3] of colours [..., 3]: light and shade count less than paint."""
    red, green, blue = np.moveaxis(np.maximum(color, 1.0), -1, 0)
    total = red + green + blue
    return np.stack([(red - green) / total, ((red + green) / 2 - blue) / total, 0.15 * np.log(total)], -1)
