"""The broad phase against a twin that compares every box with every other, and what it never makes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sdfsim.dynamics.bodies import Units, from_scene
from sdfsim.dynamics.broad import Still, near_pairs, swept_boxes
from sdfsim.dynamics.memory import Memory
from sdfsim.scene.scene import Scene
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import make_body

GRAVITY = torch.tensor([0.0, 0.0, -10.0], dtype=torch.float64)
REACH, DT = 0.1, 0.02
SHAPES = (analytic_shape("box", size=(1.0, 0.7, 0.5)), analytic_shape("sphere", radius=0.4), analytic_shape("plane"))


def crowd(seed: int, count: int = 60, origin: float = 0.0, sizes: tuple[float, float] = (0.02, 4.0)) -> Scene:
    """Dust and boulders, some fast, some fixed, over a tilted and a level floor."""
    rng = np.random.default_rng(seed)
    tilted = Rotation.from_euler("x", 40, degrees=True).as_quat()
    bodies = [
        make_body("floor", 2, [origin, 0, 0], motion="static", mass=0.0),
        make_body("slope", 2, [origin, -3, 0], motion="static", mass=0.0, quat_xyzw=tilted),
    ]
    for k in range(count):
        still = rng.random() < 0.4
        lists = [None, None, None, ("floor", "b3", "b4", "b5"), ()]
        bodies.append(
            make_body(
                f"b{k}",
                k % 2,
                rng.uniform(-4, 4, 3) + np.array([origin, 0, 3]),
                scale=float(np.exp(rng.uniform(*np.log(sizes)))),
                motion="static" if still else "dynamic",
                mass=0.0 if still else 1.0,
                quat_xyzw=Rotation.random(rng=rng).as_quat(),
                velocity=np.zeros(3) if still else rng.normal(size=3) * rng.choice([0.0, 1.0, 60.0]),
                angular_velocity=np.zeros(3) if still else rng.normal(size=3),
                collides_with=lists[rng.integers(len(lists))],
            )
        )
    return Scene(SHAPES, tuple(bodies), gravity=GRAVITY.numpy(), duration=1.0)


def found(bodies, state) -> list[tuple[int, int]]:
    going, still = Memory().surroundings(bodies, state, GRAVITY, REACH, DT)
    pairs = near_pairs(bodies, state, GRAVITY, REACH, DT, going, still)
    return list(zip(*(p.tolist() for p in pairs), strict=True))


def dense_twin(bodies, state) -> set[tuple[int, int]]:
    """Every ordered pair of bounded bodies whose boxes overlap."""
    every = torch.arange(len(bodies))
    boxes = swept_boxes(bodies, state, GRAVITY, REACH, DT, every)
    low, high = boxes.low.numpy(), boxes.high.numpy()
    pairs = set()
    for i in range(len(bodies)):
        for j in range(len(bodies)):
            one, other = torch.tensor([i]), torch.tensor([j])
            if i != j and (low[i] <= high[j]).all() and (high[i] >= low[j]).all() and bodies.may_meet(one, other):
                pairs.add((i, j))
    return pairs


@pytest.mark.parametrize("origin", [0.0, 1e5])
@pytest.mark.parametrize("seed", range(3))
def test_the_same_pairs_as_comparing_all(seed, origin):
    bodies, state = from_scene(crowd(seed, origin=origin), Units(1.0, 1.0, 1.0), torch.device("cpu"))
    pairs, expected = found(bodies, state), dense_twin(bodies, state)
    bounded = [p for p in pairs if min(p) > 1]
    assert bounded == sorted(p for p in expected if min(p) > 1) and len(bounded) > 40
    assert len(set(pairs)) == len(pairs) and set(pairs) <= expected
    # Planes are infinite; only what comes near one is paired with it, and they own no nodes.
    above = {i for i, j in pairs if j == 0}
    assert not any(i < 2 for i, _ in pairs) and 0 < len(above) < len({i for i, j in expected if j == 0})
    low = swept_boxes(bodies, state, GRAVITY, REACH, DT, torch.arange(len(bodies))).low[:, 2]
    moving = {i for i, j in expected if j == 0}
    assert above == {i for i in moving if low[i] <= 0.5 * REACH}


def test_bodies_of_two_worlds_never_meet_but_share_what_is_in_all():
    bodies, state = from_scene(crowd(5, sizes=(0.5, 2.0)), Units(1.0, 1.0, 1.0), torch.device("cpu"))
    world = torch.arange(len(bodies)) % 3
    world[:4] = -1
    together = found(bodies, state)
    apart = found(replace(bodies, world=world), state)
    kept = [(i, j) for i, j in together if world[i] == world[j] or min(world[i], world[j]) < 0]
    assert apart == kept and 0 < len(apart) < len(together)
    assert any(world[i] != world[j] for i, j in apart)


def test_many_bodies_cost_what_is_near():
    """30,000 bodies: 900 million pairs, of which a spatial tree finds the few; nothing of that size is ever made."""
    count = 30_000
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 80, (count, 3))
    ball = replace(SHAPES[1], nodes=SHAPES[1].nodes[:1])
    scene = Scene((ball,), tuple(make_body(str(k), 0, p) for k, p in enumerate(place)), np.zeros(3), 1.0)
    bodies, state = from_scene(scene, Units(1.0, 1.0, 1.0), torch.device("cpu"))
    going = torch.arange(count)
    still = Still(swept_boxes(bodies, state, 0 * GRAVITY, REACH, DT, going[:0]))
    first, second = near_pairs(bodies, state, 0 * GRAVITY, REACH, DT, going, still)
    expected = cKDTree(place).query_pairs(0.8 + REACH, p=np.inf)
    assert {(i, j) for i, j in zip(first.tolist(), second.tolist(), strict=True) if i < j} == expected
    assert len(first) == 2 * len(expected) > 1000


def test_what_stays_put_is_sorted_once():
    bodies, state = from_scene(crowd(1), Units(1.0, 1.0, 1.0), torch.device("cpu"))
    memory = Memory()
    first = memory.surroundings(bodies, state, GRAVITY, REACH, DT)[1]
    assert memory.surroundings(bodies, state, GRAVITY, REACH, DT)[1] is first
    memory.begin(bodies, replace(state))  # a state from elsewhere
    assert memory.surroundings(bodies, state, GRAVITY, REACH, DT)[1] is not first
