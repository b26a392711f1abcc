"""Shaded pictures of the zero level of an SDF, without a graphics card."""

from __future__ import annotations

from typing import Any

import numpy as np

from sdfsim.shape.far_field import BOX
from sdfsim.shape.mesh import Frame, Mesh
from sdfsim.shape.sdf import Sdf

# Fine enough for holes of a thirtieth of the extent to stay open.
CELLS = 128
CHUNK = 262_144
EYE = np.array([0.6, 1.6, 0.9])
LIGHT = np.array([1.3, 1.0, 1.6])
COLOUR = np.array([0.47, 0.62, 0.80])
# Faces seen from within, where the level is torn open.
WITHIN = np.array([0.85, 0.45, 0.25])


def level(sdf: Sdf, frame: Frame) -> Mesh:
    """The zero level by marching cubes on [-0.7, 0.7]^3 of the normalised frame; no faces where there is none.

    All values are computed: a network early in its training need not climb as a distance does.
    """
    from skimage.measure import marching_cubes

    axis = np.linspace(-BOX, BOX, CELLS + 1)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    field = [np.asarray(sdf(frame.outward(part).astype(np.float32))[0]) for part in _parts(points)]
    values = np.concatenate(field).reshape((CELLS + 1,) * 3) / frame.scale
    if not values.min() < 0 < values.max():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    vertices, faces, *_ = marching_cubes(values, 0.0, spacing=(2 * BOX / CELLS,) * 3, gradient_direction="ascent")
    return Mesh(frame.outward(vertices.astype(np.float64) - BOX), faces.astype(np.int64))


def shaded(mesh: Mesh, sdf: Sdf, frame: Frame, pixels: int) -> np.ndarray:
    """A picture [pixels, pixels, 3] in [0, 1] of `mesh` on white, seen obliquely from above without perspective.

    Normals are the gradients of `sdf`, so that its creases show sharper than triangles of a grid would have them; light
    comes from the left, and casts shadows, which tell a hole from a dent.
    """
    import open3d as o3d

    fine = 2 * pixels  # Four rays a pixel, for smooth outlines.
    image = np.ones((fine * fine, 3))
    if len(mesh.faces):
        scene: Any = o3d.t.geometry.RaycastingScene()
        vertices = frame.inward(mesh.vertices).astype(np.float32)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        eye, light = EYE / np.linalg.norm(EYE), LIGHT / np.linalg.norm(LIGHT)
        right = np.cross([0.0, 0.0, 1.0], eye)
        right /= np.linalg.norm(right)
        up = np.cross(eye, right)
        half = np.abs(np.stack([right, up]) @ _corners(sdf, frame).T).max() * 1.06
        across = (np.arange(fine) + 0.5) / fine * 2 * half - half
        places = np.stack(np.meshgrid(across, -across), axis=-1).reshape(-1, 2)
        origins = 3.0 * eye + places @ np.stack([right, up])
        rays = np.concatenate([origins, np.broadcast_to(-eye, origins.shape)], axis=1).astype(np.float32)
        answer = scene.cast_rays(o3d.core.Tensor(rays))
        depth = answer["t_hit"].numpy()
        hit = np.isfinite(depth)
        spots = origins[hit] - depth[hit, None] * eye
        flat = answer["primitive_normals"].numpy()[hit].astype(np.float64)
        normal = np.asarray(sdf(frame.outward(spots))[1])
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        within = (flat * eye).sum(1) * _turn(mesh) < 0
        normal = np.where(((normal * eye).sum(1) < 0)[:, None], -normal, normal)
        start = spots + 0.012 * normal
        towards = np.concatenate([start, np.broadcast_to(light, start.shape)], axis=1).astype(np.float32)
        lit = ~scene.test_occlusions(o3d.core.Tensor(towards)).numpy()
        bright = 0.2 + 0.18 * (normal @ eye) + 0.75 * lit * np.maximum(normal @ light, 0.0)
        image[hit] = np.clip(np.where(within[:, None], WITHIN, COLOUR) * bright[:, None] ** 0.8 * 1.15, 0, 1)
    return image.reshape(pixels, 2, pixels, 2, 3).mean((1, 3))


def _turn(mesh: Mesh) -> float:
    """1 where faces are wound outwards, -1 where inwards."""
    corners = mesh.vertices[mesh.faces]
    return float(np.sign(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) or 1.0


def _corners(sdf: Sdf, frame: Frame) -> np.ndarray:
    """[8, 3] of the solid's box, normalised; the same for every fit of a shape, so that pictures line up."""
    low, high = frame.inward(sdf.bounds)
    return np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)


def _parts(points: np.ndarray) -> list[np.ndarray]:
    return [points[start : start + CHUNK] for start in range(0, len(points), CHUNK)]
