"""Training: one loop for all networks, which can resume at any step, and needs only torch and numpy once frames are
cached."""

import argparse
import json
import math
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sdfsim.base.errors import SdfsimError, run_main
from sdfsim.base.files import locked, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.data.dataset import SOLID, SPLITS, conditions_of, read_info
from sdfsim.training.distributed import gather_team
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.run import Run, held_out_loss

CHECKPOINT_SECONDS = 60.0
TELL_STEPS = 100


def train(
    data: Path | Sequence[Path],
    out: Path,
    *,
    preset: str | Preset = "small",
    resume: bool = False,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    budget: float = math.inf,
    workers: int = 0,
    scene: Path | None = None,
    first: str | Path | None = None,
    allow_outside: bool = False,
    on_progress: Progress = silent,
) -> dict:
    """Train a preset on one or several datasets, or on recordings of a `scene`; write `model.safetensors`, `log.jsonl`
    and a checkpoint in `out`.

    Datasets have train/ and validation/; several (impulse only) are used as if they were one. Recordings are in the
    forms that `sdfsim identify` reads, of one scene (best as `identify` wrote it); every sixth is held out. Training on
    them is over several steps in a row, on the CPU, with the preset "impacts" or "alone". The preset is a name in
    `PRESETS`, or your own, with other `steps` if given. `first` is a model, by bundled name or path, with whose weights
    training begins. `resume` continues from the checkpoint in `out`, with the result of an uninterrupted run. `budget`
    is processor time in s, all cores together, after which training stops early. `workers` is a number of processes
    that draw batches in advance, with the same result: otherwise a GPU waits for the contacts of networks on surface
    nodes, which are found on the CPU. Returns paths, losses and processor time. Raises SdfsimError if data are
    unusable, if `first` is another network than the preset's, if `out` has a checkpoint and `resume` is not set, if
    another run is writing to `out`, or if training diverges.
    """
    from sdfsim.base.devices import pick_device
    from sdfsim.learned.model import load_model

    plan = PRESETS[preset] if isinstance(preset, str) else preset
    folders = [data] if isinstance(data, Path) else list(data)
    total = plan.steps if steps is None else steps
    if total < 1:
        raise SdfsimError(f"steps: must be at least 1 (got {total})")
    if workers < 0:
        raise SdfsimError(f"workers: must be at least 0 (got {workers})")
    checkpoint = out / "checkpoint.npz"
    if checkpoint.exists() and not resume:
        raise SdfsimError(f"{checkpoint} exists", "continue with --resume, or choose another -o")
    _check_kind(plan, scene, workers)
    infos = [read_info(folder) for folder in folders] if scene is None else []
    team, device = gather_team("cpu" if scene else device)
    place = pick_device(device)
    with locked(out) if team.leads else nullcontext():
        with team.in_turn():  # the first process finds contacts and caches them, the others read them
            if scene is None:
                task, held_out = _tasks(plan, folders, lambda _, message: on_progress(0.0, message))
                counts = zip(folders, infos, task.counts, held_out.counts, strict=True)
                made = [_made(*one) for one in counts]
            else:
                task, held_out = _motion_tasks(folders, scene, on_progress, allow_outside=allow_outside)
                counts = {"train": task.counts[0], "validation": held_out.counts[0]}
                made = [{"scene": scene.name, "recordings": counts}]
        begun = None if first is None else load_model(first)
        run = Run(plan, task, total, seed, place, team, workers, begun)
        if checkpoint.exists():
            run.load(checkpoint)
        team.wait()
        if team.leads:
            _shorten(out / "log.jsonl", run.step)
        _loop(run, held_out, out, budget, on_progress)
        report = {"steps": run.step, "seconds": run.seconds, "loss": run.loss}
        if team.leads:
            if begun is not None:
                made = [*made, {"weights": begun.name, "data": begun.card.get("data", [])}]
            model = run.export(preset if isinstance(preset, str) else preset.kind, made)
            report |= {"model": str(out / "model.safetensors"), "held_out_loss": held_out_loss(run, held_out)}
            try:
                model.save(out / "model.safetensors")
            except ImportError:  # without safetensors: --resume on another machine writes it from the checkpoint
                report["model"] = None
    return report


def _made(data: Path, info: dict, train: int, validation: int) -> dict[str, Any]:
    """The description of a dataset in a model's card. The numbers of trajectories are used if the files are not
    here."""
    here = {split: len(list((data / split).glob("*.npz"))) for split in SPLITS if (data / split).is_dir()}
    known = {k: info.get(k) for k in ("recipe", "seed", "engine", "engine_version")}
    known |= {k: info[k] for k in ("bodies", "fps") if info.get(k)}
    conditions = conditions_of(data)
    known |= {"floor": list(conditions.floor), "as_teacher": conditions.by_teacher}
    shapes = info.get("shapes", [])
    solids = sum(name.startswith(SOLID) for name in shapes)
    counts = {"train": train, "validation": validation} | here
    return known | {"shapes": len(shapes), "random_solids": solids, "trajectories": counts}


def _tasks(plan: Preset, folders: Sequence[Path], tell: Progress):
    if plan.kind == "impulse":
        from sdfsim.training.contact_cache import Solved, contact_frames, join_frames
        from sdfsim.training.impulse_task import ImpulseTask

        def task(split: str, draws: int) -> ImpulseTask:
            sets = [contact_frames(folder, split, Solved(draws), on_progress=tell) for folder in folders]
            return ImpulseTask(join_frames(sets))

        return task("train", 2), task("validation", 1)
    from sdfsim.training.surface_task import SurfaceTask

    if len(folders) > 1:
        raise SdfsimError("networks on surface nodes train on one dataset", "give a single --data")
    data = folders[0]
    return SurfaceTask(data, "train", plan, noisy=True), SurfaceTask(data, "validation", plan)


def _check_kind(plan: Preset, scene: Path | None, workers: int) -> None:
    """Raise SdfsimError if a preset cannot be trained on the given data."""
    impacts, alone = (bool(plan.config.get(name)) for name in ("impacts", "alone"))
    if scene is None and impacts:
        raise SdfsimError("preset: impacts trains on recordings of real motions", "give them as --data, with --scene")
    if scene is not None and workers:
        raise SdfsimError("workers: batches of recordings are drawn in one process", "leave --workers out")
    if scene is not None and not (impacts or alone):
        raise SdfsimError("preset: only impacts and alone train on recordings of a scene", "give --preset impacts")


def _motion_tasks(paths: Sequence[Path], scene: Path, tell: Progress, *, allow_outside: bool):
    from sdfsim.apps.observed import load_recordings
    from sdfsim.training.motion_task import HELD, LEAST, MotionTask

    recordings, known = load_recordings(paths, scene, allow_outside=allow_outside, on_progress=tell)
    if len(recordings) < LEAST:
        raise SdfsimError(f"{len(recordings)} recordings (at least {LEAST} to train on)", "give more of the same scene")
    held = [r for k, r in enumerate(recordings) if k % HELD == min(HELD, len(recordings)) - 1]
    kept = [r for r in recordings if not any(r is other for other in held)]
    return MotionTask(kept, known, noisy=True), MotionTask(held, known)


def _loop(run: Run, held_out: Any, out: Path, budget: float, on_progress: Progress) -> None:
    saved = time.monotonic()
    try:
        while run.step < run.total and run.seconds < budget:
            started = time.process_time()
            with _uninterrupted():
                run.advance()
                run.seconds += time.process_time() - started
                due = run.step % min(1000, max(1, run.total // 10)) == 0 or run.step == run.total
                if run.team.leads and due:  # the log line is part of the step
                    entry = {"step": run.step, "seconds": round(run.seconds, 1), "loss": run.loss}
                    entry |= {"rate": run.plan.rate * run.share(), "held_out_loss": held_out_loss(run, held_out)}
                    with open(out / "log.jsonl", "a", encoding="utf-8") as log:
                        log.write(json.dumps(entry) + "\n")
            if not run.team.leads:
                continue
            if run.step % TELL_STEPS == 0:
                on_progress(run.step / run.total, f"step {run.step}, loss {run.loss:.4f}")
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                run.save(out / "checkpoint.npz")
                saved = time.monotonic()
    finally:
        run.close()
        # Also after Ctrl-C, so that the training so far is kept.
        if run.team.leads:
            run.save(out / "checkpoint.npz")


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C to the end of a step: a checkpoint in the middle of a step would change the resumed run."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives Ctrl-C
        return
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def _shorten(log: Path, step: int) -> None:
    """Cut a log after a step: the later steps will be done, and logged, again."""
    kept = []
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []:
        with suppress(ValueError):  # the process may have been killed while writing a line
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
    write_text(log, "".join(kept))


def main() -> None:
    """Command line of this module, for machines with only torch and numpy."""
    parser = argparse.ArgumentParser(description="Train on a dataset whose contact frames are cached.")
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="small", choices=list(PRESETS))
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--workers", type=int, default=0, help="processes that draw batches in advance")
    parser.add_argument("--resume", action="store_true")
    options = vars(parser.parse_args())
    data, out = options.pop("data"), options.pop("out")
    print(json.dumps(train(data, out, **options, on_progress=lambda f, m: print(f"{f:6.1%}  {m}", flush=True))))


if __name__ == "__main__":
    run_main(main)
