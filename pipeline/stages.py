"""The stages from photos to a scene: each in its own folder, skipped when nothing changed, resumed when killed."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline import record
from pipeline.options import COMMAND, Options, read_config, write_config
from pipeline.report import STAGES, current, place_of, write_report
from sdfsim.errors import SdfsimError
from sdfsim.files import CONFIG, check_own, locked, write_json

# Raise a stage's number with every change of code after which it makes something else of the same inputs and options.
# The stages after it follow by themselves. What only moves, renames or explains code leaves the numbers as they are.
STAGE_VERSIONS = {"photos": 1, "poses": 1, "distill": 1, "mesh": 1, "fit": 1, "scene": 1}


def reconstruct(
    photos: str | Path, out: str | Path, *, preset: str = "standard", size: float | None = None,
    budget: float | None = None, seed: int = 0, device: str = "auto", from_stage: str | None = None,
    until_stage: str | None = None, progress: Progress | None = None, **more: Any,
) -> dict:  # fmt: skip
    """Photos -> a scene that can be simulated.

    Writes one folder a stage, Shape folders in `assets/`, `scene.yaml`, `config.yaml`, `report.json` and
    `report.html` to `out`.
    A stage whose inputs, options and version are those of its last run is skipped; a run that was killed goes on.

    Args:
        photos: folder of photos, video, transforms.json or COLMAP model; never written to.
        out: folder to write; made where missing.
        preset: quick, standard or fine; paper is the network of the VolSDF paper, for a GPU.
        size: widest side of the scene, m; None: 1 m is assumed, and the report says so.
        budget: s for everything.
        seed: of everything random.
        device: auto, cpu or cuda.
        from_stage: do this stage and all after it again.
        until_stage: stop after this stage.
        progress: called with (stage, fraction, message).
        **more: distance, crop, keep, static, drop: see `Options`.

    Returns:
        The report, as in report.json.

    Raises:
        SdfsimError: bad photos or options (exit code 1), poses or surface not good enough (exit code 3).
    """
    options = Options(str(Path(photos).absolute()), preset, size, budget, seed, device, **more)
    options.check()
    for name in (from_stage, until_stage):
        if name is not None and name not in STAGES:
            raise SdfsimError(f"no such stage: {name!r}", "stages: " + ", ".join(STAGES))
    first = STAGES.index(from_stage) if from_stage else len(STAGES)
    last = STAGES.index(until_stage) if until_stage else len(STAGES) - 1
    if from_stage and first > last:
        raise SdfsimError(f"from {from_stage} until {until_stage}: {until_stage} comes before {from_stage}")
    run = Run(Path(out), options, progress)
    check_apart(run)
    check_before(run, STAGES[: last + 1])
    with record.writing(run.folder):
        run.folder.mkdir(parents=True, exist_ok=True)
        with locked(run.folder):
            write_config(options, run.folder)
            for number, stage in enumerate(STAGES[: last + 1]):
                run_reported(run, stage, again=number >= first)
            return write_reports(run)


def find_poses(photos: str | Path, out: str | Path, *, progress: Progress | None = None, **changes: Any) -> dict:
    """Photos -> camera poses: the first two stages.

    Args:
        photos: as for `reconstruct`.
        out: folder to write.
        progress: called with (stage, fraction, message).
        **changes: options that differ from those in the folder's config.yaml, where there is one; None changes nothing.

    Returns:
        The report, as in report.json.

    Raises:
        SdfsimError: as `reconstruct`.
    """
    kept = asdict(read_config(Path(out))) if (Path(out) / CONFIG).exists() else {}
    given = {key: value for key, value in changes.items() if value is not None}
    return reconstruct(**{**kept, **given, "photos": photos}, out=out, until_stage="poses", progress=progress)


def run_stage(name: str, folder: str | Path, *, progress: Progress | None = None, again: bool = False,
              **changes: Any) -> dict:  # fmt: skip
    """Runs one stage in a folder that the stages before it have written.

    Args:
        name: one of `STAGES`.
        folder: of an earlier `reconstruct`.
        progress: called with (stage, fraction, message).
        again: also when nothing changed.
        **changes: options that differ from those in the folder's config.yaml (see `Options`), from then on kept there;
            None changes nothing. A budget is that of this stage and this call alone, and not kept.

    Returns:
        The report, as in report.json.

    Raises:
        SdfsimError: a stage before has not run; else as `reconstruct`.
    """
    if name not in STAGES:
        raise SdfsimError(f"no such stage: {name!r}", "stages: " + ", ".join(STAGES))
    kept = read_config(Path(folder))
    known = {key: value for key, value in changes.items() if value is not None}
    unknown = set(known) - set(asdict(kept))
    if unknown:
        raise SdfsimError(f"no such option: {', '.join(sorted(unknown))}")
    options = kept.changed(known)
    options.check()
    run = Run(Path(folder), replace(options, budget=kept.budget), progress, known.get("budget"))
    check_before(run, [name])
    with record.writing(run.folder), locked(run.folder):
        done = current(run.folder)
        for before in STAGES[: STAGES.index(name)]:
            if before not in done:
                why = "is older than what it reads" if record.read(run.place(before)) else "has not run"
                command = "poses" if before == "photos" else before  # No command does the photos alone.
                raise SdfsimError(f"{folder}: the {before} stage {why}", f"run `sdfsim {command}` first")
        write_config(run.options, run.folder)
        run_reported(run, name, again=again)
        return write_reports(run)


def check_before(run: Run, names: Sequence[str]) -> None:
    """What would stop these stages, before anything is written.

    Raises:
        SdfsimError: no such device, or something that is not ours where a stage's result belongs.
    """
    if run.options.device == "cuda":
        run.device()
    check_own(run.folder, COMMAND, "report.json", "report.html")
    for name in names:
        record.check_replaceable(run.place(name))


def check_apart(run: Run) -> None:
    """That what is given does not lie where results will: it would be replaced by them.

    Raises:
        SdfsimError: it does, or there are no photos.
    """
    from pipeline.inputs.sources import find_source

    given = Path(run.options.photos)
    files = {path.resolve() for path in (given, *find_source(given).files())}
    for stage in STAGES:
        place = run.place(stage)
        if any(path.is_relative_to(place.resolve()) for path in files):
            raise SdfsimError(
                f"{given}: lies in {place}, where the result of the {stage} stage belongs",
                "choose another -o; photos are never written to",
            )


def run_reported(run: Run, stage: str, *, again: bool) -> None:
    """Runs one stage; the report tells what came of it, also where that is an error."""
    try:
        run_one(run, stage, again=again)
    except SdfsimError as error:
        write_reports(run, (stage, error))
        more = f"{run.folder / 'report.html'} shows what was found"
        raise SdfsimError(
            error.message, f"{error.hint}; {more}" if error.hint else more, exit_code=error.exit_code
        ) from error
    write_report(run.folder, run.options)


def write_reports(run: Run, failed: tuple[str, SdfsimError] | None = None) -> dict:
    """Writes report.json and report.html; returns the former."""
    from pipeline.report_page import write_page

    report = write_report(run.folder, run.options, failed)
    write_page(run.folder, report)
    return write_report(run.folder, run.options, failed)  # Now its paths name the page as well.


def run_one(run: Run, stage: str, *, again: bool) -> None:
    """Runs one stage, or skips it where its fingerprint is that of its last run."""
    number = STAGES.index(stage)
    before = record.read(run.place(STAGES[number - 1])) if number else None
    inputs = before["made"] if before else record.content_of_photos(Path(run.options.photos))
    extra: dict[str, Any] = {} if run.own_budget is None else {"own_budget": run.own_budget}
    if stage == "fit":
        from sdfsim.shape.fit import FIT_VERSION

        extra["fit_version"] = FIT_VERSION
    wanted = record.fingerprint(stage, STAGE_VERSIONS[stage], inputs, {**run.options.of_stage(stage), **extra})
    known = record.read(run.place(stage))
    work = run.folder / f".{stage}.part"
    complete = stage != "scene" or (run.folder / "scene.yaml").exists()
    if not again and known and known["fingerprint"] == wanted and complete:
        record.clear(work, run.place(stage))
        run.tell(stage)(1.0, "unchanged")
        return
    record.begin(work, wanted, fresh=again)
    started = time.monotonic()
    report = ACTIONS[stage](run, work)
    # Training that a killed run had already done counts as well.
    seconds = time.monotonic() - started + report.get("seconds_before", 0.0)
    record.finish(work, run.place(stage), wanted, inputs, report, seconds)
    run.tell(stage)(1.0, f"done in {seconds:.0f} s")


Progress = Callable[[str, float, str], None]

# Share of an overall time budget that fitting may take, and what the other stages need after training, s.
FIT_SHARE, AFTER_TRAINING = 0.15, 40.0


@dataclass
class Run:
    """One call: where it works and what it has done so far.

    Attributes:
        folder: of all stages.
        options: as in its config.yaml.
        progress: called with (stage, fraction, message).
        own_budget: s for the one stage that is run; None: it has its share of the budget for everything.
        started: when, on the monotonic clock.
    """

    folder: Path
    options: Options
    progress: Progress | None = None
    own_budget: float | None = None
    started: float = field(default_factory=time.monotonic)

    def tell(self, stage: str) -> Callable[[float, str], None]:
        """The progress callback of one stage."""
        return lambda fraction, message: self.progress(stage, fraction, message) if self.progress else None

    def place(self, stage: str) -> Path:
        """Where a stage's result lies."""
        return place_of(self.folder, stage)

    def device(self) -> str:
        """Where to compute, as torch names it.

        Raises:
            SdfsimError: cuda was asked for and is not there.
        """
        from sdfsim.dynamics.simulator import pick_device

        return str(pick_device(self.options.device))


def do_photos(run: Run, work: Path) -> dict:
    """Photos stage."""
    from pipeline.inputs.photos import prepare_photos

    photos, notes = prepare_photos(Path(run.options.photos), work, on_progress=run.tell("photos"))
    return {"count": len(photos), "notes": notes, "masks": sum(p.mask for p in photos)}


def do_poses(run: Run, work: Path) -> dict:
    """Poses stage."""
    from pipeline.inputs.photos import load_photos
    from pipeline.mesh.placement import check_places
    from pipeline.sfm.poses import solve

    folder = run.place("photos")
    photos, known = load_photos(folder), run.options.wishes().distance
    if known is not None:
        check_places(known, photos)  # rather than after minutes of poses and training
    return solve(photos, folder, work, seed=run.options.seed, on_progress=run.tell("poses"))


def do_distill(run: Run, work: Path) -> dict:
    """Distill stage."""
    from pipeline.cameras import load_sparse, load_views
    from pipeline.field.training import PRESETS as RECIPES
    from pipeline.field.training import train

    budget = run.own_budget
    if budget is None and run.options.budget is not None:
        spent = time.monotonic() - run.started
        budget = max(20.0, run.options.budget * (1 - FIT_SHARE) - spent - AFTER_TRAINING)
    poses = run.place("poses")
    trained = train(
        load_views(poses), load_sparse(poses), run.place("photos"), work, recipe=RECIPES[run.options.preset],
        budget=budget, seed=run.options.seed, device=run.device(), on_progress=run.tell("distill"),
    )  # fmt: skip
    return trained.report


def do_mesh(run: Run, work: Path) -> dict:
    """Mesh stage."""
    from pipeline.inputs.sources import find_source
    from pipeline.mesh.meshing import make_meshes

    named = find_source(Path(run.options.photos)).folder
    return make_meshes(
        run.place("distill"), run.place("poses"), run.place("photos"), named, work,
        preset=run.options.preset, wishes=run.options.wishes(), device=run.device(),
        on_progress=run.tell("mesh"),
    )  # fmt: skip


def do_fit(run: Run, work: Path) -> dict:
    """Fit stage."""
    from pipeline.export import fit_parts
    from sdfsim.threads import choose_threads, network_work

    choose_threads(network_work, repeat=10)
    budget = run.own_budget
    if budget is None and run.options.budget is not None:
        budget = max(10.0, FIT_SHARE * run.options.budget)
    return fit_parts(
        run.place("mesh"), work, budget=budget, recipe=run.options.fit_recipe(), seed=run.options.seed,
        device=run.device(), on_progress=run.tell("fit"),
    )  # fmt: skip


def do_scene(run: Run, work: Path) -> dict:
    """Scene stage."""
    from pipeline.export import write_scene

    before = record.read(run.place("scene"))
    written = before["report"].get("scene_sha256") if before else None
    return write_scene(
        run.place("mesh"), run.folder / "scene.yaml", shape=run.options.drop, static=run.options.static,
        written=written, seed=run.options.seed,
    )  # fmt: skip


ACTIONS: dict[str, Callable[[Run, Path], dict]] = {
    "photos": do_photos, "poses": do_poses, "distill": do_distill, "mesh": do_mesh, "fit": do_fit, "scene": do_scene,
}  # fmt: skip


RECORD = "stage.json"
UNFINISHED = "unfinished.json"


def fingerprint(stage: str, version: int, inputs: str, options: dict) -> str:
    """Hash of what a stage's result depends on.

    Args:
        stage: its name.
        version: of its code, see `STAGE_VERSIONS`.
        inputs: name of the result that it reads, see `finish`; of the first stage, hash of the photos.
        options: that its result depends on.
    """
    return hashlib.sha256(json.dumps([stage, version, inputs, options], sort_keys=True).encode()).hexdigest()


def content_of_photos(given: Path) -> str:
    """Hash of the names and contents of the photos (or the video), their masks and cameras."""
    from pipeline.inputs.sources import find_source

    digest = hashlib.sha256()
    for path in find_source(given).files():
        digest.update(path.name.encode("utf-8", "surrogateescape") + b"\0")
        try:
            with open(path, "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise SdfsimError(f"{path}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def read(folder: Path) -> dict | None:
    """The record of a finished stage: fingerprint, inputs, made, report, seconds; None where it has not finished."""
    try:
        known = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        # Where a record names no result of its own, its fingerprint is the name that later stages know it by.
        return {"made": known["fingerprint"], **known} if {"inputs", "report", "seconds"} <= set(known) else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def check_replaceable(place: Path) -> None:
    """That nothing lies at a stage's place but an earlier result of it.

    Raises:
        SdfsimError: something else does, which is never replaced.
    """
    if os.path.lexists(place) and read(place) is None:
        raise SdfsimError(
            f"{place}: in the way, and not replaced: sdfsim did not write it (it holds no {RECORD})",
            "choose another folder to write to, or move it away",
        )


def begin(work: Path, wanted: str, *, fresh: bool) -> Path:
    """A folder to work in: the one a killed run left for the same fingerprint, else an empty one.

    Args:
        work: its place.
        wanted: fingerprint of the stage.
        fresh: never go on from a killed run.
    """
    try:
        left = json.loads((work / UNFINISHED).read_text(encoding="utf-8"))["fingerprint"]
    except (OSError, ValueError, KeyError, TypeError):
        left = None
    if fresh or left != wanted:
        if work.exists():
            shutil.rmtree(work)
        work.mkdir(parents=True)
        write_json(work / UNFINISHED, {"fingerprint": wanted})
    for half_written in work.rglob(".*.part"):
        if half_written.is_file():
            half_written.unlink()
    return work


def clear(work: Path, place: Path) -> None:
    """Removes what killed runs left of a stage whose result is there: the work on another, the result before it."""
    for left in (work, _old(place)):
        shutil.rmtree(left, ignore_errors=True)


def _old(place: Path) -> Path:
    return place.with_name(f".{place.name}.old")


def finish(work: Path, place: Path, wanted: str, inputs: str, report: dict, seconds: float) -> None:
    """Writes the record and moves the finished folder to its place, in place of an earlier result of the stage.

    Each result gets a name of its own, `made`: two of the same fingerprint may differ (time budgets, GPUs).

    Args:
        work: the folder that `begin` gave.
        place: where the result belongs.
        wanted: fingerprint of the stage.
        inputs: name of the result that it read.
        report: of the stage.
        seconds: that it took.

    Raises:
        SdfsimError: what lies at the place was not written by `finish`.
    """
    check_replaceable(place)
    # The mark of unfinished work goes last: where the record cannot be written, the next run goes on from here.
    write_json(
        work / RECORD,
        {"version": 1, "fingerprint": wanted, "inputs": inputs, "made": uuid.uuid4().hex, "seconds": seconds,
         "report": report},
    )  # fmt: skip
    place.parent.mkdir(parents=True, exist_ok=True)
    old = _old(place)
    shutil.rmtree(old, ignore_errors=True)
    # A folder cannot be replaced in one step; between the two renames the stage counts as not done.
    if place.exists():
        os.rename(place, old)
    os.rename(work, place)
    (place / UNFINISHED).unlink(missing_ok=True)
    shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turns a full disk or a folder that cannot be written into one clear line.

    Raises:
        SdfsimError: in place of such an OSError.
    """
    try:
        yield
    except OSError as error:
        reasons = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}
        hint = "free some space and run again: finished stages are kept" if error.errno in reasons else ""
        reason = reasons.get(error.errno or 0, error.strerror or str(error))
        raise SdfsimError(f"{error.filename or folder}: cannot be written ({reason})", hint) from error
