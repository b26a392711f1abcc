"""What the gates run on: every bundled model, the processor and, where there is one, the graphics card."""

from __future__ import annotations

import pytest

from sdfsim.dynamics.model import Model, bundled_models, load_model


@pytest.fixture(scope="session", params=bundled_models())
def model(request) -> Model:
    """Every bundled model."""
    return load_model(request.param)


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Where to compute."""
    return request.param
