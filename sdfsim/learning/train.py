"""Training: one loop for both networks, resumable to the step, needing only torch and numpy once frames are cached."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from sdfsim.errors import SdfsimError
from sdfsim.files import locked, read_arrays, write_arrays, write_text
from sdfsim.learning.dataset import SPLITS, read_info
from sdfsim.learning.optimiser import Optimiser
from sdfsim.learning.presets import PRESETS, Preset

CHECKPOINT_SECONDS = 60.0
LOG_STEPS = 100
EMA_DECAY = 0.999
CLIP = 1.0
BAD_BATCHES = 20  # consecutive batches without a finite gradient before training gives up

Progress = Callable[[float, str], None]


class Task(Protocol):
    """What a network is trained on: batches and their loss."""

    def draw(self, rng: np.random.Generator, count: int) -> Any: ...

    def loss(self, network: Any, batch: Any, *, mirrored: bool = False) -> Tensor: ...


def train(
    data: Path | Sequence[Path],
    out: Path,
    *,
    preset: str = "small",
    resume: bool = False,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_progress: Progress | None = None,
) -> dict:
    """Train a preset on one dataset or several; write `model.safetensors`, `log.jsonl` and a checkpoint under `out`.

    Args:
        data: dataset folders with train/ and validation/; several (impulse only) are drawn from as if they were one.
        out: training folder.
        preset: name in `PRESETS`.
        resume: go on from the checkpoint in `out`; the result equals an uninterrupted run's.
        steps: of the optimiser, instead of the preset's.
        seed: of initial weights and batches.
        device: "cpu", "cuda" or "auto".
        on_progress: called with the fraction done and a message.

    Returns:
        A report: paths, losses, seconds.

    Raises:
        SdfsimError: unknown preset, unusable data, a checkpoint in `out` without `resume`, another run writing
            to it, diverged training.
    """
    from sdfsim.dynamics.simulator import pick_device

    if preset not in PRESETS:
        raise SdfsimError(f"unknown preset {preset!r}", f"known: {', '.join(PRESETS)}")
    plan = PRESETS[preset]
    folders = [data] if isinstance(data, Path) else list(data)
    total = steps or plan.steps
    checkpoint = out / "checkpoint.npz"
    if checkpoint.exists() and not resume:
        raise SdfsimError(f"{checkpoint} exists", "continue with --resume, or choose another -o")
    tell = on_progress or (lambda fraction, message: None)
    with locked(out):
        place = pick_device(device)
        task, held_out = _tasks(plan, folders, place, lambda f, m: tell(0.0, m))
        run = Run(plan, task, total, seed, place)
        if checkpoint.exists():
            run.load(checkpoint)
        _shorten(out / "log.jsonl", run.step)
        _loop(run, held_out, out, tell)
        model = run.export(name=preset, data=[_made(folder) for folder in folders], ranges=task.ranges())
        target: Path | None = out / "model.safetensors"
        try:
            model.save(target)
        except ImportError:
            # Nothing is lost: with the checkpoint, --resume writes the model where safetensors is installed.
            target = None
        return {
            "model": str(target) if target else None,
            "steps": run.step,
            "seconds": run.seconds,
            "loss": run.loss,
            "held_out_loss": held_out_loss(run, held_out),
        }


def _made(data: Path) -> dict[str, Any]:
    """What a model's card tells of a dataset."""
    info = read_info(data)
    counts = {split: len(list((data / split).glob("*.npz"))) for split in SPLITS if (data / split).is_dir()}
    known = {k: info.get(k) for k in ("recipe", "seed", "engine", "engine_version")}
    return known | {"shapes": len(info.get("shapes", [])), "trajectories": counts}


def _tasks(plan: Preset, folders: Sequence[Path], device: torch.device, tell: Progress):
    """Training and held-out tasks of a preset."""
    if plan.kind == "impulse":
        from sdfsim.learning.frames import contact_frames, join_frames
        from sdfsim.learning.impulse_task import ImpulseTask, Noise

        sets = {
            split: join_frames([contact_frames(folder, split, plan.reach, on_progress=tell) for folder in folders])
            for split in ("train", "validation")
        }
        return ImpulseTask(sets["train"], device, Noise()), ImpulseTask(sets["validation"], device, None)
    from sdfsim.learning.paper_task import PaperTask

    if len(folders) > 1:
        raise SdfsimError("the paper network trains on one dataset", "give a single --data")
    data = folders[0]
    return (
        PaperTask(data, "train", plan.reach, device, plan.noise),
        PaperTask(data, "validation", plan.reach, device, None),
    )


class Run:
    """Everything that changes while training, and how to save it.

    Args:
        plan: preset.
        task: gives batches and losses.
        total: optimiser steps of the whole run (the learning rate depends on it).
        seed: of weights and batches.
        device: of weights and batches.
    """

    def __init__(self, plan: Preset, task: Any, total: int, seed: int, device: torch.device) -> None:
        from sdfsim.dynamics.model import new_network

        torch.manual_seed(seed)
        self.plan, self.task, self.total, self.seed, self.device = plan, task, total, seed, device
        self.network: nn.Module = new_network(plan.kind, plan.config).to(device)
        if hasattr(task, "prepare"):
            task.prepare(self.network, np.random.default_rng([seed, 1]))
        # Averaged are the trained weights; feature statistics are fixed before the first step.
        self.weights = dict(self.network.named_parameters())
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimiser = Optimiser(self.network, plan)
        self.step, self.seconds, self.loss, self.skipped = 0, 0.0, math.nan, 0

    def advance(self) -> None:
        """One optimiser step on a batch that depends on (seed, step) alone."""
        rng = np.random.default_rng([self.seed, 0, self.step])
        batch = self.task.draw(rng, self.plan.batch)
        loss = self.task.loss(self.network, batch, mirrored=bool(rng.integers(2)))
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
        if bool(norm.isfinite()):
            self.optimiser.step(self.share())
            self.skipped = 0
        else:
            self.skipped += 1
            if self.skipped >= BAD_BATCHES:
                raise SdfsimError(f"training diverged at step {self.step}: no finite gradient in {BAD_BATCHES} batches")
        self.step += 1
        value = float(loss.detach())
        self.loss = value if math.isnan(self.loss) else 0.99 * self.loss + 0.01 * value
        decay = min(EMA_DECAY, (1.0 + self.step) / (10.0 + self.step))
        with torch.no_grad():
            for name, weight in self.weights.items():
                self.average[name].lerp_(weight, 1.0 - decay)

    def share(self) -> float:
        """Of the peak learning rates: a warm-up over 2 % of all steps, 1000 at most, then a cosine to a hundredth."""
        warm = min(1.0, (self.step + 1) / max(1.0, min(1000.0, 0.02 * self.total)))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / self.total)))
        return warm * (0.01 + 0.99 * fall)

    def averaged(self) -> nn.Module:
        """The network with its averaged weights."""
        from sdfsim.dynamics.model import new_network

        network = new_network(self.plan.kind, self.plan.config).to(self.device)
        network.load_state_dict(self.average)
        return network.eval().requires_grad_(False)

    def save(self, path: Path) -> None:
        """Write everything. Arrays only: nothing is pickled."""
        arrays: dict[str, np.ndarray] = {}
        for name, weight in self.network.state_dict().items():
            arrays[f"network/{name}"] = weight.cpu().numpy()
            arrays[f"average/{name}"] = self.average[name].cpu().numpy()
        for name, value in self.optimiser.state().items():
            arrays[f"optimiser/{name}"] = value.cpu().numpy()
        progress = {"step": self.step, "seconds": self.seconds, "loss": self.loss, "total": self.total}
        arrays["run"] = np.array(json.dumps({"plan": asdict(self.plan), "seed": self.seed, **progress}))
        write_arrays(path, arrays, compressed=False)

    def load(self, path: Path) -> None:
        """Take up a saved run. Raises SdfsimError when it is another preset's or seed's, or unreadable."""
        arrays = read_arrays(path, "a checkpoint", "delete it to start anew")
        info: dict[str, Any] = json.loads(str(arrays["run"])) if "run" in arrays else {"plan": None}
        if info["plan"] != asdict(self.plan) or info["seed"] != self.seed or info["total"] != self.total:
            raise SdfsimError(f"{path} belongs to another preset, seed or number of steps", "choose another -o")
        tensors = {k: torch.from_numpy(v).to(self.device) for k, v in arrays.items() if k != "run"}
        self.network.load_state_dict({k[8:]: v for k, v in tensors.items() if k.startswith("network/")})
        self.average = {k[8:]: v for k, v in tensors.items() if k.startswith("average/")}
        self.optimiser.load({k[10:]: v for k, v in tensors.items() if k.startswith("optimiser/")})
        self.step, self.seconds, self.loss = info["step"], info["seconds"], info["loss"]

    def export(self, *, name: str, data: list[dict[str, Any]], ranges: dict[str, list[float]]):
        """The averaged weights as a `Model`."""
        from sdfsim.dynamics.model import Model

        card = {
            "data": data,
            "optimiser_steps": self.step,
            "seconds": round(self.seconds),
            "threads": torch.get_num_threads(),
            "device": str(self.device),
            "preset_name": name,
            "preset": asdict(self.plan),
        }
        return Model(
            name=name,
            kind=self.plan.kind,
            network=self.averaged(),
            dt=self.task.dt,
            gravity=self.task.gravity,
            length=float(np.mean(ranges["size"])),
            reach=self.plan.reach,
            nodes=getattr(self.task, "nodes", None),
            ranges=ranges,
            card=card,
        )


def held_out_loss(run: Run, task: Task, batches: int = 8) -> float:
    """Loss of the averaged weights on a fixed set of held-out batches."""
    network, rng = run.averaged(), np.random.default_rng(12345)
    with torch.no_grad():
        losses = [float(task.loss(network, task.draw(rng, 64))) for _ in range(batches)]
    return float(np.mean(losses))


def _loop(run: Run, held_out: Task, out: Path, tell: Progress) -> None:
    saved = time.monotonic()
    try:
        while run.step < run.total:
            started = time.monotonic()
            run.advance()
            run.seconds += time.monotonic() - started
            if run.step % LOG_STEPS == 0:
                tell(run.step / run.total, f"step {run.step}, loss {run.loss:.4f}")
            if run.step % min(1000, max(1, run.total // 10)) == 0 or run.step == run.total:
                rate = run.plan.rate * run.share()
                entry = {"step": run.step, "seconds": round(run.seconds, 1), "loss": run.loss, "rate": rate}
                with open(out / "log.jsonl", "a") as log:
                    log.write(json.dumps(entry | {"held_out_loss": held_out_loss(run, held_out)}) + "\n")
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                run.save(out / "checkpoint.npz")
                saved = time.monotonic()
    finally:
        # Also on Ctrl-C: what has been learned is kept.
        run.save(out / "checkpoint.npz")


def _shorten(log: Path, step: int) -> None:
    """Leave of a log what was written up to a step, in whole lines: the rest will be done, and logged, again."""
    if not log.exists():
        return
    kept = []
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
        try:
            entry = json.loads(line)
        except ValueError:
            break  # a kill has cut it short
        if entry["step"] > step:
            break
        kept.append(line)
    write_text(log, "".join(kept))


def main() -> None:
    """Command line of this module, for machines that have only torch and numpy."""
    parser = argparse.ArgumentParser(description="Train on a dataset whose contact frames are cached.")
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="small", choices=list(PRESETS))
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--resume", action="store_true")
    args = parser.parse_args()
    options = {name: getattr(args, name) for name in ("preset", "resume", "steps", "seed", "device")}
    try:
        report = train(args.data, args.out, **options, on_progress=lambda f, m: print(f"{f:6.1%}  {m}", flush=True))
    except SdfsimError as error:
        sys.exit(f"error: {error}\n{error.hint}")
    print(json.dumps(report))


if __name__ == "__main__":
    main()
