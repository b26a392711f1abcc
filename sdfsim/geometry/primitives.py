"""Procedural watertight meshes, metres, about 1 m wide by default, and the convex pieces of those that have them."""

from collections.abc import Callable

import numpy as np

from sdfsim.geometry.mesh import Mesh, clean, convex_hull, lattice

BOWL_WALL = 0.12  # wall of the bowl, relative to its outer radius
PACKED = 0.6  # part of a space that packed balls fill


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Mesh:
    """A box with full extents `size` m: 8 vertices, 12 faces."""
    corners = lattice([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return clean(Mesh(corners * np.array(size), _quads(quads)))


def sphere(radius: float = 0.5, subdivisions: int = 3) -> Mesh:
    """An icosphere: 20 * 4^subdivisions faces, vertices on the sphere of `radius` m."""
    golden = (1.0 + 5.0**0.5) / 2.0
    vertices = np.array([[0, a, b * golden] for a in (-1, 1) for b in (-1, 1)], dtype=np.float64)
    solid = convex_hull(np.concatenate([np.roll(vertices, turn, axis=1) for turn in range(3)]))
    corners = solid.vertices[solid.faces]
    for _ in range(subdivisions):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
        corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    corners *= radius / np.linalg.norm(corners, axis=2, keepdims=True)
    return clean(Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))


def cylinder(radius: float = 0.5, height: float = 1.0, segments: int = 64) -> Mesh:
    """A cylinder along z, its middle at the origin."""
    profile = np.array([[0, -height / 2], [radius, -height / 2], [radius, height / 2], [0, height / 2]])
    return revolve(profile, segments)


def cone(radius: float = 0.5, height: float = 1.0, segments: int = 64) -> Mesh:
    """A cone along z, apex up, the middle of its height at the origin."""
    return revolve(np.array([[0, -height / 2], [radius, -height / 2], [0, height / 2]]), segments)


def torus(major: float = 0.35, minor: float = 0.15, segments: int = 64, sides: int = 32) -> Mesh:
    """A ring about z: circles of radius `minor` m around a circle of radius `major` m."""
    return _tube(_torus_rings(major, minor, segments, sides))


def tube(outer: float, inner: float, height: float, segments: int = 64) -> Mesh:
    """A tube about z of radii `outer` and `inner` m."""
    turn = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return sleeve(outer * circle, inner * circle, height)


def gear() -> Mesh:
    """A spur gear about z: 12 teeth of 0.1 m, 0.2 m thick, with a bore of radius 0.12 m."""
    return sleeve(*_gear_outline(), 0.2)


def sleeve(outer: np.ndarray, inner: np.ndarray, height: float) -> Mesh:
    """The solid between two outlines [K, 2] m, counter-clockwise, from -height / 2 to height / 2 m."""
    count = len(outer)
    layers = [np.column_stack([line, np.full(count, z)]) for z in (-height / 2, height / 2) for line in (outer, inner)]
    this, following = np.arange(count), (np.arange(count) + 1) % count
    low_out, low_in, high_out, high_in = (count * layer for layer in range(4))
    quads = [
        np.stack([a + this, a + following, b + following, b + this], axis=1)
        for a, b in ((low_out, high_out), (high_out, high_in), (high_in, low_in), (low_in, low_out))
    ]
    return clean(Mesh(np.concatenate(layers), _quads(np.concatenate(quads))))


def torus_knot() -> Mesh:
    """A tube of radius 0.06 m along a (2, 3) torus knot."""
    return _tube(_knot_rings(192, 24))


def bowl(radius: float = 0.5, wall: float = 0.5 * BOWL_WALL) -> Mesh:
    """Half of a spherical shell about the origin, of outer `radius` m and `wall` m thick, open at the top (+z)."""
    outer, inner = _bowl_profiles(radius, wall, 16)
    return revolve(np.concatenate([outer, inner[::-1]]), 64)


def bowl_radii(count: int, ball: float) -> tuple[float, float]:
    """Inner and outer radius, m, of a bowl with twice the volume that `count` packed balls of diameter `ball` m
    take."""
    inner = ball * (2.0 * count / (4 * PACKED)) ** (1 / 3)
    return inner, inner / (1 - BOWL_WALL)


def shoe() -> Mesh:
    """A clog of 1 m: a long rounded body with a flat sole and a deep opening over the heel, toe along +x."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-0.58, 0.58, 72)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    # The body gets thinner towards the toe, and so do its cavity and its height.
    reach = np.clip((x + 0.3) / 0.6, 0.0, 1.0)
    thickness = 0.2 - 0.07 * reach
    along = np.maximum(np.abs(x) - 0.3, 0.0)
    body = np.sqrt(along**2 + y**2 + (1.15 * z) ** 2) - thickness
    body = np.maximum(body, -0.12 - z)
    cavity = np.sqrt(np.maximum(np.abs(x + 0.02) - 0.26, 0.0) ** 2 + y**2 + (1.15 * (z - 0.02)) ** 2) - thickness + 0.06
    cavity = np.maximum(cavity, -0.06 - z)
    opening = np.sqrt(np.maximum(np.abs(x + 0.22) - 0.08, 0.0) ** 2 + y**2) - 0.12
    opening = np.maximum(opening, -z)
    field = np.maximum(body, -np.minimum(cavity, opening))
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(axis[1] - axis[0],) * 3)
    vertices = vertices.astype(np.float64) + axis[0]
    return clean(Mesh(vertices * (1.0 / np.ptp(vertices[:, 0])), faces.astype(np.int64)))


PRIMITIVES: dict[str, Callable[..., Mesh]] = {
    make.__name__: make for make in (box, sphere, cylinder, cone, torus, gear, torus_knot, bowl, shoe)
}


def spiral(count: int) -> np.ndarray:
    """Points [count, 3] spread evenly over the unit sphere: a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)


def plane(half: float) -> Mesh:
    """A square at z = 0 that faces up, `half` m to each side."""
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def convex_pieces(kind: str) -> list[Mesh]:
    """Convex pieces whose union is (close to) the default mesh of a primitive, or a table of 1 x 0.7 x 0.7 m ("table");
    an empty list for "shoe" and unknown names."""
    if kind in ("box", "sphere", "cylinder", "cone"):
        return [convex_hull(PRIMITIVES[kind]().vertices)]
    if kind == "table":
        top, leg = box((1.0, 0.7, 0.06)), box((0.06, 0.06, 0.64))
        corners = [(x, y, -0.35) for x in (-0.45, 0.45) for y in (-0.3, 0.3)]
        return [top, *(Mesh(leg.vertices + corner, leg.faces) for corner in corners)]
    if kind == "torus":
        return _ring_hulls(_torus_rings(0.35, 0.15, 32, 16))
    if kind == "torus_knot":
        return _ring_hulls(_knot_rings(64, 12))
    if kind == "gear":
        outer, inner = _gear_outline()
        outline = np.stack([outer, np.roll(outer, -1, axis=0), np.roll(inner, -1, axis=0), inner], axis=1)
        return [
            convex_hull(np.concatenate([np.column_stack([sector, np.full(4, z)]) for z in (-0.1, 0.1)]))
            for sector in outline
        ]
    if kind == "bowl":
        outer, inner = _bowl_profiles(0.5, 0.06, 6)
        turns = 2 * np.pi * np.arange(25) / 24
        pieces = []
        for low in range(len(outer) - 1):
            wall = np.concatenate([outer[low : low + 2], inner[low : low + 2]])
            rings = [_spin(wall, turn) for turn in turns]
            pieces += [convex_hull(np.concatenate(rings[k : k + 2])) for k in range(24)]
        return pieces
    return []


def _quads(quads: np.ndarray) -> np.ndarray:
    """Two triangles for each quad of [Q, 4]."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _spun(profile: np.ndarray, segments: int) -> np.ndarray:
    """The profile at even angles about z: [S, K, 3]."""
    return np.stack([_spin(profile, turn) for turn in 2 * np.pi * np.arange(segments) / segments])


def _spin(profile: np.ndarray, turn: float) -> np.ndarray:
    """Points [K, 2] of (radius, z) at the angle `turn` about z: [K, 3]."""
    return np.stack([profile[:, 0] * np.cos(turn), profile[:, 0] * np.sin(turn), profile[:, 1]], axis=1)


def revolve(profile: np.ndarray, segments: int) -> Mesh:
    """The solid of a profile [K, 2] of (radius, z), both ends on the axis, turned about z."""
    rings = _spun(profile, segments)
    # On the axis all copies of a point are one vertex and half of each quad vanishes; `clean` handles both.
    return _tube(rings, len(profile) - 1)


def ring(profile: np.ndarray, segments: int) -> Mesh:
    """The solid of a closed profile [K, 2] of (radius, z), counter-clockwise, turned about z."""
    return _tube(_spun(profile, segments))


def _tube(rings: np.ndarray, strips: int | None = None) -> Mesh:
    """The tube through rings [R, K, 3], the last joined to the first, with K strips around it, or only the first
    `strips`."""
    turns, sides = rings.shape[:2]
    this, following = np.arange(turns)[:, None], ((np.arange(turns) + 1) % turns)[:, None]
    left = np.arange(strips or sides)[None]
    right = (left + 1) % sides
    corners = (this * sides + left, following * sides + left, following * sides + right, this * sides + right)
    return clean(Mesh(rings.reshape(-1, 3), _quads(np.stack(corners, axis=-1).reshape(-1, 4))))


def _ring_hulls(rings: np.ndarray) -> list[Mesh]:
    return [convex_hull(np.concatenate(pair)) for pair in zip(rings, np.roll(rings, -1, axis=0), strict=True)]


def _torus_rings(major: float, minor: float, segments: int, sides: int) -> np.ndarray:
    around = 2 * np.pi * np.arange(sides) / sides
    profile = np.stack([major + minor * np.cos(around), minor * np.sin(around)], axis=1)
    return np.stack([_spin(profile, turn) for turn in 2 * np.pi * np.arange(segments) / segments])


def _knot_rings(segments: int, sides: int) -> np.ndarray:
    # Radii of the torus that the curve lies on, of its section and of the tube; turns around the axis and the section.
    major, wrap, tube, p, q = 0.3, 0.13, 0.06, 2, 3
    t = 2 * np.pi * np.arange(segments) / segments
    radius = major + wrap * np.cos(q * t)
    curve = np.stack([radius * np.cos(p * t), radius * np.sin(p * t), wrap * np.sin(q * t)], axis=1)
    tangent = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # Away from the middle of the torus' own tube: a direction that turns with the curve and closes on itself.
    middle = major * np.stack([np.cos(p * t), np.sin(p * t), np.zeros_like(t)], axis=1)
    first = curve - middle
    first -= (first * tangent).sum(1, keepdims=True) * tangent
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    around = 2 * np.pi * np.arange(sides) / sides
    offset = np.cos(around)[None, :, None] * first[:, None] + np.sin(around)[None, :, None] * second[:, None]
    return curve[:, None] + tube * offset


def _gear_outline() -> tuple[np.ndarray, np.ndarray]:
    """Outer and bore outlines [4 * teeth, 2], counter-clockwise: root, rise, tip, fall of each tooth."""
    radius, tooth, bore, teeth = 0.5, 0.1, 0.12, 12
    fraction = np.array([0.0, 0.3, 0.4, 0.9])
    turn = (2 * np.pi / teeth * (np.arange(teeth)[:, None] + fraction)).reshape(-1)
    reach = np.tile([radius - tooth, radius - tooth, radius, radius], teeth)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return circle * reach[:, None], circle * bore


def _bowl_profiles(radius: float, wall: float, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Outer and inner quarter circles [bands + 1, 2] of (radius, z), from the bottom to the rim."""
    angle = np.pi / 2 * np.arange(bands + 1) / bands
    quarter = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    quarter[0, 0] = 0.0
    return radius * quarter, (radius - wall) * quarter
