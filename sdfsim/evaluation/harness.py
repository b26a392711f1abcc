"""What all studies share: results of cases x methods kept as files, tables, plots, peak memory.

A study makes a `Job` for each case and method. `measure` runs those whose result its folder does not hold yet, each
into one JSON file, so that an interrupted study goes on where it was.
"""

from __future__ import annotations

import multiprocessing
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

import sdfsim
from sdfsim.errors import SdfsimError
from sdfsim.files import digest, read_json, replacing, write_json
from sdfsim.parallel import Progress, parallel, silent

Results = dict[tuple[str, str], dict[str, Any]]
FAILURES = (SdfsimError, RuntimeError, MemoryError)


@dataclass(frozen=True)
class Job:
    """One case with one method, names fit for a file.

    Attributes:
        content: all that the result depends on; see `digest`.
        function: called with `arguments`; makes the result, which JSON can hold.
        weight: about how long it takes, in no unit.
    """

    case: str
    method: str
    content: Any
    function: Callable[..., dict[str, Any]]
    arguments: tuple = ()
    weight: float = 1.0


def measure(
    jobs: Sequence[Job],
    folder: Path,
    *,
    where: Literal["here", "cores", "fresh"] = "here",
    on_progress: Progress = silent,
) -> Results:
    """The results of all jobs by (case, method): kept ones where they still hold, new ones elsewhere.

    A job that fails gives {"failed": why}. That is not kept, because an engine or memory may be there the next time.

    Args:
        jobs: what there is to run.
        folder: holds METHOD/CASE.json.
        where: "here", one after the other in this process; "cores", on all of them, the longest first; "fresh", each in
            a process of its own, whose peak memory is then the job's.
    """
    files = [folder / job.method / f"{job.case}.json" for job in jobs]
    marks = [digest(job.content, sdfsim.__version__) for job in jobs]
    results = {}
    todo: list[tuple[Job, Path, str]] = []
    for job, file, mark in zip(jobs, files, marks, strict=True):
        kept = _kept(file, mark)
        if kept is None:
            todo.append((job, file, mark))
        else:
            results[job.case, job.method] = kept
    if where == "cores":
        todo.sort(key=lambda one: -one[0].weight)
    total, done = sum(job.weight for job, _, _ in todo), 0.0
    for index, result in _ended(todo, where):
        job = todo[index][0]
        results[job.case, job.method] = result
        done += job.weight
        on_progress(done / total, f"{job.case} with {job.method}")
    on_progress(1.0, f"{len(todo)} results measured, {len(jobs) - len(todo)} kept from before")
    return {(job.case, job.method): results[job.case, job.method] for job in jobs}


def _ended(todo: list[tuple[Job, Path, str]], where: str) -> Iterator[tuple[int, dict]]:
    if where == "cores":
        yield from parallel(_run, todo)
        return
    for index, one in enumerate(todo):
        if where == "here":
            yield index, _run(*one)
            continue
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            yield index, pool.submit(_run, *one).result()


def _run(job: Job, file: Path, mark: str) -> dict[str, Any]:
    try:
        result = job.function(*job.arguments)
    except FAILURES as error:
        return {"failed": (str(error).strip() or type(error).__name__).splitlines()[0]}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {"digest": mark, "result": result})
    return read_json(file)["result"]  # as JSON has it, whether new or kept


def _kept(file: Path, mark: str) -> dict[str, Any] | None:
    if not file.exists():
        return None
    try:
        content = read_json(file)
        return content["result"] if content["digest"] == mark else None
    except (SdfsimError, KeyError, TypeError):
        return None


def machine() -> str:
    """What timings depend on besides the code: the machine's name and the number of torch's threads."""
    return f"{platform.node()}, {torch.get_num_threads()} threads"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; the first row is its head, numbers stand to the right."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    rule = "| --- |" + " ---: |" * (len(rows[0]) - 1)
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def number(value: float | None, digits: int = 3) -> str:
    """So many significant digits; a dash for what is not known."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def front(time: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices, by time, of points that no other beats: none is at most as slow and as wrong, and one of both less."""
    kept: list[int] = []
    for k in sorted(range(len(time)), key=lambda k: (time[k], error[k])):
        if not kept or error[k] < error[kept[-1]] or (time[k], error[k]) == (time[kept[-1]], error[kept[-1]]):
            kept.append(k)
    return kept


@dataclass(frozen=True)
class Line:
    """One line of a panel: name, x [K], y [K], and where they are known the half-widths [K] of its error bars."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    noise: Sequence[float] | None = None


@dataclass(frozen=True)
class Panel:
    """One plot of several. Lines of one name have one colour in all panels.

    Attributes:
        log: of its axes: "", "x", "y" or "xy".
        limit: y of a dotted line: what is wanted.
    """

    title: str
    x: str
    y: str
    lines: Sequence[Line]
    log: str = ""
    limit: float | None = None


def draw(
    panels: Sequence[Panel], path: Path, *, wide: int = 4, dpi: int = 80, size: tuple[float, float] = (3.3, 2.5),
    key: Literal["inside", "outside"] = "inside",
) -> None:  # fmt: skip
    """Write panels of `size` inches, `wide` in a row, as a PNG. Raises SdfsimError when matplotlib is not installed."""
    pyplot = check_matplotlib()
    high, wide = -(-len(panels) // wide), min(wide, len(panels))
    across, up = size
    figure, axes = pyplot.subplots(high, wide, figsize=(across * wide, up * high), squeeze=False, layout="constrained")
    names = list(dict.fromkeys(line.name for panel in panels for line in panel.lines))
    for axis, panel in zip(axes.flat, panels, strict=False):
        for line in panel.lines:
            marker, at = ("o-" if len(line.x) <= 12 else "-"), names.index(line.name)
            style = {"label": line.name, "color": f"C{at}", "markersize": 3 + at // 10, "linewidth": 1.2}
            axis.errorbar(line.x, line.y, yerr=line.noise, fmt=marker, capsize=2, **style)
        for letter in panel.log:
            getattr(axis, f"set_{letter}scale")("log")
        if panel.limit:
            axis.axhline(panel.limit, color="tab:red", linewidth=0.8, linestyle=":")
        axis.set_title(panel.title, fontsize=8)
        axis.set_xlabel(panel.x, fontsize=8)
        axis.set_ylabel(panel.y, fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=6, **({"bbox_to_anchor": (1.0, 1.0), "loc": "upper left"} if key == "outside" else {}))
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=dpi, format="png")
    pyplot.close(figure)


def check_matplotlib() -> Any:
    """matplotlib's pyplot, drawing into files. Raises SdfsimError when it is not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise SdfsimError("the plots need matplotlib", "pip install 'sdfsim[bench]'") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


@contextmanager
def one_thread() -> Iterator[None]:
    """torch computes in one thread inside the block, whose time is then the processor's."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def peak_memory() -> Iterator[dict[str, float | None]]:
    """Puts under "mib" by how much the process grew inside the block at most; None where Linux does not tell."""
    told: dict[str, float | None] = {"mib": None}
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        before = _status("VmRSS")
    except OSError:
        yield told
        return
    yield told
    told["mib"] = max(0.0, _status("VmHWM") - before) / 1024


def _status(name: str) -> float:
    """kB of an entry of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
