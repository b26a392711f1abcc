"""The bundled model moves bodies as well as it did: MOVi-B scenes of three plain shapes, made anew by the teacher."""

from pathlib import Path

import pytest

from sdfsim.data.generate import make_dataset
from sdfsim.data.shape_assets import wavefront
from sdfsim.evaluation.evaluate import evaluate
from sdfsim.shape import primitives
from sdfsim.shape.shape import analytic_shape

TRAJECTORIES = 30


@pytest.mark.gate
def test_errors_on_plain_shapes_are_todays(tmp_path: Path):
    pytest.importorskip("pybullet")
    meshes, data = tmp_path / "meshes", tmp_path / "data"
    round_ones = {"cone": primitives.cone(segments=24), "cylinder": primitives.cylinder(segments=24)}
    for name, mesh in {"cube": primitives.box(), **round_ones}.items():
        (meshes / name).mkdir(parents=True)
        for file in ("visual_geometry.obj", "collision_geometry.obj"):
            (meshes / name / file).write_text(wavefront([mesh]))
    analytic_shape("box", size=(1.0, 1.0, 1.0), name="cube").save(data / "shapes" / "cube")
    make_dataset("movi-b", data, shapes=meshes, trajectories=TRAJECTORIES, seed=7, split="test")
    report = evaluate(data, model="small", steps=50)
    at_50 = report["model"]["50"]
    # 0.155 m (0.109 to 0.195) and 8.6 degrees (5.2 to 12.1): today's, and their intervals' ends.
    assert at_50["translation_rmse"] < 0.2
    assert at_50["rotation_error"] < 12.0
