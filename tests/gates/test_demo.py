"""The README's first command does what it shows: a true surface, and a ball that knocks the vase off the table."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.reconstruct import PHOTOS, evaluate
from sdfsim import Rollout, load_scene
from sdfsim.base.files import read_json

ROOT = Path(__file__).resolve().parents[2]
TABLE = 0.55  # m, the height of its top in samples/photos/table_vase


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    subprocess.run(["bash", "scripts/demo.sh", str(out)], cwd=ROOT, check=True)
    return out


@pytest.mark.gate
def test_the_surface_is_as_near_the_truth_as_it_was(demo):
    """Percent of the table's width, against the mesh that samples/photos/make.py rendered the photos from.

    Two runs of the room had a median of 0.13 and 0.16, 90 % within 0.63 and 0.65, 0.07 and 0.10 missing in the median,
    98.0 and 98.1 % found within 1 % (the set before, without thin leaves, 99.6 %), and a vase hollow by 32 cm of 32.
    Earlier fields, from a ball, scattered by 0.03 and 0.05 from seed to seed; the limits are some four of these away.
    """
    truth, report = evaluate(demo / "scene", PHOTOS), read_json(demo / "scene" / "report.json")
    assert truth["poses"]["center_error_worst_percent"] < 0.5
    assert report["psnr"] > 21.5
    found = truth["surface_percent_of_table_width"]
    assert found["surface"]["median"] < 0.28
    assert found["surface"]["p90"] < 0.85
    assert found["missing"]["median"] < 0.2
    assert found["complete_percent"] > 96.5
    assert found["vase"]["object1"]["hollow_cm"] > 28


@pytest.mark.gate
def test_the_vase_leaves_the_table_and_nothing_goes_through_the_floor(demo):
    scene, rollout = load_scene(demo / "scene" / "knock.yaml"), Rollout.load(demo / "rollout" / "rollout.npz")
    bodies = {body.name: (k, body, scene.shapes[body.shape]) for k, body in enumerate(scene.bodies)}
    high = rollout.position[:, bodies["object1"][0], 2]
    written = yaml.safe_load((demo / "scene" / "scene.yaml").read_text())["bodies"]
    (floor,) = (body["plane"]["offset"] for body in written if "plane" in body)
    assert -0.012 < floor <= 0  # just below the floor that the photos show
    assert high[0] > TABLE and high[-1] < 0.6 * TABLE
    for k, body, shape in (bodies["object1"], bodies["thrown"]):
        own = body.scale * (shape.mesh.vertices - shape.com)
        for position, turn in zip(rollout.position[::10, k], rollout.orientation[::10, k], strict=True):
            lowest = (Rotation.from_quat(turn).apply(own) + position)[:, 2].min()
            assert lowest > floor - 0.02 * np.ptp(own, axis=0).max()


@pytest.mark.gate
def test_a_picture_of_it_lies_beside_the_recording(demo):
    assert (demo / "rollout" / "rollout.rrd").stat().st_size > 100_000
    with Image.open(demo / "rollout" / "rollout.png") as picture:
        view = np.asarray(picture.convert("RGB"), dtype=float)[100:800, 100:1100]
    assert view.std(axis=(0, 1)).min() > 10  # something is in it
