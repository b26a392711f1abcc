"""Rows 9 and 12: degenerate shapes run or are refused; distances have bounded gradients wherever they are asked."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.sdf.closed_forms import BoxSdf, SphereSdf
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
from tests.helpers.scenes import contact_edges, random_model, surface_model

LINE = np.linspace(-0.5, 0.5, 6)[:, None] * [1.0, 0.5, 0.0]
FLAT = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.5], [0.0]), -1).reshape(-1, 3)


def dropped(nodes: np.ndarray, shape=gates.CUBE):
    """A tilted body with these nodes, about to land."""
    scene = gates.placed(shape, [(0, 0, 0.5)], floor=True, quat_xyzw=gates.TILTED, velocity=np.array([0.3, 0, -2.0]))
    return replace(scene, shapes=(replace(shape, nodes=nodes), *scene.shapes[1:]))


@pytest.mark.parametrize("make", [lambda: random_model("impulse", push=0.1), surface_model, lambda: "solver"],
                         ids=["impulse", "sdf-sim", "solver"])  # fmt: skip
def test_coplanar_nodes_run(make):
    rollout = Simulator(dropped(FLAT), make()).run(steps=12)
    gates.assert_sound(rollout)
    assert rollout.contact_count.sum() > 0


@pytest.mark.parametrize(
    ("nodes", "told"),
    [
        (LINE, "its 6 surface nodes are on one line"),
        (LINE + 1e-7 * np.random.default_rng(0).normal(size=LINE.shape), "on one line"),
        (LINE[:2], "its 2 surface nodes are on one line"),
        (LINE[:1], "its 1 surface nodes are in one place"),
        (np.zeros((4, 3)), "its 4 surface nodes are in one place"),
    ],
)
def test_nodes_that_do_not_tell_how_a_body_turns_are_refused(nodes, told):
    with pytest.raises(SdfsimError, match=f"body 'b0' moves: .*{told}") as caught:
        Simulator(dropped(nodes), random_model("impulse"))
    assert caught.value.exit_code == 1 and "nodes: 7" in caught.value.hint


# Where the gradient is not that of a smooth function, on a body of size 1 about the origin.
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3, indexing="ij"), -1).reshape(-1, 3)
PLACES = {
    "middle, planes of symmetry, edges, corners": CORNERS,
    "inside, on the diagonals": 0.5 * CORNERS,
    "on the surface's edges, a touch off": CORNERS + 1e-9,
    "outside the box": 4.0 * CORNERS,
    "far outside": 1e6 * CORNERS,
    "farther than a body may be": 1e12 * CORNERS,
}


@pytest.fixture(scope="module")
def kinds() -> dict:
    cube, ring = gates.CUBE, gates.ring()
    return {
        "plane": (gates.PLANE.sdf, None),
        "sphere": (SphereSdf(0.5), 1.0),
        "box": (BoxSdf((0.5, 0.5, 0.5)), 1.0),
        "network": (ring.sdf, 1.0),
        "grid": (with_sdf(cube, "grid", resolution=16).sdf, 1.0),
        "mesh": (with_sdf(cube, "mesh").sdf, 1.0),
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["single", "double"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["plane", "sphere", "box", "network", "grid", "mesh"])
def test_gradients_are_defined_and_bounded_and_closest_points_stay_at_the_surface(kinds, kind, place, dtype, device):
    sdf, size = kinds[kind]
    points = torch.tensor(PLACES[place], dtype=dtype, device=device)
    distance, gradient = sdf.to(device)(points)
    assert distance.isfinite().all() and gradient.isfinite().all()
    length = gradient.double().norm(dim=-1)
    assert (length > 0.85).all() and (length < 1.15).all()
    if size is None:
        return
    normal = gradient.double() / length[:, None]
    closest = points.double() - distance.double()[:, None] * normal
    # No farther out than the solid, but for what a fit errs and what the type rounds far away.
    slack = 0.1 * size + (0.05 + 4 * torch.finfo(dtype).eps) * points.double().norm(dim=-1, keepdim=True)
    assert (closest.abs() <= 0.5 * size + slack).all(), (place, (closest.abs() - slack).max())


@pytest.mark.parametrize("kind", ["sphere", "box", "network", "mesh"])
@pytest.mark.parametrize(
    "place",
    [(0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.5, 0.0), (0.5, 0.5, 0.5), (0.0, 0.0, 0.5)],
    ids=["centre", "symmetry plane", "edge", "corner", "surface"],
)
def test_a_node_where_the_gradient_has_no_direction_of_its_own(kinds, kind, place, model):
    """Its edge has a unit normal and a finite distance, and the step goes on."""
    nodes = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])
    probe = replace(analytic_shape("box", size=(0.7, 0.7, 0.7)), nodes=nodes)
    target = gates.ring() if kind == "network" else replace(gates.CUBE, sdf=kinds[kind][0])
    scene = gates.placed(probe, [place])
    rest = replace(scene.bodies[0], name="target", shape=1, position=np.zeros(3))
    scene = replace(scene, shapes=(probe, target), bodies=(*scene.bodies, rest))
    sim = Simulator(scene, model)
    _, _, contacts = contact_edges(sim.bodies, sim.state, sim.options.gravity, sim.model.reach, sim.options.dt)
    assert len(contacts)
    torch.testing.assert_close(contacts.normal.norm(dim=-1), torch.ones(len(contacts), dtype=torch.float64))
    assert contacts.distance.isfinite().all() and (contacts.distance.abs() < 2.0).all()
    gates.assert_sound(sim.run(steps=10))
