"""Training: one loop for all networks, which can resume at any step, and needs only torch and numpy once frames are
cached."""

import json
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import locked, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.data.dataset import SOLID, SPLITS, conditions_of, read_info
from sdfsim.training.presets import PRESETS, Preset
from sdfsim.training.run import Run, held_out_loss

CHECKPOINT_SECONDS = 60.0
TELL_STEPS = 100


def train(
    data: Path | Sequence[Path],
    out: Path,
    *,
    preset: str = "gnn",
    resume: bool = False,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_progress: Progress = silent,
) -> dict:
    """Train a preset on one or several datasets; write `model.safetensors`, `log.jsonl` and a checkpoint in `out`.

    Datasets have train/ and validation/; several (impulse only) are used as if they were one. The preset is a name in
    `PRESETS`, with other `steps` if given. `resume` continues from the checkpoint in `out`, with the result of an
    uninterrupted run. Returns paths, losses and processor time.
    Raises SdfsimError if data are unusable, if `out` has a checkpoint and `resume` is not set, if another run is
    writing to `out`, or if training diverges.
    """
    from sdfsim.base.devices import pick_device

    plan = PRESETS[preset]
    folders = [data] if isinstance(data, Path) else list(data)
    total = plan.steps if steps is None else steps
    if total < 1:
        raise SdfsimError(f"steps: must be at least 1 (got {total})")
    checkpoint = out / "checkpoint.npz"
    if checkpoint.exists() and not resume:
        raise SdfsimError(f"{checkpoint} exists", "continue with --resume, or choose another -o")
    infos = [read_info(folder) for folder in folders]
    place = pick_device(device)
    with locked(out):
        task, held_out = _tasks(plan, folders, lambda _, message: on_progress(0.0, message))
        made = [_made(*one) for one in zip(folders, infos, task.counts, held_out.counts, strict=True)]
        run = Run(plan, task, total, seed, place)
        if checkpoint.exists():
            run.load(checkpoint)
        _shorten(out / "log.jsonl", run.step)
        _loop(run, held_out, out, on_progress)
        run.export(preset, made).save(out / "model.safetensors")
        report = {"steps": run.step, "seconds": run.seconds, "loss": run.loss}
        report |= {"model": str(out / "model.safetensors"), "held_out_loss": held_out_loss(run, held_out)}
    return report


def _made(data: Path, info: dict, train: int, validation: int) -> dict[str, Any]:
    """The description of a dataset in a model's card. The numbers of trajectories are used if the files are not
    here."""
    here = {split: len(list((data / split).glob("*.npz"))) for split in SPLITS if (data / split).is_dir()}
    known = {k: info.get(k) for k in ("recipe", "seed", "engine", "engine_version")}
    known["floor"] = list(conditions_of(data).floor)
    shapes = info.get("shapes", [])
    solids = sum(name.startswith(SOLID) for name in shapes)
    counts = {"train": train, "validation": validation} | here
    return known | {"shapes": len(shapes), "random_solids": solids, "trajectories": counts}


def _tasks(plan: Preset, folders: Sequence[Path], tell: Progress):
    if plan.kind == "impulse":
        from sdfsim.training.contact_frames import Disturbed, contact_frames, join_frames
        from sdfsim.training.impulse_task import ImpulseTask

        def task(split: str, draws: int) -> ImpulseTask:
            sets = [contact_frames(folder, split, Disturbed(draws), on_progress=tell) for folder in folders]
            return ImpulseTask(join_frames(sets))

        return task("train", 2), task("validation", 1)
    from sdfsim.training.surface_task import SurfaceTask

    if len(folders) > 1:
        raise SdfsimError("networks on surface nodes train on one dataset", "give a single --data")
    data = folders[0]
    return SurfaceTask(data, "train", plan, noisy=True), SurfaceTask(data, "validation", plan)


def _loop(run: Run, held_out: Any, out: Path, on_progress: Progress) -> None:
    saved = time.monotonic()
    try:
        while run.step < run.total:
            started = time.process_time()
            with _uninterrupted():
                run.advance()
                run.seconds += time.process_time() - started
                due = run.step % min(1000, max(1, run.total // 10)) == 0 or run.step == run.total
                if due:  # the log line is part of the step
                    entry = {"step": run.step, "seconds": round(run.seconds, 1), "loss": run.loss}
                    entry |= {"rate": run.plan.rate * run.share(), "held_out_loss": held_out_loss(run, held_out)}
                    with open(out / "log.jsonl", "a", encoding="utf-8") as log:
                        log.write(json.dumps(entry) + "\n")
            if run.step % TELL_STEPS == 0:
                on_progress(run.step / run.total, f"step {run.step}, loss {run.loss:.4f}")
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                run.save(out / "checkpoint.npz")
                saved = time.monotonic()
    finally:
        # Also after Ctrl-C, so that the training so far is kept.
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
