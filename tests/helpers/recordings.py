"""Small recordings and datasets that tests share: cubes by the teacher, and balls whose bounces are made by hand."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim.data.dataset import Trajectory
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import Shape
from sdfsim.training import train as train_module
from sdfsim.training.presets import Preset

CORNERS = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
SIDES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
CUBE = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in SIDES
)


def trajectory(frames: int = 4, bodies: int = 2) -> Trajectory:
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(frames, bodies, 4))
    return Trajectory(
        position=rng.normal(size=(frames, bodies, 3)),
        orientation=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        velocity=rng.normal(size=(frames, bodies, 3)),
        angular_velocity=rng.normal(size=(frames, bodies, 3)),
        shape=np.array(["cube", "spot"]),
        scale=np.array([1.0, 0.5]),
        mass=np.array([2.0, 1.0]),
        inertia=np.ones((bodies, 3)),
        friction=np.array([0.4, 0.8]),
        restitution=np.array([0.3, 0.7]),
        static=np.zeros(bodies, dtype=bool),
        dt=0.02,
        gravity=np.array([0.0, 0.0, -10.0]),
    )


def balls(position, **fields) -> Trajectory:
    """Unturned balls of radius 0.5 m, 1 kg and 0.1 kg m^2 that follow `position` [T, N, 3]; no velocities."""
    position = np.asarray(position, dtype=float)
    frames, bodies = position.shape[:2]
    defaults = {
        "position": position,
        "orientation": np.tile([0.0, 0.0, 0.0, 1.0], (frames, bodies, 1)),
        "velocity": np.zeros((frames, bodies, 3)),
        "angular_velocity": np.zeros((frames, bodies, 3)),
        "shape": np.array(["ball"] * bodies),
        "scale": np.ones(bodies),
        "mass": np.ones(bodies),
        "inertia": np.full((bodies, 3), 0.1),
        "friction": np.full(bodies, 0.5),
        "restitution": np.full(bodies, 0.5),
        "static": np.zeros(bodies, dtype=bool),
        "dt": 0.02,
        "gravity": np.array([0.0, 0.0, -10.0]),
    }
    return Trajectory(**(defaults | fields))


def bouncing(seed: int):
    """Two balls thrown at the floor and at each other; bounces are elastic and frictionless by hand."""
    rng = np.random.default_rng(seed)
    dt, frames, radius = 0.02, 40, 0.5
    position = np.zeros((frames, 2, 3))
    velocity = np.zeros((frames, 2, 3))
    position[0] = [[-1.5, 0.0, 0.55 + rng.uniform(0, 0.2)], [1.5, 0.0, 0.6 + rng.uniform(0, 0.2)]]
    velocity[0] = rng.uniform([-1, -1, -3], [1, 1, -1], size=(2, 3))
    for t in range(1, frames):
        velocity[t] = velocity[t - 1] + [0, 0, -10 * dt]
        position[t] = position[t - 1] + velocity[t] * dt
        hit = (position[t, :, 2] < radius) & (velocity[t, :, 2] < 0)
        velocity[t, hit, 2] *= -0.5
        position[t, hit, 2] = radius
    return replace(
        trajectory(),
        position=position,
        velocity=velocity,
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (frames, 2, 1)),
        angular_velocity=np.zeros((frames, 2, 3)),
        shape=np.array(["ball", "ball"]),
        scale=np.ones(2),
        inertia=np.full((2, 3), 0.1),
    )


def sliding(friction: float, **fields) -> Trajectory:
    """A flat box of 1 x 1 x 0.2 m whose own friction and restitution are 1, slowed down by a floor of this friction."""
    time = 0.02 * np.arange(40)[:, None, None]
    slower, along = friction * 10.0, np.array([1.0, 0.0, 0.0])
    one = balls(np.array([0.0, 0.0, 0.1]) + (3.0 * time - 0.5 * slower * time**2) * along)
    own = {"friction": np.ones(1), "restitution": np.ones(1), "inertia": np.array([[1.04, 1.04, 2.0]]) / 12.0}
    own |= {"velocity": (3.0 - slower * time) * along, "shape": np.array(["slab"])}
    return replace(one, **(own | fields))


def write_dataset(folder: Path, shape: Shape, splits: dict[str, list[Trajectory]], info: dict | None) -> Path:
    """A dataset of one shape and of the trajectories of each split; `info` is its dataset.json, None for none."""
    shape.save(folder / "shapes" / shape.name)
    for split, trajectories in splits.items():
        (folder / split).mkdir()
        for k, one in enumerate(trajectories):
            one.save(folder / split / f"{k}.npz")
    if info is not None:
        (folder / "dataset.json").write_text(json.dumps(info))
    return folder


BALL, BALLS = analytic_shape("sphere", radius=0.5, name="ball"), {"recipe": "balls", "seed": 0}


def slab_data(folder: Path, split: str, trajectory: Trajectory, info: dict | None) -> Path:
    """A dataset of one trajectory of slabs."""
    slab = analytic_shape("box", size=(1.0, 1.0, 0.2), name="slab")
    return write_dataset(folder, slab, {split: [trajectory]}, info)


@pytest.fixture(scope="module")
def cube_meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    (folder / "cube").mkdir()
    (folder / "cube" / "visual_geometry.obj").write_text(CUBE)
    (folder / "cube" / "collision_geometry.obj").write_text("o piece\n" + CUBE)
    return folder


@pytest.fixture(scope="module")
def cube_data(cube_meshes, tmp_path_factory):
    """A dataset of three trajectories; the cube's SDF is the exact one, so that nothing has to be fitted."""
    out = tmp_path_factory.mktemp("data")
    analytic_shape("box", size=(1.0, 1.0, 1.0), name="cube").save(out / "shapes" / "cube")
    pytest.importorskip("pybullet")
    from sdfsim.data.generate import make_dataset

    make_dataset("movi-b", out, shapes=cube_meshes, trajectories=3, seed=1, split="test")
    return out


@pytest.fixture(scope="module")
def ball_data(tmp_path_factory):
    """A dataset folder with two splits of thrown balls."""
    thrown = {"train": [bouncing(k) for k in range(6)], "validation": [bouncing(100), bouncing(101)]}
    return write_dataset(tmp_path_factory.mktemp("balls"), BALL, thrown, BALLS)


@pytest.fixture(scope="module")
def presets():
    """Tiny presets under names of their own."""
    tiny = Preset("impulse", {"width": 16, "rounds": 2}, steps=150, batch=16, rate=3e-3, matrix_rate=0.01)
    train_module.PRESETS["tiny"] = tiny
    train_module.PRESETS["tiny-sdf-sim"] = Preset("sdf-sim", {"width": 16, "steps": 2}, 60, 2, 3e-3, noise=0.003)
    yield
    del train_module.PRESETS["tiny"], train_module.PRESETS["tiny-sdf-sim"]
