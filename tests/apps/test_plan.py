"""`plan` explains a scene."""

from pathlib import Path

import pytest

from sdfsim.apps.plan import describe, plan_lines
from tests.helpers.scenes import tiny_model

SCENE = """
version: 1
duration: 0.2
effects: {restitution: off}
shapes:
  ball: {sphere: {radius: 0.5}}
bodies:
  - {name: floor, plane: {}}
  - {name: ball, shape: ball, position: [0, 0, 0.5]}
  - {name: ghost, shape: ball, position: [2, 0, 0.5], collides_with: [floor]}
  - {name: far, shape: ball, position: [0, 0, 50], restitution: 0.1}
  - {name: lift, shape: ball, motion: static, position: [9, 0, 0]}
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    ranges = {"friction": [0.2, 0.3], "restitution": [0.25, 0.25]}
    return str(tiny_model(tmp_path_factory.mktemp("model") / "untrained.safetensors", ranges=ranges))


@pytest.fixture
def scene(tmp_path) -> Path:
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path / "scene.yaml"


def told(scene: Path, model: str) -> dict:
    return describe(scene, model=model, device="cpu", on_progress=lambda *_: None)


def test_a_plan_reports_effects_pairs_and_costs(scene, model):
    report = told(scene, model)
    assert [name for name, e in report["effects"].items() if not e["on"]] == ["kinematic", "restitution", "joints"]
    assert (report["static"], report["kinematic"]) == (["floor", "lift"], []) and len(report["dynamic"]) == 3
    # 10 pairs: floor-lift is not driven, ghost meets the floor alone, and only two balls come near the floor.
    pairs = {name: report["pairs"][name] for name in ("total", "unmoved", "excluded", "possible", "near", "apart")}
    assert pairs == {"total": 10, "unmoved": 1, "excluded": 3, "possible": 6, "near": 2, "apart": 4}
    assert report["step"]["contacts"] > 0 and report["step"]["edges"] > 0
    assert report["memory_mib"] > 0 and report["step_ms"] > 0 and report["units"]["length_m"] == 1.0
    assert any(line.startswith("friction") for line in report["outside_training"]) is False  # 0.25 is in its range
    lines = "\n".join(plan_lines(report))
    for word in ("off saves nothing", "[effects.sleep]", "excluded by collides_with"):
        assert word in lines
