"""What a `Simulator` takes from its caller, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sdfsim import SdfsimError, Simulator
from sdfsim.dynamics.simulator import SimulationError
from tests.dynamics.conftest import random_model


def test_a_run_takes_the_steps_that_its_time_is(free_pair):
    simulator = Simulator(free_pair, model=random_model("impulse"))
    step = simulator.dt
    for seconds, steps in ((0, 0), (0.1 * step, 1), (2.4 * step, 2), (2.6 * step, 3)):
        assert len(simulator.run(seconds=seconds)) == steps
    for seconds in (-1.0, -1e-9, float("nan"), float("inf")):
        with pytest.raises(SdfsimError, match="seconds: must be >= 0"):
            simulator.run(seconds=seconds)
    assert simulator.steps_done == 6


WAYS = {
    "initial_rollout": lambda simulator: simulator.initial_rollout(),
    "no steps": lambda simulator: simulator.run(steps=0),
    "run": lambda simulator: simulator.run(steps=1),
    "steps": lambda simulator: next(simulator.steps(1)),
    "frames": lambda simulator: next(simulator.frames(1)),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["position", "velocity", "time"])
def test_a_state_of_the_caller_that_is_no_number_is_refused_in_every_way(free_pair, way, name):
    simulator = Simulator(free_pair, model=random_model("impulse"))
    good = simulator.state
    if name == "time":
        broken, told = float("nan"), "time is not finite"
    else:
        broken, told = getattr(good, name).clone(), f"body 'right': {name} is not finite"
        broken[1, 2] = torch.nan
    simulator.state = replace(good, **{name: broken})
    with pytest.raises(SimulationError, match=f"step 1: {told}"):
        WAYS[way](simulator)
    assert simulator.state is good
