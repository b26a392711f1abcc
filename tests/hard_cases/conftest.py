"""What the gates run on: the contact solve, the bundled network on bodies, and the devices that there are."""

import pytest

from sdfsim.learned.model import SOLVER, Model, load_model
from tests.hard_cases.crashing import undisturbed, works

__all__ = ["undisturbed", "works"]

NETWORK = "gnn"


@pytest.fixture(scope="session", params=[SOLVER, NETWORK])
def every_model(request) -> Model:
    return load_model(request.param)


@pytest.fixture(scope="session", params=[SOLVER, pytest.param(NETWORK, marks=pytest.mark.slow)])
def model(request) -> Model:
    """The contact solve; the network, which takes longer, among the slow tests."""
    return load_model(request.param)


@pytest.fixture(scope="session")
def network() -> Model:
    return load_model(NETWORK)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Where to compute."""
    return request.param
