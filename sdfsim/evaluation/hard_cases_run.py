"""Runs the hard cases with models and the teacher; what is finished is kept as files and not run again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch

import sdfsim
from sdfsim.data.pybullet_sim import DT, SUBSTEPS, TEACHER_VERSION, engine_settings, import_pybullet
from sdfsim.dynamics.model import Model, bundled_models, load_model
from sdfsim.dynamics.ranges import constant_in_training
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import pick_device
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.hard_cases import GROUPS, Case
from sdfsim.evaluation.hard_cases_list import cases
from sdfsim.evaluation.hard_cases_measures import Run
from sdfsim.evaluation.hard_cases_motion import simulated, taught
from sdfsim.evaluation.hard_cases_results import NO_CUDA, TEACHER, Part, Result, Study
from sdfsim.evaluation.hard_cases_teacher import engine_file
from sdfsim.files import locked, read_json, write_json
from sdfsim.parallel import parallel
from sdfsim.scene.types import Scene
from sdfsim.shape.sdf import PlaneSdf

VERSION = 1  # counts up when what is measured changes, so that kept results are measured again
WATCHED = 10.0  # s of a recording

Progress = Callable[[float, str], None]
Record = Callable[[Scene, Rollout, Path], None]


@dataclass(frozen=True)
class _Job:
    """One repetition of a case with one model, or with the teacher (`model` is None)."""

    case: Case
    repeat: int
    who: str
    model: Model | None
    device: str
    fingerprint: str
    weight: float

    def file(self, out: Path) -> Path:
        return out / "results" / self.who / f"{self.case.name}-{self.repeat}.json"


def stress(
    out: Path,
    *,
    models: Sequence[str] = (),
    quick: bool = False,
    shapes: Path | None = None,
    device: str = "cpu",
    record: Record | None = None,
    on_progress: Progress | None = None,
) -> Study:
    """Run every case that `out` does not hold the result of yet.

    Args:
        out: folder for results/, recordings/ and the engine's files.
        models: bundled names or paths; none for all bundled ones.
        quick: fewer and shorter cases.
        shapes: folder of meshes that are to rest on the floor too.
        device: cpu, cuda or auto.
        record: writes a motion of each case that is not as wanted into a file; None for no recordings.
        on_progress: called with (fraction, message).

    Returns:
        The results of all cases.

    Raises:
        SdfsimError: no such model or device, two models of one name, unusable shapes, another run in the folder, or a
            folder that cannot be written.
    """
    device = str(pick_device(device))
    tested = [load_model(name) for name in models or bundled_models()]
    who = [model.name for model in tested] + [TEACHER] * _teacher_is_here()
    if twice := {name for name in who if who.count(name) > 1}:
        raise SdfsimError(f"two models are called {min(twice)!r}", "rename a file: results are kept by name")
    found = cases(quick=quick, shapes=shapes)
    jobs = _jobs(found, tested, device, teacher=TEACHER in who)
    with locked(out):
        if TEACHER in who:
            _write_engine_files(found, out / "engine")
        parts = _parts(jobs, out, record, on_progress or (lambda fraction, message: None))
    results = {}
    for case in found:
        for one in who:
            if one == TEACHER and not case.teacher:
                continue
            own = tuple(parts[case.name, one, k] for k in range(case.repeats) if (case.name, one, k) in parts)
            results[case.name, one] = Result(case.name, one, own, "" if own else NO_CUDA)
    return Study(found, who, results, quick)


def _jobs(found: list[Case], tested: list[Model], device: str, *, teacher: bool) -> list[_Job]:
    """All there is to run; every scene is built once, for its digest and its size."""
    digests = [_digest_model(model) for model in tested]
    jobs = []
    for case in found:
        for repeat in range(case.repeats):
            scenes = case.scenes(repeat)
            scene_digest, weight = _digest_scenes(case, scenes), _weight(case, scenes)
            for model, digest in zip(tested, digests, strict=True):
                mark = _fingerprint(scene_digest, digest, device)
                jobs.append(_Job(case, repeat, model.name, model, device, mark, weight))
            if teacher and case.teacher:
                mark = _fingerprint(scene_digest, TEACHER_VERSION, engine_settings(DT, SUBSTEPS), DT)
                jobs.append(_Job(case, repeat, TEACHER, None, "", mark, 0.05 * weight))
    return jobs


def _parts(
    jobs: list[_Job], out: Path, record: Record | None, on_progress: Progress
) -> dict[tuple[str, str, int], Part]:
    """Kept results where they still hold, new ones elsewhere; none for what this machine cannot run."""
    jobs = [job for job in jobs if job.case.variant != "cuda" or torch.cuda.is_available()]
    parts = {(job.case.name, job.who, job.repeat): kept for job in jobs if (kept := _kept(job, out)) is not None}
    # Long ones first, so that no core is left with one at the end.
    todo = [job for job in jobs if (job.case.name, job.who, job.repeat) not in parts]
    todo.sort(key=lambda job: job.weight, reverse=True)
    total, done = sum(job.weight for job in todo), 0.0
    for number, (index, part) in enumerate(parallel(_run, [(job, out, record) for job in todo]), start=1):
        job = todo[index]
        parts[job.case.name, job.who, job.repeat] = part
        done += job.weight
        on_progress(done / total, f"{job.case.name} with {job.who}, {number} of {len(todo)}")
    on_progress(1.0, f"{len(todo)} results measured, {len(jobs) - len(todo)} kept from before")
    return parts


def _run(job: _Job, out: Path, record: Record | None) -> Part:
    """Run one repetition, measure it, and keep the result as a file."""
    case, scenes = job.case, job.case.scenes(job.repeat)
    outside: list[str] = []
    if job.model is None:
        runs = taught(case, scenes, out / "engine")
    else:
        runs = simulated(case, scenes, job.model, job.device)
        outside += [line for run in runs for line in run.rollout.meta["outside_training"]]
        if (about := GROUPS[case.group].about) in constant_in_training(job.model):
            outside.append(f"{about} was constant in training, so it was not learned")
    measured = case.measure(runs)
    figures = {figure.name: float(measured.figures[figure.name]) for figure in case.figures}
    broke = [run.broke for run in runs if run.broke]
    missed = any(figure.limit is not None and figures[figure.name] > figure.limit for figure in case.figures)
    recording = None
    if record and job.model is not None and (broke or (missed and job.repeat == 0)):
        shown = next((run for run in runs if run.broke), runs[measured.worst])
        recording = _recorded(shown, Path("recordings") / job.who / f"{case.name}-{job.repeat}.rrd", out, record)
    part = Part(job.fingerprint, figures, broke, list(dict.fromkeys(outside)), measured.curve.tolist(), recording)
    file = job.file(out)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, asdict(part))
    return part


def _recorded(run: Run, path: Path, out: Path, record: Record) -> str:
    (out / path).parent.mkdir(parents=True, exist_ok=True)
    frames = int((run.rollout.time <= WATCHED).sum())
    record(run.scene, run.rollout.frames(0, frames), out / path)
    return str(path)


def _kept(job: _Job, out: Path) -> Part | None:
    """The result of an earlier run; None where there is none, or something it depends on has changed."""
    file = job.file(out)
    if not file.exists():
        return None
    try:
        part = Part(**read_json(file))
    except (SdfsimError, TypeError):
        return None
    there = part.recording is None or (out / part.recording).exists()
    return part if there and part.fingerprint == job.fingerprint else None


def _write_engine_files(found: list[Case], folder: Path) -> None:
    """Before the work is split up, so that no two processes cut one mesh into pieces."""
    shapes = {id(s): s for case in found if case.teacher for scene in case.scenes(0) for s in scene.shapes}
    for shape in shapes.values():
        if not isinstance(shape.sdf, PlaneSdf):
            engine_file(shape, folder)


def _teacher_is_here() -> bool:
    try:
        import_pybullet()
    except SdfsimError:
        return False
    return True


def _weight(case: Case, scenes: list[Scene]) -> float:
    """About how long a model takes, in no unit: long jobs go first, and progress is told in these."""
    seconds = case.seconds if case.steps is None else 0.02 * case.steps
    work = sum(10 + len(scene.bodies) for scene in scenes)  # a step has its price without bodies too
    return seconds * work * (1 if case.variant == "float32" else 2)


def _fingerprint(*parts: Any) -> str:
    """Changes with `parts`, with the version, and with what the machine can do."""
    everything = [VERSION, sdfsim.__version__, torch.cuda.is_available(), *parts]
    return hashlib.sha256(json.dumps(everything).encode()).hexdigest()[:16]


def _digest_scenes(case: Case, scenes: list[Scene]) -> str:
    names = [figure.name for figure in case.figures]
    digest = hashlib.sha256(f"{case.seconds} {case.steps} {case.variant} {names}".encode())
    for scene in scenes:
        digest.update(f"{scene.gravity.tolist()} {scene.effects}".encode())
        for shape in scene.shapes:
            digest.update(f"{type(shape.sdf).__name__} {shape.volume!r} {shape.inertia.tolist()}".encode())
            digest.update(shape.nodes.tobytes())
        for body in scene.bodies:
            digest.update(repr([_plain(getattr(body, f.name)) for f in fields(body)]).encode())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def _digest_model(model: Model) -> str:
    digest = hashlib.sha256(f"{model.kind} {model.dt} {model.gravity} {model.length} {model.reach}".encode())
    for name, weights in sorted(model.network.state_dict().items()):
        digest.update(name.encode() + weights.cpu().numpy().tobytes())
    return digest.hexdigest()
