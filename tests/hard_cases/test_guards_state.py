"""What cannot be is an error that names step, body and last good state, and what was computed stays readable."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from sdfsim import Rollout, SdfsimError
from sdfsim.learned import inference
from sdfsim.physics.bodies import State
from sdfsim.simulate.simulator import Simulator
from tests.hard_cases import gates
from tests.helpers.command import run
from tests.helpers.scenes import random_model


def breaking(monkeypatch, at_call: int, name: str, value: float) -> None:
    """At its `at_call`th call the network on bodies answers `value` in the array `name`, for the last body."""
    real, calls = inference.stepped, []

    def stepped(*given) -> State:
        calls.append(1)
        after = real(*given)
        if len(calls) == at_call:
            broken = getattr(after, name).copy()
            broken[-1, 0] = value
            after = replace(after, **{name: broken})
        return after

    monkeypatch.setattr(inference, "stepped", stepped)


def test_a_run_on_disk_is_readable_up_to_the_last_good_step(tmp_path, monkeypatch):
    scene, out = tmp_path / "scene.yaml", tmp_path / "run"
    scene.write_text(
        "version: 1\nduration: 1\nshapes: {ball: {sphere: {radius: 0.5}}}\n"
        "bodies:\n  - {name: floor, plane: {}}\n  - {name: ball, shape: ball, position: [0, 0, 0.52]}\n"
    )
    at = int(np.random.default_rng(7).integers(3, 20))
    breaking(monkeypatch, at, "velocity", np.nan)
    done = run("simulate", scene, "-o", out, "--json", "--model", "gnn")
    assert done.exit_code == 3 and json.loads(done.stdout)["exit_code"] == 3
    rollout, report = Rollout.load(out / "rollout.npz"), json.loads((out / "report.json").read_text())
    # The network is first asked when the ball meets the floor.
    last = report["steps"]
    assert len(rollout) == last >= at - 1 and report["status"] == "failed"
    gates.assert_sound(rollout)
    assert report["error"].startswith(f"step {last + 1}: body 'ball': ") and report["error"] in done.stderr
    assert f"the last good state is that of step {last}" in report["error"]
    assert (out / "rollout.rrd").stat().st_size > 0 and yaml.safe_load((out / "config.yaml").read_text())


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"position": np.array([0.0, np.nan, 1.0])}, "body 'b0': position is not finite"),
        ({"position": np.array([1e15, 0.0, 1.0])}, "too far to be placed exactly"),
        ({"quat_xyzw": np.array([0.0, 0.0, 0.0, 2.0])}, "orientation is not a unit quaternion"),
    ],
)
def test_a_start_that_cannot_be_is_told_before_any_step(fields, told):
    scene = gates.placed(gates.CUBE, [(0, 0, 1)])
    broken = replace(scene, bodies=(replace(scene.bodies[0], **fields),))
    with pytest.raises(SdfsimError, match=told) as caught:
        Simulator(broken, random_model("impulse"))
    assert caught.value.exit_code == 1
