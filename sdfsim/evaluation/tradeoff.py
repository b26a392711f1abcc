"""How much error for how many milliseconds: sweeps the knobs, and tells the front and the claims."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import sdfsim
from sdfsim.data import metrics
from sdfsim.dynamics.model import bundled_models, load_model
from sdfsim.dynamics.simulator import pick_device
from sdfsim.errors import SdfsimError
from sdfsim.evaluation.tradeoff_cases import Cases, load_cases
from sdfsim.evaluation.tradeoff_contenders import Contender, Ours
from sdfsim.evaluation.tradeoff_engines import Engine
from sdfsim.evaluation.tradeoff_front import front
from sdfsim.evaluation.tradeoff_knobs import Setting, setting_from, settings
from sdfsim.evaluation.tradeoff_measure import Point, measure
from sdfsim.evaluation.tradeoff_picture import draw
from sdfsim.evaluation.tradeoff_report import write_report
from sdfsim.evaluation.tradeoff_told import Rows, beaten_by, table, told
from sdfsim.files import locked, write_json, write_text
from sdfsim.shape.mesh import MESH_SUFFIXES

Progress = Callable[[float, str], None]
FLOOR = Engine("PyBullet", 5, off=1e-3)
QUICK_ENGINES = [FLOOR, Engine("PyBullet", 5), Engine("PyBullet", 1), Engine("MuJoCo", 5)]
ENGINES = [FLOOR, *(Engine("PyBullet", k) for k in (5, 4, 3, 2, 1)), *(Engine("MuJoCo", k) for k in (10, 5, 2))]


@dataclass(frozen=True)
class Sweep:
    """What a study found.

    Attributes:
        points: of all contenders.
        steps: the horizon of the front.
    """

    points: list[Point]
    steps: str

    @property
    def ours(self) -> list[Point]:
        """Our points that can be compared."""
        return [p for p in self.points if p["kind"] == "ours" and not p["failed"] and p["ms"]]

    @property
    def front(self) -> list[Point]:
        """Those of ours that no other of ours beats, by time."""
        return [self.ours[k] for k in front([p["ms"]["median"] for p in self.ours], [*map(self.error, self.ours)])]

    def error(self, point: Point) -> float:
        """Translation RMSE m up to the front's horizon."""
        return point["errors"][self.steps]["translation_rmse"]


def setting_of(point: Point) -> Setting:
    """The setting of a point of ours."""
    return setting_from(point["fingerprint"]["setting"])


def run(
    source: Path, out: Path, *, models: list[str], quick: bool, **rest: Any
) -> tuple[dict[str, Any], Rows, list[str]]:
    """The study that `source` asks for: of fits (meshes), else `tradeoff`.

    Args:
        source: dataset folder, scene file, mesh file or folder of meshes.
        out, models, quick: see `tradeoff`.
        rest: `device` and `on_progress`, as there.

    Returns:
        The report, the rows of a table of it, and lines that follow the table.

    Raises:
        SdfsimError: bad input, or another study that writes to the same folder.
    """
    with locked(out):
        return _run(source, out, models, quick, **rest)


def _run(
    source: Path, out: Path, models: list[str], quick: bool, **rest: Any
) -> tuple[dict[str, Any], Rows, list[str]]:
    tell = rest["on_progress"]
    if meshes := _meshes(source):
        if models or rest["device"] == "cuda":
            raise SdfsimError("--model and --device: fits of meshes are measured on the CPU, without a model")
        from sdfsim.evaluation import tradeoff_fit

        report = tradeoff_fit.fit_tradeoff(meshes, out, quick=quick, on_progress=tell)
        return report, *tradeoff_fit.told(report)
    report = tradeoff(source, out, models=models, quick=quick, **rest)
    return report, *told(report)


def _meshes(source: Path) -> dict[str, Path]:
    """Mesh files by name, in name order; none where `source` is something else."""
    if source.is_file():
        return {source.stem: source} if source.suffix.lower() in MESH_SUFFIXES else {}
    if not source.is_dir():
        raise SdfsimError(f"{source}: no such file or folder", "give a dataset, a scene.yaml or meshes")
    files = [p for p in sorted(source.iterdir()) if p.suffix.lower() in MESH_SUFFIXES]
    names = [p.stem for p in files]
    if twice := {name for name in names if names.count(name) > 1}:
        raise SdfsimError(f"{source}: two meshes are called {min(twice)!r}", "rename one")
    return dict(zip(names, files, strict=True))


def tradeoff(
    source: Path,
    out: Path,
    *,
    models: list[str],
    quick: bool,
    device: str,
    on_progress: Callable[[str, float, str], None],
) -> dict[str, Any]:
    """Sweep the knobs on recorded scenes and write tradeoff.png, tradeoff.csv, tradeoff.json and report.html.

    Args:
        source: dataset folder, or a scene file, which the teacher is then asked about.
        out: folder to write; points that it holds already are kept.
        models: bundled names or paths (none: all that are bundled); the knobs are turned on the first.
        quick: fewer settings on fewer, shorter scenes.
        device: "cpu", "cuda" or "auto"; CUDA is a knob beside the others where it is not "cpu".
        on_progress: called with (stage, fraction, message).

    Returns:
        The content of tradeoff.json.

    Raises:
        SdfsimError: bad input, or nothing of ours could be measured.
    """
    cuda = pick_device(device).type == "cuda"
    names = models or sorted(bundled_models(), key=lambda name: (name != "small", name))
    paper = [name for name in names if load_model(name, weights=False).kind == "paper"]
    cases = _cases(source, names[0], out, quick, lambda f, m: on_progress("scenes", f, m))
    ours: list[Contender] = [Ours(s) for s in settings(names, paper, quick=quick, cuda=cuda)]
    others: list[Contender] = [Ours(Setting(model=names[0]), contact=False), *(QUICK_ENGINES if quick else ENGINES)]
    points = measure([*ours, *others], cases, out / "points", lambda f, m: on_progress("measure", f, m))
    steps = str(min(50, cases.steps))
    sweep = Sweep(points, steps)
    if not sweep.ours:
        raise SdfsimError(f"nothing of ours could be measured: {points[0]['failed']}")
    report = {
        "source": str(source),
        "quick": quick,
        "sdfsim": sdfsim.__version__,
        "trajectories": len(cases.recorded),
        "bodies": cases.bodies,
        "horizon_steps": int(steps),
        "dt_s": cases.recorded[0].dt * cases.time,
        "points": [{k: v for k, v in p.items() if k != "end"} for p in points],
        "front": [p["key"] for p in sweep.front],
        "claims": claims(sweep),
        "folder": str(out),
    }
    write_json(out / "tradeoff.json", report)
    write_text(out / "tradeoff.csv", table(points))
    draw(sweep.points, sweep.front, steps, out / "tradeoff.png")
    write_report(report, beaten_by(report["claims"]), out / "report.html")
    return report


def claims(sweep: Sweep) -> dict[str, Any]:
    """What the study is asked: is the default beaten, how wide is the front, do nodes of a grid replace vertices."""
    by_key = {p["key"]: p for p in sweep.points}
    best = sweep.front
    default = sweep.ours[0]
    beaten = [
        p for p in sweep.ours if sweep.error(p) < sweep.error(default) and p["ms"]["median"] < default["ms"]["median"]
    ]
    found: dict[str, Any] = {
        "default": default["key"],
        "default_beaten_by": [p["key"] for p in beaten],
        "default_clearly_beaten_by": [p["key"] for p in beaten if clearly(p, default, sweep.steps)],
        "slowest_over_fastest_of_front": best[-1]["ms"]["median"] / best[0]["ms"]["median"],
    }
    grid, vertices = (by_key.get(replace(setting_of(default), nodes=n).key) for n in ("grid 7", "vertices"))
    if grid and vertices and not grid["failed"] and not vertices["failed"] and grid["ms"] and vertices["ms"]:
        nodes = [sum(s["nodes"] for s in p["scenes"]) for p in (grid, vertices)]
        found["resampled"] = {
            "fewer_nodes": 1 - nodes[0] / nodes[1],
            "error_over_vertices": sweep.error(grid) / sweep.error(vertices),
            "time_over_vertices": grid["ms"]["median"] / vertices["ms"]["median"],
        }
    return found


def clearly(better: Point, worse: Point, steps: str) -> bool:
    """Whether the difference of two errors is more than the choice of trajectories brings about (95 %, paired)."""
    mine, other = (np.array(p["errors"][steps]["squared_by_trajectory"]) for p in (better, worse))
    return len(mine) > 1 and metrics.interval(other - mine)[0] > 0


def _cases(source: Path, model: str, out: Path, quick: bool, tell: Progress) -> Cases:
    if source.is_file():
        from sdfsim.evaluation.tradeoff_scene import cases_of_scene

        return cases_of_scene(source, model, out / "shapes", quick=quick, on_progress=tell)
    tell(0.0, "reading trajectories and shapes")
    return load_cases(source, out / "shapes", quick=quick)
