"""Small scenes and untrained networks: what must hold holds whatever the weights are."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sdfsim.learned.model import Model, new_network
from sdfsim.learned.surfaces import (
    BodyTensors,
    Contacts,
    StateTensors,
    body_tensors,
    find_contacts,
    state_tensors,
)
from sdfsim.physics import pose
from sdfsim.physics.bodies import Bodies, State
from sdfsim.physics.solver.prepare import Compiled
from sdfsim.scene.scene import Body, Scene
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape

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
            torch.nn.init.normal_(layer.factor.weight, std=push)
    network.eval().requires_grad_(False)
    return Model("random", kind, network, dt=0.02, gravity=10.0, length=1.0, reach=0.1)


def tiny_model(path: Path, **known) -> Path:
    """The file of an untrained network on bodies, of the file's name; `known` are further fields of `Model`."""
    torch.manual_seed(0)
    network = new_network("impulse", {"width": 8, "rounds": 1})
    Model(path.stem, "impulse", network, 0.02, 10.0, 1.0, 0.1, **known).save(path)
    return path


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


def in_torch(bodies: Bodies, state: State) -> tuple[BodyTensors, StateTensors]:
    """Bodies and state as a network on surface nodes has them."""
    return body_tensors(bodies, CPU), state_tensors(state, CPU)


def contact_edges(
    bodies: Bodies, state: State, gravity: np.ndarray, reach: float, dt: float
) -> tuple[BodyTensors, StateTensors, Contacts]:
    """Bodies, state and contact edges as a network on surface nodes is given them."""
    tensors = in_torch(bodies, state)
    return *tensors, find_contacts(*tensors, gravity, reach, dt, Compiled(bodies, state))


def surface_model(push: float = 1e-3):
    """Untrained, its accelerations of the size of `push`."""
    model = random_model("sdf-sim", width=16, steps=2)
    model.network.target.total.fill_(1.0)
    model.network.target.squares.fill_(push**2)
    return model
