"""The sample scenes do what their first lines say."""

import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sdfsim.apps.run import summary
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.load import load_scene, read_scene
from sdfsim.simulate.simulator import Simulator

SAMPLES = Path(__file__).parents[2] / "samples"


@cache
def run(name: str) -> tuple[Rollout, list[dict]]:
    """The motion of a sample, and where its bodies ended."""
    scene = load_scene(SAMPLES / f"{name}.yaml")
    rollout = Simulator(scene).run()
    return rollout, summary(scene, rollout, 0.0)["ended"]


def track(name: str, body: str) -> np.ndarray:
    rollout, _ = run(name)
    return rollout.position[:, rollout.names.index(body)]


def test_every_sample_can_be_read_and_is_in_the_gallery():
    page = (SAMPLES.parent / "docs" / "tutorial.md").read_text(encoding="utf-8")
    for file in SAMPLES.glob("*.yaml"):
        read_scene(file)
        assert f"images/sample-{file.stem}.jpg" in page and f"samples/{file.name}" in page


@pytest.mark.parametrize(("ball", "e"), [("lively", 0.9), ("middling", 0.7), ("dull", 0.3)])
def test_balls_rebound_to_the_square_of_their_restitution(ball, e):
    height = track("bounce", ball)[:, 2] - 0.05
    first = int(np.argmax(height < 0.005))  # the first impact
    assert height[first:].max() == pytest.approx(e**2 * 0.5, abs=0.01)


def test_on_the_slope_one_block_stays_and_the_others_go_as_in_a_school_book():
    rollout, _ = run("slope")
    along, turn = np.array([0.940, 0.0, -0.342]), np.radians(20.0)
    time = rollout.time[-1]
    for body, gain in (
        ("stays", 0.0),
        ("slides", np.sin(turn) - 0.2 * np.cos(turn)),
        ("ball", 5 / 7 * np.sin(turn)),
        ("roller", 2 / 3 * np.sin(turn)),
    ):
        way = (track("slope", body)[-1] - track("slope", body)[0]) @ along
        assert way == pytest.approx(0.5 * 9.81 * gain * time**2, rel=0.04, abs=2e-3)


def test_all_dominoes_fall_and_rest():
    _, end = run("dominoes")
    assert len(end) == 12 and all(body["rests"] and body["centre_m"][2] < 0.02 for body in end)


@pytest.mark.parametrize("name", ["tower", "heavy_on_light"])
def test_what_is_stacked_stands(name):
    rollout, end = run(name)
    assert all(body["rests"] for body in end)
    moved = np.linalg.norm(np.diff(rollout.position[[-40, -1]], axis=0), axis=-1)
    assert moved.max() < 1e-3
    fallen = rollout.position[0, :, 2] - rollout.position[-1, :, 2]
    assert fallen.max() < 0.025  # what was put a little above has come down to what is below it


def test_marbles_end_in_the_bowl():
    _, end = run("marble_run")
    for body in end:
        x, y, z = body["centre_m"]
        assert np.hypot(x + 0.15, y) < 0.18 and z > 0.02  # above the floor, inside the rim


def test_the_paddle_goes_its_way_whatever_it_meets_and_pushes_all_before_it():
    paddle = track("paddle", "paddle")
    np.testing.assert_allclose(paddle[-1], (0.3, 0.0, 0.07), atol=1e-6)
    box = track("paddle", "box")
    assert box[-1, 0] > box[0, 0] + 0.3


def test_a_scan_in_centimetres_has_the_size_of_a_stone():
    scene = load_scene(SAMPLES / "scan.yaml")
    assert 0.1 < np.ptp(scene.shapes[1].mesh.vertices, axis=0).max() < 0.15


def test_the_vase_is_knocked_off_the_table():
    vase = track("knocked_vase", "vase")
    assert vase[0, 2] > 0.6 and vase[-1, 2] < 0.3


def test_the_car_drives_over_the_ramp_and_the_log():
    way = track("cart", "body")
    rolled = 14.0 * 0.07  # m/s, from the speed of its wheels
    assert way[:, 2].max() > 0.2 and way[-1, 0] > 3.0 and abs(way[-1, 1]) < 0.1
    speed = np.diff(way[-20:, 0]).mean() / np.diff(run("cart")[0].time[-20:]).mean()
    assert speed == pytest.approx(rolled, rel=0.02)


def test_the_fingers_stay_together_and_hold_the_can_in_the_middle():
    left, right, can, hand = (track("gripper", name) for name in ("left", "right", "can", "hand"))
    assert np.abs(left[:, 0] + right[:, 0] - 2 * hand[:, 0]).max() < 1e-4
    assert can[-1, 2] > 0.25 and abs(can[-1, 0]) < 1e-3
    held = can[:, 2] - hand[:, 2]
    assert np.ptp(held[len(held) // 2 :]) < 2e-3  # it does not slip


def test_the_rollers_carry_both_parcels_through_the_gate_and_down_the_chute():
    _, end = run("conveyor")
    parcels = [body for body in end if "parcel" in body["name"]]
    assert all(body["rests"] and body["centre_m"][0] > 0.8 and body["centre_m"][2] < 0.1 for body in parcels)
    assert abs(next(body for body in end if body["name"] == "gate")["centre_m"][2] - 0.45) < 0.01


def test_the_mobile_arm_pushes_the_box_off_the_shelf():
    assert track("mobile_arm", "box")[-1, 2] < 0.3 and track("mobile_arm", "base")[-1, 0] > 1.2


SCRIPT = Path(__file__).resolve().parents[2] / "samples" / "nut.py"


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_nut_goes_down_by_its_pitch_a_turn_or_locks(friction, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["nut.py", str(tmp_path), "--friction", str(friction), "--seconds", "0.8"])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    turns, way = (float(word) for word in capsys.readouterr().out.split()[0:3:2])
    if friction:
        assert turns == pytest.approx(0.0, abs=0.01)
        assert way < 0.2
    else:
        assert 1.2 < turns < 1.7
        assert way == pytest.approx(2.0 * turns, abs=0.15)
    assert (tmp_path / "nut.mp4").is_file()
