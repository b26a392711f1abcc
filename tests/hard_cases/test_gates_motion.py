"""Rows 1 to 5, 7 and 8: what every run of every bundled model keeps to, whatever it has learned.

Of untrained networks the same is tested in tests/physics/test_free_flight.py and tests/learned/test_impulse.py.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sdfsim.physics.bodies import State
from sdfsim.shape.make import analytic_shape
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("position", "orientation", "velocity", "angular_velocity")


@pytest.mark.parametrize("case", gates.CASES)
def test_every_case_stays_sound(every_model, case):
    scene = gates.CASES[case]()
    rollout = Simulator(scene, every_model).run(steps=40)
    gates.assert_sound(rollout)
    assert rollout.counters["active"].sum() > 0  # what is shot has left again when a step ends
    assert np.abs(rollout.position).max() < 40.0 and np.abs(rollout.velocity).max() < 60.0


def test_twenty_seconds_about_the_middle_axis_flip_and_conserve(model):
    box = analytic_shape("box", size=(1.0, 0.8, 0.6))
    spin = np.array([0.02, 5.0, 0.02])
    rollout = Simulator(gates.placed(box, [(0, 0, 0)], angular_velocity=spin), model).run(seconds=20.0)
    turn = Rotation.from_quat(rollout.orientation[:, 0])
    local = turn.inv().apply(rollout.angular_velocity[:, 0])
    inertia = np.diag(box.inertia) / box.volume  # of 1 kg
    energy, momentum = 0.5 * (inertia * local**2).sum(-1), turn.apply(inertia * local)
    assert np.abs(energy / energy[0] - 1).max() <= 1e-3
    assert np.linalg.norm(momentum - momentum[0], axis=-1).max() <= 1e-3 * np.linalg.norm(momentum[0])
    about = local[:, 1]
    assert (np.diff(np.sign(about[np.abs(about) > 1.0])) != 0).sum() >= 2


def apart(model, one, other, steps: int, there=lambda p: p, back=lambda p: p) -> float:
    """Largest distance of two scenes' bodies after any single step from the same state.

    Contact is sharp: what rounding makes of one step grows in those that follow, so each step starts anew.

    Args:
        model: what simulates.
        one, other: scenes.
        steps: how many.
        there: a state [N, ...] of the first scene as the second one has it.
        back: positions [N, 3] of the second scene as the first one has them.
    """
    near, far = (Simulator(s, model) for s in (one, other))
    rows, contacts, worst = gates.moving(one), 0, 0.0
    for _ in range(steps):
        start = replace(near.state, touch=None)
        near.state, far.state = start, there(start)  # both forget what they know of contacts
        (mine,), (theirs,) = near.frames(1), far.frames(1)
        contacts += int(mine.contact_count.sum())
        worst = max(worst, float(np.abs(back(theirs.position[0])[rows] - mine.position[0, rows]).max()))
    assert contacts > 10
    return worst


def in_order(state: State, order: list[int]) -> State:
    """The same bodies in another order."""
    names = ("position", "orientation", "velocity", "angular_velocity")
    return replace(state, **{name: getattr(state, name)[order] for name in names})


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_where_it_happens_does_not_matter(model, distance):
    shift = distance * np.array([1.0, -1.0, 0.5])
    scene = gates.mixed()
    far = replace(scene, bodies=tuple(replace(b, position=b.position + shift) for b in scene.bodies))
    unit = Simulator(scene, model).units.length

    def there(state: State) -> State:
        return replace(state, position=state.position + shift / unit)

    assert apart(model, scene, far, 25, there, lambda p: p - shift) <= 1e-4


def test_the_order_of_bodies_does_not_matter(model):
    scene = gates.mixed()
    order = [2, 0, 3, 1]
    mixed_up = replace(scene, bodies=tuple(scene.bodies[k] for k in order))
    assert apart(model, scene, mixed_up, 25, lambda s: in_order(s, order), lambda p: p[np.argsort(order)]) <= 1e-4


def test_the_order_of_nodes_does_not_matter(model):
    """Networks that look at the first so many nodes have others then, which is another body."""
    if model.nodes is not None:
        pytest.skip(
            f"does not hold for {model.name}: it takes a shape's first {model.nodes} nodes, others in another order"
        )
    scene, rng = gates.mixed(), np.random.default_rng(0)
    shapes = tuple(replace(s, nodes=s.nodes[rng.permutation(len(s.nodes))]) for s in scene.shapes)
    assert apart(model, scene, replace(scene, shapes=shapes), 25) <= 1e-4


@pytest.mark.parametrize(("size", "strength"), [(0.01, 9.81), (1.0, 1.62)])
def test_units_do_not_matter(model, size, strength):
    scene = gates.mixed()
    time = np.sqrt(size * 9.81 / strength)

    def body(b):
        return replace(
            b,
            position=b.position * size,
            scale=b.scale * size,
            mass=b.mass * size**3,
            velocity=b.velocity * size / time,
            angular_velocity=b.angular_velocity / time,
        )

    scaled = replace(scene, gravity=np.array([0.0, 0.0, -strength]), bodies=tuple(body(b) for b in scene.bodies))
    assert apart(model, scene, scaled, 25, back=lambda p: p / size) <= 1e-4


SCRIPT = """
import sys, numpy as np, torch
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
torch.set_num_threads(int(sys.argv[1]))
r = Simulator(gates.mixed(), sys.argv[2], seed=3).run(steps=25)
np.savez(sys.argv[3], **{k: getattr(r, k) for k in ("position", "orientation", "velocity", "angular_velocity")})
"""


def test_the_same_run_in_a_fresh_process(model, tmp_path):
    """Bit for bit with as many threads."""
    for name in ("one", "again"):
        subprocess.run(
            [sys.executable, "-c", SCRIPT, "1", model.name, str(tmp_path / f"{name}.npz")],
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            check=True,
        )
    one, again = (np.load(tmp_path / f"{name}.npz") for name in ("one", "again"))
    for name in NAMES:
        assert one[name].tobytes() == again[name].tobytes(), name


def test_a_step_with_two_threads_is_that_with_one(model):
    """To a millionth of a size, from each state of a run: contacts multiply what rounding does from step to step."""
    simulator, usual = Simulator(gates.mixed(), model), torch.get_num_threads()
    try:
        for _ in range(25):
            before, after = simulator.state, []
            for threads in (2, 1):
                torch.set_num_threads(threads)
                simulator.restore(before)
                after += list(simulator.steps(1))
            two, one = after
            assert np.abs(one.position - two.position).max() <= 1e-6
    finally:
        torch.set_num_threads(usual)
