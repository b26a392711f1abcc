"""The stages from photos to a scene: each in its own folder, skipped when nothing changed, resumed when killed."""

import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Unpack

from pipeline.options import COMMAND, OptionKeys, Options, options_of, read_config, write_config
from pipeline.records import FitReport, MeshReport, PhotosReport, SceneReport, read, written
from pipeline.report import write_report
from sdfsim.base.compiling import say_compiling
from sdfsim.base.errors import EXIT_QUALITY, SdfsimError
from sdfsim.base.files import CONFIG, check_own, locked, write_json
from sdfsim.base.parallel import Progress, StageProgress

RECORD = "stage.json"  # in the folder of a stage: its `Record`

# Share of an overall time budget that fitting may take, and the time of the other stages after training, s.
FIT_SHARE, AFTER_TRAINING = 0.15, 50.0


@dataclass(frozen=True)
class Instead:
    """Replaces a stage's own work, with the further inputs on which its result depends."""

    run: Callable[["Project", Path], Any]
    depends: Any


@dataclass
class Project:
    """A reconstruction: its folder, its options, and its progress callback."""

    folder: Path  # of all stages
    options: Options  # as in its config.yaml
    progress: StageProgress | None = None  # called with (stage, fraction, message)
    # s for a single stage; None: its share of the overall budget
    own_budget: float | None = None
    started: float = field(default_factory=time.monotonic)
    instead: dict[str, Instead] = field(default_factory=dict)  # of stages

    def progress_of(self, stage: str) -> Progress:
        """The progress callback of one stage."""
        return lambda fraction, message: self.progress(stage, fraction, message) if self.progress else None

    def place(self, stage: str) -> Path:
        """Where a stage's result lies."""
        return self.folder / STAGES[stage].folder

    def device(self) -> str:
        """The device for computing, as torch names it. Raises SdfsimError if CUDA was requested and is missing."""
        from sdfsim.base.devices import pick_device

        return str(pick_device(self.options.device))


@dataclass(frozen=True)
class Record:
    """What `stage.json` in the folder of a finished stage says; that of a running stage has only the fingerprint."""

    fingerprint: str  # of options and inputs
    inputs: str  # name of the result of the stage before, or hash of the photos
    made: str  # name of this result: two with the same fingerprint may differ (time budgets, GPUs)
    seconds: float
    report: dict[str, Any]
    version: int = 1


# The work of each stage: it makes its result in an existing folder and returns its report.


def do_photos(project: Project, work: Path) -> PhotosReport:
    from pipeline.inputs.photos import prepare_photos

    photos, notes = prepare_photos(Path(project.options.photos), work, on_progress=project.progress_of("photos"))
    return PhotosReport(len(photos), notes, sum(p.mask for p in photos))


def do_poses(project: Project, work: Path) -> dict:
    from pipeline.inputs.photos import load_photos
    from pipeline.mesh.placement import check_bodies, check_distance, check_up
    from pipeline.sfm.poses import solve

    folder = project.place("photos")
    photos = load_photos(folder)
    if project.options.distance is not None:  # before minutes of poses and training
        check_distance(project.options.distance, photos)
    if project.options.up is not None:
        check_up(project.options.up, photos)
    check_bodies(project.options.body, photos)
    return solve(photos, folder, work, seed=project.options.seed, on_progress=project.progress_of("poses"))


def do_distill(project: Project, work: Path) -> dict:
    from pipeline.cameras import load_poses
    from pipeline.field.training import PRESETS, train

    budget = project.own_budget
    if budget is None and project.options.budget is not None:
        spent = time.monotonic() - project.started
        budget = max(20.0, project.options.budget * (1 - FIT_SHARE) - spent - AFTER_TRAINING)
    return train(
        load_poses(project.place("poses")), project.place("photos"), work, settings=PRESETS[project.options.preset],
        budget=budget, seed=project.options.seed, device=project.device(), on_progress=project.progress_of("distill"),
    ).report  # fmt: skip


def do_mesh(project: Project, work: Path) -> MeshReport:
    from pipeline.mesh.meshing import make_meshes

    try:
        return make_meshes(
            project.place("distill"), project.place("poses"), project.place("photos"), work, project.options,
            device=project.device(), on_progress=project.progress_of("mesh"),
        )  # fmt: skip
    except SdfsimError as error:
        if error.exit_code != EXIT_QUALITY:
            raise
        hint = "; ".join(filter(None, (error.hint, project.options.longer())))
        raise SdfsimError(error.message, hint, exit_code=EXIT_QUALITY) from error


def do_fit(project: Project, work: Path) -> FitReport:
    from pipeline.scene_writer import fit_parts

    budget = project.own_budget
    if budget is None and project.options.budget is not None:
        budget = max(10.0, FIT_SHARE * project.options.budget)
    return fit_parts(
        project.place("mesh"), work, budget=budget, recipe=project.options.fit_recipe(),
        sdf=project.options.shape_sdf(), seed=project.options.seed, device=project.device(),
        on_progress=project.progress_of("fit"),
    )  # fmt: skip


def do_scene(project: Project, work: Path) -> SceneReport:
    from pipeline.materials import materials_of
    from pipeline.scene_writer import write_scene

    before = read_record(project.place("scene"))
    known = read(SceneReport, before.report if before else None).scene_sha256
    return write_scene(
        project.place("mesh"), project.folder / "scene.yaml", drop=project.options.drop, written=known,
        materials=materials_of(project.options.material, project.options.mass), seed=project.options.seed,
    )  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One stage."""

    run: Callable[[Project, Path], Any]  # returns the report, see `pipeline.records`
    folder: str  # where the result lies in that of the run
    # Raise it with every change that gives other results for the same inputs; later stages follow.
    version: int = 1


STAGES = {
    "photos": Stage(do_photos, "photos", version=5),
    "poses": Stage(do_poses, "poses", version=11),
    "distill": Stage(do_distill, "distill", version=15),
    "mesh": Stage(do_mesh, "mesh", version=22),
    "fit": Stage(do_fit, "assets", version=4),
    "scene": Stage(do_scene, "scene", version=8),
}


def reconstruct(
    photos: str | Path, out: str | Path, *, from_stage: str | None = None, until_stage: str | None = None,
    progress: StageProgress | None = None, **options: Unpack[OptionKeys],
) -> dict:  # fmt: skip
    """Photos -> a scene, by all stages; see `pipeline.states.reconstruct`."""
    say_compiling()
    resolved = options_of(photos=str(Path(photos).absolute()), **options)
    wanted = wanted_stages(from_stage, until_stage)
    project = Project(Path(out), resolved, progress)
    check_apart(project)
    return run_all(project, wanted)


def wanted_stages(from_stage: str | None, until_stage: str | None) -> dict[str, bool]:
    """The stages up to `until_stage`, and whether each must run even if nothing changed, which holds from `from_stage`
    on. Raises SdfsimError if there is no such stage, or they are in the wrong order."""
    first, last = number_of(from_stage or "scene"), number_of(until_stage or "scene")
    if from_stage and first > last:
        raise SdfsimError(f"from {from_stage} until {until_stage}: {until_stage} comes before {from_stage}")
    names = list(STAGES)[: last + 1]
    return {name: from_stage is not None and number >= first for number, name in enumerate(names)}


def find_poses(photos: str | Path, out: str | Path, *, progress: StageProgress | None = None,
               **changes: Any) -> dict:  # fmt: skip
    """Photos -> camera poses: the first two stages of `reconstruct`; options that are not given (None) come from the
    folder's config.yaml, if it exists."""
    kept = read_config(Path(out)).model_dump() if (Path(out) / CONFIG).exists() else {}
    given: dict[str, Any] = kept | {key: value for key, value in changes.items() if value is not None}
    given["photos"] = photos
    return reconstruct(**given, out=out, until_stage="poses", progress=progress)


def run_stage(
    name: str, folder: str | Path, *, progress: StageProgress | None = None, **changes: Any
) -> dict:  # fmt: skip
    """Runs one stage in a folder that the earlier stages have written; returns and raises like `reconstruct`. Options
    that are given (not None) are stored in the folder's config.yaml; a budget holds only for this call."""
    number, kept = number_of(name), read_config(Path(folder))
    known = {key: value for key, value in changes.items() if value is not None}
    options = kept.changed(known)  # also checks the budget, which is not stored
    project = Project(
        Path(folder), options.changed({"budget": kept.budget}), progress, options.budget if "budget" in known else None
    )
    done = current(project.folder)
    for before in list(STAGES)[:number]:
        if before not in done:
            why = "is older than what it reads" if read_record(project.place(before)) else "has not run"
            command = "poses" if before == "photos" else before  # No command does the photos alone.
            raise SdfsimError(f"{folder}: the {before} stage {why}", f"run `sdfsim {command}` first")
    return run_all(project, {name: False})


def number_of(stage: str) -> int:
    """Its place in the order of the stages. Raises SdfsimError for an unknown stage."""
    if stage not in STAGES:
        raise SdfsimError(f"no such stage: {stage!r}", "stages: " + ", ".join(STAGES))
    return list(STAGES).index(stage)


def run_all(project: Project, stages: dict[str, bool]) -> dict:
    """Runs stages, those with the value True even if nothing changed, and returns the report. Raises SdfsimError,
    before it writes anything, if the device is missing or if files that sdfsim did not write would be lost."""
    if project.options.device == "cuda":
        project.device()
    check_own(project.folder, COMMAND, "report.json", "report.md")
    for stage in stages:
        check_replaceable(project.place(stage))
    try:
        with locked(project.folder):
            write_config(project.options, project.folder)
            for stage, again in stages.items():
                run_reported(project, stage, again=again)
            return write_report(project.folder, project.options, current(project.folder))
    except OSError as error:  # a full disk, or an unreadable or unwritable file
        message = f"{error.filename or project.folder}: {error.strerror or error}"
        raise SdfsimError(message, "solve this and run again: finished stages are kept") from error


def check_apart(project: Project) -> None:
    """Raises SdfsimError if there are no photos, or a file of the user's lies where a result will replace it."""
    from pipeline.inputs.sources import find_source

    given = Path(project.options.photos)
    files = {path.resolve() for path in (given, *find_source(given).files())}
    for stage in STAGES:
        place = project.place(stage)
        if any(path.is_relative_to(place.resolve()) for path in files):
            message = f"{given}: lies in {place}, where the result of the {stage} stage belongs"
            raise SdfsimError(message, "choose another -o; photos are never written to")


def run_reported(project: Project, stage: str, *, again: bool) -> None:
    """Runs one stage; the report records its result or its error."""
    try:
        run_one(project, stage, again=again)
    except SdfsimError as error:
        write_report(project.folder, project.options, current(project.folder), (stage, error))
        more = f"{project.folder / 'report.md'} shows what was found"
        hint = f"{error.hint}; {more}" if error.hint else more
        raise SdfsimError(error.message, hint, exit_code=error.exit_code) from error


def run_one(project: Project, stage: str, *, again: bool) -> None:
    """Runs one stage, or skips it if its fingerprint is that of its last run."""
    place, work = project.place(stage), project.folder / f".{stage}.part"
    before = read_record(project.place(list(STAGES)[number_of(stage) - 1])) if stage != "photos" else None
    instead = project.instead.get(stage)
    if before:
        inputs = before.made
    else:
        inputs = hash_of_photos(Path(project.options.photos)) if instead is None else ""
    depends = project.options.of_stage(stage) | {"own_budget": project.own_budget}
    if stage == "fit":
        from sdfsim.sdf.fit import FIT_VERSION

        depends["fit_version"] = FIT_VERSION
    if instead is not None:
        depends["instead"] = instead.depends
    text = json.dumps([stage, STAGES[stage].version, inputs, depends], sort_keys=True)
    wanted = hashlib.sha256(text.encode()).hexdigest()
    known = read_record(place)
    complete = stage != "scene" or (project.folder / "scene.yaml").exists()
    if not again and known and known.fingerprint == wanted and complete:
        for left in (work, _old(place)):  # by runs that were killed
            shutil.rmtree(left, ignore_errors=True)
        project.progress_of(stage)(1.0, "unchanged")
        return
    begin(work, wanted, fresh=again)
    started = time.monotonic()
    report = written((STAGES[stage] if instead is None else instead).run(project, work))
    # Includes the training of a killed run.
    seconds = time.monotonic() - started + report.get("seconds_before", 0.0)
    finish(work, place, Record(wanted, inputs, uuid.uuid4().hex, seconds, report))
    project.progress_of(stage)(1.0, f"done in {seconds:.0f} s")


def hash_of_photos(given: Path) -> str:
    """Hash of the paths and contents of the photos (or the video), their masks and cameras; paths are relative to the
    photos: all may move together, but the folder of a mask is the name of its body."""
    from pipeline.inputs.sources import find_source

    digest, source = hashlib.sha256(), find_source(given)
    for path in source.files():
        place = Path(os.path.relpath(path.absolute(), source.folder)).as_posix()
        digest.update(place.encode("utf-8", "surrogateescape") + b"\0")
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def current(folder: Path) -> dict[str, Record]:
    """Records by stage, up to the first stage that is missing or was made from a different result of the stage
    before."""
    found: dict[str, Record] = {}
    before = None
    for name, stage in STAGES.items():
        known = read_record(folder / stage.folder)
        if known is None or (before is not None and known.inputs != before.made):
            break
        found[name] = before = known
    return found


def read_record(place: Path) -> Record | None:
    """The record of a finished stage; None if it has not finished."""
    try:
        return Record(**json.loads((place / RECORD).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def check_replaceable(place: Path) -> None:
    """Raises SdfsimError if the place of a stage holds anything but an earlier result, which would be lost."""
    if os.path.lexists(place) and read_record(place) is None:
        message = f"{place}: exists and is not replaced, as sdfsim did not write it (no {RECORD} in it)"
        raise SdfsimError(message, "choose another folder to write to, or move it away")


def begin(work: Path, wanted: str, *, fresh: bool) -> Path:
    """A folder to work in: that of a killed run with the same fingerprint, else an empty one."""
    try:
        left = json.loads((work / RECORD).read_text(encoding="utf-8"))["fingerprint"]
    except (OSError, ValueError, KeyError, TypeError):
        left = None
    if fresh or left != wanted:
        if work.exists():
            shutil.rmtree(work)
        work.mkdir(parents=True)
        write_json(work / RECORD, {"fingerprint": wanted})
    for half_written in work.rglob(".*.part"):
        if half_written.is_file():
            half_written.unlink()
    return work


def finish(work: Path, place: Path, record: Record) -> None:
    """Writes the record and moves the finished folder to its place, where it replaces an earlier result of the stage.
    Raises SdfsimError if the place holds files that no stage wrote."""
    check_replaceable(place)
    # If the record cannot be written, the one with only the fingerprint stays, and the next run continues from here.
    write_json(work / RECORD, asdict(record))
    old = _old(place)
    shutil.rmtree(old, ignore_errors=True)
    # A folder cannot be replaced in one step; between the two renames the stage counts as not done.
    if place.exists():
        os.rename(place, old)
    os.rename(work, place)
    shutil.rmtree(old, ignore_errors=True)


def _old(place: Path) -> Path:
    return place.with_name(f".{place.name}.old")
