"""Contacts of round surfaces: where closed forms have them, however few nodes there are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.dynamics import pose
from sdfsim.dynamics.contacts import ARRAYS, Contacts, find_contacts
from sdfsim.dynamics.memory import Memory
from sdfsim.dynamics.rounding import curvature
from sdfsim.dynamics.simulator import Simulator
from sdfsim.scene.scene import Scene
from sdfsim.shape.mesh import Mesh
from sdfsim.shape.sdf import MeshSdf
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import make_body, random_model

REACH = 0.1
NOTHING = torch.zeros(3, dtype=torch.float64)
PLANE = analytic_shape("plane")


class CapsuleSdf:
    """A capsule along x: exact distances of a surface that bends one way only, but for its ends."""

    def __init__(self, radius: float, half: float) -> None:
        self.radius, self.half = radius, half
        self.bounds = np.array([[-half - radius, -radius, -radius], [half + radius, radius, radius]])

    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        along = points[:, 0].clamp(-self.half, self.half)
        away = points - torch.stack([along, torch.zeros_like(along), torch.zeros_like(along)], -1)
        length = away.norm(dim=-1)
        return length - self.radius, away / length[:, None]


def sphere(radius: float, nodes: int = 64):
    """A sphere with evenly spread nodes, none of them at a pole."""
    k = np.arange(nodes) + 0.5
    z, turn = 1 - 2 * k / nodes, np.pi * (1 + 5**0.5) * k
    places = radius * np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    return replace(analytic_shape("sphere", radius=radius), nodes=places)


def capsule(radius: float = 0.2, half: float = 0.5):
    """With rings of twelve nodes along its cylinder, none where it goes over into its ends."""
    x, turn = np.meshgrid(0.7 * np.linspace(-half, half, 9), 2 * np.pi * (np.arange(12) + 0.3) / 12, indexing="ij")
    nodes = np.stack([x, radius * np.cos(turn), radius * np.sin(turn)], -1).reshape(-1, 3)
    return replace(sphere(radius), sdf=CapsuleSdf(radius, half), nodes=nodes)


def rotation(seed: int) -> np.ndarray:
    turn = np.random.default_rng(seed).normal(size=4)
    return turn / np.linalg.norm(turn)


def simulator(shapes, *bodies) -> Simulator:
    return Simulator(Scene(tuple(shapes), bodies, gravity=np.zeros(3), duration=1.0), random_model("impulse"))


def edges(sim: Simulator, **options) -> Contacts:
    reach = REACH / sim.units.length
    return find_contacts(sim.bodies, sim.state, NOTHING, reach, sim.rules.dt, thin=True, **options)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_a_sphere_meets_the_floor_at_its_lowest_point(seed, scale):
    height = 0.5 * scale - 0.004
    ball = make_body("ball", 1, [0.3, -0.2, height], quat_xyzw=rotation(seed), scale=scale)
    sim = simulator([PLANE, sphere(0.5)], make_body("floor", 0, [0, 0, 0], motion="static"), ball)
    found, length = edges(sim), sim.units.length
    assert 1 <= len(found) <= 2
    np.testing.assert_allclose(found.distance * length, -0.004, atol=1e-5)
    np.testing.assert_allclose(found.arm * length, [[0.0, 0.0, 0.002 - 0.5 * scale]] * len(found), atol=1e-4)
    assert len(edges(sim, rounded=False)) > 2


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("radius", [0.5, 0.2])
def test_spheres_meet_on_the_line_of_their_centres(seed, radius):
    line = pose.rotate(torch.tensor(rotation(seed + 9)), torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).numpy()
    bodies = (
        make_body("one", 0, [0.0, 0.0, 0.0], quat_xyzw=rotation(seed)),
        make_body("two", 1, (0.5 + radius + 0.003) * line, quat_xyzw=rotation(seed + 1)),
    )
    sim = simulator([sphere(0.5), sphere(radius)], *bodies)
    found, length = edges(sim), sim.units.length
    assert {0, 1} == set(found.owner.tolist())
    np.testing.assert_allclose(found.distance * length, 0.003, atol=1e-4)
    sign = torch.where(found.owner == 0, -1.0, 1.0)[:, None].numpy()
    np.testing.assert_allclose(found.normal, sign * line, atol=5e-3)
    middle = np.where(sign < 0, 0.5015, -(radius + 0.0015)) * line
    np.testing.assert_allclose(found.arm * length, middle, atol=3e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_capsule_lies_on_a_line(seed):
    roll = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    body = make_body("it", 1, [0, 0, 0.2], quat_xyzw=np.array([np.sin(roll / 2), 0.0, 0.0, np.cos(roll / 2)]))
    sim = simulator([PLANE, capsule()], make_body("floor", 0, [0, 0, 0], motion="static"), body)
    found, length = edges(sim), sim.units.length
    middle = found.arm[(found.distance * length).abs() < 1e-5] * length
    np.testing.assert_allclose(middle[:, 1:], [[0.0, -0.2]] * len(middle), atol=1e-4)
    assert middle[:, 0].max() > 0.3 and middle[:, 0].min() < -0.3  # and still carries at both ends
    assert len(middle) == len(found)


def test_what_has_corners_keeps_its_nodes(box_shape):
    tilt = make_body("box", 1, [0, 0, 0.55], quat_xyzw=rotation(3))
    sim = simulator([PLANE, box_shape], make_body("floor", 0, [0, 0, 0], motion="static"), tilt)
    for name in ARRAYS:
        torch.testing.assert_close(getattr(edges(sim), name), getattr(edges(sim, rounded=False), name), rtol=0, atol=0)


def test_curvature_is_that_of_the_surface(box_shape):
    shapes = [sphere(0.5), capsule(), box_shape]
    bodies = [make_body(str(k), k, [5.0 * k, 0, 0], scale=2.0) for k in range(3)]
    known = curvature(simulator(shapes, *bodies).bodies)
    ball, rod, box = (slice(int(a), int(b)) for a, b in zip(known.start[:-1], known.start[1:], strict=True))
    assert known.smooth[ball].all() and not known.smooth[box].any()
    bend = torch.linalg.eigvalsh(known.bend[ball])
    np.testing.assert_allclose(bend, [[0.0, 2.0, 2.0]] * 64, rtol=0.02, atol=1e-9)
    inner = torch.tensor(np.abs(shapes[1].nodes[:, 0]) < 0.3)
    assert known.smooth[rod][inner].all()
    np.testing.assert_allclose(torch.linalg.eigvalsh(known.bend[rod][inner])[:, 2], 5.0, rtol=0.05)


def test_facets_are_not_round():
    """A prism of sixteen sides stands and lies on its edges, as it does for an engine."""
    turn = 2 * np.pi * np.arange(16) / 16
    ring = 0.5 * np.stack([np.cos(turn), np.sin(turn)], -1)
    vertices = np.concatenate([np.c_[ring, np.full(16, z)] for z in (-0.3, 0.3)])
    sides = [[k, (k + 1) % 16, 16 + k] for k in range(16)] + [
        [(k + 1) % 16, 16 + (k + 1) % 16, 16 + k] for k in range(16)
    ]
    lids = [[0, k + 1, k] for k in range(1, 15)] + [[16, 16 + k, 17 + k] for k in range(1, 15)]
    prism = replace(sphere(0.5), sdf=MeshSdf(Mesh(vertices, np.array(sides + lids))), nodes=vertices)
    assert not Memory().curvature(simulator([prism], make_body("prism", 0, [0, 0, 0])).bodies).smooth.any()
