"""A recorded motion beside a run: where it begins, what recordings and pictures show, and how far apart both are."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from sdfsim.apps.beside import COLOR, OPACITY, beside_of, between
from sdfsim.apps.observed import load_beside
from sdfsim.apps.render import SIZE, picture_at
from sdfsim.apps.run import read_run
from sdfsim.base.errors import SdfsimError
from sdfsim.simulate.camera import Camera, Style
from tests.helpers.command import run
from tests.helpers.runs import read, simulate

SCENE = """version: 1
duration: 0.5
gravity: [0, 0, -10]
shapes: {slab: {box: {size: [1.4, 0.7, 0.7]}}}
bodies:
  - {name: floor, plane: {}}
  - {name: other, shape: slab, position: [6, 0, 0.35], mass: 1, motion: static}
  - {name: slab, shape: slab, position: [9, 9, 9], mass: 1}
"""
DT, COUNT = 0.01, 40
VELOCITY = np.array([1.0, -0.5, 2.0])
SPIN = 3.0  # rad/s about z


def flown(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A flight in closed form: positions and quaternions."""
    place = np.array([0.1, 0.2, 1.0]) + time[:, None] * VELOCITY - 5.0 * time[:, None] ** 2 * [0.0, 0.0, 1.0]
    half = 0.5 * SPIN * time
    return place, np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], 1)


@pytest.fixture
def folder(tmp_path):
    """A scene and its recording, whose first frame is lost, and which has two poses that are."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    time = DT * np.arange(COUNT)
    place, turn = flown(time)
    with (tmp_path / "flight.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow("time,body,x,y,z,qx,qy,qz,qw".split(","))
        for k in range(COUNT):
            pose = [""] * 7 if k in (0, 20, 21) else [*place[k], *turn[k]]
            rows.writerow([time[k], "slab", *pose])
    return tmp_path


def test_the_run_begins_where_the_recording_does_and_flies_along(folder):
    """With the velocities that a fit of the flight tells, of the first frame that is there."""
    beside = load_beside(folder / "flight.csv", folder / "scene.yaml")
    report = simulate(folder / "scene.yaml", folder / "run", seconds=0.3, beside=beside)
    scene, rollout = read_run(folder / "run")  # its scene is still that of the file
    place, turn = flown(rollout.time + DT)
    np.testing.assert_allclose(rollout.position[:, 2], place, atol=1e-6)
    np.testing.assert_allclose(np.abs((rollout.orientation[:, 2] * turn).sum(1)), 1.0, atol=1e-9)
    assert rollout.velocity[0, 2] == pytest.approx(VELOCITY - [0.0, 0.0, 10 * DT], abs=1e-6)
    assert report["beside"]["position_m"] < 1e-3 and report["beside"]["rotation_degrees"] < 1e-3
    assert report["beside"]["seconds"] == pytest.approx(0.3, abs=0.03)
    shown = beside_of(folder / "run", scene)
    assert shown is not None and shown.names == ("slab",)
    at = flown(np.array([0.2355]) + DT)[0]
    found = between(shown.time, shown.position, shown.orientation, np.array([0.2355]))[0][0]
    np.testing.assert_allclose(found, at, atol=2e-4)  # between frames as if moved evenly


def test_the_recording_shows_what_was_recorded_to_look_through(folder):
    """Also over a gap, and after its end its last pose; where the run itself goes elsewhere."""
    beside = load_beside(folder / "flight.csv", folder / "scene.yaml")
    moved = (folder / "scene.yaml").read_text().replace("[0, 0, -10]", "[0, 0, -2.5]")
    (folder / "scene.yaml").write_text(moved)
    report = simulate(folder / "scene.yaml", folder / "run", viewer="file", seconds=0.5, beside=beside)
    found = read(folder / "run" / "rollout.rrd")
    ghost, mesh = found["/world/recorded/slab"], found["/world/recorded/slab/mesh!"]
    time = np.array([t.total_seconds() for t in ghost["time"]])
    shown = np.array([row[0] for row in ghost["Transform3D:translation"]])
    np.testing.assert_allclose(shown, flown(np.minimum(time, (COUNT - 2) * DT) + DT)[0], atol=1e-3)
    assert time[-1] == pytest.approx(0.5, abs=0.05)
    color = int(mesh["Mesh3D:albedo_factor"][0][0])
    assert [color >> shift & 255 for shift in (24, 16, 8, 0)] == [*COLOR, round(255 * OPACITY)]
    assert np.ptp(np.array(mesh["Mesh3D:vertex_positions"][0]), axis=0) == pytest.approx([1.4, 0.7, 0.7], abs=1e-6)
    run_itself = np.array([row[0] for row in found["/world/slab"]["Transform3D:translation"]])
    assert np.linalg.norm(run_itself - shown, axis=1).max() > 0.3
    last = beside.time  # of the parabolas: they differ by 3.75 t^2
    assert report["beside"]["position_m"] == pytest.approx(np.sqrt(np.mean((3.75 * last**2) ** 2)), rel=0.02)


def test_a_picture_shows_both_and_what_is_behind(folder):
    beside = load_beside(folder / "flight.csv", folder / "scene.yaml")
    simulate(folder / "scene.yaml", folder / "run", seconds=0.1, beside=beside)
    scene, rollout = read_run(folder / "run")
    # The recorded body stands 2 m before the simulated one, as seen along y, and to the right of it by 0.7 m.
    aside = beside.position - beside.position[:1] + rollout.position[:1, 2:] + [0.7, -2.0, 0.0]
    middle = rollout.position[0, 2]
    camera = Camera(middle - [0.0, 10.0, 0.0], middle)
    ghost = replace(beside, position=aside)
    both, alone = (picture_at(camera, scene, rollout, 0.0, Style(smooth=True), of) for of in (ghost, None))
    pixel = SIZE[1] / 2 / np.tan(np.radians(20.0))  # at 1 m, so many pixels are a metre

    def at(picture: np.ndarray, x: float, away: float) -> np.ndarray:
        return picture[SIZE[1] // 2, round(SIZE[0] / 2 + x * pixel / away)].astype(float)

    for x, away in ((-0.5, 10.0), (-2.0, 10.0)):  # the simulated body alone; nothing of both
        assert (at(both, x, away) == at(alone, x, away)).all()
    behind = [at(alone, 0.35, 10.0), at(alone, 1.2, 8.0)]  # the simulated body, and the floor
    seen = [at(both, 0.35, 10.0), at(both, 1.2, 8.0)]
    assert np.abs(behind[0] - behind[1]).max() > 20  # they are not alike
    own = [(color - (1.0 - OPACITY) * back) / OPACITY for color, back in zip(seen, behind, strict=True)]
    assert own[0] == pytest.approx(own[1], abs=3.0)  # what both have in front is one body
    ratio = own[0] / np.array(COLOR)
    assert ratio == pytest.approx(ratio.mean(), abs=0.15) and 0.3 < ratio.mean() <= 1.1  # in light or shade


def test_which_of_many_recordings_is_meant_is_said(folder):
    place, turn = flown(DT * np.arange(COUNT))
    many = {"position": np.concatenate([place, place + 1.0]), "quat_xyzw": np.concatenate([turn, turn])}
    np.savez(folder / "many.npz", **many, dt=DT, start=[0, COUNT, 2 * COUNT])
    scene = folder / "scene.yaml"
    assert load_beside(folder / "many.npz[1]", scene).position[0, 0] == pytest.approx(place[0] + 1.0)
    for name, told in (
        ("many.npz", r"many\.npz: 2 recordings.*\nhint: .*many\.npz\[0\]"),
        ("many.npz[2]", r"many\.npz\[2\]: there are 2 recordings"),
        ("nothing.npz[0]", "nothing"),
    ):
        with pytest.raises(SdfsimError, match=told):
            load_beside(folder / name, scene)


def test_a_run_is_laid_beside_another(folder):
    """One model's motion beside that of another: a run folder is a recording too."""
    simulate(folder / "scene.yaml", folder / "first", seconds=0.2)
    done = run(
        "simulate", folder / "scene.yaml", "-o", folder / "second", "--beside", folder / "first", "--seconds", 0.2
    )
    assert done.exit_code == 0, done.output
    assert f"off {folder / 'first'} by 0 mm" in " ".join(done.output.split())


def test_a_run_without_leaves_nothing_of_an_earlier_one(folder):
    beside = load_beside(folder / "flight.csv", folder / "scene.yaml")
    simulate(folder / "scene.yaml", folder / "run", beside=beside)
    assert (folder / "run" / "beside.npz").exists()
    simulate(folder / "scene.yaml", folder / "run")
    assert beside_of(folder / "run", read_run(folder / "run")[0]) is None
    replace(beside, names=("who",)).save(folder / "run" / "beside.npz")
    with pytest.raises(SdfsimError, match=r"beside\.npz: not of this scene"):
        beside_of(folder / "run", read_run(folder / "run")[0])
