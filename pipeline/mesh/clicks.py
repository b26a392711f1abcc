"""Bodies that users point at: from a few clicked places to the body of each part of a connected surface.

A part that the shape separates and that has no click is a separate body. The rest is divided between the clicked
bodies, first by distance along the surface, which grooves and changes of colour lengthen; then the borders are found in
photos (GrabCut, Rother et al. 2004).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from pipeline.cameras import View
from pipeline.inputs.labels import UNKNOWN
from pipeline.inputs.photos import open_photo
from pipeline.mesh.seams import ConnectedSolid, Part, count_votes, cut, grooves, owners, seams, shape_labels, steps
from pipeline.mesh.visibility import Visibility, framed
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh

# Chosen by hand on the rendered sets.
SEED = 1.5  # samples around a clicked point that certainly belong to its body
LONGEST = 7.0  # largest factor by which grooves and changes of colour lengthen distances, as a power of e
SURE = 0.5  # of the distance to the next clicked body: within this share a vertex is certain
PHOTOS, SIDE = 12, 320  # used to find borders, and their size in px
VIEWED = 3  # photos that should see each place
PASSES, AGREED = 2, 0.9  # of finding borders; share of votes above which the second is certain
SAMPLES, LEAST = 20_000, 60  # most and fewest pixels for the colours of a body
OUTSIDE = (255, 0, 255)  # colour of ignored pixels: uses only one of GrabCut's colour models


@dataclass(frozen=True)
class Scene:
    """The surface from which bodies are cut, in normalised space."""

    mesh: Mesh  # all of the closed surface
    caster: Caster  # of it
    sight: Visibility  # of its vertices
    views: Sequence[View]
    photos: Path  # folder of the photos stage


def parts_by_clicks(solid: ConnectedSolid, colors: np.ndarray, clicked: dict[int, np.ndarray], scene: Scene,
                    least: float) -> list[Part]:  # fmt: skip
    """The parts of a solid in which points [K, 3] of several bodies were clicked, by number; further parts found by
    shape have the number 0. `colors` [P, 3] of its vertices; parts are at least `least` long in every direction."""
    shape = shape_labels(solid, colors, least)
    tree = KDTree(solid.points)
    seeds = {number: np.unique(np.concatenate(tree.query_ball_point(points, SEED * solid.volume.cell)).astype(int))
             for number, points in clicked.items()}  # fmt: skip
    for number, points in clicked.items():
        seeds[number] = np.union1d(seeds[number], tree.query(points)[1])
    at = {number: shape[tree.query(points)[1]] for number, points in clicked.items()}
    pointed = np.isin(shape, np.concatenate([*at.values()]))
    kept = [*clicked, *([0] * len(np.unique(shape[~pointed])))]
    label = np.zeros(len(solid.points), int)
    label[~pointed] = len(clicked) + np.unique(shape[~pointed], return_inverse=True)[1]
    if len(clicked) > 1:
        inside = [some[pointed[some]] for some in seeds.values()]
        label[pointed] = divided(solid, pointed, colors, inside, scene)[pointed]
    share = owners(solid.points, np.eye(len(kept))[label], solid.volume.cell)
    return cut(solid, share.argmax(1), seams(solid, share), kept)


def divided(solid: ConnectedSolid, mine: np.ndarray, colors: np.ndarray, seeds: list[np.ndarray], scene: Scene
            ) -> np.ndarray:  # fmt: skip
    """The body of each vertex [P] among those `mine` [P] bool, from the bodies' seed vertices."""
    ends, deep, apart = steps(solid, mine, grooves(solid), colors)
    length = np.linalg.norm(np.diff(solid.points[ends], axis=1)[:, 0], axis=1)
    length *= 1 + np.exp(np.minimum(deep + apart, LONGEST))
    graph = coo_matrix((length, (ends[:, 0], ends[:, 1])), shape=(len(mine), len(mine)))
    away = np.array([_away(graph, solid.points, some) for some in seeds])
    label = away.argmin(0)
    order = np.sort(away, 0)
    sure = order[0] <= SURE * order[1]
    sight = scene.sight.at(solid.index[mine])
    chosen = _chosen(sight, scene.views)
    place = np.cumsum(mine) - 1
    faces = place[solid.faces[mine[solid.faces].all(1)]]
    names = [str(number) for number in range(1, len(seeds) + 1)]
    # Per vertex of the whole surface: the body from 1 on, 0 for ignored vertices.
    whole, certain = np.zeros(len(scene.mesh.vertices), int), np.zeros(len(scene.mesh.vertices), bool)
    for _ in range(PASSES):
        whole[solid.index[mine]], certain[solid.index[mine]] = label[mine] + 1, sure[mine]
        labels = borders([_cut_out(view, whole, certain, scene) for view in chosen], len(seeds))
        share = count_votes(sight, faces, chosen, labels.get, names).share[:, 1:]
        if not share.any():
            break
        # Vertices without a vote take the body of their neighbours.
        label, sure = label.copy(), sure.copy()
        label[mine] = owners(solid.points[mine], share, solid.volume.cell).argmax(1)
        sure[mine] = share.max(1) > AGREED
    return label


def _away(graph: coo_matrix, points: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Distance [P] of vertices, at `points` [P, 3], from those of a seed along the edges of a graph."""
    found = np.asarray(dijkstra(graph.tocsr(), directed=False, indices=seed, min_only=True))
    # Vertices not connected to a seed take the nearest one in space.
    loose = ~np.isfinite(found)
    found[loose] = 1e6 * KDTree(points[seed]).query(points[loose])[0]
    return found


def _chosen(sight: Visibility, views: Sequence[View]) -> list[View]:
    """The photos that together see most; further views of a vertex beyond `VIEWED` do not count."""
    seen = np.zeros((len(views), len(sight.vertices)), np.float32)
    for number, view in enumerate(views):
        index, _, cosine = sight.of_view(view)
        seen[number, index] = cosine
    chosen, have = [], np.zeros(len(sight.vertices), np.float32)
    while len(chosen) < min(PHOTOS, len(views)):
        gain = (np.minimum(have + seen, VIEWED) - np.minimum(have, VIEWED)).sum(1)
        gain[chosen] = -1
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        chosen.append(best)
        have += seen[best]
    return [views[number] for number in chosen]


@dataclass(frozen=True)
class CutOut:
    """The part of a photo that shows some bodies."""

    view: View
    low: np.ndarray  # [2] px of the photo, column and row of its first pixel
    size: np.ndarray  # [2] px of the photo, width and height
    picture: np.ndarray  # [H, W, 3] uint8, reduced, `OUTSIDE` where it shows something else
    body: np.ndarray  # [H, W] as far as known, from 1 on; 0 for something else
    sure: np.ndarray  # [H, W] bool, where that is sure

    def labels(self, found: np.ndarray) -> np.ndarray:
        """Labels [H, W] uint8 of the cut-out as labels of the photo; `UNKNOWN` around it."""
        result = np.full((self.view.height, self.view.width), UNKNOWN, np.uint8)
        wide = np.asarray(Image.fromarray(found).resize(tuple(self.size.tolist()), Image.Resampling.NEAREST))
        start, end = np.maximum(self.low, 0), np.minimum(self.low + self.size, [self.view.width, self.view.height])
        inner = wide[start[1] - self.low[1] : end[1] - self.low[1], start[0] - self.low[0] : end[0] - self.low[0]]
        result[start[1] : end[1], start[0] : end[0]] = inner
        return result


def _cut_out(view: View, label: np.ndarray, certain: np.ndarray, scene: Scene) -> CutOut:
    """The part of a photo with the vertices whose label [V] is above 0; some are `certain` [V] bool."""
    pixels, inside = framed(view, scene.mesh.vertices)
    corner = pixels[inside & (label > 0)]
    low = np.floor(corner.min(0)).astype(int)
    size = np.ceil(corner.max(0)).astype(int) - low + 1
    shrink = min(1.0, SIDE / size.max())
    width, height = (max(1, round(shrink * side)) for side in size.tolist())
    column, row = np.meshgrid(low[0] + (np.arange(width) + 0.5) * size[0] / width,
                              low[1] + (np.arange(height) + 0.5) * size[1] / height)  # fmt: skip
    hit, face = scene.caster.hits(view.center, view.rays(column.ravel(), row.ravel()))
    nearest = scene.mesh.faces[np.where(np.isfinite(hit), face, 0)]
    corners = np.where(np.isfinite(hit)[:, None], label[nearest], 0)
    body = corners[:, 0].reshape(height, width)
    sure = (certain[nearest].all(1) & (corners == corners[:, :1]).all(1)).reshape(height, width)
    shown = open_photo(scene.photos, view).crop((*low.tolist(), *(low + size).tolist()))
    picture = np.array(shown.resize((width, height), Image.Resampling.BOX))
    picture[body == 0] = OUTSIDE
    return CutOut(view, low, size, picture, body, sure)


def borders(shown: list[CutOut], count: int) -> dict[str, np.ndarray]:
    """The body, from 1 to `count`, at each pixel [H, W] uint8 of each photo, by its name; `UNKNOWN` if unclear. The
    colours of each body are those of its certain pixels in all photos together."""
    import cv2

    color = np.concatenate([one.picture[one.sure & (one.body > 0)] for one in shown])
    body = np.concatenate([one.body[one.sure & (one.body > 0)] for one in shown])
    some = np.random.default_rng(0).permutation(len(color))[:SAMPLES]
    color = np.concatenate([color[some], np.full((SAMPLES // 10, 3), OUTSIDE, np.uint8)])
    body = np.concatenate([body[some], np.zeros(SAMPLES // 10, int)])
    claims = [np.zeros((count + 1, *one.body.shape), bool) for one in shown]
    there = [number for number in range(1, count + 1) if (body == number).sum() >= LEAST]
    nothing = (0, 0, 1, 1)
    for number in there if len(there) > 1 else []:
        back, front = np.zeros((1, 65)), np.zeros((1, 65))
        known = np.where(body == number, cv2.GC_FGD, cv2.GC_BGD).astype(np.uint8)
        cv2.setRNGSeed(0)
        cv2.grabCut(color[None], known[None], nothing, back, front, 1, cv2.GC_INIT_WITH_MASK)
        for claim, one in zip(claims, shown, strict=True):
            mask = np.where(one.body == number, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
            mask[one.sure] = np.where(one.body == number, cv2.GC_FGD, cv2.GC_BGD)[one.sure]
            mask = np.where(one.body == 0, cv2.GC_BGD, mask).astype(np.uint8)
            cv2.grabCut(one.picture, mask, nothing, back.copy(), front.copy(), 1, cv2.GC_EVAL_FREEZE_MODEL)
            claim[number] = ((mask == cv2.GC_FGD) | (mask == cv2.GC_PR_FGD)) & (one.body > 0)
    return {
        one.view.name: one.labels(np.where(claim.sum(0) == 1, claim.argmax(0), UNKNOWN).astype(np.uint8))
        for one, claim in zip(shown, claims, strict=True)
    }
