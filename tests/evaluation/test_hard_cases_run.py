"""The hard cases as a whole: resumed, reported, and held by the ratchet."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import cli
from sdfsim.dynamics.model import Model, new_network
from sdfsim.dynamics.rollout import Rollout
from sdfsim.errors import SdfsimError
from sdfsim.evaluation import hard_cases_run, hard_cases_scenes
from sdfsim.evaluation.hard_cases_list import cases
from sdfsim.evaluation.hard_cases_motion import in_variant, simulated
from sdfsim.evaluation.hard_cases_page import page, report_notes, report_table, write_report
from sdfsim.evaluation.hard_cases_ratchet import accepted, slipped_back
from sdfsim.evaluation.hard_cases_tables import NO_TEACHER, columns, losses, markdown, rows
from sdfsim.files import write_json
from sdfsim.shape import primitives
from sdfsim.shape.mesh import write_ply
from sdfsim.shape.shape import analytic_shape

FEW = ("overlap-balls", "thin-5", "cuda")


def save_model(path: Path, *, factor: float = 1.0) -> Path:
    torch.manual_seed(0)
    network = new_network("impulse", {"width": 8, "rounds": 1})
    for weights in network.parameters():
        weights.data *= factor
    ranges = {"friction": [0.2, 0.6], "restitution": [0.25, 0.25], "speed": [0.0, 4.0]}
    Model(path.stem, "impulse", network, 0.02, 10.0, 1.0, 0.1, ranges=ranges).save(path)
    return path


@pytest.fixture
def model(tmp_path) -> str:
    return str(save_model(tmp_path / "untrained.safetensors"))


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Three short cases, in this process, with their repetitions counted as they run."""
    found = [replace(c, seconds=0.1, repeats=min(c.repeats, 2)) for c in cases(quick=True) if c.name in FEW]
    ran: list[tuple[str, str, int]] = []

    def one_by_one(function, jobs):
        for index, job in enumerate(jobs):
            ran.append((job[0].case.name, job[0].who, job[0].repeat))
            yield index, function(*job)

    monkeypatch.setattr(hard_cases_run, "cases", lambda **_: found)
    monkeypatch.setattr(hard_cases_run, "parallel", one_by_one)
    return ran


def run(out: Path, model: str, **options):
    return hard_cases_run.stress(out, models=[model], quick=True, **options)


def test_what_is_finished_is_kept_and_what_changed_is_run_again(tmp_path, model, few):
    first = run(tmp_path / "out", model)
    both = [("overlap-balls", k) for k in (0, 1)] + [("thin-5", k) for k in (0, 1)]
    assert sorted(few) == sorted((name, who, k) for name, k in both for who in ("untrained", "teacher"))
    few.clear()
    again = run(tmp_path / "out", model)
    assert few == [] and again.results == first.results
    damaged = tmp_path / "out" / "results" / "untrained" / "thin-5-1.json"
    damaged.write_text(damaged.read_text()[:40])
    assert run(tmp_path / "out", model).results == first.results and few == [("thin-5", "untrained", 1)]
    few.clear()
    save_model(Path(model), factor=1.01)
    run(tmp_path / "out", model)
    assert sorted(few) == [(name, "untrained", k) for name, k in both], "the teacher is as it was"


def test_an_interrupted_run_goes_on_where_it_was(tmp_path, model, few, monkeypatch):
    def interrupted(function, jobs):
        for index, job in enumerate(jobs):
            if index == 3:
                raise KeyboardInterrupt
            yield index, function(*job)

    going_on = hard_cases_run.parallel
    monkeypatch.setattr(hard_cases_run, "parallel", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "out", model)
    assert len(list((tmp_path / "out" / "results").rglob("*.json"))) == 3
    monkeypatch.setattr(hard_cases_run, "parallel", going_on)
    resumed = run(tmp_path / "out", model)
    assert len(few) == 8 - 3
    assert resumed.results == run(tmp_path / "whole", model).results


def test_two_models_of_one_name_are_refused(tmp_path, model):
    (tmp_path / "other").mkdir()
    second = save_model(tmp_path / "other" / Path(model).name)
    with pytest.raises(SdfsimError, match="two models are called 'untrained'"):
        hard_cases_run.stress(tmp_path / "out", models=[model, str(second)], quick=True)
    assert not (tmp_path / "out").exists()


def test_the_table_has_a_row_for_every_figure_and_says_what_was_not_run(tmp_path, model, monkeypatch):
    study = run(tmp_path / "out", model)
    table = rows(study)
    assert [row.figure for row in table] == [figure.name for case in study.cases for figure in case.figures]
    assert columns(study) == ["untrained", "teacher"]
    cells = {(row.case, row.figure): row.cells for row in table}
    if not torch.cuda.is_available():
        assert cells["on CUDA", "diverges after"][0].text == hard_cases_run.NO_CUDA
    assert cells["on CUDA", "diverges after"][1].text == "-", "the teacher has no part in it"
    assert "†" in cells["5 m/s", "through"][0].text, "faster than the model was trained on"
    assert len(markdown(study)) == 2 + len(table) + 3
    monkeypatch.setattr(hard_cases_run, "import_pybullet", absent)
    alone = run(tmp_path / "alone", model)
    assert alone.who == ["untrained"] and rows(alone)[0].cells[1].text == NO_TEACHER
    assert NO_TEACHER in page(alone)


def absent():
    raise SdfsimError("PyBullet is not installed")


def test_the_page_needs_nothing_else(tmp_path, model):
    study = run(tmp_path / "out", model)
    report = write_report(study, tmp_path / "out")
    text = Path(report["page"]).read_text()
    assert not re.search(r"https?:|//|<script|<link|@import|url\(", re.sub(r"data:image/png;base64,[\w+/=]+", "", text))
    sources = re.findall(r'src="([^"]{0,30})', text)
    assert sources and all(source.startswith("data:image/png;base64,") for source in sources)
    for row in rows(study):
        assert all(cell.text.replace("<", "&lt;") in text for cell in row.cells)
    assert losses(study)["untrained"]["cases that blew up"] == 0 and report["failed_checks"] == []
    assert any(line.startswith("untrained: ") for line in report_notes(report))
    assert len(report_table(study)) == 1 + len(rows(study)) == 5


def broken(model: str) -> str:
    return str(save_model(Path(model).with_name("broken.safetensors"), factor=1e12))


def test_a_motion_that_blows_up_is_a_row_that_says_so(tmp_path, model):
    recorded = {}
    study = run(tmp_path / "out", broken(model), record=lambda scene, rollout, path: recorded.setdefault(path, rollout))
    cell = rows(study)[0].cells[0]
    assert cell.state == "missed" and cell.text.startswith("blew up: ") and "step" in cell.text
    assert cell.recording == "recordings/broken/overlap-balls-0.rrd"
    kept = recorded[tmp_path / "out" / cell.recording]
    assert isinstance(kept, Rollout) and np.isfinite(kept.position).all()
    report = write_report(study, tmp_path / "out")
    assert report["models"]["broken"]["cases that blew up"] == 2
    assert any(check.startswith("overlap-balls with broken blew up: ") for check in report["failed_checks"])
    assert "blew up: " in Path(report["page"]).read_text() and f'href="{cell.recording}"' in page(study)


def test_the_command_ends_with_3_when_a_model_blows_up_and_with_0_otherwise(tmp_path, model):
    for weights, code in ((model, 0), (broken(model), 3)):
        out = tmp_path / f"out{code}"
        done = CliRunner().invoke(cli.app, ["stress", "-o", str(out), "--model", weights, "--quick", "--json"])
        assert done.exit_code == code, done.stderr
        report = json.loads(done.stdout)
        assert Path(report["page"]).exists() and bool(report["failed_checks"]) == bool(code)
        assert all(Path(recording).exists() for recording in report["recordings"])
        assert len(report["figures"]) == 4 and report["quick"] is True


def test_the_ratchet_holds_what_was_accepted_and_no_more(tmp_path, model):
    study = run(tmp_path / "out", model)
    file = tmp_path / "ratchet.json"
    write_json(file, accepted(study))
    assert slipped_back(study, file) == []
    content = json.loads(file.read_text())
    entry = content["models"]["untrained"]["figures"]["overlap-balls/exit speed"]
    now = entry["value"]
    entry.update(value=now - 0.5, noise=0.1)
    write_json(file, content)
    assert len(slipped_back(study, file)) == 1 and "exit speed" in slipped_back(study, file)[0]
    entry.update(noise=0.2)  # within three of it
    write_json(file, content)
    assert slipped_back(study, file) == []
    entry.update(value=now + 5.0, noise=0.0)  # better than accepted
    write_json(file, content)
    assert slipped_back(study, file) == []
    blown = run(tmp_path / "blown", broken(model))
    with pytest.raises(SdfsimError, match="knows no model 'broken'"):
        slipped_back(blown, file)
    content["models"]["broken"] = {"figures": {}, "blew_up": ["overlap-balls"]}
    write_json(file, content)
    assert [line.split(": ")[1] for line in slipped_back(blown, file)] == ["thin-5"]
    write_json(file, content | {"quick": False})
    with pytest.raises(SdfsimError, match="long form"):
        slipped_back(study, file)


def test_reduced_precision_changes_a_little_and_leaves_the_network_as_it_was(model):
    from sdfsim.dynamics.model import load_model

    loaded = load_model(model)
    before = {name: weight.clone() for name, weight in loaded.network.state_dict().items()}
    reduced, device = in_variant(loaded, "bfloat16", "cpu")
    assert device == "cpu" and type(reduced.network) is type(loaded.network)
    case = replace(next(c for c in cases(quick=True) if c.name == "bfloat16"), seconds=0.6)
    scene = hard_cases_scenes.overlapping(hard_cases_scenes.ball(), hard_cases_scenes.ball(), 0.5)
    one, other = (r.rollout.position for r in simulated(case, [scene], loaded, "cpu"))
    assert 0 < np.abs(one - other).max() < 0.1
    assert all(torch.equal(weight, before[name]) for name, weight in loaded.network.state_dict().items())


def test_the_teacher_has_the_scenes_own_masses_and_starts(tmp_path):
    from sdfsim.evaluation.hard_cases_teacher import teach

    scene = hard_cases_scenes.tossed((3,))
    motion = teach(scene, tmp_path, steps=2)
    assert motion.position.shape == (3, len(scene.bodies), 3) and motion.time[-1] == pytest.approx(0.04)
    np.testing.assert_allclose(motion.position[0], [b.position for b in scene.bodies], atol=1e-12)
    np.testing.assert_allclose(motion.velocity[0], [b.velocity for b in scene.bodies], atol=1e-6)
    high = [k for k, b in enumerate(scene.bodies) if b.position[2] > 1.5]
    fallen = np.array([scene.bodies[k].velocity[2] for k in high]) - 10.0 * 0.04
    assert high
    np.testing.assert_allclose(motion.velocity[-1, high, 2], fallen, atol=1e-6)


def test_the_teacher_gets_pieces_of_the_size_of_the_shape(tmp_path):
    from sdfsim.data.pybullet_sim import Teacher, TeacherBody
    from sdfsim.evaluation.hard_cases_teacher import engine_file
    from sdfsim.shape.mesh import load_pieces

    shape = hard_cases_scenes.shape_from_primitive("torus", 2.0, sdf="mesh")
    urdf = engine_file(shape, tmp_path)
    vertices = np.concatenate([piece.vertices for piece in load_pieces(urdf.with_suffix(".obj"))])
    np.testing.assert_allclose(np.ptp(vertices, axis=0), np.ptp(shape.mesh.vertices, axis=0), rtol=0.01)
    assert np.ptp(primitives.PRIMITIVES["torus"]().vertices[:, 0]) == pytest.approx(1.0, rel=0.01)
    box = engine_file(analytic_shape("box", size=(1.0, 2.0, 3.0)), tmp_path)
    with Teacher(np.zeros(3), None) as teacher:
        teacher.add(TeacherBody(box, 2.0, 1.0, 0.5, 0.5), (0, 0, 0))
        teacher._call("performCollisionDetection")
        low, high = teacher._call("getAABB", teacher.bodies[0])
    np.testing.assert_allclose(np.array(high) - low, [2.0, 4.0, 6.0], atol=0.1)


def test_meshes_of_ones_own_rest_too_at_a_metre(tmp_path):
    with pytest.raises(SdfsimError, match="no meshes found"):
        cases(quick=True, shapes=tmp_path)
    (tmp_path / "brick.ply").write_bytes(write_ply(primitives.box((2.0, 4.0, 1.0))))
    found = {case.name: case for case in cases(quick=True, shapes=tmp_path)}
    assert {"rest-brick", "rest-brick-sleep"} < set(found)
    scene = found["rest-brick"].scenes(0)[0]
    np.testing.assert_allclose(np.sort(np.ptp(scene.shapes[0].mesh.vertices, axis=0)), [0.25, 0.5, 1.0], rtol=1e-6)
    assert scene.bodies[0].position[2] == pytest.approx(0.125)
