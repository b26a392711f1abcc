"""Sleep: resting islands freeze exactly, and wake when something touches or changes them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.dynamics.simulator import Simulator
from sdfsim.dynamics.sleep import STEPS
from sdfsim.scene.scene import Effects, Scene, Waypoints
from sdfsim.shape.shape import analytic_shape
from tests.dynamics.conftest import make_body, random_model

BOX = analytic_shape("box", size=(1.0, 1.0, 1.0))
STILL = np.array([0.0, 0.0, 0.0, 1.0])
FLYER = 6  # the last body


def resting_model(kind: str = "impulse"):
    """It pushes in proportion to nothing at all: what rests without gravity stays at rest."""
    if kind == "paper":
        model = random_model("paper", width=8, steps=1)
        for parameter in model.network.decode.parameters():
            torch.nn.init.zeros_(parameter)
        model.network.target.total.fill_(1.0)
        return model
    model = random_model("impulse", push=0.0)
    for layer in model.network.rounds:
        for head in (layer.normal_impulse, layer.tangent_impulse):
            torch.nn.init.zeros_(head.weight)
            torch.nn.init.zeros_(head.bias)
    return model


def two_islands(flyer_speed: float = 0.0, sleep: str = "on", **fields) -> Scene:
    """Without gravity: boxes 1 and 2 rest on block 0, boxes 4 and 5 on each other on block 3; 6 is on its way to 5."""
    bodies = [
        make_body("block", 0, [0, 0, 0], **({"motion": "static", "mass": 0.0} | fields)),
        make_body("a", 0, [0, 0, 1.02]),
        make_body("b", 0, [0, 0, 2.04]),
        make_body("shelf", 0, [10, 0, 0], motion="static", mass=0.0),
        make_body("c", 0, [10, 0, 1.02]),
        make_body("d", 0, [10, 0, 2.04]),
        make_body("flyer", 0, [10, 0, 8], velocity=np.array([0.0, 0.0, -flyer_speed])),
    ]
    return Scene((BOX,), tuple(bodies), np.zeros(3), 1.0, effects=Effects(sleep=sleep))


def run_until_asleep(scene: Scene, model=None) -> Simulator:
    simulator = Simulator(scene, model or resting_model())
    simulator.run(steps=STEPS + 1)
    assert asleep(simulator) == {1, 2, 4, 5}
    return simulator


def asleep(simulator: Simulator) -> set[int]:
    return set((simulator.state.sleep.island >= 0).nonzero()[:, 0].tolist())


def change(simulator: Simulator, body: int, **values) -> None:
    tensors = {}
    for name, value in values.items():
        tensors[name] = getattr(simulator.state, name).clone()
        tensors[name][body] = torch.as_tensor(value, dtype=torch.float64)
    simulator.state = replace(simulator.state, **tensors)


@pytest.mark.parametrize("kind", ["impulse", "paper"])
def test_islands_freeze_exactly_and_are_not_looked_at(kind, monkeypatch):
    simulator = run_until_asleep(two_islands(), resting_model(kind))
    island = simulator.state.sleep.island
    assert island[1] == island[2] != island[4] == island[5] and island[6] == -1

    def refuse(*_, **__):
        raise AssertionError("asked")

    simulator.run(steps=1)  # the frame before still tells how deep its contacts are
    simulator.model.network.forward = refuse
    simulator.bodies = replace(simulator.bodies, bank=refuse)
    before = simulator.state
    simulator.run(steps=20)
    after = simulator.state
    for name in ("position", "orientation"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    assert (after.velocity == 0).all() and (after.angular_velocity == 0).all()
    counts = simulator.memory.counts
    assert (counts["asleep"], counts["active"], counts["free"]) == (4, 0, 1)
    assert counts["sdf_queries"] == counts["edges"] == 0


def test_a_body_has_to_stay_and_be_in_contact_for_a_while():
    simulator = Simulator(two_islands(flyer_speed=0.05), resting_model())
    simulator.run(steps=STEPS)
    assert asleep(simulator) == set()
    simulator.run(steps=1)
    assert asleep(simulator) == {1, 2, 4, 5}  # not the flyer: it hardly moves, but touches nothing
    restless = Simulator(two_islands(), resting_model())
    for k in range(STEPS + 5):
        change(restless, 1, velocity=[0.0, 0.0, 0.0], angular_velocity=[0.0, 0.0, 1.5 * (k % 5 == 0)])
        restless.run(steps=1)
    assert asleep(restless) == {4, 5}  # one fast body keeps its whole island awake, and no other


@pytest.mark.parametrize(
    "poke",
    [
        {"velocity": [0.0, 0.0, 0.3]},
        {"angular_velocity": [0.0, 0.1, 0.0]},
        {"position": [10.0, 0.0, 1.021]},
        {"orientation": [0.0, 0.0, 0.6, 0.8]},
    ],
)
def test_a_poke_wakes_exactly_its_island(poke):
    simulator = run_until_asleep(two_islands())
    change(simulator, 4, **poke)
    simulator.run(steps=1)
    assert asleep(simulator) == {1, 2}
    assert simulator.memory.counts["active"] == 2


def test_what_arrives_wakes_what_it_reaches_and_nothing_moves_otherwise_before():
    """Until the wake, the flyer moves as in a run without sleep."""
    speed = 4.0
    tired, lively = (Simulator(two_islands(speed, sleep), resting_model()) for sleep in ("on", "off"))
    woken = None
    for k in range(90):
        tired.run(steps=1)
        lively.run(steps=1)
        if woken is None and k >= STEPS and asleep(tired) == {1, 2}:
            woken = k
            break
        assert torch.equal(tired.state.position[FLYER], lively.state.position[FLYER])
    assert woken is not None and woken > STEPS
    # It is an edge within the contact radius that woke it, in the same step in which there is one without sleep.
    for simulator in (tired, lively):
        ends = set(zip(simulator.contacts.owner.tolist(), simulator.contacts.body.tolist(), strict=True))
        assert (FLYER, 5) in ends and (4, 5) in ends
    assert tired.memory.counts["active"] == 3


def test_a_change_of_gravity_wakes_all():
    simulator = run_until_asleep(two_islands())
    simulator.run(steps=3)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    simulator.rules = replace(simulator.rules, gravity=down, falls=True)
    simulator.run(steps=1)
    assert asleep(simulator) == set()
    assert (simulator.state.velocity[[1, 2, 4, 5], 2] < 0).all()


def test_a_support_that_is_taken_away_wakes_what_rested_on_it():
    simulator = run_until_asleep(two_islands())
    change(simulator, 3, position=[50.0, 0.0, 0.0])
    simulator.run(steps=1)
    assert asleep(simulator) == {1, 2}


def test_a_body_on_a_path_wakes_its_neighbours_when_it_starts():
    start = (STEPS + 20) * 0.02
    path = Waypoints(np.array([start, start + 1.0]), np.array([[0.0, 0, 0], [0, 0, -1.0]]), np.stack([STILL, STILL]))
    simulator = Simulator(two_islands(motion="kinematic", path=path), resting_model())
    waited = round(start / simulator.dt) - 1
    for k in range(waited + 3):
        simulator.run(steps=1)
        if STEPS < k < waited - 1:
            assert asleep(simulator) == {1, 2, 4, 5}
    assert asleep(simulator) == {4, 5}


def test_nobody_sleeps_beside_a_body_that_turns_on_its_path():
    turned = np.array([0.0, 0.0, np.sin(0.05), np.cos(0.05)])
    path = Waypoints(np.array([0.0, 10.0]), np.zeros((2, 3)), np.stack([STILL, turned]))
    simulator = Simulator(two_islands(motion="kinematic", path=path), resting_model())
    for _ in range(STEPS + 5):
        simulator.run(steps=1)
        assert not asleep(simulator) & {1, 2}
    assert asleep(simulator) == {4, 5} and (simulator.state.velocity[0] == 0).all()


def test_a_state_keeps_who_sleeps():
    simulator = run_until_asleep(two_islands(flyer_speed=1.0))
    kept = simulator.state
    simulator.run(steps=10)
    restored = Simulator(two_islands(flyer_speed=1.0), resting_model())
    restored.state = kept
    restored.run(steps=10)
    assert asleep(restored) == {1, 2, 4, 5}
    assert torch.equal(restored.state.position, simulator.state.position)
    simulator.state = kept  # back in time, in the same run
    simulator.run(steps=10)
    assert torch.equal(restored.state.position, simulator.state.position) and asleep(simulator) == {1, 2, 4, 5}


def test_sleep_that_never_comes_changes_nothing(dropped):
    model = random_model("impulse")
    on = Simulator(replace(dropped, effects=Effects(sleep="on")), model)
    one, other = on.run(steps=12), Simulator(dropped, model).run(steps=12)
    assert (one.position == other.position).all() and (one.orientation == other.orientation).all()
    assert asleep(on) == set() and one.contact_count.sum() > 0
