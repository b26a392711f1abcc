"""What the commands simulate, evaluate and info do or tell: a scene file becomes a run folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from sdfsim.dynamics.memory import COUNTS, PHASES
from sdfsim.dynamics.model import Model, load_model
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, Simulator, join, pick_device
from sdfsim.errors import SdfsimError
from sdfsim.files import check_writable, write_json, write_text
from sdfsim.learning import tables
from sdfsim.playback import Playback, save_rollout
from sdfsim.progress import columns
from sdfsim.scene.load import load_scene
from sdfsim.scene.types import Scene

Viewer = Literal["none", "file", "native", "web"]
Progress = Callable[[str, float, str], None]  # stage, fraction of it that is done, message
_PACKAGES = (
    "torch",
    "numpy",
    "scipy",
    "open3d",
    "trimesh",
    "pycolmap",
    "opencv-python-headless",
    "rerun-sdk",
    "pybullet",
)
_RESULTS = ("report.json", "rollout.npz", "rollout.rrd")


def simulate(
    scene_file: Path,
    out: Path,
    *,
    model: str | None,
    seconds: float | None,
    seed: int | None,
    viewer: Viewer,
    device: str,
    on_progress: Progress,
    on_address: Callable[[str], None],
) -> dict[str, Any]:
    """Simulate a scene and write config.yaml, report.json, rollout.npz and (unless `viewer` is none) rollout.rrd.

    Args:
        scene_file: scene.yaml.
        out: run folder; made if missing, an earlier run in it is replaced.
        model: bundled name or path (None: what the scene says).
        seconds: simulated time in s (None: the scene's duration).
        seed: None: the scene's.
        viewer: where to watch: not at all, later from the file, or live in a window or a page.
        device: cpu, cuda or auto.
        on_progress: called with (stage, fraction, message).
        on_address: called with the address of the page that `viewer` web serves.

    Returns:
        The content of report.json; `failed_checks` names the shapes that were fitted for this scene and missed their
        certificate.

    Raises:
        SdfsimError: bad input, or an output that cannot be written.
        SimulationError: the state broke; what was computed before is in the folder.
        KeyboardInterrupt: likewise.
    """
    # Everything that can be wrong from the start, before shapes are fitted for minutes or earlier results are deleted.
    pick_device(device)
    if model:
        load_model(model, weights=False)
    check_writable(out)
    if viewer in ("native", "web"):
        from sdfsim.viewer import check_screen

        check_screen(viewer)
    scene = _load(scene_file, on_progress)
    simulator = Simulator(scene, model=model, device=device, seed=seed)
    frames = [simulator.initial_rollout()]
    live = _live(scene, viewer, frames[0], on_address)
    length = scene.duration if seconds is None else seconds
    config = {
        "command": "simulate",
        "scene": str(scene_file.resolve()),
        "model": _repeatable(model or scene.model, simulator.model),
        "seconds": float(length),
        "seed": int(simulator.seed),
        "viewer": viewer,
        "device": str(simulator.device),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name in _RESULTS:
        (out / name).unlink(missing_ok=True)
    write_text(out / "config.yaml", yaml.safe_dump(config, sort_keys=False))

    def on_step(frame: Rollout) -> None:
        frames.append(frame)
        if live:
            live.log_steps(frame)
        on_progress("simulate", float(frame.time[-1]) / length, f"{frame.time[-1]:.2f} of {length:g} s simulated")

    started, broken = time.monotonic(), None
    try:
        rollout = simulator.run(seconds=length, on_step=on_step)
    except (SimulationError, KeyboardInterrupt) as error:
        broken = error
        rollout = error.rollout if isinstance(error, SimulationError) else join(frames)
    on_progress("simulate", 1.0, f"{len(rollout)} steps" + (" (stopped early)" if broken else ""))

    report = summary(rollout, time.monotonic() - started)
    report["status"] = "done" if broken is None else "failed" if isinstance(broken, SdfsimError) else "interrupted"
    report["folder"] = str(out)
    report["failed_checks"] = _missed(scene)
    if isinstance(broken, SdfsimError):
        report["error"] = broken.message
    rollout.save(out / "rollout.npz")
    if viewer != "none":
        save_rollout(scene, rollout, out / "rollout.rrd")
        report["recording"] = str(out / "rollout.rrd")
    write_json(out / "report.json", report)
    if isinstance(broken, SimulationError):
        broken.hint = f"what was computed is in {out}; {broken.hint}"
    if broken is not None:
        raise broken
    return report


def _load(scene_file: Path, on_progress: Progress) -> Scene:
    return load_scene(scene_file, on_progress=lambda fraction, message: on_progress("shapes", fraction, message))


def _missed(scene: Scene) -> list[str]:
    return [f"fit of shape {told}" for told in scene.missed]


def _repeatable(asked: str | None, model: Model) -> str:
    """The model as it can be asked for again, from whatever folder."""
    return str(Path(asked).resolve()) if asked and asked.endswith(".safetensors") else model.name


def _live(scene: Any, viewer: Viewer, first: Rollout, on_address: Callable[[str], None]) -> Playback | None:
    if viewer not in ("native", "web"):
        return None
    from sdfsim.viewer import stream_to_viewer

    live = Playback(scene)
    if address := stream_to_viewer(live, viewer):
        on_address(address)
    live.log_static()
    live.log_steps(first)
    return live


def summary(rollout: Rollout, wall: float) -> dict[str, Any]:
    """The numbers of a run that a person looks at first; None for one that is not finite."""
    counters, heights = rollout.counters, rollout.position[..., 2]
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
        "lowest_m": _number(heights.min()) if heights.size else None,
        "outside_training": rollout.meta.get("outside_training", []),
        "cost": cost(rollout),
        "finite": bool(np.isfinite(rollout.position).all() and np.isfinite(rollout.orientation).all()),
        "meta": rollout.meta,
    }


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


def evaluation_lines(report: dict[str, Any]) -> list[str]:
    """`evaluate`'s report for people: errors at every horizon, then the quality of the motion."""
    names = {"name": report["model_name"], "ballistic": "ballistic"}
    return [
        "Translation RMSE and mean rotation error up to each horizon (95 % intervals over trajectories)",
        *columns(tables.error_rows(report, **names)),
        "",
        *columns(tables.quality_rows(report, **names)),
        "",
        *tables.notes(report),
        f"{report['trajectories']} trajectories, {report['bodies']} bodies, "
        f"{report['ms_per_step_per_trajectory']:.2f} ms per step and trajectory",
    ]


def environment() -> dict[str, Any]:
    """Versions, devices and bundled models."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    import torch

    import sdfsim
    from sdfsim.dynamics.model import bundled_models

    versions = {"sdfsim": sdfsim.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "missing"
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {
        "versions": versions,
        "devices": ["cpu", *(f"cuda:{i} {name}" for i, name in enumerate(gpus))],
        "cpu_threads": torch.get_num_threads(),
        "models": bundled_models(),
    }
