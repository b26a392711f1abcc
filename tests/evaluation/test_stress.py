"""The hard cases as a whole: resumed, reported, and held by the ratchet."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.hard_cases import accepted, slipped_back
from sdfsim.apps import stress as study
from sdfsim.apps.stress import rows, table, write_report
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_json
from sdfsim.evaluation import harness
from sdfsim.evaluation.laws.hard_cases import meshes
from sdfsim.evaluation.laws.scenes import Law
from sdfsim.evaluation.laws.table import laws
from sdfsim.geometry import primitives
from sdfsim.geometry.mesh_io import write_ply
from sdfsim.learned.model import Model, new_network
from tests.helpers import command

FEW = ("overlap-balls", "thin-5")


def save_model(path: Path, *, seed: int = 0, wild: bool = False) -> Path:
    """An untrained model; the answers of a wild one are no numbers."""
    torch.manual_seed(seed)
    network = new_network("impulse", {"width": 8, "rounds": 1})
    for weights in network.parameters():
        weights.data *= torch.nan if wild else 1.0
    ranges = {} if wild else {"friction": [0.2, 0.6], "restitution": [0.25, 0.25], "speed": [0.0, 4.0]}
    Model(path.stem, "impulse", network, 0.02, 10.0, 1.0, 0.1, ranges=ranges).save(path)
    return path


@pytest.fixture
def model(tmp_path) -> str:
    return str(save_model(tmp_path / "untrained.safetensors"))


def shortened(*names: str) -> list[Law]:
    """Laws of the table whose motions end after 0.1 s, so that few figures mean anything."""

    def short(law: Law) -> Law:
        return replace(law, repeats=2, checks=lambda at: law.checks(replace(at, by=lambda scene, _: at.by(scene, 0.1))))

    return [short(law) for law in laws(quick=True) if law.name in names]


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Two short cases, in this process, noted as they run."""
    ran: list[tuple[str, str]] = []

    def one_by_one(function, jobs):
        for index, job in enumerate(jobs):
            ran.append((job[0].case, job[0].method))
            yield index, function(*job)

    monkeypatch.setattr(study, "laws", lambda **_: shortened(*FEW))
    monkeypatch.setattr(harness, "parallel", one_by_one)
    return ran


def run(out: Path, *models: str, **options):
    return study.stress(out, models=models, quick=True, **options)


def test_what_is_finished_is_kept_and_what_changed_is_run_again(tmp_path, model, few):
    first = run(tmp_path / "out", model)
    assert sorted(few) == [(case, who) for case in FEW for who in ("teacher", "untrained")]
    few.clear()
    again = run(tmp_path / "out", model)
    assert few == [] and again.results == first.results
    save_model(Path(model), seed=1)
    run(tmp_path / "out", model)
    assert sorted(few) == [(case, "untrained") for case in FEW], "the teacher is as it was"


def test_the_table_has_a_row_for_every_figure_and_says_what_was_not_run(tmp_path, model, monkeypatch):
    found = run(tmp_path / "out", model)
    head, *shown = rows(found, {})
    assert head == ("case", "figure", "wanted", "untrained", "teacher")
    assert [row[:3] for row in shown[:2]] == [
        ("two balls, half in each other", "exit speed", "at most 3"), ("", "depth left", "")
    ]  # fmt: skip
    cells = {(row[0], row[1]): row[3:] for row in shown}
    assert "†" in cells["5 m/s", "through"][0], "faster than the model was trained on"
    report = write_report(found, tmp_path / "out")
    assert report["failed_checks"] == [] and report["models"]["untrained"]["cases that blew up"] == 0
    text = Path(report["table"]).read_text()
    assert table(found) in text
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == report

    def absent():
        raise SdfsimError("PyBullet is not installed")

    monkeypatch.setattr(study, "import_pybullet", absent)
    assert run(tmp_path / "alone", model).who == ["untrained"]


def broken(model: str) -> str:
    return str(save_model(Path(model).with_name("broken.safetensors"), wild=True))


def test_a_motion_that_blows_up_is_a_row_that_says_so(tmp_path, model):
    found = run(tmp_path / "out", broken(model))
    first = rows(found, {"missed": "**"})[1][3]
    assert first.startswith("**blew up: ") and "step" in first
    assert (tmp_path / "out" / "recordings" / "broken" / "overlap-balls.rrd").stat().st_size > 500
    report = write_report(found, tmp_path / "out")
    assert report["models"]["broken"]["cases that blew up"] == 2
    assert any(check.startswith("overlap-balls with broken blew up: ") for check in report["failed_checks"])


def test_the_command_ends_with_3_when_a_model_blows_up_and_with_0_otherwise(tmp_path, model):
    for weights, code in ((model, 0), (broken(model), 3)):
        out = tmp_path / f"out{code}"
        done = command.run("stress", "-o", str(out), "--model", weights, "--quick", "--json")
        assert done.exit_code == code, done.stderr
        report = json.loads(done.stdout)
        assert bool(report["failed_checks"]) == bool(code) and report["quick"] is True
        assert all(Path(recording).exists() for recording in report["recordings"])


def test_the_ratchet_holds_what_was_accepted_and_no_more(tmp_path, model):
    found = run(tmp_path / "out", model)
    file = tmp_path / "ratchet.json"
    content = accepted(found)
    entry = content["models"]["untrained"]["figures"]["overlap-balls/exit speed"]
    now = entry["value"]
    for was, noise, count in ((now, 0.0, 0), (now - 0.5, 0.1, 1), (now - 0.5, 0.2, 0), (now + 5.0, 0.0, 0)):
        entry.update(value=was, noise=noise)
        write_json(file, content)
        assert len(slipped_back(found, file)) == count
    write_json(file, {"models": {"broken": {"figures": {}, "blew_up": ["overlap-balls"]}}})
    assert slipped_back(run(tmp_path / "blown", broken(model)), file) == ["broken: thin-5: blew up"]


def test_meshes_of_ones_own_rest_too_at_a_metre(tmp_path):
    with pytest.raises(SdfsimError, match="no meshes found"):
        meshes(tmp_path)
    (tmp_path / "brick.ply").write_bytes(write_ply(primitives.box((2.0, 4.0, 1.0))))
    found = meshes(tmp_path)
    np.testing.assert_allclose(np.sort(np.ptp(found["brick"].mesh.vertices, axis=0)), [0.25, 0.5, 1.0], rtol=1e-6)
    assert {"rest-brick", "rest-brick-sleep"} < {law.name for law in laws(quick=True, shapes=found)}
