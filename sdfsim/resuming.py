"""A long rollout on disk while it runs, so that it goes on where it was killed: RUN/checkpoint/."""

from __future__ import annotations

import hashlib
import shutil
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.dynamics.bodies import Sleep, State
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import Simulator, join
from sdfsim.errors import SdfsimError
from sdfsim.files import read_arrays, write_arrays

EVERY = 30.0  # s between two checkpoints
_STATE = "state.npz"


class Checkpoint:
    """What is kept of one run: its frames in parts, and the state that the last part leads to.

    Args:
        folder: of the run.
        simulator: at its start.
    """

    def __init__(self, folder: Path, simulator: Simulator) -> None:
        self._folder = folder / "checkpoint"
        self._simulator = simulator
        self._identity = identity(simulator)
        self._fresh: list[tuple[Rollout, State, int]] = []  # one entry a step: an interruption splits none
        self._parts = 0
        self._saved = time.monotonic()

    def restore(self) -> list[Rollout]:
        """The frames so far, the simulator's state brought to the last of them; none where nothing was kept.

        Raises:
            SdfsimError: what is kept is of another scene, model or seed, or damaged.
        """
        if not (self._folder / _STATE).exists():
            return []
        kept = read_arrays(self._folder / _STATE, "a checkpoint", "leave --resume away to start anew")
        if str(kept["identity"]) != self._identity:
            raise SdfsimError(
                f"{self._folder}: is of another scene, model or seed", "leave --resume away to start anew"
            )
        self._parts = int(kept["parts"])
        simulator = self._simulator
        simulator.state = _state(kept, simulator.device)
        simulator.steps_done = int(kept["steps_done"])
        return [Rollout.load(self._folder / _part(k)) for k in range(self._parts)]

    def add(self, frame: Rollout) -> None:
        """Keep a frame; on disk when the last time is long enough ago."""
        self._fresh.append((frame, self._simulator.state, self._simulator.steps_done))
        if time.monotonic() - self._saved > EVERY:
            self.save()

    def save(self) -> None:
        """Bring what is new to the disk; the state comes last, so that it never tells of a part that is not there."""
        if self._fresh:
            self._folder.mkdir(exist_ok=True)
            frames, states, steps = zip(*self._fresh, strict=True)
            join(list(frames)).save(self._folder / _part(self._parts))
            done = {"identity": self._identity, "parts": self._parts + 1, "steps_done": steps[-1]}
            write_arrays(self._folder / _STATE, {**done, **_arrays(states[-1])}, compressed=False)
            self._fresh = []  # not before: Ctrl-C amid this saves once more, and must write the same part again
            self._parts += 1
        self._saved = time.monotonic()

    def clear(self) -> None:
        """Nothing is to be gone on with. The state goes first: parts that a kill leaves are nothing without it."""
        (self._folder / _STATE).unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)


def identity(simulator: Simulator) -> str:
    """A hash of all that decides how a run goes: bodies, start, rules and weights."""
    told = hashlib.sha256(f"{simulator.dt!r} {simulator.seed} {replace(simulator.rules, rows=None)}".encode())
    parts = [getattr(simulator.bodies, f.name) for f in fields(simulator.bodies)]
    parts += [*_arrays(simulator.state).values(), *simulator.model.network.state_dict().values()]
    for part in parts:
        if isinstance(part, torch.Tensor):
            part = part.cpu().numpy()
        if isinstance(part, np.ndarray):
            told.update(np.ascontiguousarray(part).tobytes())
    return told.hexdigest()


def _part(number: int) -> str:
    return f"part_{number:04}.npz"


def _arrays(state: State) -> dict[str, np.ndarray]:
    """Every array of a state, and of who sleeps in it, by name."""
    found: dict[str, np.ndarray] = {"time": np.array(state.time)}
    for prefix, of in (("", state), ("sleep.", state.sleep)):
        for field in fields(of) if of is not None else ():
            value = getattr(of, field.name)
            if isinstance(value, torch.Tensor):
                found[prefix + field.name] = value.cpu().numpy()
    return found


def _state(arrays: dict[str, np.ndarray], device: torch.device) -> State:
    def tensors(kind: type, prefix: str) -> dict[str, torch.Tensor]:
        names = {f.name: prefix + f.name for f in fields(kind) if f.name != "time"}
        return {k: torch.as_tensor(arrays[name], device=device) for k, name in names.items() if name in arrays}

    asleep = tensors(Sleep, "sleep.")
    return State(**tensors(State, ""), sleep=Sleep(**asleep) if asleep else None, time=float(arrays["time"]))
