"""A long rollout on disk while it runs, so that it goes on where it was killed: RUN/checkpoint/."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdfsim.dynamics.bodies import Sleep, State, Touch
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import Simulator, join
from sdfsim.dynamics.sleep import Rest
from sdfsim.errors import SdfsimError
from sdfsim.files import read_arrays, read_json, write_arrays
from sdfsim.shape.sdf_batch import SdfBank

CHECKPOINT = "checkpoint"  # folder in that of the run
EVERY = 30.0  # s between two checkpoints
_STATE = "state.npz"
_ANEW = "leave --resume away to start anew"
_OTHER = "is of another scene, model or seed"


class Checkpoint:
    """What is kept of one run: its frames in parts, the state that the last part leads to, and how long all has rested.

    Args:
        folder: of the run.
        simulator: at its start.

    Attributes:
        identity: of the run, see the function of this name.
        rest: for how long everything has rested.
    """

    def __init__(self, folder: Path, simulator: Simulator) -> None:
        self._folder = folder / CHECKPOINT
        self._simulator = simulator
        self.identity = identity(simulator)
        self.rest = Rest()
        self._fresh: list[tuple[Rollout, State, int, Rest]] = []  # one entry a step: an interruption splits none
        self._parts = 0
        self._saved = time.monotonic()

    def restore(self) -> list[Rollout]:
        """The frames so far, the simulator's state brought to the last of them; none where nothing was kept.

        Raises:
            SdfsimError: what is kept is of another scene, model or seed, or damaged.
        """
        if not (self._folder / _STATE).exists():
            return []
        kept = read_arrays(self._folder / _STATE, "a checkpoint", _ANEW)
        simulator = self._simulator
        try:
            if str(kept["identity"]) != self.identity:
                raise SdfsimError(f"{self._folder}: {_OTHER}", _ANEW)
            self._parts = int(kept["parts"])
            simulator.state = _state(kept, simulator.device)
            simulator.steps_done = int(kept["steps_done"])
            self.rest = Rest(torch.as_tensor(kept["rest.anchor"], device=simulator.device), int(kept["rest.quiet"]))
        except (KeyError, TypeError, ValueError) as error:
            raise SdfsimError(f"{self._folder / _STATE}: not a checkpoint of this version ({error})", _ANEW) from error
        return [Rollout.load(self._folder / _part(k)) for k in range(self._parts)]

    def add(self, frame: Rollout) -> None:
        """Keep a frame and the state it tells of; on disk when the last time is long enough ago."""
        simulator = self._simulator
        self.rest = self.rest.after(simulator.bodies, simulator.state)
        self._fresh.append((frame, simulator.state, simulator.steps_done, self.rest))
        if time.monotonic() - self._saved > EVERY:
            self.save()

    def save(self) -> None:
        """Bring what is new to the disk; the state comes last, so that it never tells of a part that is not there."""
        if self._fresh:
            self._folder.mkdir(exist_ok=True)
            _, state, steps, rest = self._fresh[-1]
            join([frame for frame, *_ in self._fresh]).save(self._folder / _part(self._parts))
            done = {"identity": self.identity, "parts": self._parts + 1, "steps_done": steps}
            write_arrays(self._folder / _STATE, {**done, **_arrays(state, rest)}, compressed=False)
            self._fresh = []  # not before: Ctrl-C amid this saves once more, and must write the same part again
            self._parts += 1
        self._saved = time.monotonic()

    def clear(self) -> None:
        """Nothing is to be gone on with. The state goes first: parts that a kill leaves are nothing without it."""
        (self._folder / _STATE).unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)


def finished(report_file: Path, identity: str, steps: int, *, until_settled: bool) -> dict[str, Any] | None:
    """The report of a run that is finished; None where it was interrupted or is not there.

    Args:
        report_file: report.json of the run folder.
        identity: of the run that is asked for.
        steps: that it takes at most.
        until_settled: whether it ends as soon as everything has come to rest.

    Raises:
        SdfsimError: the finished run is another one or of another length, or its state broke.
    """
    if not report_file.exists():
        return None
    report, folder = read_json(report_file, _ANEW), report_file.parent
    if report["status"] == "interrupted":
        return None
    if report.get("identity") != identity:
        raise SdfsimError(f"{folder}: {_OTHER}", _ANEW)
    if report["status"] == "failed":
        raise SdfsimError(f"{folder}: this run has ended: {report['error']}", _ANEW)
    settled = until_settled and report.get("settled") and report["steps"] < steps
    if report["steps"] != steps and not settled:
        told = f"{report['steps']} steps, {report['simulated_s']:.4g} s"
        raise SdfsimError(f"{folder}: finished after {told}; its length cannot be changed", "choose a new -o")
    return report


def identity(simulator: Simulator) -> str:
    """A hash of all that decides how a run goes: bodies with their paths and distances, start, rules, units, model."""
    s, told = simulator, hashlib.sha256()
    model = (s.model.kind, s.model.reach, *s.model.network.state_dict().items())
    for piece in _pieces((s.dt, s.seed, replace(s.rules, rows=None), s.units, s.bodies, s.state, model)):
        told.update(piece)
    return told.hexdigest()


def _pieces(value: Any) -> Iterator[bytes]:
    """All that `value` is made of, to the last bit."""
    if isinstance(value, torch.Tensor):
        value = value.cpu().numpy()
    elif isinstance(value, SdfBank):
        value = value.sdfs
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) or isinstance(value, tuple):
        parts = value if isinstance(value, tuple) else [getattr(value, field.name) for field in fields(value)]
        yield f"{type(value).__name__}{len(parts)}".encode()
        for part in parts:
            yield from _pieces(part)
    else:
        yield repr(value).encode()


def _part(number: int) -> str:
    return f"part_{number:04}.npz"


def _arrays(state: State, rest: Rest) -> dict[str, np.ndarray]:
    """Every array of a state, of who sleeps in it and of how long all has rested, by name."""
    found = {"time": np.array(state.time), "rest.quiet": np.array(rest.quiet)}
    for prefix, of in (("", state), ("sleep.", state.sleep), ("touch.", state.touch), ("rest.", rest)):
        for field in fields(of) if of is not None else ():
            value = getattr(of, field.name)
            if isinstance(value, torch.Tensor):
                found[prefix + field.name] = value.cpu().numpy()
    return found


def _state(arrays: dict[str, np.ndarray], device: torch.device) -> State:
    def tensors(kind: type, prefix: str) -> dict[str, torch.Tensor]:
        names = {f.name: prefix + f.name for f in fields(kind) if f.name != "time"}
        return {k: torch.as_tensor(arrays[name], device=device) for k, name in names.items() if name in arrays}

    asleep, touch = tensors(Sleep, "sleep."), tensors(Touch, "touch.")
    return State(
        **tensors(State, ""),
        sleep=Sleep(**asleep) if asleep else None,
        touch=Touch(**touch) if touch else None,
        time=float(arrays["time"]),
    )
