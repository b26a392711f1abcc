"""`simulate`: turns a scene file into a run folder, with checkpoints from which a killed run continues."""

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from sdfsim.apps.beside import FILE, begun, beside_of, off
from sdfsim.apps.recording import Playback, save_rollout
from sdfsim.apps.viewer import check_screen, stream_to_viewer
from sdfsim.base.compiling import running, seconds_spent
from sdfsim.base.console import columns, plain
from sdfsim.base.devices import check_device
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import (
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
from sdfsim.base.parallel import Progress, StageProgress, of_stage, silent, silent_stages
from sdfsim.evaluation.instruments import LEAST, PART, judged
from sdfsim.learned.model import SOLVER, load_model
from sdfsim.physics.bodies import State, largest_extent
from sdfsim.physics.rollout import Rollout
from sdfsim.physics.steps import COUNTS, PHASES
from sdfsim.physics.units import EARTH
from sdfsim.scene.bundled import find_scene
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene, fingerprints
from sdfsim.simulate.looks import framed
from sdfsim.simulate.simulator import SimulationError, Simulator, check_seconds, join

Viewer = Literal["none", "file", "native", "web"]
EVERY = 30.0  # s between two checkpoints
SETTLED = 25  # number of steps for which everything has to be at rest
STILL = 0.01  # see `resting`
TOLD = 12  # largest number of bodies for which each gets a line at the end
FAR = 10.0  # times the size of the scene: a body farther away at the end has left the scene
_REPORT = "report.json"
_RESULTS = (_REPORT, "rollout.npz", "rollout.rrd", FILE)
_STATE = "state.npz"
_ANEW = "leave out --resume to start again"
_OTHER = "is of another scene, model or seed"


def simulate(
    scene_file: Path | str,
    out: Path | str,
    *,
    model: str | None = None,
    seconds: float | None = None,
    seed: int | None = None,
    viewer: Viewer = "file",
    device: str = "auto",
    on_progress: StageProgress = silent_stages,
    say: Callable[[str], None] = lambda line: None,
    allow_outside: bool = False,
    until_settled: bool = False,
    resume: bool = False,
    beside: Rollout | None = None,
) -> dict[str, Any]:
    """Simulate a scene file, or a sample by its name, and write config.yaml, report.json, rollout.npz and (unless
    `viewer` is none) rollout.rrd; an earlier run in `out` is replaced. Returns the report. Of the fitted shapes of this
    scene, `failed_checks` names those that are not usable, and `caveats` those that are not exact.

    `model`, `seconds` of simulated time and `seed` are by default (None) those of the scene. `until_settled` ends the
    run as soon as everything is at rest. `resume` continues the interrupted run in `out`, or starts one if there is
    none; a finished run is left as it is, and its report is returned. `beside` is a recorded motion of the scene: the
    run begins where it does, the recording shows both, and the report says how far apart they are. `say` is called with
    lines for the user.

    Raises SdfsimError for invalid input, an output that cannot be written, another run that writes to the same folder,
    or a finished run to resume that is not this one. Raises SimulationError for an invalid state, and
    KeyboardInterrupt; the results until then are in the folder.
    """
    out = Path(out)
    # Check everything that can be wrong before fitting shapes, which takes minutes, and before deleting earlier
    # results.
    check_device(device)
    if seconds is not None:
        check_seconds(seconds)
    if model:
        load_model(model, weights=False)
    check_writable(out)
    check_own(out, "simulate", *_RESULTS)
    check_screen(viewer)
    scene_file = find_scene(scene_file)
    scene = load_scene(scene_file, of_stage(on_progress, "shapes"), allow_outside=allow_outside)
    for note in scene.notes:
        say(note)
    known = fingerprints(scene)
    if beside is not None:
        scene = begun(scene, beside)
    compiled = seconds_spent()
    simulator = Simulator(scene, model=model, device=device, seed=seed)
    length = scene.duration if seconds is None else seconds
    asked = model or scene.model or ""
    config = {
        "command": "simulate",
        "scene": str(scene_file.resolve()),
        "model": str(Path(asked).resolve()) if asked.endswith(".safetensors") else simulator.model.name,
        "seconds": float(length),
        "seed": int(simulator.seed),
        "viewer": viewer,
        "allow_outside": allow_outside,
        "until_settled": until_settled,
        "device": simulator.device,
        **({"beside": beside.meta["recording"]} if beside else {}),
    }
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        kept = Checkpoint(out / "checkpoint", simulator)
        steps = simulator.steps_in(length)
        if resume and (done := finished(out / _REPORT, kept.identity, steps, until_settled=until_settled)):
            kept.clear()  # in case it was killed between its last file and its end
            say(f"{out}: finished already")
            return done
        parts = kept.restore() if resume else []
        if not parts and any((out / name).exists() for name in _RESULTS):
            say(f"replaced the earlier run in {out}")
        for name in _RESULTS:
            (out / name).unlink(missing_ok=True)
        if not parts:
            kept.clear()
            parts = [simulator.initial_rollout()]
            kept.add(parts[0])
        write_text(out / CONFIG, yaml.safe_dump(config, sort_keys=False))
        network = simulator.model.kind != SOLVER
        live = Playback(scene, network=network, beside=beside) if viewer in ("native", "web") else None
        if live:
            if address := stream_to_viewer(live, viewer):
                say(f"watch it at {address}")
            live.log_static()
            live.log_steps(join(parts))

        started, broken = running(), None
        still = [row.all() for row in resting(scene, join(parts))]  # for each frame, whether everything rests

        def settled() -> bool:
            return until_settled and len(still) > SETTLED and all(still[-SETTLED - 1 :])

        at_once = 1 if until_settled else None  # so that the run ends at the step in which everything rests
        try:
            for part in simulator.frames(0 if settled() else steps - simulator.steps_done, at_once):
                parts.append(part)
                kept.add(part)
                if live:
                    live.log_steps(part)
                now = float(part.time[-1])
                on_progress("simulate", now / length, f"{now:.2f} of {length:g} s simulated")
                if until_settled:
                    still += [row.all() for row in resting(scene, part)]
                if settled():
                    break
        except (SimulationError, KeyboardInterrupt) as error:
            broken = error
            if isinstance(error, SimulationError):
                parts.append(error.rollout)
                kept.add(error.rollout)
            kept.save()
        try:
            rollout = join(parts)
            rollout = replace(rollout, meta=rollout.meta | {"scene": known})
            on_progress("simulate", 1.0, f"{len(rollout)} steps" + (" (stopped early)" if broken else ""))

            report = summary(scene, rollout, running() - started) | {
                "compiling_s": round(seconds_spent() - compiled, 3),
                "status": "done" if broken is None else "failed" if isinstance(broken, SdfsimError) else "interrupted",
                "folder": out,
                "identity": kept.identity,
                "failed_checks": [f"fit of shape {reason}" for reason in scene.missed],
                "caveats": [f"fit of shape {reason}" for reason in scene.caveats],
                "notes": list(scene.notes),
            }
            if until_settled:
                report["settled"] = settled()
            if beside is not None:
                report["beside"] = off(scene, rollout, beside)
                beside.save(out / FILE)
            if isinstance(broken, SdfsimError):
                report["error"] = broken.message
            rollout.save(out / "rollout.npz")
            if viewer != "none":
                save_rollout(scene, rollout, out / "rollout.rrd", beside)
                report["recording"] = out / "rollout.rrd"
            report = plain(report)
            write_json(out / _REPORT, report)
        except KeyboardInterrupt:
            kept.save()
            raise
        if not isinstance(broken, KeyboardInterrupt):
            kept.clear()
        if isinstance(broken, SimulationError):
            broken.rollout, broken.hint = rollout, f"results until then are in {out}; {broken.hint}"
        if broken is not None:
            raise broken
        return report


def read_run(
    path: Path, scene_file: Path | None = None, *, allow_outside: bool = False, on_progress: Progress = silent
) -> tuple[Scene, Rollout]:
    """A finished or interrupted run, by its folder or `rollout.npz`, and its scene: the given scene file, or the one
    that the run was made from. Raises SdfsimError if there is no run or no scene, or if the scene is not that of the
    run: a given scene must have the same bodies and shapes; the run's own scene file must not have been edited
    since."""
    file = path / "rollout.npz" if path.is_dir() else path
    rollout = Rollout.load(file)
    compared = ("shapes",) if scene_file is not None else ("shapes", "bodies", "gravity")
    if scene_file is None:
        try:
            scene_file = Path(yaml.safe_load((file.parent / CONFIG).read_text(encoding="utf-8"))["scene"])
        except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError) as error:
            message = f"{file.parent}: not the folder of a simulation ({error})"
            raise SdfsimError(message, "give its scene: --scene") from error
    scene = load_scene(scene_file, on_progress, allow_outside=allow_outside)
    if tuple(body.name for body in scene.bodies) != rollout.names:
        raise SdfsimError(f"{file}: its bodies are not those of {scene.path}", "give its scene: --scene")
    known, now = rollout.meta.get("scene", {}), fingerprints(scene)
    if other := [what for what in compared if known.get(what, now[what]) != now[what]]:
        message = f"{file}: {scene.path} is not the scene that it was made from: other {' and '.join(other)}"
        raise SdfsimError(message, "simulate it again, or give the original scene: --scene")
    return scene, rollout


def recorded(
    place: Path, scene_file: Path | None = None, *, say: Callable[[str], None] = lambda line: None,
    allow_outside: bool = False, on_progress: Progress = silent,
) -> Path:  # fmt: skip
    """What `view` shows: `place` itself, or for a run without a recording (its folder or rollout.npz) a recording that
    is drawn from rollout.npz and written beside it. Raises as `read_run` does."""
    rollout = place / "rollout.npz" if place.is_dir() else place
    if rollout.suffix != ".npz" or not rollout.is_file():
        return place
    recording = rollout.with_suffix(".rrd")
    if not recording.exists() or scene_file is not None:  # a scene that is given may be another
        scene, motion = read_run(place, scene_file, allow_outside=allow_outside, on_progress=on_progress)
        if not recording.exists():
            save_rollout(scene, motion, recording, beside_of(place, scene))
            say(f"wrote {recording}, drawn from {rollout.name}: the run has no recording")
    return recording


def resting(scene: Scene, rollout: Rollout) -> np.ndarray:
    """[T+1, D] bool: which of the D dynamic bodies rest. A body rests if it moves by less than `STILL` of its size in
    the time that it takes to fall that far."""
    rows = _dynamic(scene)
    extents = [largest_extent(shape) for shape in scene.shapes]
    size = np.array([scene.bodies[k].scale * extents[scene.bodies[k].shape] for k in rows])
    speed, spin = (np.linalg.norm(v[:, rows], axis=-1) for v in (rollout.velocity, rollout.angular_velocity))
    strength = float(np.linalg.norm(scene.gravity)) or EARTH
    return speed + 0.5 * size * spin < STILL * np.sqrt(strength * size)


def _dynamic(scene: Scene) -> list[int]:
    return [k for k, body in enumerate(scene.bodies) if body.motion == "dynamic"]


def summary(scene: Scene, rollout: Rollout, wall: float) -> dict[str, Any]:
    """The main numbers of a run. `cost` has every counter and phase of the step; `ended` says where the dynamic bodies
    are at the end, and which of them `left` the scene for good; `broken_laws` are the findings of instruments that do
    not use the contact solve (see `sdfsim.evaluation.instruments`), in a twentieth of the run's time."""
    counters = rollout.counters
    rows, (centre, radius) = _dynamic(scene), framed(scene)
    place, speed = rollout.position[-1, rows], np.linalg.norm(rollout.velocity[-1, rows], axis=-1)
    left = np.linalg.norm(place - centre, axis=-1) > FAR * radius
    endings = zip(rows, place, speed, resting(scene, rollout)[-1], left, strict=True)
    costs = {name: counters[name][1:] for name in (*COUNTS, *PHASES, "step_ms")}
    return {
        "model": rollout.meta["model"],
        "steps": len(rollout),
        "frames": len(rollout.time),
        "dt_s": rollout.meta["dt"],
        "simulated_s": float(rollout.time[-1]),
        "wall_s": round(wall, 3),
        "step_ms_median": float(np.median(counters["step_ms"][1:])) if len(rollout) else None,
        "contacts_mean": float(counters["contacts"].mean()),
        "worst_penetration_m": float(counters["worst_penetration"].max()),
        "kinetic_energy_J": counters["kinetic_energy"][[0, -1]].tolist(),
        **judged(scene, rollout, seconds=max(LEAST, PART * wall)).report(),
        "outside_training": rollout.meta["outside_training"],
        "cost": {name: {"sum": v.sum(), "most": v.max()} for name, v in costs.items() if len(v)},
        "finite": bool(np.isfinite(rollout.position).all() and np.isfinite(rollout.orientation).all()),
        "ended": [
            {"name": scene.bodies[k].name, "centre_m": at, "speed_m_s": fast, "rests": rests, "left": gone}
            for k, at, fast, rests, gone in endings
        ],
        "meta": rollout.meta,
    }


def ending_lines(report: dict[str, Any]) -> list[str]:
    bodies, lines = report["ended"], []
    if 0 < len(bodies) <= TOLD:
        places = ["({:.3f}, {:.3f}, {:.3f}) m".format(*body["centre_m"]) for body in bodies]
        moves = ["at rest" if body["rests"] else f"{body['speed_m_s']:.2g} m/s" for body in bodies]
        lines += columns([(f"  {body['name']}", *rest) for body, *rest in zip(bodies, places, moves, strict=True)])
    moving = [body["name"] for body in bodies if not body["rests"] and not body["left"]]
    left = [body["name"] for body in bodies if body["left"]]
    lines.append(f"{sum(body['rests'] for body in bodies)} of {len(bodies)} bodies rest")
    for what, names in (("move", moving), ("left the scene", left)):
        if names:
            lines.append(f"{what}: {', '.join(names[:3])}" + (f" and {len(names) - 3} more" if len(names) > 3 else ""))
    return lines


def beside_lines(report: dict[str, Any]) -> list[str]:
    """How far a run is from the recorded motion beside which it was simulated; empty if there was none."""
    if not (way := report.get("beside")):
        return []
    far = f"{1e3 * way['position_m']:.3g} mm (root mean square), {way['rotation_degrees']:.3g} degrees (mean)"
    return [f"off {way['recording']} by {far} over {way['seconds']:.3g} s"]


class Checkpoint:
    """The checkpoint of a run in a folder: its `identity`, its frames in parts, and the state after the last part."""

    def __init__(self, folder: Path, simulator: Simulator) -> None:
        self._folder = folder
        self._simulator = simulator
        self.identity = identity(simulator)
        self._fresh: list[tuple[Rollout, State]] = []  # an interruption does not split one
        self._parts = 0
        self._saved = time.monotonic()

    def restore(self) -> list[Rollout]:
        """The frames so far, with the simulator's state set to the last of them; empty if nothing was kept. Raises
        SdfsimError if the checkpoint is of another scene, model or seed, or is damaged."""
        file = self._folder / _STATE
        if not file.exists():
            return []
        kept = read_arrays(file, "a checkpoint", _ANEW)
        try:
            if str(kept["identity"]) != self.identity:
                raise SdfsimError(f"{self._folder}: {_OTHER}", _ANEW)
            self._parts = int(kept["parts"])
            self._simulator.restore(State.of_arrays(kept))
        except (KeyError, TypeError, ValueError) as error:
            raise SdfsimError(f"{file}: not a checkpoint of this version ({error})", _ANEW) from error
        return [Rollout.load(self._part(k)) for k in range(self._parts)]

    def add(self, part: Rollout) -> None:
        """Keep frames and the state after them; write them to disk if the last time is long enough ago."""
        self._fresh.append((part, self._simulator.state))
        if time.monotonic() - self._saved > EVERY:
            self.save()

    def save(self) -> None:
        """Write new parts to disk. The state comes last, so that it never refers to a part that is not there."""
        if self._fresh:
            self._folder.mkdir(exist_ok=True)
            join([frame for frame, _ in self._fresh]).save(self._part(self._parts))
            done = {"identity": self.identity, "parts": self._parts + 1}
            write_arrays(self._folder / _STATE, done | self._fresh[-1][1].arrays(), compressed=False)
            self._fresh = []  # not earlier: after Ctrl-C during this, the next save must write the same part again
            self._parts += 1
        self._saved = time.monotonic()

    def clear(self) -> None:
        """Remove the checkpoint. The state goes first: parts that a killed process leaves are ignored without it."""
        (self._folder / _STATE).unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _part(self, number: int) -> Path:
        return self._folder / f"part_{number:04}.npz"


def finished(report_file: Path, identity: str, steps: int, *, until_settled: bool) -> dict[str, Any] | None:
    """The report of a finished run; None if it was interrupted or does not exist. Raises SdfsimError if it is another
    run, if it has another length (unless it ended `until_settled`), or if it ended at an invalid state."""
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
        done = f"{report['steps']} steps, {report['simulated_s']:.4g} s"
        raise SdfsimError(f"{folder}: finished after {done}; its length cannot be changed", "choose a new -o")
    return report


def identity(simulator: Simulator) -> str:
    """A hash of everything that determines a run: bodies with their paths and distances, start, rules, units, model."""
    s = simulator
    model = (s.model.kind, s.model.reach, s.model.network)
    chosen = {name: value for name, value in vars(s.stepper).items() if isinstance(value, bool | float)}
    return digest(s.dt, s.seed, s.options, type(s.stepper).__name__, chosen, s.units, s.bodies, s.state, model)
