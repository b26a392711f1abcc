"""What the gates run on: the contact solve, every bundled network on top of it, and the devices that there are."""

import pytest

from sdfsim.learned.model import SOLVER, Model, load_model, sound_models
from tests.hard_cases.crashing import undisturbed, works

__all__ = ["undisturbed", "works"]

ON_SOLVE = [name for name in sound_models() if name != SOLVER]


@pytest.fixture(scope="session", params=sound_models())
def every_model(request) -> Model:
    """The contact solve and every bundled network on it."""
    return load_model(request.param)


@pytest.fixture(scope="session", params=[SOLVER, *(pytest.param(name, marks=pytest.mark.slow) for name in ON_SOLVE)])
def model(request) -> Model:
    """The contact solve; the networks, which take longer, among the slow tests."""
    return load_model(request.param)


@pytest.fixture(scope="session", params=ON_SOLVE)
def network(request) -> Model:
    """Every bundled network on the solve."""
    return load_model(request.param)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Where to compute."""
    return request.param
