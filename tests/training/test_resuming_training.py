"""What a run goes on with: the same data, frames of this version, all that the model's card needs."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import load_model
from sdfsim.training import train as train_module
from sdfsim.training.contact_frames import FRAMES_VERSION, Disturbed, contact_frames, join_frames
from sdfsim.training.train import train
from tests.helpers.recordings import bouncing

TRAIN, HELD_OUT = Disturbed(draws=2), Disturbed(draws=1)  # as training asks for them


@pytest.fixture
def frames_only(ball_data, tmp_path):
    """What the machine that trains is given: contact frames and dataset.json."""
    for split, how in (("train", TRAIN), ("validation", HELD_OUT)):
        contact_frames(ball_data, split, how)
    shutil.copytree(ball_data / "frames", tmp_path / "given" / "frames")
    shutil.copy(ball_data / "dataset.json", tmp_path / "given")
    return tmp_path / "given"


def rewritten(file, change) -> None:
    """An .npz again with `change` applied to its arrays."""
    with np.load(file) as data:
        arrays = dict(data)
    change(arrays)
    np.savez(file, **arrays)


def test_frames_alone_train_the_same_model_with_the_same_card(frames_only, ball_data, presets, tmp_path):
    train(frames_only, tmp_path / "one", preset="tiny", steps=5)
    train(ball_data, tmp_path / "two", preset="tiny", steps=5)
    one, two = (load_model(tmp_path / name / "model.safetensors") for name in ("one", "two"))
    assert one.card["data"] == two.card["data"]
    assert one.card["data"][0]["trajectories"] == {"train": 6, "validation": 2}
    weights = two.network.state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in one.network.state_dict().items())
    both = contact_frames(frames_only, "train", TRAIN), contact_frames(frames_only, "validation", HELD_OUT)
    assert join_frames(list(both)).trajectories.tolist() == [6, 2]


def test_what_the_card_needs_is_missed_before_training(frames_only, presets, tmp_path):
    (frames_only / "dataset.json").unlink()
    with pytest.raises(SdfsimError, match=r"dataset\.json"):
        train(frames_only, tmp_path / "run", preset="tiny", steps=5)
    assert not (tmp_path / "run").exists()


def test_frames_of_another_version_are_refused_where_nothing_else_shows_it(frames_only):
    def change(arrays):
        arrays["version"] = np.array(FRAMES_VERSION - 1)

    file = next((frames_only / "frames").glob("train-*.npz"))
    rewritten(file, change)
    with pytest.raises(SdfsimError, match=r"\.npz: .*\bversion\b") as error:
        contact_frames(frames_only, "train", TRAIN)
    assert file.name in error.value.message and "made again" in error.value.hint


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


@pytest.mark.parametrize("preset", ["tiny", "tiny-sdf-sim"])
def test_a_training_begins_with_the_weights_that_it_is_given(ball_data, presets, preset, tmp_path):
    """After one step of a tiny rate they are still those of the first training; its feature statistics stay."""
    first = tmp_path / "first" / "model.safetensors"
    train(ball_data, first.parent, preset=preset, steps=20)
    slow = replace(train_module.PRESETS[preset], rate=1e-12, matrix_rate=None)
    train(ball_data, tmp_path / "on", preset=slow, steps=1, seed=5, first=first)
    train(ball_data, tmp_path / "anew", preset=slow, steps=1, seed=5)
    was, on, anew = (
        load_model(folder / "model.safetensors").network.state_dict()
        for folder in (first.parent, tmp_path / "on", tmp_path / "anew")
    )
    assert all(torch.allclose(on[name], value, atol=1e-9) for name, value in was.items())
    assert not all(torch.allclose(anew[name], value, atol=1e-3) for name, value in was.items())
    assert load_model(tmp_path / "on" / "model.safetensors").card["data"][-1]["weights"] == "model"


def test_weights_of_another_network_are_refused_to_begin_with(ball_data, presets, tmp_path):
    train(ball_data, tmp_path / "first", preset="tiny", steps=2)
    given = tmp_path / "first" / "model.safetensors"
    for preset in ("tiny-sdf-sim", "gnn"):
        with pytest.raises(SdfsimError, match="another kind or size than the preset's"):
            train(ball_data, tmp_path / preset, preset=preset, steps=1, first=given)
    with pytest.raises(SdfsimError, match="'nothing' not found"):
        train(ball_data, tmp_path / "no", preset="tiny", steps=1, first="nothing")
    train(ball_data, tmp_path / "on", preset="tiny", steps=2, first=given)
    with pytest.raises(SdfsimError, match="began with other weights"):
        train(ball_data, tmp_path / "on", preset="tiny", steps=2, resume=True)
