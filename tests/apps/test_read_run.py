"""A run and its scene: what was edited since is not shown with the motion of before."""

import pytest

from sdfsim import Simulator, load_scene
from sdfsim.apps.run import read_run, simulate
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_json
from sdfsim.physics.rollout import Rollout

SCENE = """
version: 1
duration: 0.1
shapes:
  ball: {sphere: {radius: 0.1}}
  ring: {primitive: {name: box, size: 0.2}, sdf: mesh}
bodies:
  - {name: floor, plane: {}}
  - {name: ball, shape: ball, position: [0, 0, 0.5], mass: 1, friction: 0.4}
  - {name: ring, shape: ring, position: [1, 0, 0.5], mass: 1}
"""
SHAPES = {  # edits of what is shown
    "a radius": ("radius: 0.1", "radius: 0.2"),
    "a form": ("sphere: {radius: 0.1}", "box: {size: [0.2, 0.2, 0.2]}"),
    "a size": ("size: 0.2", "size: 0.25"),
    "a mesh": ("name: box", "name: cone"),
    "a shape": ("shape: ring", "shape: ball"),
    "a scale": ("shape: ball,", "shape: ball, scale: 1.01,"),
    "a motion": ("0.5], mass: 1}", "0.5], motion: static}"),
    "a wall": ("radius: 0.1}", "radius: 0.1}, wall: 0.01"),
}
OTHERS = {
    "a place": ("[0, 0, 0.5]", "[0, 0, 0.6]"),
    "a mass": ("mass: 1, friction", "mass: 2, friction"),
    "a friction": ("friction: 0.4", "friction: 0.5"),
    "gravity": ("duration: 0.1", "duration: 0.1\ngravity: [0, 0, -1.6]"),
}
HARMLESS = {
    "nothing": ("version: 1", "version: 1"),
    "a comment": ("version: 1", "version: 1  # as it was"),
    "a duration": ("duration: 0.1", "duration: 0.4"),
    "another way to say it": ("[0, 0, 0.5]", "[0.0, 0.0, 5.0e-1]"),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run folder and its scene file."""
    folder = tmp_path_factory.mktemp("made")
    file = folder / "scene.yaml"
    file.write_text(SCENE)
    options = {"model": None, "seconds": None, "seed": None, "viewer": "none", "device": "cpu"}
    simulate(file, folder / "run", **options, on_progress=lambda *_: None, say=lambda _: None)  # type: ignore[arg-type]
    return folder / "run", file


def edited(file, old: str, new: str) -> None:
    assert SCENE.count(old) >= 1
    file.write_text(SCENE.replace(old, new, 1))


@pytest.mark.parametrize("what", [*SHAPES, *OTHERS])
def test_a_scene_that_was_edited_is_refused(made, what):
    run, file = made
    edited(file, *(SHAPES | OTHERS)[what])
    with pytest.raises(SdfsimError, match=r"rollout\.npz: .*scene\.yaml"):
        read_run(run)


@pytest.mark.parametrize("what", HARMLESS)
def test_what_changes_nothing_of_the_motion_is_no_edit(made, what):
    run, file = made
    edited(file, *HARMLESS[what])
    scene, rollout = read_run(run)
    assert rollout.names == tuple(body.name for body in scene.bodies)


@pytest.mark.parametrize("what", [*SHAPES, *OTHERS])
def test_a_scene_that_is_given_need_have_the_same_shapes_only(made, tmp_path, what):
    """Coefficients and masses are what `identify` looks for."""
    other = tmp_path / "other.yaml"
    edited(other, *(SHAPES | OTHERS)[what])
    if what in OTHERS:
        assert read_run(made[0], other)[0].path == other
        return
    with pytest.raises(SdfsimError, match="other shapes"):
        read_run(made[0], other)


def test_a_rollout_that_a_program_saved_is_known_by_its_bodies(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(SCENE)
    Simulator(load_scene(file)).run(steps=2).save(tmp_path / "rollout.npz")
    assert "scene" not in Rollout.load(tmp_path / "rollout.npz").meta
    assert len(read_run(tmp_path / "rollout.npz", file)[1]) == 2
    write_json(tmp_path / "config.yaml", {"scene": str(file)})
    assert len(read_run(tmp_path)[1]) == 2
