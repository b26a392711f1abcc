"""The stages from photos to a scene: each in its own folder, skipped when nothing changed, resumed when killed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline import record
from pipeline.options import Options, read_config, write_config
from pipeline.report import STAGES, current, place_of, write_report
from sdfsim.errors import SdfsimError
from sdfsim.files import locked

Progress = Callable[[str, float, str], None]

# Share of an overall time budget that fitting may take, and what the other stages need after training, s.
FIT_SHARE, AFTER_TRAINING = 0.15, 40.0

# Whose source code makes a stage's result; a change there makes the result old.
# fmt: off
CODE = {
    "photos": ("sources", "given", "video", "rectify", "quality", "photo_file", "photos", "cameras"),
    "poses": ("photos", "cameras", "poses", "poses_worker", "pair_checks", "verdict", "normalise"),
    "distill": (
        "photo_file", "cameras", "normalise", "rays", "field", "landmarks", "render", "recipe", "trainer", "distill",
        "held_out", "mlp_field", "mlp_trainer", "error_bound",
    ),
    "mesh": (
        "cameras", "normalise", "field", "distill", "volume", "visibility", "cleaning", "surface", "objects", "parts",
        "placement", "scale", "picture", "meshing",
    ),
    "fit": ("asset",),
    "scene": ("scene_file", "drop", "placement", "asset", "meshing"),
}
# fmt: on


@dataclass
class Run:
    """One call: where it works and what it has done so far."""

    folder: Path
    options: Options
    progress: Progress | None = None
    started: float = field(default_factory=time.monotonic)

    def tell(self, stage: str) -> Callable[[float, str], None]:
        """The progress callback of one stage."""
        return lambda fraction, message: self.progress(stage, fraction, message) if self.progress else None

    def place(self, stage: str) -> Path:
        """Where a stage's result lies."""
        return place_of(self.folder, stage)


def reconstruct(
    photos: str | Path, out: str | Path, *, preset: str = "standard", size: float | None = None,
    budget: float | None = None, seed: int = 0, device: str = "auto", from_stage: str | None = None,
    until_stage: str | None = None, progress: Progress | None = None, **more: Any,
) -> dict:  # fmt: skip
    """Photos -> a scene that can be simulated.

    Writes one folder a stage, Shape folders in `assets/`, `scene.yaml`, `config.yaml`, `report.json` and
    `report.html` to `out`.
    A stage whose inputs, options and code are those of its last run is skipped; a run that was killed goes on.

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
    options = Options(str(photos), preset, size, budget, seed, device, **more)
    options.check()
    for name in (from_stage, until_stage):
        if name is not None and name not in STAGES:
            raise SdfsimError(f"no such stage: {name!r}", "stages: " + ", ".join(STAGES))
    first = STAGES.index(from_stage) if from_stage else len(STAGES)
    last = STAGES.index(until_stage) if until_stage else len(STAGES) - 1
    run = Run(Path(out), options, progress)
    from pipeline.sources import find_source

    find_source(Path(photos))  # Before anything is written.
    with record.writing(run.folder):
        run.folder.mkdir(parents=True, exist_ok=True)
        with locked(run.folder):
            write_config(options, run.folder)
            for number, stage in enumerate(STAGES[: last + 1]):
                run_reported(run, stage, again=number >= first)
            return write_reports(run)


def run_stage(name: str, folder: str | Path, *, progress: Progress | None = None, again: bool = False,
              **changes: Any) -> dict:  # fmt: skip
    """Runs one stage in a folder that the stages before it have written.

    Args:
        name: one of `STAGES`.
        folder: of an earlier `reconstruct`.
        progress: called with (stage, fraction, message).
        again: also when nothing changed.
        **changes: options that differ from those in the folder's config.yaml (see `Options`); None changes nothing.

    Returns:
        The report, as in report.json.

    Raises:
        SdfsimError: a stage before has not run; else as `reconstruct`.
    """
    if name not in STAGES:
        raise SdfsimError(f"no such stage: {name!r}", "stages: " + ", ".join(STAGES))
    run = Run(Path(folder), read_config(Path(folder)), progress)
    known = {key: value for key, value in changes.items() if value is not None}
    unknown = set(known) - set(asdict(run.options))
    if unknown:
        raise SdfsimError(f"no such option: {', '.join(sorted(unknown))}")
    run.options = run.options.changed(known)
    run.options.check()
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
    inputs = before["fingerprint"] if before else record.content_of_photos(Path(run.options.photos))
    extra = {}
    if stage == "fit":
        from sdfsim.shape.fit import FIT_VERSION

        extra["version"] = FIT_VERSION
    wanted = record.fingerprint(stage, inputs, {**run.options.of_stage(stage), **extra}, CODE[stage])
    known = record.read(run.place(stage))
    complete = stage != "scene" or (run.folder / "scene.yaml").exists()
    if not again and known and known["fingerprint"] == wanted and complete:
        run.tell(stage)(1.0, "unchanged")
        return
    work = record.begin(run.folder / f".{stage}.part", wanted, fresh=again)
    started = time.monotonic()
    report = ACTIONS[stage](run, work)
    # Training that a killed run had already done counts as well.
    seconds = time.monotonic() - started + report.get("seconds_before", 0.0)
    record.finish(work, run.place(stage), wanted, inputs, report, seconds)
    run.tell(stage)(1.0, f"done in {seconds:.0f} s")


def do_photos(run: Run, work: Path) -> dict:
    """Photos stage."""
    from pipeline.photos import prepare_photos

    photos, notes = prepare_photos(Path(run.options.photos), work, on_progress=run.tell("photos"))
    return {"count": len(photos), "notes": notes, "masks": sum(p.mask for p in photos)}


def do_poses(run: Run, work: Path) -> dict:
    """Poses stage."""
    from pipeline.photos import load_photos
    from pipeline.poses import solve

    photos = run.place("photos")
    return solve(load_photos(photos), photos, work, seed=run.options.seed, on_progress=run.tell("poses"))


def do_distill(run: Run, work: Path) -> dict:
    """Distill stage."""
    from pipeline.cameras import load_sparse, load_views
    from pipeline.distill import train
    from pipeline.recipe import PRESETS as RECIPES

    budget = run.options.budget
    if budget is not None:
        spent = time.monotonic() - run.started
        budget = max(20.0, budget * (1 - FIT_SHARE) - spent - AFTER_TRAINING)
    poses = run.place("poses")
    trained = train(
        load_views(poses), load_sparse(poses), run.place("photos"), work, recipe=RECIPES[run.options.preset],
        budget=budget, seed=run.options.seed, device=pick_device(run.options.device), on_progress=run.tell("distill"),
    )  # fmt: skip
    return trained.report


def do_mesh(run: Run, work: Path) -> dict:
    """Mesh stage."""
    from pipeline.meshing import make_meshes
    from pipeline.sources import find_source

    named = find_source(Path(run.options.photos)).folder
    return make_meshes(
        run.place("distill"), run.place("poses"), run.place("photos"), named, work,
        preset=run.options.preset, wishes=run.options.wishes(), on_progress=run.tell("mesh"),
    )  # fmt: skip


def do_fit(run: Run, work: Path) -> dict:
    """Fit stage."""
    from pipeline.asset import fit_parts
    from sdfsim.threads import choose_threads, network_work

    choose_threads(network_work, repeat=10)
    budget = None if run.options.budget is None else max(10.0, FIT_SHARE * run.options.budget)
    return fit_parts(
        run.place("mesh"), work, budget=budget, recipe=run.options.recipe, seed=run.options.seed,
        on_progress=run.tell("fit"),
    )  # fmt: skip


def do_scene(run: Run, work: Path) -> dict:
    """Scene stage."""
    from pipeline.scene_file import write_scene

    before = record.read(run.place("scene"))
    written = before["report"].get("scene_sha256") if before else None
    return write_scene(
        run.place("mesh"), run.folder / "scene.yaml", shape=run.options.drop, static=run.options.static,
        written=written, seed=run.options.seed,
    )  # fmt: skip


ACTIONS: dict[str, Callable[[Run, Path], dict]] = {
    "photos": do_photos, "poses": do_poses, "distill": do_distill, "mesh": do_mesh, "fit": do_fit, "scene": do_scene,
}  # fmt: skip


def pick_device(name: str) -> str:
    """The torch device for auto, cpu or cuda.

    Raises:
        SdfsimError: cuda was asked for and is not there.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise SdfsimError("device: no CUDA device here", "use --device cpu")
    return name
