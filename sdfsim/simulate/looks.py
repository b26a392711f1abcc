"""What bodies look like, wherever they are drawn: meshes with normals, colours, and the box that a first view shows."""

import colorsys
from dataclasses import replace
from itertools import cycle

import numpy as np

from sdfsim.geometry.mesh import Mesh, face_normals, lattice, vertex_normals
from sdfsim.geometry.primitives import plane
from sdfsim.physics import pose
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene
from sdfsim.sdf.closed_forms import ClosedForm
from sdfsim.shape.shape import Shape

STATIC_COLOR = (150, 150, 155)
HUES = 32  # number of colours for moving bodies
# Of bodies' paths, see `extent`: a body that leaves the scene must not shrink it to a dot.
FARTHEST, USUAL, BORDER = 1.0, 0.5, 0.8
ROOM = 2.5  # times the size of what is in it, at least, of a static body that counts as the room around
_CREASE = np.cos(np.radians(40.0))
_MOST_CORNER_PAIRS = 1_000_000  # with more (about 10,000 vertices) a mesh counts as smooth: splitting triples it


def body_colors(scene: Scene) -> list[tuple[int, ...]]:
    """An RGB colour (0 to 255) for every body, shown where its mesh has none: the scene's, else grey if it never moves,
    else one of `HUES`, in turn."""
    hues = map(_color, cycle(range(HUES)))
    usual = [STATIC_COLOR if body.motion == "static" else next(hues) for body in scene.bodies]
    return [body.color or color for body, color in zip(scene.bodies, usual, strict=True)]


def _color(number: int) -> tuple[int, ...]:
    """RGB (0 to 255); the hues of consecutive numbers are a golden angle apart."""
    rgb = colorsys.hsv_to_rgb((0.58 + number * 0.61803398875) % 1.0, 0.62, 0.9 if number % 2 == 0 else 0.75)
    return tuple(round(255 * c) for c in rgb)


def framed(scene: Scene, motion: Rollout | None = None) -> tuple[np.ndarray, float]:
    """Centre [3] m and radius m of a ball around `extent`."""
    low, high = extent(scene, motion)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def extent(scene: Scene, motion: Rollout | None = None) -> np.ndarray:
    """[2, 3] m: the lowest and highest coordinates that the first view must show.

    These are the bodies at the start, except planes and a room around all others; the points on planes below them, as
    free bodies fall there; and, if the motion is known, the bodies' paths up to `FARTHEST` times the size of all this,
    but of these only the middle `USUAL` of all places and a border of `BORDER` times its size: who rolls away from the
    others is not followed.
    """
    boxes: dict[int, np.ndarray] = {}
    planes = []
    for k, body in enumerate(scene.bodies):
        shape = scene.shapes[body.shape]
        if is_infinite(shape):
            planes.append((body.position, pose.rotate(body.quat_xyzw, np.array([0.0, 0.0, 1.0]))))
        elif len(shape.mesh.vertices):
            box = np.stack([shape.mesh.vertices.min(0), shape.mesh.vertices.max(0)]) * body.scale
            corners = np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3)
            boxes[k] = body.position + pose.rotate(body.quat_xyzw, corners)
    for k in [k for k in boxes if scene.bodies[k].motion == "static"]:
        others = [box for n, box in boxes.items() if n != k]
        if others and _surrounds(boxes[k], np.concatenate(others)):
            del boxes[k]
    if not boxes:
        return np.array([[-1.0] * 3, [1.0] * 3]) / np.sqrt(3.0)
    start = np.concatenate(list(boxes.values()))
    below = [start - ((start - at) @ normal)[:, None] * normal for at, normal in planes]
    shown = np.concatenate([start, *below])
    low, high = shown.min(0), shown.max(0)
    if motion is not None:
        moving, size = [k for k in boxes if scene.bodies[k].motion != "static"], FARTHEST * float((high - low).max())
        half = np.array([np.linalg.norm(np.ptp(boxes[k], axis=0)) / 2 for k in moving])[:, None]
        ways = np.clip(motion.position[:, moving], low - size, high + size)
        if moving:
            few = np.quantile(ways, [0.5 - USUAL / 2, 0.5 + USUAL / 2], axis=(0, 1))
            first, last = np.minimum(low, few[0]), np.maximum(high, few[1])
            border = BORDER * (last - first)
            ways = np.clip([ways - half, ways + half], first - border, last + border)
            low, high = np.minimum(low, ways.min((0, 1, 2))), np.maximum(high, ways.max((0, 1, 2)))
    return np.stack([low, high])


def _surrounds(box: np.ndarray, others: np.ndarray) -> bool:
    """Whether corners [8, 3] are of a room around other points [P, 3], much larger than what is in it."""
    within = (others.min(0) > box.min(0)).all() and (others.max(0) < box.max(0)).all()
    return bool(within and np.ptp(box, axis=0).max() > ROOM * np.ptp(others, axis=0).max())


def is_infinite(shape: Shape) -> bool:
    return not np.isfinite(shape.sdf.bounds).all()


def shown(scene: Scene, row: int, half: float) -> Mesh:
    """The mesh that is shown for a body, at scale 1; for a plane a square, `half` m to each side.

    A plane is shown where it collides, but lower where other scenery lies in it, such as a photographed floor in an
    infinite one: the two would flicker.
    """
    body = scene.bodies[row]
    shape = scene.shapes[body.shape]
    if not is_infinite(shape):
        return shape.shown
    most = 0.02 * framed(scene)[1]
    found = [np.zeros((0, 3))]
    for other in scene.bodies:
        of = scene.shapes[other.shape]
        if other.motion == "static" and not isinstance(of.sdf, ClosedForm):
            places = other.position + pose.rotate(other.quat_xyzw, of.shown.vertices * other.scale)
            places = pose.rotate(pose.conjugate(body.quat_xyzw), places - body.position)
            found.append(places[np.abs(places[:, 2]) < most])
    near = np.concatenate(found)
    if not len(near):
        return plane(half)
    lower = max(0.0, 0.05 * most - float(np.quantile(near[:, 2], 0.01)))
    low, high = near[:, :2].min(0), near[:, :2].max(0)
    # A square with a rectangular hole, and the lower part, which is larger than the hole so that no gap is visible.
    frame = lattice(*np.clip([[-half] * 2, low - most, high + most, [half] * 2], -half, half).T, [0.0])
    under = lattice(*np.stack([low - 2 * most, high + 2 * most], 1), [-lower])
    corner = np.array([4 * i + j for i in range(3) for j in range(3) if (i, j) != (1, 1)])
    quads = np.concatenate([corner[:, None] + [0, 4, 5, 1], [[16, 18, 19, 17]]])
    return Mesh(np.concatenate([frame, under]), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))


def with_normals(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The mesh with smooth normals [V, 3]; vertices are split along creases, so that boxes keep their edges."""
    welded, label = mesh, np.arange(len(mesh.vertices))
    if mesh.uv is not None:  # its vertices are doubled where the texture is cut, which is not a crease
        _, first, label = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
        label = label.reshape(-1)
        welded = Mesh(mesh.vertices[first], label[mesh.faces])
    normals = _corner_normals(welded)
    if normals is None:
        return mesh, vertex_normals(welded)[label]
    corners = mesh.faces.reshape(-1)
    if mesh.uv is not None:  # only as many vertices as creases need
        rows = np.column_stack([corners, np.round(normals, 4)])
        _, kept, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        kept, faces = corners[kept], place.reshape(-1, 3)
        split = np.empty((len(kept), 3))
        split[faces.reshape(-1)] = normals
        return replace(mesh, vertices=mesh.vertices[kept], faces=faces, colors=None, uv=mesh.uv[kept]), split
    colors = None if mesh.colors is None else mesh.colors[corners]
    return Mesh(mesh.vertices[corners], np.arange(len(corners)).reshape(-1, 3), colors), normals


def _corner_normals(mesh: Mesh) -> np.ndarray | None:
    """[3 F, 3] for every face corner the mean normal of the faces at its vertex that differ by less than the crease
    angle. None for a mesh that is fine enough to count as smooth."""
    owner = mesh.faces.reshape(-1)
    order = np.argsort(owner, kind="stable")
    valence = np.bincount(owner, minlength=len(mesh.vertices))
    if (valence**2).sum() > _MOST_CORNER_PAIRS:
        return None
    start = np.cumsum(valence) - valence
    repeats = valence[owner]
    first = np.repeat(np.arange(len(owner)), repeats)
    second = order[np.repeat(start[owner] - (np.cumsum(repeats) - repeats), repeats) + np.arange(repeats.sum())]
    unit, area = face_normals(mesh)
    near = (unit[first // 3] * unit[second // 3]).sum(1) >= _CREASE
    total = np.zeros((len(owner), 3))
    np.add.at(total, first[near], (area[:, None] * unit)[second[near] // 3])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
