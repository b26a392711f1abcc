"""The compiled contact step against its readable twin, and the twin's gradients against differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.dynamics import solver_in_torch as twin
from sdfsim.dynamics.bodies import State, Units, from_scene
from sdfsim.dynamics.kernels.world import DRAG, GAP, KEY, NORMAL, PUSH, SECOND, Manifolds
from sdfsim.dynamics.solver import Compiled, compiled_rules, taken_up
from sdfsim.dynamics.step import StepOptions
from sdfsim.scene.scene import Scene
from sdfsim.shape.baked_grid import baked, interpolated
from sdfsim.shape.primitives import convex_pieces
from sdfsim.shape.shape import analytic_shape, load_shape
from tests.dynamics.test_laws import ball, body, cube
from tests.dynamics.test_scale import SHAPES
from tests.dynamics.test_solver import heap

ONE = Units(1.0, 1.0, 1.0)


def compiled(scene: Scene, **rules):
    bodies, state = from_scene(scene, ONE, torch.device("cpu"))
    inside = Compiled(bodies, state)
    rules = compiled_rules(StepOptions(torch.from_numpy(scene.gravity), 0.02, **rules))
    return inside, *taken_up(bodies, state, inside, rules), rules


def state_of(motion) -> State:
    return State(*(torch.from_numpy(array.copy()) for array in motion[:4]))


def poses(state: State) -> tuple[torch.Tensor, ...]:
    return state.position, state.orientation, state.velocity, state.angular_velocity


def known_of(touching: torch.Tensor, manifolds: Manifolds) -> twin.Known:
    """What the compiled step has left."""
    points: twin.Points = {}
    for (a, b), count, rows in zip(manifolds.pair.tolist(), manifolds.count, manifolds.point, strict=True):
        points[a, b] = [
            twin.Point(r[:SECOND], r[SECOND:NORMAL], r[NORMAL:GAP], r[GAP], int(r[KEY]), r[PUSH], r[DRAG : DRAG + 3])
            for r in torch.from_numpy(rows[:count].copy())
        ]
    return twin.Known(touching, points)


def tops(seed: int) -> Scene:
    """Fitted shapes, one of them of convex pieces, on a slope; nothing is symmetric, so no choice is a tie."""
    draw = np.random.default_rng(seed)
    ring = load_shape(SHAPES / "ring")
    pieces = tuple(0.22 * p.vertices * (1.0 + 0.05 * draw.random(p.vertices.shape)) for p in convex_pieces("torus"))
    shapes = (
        replace(ring, pieces=pieces), load_shape(SHAPES / "bowl"), load_shape(SHAPES / "can"), cube(1.0),
        analytic_shape("plane"),
    )  # fmt: skip
    bodies = []
    for k in range(4):
        quat = draw.normal(size=4)
        bodies.append(
            body(
                str(k), k, [*draw.uniform(-0.2, 0.2, 2), 0.7 + 0.7 * k], draw.uniform(0.5, 5.0),
                scale=1.0 / np.ptp(shapes[k].sdf.bounds, axis=0).max(), quat_xyzw=quat / np.linalg.norm(quat),
                velocity=draw.normal(size=3), angular_velocity=2.0 * draw.normal(size=3),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    return Scene(shapes, (*bodies, floor(4)), np.array([1.0, 0.5, -9.0]), 1.0)


def swallowed() -> Scene:
    """A box whose middle is in another one."""
    one = body("one", 0, [0, 0, 0], 1.0, angular_velocity=[0.1, 0.2, 0.3])
    other = body("other", 0, [0.13, 0.07, 0.21], 3.0, scale=1.3, quat_xyzw=np.array([1.0, 3.0, -2.0, 9.0]) / 95**0.5)
    return Scene((cube(1.0),), (one, other), np.zeros(3), 1.0)


def floor(shape: int):
    return body("floor", shape, [0, 0, 0], 0.0, motion="static", friction=0.8, restitution=1.0)


@pytest.mark.parametrize(
    ("scene", "steps", "rules", "pull"),
    [
        (heap(0, 4), 60, {}, 0.0), (heap(1, 4), 60, {"margin": 1e-3, "adds": True}, 0.0),
        (tops(0), 45, {}, 0.0), (tops(1), 25, {}, 0.5), (swallowed(), 30, {}, 0.0),
    ],
    ids=["closed forms", "as the teacher", "fitted", "fitted, pulled at", "swallowed"],
)  # fmt: skip
def test_the_compiled_step_is_its_twin(scene, steps, rules, pull):
    """Step by step from the compiled states: chaos would soon make more of a rounding."""
    inside, motion, manifolds, rules = compiled(scene, **rules)
    moves = inside.world.moves[:, None]
    inside.work.load[:] = pull * moves * np.random.default_rng(3).normal(size=inside.work.load.shape)
    points = 0
    for k in range(steps):
        if k % 6:
            manifolds, *_ = inside.run(motion, manifolds, rules)
            continue
        state = replace(state_of(motion), load=torch.from_numpy(inside.work.load.copy()))
        known = known_of(torch.from_numpy(motion.touching.copy()), manifolds)
        after, known = twin.Solve(inside.shapes, inside.bodies, rules).step(state, known)
        manifolds, _, counts = inside.run(motion, manifolds, rules)
        assert sum(map(len, known.points.values())) == manifolds.count.sum()
        for ours, theirs, bound in zip(poses(after), motion, (1e-9, 1e-9, 1e-7, 1e-7), strict=False):
            np.testing.assert_allclose(ours.numpy(), theirs, atol=bound, rtol=0)
        points += counts[1]
    assert points > 5


def test_distances_of_a_grid_and_their_derivatives_are_those_of_what_lies_between_its_samples():
    bowl = load_shape(SHAPES / "bowl")
    inside, *_ = compiled(Scene((bowl,), (body("it", 0, [0, 0, 0], 1.0),), np.zeros(3), 1.0))
    grid = baked(bowl.sdf, bowl.nodes, bowl.pieces)
    places = torch.from_numpy(bowl.nodes[:200] + 0.3 * grid.cell).requires_grad_()
    d, n = twin.Distance.apply(places, inside.shapes, 0)
    np.testing.assert_allclose(d.detach(), interpolated(grid, places.detach().numpy()), atol=1e-12)
    slope = torch.autograd.grad(d.sum(), places)[0]
    np.testing.assert_allclose(slope / slope.norm(dim=1, keepdim=True), n.detach(), atol=1e-6)


THROW = {"velocity": np.array([1.5, 0.2, -0.5]), "friction": 0.1, "restitution": 0.7, "mass": 1.3}


def thrown(velocity, friction, restitution, mass) -> Scene:
    """A ball that bounces off the floor and then off another ball."""
    first = body("first", 0, [0.0, 0.0, 0.56], mass, velocity=velocity, friction=friction, restitution=restitution)
    other = body("other", 0, [1.15, 0.1, 0.9], 1.0, friction=1.0, restitution=1.0)
    return Scene((ball(1.0), analytic_shape("plane")), (first, other, floor(1)), np.array([0.0, 0.0, -9.81]), 1.0)


@pytest.mark.parametrize("name", THROW)
def test_gradients_are_differences_of_the_compiled_step(name):
    """Where a ball is after 0.24 s, with two impacts on the way, told by the first body's values."""

    def end(value) -> np.ndarray:
        inside, motion, manifolds, rules = compiled(thrown(**(THROW | {name: value})))
        for _ in range(12):
            manifolds, *_ = inside.run(motion, manifolds, rules)
        return motion.position[:2].copy()

    inside, motion, manifolds, rules = compiled(thrown(**THROW))
    bodies, state = inside.bodies, state_of(motion)
    value = torch.tensor(THROW[name], dtype=torch.float64, requires_grad=True)
    if name == "velocity":
        state = replace(state, velocity=torch.cat([value[None], state.velocity[1:]]))
    elif name == "mass":
        share = torch.stack([value / THROW["mass"], *torch.ones(2, dtype=torch.float64)])
        bodies = replace(
            bodies, inverse_mass=bodies.inverse_mass / share, inertia=bodies.inertia * share[:, None, None]
        )  # fmt: skip
    else:
        bodies = replace(bodies, **{name: torch.cat([value[None], getattr(bodies, name)[1:]])})
    solve, known = twin.Solve(inside.shapes, bodies, rules), known_of(torch.zeros(3, dtype=bool), manifolds)
    for _ in range(12):
        state, known = solve.step(state, known)
    np.testing.assert_allclose(state.position[:2].detach().numpy(), end(THROW[name]), atol=1e-9)
    weights = torch.tensor([[1.0, 2.0, 3.0], [-2.0, 1.0, 0.5]], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((state.position[:2] * weights).sum(), value)
    steps = 1e-6 * np.eye(3) if name == "velocity" else [np.array(1e-6)]
    wanted = [((end(THROW[name] + h) - end(THROW[name] - h)) * weights.numpy()).sum() / 2e-6 for h in steps]
    assert np.abs(wanted).max() > 1e-3
    np.testing.assert_allclose(gradient.numpy().reshape(-1), wanted, rtol=1e-4, atol=1e-6)
