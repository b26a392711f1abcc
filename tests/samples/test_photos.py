"""What samples/photos/make.py draws is solid, and the ball of its last scene flies at the body."""

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.reconstruct import BALL, PHOTOS, drawn, dropped_ball
from samples.photos import make
from sdfsim.scene.load import load_scene
from sdfsim.shape.make import analytic_shape

SHAPES = Path(__file__).parents[2] / "samples" / "shapes"


@pytest.mark.parametrize("part", [make.leaves, make.cloth])
def test_leaves_and_cloth_are_closed_and_face_outwards(part):
    import trimesh

    mesh = trimesh.Trimesh(part().vertices, part().faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert all(piece.volume > 0 for piece in mesh.split())


@pytest.mark.parametrize("name", make.TURNED)
def test_what_is_turned_is_closed_and_has_the_volume_of_its_profile(name):
    """Pappus: between two rings the radius goes evenly, so the mean of its square is (a^2 + ab + b^2) / 3."""
    import trimesh

    (outer, inner), _, segments = make.TURNED[name]
    mesh = trimesh.Trimesh(*make.turned_solid(outer, inner, segments), process=False)
    line = np.vstack([make.smooth_profile(outer, 500), make.smooth_profile(inner, 500)])
    (a, b), rise = (line[:-1, 0], line[1:, 0]), np.diff(line[:, 1])
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * ((a**2 + a * b + b**2) / 3 * rise).sum(), rel=0.01)


def test_names_of_sets_are_folders_and_other_folders_stay(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(make, "make_set", lambda name, folder: made.append((name, folder)))
    other = next(name for name in make.SETS if name != make.BUNDLED)
    assert drawn(Path(make.BUNDLED), tmp_path / "run") == PHOTOS and not made
    assert drawn(Path(other), tmp_path / "run") == tmp_path / f"run-{other}"
    assert made == [(other, tmp_path / f"run-{other}")]
    assert drawn(tmp_path, tmp_path / "run") == tmp_path and len(made) == 1


@pytest.mark.parametrize("kind", ["vase", "box"])
def test_a_ball_falls_as_far_into_the_vase_as_that_is_hollow(tmp_path, kind):
    """To its floor; a box has no hollow, so the ball lies on it."""
    size, depth = 0.3, 0.0
    if kind == "vase":
        depth = make.VASE_OUTER[-1][1] - make.VASE_INNER[-1][1]
        shutil.copytree(SHAPES / "vase", tmp_path / "assets" / "object1")
    else:
        analytic_shape("box", size=3 * [size], name="object1").save(tmp_path / "assets" / "object1")
    at = [0.3, 0.2, 0.0 if kind == "vase" else size / 2]
    body = {"name": "object1", "shape": "object1", "position": at, "density": 1500.0, "friction": 0.7}
    bodies = [{"name": "floor", "plane": {}, "friction": 0.8}, body]
    scene = {"version": 1, "shapes": {"object1": {"asset": "assets/object1"}}, "bodies": bodies}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    found = dropped_ball(tmp_path, "object1")
    assert found["below_rim_cm"] == pytest.approx(100 * (depth - BALL), abs=0.4)
    assert found["aside_cm"] < 4


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
