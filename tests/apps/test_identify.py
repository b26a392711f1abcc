"""What recordings were made with is found again: by closed forms, by PyBullet, by the solve itself; through noise,
gaps and jumps, on ground that is tilted."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import cli
from sdfsim.apps.identify import optimiser
from sdfsim.apps.identify.optimiser import identify
from sdfsim.apps.identify.report import picture, report_lines, write_scene
from sdfsim.apps.observed import COLUMNS, load_recordings
from sdfsim.base.errors import SdfsimError
from sdfsim.learned.model import load_model
from sdfsim.scene.load import load_scene
from sdfsim.simulate.simulator import Simulator, run_all

FLOOR = {"friction": 0.6, "restitution": 0.9}
BOX = {"friction": 0.7, "restitution": 0.4, "mass": 1.0}
BALL = {"friction": 0.3, "restitution": 0.8, "mass": 3.0}
UNKNOWN = {"friction": 0.5, "restitution": 0.5, "mass": 1.0}
LEVEL = [0.0, 0.0, 0.0, 1.0]


def write_scene_file(path: Path, shapes: dict, bodies: list[dict], **keys) -> Path:
    path.write_text(yaml.safe_dump({"version": 1, "model": "solver", **keys, "shapes": shapes, "bodies": bodies}))
    return path


def two_bodies(path: Path, box: dict, ball: dict) -> Path:
    """A box that slides and tumbles into a ball that bounces."""
    bodies = [
        {"name": "floor", "motion": "static", "plane": {"normal": [0, 0, 1], "offset": 0.0}, **FLOOR},
        {"name": "box", "shape": "box", "position": [0, 0, 1], "velocity": [3, 0, 0]}
        | {"angular_velocity": [0.5, 2, 1], **box},
        {"name": "ball", "shape": "ball", "position": [2, 0, 1.2], "velocity": [-4, 0.1, 0], **ball},
    ]
    shapes = {"box": {"box": {"size": [1, 0.8, 0.6]}}, "ball": {"sphere": {"radius": 0.5}}}
    return write_scene_file(path, shapes, bodies, duration=3.0)


def write_poses(path: Path, time, names, position, quat) -> Path:
    """Poses [T, D, *] as a CSV; a row of NaN is left empty."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(COLUMNS)
        for t, now in enumerate(time):
            for k, name in enumerate(names):
                values = [*position[t, k], *quat[t, k]]
                rows.writerow([now, name, *("" if np.isnan(v) else v for v in values)])
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the motion of known bodies, and the scene as one knows it who has only watched."""
    folder = tmp_path_factory.mktemp("recorded")
    rollout = Simulator(load_scene(two_bodies(folder / "known.yaml", BOX, BALL)), "solver").run()
    rollout.save(folder / "rollout.npz")
    write_poses(folder / "poses.csv", rollout.time, rollout.names, rollout.position, rollout.orientation)
    two_bodies(folder / "scene.yaml", UNKNOWN, UNKNOWN)
    return folder


@pytest.mark.parametrize(
    ("file", "exact"), [("rollout.npz", 0.01), pytest.param("poses.csv", 0.05, marks=pytest.mark.slow)]
)
def test_what_a_motion_of_two_bodies_was_made_with_is_found_again(recorded, file, exact):
    found = identify(*load_recordings([recorded / file], recorded / "scene.yaml")).report()
    for kind in ("friction", "restitution"):
        own = {"box": BOX[kind], "ball": BALL[kind]}
        products = {"box / floor": own["box"] * FLOOR[kind], "ball / floor": own["ball"] * FLOOR[kind]}
        products["box / ball"] = own["box"] * own["ball"]
        for expected, estimates in ((own, found[f"own_{kind}"]), (products, found[kind])):
            assert set(estimates) == set(expected)
            for name, value in expected.items():
                assert estimates[name]["value"] == pytest.approx(value, abs=exact), (kind, name)
                low, high = estimates[name]["interval"]
                assert low <= estimates[name]["value"] <= high and high - low < 0.2
    assert found["mass"]["ball"]["value"] == pytest.approx(3.0, rel=2 * exact)
    for kind in ("size", "inertia"):
        for name, estimate in found[kind].items():
            assert estimate["value"] is None or estimate["value"] == pytest.approx(1.0, abs=2 * exact), (kind, name)


def test_what_a_motion_does_not_show_is_not_made_up(recorded, tmp_path):
    """Up to 0.9 s the box has slid on the floor and met the ball, but these two never slid on each other for long."""
    Simulator(load_scene(recorded / "known.yaml"), "solver").run(0.9).save(tmp_path / "rollout.npz")
    found = identify(*load_recordings([tmp_path / "rollout.npz"], recorded / "scene.yaml")).report()
    assert found["friction"]["box / ball"] == {"value": None, "interval": None}
    assert found["own_friction"]["box"]["value"] == pytest.approx(BOX["friction"], abs=0.01)


def test_a_body_that_only_falls_tells_nothing(recorded, tmp_path):
    scene = load_scene(recorded / "known.yaml")
    up = np.array([0.0, 0.0, 50.0])
    high = tuple(replace(b, position=b.position + up, velocity=up) for b in scene.bodies[1:])
    falls = replace(scene, bodies=(scene.bodies[0], *high), duration=0.5)
    Simulator(falls, "solver").run().save(tmp_path / "rollout.npz")
    with pytest.raises(SdfsimError, match="nothing touches"):
        identify(*load_recordings([tmp_path / "rollout.npz"], recorded / "scene.yaml"))


# --- closed forms ---


def sliding_block(folder: Path, *, friction=0.3, slope=0.0, noise=0.0, rest: int | None = None) -> Path:
    """A block of 20 cm that slides to a stop, straight over ground that rises by `slope` rad along x, for 1.2 s in
    all; or `rest` frames longer than it slides, and then without noise."""
    push = 9.81 * (friction * np.cos(slope) + np.sin(slope))
    stop = 2.0 / push
    time = 0.01 * np.arange(120 if rest is None else int(stop / 0.01) + 1 + rest)
    way = np.where(time < stop, 2.0 * time - 0.5 * push * time**2, 0.5 * 2.0 * stop)
    turn = Rotation.from_euler("y", -slope)
    place = turn.apply(np.stack([way, 0 * way, np.full_like(way, 0.1)], 1))[:, None]
    shaken = (time < stop) | (rest is None)
    place += noise * np.random.default_rng(1).standard_normal(place.shape) * shaken[:, None, None]
    write_poses(folder / "block.csv", time, ["block"], place, np.tile(turn.as_quat(), (len(time), 1, 1)))
    bodies = [
        {"name": "ground", "plane": {"normal": turn.apply([0, 0, 1]).tolist()}, "friction": 1.0, "restitution": 1.0},
        {"name": "block", "shape": "block", "position": [0, 0, 0.1], "friction": 0.5},
    ]
    return write_scene_file(folder / "scene.yaml", {"block": {"box": {"size": [0.2] * 3}}}, bodies)


@pytest.mark.parametrize(("slope", "noise"), [(0.0, 0.0), (0.1, 0.0), (0.0, 3e-4)])
def test_a_sliding_block_shows_its_friction_and_no_restitution(tmp_path, slope, noise):
    """Its stop is v^2 / (2 g (mu cos a + sin a)) away."""
    scene = sliding_block(tmp_path, slope=slope, noise=noise)
    found = identify(*load_recordings([tmp_path / "block.csv"], scene)).report()
    told = found["friction"]["block / ground"]
    assert told["value"] == pytest.approx(0.3, abs=0.015)
    assert found["restitution"]["block / ground"]["value"] is None
    assert told["interval"][0] - 0.01 < 0.3 < told["interval"][1] + 0.01


def test_a_block_on_a_tray_that_is_pulled_away_shows_its_friction(tmp_path):
    """A body on a path: the tray accelerates by more than friction can follow, and the block by its coefficient."""
    time, friction, pull = np.arange(0.0, 0.6, 0.01), 0.3, 6.0
    still = np.zeros_like(time)
    way = 0.5 * friction * 9.81 * time**2
    place = np.stack([way, still, still + 0.1], 1)[:, None]
    write_poses(tmp_path / "block.csv", time, ["block"], place, np.tile([0, 0, 0, 1.0], (len(time), 1, 1)))
    path = [{"time": t, "position": [0.5 * pull * t**2, 0, -0.05]} for t in time.tolist()]
    bodies = [
        {"name": "tray", "shape": "tray", "path": path, "motion": "kinematic", "friction": 1.0, "restitution": 1.0},
        {"name": "block", "shape": "block", "position": [0, 0, 0.1], "friction": 0.5},
    ]
    shapes = {"block": {"box": {"size": [0.2] * 3}}, "tray": {"box": {"size": [3.0, 0.6, 0.1]}}}
    scene = write_scene_file(tmp_path / "scene.yaml", shapes, bodies)
    told = identify(*load_recordings([tmp_path / "block.csv"], scene)).report()["friction"]["block / tray"]
    assert told["value"] == pytest.approx(friction, abs=0.015)


def test_the_picture_shows_what_the_recordings_tell_and_what_they_do_not(tmp_path, monkeypatch):
    scene = sliding_block(tmp_path, noise=3e-4)
    out, kept = tmp_path / "found.yaml", []
    monkeypatch.setattr(optimiser, "identify", lambda *given, **how: kept.append(identify(*given, **how)) or kept[0])
    done = CliRunner().invoke(
        cli.app, ["identify", str(tmp_path / "block.csv"), "--scene", str(scene), "-o", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["picture"] == str(out.with_suffix(".png"))
    with Image.open(out.with_suffix(".png")) as image:
        assert image.format == "PNG" and min(image.size) > 200
    (found,) = kept
    profiles = {p.estimate.kind: p for p in found.profiles}
    friction, restitution = profiles["own_friction"], profiles["own_restitution"]
    # Stopping after v^2 / (2 g mu): what is off by a tenth of that is seen, on either side of the 0.3 it was made with.
    assert friction.x[int(np.argmin(friction.loss))] == pytest.approx(0.3, abs=0.015)
    assert min(friction.loss[0], friction.loss[-1]) > 1.02
    assert restitution.estimate.interval is None and max(restitution.loss) < 1.2  # noise at the start rebounds a little
    assert restitution.estimate.lines() == ("restitution of its own: block", "not shown by these recordings")
    assert friction.estimate.lines()[0] == "friction of its own: block" and " to " in friction.estimate.lines()[1]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert picture(found, tmp_path / "none.png") == "matplotlib is not installed: pip install 'sdfsim[bench]'"
    assert not (tmp_path / "none.png").exists()


def bounces(restitution: float, height: float, ground: float, frames: int = 200, dt: float = 0.005) -> np.ndarray:
    """Heights of a ball of 5 cm radius that falls from rest onto z = `ground`, impacts in closed form."""
    floor, z, speed, left, found = ground + 0.05, height, 0.0, dt, [height]
    while len(found) < frames:
        fall = (speed + np.sqrt(speed**2 + 2 * 9.81 * max(z - floor, 0.0))) / 9.81
        step = min(left, fall)
        z, speed, left = z + speed * step - 0.5 * 9.81 * step**2, speed - 9.81 * step, left - step
        if step == fall:
            z, speed = floor, -restitution * speed
        if left <= 1e-12:
            found.append(z)
            left = dt
    return np.array(found)


def bouncing_balls(folder: Path, count: int = 6, *, ground: float = 0.004, noise: float = 1e-4) -> Path:
    rng = np.random.default_rng(2)
    for k in range(count):
        z = bounces(0.7, 0.3 + 0.1 * k, ground)
        place = np.stack([0.3 * k + 0 * z, 0 * z, z], 1)[:, None]
        place += noise * rng.standard_normal(place.shape)
        write_poses(folder / f"{k}.csv", 0.005 * np.arange(len(z)), ["ball"], place, np.tile(LEVEL, (len(z), 1, 1)))
    bodies = [
        {"name": "ground", "plane": {}, "friction": 1.0, "restitution": 0.9},
        {"name": "ball", "shape": "ball", "position": [0, 0, 1]},
    ]
    return write_scene_file(folder / "scene.yaml", {"ball": {"sphere": {"radius": 0.05}}}, bodies)


def test_bouncing_balls_show_restitution_and_where_the_ground_is(tmp_path):
    """Ground that lies 4 mm higher than the scene says, and a ball that is larger than it says, bounce alike: one of
    the two is moved so far, or both by half."""
    scene = bouncing_balls(tmp_path)
    recordings, loaded = load_recordings([tmp_path], scene)
    assert [r.name for r in recordings] == [str(tmp_path / f"{k}.csv") for k in range(6)]
    found = identify(recordings, loaded)
    report = found.report()
    told = report["restitution"]["ball / ground"]
    assert told["interval"][0] - 0.005 < 0.7 < told["interval"][1] + 0.005 and told["value"] == pytest.approx(
        0.7, abs=0.01
    )
    assert report["friction"]["ball / ground"]["value"] is None
    ball, ground = report["scene"]["ball"], report["scene"]["ground"]
    # Impacts are found to one inner step: at 2 m/s that is a millimetre.
    assert ground["position"][2] + 0.05 * ball["scale"] == pytest.approx(0.054, abs=1.5e-3)
    assert report["held_out"]["recordings"] == 1
    assert report["held_out"]["after"][0] < 0.2 * report["held_out"]["before"][0]


# --- what trackers do ---


def test_gaps_jumps_flips_and_rows_without_numbers_are_survived(tmp_path):
    scene = bouncing_balls(tmp_path, noise=5e-5)
    spoilt, rng, jumps = tmp_path / "spoilt", np.random.default_rng(3), 0
    spoilt.mkdir()
    for k in range(3):
        rows = list(csv.reader((tmp_path / f"{k}.csv").open()))
        head, body = rows[0], rows[1:]
        for t in rng.choice(np.arange(10, 190, 10), 4, replace=False):
            body[t][2:5] = [float(v) + 0.3 for v in body[t][2:5]]
            jumps += 1
        for t in rng.choice(np.arange(15, 190, 10), 3, replace=False):
            body[t][2:] = ["nan"] * 7
        for t in rng.choice(200, 60, replace=False):
            body[t][5:] = [v if v == "nan" else -float(v) for v in body[t][5:]]
        gone = set(rng.choice(np.arange(12, 190, 10), 3, replace=False).tolist())
        with (spoilt / f"{k}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *(row for t, row in enumerate(body) if t not in gone)])
    recordings, loaded = load_recordings([spoilt], scene)
    assert sum(r.jumps for r in recordings) == jumps
    assert sum(r.lost for r in recordings) == 3 * (3 + 3)
    for r in recordings:
        assert np.abs(r.velocity[r.known]).max() < 5.0 and r.known.mean() > 0.5
        assert np.linalg.norm(r.angular_velocity[r.known], axis=-1).max() < 1e-3
    found = identify(recordings, loaded)
    assert found.report()["restitution"]["ball / ground"]["value"] == pytest.approx(0.7, abs=0.015)
    assert any("12 jumps" in line and "18 poses" in line for line in report_lines(found))


def test_a_start_is_fitted_through_the_flight(tmp_path):
    """Of 0.3 mm of noise at 200 frames a second a raw difference makes 0.06 m/s and more; a tumbling box turns as Euler
    says, by an integrator of another library."""
    from scipy.integrate import solve_ivp

    size, rate = np.array([0.1, 0.06, 0.03]), np.array([3.0, 20.0, 2.0])
    inertia = (np.square(size).sum() - np.square(size)) / 12.0
    momentum = inertia * rate

    def turning(_t, q):
        turn = Rotation.from_quat(q)
        spin = turn.apply(turn.inv().apply(momentum) / inertia)
        x, y, z = 0.5 * spin
        return np.array([[0, -z, y, x], [z, 0, -x, y], [-y, x, 0, z], [-x, -y, -z, 0]]) @ q

    time = np.arange(0.0, 0.2, 0.005)
    quat = solve_ivp(turning, (0, 0.2), LEVEL, t_eval=time, rtol=1e-10, atol=1e-12).y.T
    rng = np.random.default_rng(5)
    noisy = Rotation.from_rotvec(3e-3 * rng.standard_normal((len(time), 3))) * Rotation.from_quat(quat)
    place = np.stack([0.8 * time, 0 * time, 1.0 + 1.1 * time - 0.5 * 9.81 * time**2], 1)
    place += 3e-4 * rng.standard_normal(place.shape)
    write_poses(tmp_path / "box.csv", time, ["box"], place[:, None], noisy.as_quat()[:, None])
    bodies = [{"name": "ground", "plane": {}}, {"name": "box", "shape": "box", "position": [0, 0, 1]}]
    scene = write_scene_file(tmp_path / "scene.yaml", {"box": {"box": {"size": size.tolist()}}}, bodies)
    (found,), _ = load_recordings([tmp_path / "box.csv"], scene)
    assert found.flying[2:-2].all() and found.known[2:-2].all()
    assert found.velocity[4, 0] == pytest.approx([0.8, 0.0, 1.1 - 9.81 * 0.02], abs=0.006)
    spin = Rotation.from_quat(quat[4])
    assert found.angular_velocity[4, 0] == pytest.approx(spin.apply(spin.inv().apply(momentum) / inertia), abs=0.15)
    assert found.noise[0] == pytest.approx(3e-4, rel=0.4)


# --- the scene that is written ---


def test_the_scene_that_is_written_moves_as_identified(tmp_path):
    """Boxes tossed onto a tilted slab, found again from their poses, and simulated once more from the file."""
    shapes = {"box": {"box": {"size": [0.2, 0.15, 0.1]}}, "slab": {"box": {"size": [4, 4, 0.2]}}}

    def scene(path: Path, angle: float, height: float, own: dict, **start) -> Path:
        slab = {"name": "slab", "shape": "slab", "motion": "static", "position": [0, 0, height - 0.1]}
        slab |= {"euler_xyz_deg": [angle, 0, 0], "friction": 1.0, "restitution": 1.0}
        box = {"name": "box", "shape": "box", "position": [0, 0, 0.4], **own, **start}
        return write_scene_file(path, shapes, [slab, box], duration=0.8, effects={"sleep": "off"})

    true = {"friction": 0.3, "restitution": 0.3, "density": 500.0, "inertia_factor": 1.3}
    rng, known = np.random.default_rng(6), []
    for _ in range(7):
        start = {"velocity": [*rng.uniform(-1, 1, 2), 0.0], "quat_xyzw": Rotation.random(rng=rng).as_quat()}
        start = {name: np.asarray(value).tolist() for name, value in start.items()}
        spin = rng.normal(0, 3, 3).tolist()
        known.append(load_scene(scene(tmp_path / "known.yaml", 2.0, 0.01, true, **start, angular_velocity=spin)))
    folder = tmp_path / "poses"
    folder.mkdir()
    for k, run in enumerate(run_all(known, load_model("solver"))):
        write_poses(folder / f"{k}.csv", run.time, ["box"], run.position[:, 1:], run.orientation[:, 1:])
    start = scene(tmp_path / "scene.yaml", 0.0, 0.0, {"density": 500.0})
    found = identify(*load_recordings([folder], start))
    assert write_scene(found, start, tmp_path / "identified.yaml") == []
    made = load_scene(tmp_path / "identified.yaml")
    slab, box = made.bodies
    assert slab.friction * box.friction == pytest.approx(0.3, abs=0.02)
    assert slab.restitution * box.restitution == pytest.approx(0.3, abs=0.03)
    truth = known[0].bodies[1]
    assert box.mass == pytest.approx(truth.mass)
    assert np.trace(box.inertia) == pytest.approx(np.trace(truth.inertia), rel=0.05)
    assert box.scale == pytest.approx(1.0, abs=0.01)
    top = Rotation.from_quat(slab.quat_xyzw).apply([0, 0, 0.1]) + slab.position
    normal = Rotation.from_quat(slab.quat_xyzw).apply([0, 0, 1])
    assert normal == pytest.approx(Rotation.from_euler("x", 2, degrees=True).apply([0, 0, 1]), abs=0.004)
    expected = Rotation.from_euler("x", 2, degrees=True).apply([0, 0, 0.1])[2] - 0.09
    assert top[2] == pytest.approx(expected, abs=0.002)
    Simulator(made, "solver").run(steps=3)


# --- what is refused ---

HEAD = ",".join(COLUMNS)
ROWS = [f"{0.01 * t},ball,0,0,1,0,0,0,1" for t in range(8)]
BAD = {
    "x": ([HEAD, *ROWS[:3], "0.03,ball,zero,0,1,0,0,0,1"], r"bad\.csv:5: x: must be a number \(got 'zero'\)"),
    "time": ([HEAD, *ROWS[:3], ",ball,0,0,1,0,0,0,1"], r"bad\.csv:5: time: must be a number"),
    "columns": (["time,body,x"], r"bad\.csv:1: columns must be time,body,x,y,z"),
    "twice": ([HEAD, *ROWS, ROWS[2]], r"bad\.csv:10: body: 'ball' has two poses at time 0\.02"),
    "missing": ([HEAD, *(row.replace("ball", "cup") for row in ROWS)], r"bad\.csv: body: no pose of 'ball'"),
    "short": ([HEAD, *ROWS[:3]], r"bad\.csv: time: 3 times \(at least 5\)"),
    "milliseconds": (
        [HEAD, *(f"{10 * t},ball,0,0,1,0,0,0,1" for t in range(8))],
        r"frames are 10 s apart \(at most 1\)",
    ),
    "uneven": ([HEAD, *ROWS, "0.0755,ball,0,0,1,0,0,0,1"], r"bad\.csv: time: must be evenly spaced"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_csv_is_one_line_of_file_line_and_field(tmp_path, what):
    scene = bouncing_balls(tmp_path, 1)
    lines, told = BAD[what]
    (tmp_path / "bad.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(SdfsimError, match=told):
        load_recordings([tmp_path / "bad.csv"], scene)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"quat_xyzw": None}, "quat_xyzw: there is no such array"),
        ({"position": np.zeros((8, 2))}, r"position: must be numbers \[T, bodies, 3\]"),
        ({"dt": None}, "dt: must be one number above 0, in s"),
        ({"dt": 0.0}, "dt: must be one number above 0, in s"),
        ({"start": [0, 5, 7]}, "start: must be whole numbers from 0 to 8"),
        ({"names": ["cup"]}, "names: no body 'ball'"),
        ({"time": np.zeros(8)}, "time: must increase"),
    ],
)
def test_bad_arrays_are_one_line_of_file_and_field(tmp_path, change, told):
    scene = bouncing_balls(tmp_path, 1)
    arrays = {"dt": 0.01, "position": np.zeros((8, 3)), "quat_xyzw": np.tile(LEVEL, (8, 1))} | change
    np.savez(tmp_path / "bad.npz", **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(SdfsimError, match=r"bad\.npz: " + told):
        load_recordings([tmp_path / "bad.npz"], scene)


def test_no_scene_and_empty_folders_are_told(tmp_path):
    bouncing_balls(tmp_path, 1)
    with pytest.raises(SdfsimError, match="without its scene"):
        load_recordings([tmp_path / "0.csv"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(SdfsimError, match="no recordings in this folder"):
        load_recordings([tmp_path / "empty"])


@pytest.mark.parametrize("rest", [0, 51, 400])
@pytest.mark.parametrize("noise", [1e-4, 0.0])
def test_rest_after_a_slide_hides_nothing_of_its_friction(tmp_path, rest, noise):
    scene_file = sliding_block(tmp_path, friction=0.42, noise=noise, rest=rest)
    recordings, scene = load_recordings([tmp_path / "block.csv"], scene_file)
    assert recordings[0].noise[0] == pytest.approx(max(noise, 4e-7), rel=0.5)
    assert recordings[0].known[:20].all()
    found = identify(recordings, scene).report()
    friction = found["friction"]["block / ground"]
    assert friction["value"] == pytest.approx(0.42, abs=0.01)
    assert friction["interval"][0] - 1e-3 <= 0.42 <= friction["interval"][1] + 1e-3
    # What is left of the motion is compared, not the rest: as the scene was, the block came a tenth of its way too far.
    assert found["held_out"]["before"][0] > 5.0 and found["held_out"]["covered"] > 0.9


def test_whole_motions_that_begin_late_are_told(tmp_path):
    """The tracker shakes until half of the way, so that no frame before is smooth."""
    scene_file, file = sliding_block(tmp_path, rest=60), tmp_path / "block.csv"
    rows, rng = list(csv.reader(file.open())), np.random.default_rng(0)
    for row in rows[1:14]:
        row[2:4] = [str(float(value) + rng.normal(0.0, 3e-3)) for value in row[2:4]]
    with file.open("w", newline="") as out:
        csv.writer(out).writerows(rows)
    recordings, scene = load_recordings([file], scene_file)
    assert not recordings[0].known[:10].any() and recordings[0].known[20:].all()
    lines = report_lines(identify(recordings, scene))
    assert any("% of the recorded way" in line for line in lines)
