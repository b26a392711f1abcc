"""Recognises meshes that are round solids up to their facets: spheres, cylinders, capsules, cones and rings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdfsim.geometry.mass import mass_properties
from sdfsim.geometry.mesh import Mesh, is_closed
from sdfsim.sdf.closed_forms import CapsuleSdf, ConeSdf, CylinderSdf, SphereSdf, TorusSdf, sizes_in_scene

OFF = 1e-3  # relative to the largest extent: how far a vertex may be from the round surface
FACET = 0.04  # relative to the least radius: how deep a facet may lie; with twelve around, 0.034
FEW = 64  # vertices that are looked at first


@dataclass(frozen=True)
class RoundForm:
    """A round solid in the frame of a mesh."""

    kind: Any  # "sphere", "cylinder", "capsule", "cone" or "torus"
    sizes: dict[str, Any]  # m, as `analytic_shape` takes them
    pose: np.ndarray  # [4, 4], of its own frame in the mesh's

    def __str__(self) -> str:
        sizes = ", ".join(f"{key} {value:.4g} m" for key, value in self.sizes.items())
        return f"its mesh is a {self.kind} up to its facets ({sizes}), and collides as one"


def round_form(mesh: Mesh) -> RoundForm | None:
    """The round solid that a closed mesh is, up to its facets; None if it is none. Its radius is that of the
    vertices."""
    if not is_closed(mesh):
        return None
    volume, com, inertia = mass_properties(mesh)
    if not volume > 0.0:
        return None
    for axis in (*np.eye(3)[::-1], *np.linalg.eigh(inertia)[1].T):
        side = np.eye(3)[np.argmin(np.abs(axis))]
        side = side - (side @ axis) * axis
        side /= np.linalg.norm(side)
        frame = np.stack([side, np.cross(axis, side), axis], axis=1)
        places = (mesh.vertices - com) @ frame
        low, high = places[:, 2].min(), places[:, 2].max()
        middle = 0.5 * (low + high)
        if middle < 0.0:  # the tip of a cone is far from its centre of mass
            turn = np.diag([1.0, -1.0, -1.0])
            frame, places, middle = frame @ turn, places @ turn, -middle
        for form in _fits(places, 0.5 * float(high - low)):
            up = 0.0 if isinstance(form, SphereSdf) else middle
            if _is(form, places - (0.0, 0.0, up), mesh.faces):
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = frame, com + up * frame[:, 2]
                return RoundForm(form.KIND, sizes_in_scene(form), pose)
    return None


def _fits(places: np.ndarray, half: float) -> Iterator[SphereSdf | CylinderSdf | ConeSdf | CapsuleSdf | TorusSdf]:
    """The solids about z that would have the extents of vertices [V, 3] m about their centre of mass."""
    radius = float(np.hypot(places[:, 0], places[:, 1]).max())
    yield SphereSdf(float(np.linalg.norm(places, axis=1).max()))
    yield CylinderSdf(radius, half)
    yield ConeSdf(radius, half)
    if half > radius:
        yield CapsuleSdf(radius, half - radius)
    if radius > 2.0 * half:
        yield TorusSdf(radius - half, half)


def _is(form: Any, places: np.ndarray, faces: np.ndarray) -> bool:
    """Whether vertices [V, 3] m lie on the surface of a round solid, and faces no farther from it than facets do."""
    off = OFF * float(np.ptp(places, axis=0).max())
    for some in (places[:: 1 + len(places) // FEW], places):
        if np.abs(form(some)[0]).max() > off:
            return False
    # A face from the end to the side of a cylinder or cone has its corners on the surface too, but is none of it.
    if not np.any([(part[faces] <= off).all(1) for part in _parts(form, places)], axis=0).all():
        return False
    corners = places[faces]
    middles = np.concatenate([corners.mean(1), *(0.5 * (corners[:, k] + corners[:, (k + 1) % 3]) for k in range(3))])
    least = form.tube if isinstance(form, TorusSdf) else form.radius
    return bool(np.abs(form(middles)[0]).max() <= FACET * least + off)


def _parts(form: Any, places: np.ndarray) -> list[np.ndarray]:
    """How far [V] m vertices are from each smooth part of the surface."""
    beyond, height = np.hypot(places[:, 0], places[:, 1]) - form.radius, places[:, 2]
    if isinstance(form, CylinderSdf):
        return [np.abs(beyond), np.abs(height - form.half), np.abs(height + form.half)]
    if isinstance(form, ConeSdf):
        across, up = 2.0 * form.half, form.radius
        return [np.abs(across * beyond + up * (height + form.half)) / np.hypot(across, up), np.abs(height + form.half)]
    return [np.zeros(len(places))]
