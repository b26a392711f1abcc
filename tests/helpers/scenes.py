"""Small scenes and untrained networks: what must hold holds whatever the weights are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.learned import inference
from sdfsim.learned.contact_graph import ContactGraph
from sdfsim.learned.model import Model, new_network
from sdfsim.learned.near import Contacts, find_contacts
from sdfsim.learned.tensors import BodyTensors, StateTensors, body_tensors, state_tensors
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.motion import MOTION
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.physics.solver.record import APART, ARM, AXIS, GIVEN, OTHER, WHEN, Edges
from sdfsim.physics.solver.world import World
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape

kernel = inference.compiled
CPU = torch.device("cpu")


def make_body(name: str, shape: int, position, mass: float = 1.0, **fields) -> Body:
    usual = {"motion": "dynamic", "scale": 1.0, "friction": 0.5, "restitution": 0.5}
    usual |= {"quat_xyzw": [0.0, 0.0, 0.0, 1.0], "velocity": [0.0, 0.0, 0.0], "angular_velocity": [0.0, 0.0, 0.0]}
    given = usual | fields
    vectors = {key: np.asarray(given[key], dtype=float) for key in ("quat_xyzw", "velocity", "angular_velocity")}
    return Body(name=name, shape=shape, position=np.asarray(position, dtype=float), mass=mass, **(given | vectors))


def ball(size: float) -> Shape:
    """A sphere of diameter `size` m."""
    return analytic_shape("sphere", radius=size / 2)


def cube(size: float) -> Shape:
    return analytic_shape("box", size=(size,) * 3)


def random_model(kind: str, seed: int = 0, push: float = 0.5, **config: int) -> Model:
    """An untrained model whose predictions are far from zero (by `push`)."""
    torch.manual_seed(seed)
    network = new_network(kind, config or {"width": 16, "rounds": 2} if kind == "impulse" else config)
    if kind == "impulse":
        for layer in network.rounds:  # type: ignore[union-attr]
            torch.nn.init.normal_(layer.normal_impulse.weight, std=push)
            torch.nn.init.normal_(layer.tangent_impulse.weight, std=push)
    network.eval().requires_grad_(False)
    return Model("random", kind, network, dt=0.02, gravity=10.0, length=1.0, reach=0.1)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle [...] rad of the rotation from `a` to `b`, unit quaternions [..., 4]."""
    return np.linalg.norm(pose.to_rotvec(pose.multiply(b, pose.conjugate(a))), axis=-1)


@pytest.fixture
def box_shape():
    return analytic_shape("box", size=(1.0, 0.8, 0.6))


@pytest.fixture
def free_pair(box_shape) -> Scene:
    """Two tumbling boxes that hit each other where there is no gravity."""
    left = make_body(
        "left", 0, [-0.52, 0.0, 0.1], velocity=np.array([2.0, 0.3, 0.0]), angular_velocity=np.array([0.5, 1.0, -2.0])
    )
    right = make_body("right", 0, [0.52, 0.05, 0.0], velocity=np.array([-1.0, 0.0, 0.4]), mass=3.0)
    return Scene((box_shape,), (left, right), gravity=np.zeros(3), duration=1.0)


@pytest.fixture
def dropped(box_shape) -> Scene:
    """A tilted box just above the floor, one on its way and one high up."""
    tilt = np.array([0.2, 0.1, 0.3, 1.0])
    tilt /= np.linalg.norm(tilt)
    bodies = (
        make_body("floor", 1, [0, 0, 0], motion="static", mass=0.0),
        make_body("low", 0, [0.0, 0.0, 0.55], quat_xyzw=tilt, velocity=np.array([1.0, 0.5, -2.0])),
        make_body("next", 0, [0.6, 0.7, 0.7], angular_velocity=np.array([3.0, 0.0, 1.0]), mass=2.0),
        make_body("high", 0, [0.0, 0.0, 50.0]),
    )
    return Scene((box_shape, analytic_shape("plane")), bodies, gravity=np.array([0.0, 0.0, -9.81]), duration=1.0)


def contact_graph(
    world: World, before: State, solved: State, edges: Edges, terms: kernel.Terms
) -> tuple[torch.Tensor, ContactGraph]:
    """The bodies [A] of a step's graph, and the graph, as the compiled network has it but in torch."""
    start, end = (kernel.Poses(*(getattr(state, name) for name in MOTION)) for state in (before, solved))
    given = kernel._graph(world, start, end, edges.pair, edges.value, terms)
    columns = {"normal": AXIS, "arm_first": ARM, "arm_second": OTHER, "impulse": GIVEN}
    twists = {"": kernel.START, "free_": kernel.FREE, "solved_": kernel.END, "mean_": kernel.MEAN}
    value, twist, pair = (torch.from_numpy(array) for array in (given.value, given.twist, given.pair))
    pairs = len(given.first) - 1
    return torch.from_numpy(given.body), ContactGraph(
        inverse_mass=torch.from_numpy(given.inverse_mass),
        inverse_inertia=torch.from_numpy(given.inverse_inertia),
        **{f"{name}velocity": twist[:, k : k + 3] for name, k in twists.items()},
        **{f"{name}angular": twist[:, k + 3 : k + 6] for name, k in twists.items()},
        **{name: value[:, k : k + 3] for name, k in columns.items()},
        first=pair[:, 0],
        second=pair[:, 1],
        pair=torch.repeat_interleave(torch.arange(pairs), torch.from_numpy(np.diff(given.first))),
        pairs=pairs,
        gap=value[:, APART],
        when=value[:, WHEN],
        friction=torch.from_numpy(given.product[:, 0]),
        restitution=torch.from_numpy(given.product[:, 1]),
        dt=terms.known,
    )


def in_torch(bodies: Bodies, state: State) -> tuple[BodyTensors, StateTensors]:
    """Bodies and state as a network on surface nodes has them."""
    return body_tensors(bodies, CPU), state_tensors(state, CPU)


def contact_edges(
    bodies: Bodies, state: State, gravity: np.ndarray, reach: float, dt: float
) -> tuple[BodyTensors, StateTensors, Contacts]:
    """Bodies, state and contact edges as a network on surface nodes is given them."""
    tensors = in_torch(bodies, state)
    return *tensors, find_contacts(*tensors, gravity, reach, dt, Compiled(bodies, state))


def in_single(graph: ContactGraph) -> ContactGraph:
    """The graph in single precision, as a network has it."""
    values = {name: value for name, value in vars(graph).items() if isinstance(value, torch.Tensor)}
    return replace(graph, **{name: v.float() for name, v in values.items() if v.is_floating_point()})


def surface_model(kind: str = "sdf-sim", push: float = 1e-3):
    """Untrained, its accelerations of the size of `push`."""
    model = random_model(kind, width=16, steps=2)
    model.network.target.total.fill_(1.0)
    model.network.target.squares.fill_(push**2)
    return model
