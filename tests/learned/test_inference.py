"""The compiled network against its form in torch, in double precision, step by step; and what it must never do."""

import sys
from copy import deepcopy
from dataclasses import dataclass, replace
from subprocess import run

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from sdfsim.data.batching import roll_out
from sdfsim.data.dataset import Trajectory
from sdfsim.learned import inference, pose
from sdfsim.learned.contact_graph import ContactGraph
from sdfsim.learned.model import Model, load_model, new_network
from sdfsim.physics.bodies import State
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver import impulse as kernel
from sdfsim.scene.scene import Effects, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from sdfsim.simulate.steppers import OnSolver
from tests.helpers.scenes import contact_graph, cube, make_body, random_model

ROUNDING = 1e-5  # by the largest speed around


def pile(seed: int, bodies: int = 5, **effects: str) -> Scene:
    """Boxes and balls of all masses and coefficients that fall onto each other; nothing is symmetric."""
    draw = np.random.default_rng(seed)
    box, ball = analytic_shape("box", size=(1.0, 0.8, 0.6)), analytic_shape("sphere", radius=0.4)
    moving = []
    for k in range(bodies):
        quat = draw.normal(size=4)
        moving.append(
            make_body(
                f"body{k}", int(k % 3 == 2), [*draw.uniform(-0.6, 0.6, 2), 0.6 + 0.7 * k],
                quat_xyzw=quat / np.linalg.norm(quat), velocity=draw.normal(size=3) - np.array([0, 0, 2.0]),
                angular_velocity=2.0 * draw.normal(size=3), mass=10.0 ** draw.uniform(-1, 1),
                friction=draw.uniform(0, 1), restitution=draw.uniform(0, 1),
            )
        )  # fmt: skip
    floor = make_body("floor", 2, [0, 0, 0], motion="static", mass=0.0)
    shapes, played = (box, ball, analytic_shape("plane")), replace(Effects(), **effects)
    return Scene(shapes, (*moving, floor), np.array([0.7, 0.3, -9.0]), 1.0, effects=played)


def model_of(name: str, seed: int = 0) -> Model:
    if name == "small":
        return replace(load_model("small"), ranges={})  # whatever the scene is, it is not beyond them
    return random_model("impulse", seed, width=24, rounds=3, alone=int(name == "alone"))


@dataclass(frozen=True)
class Compared:
    """One step: how many edges it had, what the network added, and by how much compiled and torch differ in it; both
    by the largest speed around."""

    edges: int
    change: float
    error: float


def in_torch(network, solved: State, terms: kernel.Terms, active: torch.Tensor, graph: ContactGraph) -> State:
    """What the network in torch makes of a solved step."""
    predicted = network(graph, friction=terms.friction, trust=terms.trust)
    chosen, time = graph.inverse_mass > 0, terms.dt / graph.dt
    rows = active[chosen]
    place, velocity, turned, angular = (
        torch.tensor(getattr(solved, name)) for name in ("position", "velocity", "orientation", "angular_velocity")
    )
    place[rows] += (predicted.mean_velocity - graph.mean_velocity)[chosen] * time * terms.dt
    velocity[rows] += (predicted.velocity - graph.solved_velocity)[chosen] * time
    if terms.rotation:
        turn = pose.from_rotvec((predicted.mean_angular - graph.mean_angular)[chosen] * graph.dt)
        turned[rows] = pose.normalise(pose.multiply(turn, turned[rows]))
        angular[rows] += (predicted.angular - graph.solved_angular)[chosen] / time
    arrays = (array.numpy() for array in (place, turned, velocity, angular))
    return replace(solved, **dict(zip(MOTION, arrays, strict=True)))


@pytest.fixture
def steps(monkeypatch) -> list[Compared]:
    """Every step that the compiled network makes, made by torch in double precision as well."""
    found, given = [], []
    compiled, step = inference.corrected, OnSolver._step

    def stepped(stepper, *rest):
        given[:] = [deepcopy(stepper.model.network).double()]
        return step(stepper, *rest)

    def both(weights, world, before, solved, edges, terms):
        mine = compiled(weights, world, before, solved, edges, terms)
        theirs = in_torch(given[0], solved, terms, *contact_graph(world, before, solved, edges, terms))
        rows = edges.pair.ravel()
        speed = max(np.abs(getattr(s, n)[rows]).max() for s in (before, solved, theirs) for n in MOTION[2:])

        def apart(other: State, names: tuple[str, ...]) -> float:
            return max(np.abs(getattr(mine, n) - getattr(other, n)).max() for n in names) / speed

        found.append(Compared(len(edges.pair), apart(solved, MOTION[2:]), apart(theirs, MOTION)))
        return mine

    monkeypatch.setattr(OnSolver, "_step", stepped)
    monkeypatch.setattr(inference, "corrected", both)
    return found


def agree(steps: list[Compared], count: int, change: float = 1e-3, rounding: float = ROUNDING) -> bool:
    """Whether compiled and torch do to rounding, in at least `count` steps one of which changes velocities so much."""
    assert len(steps) >= count and max(s.change for s in steps) > change
    return max(s.error for s in steps) < rounding


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("small", {}), ("alone", {}), ("alone", {"friction": "off"}), ("random", {}), ("random", {"friction": "off"}),
        ("random", {"rotation": "off"}), ("random", {"restitution": "off"}),
    ],
    ids=str,
)  # fmt: skip
def test_compiled_and_torch_agree_to_rounding(steps, name, effects):
    for seed in range(2):
        Simulator(pile(seed, **effects), model_of(name, seed)).run(steps=12)
    assert agree(steps, 16) and max(s.edges for s in steps) > 4


@pytest.mark.parametrize("push", [5.0, 50.0])
def test_they_agree_where_every_bound_of_the_trust_region_acts(steps, push):
    for seed in range(3):
        weightless = replace(pile(seed, 4), gravity=np.zeros(3))
        Simulator(weightless, random_model("impulse", seed, push=push)).run(steps=15)
    assert agree(steps, 10, rounding=ROUNDING * push / 5.0)  # single precision, times what the network pushes


def test_they_agree_on_one_edge(steps, free_pair):
    ball = analytic_shape("sphere", radius=0.5)
    Simulator(replace(free_pair, shapes=(ball,)), model_of("random")).run(steps=6)
    assert agree(steps, 1) and {s.edges for s in steps} == {1}


def test_they_agree_on_more_edges_than_go_through_a_layer_at_once(steps):
    draw = np.random.default_rng(0)
    places = [(1.02 * i, 1.02 * j, 0.5) for i in range(13) for j in range(13)]
    bodies = [make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0)]
    bodies += [make_body(f"{n}", 0, place, velocity=draw.normal(size=3)) for n, place in enumerate(places)]
    scene = Scene((cube(1.0), analytic_shape("plane")), tuple(bodies), np.array([0.0, 0.0, -9.81]), 1.0)
    Simulator(scene, model_of("random")).run(steps=2)
    assert agree(steps, 2) and max(s.edges for s in steps) > kernel.BLOCK


@pytest.mark.parametrize("longer", [0.5, 2.0])
def test_they_agree_on_steps_of_another_length_than_the_network_knows(steps, longer):
    sim = Simulator(pile(3), model_of("random"))
    sim.options = replace(sim.options, dt=longer * sim.options.dt)
    sim.run(steps=15)
    assert agree(steps, 8)


def test_recordings_in_a_batch_move_as_each_alone_and_as_in_torch(steps, box_shape):
    draw = np.random.default_rng(4)

    def recording(count: int) -> Trajectory:
        quat, spread = draw.normal(size=(1, count, 4)), np.linspace(0.0, 1.0, count)[:, None] * [0.3, 0.2, 1.2]
        return Trajectory(
            position=spread[None] + [0.0, 0.0, 0.6], orientation=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
            velocity=draw.normal(size=(1, count, 3)), angular_velocity=draw.normal(size=(1, count, 3)),
            shape=np.array(["box"] * count), scale=np.ones(count), mass=draw.uniform(1, 5, count),
            inertia=draw.uniform(0.2, 0.3, (count, 3)), friction=draw.uniform(size=count),
            restitution=draw.uniform(size=count), static=np.zeros(count, bool), dt=0.02,
            gravity=np.array([0.0, 0.0, -10.0]),
        )  # fmt: skip

    group, model = [recording(count) for count in (2, 1, 3, 2)], model_of("random")
    together = roll_out(model, group, {"box": box_shape}, 8)
    assert agree(steps, 8)
    for one, same in zip(group, together, strict=True):
        (alone,) = roll_out(model, [one], {"box": box_shape}, 8)
        np.testing.assert_allclose(alone.velocity, same.velocity, atol=1e-4)
    assert max(s.error for s in steps) < ROUNDING


def test_without_trust_it_is_not_asked_and_with_little_it_adds_little(steps):
    def first(trust: float) -> float:
        """What is added in the first step that has edges."""
        steps.clear()
        sim = Simulator(pile(1), model_of("random"))
        sim.stepper = replace(sim.stepper, trust=trust)
        sim.run(steps=4)
        return steps[0].change if steps else 0.0

    whole, little = first(1.0), first(1e-6)
    assert first(0.0) == 0.0 and not steps
    assert 0.0 < little < 1e-4 * whole


def test_whatever_it_adds_keeps_momentum(free_pair):
    model = random_model("impulse", push=5.0)
    sim, plain = Simulator(free_pair, model), Simulator(free_pair, replace(model, kind="solver"))
    mass = sim.bodies.mass[:, None]
    before = (mass * sim.state.velocity).sum(0)
    for one in (sim, plain):
        one.run(steps=20)
    assert np.abs(sim.state.velocity - plain.state.velocity).max() > 1e-2
    np.testing.assert_allclose((mass * sim.state.velocity).sum(0), before, rtol=0, atol=1e-13)


def test_the_same_steps_give_the_same_bits():
    one, other = (Simulator(pile(2), model_of("random")).run(steps=20) for _ in range(2))
    for name in MOTION:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_matrices_of_the_network_take_one_thread(monkeypatch):
    """Inside a step. Afterwards their library has its threads again."""

    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    seen, correct = [], inference.compiled.correct

    def watched(*given):
        seen.append(threads())
        correct(*given)

    monkeypatch.setattr(inference.compiled, "correct", watched)
    with threadpool_limits(3, "blas"):
        Simulator(pile(2), model_of("random")).run(steps=10)
        assert threads() == {3}
    assert seen and all(counts == {1} for counts in seen)


def test_the_library_of_its_matrices_is_known_before_they_are_multiplied():
    code = (
        "from sdfsim.learned.inference import _blas; known = len(_blas().info())\n"
        "import scipy.linalg.cython_blas; from threadpoolctl import threadpool_info\n"
        "assert known == sum(library['user_api'] == 'blas' for library in threadpool_info()) > 0"
    )
    assert run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("sizes", [{"width": 0}, {"rounds": 0}])
def test_a_network_of_nothing_is_refused(sizes):
    with pytest.raises(ValueError, match="at least 1"):
        new_network("impulse", sizes)
