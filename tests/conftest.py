"""What the tests share: small recordings and scenes, and where the data that is not part of the project lies."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from joblib import parallel_config

from tests.helpers.recordings import ball_data, cube_data, cube_meshes, presets
from tests.helpers.scenes import box_shape, dropped, free_pair

__all__ = ["ball_data", "box_shape", "cube_data", "cube_meshes", "dropped", "free_pair", "presets"]


@pytest.fixture(scope="session", autouse=True)
def in_this_process() -> Iterator[None]:
    """`parallel` works in the test's own process: jobs are small, and every other process loads everything anew."""
    with parallel_config(backend="sequential"):
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder with `kubasic` and `meshes`: $SDFSIM_DATA, or `../shared/data` beside the checkout."""
    default = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
    folder = Path(os.environ.get("SDFSIM_DATA") or default)
    if not (folder / "kubasic").is_dir():
        pytest.skip(
            f"meshes that are not part of the project are not at {folder} (set SDFSIM_DATA, see CONTRIBUTING.md)"
        )
    return folder
