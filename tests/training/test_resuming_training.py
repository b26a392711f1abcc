"""A run goes on with the same data only."""

import shutil

import pytest

from sdfsim.base.errors import SdfsimError
from sdfsim.training.train import train
from tests.helpers.recordings import bouncing


@pytest.mark.parametrize("preset", ["tiny", "tiny-sdf-sim"])
def test_a_run_does_not_go_on_with_other_data(ball_data, presets, preset, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(ball_data, other, ignore=shutil.ignore_patterns("frames"))
    bouncing(55).save(other / "train" / "3.npz")
    train(ball_data, tmp_path / "run", preset=preset, steps=2)
    before = (tmp_path / "run" / "checkpoint.npz").read_bytes()
    with pytest.raises(SdfsimError, match=r"\bdata\b"):
        train(other, tmp_path / "run", preset=preset, steps=2, resume=True)
    assert (tmp_path / "run" / "checkpoint.npz").read_bytes() == before
    shutil.copytree(ball_data, tmp_path / "copy")
    assert train(tmp_path / "copy", tmp_path / "run", preset=preset, steps=2, resume=True)["steps"] == 2
