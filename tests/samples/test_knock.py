"""samples/knock.py: a ball thrown at a body of a reconstruction."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import yaml

from sdfsim.scene.load import load_scene
from sdfsim.shape.make import analytic_shape

SCRIPT = Path(__file__).resolve().parents[2] / "samples" / "knock.py"


def knock(folder: Path, body: str, monkeypatch) -> None:
    spec = importlib.util.spec_from_file_location("knock", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr("sys.argv", ["knock.py", str(folder), body])
    module.main()


def write(folder: Path, size: float, *, scenery: bool) -> None:
    """A block of half a `size` m, on a slab (z = 0 is its top) or on nothing."""
    surface = {"friction": 0.8, "restitution": 0.4}
    shapes, bodies = {}, [{"name": "floor", "motion": "static", "plane": {"normal": [0, 0, 1], "offset": -size}}]
    if scenery:
        analytic_shape("box", size=[4 * size, 4 * size, 0.2 * size], name="scenery").save(folder / "assets" / "scene")
        shapes["scenery"] = {"asset": "assets/scene"}
        bodies.append({"name": "scenery", "shape": "scenery", "motion": "static", "position": [0, 0, -0.1 * size]})
    analytic_shape("box", size=3 * [0.5 * size], name="object1").save(folder / "assets" / "object1")
    shapes["object1"] = {"asset": "assets/object1"}
    bodies.append({"name": "object1", "shape": "object1", "position": [size, 0.0, 0.0], "density": 400.0, **surface})
    (folder / "scene.yaml").write_text(yaml.safe_dump({"version": 1, "shapes": shapes, "bodies": bodies}))


@pytest.mark.parametrize("size", [1.0, 1e-4])
def test_a_ball_flies_at_the_body_from_behind(tmp_path, monkeypatch, size):
    write(tmp_path, size, scenery=True)
    knock(tmp_path, "object1", monkeypatch)
    scene = load_scene(tmp_path / "knock.yaml")
    ball = next(body for body in scene.bodies if body.name == "thrown")
    assert ball.mass == pytest.approx(2 * 400 * (0.5 * size) ** 3, rel=1e-4)
    assert np.ptp(scene.shapes[ball.shape].nodes[:, 0]) == pytest.approx(2 * 0.15 * 0.5 * size, rel=0.1)
    away = np.array([size, 0.0]) - ball.position[:2]
    assert np.linalg.norm(away) == pytest.approx((0.25 + 4 * 0.075) * size, rel=1e-4)
    np.testing.assert_allclose(ball.velocity[:2] / np.linalg.norm(ball.velocity[:2]), away / np.linalg.norm(away),
                               atol=1e-3)  # fmt: skip


def test_the_ball_is_heavier_than_a_hollow_body_by_the_same_factor(tmp_path, monkeypatch):
    write(tmp_path, 1.0, scenery=True)
    text = (tmp_path / "scene.yaml").read_text()
    (tmp_path / "scene.yaml").write_text(text.replace("asset: assets/object1", "asset: assets/object1\n    wall: 0.05"))
    knock(tmp_path, "object1", monkeypatch)
    mass = {body.name: body.mass for body in load_scene(tmp_path / "knock.yaml").bodies}
    assert mass["object1"] == pytest.approx(400 * (0.5**3 - 0.4**3), rel=0.01)
    assert mass["thrown"] == pytest.approx(2 * mass["object1"], rel=1e-4)
