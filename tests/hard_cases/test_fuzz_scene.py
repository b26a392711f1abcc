"""Scene files from strangers: valid ones become what they say, every other one is told about; none crashes or hangs."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sdfsim import SceneError, load_scene
from sdfsim.base.errors import printable
from sdfsim.scene.scene import Scene
from sdfsim.shape.make import analytic_shape, shape_from_mesh
from tests.hard_cases.strangers import Spoiled, mangled_texts, scenes, spoiled_scenes, time_limit

SECONDS = 5.0  # more than a hundred times what a scene of this size takes
FACES = "1 3 4, 1 4 2, 5 6 8, 5 8 7, 1 2 6, 1 6 5, 3 7 8, 3 8 4, 1 5 7, 1 7 3, 2 4 8, 2 8 6".split(", ")
CRATE = "".join(f"v {k // 4} {k // 2 % 2} {k % 2}\n" for k in range(8)) + "".join(f"f {face}\n" for face in FACES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the scenes lie, with the files that they name."""
    made = tmp_path_factory.mktemp("strangers")
    (made / "crate.obj").write_text(CRATE)
    analytic_shape("box", size=(1, 1, 1)).save(made / "crate")
    shape_from_mesh(made / "crate.obj", sdf="mesh")  # loads what is slow to load
    return made


def read(folder: Path, text: str) -> Scene | SceneError:
    """What comes of a text; anything but a scene or a list of faults is let through, and so is a warning."""
    file = folder / "scene.yaml"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    with time_limit(SECONDS), warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return load_scene(file)
        except SceneError as error:
            check_told(error, text)
            return error


def check_told(error: SceneError, text: str) -> None:
    """One clear line each, at a line that the file has."""
    lines = len(text.splitlines()) + 1
    assert error.problems and len(set(error.problems)) == len(error.problems)
    for told in error.problems:
        assert told.isprintable() and len(told) < 2000, told
        place = re.search(r"scene\.yaml:(\d+): ", told)
        assert place and 1 <= int(place[1]) <= lines + text.count("\r"), told


def check_is_what_it_says(scene: Scene, document: dict) -> None:
    """Every field of the document is found in the scene."""
    assert scene.duration == document.get("duration", 4.0) and scene.seed == document.get("seed", 0)
    assert scene.gravity.tolist() == document.get("gravity", [0.0, 0.0, -9.81])
    assert scene.model == document.get("model")
    for key, said in document.get("effects", {}).items():
        assert getattr(scene.effects, key) == said
    bodies = iter(scene.bodies)
    for entry in document["bodies"]:
        for copy in range(entry.get("count", 1)):
            body = next(bodies)
            assert body.name == (f"{entry['name']}[{copy}]" if "count" in entry else entry["name"])
            assert body.motion == entry.get("motion", "static" if "plane" in entry else "dynamic")
            assert (body.scale, body.friction) == (entry.get("scale", 1.0), entry.get("friction", 0.5))
            assert body.restitution == entry.get("restitution", 0.5)
            assert body.velocity.tolist() == entry.get("velocity", [0, 0, 0])
            assert body.angular_velocity.tolist() == entry.get("angular_velocity", [0, 0, 0])
            assert list(body.collides_with or []) == entry.get("collides_with", [])
            if "shape" in entry:
                shape, said = scene.shapes[body.shape], document["shapes"][entry["shape"]]
                extent = {"cm": 0.01}.get(said.get("units", "m"), 1.0)
                size = (
                    said["box"]["size"] if "box" in said else 2 * said.get("sphere", {"radius": extent / 2})["radius"]
                )
                np.testing.assert_allclose(np.ptp(shape.sdf.bounds, axis=0), size, rtol=1e-6)
            if body.motion == "dynamic":
                assert body.mass == entry.get("mass", body.mass) > 0
                if "mass" not in entry:
                    volume = shape.volume * body.scale**3
                    np.testing.assert_allclose(body.mass, entry.get("density", 1000) * volume)
            if "euler_xyz_deg" in entry:
                turn = Rotation.from_euler("xyz", entry["euler_xyz_deg"], degrees=True)
                assert (turn * Rotation.from_quat(body.quat_xyzw).inv()).magnitude() < 1e-9
            if "path" in entry:
                assert body.path.position.tolist() == [pose["position"] for pose in entry["path"]]
            elif "plane" in entry:
                normal = Rotation.from_quat(body.quat_xyzw).apply([0, 0, 1])
                said = np.array(entry["plane"].get("normal", [0, 0, 1]))
                np.testing.assert_allclose(normal, said / np.linalg.norm(said), atol=1e-12)
                np.testing.assert_allclose(body.position @ normal, entry["plane"].get("offset", 0.0), atol=1e-9)
            elif "arrange" in entry:
                low = np.array(entry.get("position", [0, 0, 0]))
                offset, grid = body.position - low, entry["arrange"]["grid"]
                half = entry["arrange"]["spacing"] * (np.array(grid) - 1) / 2
                assert (np.abs(offset[:2]) <= half[:2] + 1e-9).all() and offset[2] >= 0
            else:
                assert body.position.tolist() == entry.get("position", [0, 0, 0])
    assert next(bodies, None) is None


def dump(document: dict) -> str:
    import yaml

    return yaml.safe_dump(document, allow_unicode=True, sort_keys=False)


def try_one(folder: Path, case: dict | Spoiled | str) -> None:
    if isinstance(case, dict):
        made = read(folder, dump(case))
        assert isinstance(made, Scene), made
        check_is_what_it_says(made, case)
    elif isinstance(case, Spoiled):
        error = read(folder, case.text)
        assert isinstance(error, SceneError), f"accepted: {case}"
        field = printable(case.field)
        assert any(field in told for told in error.problems), (field, error.problems)
    else:
        read(folder, case)


cases = st.one_of(scenes(), spoiled_scenes(), mangled_texts())
common = {"deadline": None, "derandomize": True, "database": None, "suppress_health_check": list(HealthCheck)}


@settings(max_examples=60, **common)
@given(case=cases)
def test_no_scene_file_crashes_hangs_or_is_misread(folder, case):
    try_one(folder, case)


@pytest.mark.slow
@settings(max_examples=2500, **common)
@given(case=cases)
def test_thousands_of_scene_files(folder, case):
    try_one(folder, case)
