"""Evidence from photos of an object in two states on the part that moves: where photos see through, which features look
alike, and which pixels show the part."""

from collections.abc import Sequence
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
from pipeline.mesh.meshing import closed_files, read_parts
from pipeline.mesh.placement import load_placement
from pipeline.mesh.visibility import framed
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.geometry.bvh import Caster, ClosestPoint
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import read_mesh

THROUGH = 2  # photos that have to look through an empty place
CELLS = 3.0  # of the field's finest grid: surfaces that differ by less between two states are static
ASKED, SPREAD = 24, 15  # largest numbers of photos of a state for matching, on the part and elsewhere
FEATURES, DISTINCT = 2000, 0.8  # per photo; how much nearer than the next a match has to be
LIKELIER = 0.4  # of the distance: a surface moves if the motion brings it so much nearer to the other state's
BESIDE = 2.0  # times the limit of static: how near to the part's points its vertices lie
TIED, REFINED = 50, 3  # patches that have to look alike in both states; rounds of least squares on all of them
INNER = 0.97  # of the ball in which a field was trained
EVERY = 2  # px between rays that find the content of a photo


@dataclass(frozen=True)
class State:
    """One state of an object, in a frame that both states share."""

    visible: Mesh  # the surface that photos show
    closed: Mesh  # the whole surface, for occlusion
    views: Sequence[View]
    photos: Path  # folder of the photos stage
    cell: float  # width of the field's cells
    middle: np.ndarray  # [3] of the ball in which the field was trained
    radius: float

    def moved(self, move: Similarity) -> "State":
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
        """[P] bool, places [P, 3] through which photos see the surface behind."""
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
    """The state in a folder of the mesh stage, in its own metres."""
    trained, place = load_field(folder / "distill"), load_placement(folder / "mesh").to_metres
    visible = read_mesh(folder / "mesh" / "mesh.ply")
    closed = joined([read_mesh(file) for file in closed_files(folder / "mesh").values()])
    views = load_poses(folder / "poses").moved(place.after(trained.to_unit)).views
    middle, radius = place.translation, INNER * place.scale
    return State(visible, closed, views, folder / "photos", read_parts(folder / "mesh")["cell"], middle, radius)


@dataclass(frozen=True)
class Landmarks:
    """Features of photos on a surface."""

    points: list[np.ndarray]  # by photo [K, 3]
    looks: list[np.ndarray]  # by photo [K, 128] float32


def landmarks(state: State, part: np.ndarray | None = None) -> Landmarks:
    """Features (SIFT, Lowe 2004) on the surface in photos from all sides, or near points [P, 3] of it in the photos
    that show most of these."""
    import cv2

    finder, tree = cv2.SIFT.create(FEATURES, contrastThreshold=0.01), None if part is None else KDTree(part)
    points, looks = [], []
    if part is None:
        chosen = np.unique(np.linspace(0, len(state.views) - 1, SPREAD).astype(int))  # people walk around an object
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
    """Points [K, 3] of the first and of the second that look alike in two photos; some pairs are wrong."""
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


def alike(one: State, other: State, part: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [K, 3] that look alike, near points [P, 3] that move in the first and in the second state; some pairs are
    wrong."""
    if not len(part) or not len(there):
        return np.zeros((0, 3)), np.zeros((0, 3))
    return matched(landmarks(one, part), landmarks(other, there))


def tie(state: State, onto: State) -> tuple[Similarity, int]:
    """The similarity that moves a state onto another where they look alike, and the number of places that agree with
    it. Each patch of the surface has one vote, however many features it has. Raises SdfsimError (exit code 3) if too
    few agree."""
    return tied(*matched(landmarks(state), landmarks(onto)), CELLS * state.cell, CELLS * onto.cell)


def tied(here: np.ndarray, there: np.ndarray, near: float, near_there: float) -> tuple[Similarity, int]:
    """The similarity that most pairs of points [K, 3] agree on (some pairs are wrong or have moved), and the number of
    patches, `near` in width, with such pairs; their error is at most `near_there`."""
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
    for _ in range(REFINED):  # with all pairs, keeping those that are near
        moved = move.scale * here @ move.rotation.matrix().T + move.translation
        good = np.linalg.norm(moved - there, axis=1) < near_there / 2
        move = pycolmap.estimate_sim3d(here[good], there[good])
    return Similarity(float(move.scale), move.rotation.matrix(), np.asarray(move.translation)), patches


def which_move(mesh: Mesh, other: State, motion: Similarity, seen: np.ndarray) -> np.ndarray:
    """[V] uint8 for the vertices of one state's surface: 1 for those that a motion takes to the other state, 0 for
    those that stay, `UNKNOWN` without evidence. `seen` [P, 3] are points of the part."""
    near, points = CELLS * other.cell, mesh.vertices
    moved = motion.points(points)
    on = ClosestPoint(other.visible)
    stays, goes = (np.linalg.norm(on(at)[0] - at, axis=1) for at in (points, moved))
    beside = KDTree(seen).query(points)[0]
    may = beside < 2.0 * float(np.linalg.norm(np.ptp(seen, axis=0)))
    empty, empty_moved = np.zeros(len(points), bool), np.zeros(len(points), bool)
    empty[may], empty_moved[may] = other.empty(points[may]), other.empty(moved[may])
    gone, nowhere = empty & (stays > near), empty_moved & (goes > near)
    # Vertices that move to where no photo looks may belong to the part, even if they cross a surface of the other
    # state.
    unsure = ~empty_moved & (goes > near) & (beside < BESIDE * near)
    result = np.full(len(points), UNKNOWN, np.uint8)
    result[~may | nowhere | ((stays <= near) & (goes > LIKELIER * stays) & ~unsure)] = 0
    likelier = (goes < LIKELIER * stays) & (goes < near) & (beside < BESIDE * near)
    result[may & ~nowhere & ((gone & (beside < 2.0 * BESIDE * near)) | likelier)] = 1
    return result


def label_images(state: State, number: np.ndarray) -> dict[str, np.ndarray]:
    """Label images [H, W] uint8 by photo name, from the numbers [V] of the closed surface's vertices."""
    faces, found = number[state.closed.faces], {}
    # A face with different corners is unknown.
    of_face = np.where((faces == faces[:, :1]).all(1), faces[:, 0], UNKNOWN).astype(np.uint8)
    for view in state.views:
        row, column = np.mgrid[0 : view.height : EVERY, 0 : view.width : EVERY] + 0.5 * EVERY
        away, face = state.caster.hits(view.center, view.rays(column.ravel(), row.ravel()))
        shown = np.where(np.isfinite(away), of_face[np.where(np.isfinite(away), face, 0)], UNKNOWN)
        wide = shown.reshape(row.shape).repeat(EVERY, 0).repeat(EVERY, 1)
        found[view.name] = wide[: view.height, : view.width].astype(np.uint8)
    return found
