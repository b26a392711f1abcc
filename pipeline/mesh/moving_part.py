"""What photos of a thing in one of two states tell of the part that moves: where they see through, what on it looks
like what, and which pixels show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from pipeline.cameras import Similarity, View, load_poses
from pipeline.field.training import load_field
from pipeline.inputs.labels import UNKNOWN
from pipeline.inputs.photos import open_photo
from pipeline.mesh.meshing import read_parts
from pipeline.mesh.placement import load_placement
from pipeline.mesh.visibility import framed
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.geometry.bvh import Caster, ClosestPoint
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import read_mesh

THROUGH = 2  # photos that look through a place where nothing is
CELLS = 3.0  # of the field's finest grid: what differs by less between two states stands still
ASKED, SPREAD = 24, 15  # photos of a state at most in which alike places are looked for, on the part and on all else
FEATURES, DISTINCT = 2000, 0.8  # of a photo; how much nearer than the next a match has to be
LIKELIER = 0.4  # of the way: a surface that is so much nearer to the other state's once it is moved does move
BESIDE = 2.0  # times what counts as still: so near to the part's points what moves with it is
TIED, REFINED = 50, 3  # patches that have to look alike in both states; rounds of least squares on all that do
INNER = 0.97  # of the ball in which a field was trained
EVERY = 2  # px between rays that tell what a photo shows


@dataclass(frozen=True)
class State:
    """One state of a thing, in whatever frame both states share."""

    visible: Mesh  # what photos show
    closed: Mesh  # all of the surface, which is in the way of what lies behind
    views: Sequence[View]
    photos: Path  # folder of the photos stage
    cell: float  # width of the field's cells
    middle: np.ndarray  # [3] of the ball in which the field was trained
    radius: float

    def moved(self, move: Similarity) -> State:
        """The same in another frame."""
        visible, closed = (Mesh(move.points(mesh.vertices), mesh.faces) for mesh in (self.visible, self.closed))
        views = [move.view(view) for view in self.views]
        middle = move.points(self.middle)
        return State(visible, closed, views, self.photos, self.cell * move.scale, middle, self.radius * move.scale)

    @cached_property
    def caster(self) -> Caster:
        """Of the closed surface."""
        return Caster(self.closed)

    def empty(self, points: np.ndarray) -> np.ndarray:
        """[P] bool, places [P, 3] through which photos see what lies behind them."""
        inside = np.linalg.norm(points - self.middle, axis=1) < self.radius
        count = np.zeros(len(points), int)
        for view in self.views:
            index = np.flatnonzero(inside & framed(view, points)[1] & (count < THROUGH))
            way = points[index] - view.center
            away = np.linalg.norm(way, axis=1)
            hit = self.caster.hits(view.center, way / away[:, None])[0]
            count[index] += hit > away + CELLS * self.cell
        return count >= THROUGH


def load_state(folder: Path) -> State:
    """The state that a folder of the mesh stage holds, in metres of its own."""
    trained, place = load_field(folder / "distill"), load_placement(folder / "mesh").to_metres
    known = read_parts(folder / "mesh")
    files = [*(["solid.ply"] if known["scenery"] else []), *(f"objects/{one['name']}.ply" for one in known["objects"])]
    visible = read_mesh(folder / "mesh" / "mesh.ply")
    closed = joined([read_mesh(folder / "mesh" / file) for file in files])
    views = load_poses(folder / "poses").moved(place.after(trained.to_unit)).views
    middle, radius = place.translation, INNER * place.scale
    return State(visible, closed, views, folder / "photos", known["cell"], middle, radius)


@dataclass(frozen=True)
class Landmarks:
    """Features of photos on a surface."""

    points: list[np.ndarray]  # by photo [K, 3]
    looks: list[np.ndarray]  # by photo [K, 128] float32


def landmarks(state: State, part: np.ndarray | None = None) -> Landmarks:
    """Features (SIFT, Lowe 2004) on the surface in photos from all sides, or near points [P, 3] of it in those that
    show most of these."""
    import cv2

    finder, tree = cv2.SIFT.create(FEATURES, contrastThreshold=0.01), None if part is None else KDTree(part)
    points, looks = [], []
    if part is None:
        chosen = np.unique(np.linspace(0, len(state.views) - 1, SPREAD).astype(int))  # people walk around a thing
    else:
        chosen = np.argsort([-framed(view, part)[1].sum() for view in state.views])[:ASKED]
    for number in chosen:
        view = state.views[number]
        grey = np.asarray(open_photo(state.photos, view, "L"))
        keys, found = finder.detectAndCompute(grey, None)  # type: ignore[call-overload]
        if not keys:
            continue
        pixels = np.array([key.pt for key in keys]) + 0.5
        rays = view.rays(pixels[:, 0], pixels[:, 1])
        away = state.caster.hits(view.center, rays)[0]
        there = view.center + np.where(np.isfinite(away), away, 0.0)[:, None] * rays
        kept = np.isfinite(away) & (np.linalg.norm(there - state.middle, axis=1) < state.radius)
        if tree is not None:
            kept &= tree.query(there)[0] < CELLS * state.cell
        if kept.sum() >= 2:
            points.append(there[kept])
            looks.append(found[kept])
    return Landmarks(points, looks)


def matched(first: Landmarks, second: Landmarks) -> tuple[np.ndarray, np.ndarray]:
    """Places [K, 3] of the first and of the second that look alike in some two photos, some of them wrongly."""
    import cv2

    matcher, nothing = cv2.BFMatcher(cv2.NORM_L2), np.zeros((0, 3))
    here, over = [nothing], [nothing]
    for points, looks in zip(first.points, first.looks, strict=True):
        for theirs, faces in zip(second.points, second.looks, strict=True):
            close = [pair[0] for pair in matcher.knnMatch(looks, faces, 2)
                     if len(pair) == 2 and pair[0].distance < DISTINCT * pair[1].distance]  # fmt: skip
            here.append(points[[match.queryIdx for match in close]])
            over.append(theirs[[match.trainIdx for match in close]])
    return np.concatenate(here), np.concatenate(over)


def alike(one: State, other: State) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """What gives places [K, 3] that look alike, of points [P, 3] that move in the first and in the second state; some
    of them are wrong."""

    def paired(part: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not len(part) or not len(there):
            return np.zeros((0, 3)), np.zeros((0, 3))
        return matched(landmarks(one, part), landmarks(other, there))

    return paired


def tie(state: State, onto: State) -> tuple[Similarity, int]:
    """The similarity that moves a state onto another where they look alike, and how many places agree with it. Each
    patch of the surface has one vote, however much there is to see on it. Raises SdfsimError (exit code 3) if too
    few agree."""
    return tied(*matched(landmarks(state), landmarks(onto)), CELLS * state.cell, CELLS * onto.cell)


def tied(here: np.ndarray, there: np.ndarray, near: float, near_there: float) -> tuple[Similarity, int]:
    """The similarity that most pairs of places [K, 3] agree on, some of which are wrong or have moved, and how many
    patches, `near` in width, these are on; they are off by `near_there` at most."""
    import pycolmap

    patch = np.concatenate([np.floor(here / near), np.floor(there / near_there)], 1).astype(int)
    one = np.unique(patch, axis=0, return_index=True)[1]
    first, second = here[one], there[one]
    options = pycolmap.RANSACOptions(max_error=near_there, max_num_trials=20_000, random_seed=0)
    found: Any = pycolmap.estimate_sim3d_robust(first, second, options) if len(first) > TIED else None
    found = found or {"tgt_from_src": None, "inlier_mask": np.zeros(len(first), bool)}
    good = np.asarray(found["inlier_mask"], bool)
    patches = len(np.unique(np.floor(first[good] / near), axis=0))
    if patches < TIED:
        message = f"both states have too little in common: they look alike in {patches} places, {TIED} are needed"
        hint = "leave most of what the photos show as it is, and photograph it from the same sides in both states"
        raise SdfsimError(message, hint, exit_code=EXIT_QUALITY)
    move: Any = found["tgt_from_src"]
    for _ in range(REFINED):  # all pairs now, and those alone that are near
        moved = move.scale * here @ move.rotation.matrix().T + move.translation
        good = np.linalg.norm(moved - there, axis=1) < near_there / 2
        move = pycolmap.estimate_sim3d(here[good], there[good])
    return Similarity(float(move.scale), move.rotation.matrix(), np.asarray(move.translation)), patches


def which_move(mesh: Mesh, other: State, motion: Similarity, seen: np.ndarray) -> np.ndarray:
    """[V] uint8, of the vertices of one state's surface: 1 for those that a motion takes to the other state, 0
    for those that stay, `UNKNOWN` where nothing tells. `seen` [P, 3] are points of the part."""
    near, points = CELLS * other.cell, mesh.vertices
    moved = motion.points(points)
    on = ClosestPoint(other.visible)
    stays, goes = (np.linalg.norm(on(at)[0] - at, axis=1) for at in (points, moved))
    beside = KDTree(seen).query(points)[0]
    may = beside < 2.0 * float(np.linalg.norm(np.ptp(seen, axis=0)))
    empty, empty_moved = np.zeros(len(points), bool), np.zeros(len(points), bool)
    empty[may], empty_moved[may] = other.empty(points[may]), other.empty(moved[may])
    gone, nowhere = empty & (stays > near), empty_moved & (goes > near)
    # What goes to where no photo looks may be the part's, even if it crosses a surface of the other state.
    unsure = ~empty_moved & (goes > near) & (beside < BESIDE * near)
    result = np.full(len(points), UNKNOWN, np.uint8)
    result[~may | nowhere | ((stays <= near) & (goes > LIKELIER * stays) & ~unsure)] = 0
    likelier = (goes < LIKELIER * stays) & (goes < near) & (beside < BESIDE * near)
    result[may & ~nowhere & ((gone & (beside < 2.0 * BESIDE * near)) | likelier)] = 1
    return result


def label_images(state: State, number: np.ndarray) -> dict[str, np.ndarray]:
    """What each photo shows, [H, W] uint8 by its name, from the numbers [V] of the closed surface's vertices."""
    faces, found = number[state.closed.faces], {}
    # Where the corners of a face differ, nothing is said.
    of_face = np.where((faces == faces[:, :1]).all(1), faces[:, 0], UNKNOWN).astype(np.uint8)
    for view in state.views:
        row, column = np.mgrid[0 : view.height : EVERY, 0 : view.width : EVERY] + 0.5 * EVERY
        away, face = state.caster.hits(view.center, view.rays(column.ravel(), row.ravel()))
        shown = np.where(np.isfinite(away), of_face[np.where(np.isfinite(away), face, 0)], UNKNOWN)
        wide = shown.reshape(row.shape).repeat(EVERY, 0).repeat(EVERY, 1)
        found[view.name] = wide[: view.height, : view.width].astype(np.uint8)
    return found
