"""A run that was interrupted goes on as if nothing had happened, and ends early when asked to; what was edited since is
not shown with the motion of before."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sdfsim import SdfsimError, Simulator, load_scene
from sdfsim.apps import run
from sdfsim.apps.run import read_run
from sdfsim.base.files import write_json
from sdfsim.learned.model import load_model
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Scene, Waypoints
from sdfsim.sdf.grid import sample_grid
from sdfsim.shape.make import analytic_shape
from tests.helpers.runs import Killed, simulate
from tests.helpers.scenes import make_body


@pytest.fixture
def sleepy(tmp_path) -> Path:
    """A ball on its way to the floor, with sleep on, so that all of a state is kept."""
    path = tmp_path / "scene.yaml"
    path.write_text(
        "version: 1\neffects: {sleep: on}\nshapes: {ball: {sphere: {radius: 0.5}}}\nbodies:\n"
        "  - {name: floor, plane: {}}\n  - {name: ball, shape: ball, position: [0, 0, 0.51]}\n"
        "  - {name: far, shape: ball, position: [9, 0, 3]}\n"
    )
    return path


@pytest.mark.parametrize("kind", [pytest.param(KeyboardInterrupt, marks=pytest.mark.slow), Killed])
def test_a_resumed_run_is_the_run(sleepy, tmp_path, monkeypatch, kind):
    monkeypatch.setattr(run, "EVERY", 0.0)
    for _ in range(2):  # interrupted twice, the second time farther on
        with pytest.raises(kind):
            simulate(sleepy, tmp_path / "run", stop=0.3 + 0.3 * _, kind=kind, resume=True)
    part = sorted(p.name for p in (tmp_path / "run" / "checkpoint").glob("part_*.npz"))
    assert len(part) >= 3
    simulate(sleepy, tmp_path / "run", resume=True)
    simulate(sleepy, tmp_path / "whole")
    resumed, whole = (Rollout.load(tmp_path / name / "rollout.npz") for name in ("run", "whole"))
    for name in ("time", "position", "orientation", "velocity", "contact_point", "contact_count"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name), err_msg=name)
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_another_run_is_not_gone_on_with(sleepy, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "EVERY", 0.0)
    with pytest.raises(KeyboardInterrupt):
        simulate(sleepy, tmp_path / "run", stop=0.5)
    sleepy.write_text(sleepy.read_text().replace("0.51]", "0.52]"))
    with pytest.raises(SdfsimError, match="another scene"):
        simulate(sleepy, tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "rollout.npz").exists()
    assert simulate(sleepy, tmp_path / "run", seconds=0.05)["status"] == "done"  # anew
    assert not (tmp_path / "run" / "checkpoint").exists()


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_finished_run_is_left_as_it_is(sleepy, tmp_path, capsys):
    out = tmp_path / "run"
    report = simulate(sleepy, out, seed=3)
    before = content(out)
    again = simulate(sleepy, out, seed=3, resume=True)
    assert capsys.readouterr().out == f"{out}: finished already\n"
    assert again == report and content(out) == before
    for other, told in (({"seconds": 0.3}, r"finished after \d+ steps, 0.1"), ({"seed": 4}, "another scene")):
        with pytest.raises(SdfsimError, match=told):
            simulate(sleepy, out, **({"seed": 3, "resume": True} | other))
        assert content(out) == before


def described() -> tuple[Scene, dict]:
    """A ball beside a paddle on a path, and the options of its simulator: the same at every call."""
    ball = analytic_shape("sphere", radius=0.5)
    ball = replace(ball, sdf=sample_grid(ball.sdf, ball.sdf.bounds, 4))
    still = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    path = Waypoints(np.array([0.0, 1.0]), np.array([[0.0, 0.0, -2.0], [0.0, 0.0, -1.0]]), still)
    bodies = (make_body("paddle", 0, [0, 0, -2], motion="kinematic", path=path), make_body("ball", 0, [0, 0, 0]))
    return Scene((ball,), bodies, np.array([5.0, 0.0, -12.0]), 1.0), {"model": load_model()}


def waypoint(scene: Scene, options: dict):
    path = scene.bodies[0].path
    other = replace(path, position=path.position + np.array([[0, 0, 0], [0, 0, 1e-9]]))
    return replace(scene, bodies=(replace(scene.bodies[0], path=other), scene.bodies[1])), options


def distances(scene: Scene, options: dict):
    values = scene.shapes[0].sdf.values.clone()
    values[1, 2, 3] += 1e-4
    return replace(scene, shapes=(replace(scene.shapes[0], sdf=replace(scene.shapes[0].sdf, values=values)),)), options


def size(scene: Scene, options: dict):
    """Four times as large under four times the gravity: the same in the model's units, and the same step."""
    ball = scene.shapes[0]
    far = [replace(b, scale=4.0, position=4.0 * b.position, mass=1.0) for b in scene.bodies]
    path = scene.bodies[0].path
    far[0] = replace(far[0], path=replace(path, position=4.0 * path.position))
    return replace(scene, shapes=(ball,), bodies=tuple(far), gravity=4.0 * scene.gravity), options


def same(scene: Scene, options: dict):
    return scene, options


@pytest.mark.parametrize("change", [same, waypoint, distances, size])
def test_the_identity_of_a_run_is_all_that_decides_it(change):
    scene, options = described()
    other, others = change(*described())
    equal = run.identity(Simulator(scene, **options)) == run.identity(Simulator(other, **others))
    assert equal == (change is same)


@pytest.mark.parametrize("after", [pytest.param(2, marks=pytest.mark.slow), run.SETTLED])
def test_a_run_until_all_rests_ends_where_it_would_have_however_often_it_is_killed(tmp_path, monkeypatch, after):
    """One that is killed after its last step, before its results are written, makes no step more."""
    monkeypatch.setattr(run, "EVERY", 0.0)
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "version: 1\ngravity: [0, 0, 0]\nshapes: {ball: {sphere: {radius: 0.5}}}\nbodies: [{name: b, shape: ball}]\n"
    )
    step = Simulator(load_scene(scene)).dt
    options = {"seconds": 100 * step, "until_settled": True}
    with pytest.raises(Killed):
        simulate(scene, tmp_path / "run", stop=(after - 0.5) / 100, kind=Killed, **options)
    whole = simulate(scene, tmp_path / "whole", **options)
    resumed = simulate(scene, tmp_path / "run", resume=True, **options)
    assert whole["settled"] and resumed["settled"] and whole["steps"] == resumed["steps"] == run.SETTLED
    assert simulate(scene, tmp_path / "whole", resume=True, **options) == whole


TOWER = Path(__file__).resolve().parents[2] / "samples" / "tower.yaml"


def test_a_run_ends_when_everything_rests(tmp_path):
    report = simulate(TOWER, tmp_path / "run", seconds=3.0, until_settled=True)
    assert report["settled"] and report["simulated_s"] < 1.0
    falling = simulate(TOWER, tmp_path / "short", seconds=0.05, until_settled=True)
    assert falling["settled"] is False and falling["status"] == "done"


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
    simulate(file, folder / "run", seconds=None)
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
