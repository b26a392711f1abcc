"""What the gates run on: the contact solve, every bundled network, and the devices that there are."""

import pytest

from sdfsim.learned.model import SOLVER, Model, bundled_models, load_model, model_names
from tests.hard_cases.crashing import undisturbed, works

__all__ = ["undisturbed", "works"]


@pytest.fixture(scope="session", params=model_names())
def every_model(request) -> Model:
    """The contact solve and every bundled network."""
    return load_model(request.param)


@pytest.fixture(
    scope="session", params=[SOLVER, *(pytest.param(name, marks=pytest.mark.slow) for name in bundled_models())]
)
def model(request) -> Model:
    """The contact solve; the networks, which take longer, among the slow tests."""
    return load_model(request.param)


@pytest.fixture(scope="session", params=bundled_models())
def network(request) -> Model:
    """Every bundled network."""
    return load_model(request.param)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Where to compute."""
    return request.param
