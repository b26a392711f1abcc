"""What photos of a thing in one of two states tell of the part that moves: where they see through, what on it looks
like what, and which pixels show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import KDTree

from pipeline.cameras import Similarity, View, load_poses
from pipeline.field.training import load_field
from pipeline.inputs.labels import UNKNOWN
from pipeline.mesh.joint import FoundJoint
from pipeline.mesh.meshing import read_parts
from pipeline.mesh.placement import load_placement
from pipeline.mesh.visibility import framed
from sdfsim.geometry.bvh import Caster, ClosestPoint
from sdfsim.geometry.mesh import Mesh, joined
from sdfsim.geometry.mesh_io import read_mesh

THROUGH = 2  # photos that look through a place where nothing is
CELLS = 3.0  # of the field's finest grid: what differs by less between two states stands still
ASKED = 24  # photos of a state at most in which alike places are looked for
FEATURES, DISTINCT = 3000, 0.8  # of a photo; how much nearer than the next a match has to be
LIKELIER = 0.4  # of the way: a surface that is so much nearer to the other state's once it is moved does move
BESIDE = 2.0  # times what counts as still: so near to the part's points what moves with it is
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


def load_state(folder: Path, world: Similarity | None = None) -> tuple[State, Similarity]:
    """The state that a folder of the mesh stage holds, in metres of its own, or as `world` moves the world of the
    poses; and what moves that world so."""
    trained, place = load_field(folder / "distill"), load_placement(folder / "mesh").to_metres
    own = place.after(trained.to_unit)
    world = world or own
    move = world.after(own.inverse())
    known = read_parts(folder / "mesh")
    files = [*(["solid.ply"] if known["scenery"] else []), *(f"objects/{one['name']}.ply" for one in known["objects"])]

    def moved(mesh: Mesh) -> Mesh:
        return Mesh(move.points(mesh.vertices), mesh.faces)

    visible = moved(read_mesh(folder / "mesh" / "mesh.ply"))
    closed = moved(joined([read_mesh(folder / "mesh" / file) for file in files]))
    to_unit = world.after(trained.to_unit.inverse())
    views = load_poses(folder / "poses").moved(world).views
    middle, radius = to_unit.points(np.zeros((1, 3)))[0], to_unit.scale
    return State(visible, closed, views, folder / "photos", known["cell"] * move.scale, middle, 0.97 * radius), world


@dataclass(frozen=True)
class Landmarks:
    """Features of photos on a surface."""

    points: list[np.ndarray]  # by photo [K, 3]
    looks: list[np.ndarray]  # by photo [K, 128] float32


def landmarks(state: State, part: np.ndarray) -> Landmarks:
    """Features near some points [P, 3] of the surface in the photos that have most of them (SIFT, Lowe 2004)."""
    import cv2

    finder, tree = cv2.SIFT.create(FEATURES, contrastThreshold=0.01), KDTree(part)
    points, looks = [], []
    shows = [int(framed(view, part)[1].sum()) for view in state.views]
    for number in np.argsort(shows)[::-1][:ASKED]:
        view = state.views[number]
        with Image.open(state.photos / "images" / view.name) as image:
            grey = np.asarray(image.convert("L"))
        keys, found = finder.detectAndCompute(grey, None)
        if not keys:
            continue
        pixels = np.array([key.pt for key in keys]) + 0.5
        rays = view.rays(pixels[:, 0], pixels[:, 1])
        away = state.caster.hits(view.center, rays)[0]
        there = view.center + np.where(np.isfinite(away), away, 0.0)[:, None] * rays
        kept = np.isfinite(away) & (tree.query(there)[0] < CELLS * state.cell)
        if kept.sum() >= 2:
            points.append(there[kept])
            looks.append(found[kept])
    return Landmarks(points, looks)


def alike(one: State, other: State) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """What gives places [K, 3] that look alike, of points [P, 3] that move in the first and in the second state; some
    of them are wrong."""

    def paired(part: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        nothing = np.zeros((0, 3))
        if not len(part) or not len(there):
            return nothing, nothing
        first, second = landmarks(one, part), landmarks(other, there)
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        here, over = [nothing], [nothing]
        for points, looks in zip(first.points, first.looks, strict=True):
            for theirs, faces in zip(second.points, second.looks, strict=True):
                close = [pair[0] for pair in matcher.knnMatch(looks, faces, 2)
                         if len(pair) == 2 and pair[0].distance < DISTINCT * pair[1].distance]  # fmt: skip
                here.append(points[[match.queryIdx for match in close]])
                over.append(theirs[[match.trainIdx for match in close]])
        return np.concatenate(here), np.concatenate(over)

    return paired


def which_move(mesh: Mesh, other: State, motion: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """[V] uint8, of the vertices of one state's surface: 1 for those that a motion [4, 4] takes to the other state, 0
    for those that stay, `UNKNOWN` where nothing tells. `seen` [P, 3] are points of the part."""
    near, points = CELLS * other.cell, mesh.vertices
    moved = points @ motion[:3, :3].T + motion[:3, 3]
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


def part_of(found: FoundJoint, first: bool) -> tuple[np.ndarray, np.ndarray]:
    """The motion [4, 4] to the other state, from the first or from the second, and points [P, 3] of the part there."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = found.turn, found.shift
    return (motion, found.seen[0]) if first else (np.linalg.inv(motion), found.seen[1])
