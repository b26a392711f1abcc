"""The stages from photos to a scene: each in its own folder, skipped when nothing changed, resumed when killed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipeline import record
from pipeline.actions import ACTIONS, Progress, Run
from pipeline.options import COMMAND, Options, read_config, write_config
from pipeline.report import STAGES, current, write_report
from sdfsim.errors import SdfsimError
from sdfsim.files import CONFIG, check_own, locked

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
    from pipeline.sources import find_source

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
