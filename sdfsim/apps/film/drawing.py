"""What a body covers of a picture: the synthesis of tracking."""

from __future__ import annotations

import math
from copy import copy
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from sdfsim.apps.film.eye import Eye
from sdfsim.base.compiling import cache_of, kept
from sdfsim.geometry.mesh import Mesh, area_vectors
from sdfsim.physics import pose
from sdfsim.scene.scene import Body, Scene
from sdfsim.sdf.closed_forms import SphereSdf
from sdfsim.shape.shape import Shape

SAMPLES, LINES = 4, 8  # places along a side of a pixel, and lines in it
EVEN = 0.02  # radii by which a turned body that looks alike may differ
SPOTTED = 8.0  # levels, of a paint that is not even
HOVERS, UPRIGHT = 0.1, 0.99  # radii above what a body lies on; cosine between an axis and its normal
FACES, LARGE = 8, 0.05  # most parts with a colour of their own; least share of the surface of one


class Window(NamedTuple):
    """A part of a picture, px."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def rows(self) -> slice:
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        return slice(self.left, self.right)


class Look:
    """A body as it covers pictures: its outline, and flat faces, which differ in brightness."""

    def __init__(self, scene: Scene, body: Body) -> None:
        shape = scene.shapes[body.shape]
        self.name, self.support = body.name, body.motion != "dynamic"
        self.com = body.scale * shape.com
        self.ball = shape.sdf.radius * body.scale if isinstance(shape.sdf, SphereSdf) else 0.0
        vertices = body.scale * (shape.mesh.vertices - shape.com)
        self.corners = vertices[:: max(1, len(vertices) // 500)]
        self.radius = self.ball or float(np.linalg.norm(vertices, axis=1).max())
        self.axis = None if self.ball else _axis_of(shape)
        # normal [3] of the surface on which it lies, so that it only slides and turns there; where it lay at first
        self.normal: np.ndarray | None = None
        self.seat, self.turn = np.zeros(3), np.zeros(4)
        self.parts, self.round, self.faces = 1, True, []
        if not self.ball:
            self.part = _parts(Mesh(vertices, shape.mesh.faces))
            self.vertices, self.mesh_faces, self.faces = vertices, shape.mesh.faces.astype(np.int64), []
            self.normals, self.heights = _planes(vertices, shape.mesh.faces, self.part)
            if (
                (self.part.min() == 0)
                and (vertices @ self.normals.T <= self.heights + 1e-3 * self.radius).all()
                and len(self.normals) > 3
            ):
                self.faces = [np.unique(shape.mesh.faces[self.part == k]) for k in range(int(self.part.max()) + 1)]
            self.parts, self.round = int(self.part.max()) + 1, bool((self.part == 0).sum() > 2)
            area = area_vectors(vertices[shape.mesh.faces]) * (self.part == 0)[:, None]
            self.bent = area / np.maximum(np.linalg.norm(area, axis=1), 1e-20)[:, None]  # normals of what is round
            self.spots = _spots(shape.mesh, self.part)
            if self.spots.shape[1]:  # which show how it is turned
                self.axis, self.faces = None, []

    @property
    def ways(self) -> int:
        """How many of the six ways to move it pictures show: not a ball's rotation, nor a cup's about its axis."""
        if self.normal is not None:
            axis = None if self.axis is None else pose.rotate(self.turn, self.axis)
            return 2 if axis is not None and abs(axis @ self.normal) > UPRIGHT else 3
        return 3 if self.ball else 6 if self.axis is None else 5

    @property
    def shifts(self) -> int:
        """How many of these ways are shifts."""
        return 3 if self.normal is None else 2

    def lying(self, scene: Scene, body: Body) -> Look | None:
        """The body as it lies where the scene has it; None if it lies on nothing that stays, or is a ball."""
        place = body.position + pose.rotate(body.quat_xyzw, self.com)
        points, below = pose.rotate(body.quat_xyzw, self.corners) + place, []
        for other in scene.bodies:
            if other.motion != "dynamic":
                turn = pose.conjugate(other.quat_xyzw)
                far, slope = scene.shapes[other.shape].sdf(pose.rotate(turn, points - other.position) / other.scale)
                least = int(np.argmin(far))
                below.append((other.scale * float(far[least]), pose.rotate(other.quat_xyzw, slope[least]), other))
        gap, normal, on = min(below, key=lambda one: abs(one[0]), default=(np.inf, place, body))
        if self.ball or abs(gap) > HOVERS * self.radius or on.motion != "static" or normal @ scene.gravity >= 0.0:
            return None
        same = copy(self)
        same.normal, same.seat, same.turn = normal, place - gap * normal, body.quat_xyzw
        return same

    def laid(self, eye: Eye, place: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pose in which a lying body is seen in the same place of the picture, turned alike; else the same pose."""
        if self.normal is None:
            return place, turn
        camera = -eye.rotation.T @ eye.translation
        share = (self.normal @ (self.seat - camera)) / (self.normal @ (place - camera))
        by = pose.multiply(turn, pose.conjugate(self.turn))
        twist = np.r_[self.normal * (self.normal @ by[:3]), by[3]]
        length = np.linalg.norm(twist)
        turned = pose.multiply(twist / length, self.turn) if length > 1e-6 else self.turn
        return (camera + share * (place - camera) if share > 0.0 else place), turned

    def window(self, eye: Eye, place: np.ndarray, turn: np.ndarray, margin: float) -> Window | None:
        """The part of the picture that holds it; None if it is behind the camera or outside."""
        depth = float(eye.seen(place)[2])
        if depth < 1.5 * self.radius:
            return None
        if self.ball:
            centre, reach = eye.project(place), eye.focal * self.ball / (depth - self.ball) + margin
            low, high = centre - reach, centre + reach
        else:
            at = eye.project(pose.rotate(turn, self.corners) + place)
            low, high = at.min(0) - margin, at.max(0) + margin
        size = np.array([eye.width, eye.height])
        low, high = np.clip(np.floor(low), 0, size).astype(int), np.clip(np.ceil(high), 0, size).astype(int)
        return Window(*low.tolist(), *high.tolist()) if (high - low > 2).all() else None

    def cover(self, eye: Eye, place: np.ndarray, turn: np.ndarray, at: Window) -> np.ndarray:
        """[parts, h, w] float32: the share of each pixel that a part of it covers. `place`: its centre of mass."""
        return self.patterns(eye, place, turn, at)[: self.parts]

    def patterns(self, eye: Eye, place: np.ndarray, turn: np.ndarray, at: Window) -> np.ndarray:
        """[basis, h, w] float32, of which its brightness is made: the cover of its parts; if it is round, that of the
        first times the normal there [3], as what is matt is lit (Lambert); and if it is painted, how much brighter it
        is there than its part."""
        if self.ball:
            x, y = np.arange(at.left, at.right) + 0.5, np.arange(at.top, at.bottom)[:, None] + 0.5
            ray = eye.rays(x, y)
            centre = eye.seen(place)
            length = np.linalg.norm(ray, axis=-1)
            along = ray @ centre / length
            aside = np.sqrt(np.maximum(centre @ centre - along**2, 0.0))
            inside = (self.ball - aside) / along * eye.focal * length
            full = np.clip(inside + 0.5, 0.0, 1.0)
            deep = along - np.sqrt(np.maximum(self.ball**2 - aside**2, 0.0))
            normal = np.moveaxis(ray * (deep / length)[..., None] - centre, -1, 0) / self.ball
            return np.concatenate([full[None], full * normal]).astype(np.float32)
        high, wide = at.bottom - at.top, at.right - at.left
        if self.faces:
            seen = eye.seen(pose.rotate(turn, self.vertices) + place)
            away = pose.rotate(
                pose.conjugate(turn), -eye.rotation.T @ eye.translation - place
            )  # the camera, shape axes
            pixel = eye.focal * seen[:, :2] / seen[:, 2:] + eye.middle - (at.left, at.top)
            found = np.zeros((self.parts, high, wide), np.float32)
            for k, rows in enumerate(self.faces):
                if self.normals[k] @ away > self.heights[k]:
                    found[k] = _covered(
                        cv2.convexHull(pixel[rows].astype(np.float32))[:, 0].astype(np.float64), high, wide
                    )
            return found
        seen = eye.seen(pose.rotate(turn, self.vertices) + place)
        pixel = eye.focal * seen[:, :2] / seen[:, 2:] + eye.middle - (at.left, at.top)
        bent = (pose.rotate(turn, self.bent) @ eye.rotation.T)[:, : 3 * self.round]
        each = np.concatenate([bent, self.spots], 1)
        return _drawn(np.c_[pixel, 1.0 / seen[:, 2]], self.mesh_faces, self.part, self.parts, each, high, wide)


with kept(cache_of([Path(__file__)])):

    @njit(cache=True)
    def _covered(around, high, wide):
        """[high, wide] the share of each pixel that a convex polygon [N, 2] px covers: of lines in it, exactly."""
        found = np.zeros((high, wide), np.float32)
        low, top = around[:, 1].min(), around[:, 1].max()
        for line in range(high * LINES):
            begin, end = max(line / LINES, low), min((line + 1) / LINES, top)
            if end <= begin:
                continue
            y, left, right = 0.5 * (begin + end), np.inf, -np.inf
            for k in range(len(around)):
                (ax, ay), (bx, by) = around[k - 1], around[k]
                if min(ay, by) <= y <= max(ay, by) and ay != by:
                    x = ax + (y - ay) / (by - ay) * (bx - ax)
                    left, right = min(left, x), max(right, x)
            for i in range(max(0, math.floor(left)), min(wide, math.ceil(right))):
                found[line // LINES, i] += (end - begin) * (min(right, i + 1) - max(left, i))
        return found

    @njit(cache=True)
    def _drawn(corners, faces, part, parts, each, high, wide):
        """[parts + K, high, wide] the share of each pixel that parts of a mesh cover: of samples in it, by what is
        nearest; and the sum there of `each` [F, K]. `corners` [V, 3]: px, and one over the depth."""
        near = np.zeros((SAMPLES * high, SAMPLES * wide))
        which = np.full(near.shape, -1)
        for f in range(len(faces)):
            (ax, ay, a), (bx, by, b), (cx, cy, c) = corners[faces[f, 0]], corners[faces[f, 1]], corners[faces[f, 2]]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if area >= 0.0:  # it looks away
                continue
            across = ((b - a) * (cy - ay) - (c - a) * (by - ay)) / area  # of 1 / depth, which is linear in a picture
            down = ((c - a) * (bx - ax) - (b - a) * (cx - ax)) / area
            low, top = min(ay, by, cy) * SAMPLES - 0.5, max(ay, by, cy) * SAMPLES - 0.5
            for i in range(max(0, math.ceil(low)), min(SAMPLES * high - 1, math.floor(top)) + 1):
                y, left, right = (i + 0.5) / SAMPLES, np.inf, -np.inf
                for px, py, qx, qy in ((ax, ay, bx, by), (bx, by, cx, cy), (cx, cy, ax, ay)):
                    if min(py, qy) <= y <= max(py, qy) and py != qy:
                        x = px + (y - py) / (qy - py) * (qx - px)
                        left, right = min(left, x), max(right, x)
                if right < left:
                    continue
                first, last = math.ceil(left * SAMPLES - 0.5), math.floor(right * SAMPLES - 0.5)
                for j in range(max(0, first), min(SAMPLES * wide - 1, last) + 1):
                    nearness = a + across * ((j + 0.5) / SAMPLES - ax) + down * (y - ay)
                    if nearness > near[i, j]:
                        near[i, j], which[i, j] = nearness, f
        found = np.zeros((parts + each.shape[1], high, wide), np.float32)
        for i in range(SAMPLES * high):
            for j in range(SAMPLES * wide):
                f = which[i, j]
                if f >= 0:
                    found[part[f], i // SAMPLES, j // SAMPLES] += 1.0 / SAMPLES**2
                    for k in range(each.shape[1]):
                        found[parts + k, i // SAMPLES, j // SAMPLES] += each[f, k] / SAMPLES**2
        return found


def _axis_of(shape: Shape) -> np.ndarray | None:
    """[3] the axis about which a shape looks alike however it is turned; None if there is none."""
    moments, axes = np.linalg.eigh(shape.inertia)
    odd = 0 if abs(moments[2] - moments[1]) < abs(moments[1] - moments[0]) else 2
    points = shape.mesh.vertices[:: max(1, len(shape.mesh.vertices) // 500)] - shape.com
    for angle in (0.4, 1.1, 2.3):
        turned = pose.rotate(pose.from_rotvec(angle * axes[:, odd]), points) + shape.com
        if np.abs(shape.sdf(turned)[0]).max() > EVEN * np.linalg.norm(points, axis=1).max():
            return None
    return axes[:, odd]


def _spots(mesh: Mesh, part: np.ndarray) -> np.ndarray:
    """[F, 1] how much brighter each face is than its part, in hundreds of levels; [F, 0] if it is of even colour."""
    if mesh.colors is None:
        return np.zeros((len(mesh.faces), 0))
    light = mesh.colors.mean(1)[mesh.faces].mean(1)
    size = np.linalg.norm(area_vectors(mesh.vertices[mesh.faces]), axis=1)
    off = light - (np.bincount(part, size * light) / np.maximum(np.bincount(part, size), 1e-20))[part]
    return (off / 100.0)[:, None][:, : int(np.sqrt(size @ off**2 / size.sum()) > SPOTTED)]


def _planes(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean normals [parts, 3] and heights [parts] of the parts of a surface."""
    area = area_vectors(vertices[faces])
    normal = np.stack([area[part == k].sum(0) for k in range(part.max() + 1)])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-20)[:, None]
    return normal, np.array([(vertices[faces[part == k, 0]] @ normal[k]).mean() for k in range(part.max() + 1)])


def _parts(mesh: Mesh) -> np.ndarray:
    """[F] numbers of flat faces; 0: all that is not flat."""
    area = area_vectors(mesh.vertices[mesh.faces])
    size = np.linalg.norm(area, axis=1)
    normal = area / np.maximum(size, 1e-20)[:, None]
    reach = np.abs(mesh.vertices).max()
    height = (normal * mesh.vertices[mesh.faces[:, 0]]).sum(1) / reach
    keys, group = np.unique(np.round(np.c_[normal, height], 1) + 0.0, axis=0, return_inverse=True)
    share = np.bincount(group.ravel(), size) / size.sum()
    large = np.argsort(-share)[:FACES]
    large = large[share[large] > LARGE]
    number = np.zeros(len(keys), int)
    number[large] = np.arange(len(large)) + (1 if share[large].sum() < 0.999 else 0)
    return number[group.ravel()]
