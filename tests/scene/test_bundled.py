"""Samples go by their names, wherever the command is called, and files of the user's go first."""

import json

import pytest

from sdfsim import SdfsimError, load_scene
from sdfsim.scene.bundled import copy_samples, find_scene, samples
from tests.helpers.command import SCENE, run


def test_a_name_is_a_sample_a_path_is_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(load_scene("tower").bodies) == 5
    (tmp_path / "tower").mkdir()  # as a run of it may be called
    assert len(load_scene("tower").bodies) == 5
    assert str(find_scene("tower.yaml")) == "tower.yaml" and str(find_scene("here/tower")) == "here/tower"
    (tmp_path / "slope").write_text(SCENE)
    assert len(load_scene("slope").bodies) == 2


@pytest.mark.parametrize("name", ["towr", "scene", ""])
def test_what_is_neither_is_told_with_what_there_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SdfsimError) as caught:
        load_scene(name)
    if name:
        assert ("did you mean 'tower'?" in caught.value.message) == (name == "towr")
        assert all(known in caught.value.hint for known in samples())


def test_commands_take_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("export", "tower", "-o", "tower.csv", "--json")
    assert done.exit_code == 0 and json.loads(done.stdout)["bodies"] == 5
    done = run("export", "nosuchrun", "-o", "x.glb")
    assert done.exit_code == 1 and "nosuchrun: no run folder, Shape folder, scene file or sample" in done.stderr
    assert "pile" not in done.stderr
    done = run("export", "runs/none", "-o", "x.glb")
    assert done.exit_code == 1 and "none: no such folder or file" in done.stderr
    done = run("simulate", "towr", "-o", "run")
    assert done.exit_code == 1 and "towr: neither a scene file nor a sample (did you mean 'tower'?)" in done.stderr
    listed = run("samples").stdout
    assert all(name in listed for name in samples()) and "Four blocks" in listed


def test_samples_are_copied_once(tmp_path):
    copy_samples(tmp_path / "mine")
    assert load_scene(tmp_path / "mine" / "knocked_vase.yaml").shapes
    with pytest.raises(SdfsimError, match="exists already"):
        copy_samples(tmp_path / "mine")
