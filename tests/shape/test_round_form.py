import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sdfsim.geometry import primitives
from sdfsim.geometry.mesh import Mesh, convex_hull, joined
from sdfsim.shape.round_form import round_form


def pill(radius: float, height: float) -> Mesh:
    """Sixteen meridians."""
    tilts, up = np.linspace(0, np.pi / 2, 9), 0.5 * height - radius
    upper = [(radius * np.cos(t), radius * np.sin(t) + up) for t in tilts[:-1]]
    lower = [(r, -z) for r, z in reversed(upper)]
    return primitives.revolve(np.array([(0.0, -0.5 * height), *lower, *upper, (0.0, 0.5 * height)]), 16)


ROUND = {
    "ball": (primitives.sphere(0.3, 2), "sphere", {"radius": 0.3}),
    "wheel": (primitives.cylinder(0.3, 0.1, 32), "cylinder", {"radius": 0.3, "height": 0.1}),
    "rod": (primitives.cylinder(0.01, 1.0, 12), "cylinder", {"radius": 0.01, "height": 1.0}),
    # all its moments of inertia are equal
    "can": (primitives.cylinder(0.1, 0.1 * np.sqrt(3.0), 256), "cylinder", {"radius": 0.1, "height": 0.1 * 3**0.5}),
    "pill": (pill(0.1, 0.5), "capsule", {"radius": 0.1, "height": 0.5}),
    "cone": (primitives.cone(0.2, 0.5, 24), "cone", {"radius": 0.2, "height": 0.5}),
    "hat": (primitives.cone(0.5, 0.1, 24), "cone", {"radius": 0.5, "height": 0.1}),
    "ring": (primitives.torus(0.3, 0.1), "torus", {"radius": 0.3, "tube": 0.1}),
}


@pytest.mark.parametrize("name", ROUND)
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_round_meshes_are_recognised_wherever_they_are(name: str, seed: int | None) -> None:
    mesh, kind, sizes = ROUND[name]
    turn, shift = Rotation.identity(), np.zeros(3)
    if seed is not None:
        turn, shift = Rotation.random(random_state=seed), np.random.default_rng(seed).normal(size=3)
    scale = 1.0 if seed is None else 10.0 ** (3 * seed - 2)
    vertices = scale * (turn.apply(mesh.vertices) + shift)
    found = round_form(Mesh(vertices.astype(np.float32).astype(float), mesh.faces))
    assert found is not None and found.kind == kind
    assert found.sizes == pytest.approx({key: scale * value for key, value in sizes.items()}, rel=1e-3)
    np.testing.assert_allclose(found.pose[:3, 3], scale * shift, atol=1e-3 * scale)
    if kind != "sphere":
        axis = turn.apply([0, 0, 1]) @ found.pose[:3, 2]
        assert (axis if kind == "cone" else abs(axis)) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(found.pose[:3, :3] @ found.pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found.pose) == pytest.approx(1.0)


def dented() -> Mesh:
    mesh = primitives.cylinder(0.1, 0.3, 32)
    vertices = mesh.vertices.copy()
    vertices[np.argmax(vertices[:, 0])] *= (0.97, 1, 1)
    return Mesh(vertices, mesh.faces)


BALL = primitives.sphere(0.3, 3)
OTHERS = {
    "box": primitives.box(),
    "nut": primitives.cylinder(0.1, 0.1, 6),  # its vertices are on a cylinder
    "octagon": primitives.cylinder(0.1, 0.1, 8),
    "coarse ball": primitives.sphere(0.3, 1),
    "egg": Mesh(BALL.vertices * (1, 1, 1.02), BALL.faces),
    "half ball": convex_hull(BALL.vertices[BALL.vertices[:, 2] >= -1e-9]),
    "frustum": primitives.revolve(np.array([[0, 0], [0.2, 0], [0.19, 0.3], [0, 0.3]]), 32),
    "chamfered": primitives.revolve(np.array([[0, 0], [0.19, 0], [0.2, 0.01], [0.2, 0.3], [0, 0.3]]), 32),
    "tapered": primitives.revolve(np.array([[0, 0], [0.2, 0], [0.05, 0.3], [0.0, 0.5]]), 32),
    "pipe": primitives.tube(0.2, 0.15, 0.4),
    "dented": dented(),
    "flat ring": primitives.tube(0.2, 0.1, 0.05),
    "bowl": primitives.bowl(),
    "gear": primitives.gear(),
    "half a ring": convex_hull(primitives.torus(0.3, 0.1).vertices),
    "two balls": joined([BALL, Mesh(BALL.vertices + 2, BALL.faces)]),
    "open": Mesh(primitives.cylinder().vertices, primitives.cylinder().faces[:-1]),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_other_meshes_are_not_round(name: str) -> None:
    assert round_form(OTHERS[name]) is None
