"""What a body covers of a picture: the synthesis of tracking."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from sdfsim.apps.film.eye import Eye
from sdfsim.base.compiling import cache_of, kept
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, area_vectors
from sdfsim.physics import pose
from sdfsim.scene.scene import Body, Scene
from sdfsim.sdf.closed_forms import SphereSdf

SAMPLES, LINES = 2, 8  # rays a side of a pixel, and lines
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
        self.parts, self.round, self.faces = 1, True, []
        if not self.ball:
            self.caster = Caster(Mesh(vertices, shape.mesh.faces))
            self.part = _parts(Mesh(vertices, shape.mesh.faces))
            self.vertices, self.faces = vertices, []
            self.normals, self.heights = _planes(vertices, shape.mesh.faces, self.part)
            if (
                (self.part.min() == 0)
                and (vertices @ self.normals.T <= self.heights + 1e-3 * self.radius).all()
                and len(self.normals) > 3
            ):
                self.faces = [np.unique(shape.mesh.faces[self.part == k]) for k in range(int(self.part.max()) + 1)]
            self.parts, self.round = int(self.part.max()) + 1, bool((self.part == 0).sum() > 2)

    @property
    def ways(self) -> int:
        """How many of the six ways to move it pictures show: a ball's rotation is unseen."""
        return 3 if self.ball else 6

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
        if self.ball:
            x, y = np.arange(at.left, at.right) + 0.5, np.arange(at.top, at.bottom)[:, None] + 0.5
            ray = eye.rays(x, y)
            centre = eye.seen(place)
            length = np.linalg.norm(ray, axis=-1)
            along = ray @ centre / length
            aside = np.sqrt(np.maximum(centre @ centre - along**2, 0.0))
            inside = (self.ball - aside) / along * eye.focal * length
            return np.clip(inside + 0.5, 0.0, 1.0)[None].astype(np.float32)
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
        x = at.left + (np.arange(SAMPLES * wide) + 0.5) / SAMPLES
        y = at.top + (np.arange(SAMPLES * high) + 0.5)[:, None] / SAMPLES
        into = pose.to_matrix(turn).T
        rays = np.empty((SAMPLES * high, SAMPLES * wide, 6), np.float32)
        rays[..., :3] = into @ (-eye.rotation.T @ eye.translation - place)
        rays[..., 3:] = eye.rays(x, y) @ (eye.rotation @ into.T)
        away, face, _ = self.caster.cast(rays.reshape(-1, 6))
        part = np.where(np.isfinite(away), self.part[np.minimum(face, len(self.part) - 1)], -1)
        part = part.reshape(high, SAMPLES, wide, SAMPLES)
        return np.stack([(part == k).mean((1, 3)) for k in range(self.parts)]).astype(np.float32)


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
