"""`simulate`: a scene file becomes a run folder; and what is kept there so that a killed run goes on."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml

from sdfsim.console import columns
from sdfsim.dynamics.bodies import State, Touch, largest_extent
from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.rest import Rest
from sdfsim.dynamics.rollout import Rollout, energy_from_nothing
from sdfsim.dynamics.run_memory import COUNTS, PHASES
from sdfsim.dynamics.simulator import SimulationError, Simulator, check_seconds, join, pick_device
from sdfsim.dynamics.units import EARTH
from sdfsim.errors import SdfsimError
from sdfsim.files import (
    CONFIG,
    check_own,
    check_writable,
    digest,
    locked,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
    write_text,
)
from sdfsim.parallel import Progress, StageProgress, silent
from sdfsim.recording import Place, Playback, eye_of, framed, save_rollout
from sdfsim.scene.scene import Scene
from sdfsim.scene.scene_file import load_scene

Viewer = Literal["none", "file", "native", "web"]
CHECKPOINT = "checkpoint"  # folder in that of the run
EVERY = 30.0  # s between two checkpoints
TOLD = 12  # bodies that are told of one by one at the end
STILL = 0.01  # see `ended`
FAR = 10.0  # times the size of the scene: who is farther away in the end has left it
ODD = 0.01  # energy from nothing in a step, as a part of what is in play, that is told
_REPORT = "report.json"
_RESULTS = (_REPORT, "rollout.npz", "rollout.rrd")
_STATE = "state.npz"
_ANEW = "leave --resume away to start anew"
_OTHER = "is of another scene, model or seed"


def simulate(
    scene_file: Path,
    out: Path,
    *,
    model: str | None,
    seconds: float | None,
    seed: int | None,
    viewer: Viewer,
    device: str,
    on_progress: StageProgress,
    say: Callable[[str], None],
    bind: str = "127.0.0.1",
    allow_outside: bool = False,
    until_settled: bool = False,
    resume: bool = False,
    camera: Place | None = None,
    look_at: Place | None = None,
) -> dict[str, Any]:
    """Simulate a scene and write config.yaml, report.json, rollout.npz and (unless `viewer` is none) rollout.rrd; an
    earlier run in `out` is replaced. Returns the report; of the shapes that were fitted for this scene, `failed_checks`
    names those that are not usable, and `caveats` those that are not exact.

    What is None is as the scene says: model, `seconds` of simulated time, seed; and the first view of the recording,
    from `camera` [3] m to `look_at` [3] m, has all of the motion in sight. `until_settled` ends the run as soon as
    everything rests. `resume` goes on with the run in `out` that was interrupted, from the start where there is none; a
    finished one is left as it is, and its report is returned. `say` is called with lines for the person; live viewers
    listen on `bind`.

    Raises SdfsimError for bad input, an output that cannot be written, another run that writes to the same folder, or a
    finished run to resume that is another one than this; SimulationError where the state broke, and KeyboardInterrupt:
    what was computed before is in the folder.
    """
    # Everything that can be wrong from the start, before shapes are fitted for minutes or earlier results are deleted.
    pick_device(device)
    if seconds is not None:
        check_seconds(seconds)
    if model:
        load_model(model, weights=False)
    check_writable(out)
    check_own(out, "simulate", *_RESULTS)
    if viewer in ("native", "web"):
        from sdfsim.viewer import check_screen

        check_screen(viewer)
    scene = load_scene(scene_file, partial(on_progress, "shapes"), allow_outside=allow_outside)
    eye_of(scene, None, camera, look_at)
    simulator = Simulator(scene, model=model, device=device, seed=seed)
    length = scene.duration if seconds is None else seconds
    config = {
        "command": "simulate",
        "scene": str(scene_file.resolve()),
        "model": _repeatable(model or scene.model, simulator.model),
        "seconds": float(length),
        "seed": int(simulator.seed),
        "viewer": viewer,
        "allow_outside": allow_outside,
        "until_settled": until_settled,
        "device": str(simulator.device),
    }
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        kept = Checkpoint(out, simulator)
        steps = simulator.steps_in(length)
        if resume and (done := finished(out / _REPORT, kept.identity, steps, until_settled=until_settled)):
            kept.clear()  # where it was killed between its last file and its end
            say(f"{out}: finished already")
            return done
        frames = kept.restore() if resume else []
        if not frames and any((out / name).exists() for name in (*_RESULTS, CHECKPOINT)):
            say(f"replaced the earlier run in {out}")
        for name in _RESULTS:
            (out / name).unlink(missing_ok=True)
        if not frames:
            kept.clear()
            frames = [simulator.initial_rollout()]
            kept.add(frames[0])
        write_text(out / CONFIG, yaml.safe_dump(config, sort_keys=False))
        live = _live(Playback(scene, None, camera, look_at), viewer, join(frames), say, bind)

        started, broken = time.monotonic(), None
        settled = until_settled and kept.rest.settled  # already, where it was killed between its last step and the end
        left = 0 if settled else steps - simulator.steps_done
        try:
            for frame in simulator.frames(left):
                frames.append(frame)
                kept.add(frame)
                if live:
                    live.log_steps(frame)
                now = float(frame.time[-1])
                on_progress("simulate", now / length, f"{now:.2f} of {length:g} s simulated")
                if settled := until_settled and kept.rest.settled:
                    break
        except (SimulationError, KeyboardInterrupt) as error:
            broken = error
            kept.save()
        rollout = join(frames)
        on_progress("simulate", 1.0, f"{len(rollout)} steps" + (" (stopped early)" if broken else ""))

        report = summary(rollout, time.monotonic() - started)
        report["ended"] = ended(scene, rollout)
        report["status"] = "done" if broken is None else "failed" if isinstance(broken, SdfsimError) else "interrupted"
        report["folder"] = str(out)
        report["identity"] = kept.identity
        report["failed_checks"] = [f"fit of shape {told}" for told in scene.missed]
        report["caveats"] = [f"fit of shape {told}" for told in scene.caveats]
        if until_settled:
            report["settled"] = settled
        if isinstance(broken, SdfsimError):
            report["error"] = broken.message
        rollout.save(out / "rollout.npz")
        if viewer != "none":
            save_rollout(scene, rollout, out / "rollout.rrd", camera, look_at)
            report["recording"] = str(out / "rollout.rrd")
        write_json(out / _REPORT, report)
        if not isinstance(broken, KeyboardInterrupt):
            kept.clear()
        if isinstance(broken, SimulationError):
            broken.rollout, broken.hint = rollout, f"what was computed is in {out}; {broken.hint}"
        if broken is not None:
            raise broken
        return report


def _repeatable(asked: str | None, model: Model) -> str:
    """The model as it can be asked for again, from whatever folder."""
    return str(Path(asked).resolve()) if asked and asked.endswith(".safetensors") else model.name


def _live(live: Playback, viewer: Viewer, first: Rollout, say: Callable[[str], None], bind: str) -> Playback | None:
    if viewer not in ("native", "web"):
        return None
    from sdfsim.viewer import stream_to_viewer

    if address := stream_to_viewer(live, viewer, bind=bind):
        say(f"watch it at {address}")
    live.log_static()
    live.log_steps(first)
    return live


def read_run(
    path: Path, scene_file: Path | None = None, *, allow_outside: bool = False, on_progress: Progress = silent
) -> tuple[Scene, Rollout]:
    """A finished or interrupted run, by its folder or `rollout.npz`, and its scene: a scene file, or that the run was
    made from. Raises SdfsimError for no run, no scene, or another scene than that of the run."""
    file = path / "rollout.npz" if path.is_dir() else path
    rollout = Rollout.load(file)
    scene = load_scene(scene_file or scene_of(file.parent), on_progress, allow_outside=allow_outside)
    if tuple(body.name for body in scene.bodies) != rollout.names:
        raise SdfsimError(f"{file}: its bodies are not those of {scene.path}", "give its scene: --scene")
    return scene, rollout


def scene_of(folder: Path) -> Path:
    """The scene file of a run folder. Raises SdfsimError where there is none."""
    try:
        config = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        return Path(config["scene"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise SdfsimError(f"{folder}: not the folder of a simulation ({error})", "give its scene: --scene") from error


def summary(rollout: Rollout, wall: float) -> dict[str, Any]:
    """The numbers of a run that a person looks at first; None for one that is not finite."""
    counters = rollout.counters
    energy = counters["kinetic_energy"]
    taken = counters["step_ms"][1:]
    return {
        "model": rollout.meta.get("model"),
        "steps": len(rollout),
        "dt_s": _number(rollout.meta["dt"]),
        "simulated_s": _number(rollout.time[-1]),
        "wall_s": round(wall, 3),
        "step_ms_median": _number(np.median(taken)) if len(taken) else None,
        "contacts_mean": _number(counters["contacts"].mean()),
        "worst_penetration_m": _number(counters["worst_penetration"].max()),
        "kinetic_energy_J": [_number(energy[0]), _number(energy[-1])],
        "energy_from_nothing": energy_from_nothing(rollout),
        "outside_training": rollout.meta.get("outside_training", []),
        "cost": cost(rollout),
        "finite": bool(np.isfinite(rollout.position).all() and np.isfinite(rollout.orientation).all()),
        "meta": rollout.meta,
    }


def ended(scene: Scene, rollout: Rollout) -> dict[str, Any]:
    """Where the bodies that move by themselves are in the end.

    `bodies`: of the first `TOLD` the name, the place of the centre of mass in m, the speed in m/s and whether they
    rest, as `rest` do: they move by less than `STILL` of their size in the time that they take to fall that far.
    `moving`: names of those that do not, the fastest first; `left`: of those that have left the scene for good.
    `driven`: whether bodies on paths do work.
    """
    rows = [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]
    sizes = [scene.bodies[k].scale * largest_extent(scene.shapes[scene.bodies[k].shape]) for k in rows]
    place, velocity, spin = (getattr(rollout, name)[-1, rows] for name in ("position", "velocity", "angular_velocity"))
    size, speed = np.array(sizes), np.linalg.norm(velocity, axis=-1)
    strength = float(np.linalg.norm(scene.gravity)) or EARTH
    rests = speed + 0.5 * size * np.linalg.norm(spin, axis=-1) < STILL * np.sqrt(strength * size)
    centre, radius = framed(scene)
    left = np.linalg.norm(place - centre, axis=-1) > FAR * radius
    names = np.array([scene.bodies[k].name for k in rows], dtype=str)
    faster = np.argsort(-speed, kind="stable")
    return {
        "bodies": [
            {
                "name": str(names[k]),
                "centre_m": place[k].tolist(),
                "speed_m_s": _number(speed[k]),
                "rests": bool(rests[k]),
            }
            for k in range(min(len(rows), TOLD))
        ],
        "count": len(rows),
        "rest": int(rests.sum()),
        "moving": [str(names[k]) for k in faster if not rests[k] and not left[k]],
        "left": [str(names[k]) for k in faster if left[k]],
        "driven": any(body.motion == "kinematic" for body in scene.bodies),
    }


def ending_lines(report: dict[str, Any]) -> list[str]:
    """Where bodies ended, which rest, and what was odd."""
    end, lines = report["ended"], []
    if end["count"] == len(end["bodies"]):
        rows = []
        for body in end["bodies"]:
            place = ", ".join(f"{x:.3f}" for x in body["centre_m"])
            how = "left the scene" if body["name"] in end["left"] else f"{body['speed_m_s'] or 0.0:.2g} m/s"
            rows.append((f"  {body['name']}", f"({place}) m", "at rest" if body["rests"] else how))
        lines += columns(rows) if rows else []
    moving = end["count"] - end["rest"]
    fastest = f", the fastest {', '.join(end['moving'][:3])}" if moving and end["moving"] else ""
    lines.append(f"{end['rest']} of {end['count']} bodies rest" + (f"; {moving} move{fastest}" if moving else ""))
    if end["left"]:
        many = f" and {len(end['left']) - 3} more" if len(end["left"]) > 3 else ""
        lines.append(f"left the scene: {', '.join(end['left'][:3])}{many}")
    made = report["energy_from_nothing"]
    if made["worst"] > ODD and not end["driven"]:  # what is on a path does work
        part = f"{100 * made['steps_above_1_percent']:.1f} % of the steps made more than 1 % of what was in play"
        lines.append(f"energy from nothing: {made['sum_J']:.3g} J; {part}, the worst {100 * made['worst']:.2g} %")
    return lines


def cost(rollout: Rollout) -> dict[str, dict[str, Any]]:
    """Sum and largest value over the steps of everything that was counted or timed."""
    counted = {name: rollout.counters[name][1:] for name in (*COUNTS, *PHASES, "step_ms") if name in rollout.counters}
    return {
        name: {"sum": _number(v.sum()), "mean": _number(v.mean()), "most": _number(v.max())}
        for name, v in counted.items()
        if len(v)
    }


def cost_lines(report: dict[str, Any]) -> list[str]:
    """What a run has cost, as one table: a row for each counter and each phase of the step."""
    told = {**COUNTS, **{name: f"{what}, ms" for name, what in PHASES.items()}, "step_ms": "whole step, ms"}
    rows = [("", "a step", "most", "together")]
    for name, values in report["cost"].items():
        mean, most, total = (f"{values[k]:,.1f}" for k in ("mean", "most", "sum"))
        rows.append((told[name], mean, most, total))
    return columns(rows)


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


class Checkpoint:
    """What is kept of one run: its `identity`, its frames in parts, the state that the last part leads to, and for how
    long everything has rested (`rest`)."""

    def __init__(self, folder: Path, simulator: Simulator) -> None:
        self._folder = folder / CHECKPOINT
        self._simulator = simulator
        self.identity = identity(simulator)
        self.rest = Rest()
        self._fresh: list[tuple[Rollout, State, int, Rest]] = []  # one entry a step: an interruption splits none
        self._parts = 0
        self._saved = time.monotonic()

    def restore(self) -> list[Rollout]:
        """The frames so far, the simulator's state brought to the last of them; none where nothing was kept. Raises
        SdfsimError where that is of another scene, model or seed, or damaged."""
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
            self.rest = Rest(kept["rest.anchor"], int(kept["rest.quiet"]))
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
    """The report of a run that is finished; None where it was interrupted or is not there. Raises SdfsimError where it
    is another run, of another length (unless it ended `until_settled`), or its state broke."""
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
    s = simulator
    model = (s.model.kind, s.model.reach, s.model.network)
    return digest(s.dt, s.seed, replace(s.rules, rows=None), s.units, s.bodies, s.state, model)


def _part(number: int) -> str:
    return f"part_{number:04}.npz"


def _arrays(state: State, rest: Rest) -> dict[str, np.ndarray]:
    """Every array of a state, of who sleeps in it and of how long all has rested, by name."""
    found = {"time": np.array(state.time), "rest.quiet": np.array(rest.quiet)}
    for prefix, of in (("", state), ("touch.", state.touch), ("rest.", rest)):
        for field in fields(of) if of is not None else ():
            value = getattr(of, field.name)
            if isinstance(value, torch.Tensor | np.ndarray):
                found[prefix + field.name] = np.asarray(value.cpu() if isinstance(value, torch.Tensor) else value)
    return found


def _state(arrays: dict[str, np.ndarray], device: torch.device) -> State:
    def tensors(kind: type, prefix: str) -> dict[str, torch.Tensor]:
        names = {f.name: prefix + f.name for f in fields(kind) if f.name != "time"}
        return {k: torch.as_tensor(arrays[name], device=device) for k, name in names.items() if name in arrays}

    touch = tensors(Touch, "touch.")
    return State(**tensors(State, ""), touch=Touch(**touch) if touch else None, time=float(arrays["time"]))
