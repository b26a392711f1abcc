"""Rows 16 (flag), 18, 19 and 21: many bodies, long runs, and a single mover among much scenery."""

import gc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sdfsim
from sdfsim.scene.scene import Effects
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
from tests.helpers.scenes import make_body


def total(rollout) -> np.ndarray:
    return rollout.counters["kinetic_energy"] + rollout.counters["potential_energy"]


def resident() -> float:
    """MiB of memory that the process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="/proc, which tells a process's memory, exists on Linux only"
)
@pytest.mark.parametrize(
    ("settle", "steps", "sleep"),
    [(150, 150, "off"), *(pytest.param(400, 10_000, sleep, marks=pytest.mark.slow) for sleep in ("on", "off"))],
)
def test_many_steps_of_a_settled_pile(model, settle, steps, sleep):
    scene = sdfsim.load_scene(gates.SAMPLES / "pile.yaml")
    sim = Simulator(replace(scene, effects=Effects(sleep=sleep)), model)
    start = total(sim.initial_rollout())[0]
    for _ in sim.steps(settle):
        pass
    settled = total(sim.initial_rollout())[0]
    fallen = start - settled
    objects, memory, worst = None, None, 0.0
    for k, _ in enumerate(sim.steps(steps)):
        if k % max(1, steps // 50) == 0:
            frame = sim.initial_rollout()
            gates.assert_sound(frame)
            worst = max(worst, total(frame)[0] - settled)
        if k in (steps // 4, steps - 1):
            gc.collect()
            if memory is None:
                objects, memory = len(gc.get_objects()), resident()
    assert fallen > 0 and worst < 0.01 * fallen
    assert len(gc.get_objects()) < objects + steps // 2  # one object a step would be more
    assert resident() < memory + 32.0


def test_ten_thousand_static_bodies_cost_one_mover_what_ten_do(model):
    """Counted, not timed: pairs, contact points, nodes and edges of every step."""

    def run(count: int):
        scene = gates.mixed()
        far = tuple(
            make_body(f"far{k}", 0, [30 + 2 * (k % 100), 2 * (k // 100), 1], motion="static", mass=0.0)
            for k in range(count)
        )
        sim = Simulator(replace(scene, bodies=(*scene.bodies, *far)), model)
        return sim.run(steps=12)

    few, many = run(10), run(10_000)
    for name in ("pairs", "contacts", "nodes", "edges", "active", "free"):
        np.testing.assert_array_equal(few.counters[name], many.counters[name], err_msg=name)
    assert few.counters["pairs"].sum() > 0
    np.testing.assert_array_equal(few.position[:, :4], many.position[:, :4])
