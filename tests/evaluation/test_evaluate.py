"""The whole report: a perfect model, scenery among the bodies, recordings of other engines on other floors."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sdfsim.data.dataset import Trajectory, trajectory_files
from sdfsim.data.pybullet_sim import engine_settings
from sdfsim.evaluation import evaluate as evaluate_module
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.geometry import primitives
from sdfsim.shape.make import analytic_shape
from sdfsim.shape.shape import with_sdf
from tests.helpers.recordings import bouncing, slab_data, sliding
from tests.helpers.scenes import random_model


@pytest.fixture
def replayed(monkeypatch):
    """The model does what was recorded."""

    def replay(model, group, shapes, steps, *_, **__):
        return group

    monkeypatch.setattr(evaluate_module, "roll_out", replay)


@pytest.fixture
def with_bowl(tmp_path):
    """One thrown-ball trajectory with a static concave bowl, which has neither mass nor inertia, before the balls."""
    t = bouncing(3)
    start = np.tile([[0.0, 0.0, 5.0]], (len(t.position), 1, 1))
    grown = {name: np.concatenate([0 * start, getattr(t, name)], 1) for name in ("velocity", "angular_velocity")}
    grown |= {"position": np.concatenate([start, t.position], 1), "static": np.array([True, False, False])}
    grown |= {name: np.concatenate([[0.0], getattr(t, name)]) for name in ("mass", "friction", "restitution")}
    grown["orientation"] = np.concatenate([t.orientation[:, :1], t.orientation], 1)
    grown["inertia"] = np.concatenate([np.zeros((1, 3)), t.inertia])
    grown["scale"], grown["shape"] = np.ones(3), np.array(["bowl", "ball", "ball"])
    replace(t, **grown).save(tmp_path / "0.npz")
    analytic_shape("sphere", radius=0.5, name="ball").save(tmp_path / "shapes" / "ball")
    bowl = replace(analytic_shape("sphere", radius=0.5, name="bowl"), mesh=primitives.bowl(2.0, 0.3))
    with_sdf(bowl, "grid", resolution=24).save(tmp_path / "shapes" / "bowl")
    return tmp_path


def test_a_perfect_model_has_no_error_and_loses_nobody(ball_data, replayed):
    report = evaluate(ball_data, model=random_model("impulse"), split="validation")
    assert list(report["model"]) == ["39"] and report["model"]["39"]["seconds"] == pytest.approx(0.78)
    assert (report["steps"], report["steps_asked"]) == (39, 100)  # the recordings are short, and that is told
    assert report["model"]["39"]["translation_rmse"] == 0.0
    assert report["model"]["39"]["rotation_error"] == pytest.approx(0.0, abs=1e-9)
    for limit in ("0.1", "0.25", "0.5"):
        assert report["median_survival_s"]["model"][limit] is None
    for what in ("penetration", "energy_gain", "resting_speed"):
        assert report[what]["model"] == report[what]["teacher"]
    assert "chaos_floor" not in report


def test_bounces_by_hand_reach_the_floor_and_are_no_deeper(ball_data, replayed):
    """The balls' centres are never below their radius: nodes touch the floor and do not enter it."""
    known = {"size": [0.2, 0.5], "speed": [0.0, 20.0], "mass_ratio": [1.0, 1.5], "friction": [0.0, 1.0]}
    report = evaluate(ball_data, model=replace(random_model("impulse"), ranges=known), split="train")
    size, ratio = report["outside_training"]
    assert "1 to 1 here, random was trained on 0.2 to 0.5" in size and ratio.startswith("heaviest to lightest body: 2")
    depth = report["penetration"]["teacher"]
    assert depth["steps_with_contact"] > 0 and depth["worst"] < 1e-9
    assert report["penetration"]["geometry"] == {"ball": "closed form"}
    assert 0 <= report["energy_gain"]["teacher"]["worst"] < 0.05


def test_static_concave_scenery_is_no_body_of_the_errors(with_bowl, ball_data):
    """The bowl hangs in the air: were it to fall in the baseline, or count as at rest, the numbers would show it."""
    model = random_model("impulse", push=0.02)
    report = evaluate(with_bowl, model=model, split="test")
    plain = with_bowl / "plain"
    plain.mkdir()
    (plain / "shapes").symlink_to(with_bowl / "shapes")
    bouncing(3).save(plain / "0.npz")
    alone = evaluate(plain, model=model)
    errors, lonely = (r["ballistic"]["39"] for r in (report, alone))
    assert errors["translation_rmse"] == pytest.approx(lonely["translation_rmse"])
    assert report["energy_gain"]["teacher"] == alone["energy_gain"]["teacher"]
    assert report["resting_speed"]["bodies"] == alone["resting_speed"]["bodies"]
    assert report["penetration"]["geometry"] == {"ball": "closed form", "bowl": "mesh"}
    assert report["penetration"]["teacher"] == alone["penetration"]["teacher"]


def shrunk(t: Trajectory, size: float) -> Trajectory:
    """The same motion of bodies `size` times as large, under the same gravity (equal Froude number)."""
    time = np.sqrt(size)
    return replace(
        t,
        position=t.position * size,
        velocity=t.velocity * size / time,
        angular_velocity=t.angular_velocity / time,
        scale=t.scale * size,
        mass=t.mass * size**3,
        inertia=t.inertia * size**5,
        dt=t.dt * time,
    )


def test_errors_shrink_with_the_bodies_and_are_the_same_to_the_bit_when_repeated(ball_data, tmp_path):
    for file in trajectory_files(ball_data, "validation"):
        (tmp_path / "validation").mkdir(exist_ok=True)
        shrunk(Trajectory.load(file), 0.1).save(tmp_path / "validation" / file.name)
    (tmp_path / "shapes").symlink_to(ball_data / "shapes")
    large, again = (evaluate(ball_data, split="validation", errors_only=True) for _ in range(2))
    small = evaluate(tmp_path, split="validation", errors_only=True)
    assert large["model"] == again["model"]
    one, other = large["model"]["39"], small["model"]["39"]
    assert one["translation_rmse"] > 0.01
    assert other["seconds"] == pytest.approx(one["seconds"] * np.sqrt(0.1))
    assert other["translation_rmse"] == pytest.approx(0.1 * one["translation_rmse"], rel=0.02)
    assert other["rotation_error"] == pytest.approx(one["rotation_error"], rel=0.02, abs=0.05)


TEACHER = {"engine": "pybullet", "engine_settings": engine_settings(0.02, 5)}
OTHERS = {
    "no dataset.json": None,
    "no engine": {},
    "another engine": {"engine": "mujoco", "engine_settings": {"timeStep": 0.0}},
    "another engine with fine steps": {"engine": "mujoco", "engine_settings": {"timeStep": 0.0005}},
    "PyBullet, settings not told": {"engine": "pybullet"},
    "PyBullet, set otherwise": {
        "engine": "pybullet", "engine_settings": engine_settings(0.02, 5) | {"useSplitImpulse": False},
    },
}  # fmt: skip


@pytest.mark.parametrize(("friction", "other"), [(0.05, 0.3), (0.15, 0.05), (0.0, 0.3)])
def test_the_floor_is_that_of_dataset_json(tmp_path, friction, other):
    told = {"engine": "mine", "floor": {"friction": friction, "restitution": 0.0}}
    data = slab_data(tmp_path, "test", sliding(friction), told)
    report = evaluate(data, errors_only=True)
    assert report["model"]["39"]["translation_rmse"] < 2e-3
    assert report["floor"] == {"friction": friction, "restitution": 0.0, "told": True}
    (data / "dataset.json").write_text(json.dumps(told | {"floor": {"friction": other, "restitution": 0.0}}))
    away = 0.5 * 10.0 * abs(friction - other) * 0.78**2  # in the end, by the difference of two parabolas
    error = evaluate(data, errors_only=True)["model"]["39"]["at_frame"]["translation_rmse"]
    assert error == pytest.approx(away, rel=0.02)


def test_a_rebound_is_that_of_the_floor(tmp_path):
    """A slab that falls flat for 0.2 s and rises with three quarters of its speed, in the end still in the air."""
    step, falls = 0.02, 10
    time = step * np.arange(24)
    hit = step * falls
    height = np.where(time < hit, 5.0 * (hit**2 - time**2), 7.5 * hit * (time - hit) - 5.0 * (time - hit) ** 2)
    speed = np.where(time < hit, -10.0 * time, 7.5 * hit - 10.0 * (time - hit))
    place = np.zeros((24, 1, 3))
    place[:, 0, 2] = 0.1 + height
    motion = {"position": place, "velocity": np.stack([0 * speed, 0 * speed, speed], -1)[:, None]}
    same = {"orientation": np.tile([0.0, 0.0, 0.0, 1.0], (24, 1, 1)), "angular_velocity": np.zeros((24, 1, 3))}
    told = {"engine": "mine", "floor": {"friction": 0.0, "restitution": 0.75}}
    data = slab_data(tmp_path, "test", sliding(0.0, **motion, **same), told)
    assert evaluate(data, errors_only=True)["model"]["23"]["translation_rmse"] < 0.015
    (data / "dataset.json").write_text('{"engine": "mine", "floor": {"friction": 0.0, "restitution": 0.25}}')
    assert evaluate(data, errors_only=True)["model"]["23"]["translation_rmse"] > 0.05


def test_a_slab_at_rest_stays_whoever_recorded_it(tmp_path):
    still = {"position": np.tile([0.0, 0.0, 0.1], (40, 1, 1)), "velocity": np.zeros((40, 1, 3))}
    for name, info in (OTHERS | {"teacher": TEACHER}).items():
        (tmp_path / name).mkdir()
        report = evaluate(slab_data(tmp_path / name, "test", sliding(0.0, **still), info), errors_only=True)
        assert report["floor"]["told"] is False
        assert report["model"]["39"]["at_frame"]["translation_rmse"] < 1e-4
