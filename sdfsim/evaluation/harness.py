"""Tools that all studies share: results of cases x methods kept as files, tables, plots, peak memory.

A study makes a `Job` for each case and method. `measure` runs those without a result in its folder and writes one JSON
file for each, so that an interrupted study continues where it stopped.
"""

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

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import digest, read_json, replacing, write_json
from sdfsim.base.lazy import pyplot
from sdfsim.base.parallel import Progress, parallel, silent
from sdfsim.base.version import __version__

Results = dict[tuple[str, str], dict[str, Any]]
FAILURES = (SdfsimError, RuntimeError, MemoryError)


@dataclass(frozen=True)
class Job:
    """One case with one method; both names are valid for files."""

    case: str
    method: str
    content: Any  # everything on which the result depends; see `digest`
    function: Callable[..., dict[str, Any]]  # computes the result, which JSON can hold
    arguments: tuple = ()


def measure(
    jobs: Sequence[Job],
    folder: Path,
    *,
    where: Literal["here", "cores", "fresh"] = "here",
    on_progress: Progress = silent,
) -> Results:
    """The results of all jobs by (case, method): those kept in FOLDER/METHOD/CASE.json if their content and the
    compiled contact step are unchanged, else new ones.

    A job that fails gives {"failed": reason}. That is not kept, because an engine or memory may be available the next
    time.

    Args:
        where: "here": one after the other in this process; "cores": on all cores, in the order of `jobs`; "fresh": each
            in its own process, whose peak memory is then the job's.
    """
    from sdfsim.physics.solver.code_cache import code_folder  # numba is slow to load

    todo: list[tuple[Job, Path, str]] = []
    version = [__version__, code_folder().name]  # the name is a hash of the compiled step's source
    results: Results = {}
    for job in jobs:
        file, mark = folder / job.method / f"{job.case}.json", digest(job.content, version)
        results[job.case, job.method] = kept = _kept(file, mark)
        if not kept:
            todo.append((job, file, mark))
    for done, (index, result) in enumerate(_ended(todo, where), 1):
        job = todo[index][0]
        results[job.case, job.method] = result
        on_progress(done / len(todo), f"{job.case} with {job.method}")
    on_progress(1.0, f"{len(todo)} results measured, {len(jobs) - len(todo)} kept from before")
    return results


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
    return read_json(file)["result"]  # as read from JSON, whether new or kept


def _kept(file: Path, mark: str) -> dict[str, Any]:
    """The result in a file; empty if its content does not match."""
    try:
        content = read_json(file)
    except SdfsimError:
        return {}
    return content["result"] if content["digest"] == mark else {}


def machine() -> str:
    """What timings depend on besides the code: the machine's name and the number of torch's threads."""
    return f"{platform.node()}, {torch.get_num_threads()} threads"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; the first row is the header, numbers are aligned right."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    rule = "| --- |" + " ---: |" * (len(rows[0]) - 1)
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits; a dash if it is unknown."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def front(time: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the Pareto front, by time: no other point is at least as good in time and error, and better in one."""
    kept: list[int] = []
    for k in sorted(range(len(time)), key=lambda k: (time[k], error[k])):
        if not kept or error[k] < error[kept[-1]] or (time[k], error[k]) == (time[kept[-1]], error[kept[-1]]):
            kept.append(k)
    return kept


@dataclass(frozen=True)
class Line:
    name: str  # lines with the same name have the same colour in all panels
    x: Sequence[float]  # [K]
    y: Sequence[float]  # [K]
    noise: Sequence[float] | None = None  # [K], half-widths of error bars


@dataclass(frozen=True)
class Panel:
    title: str
    x: str
    y: str
    lines: Sequence[Line]
    log: str = ""  # logarithmic axes: "", "x", "y" or "xy"
    limit: float | None = None  # y of a dotted line: the wanted limit


def draw(panels: Sequence[Panel], path: Path, *, size: tuple[float, float] = (3.3, 2.5)) -> None:
    """Write panels of `size` inches in a row as a PNG. Raises NotInstalled."""
    across, up = size
    plots = pyplot()
    figure, axes = plots.subplots(1, len(panels), figsize=(across * len(panels), up), layout="constrained")
    names = list(dict.fromkeys(line.name for panel in panels for line in panel.lines))
    for axis, panel in zip(np.atleast_1d(axes), panels, strict=True):
        for line in panel.lines:
            marker, at = ("o-" if len(line.x) <= 12 else "-"), names.index(line.name)
            style = {"label": line.name, "color": f"C{at}", "markersize": 3 + at // 10, "linewidth": 1.2}
            axis.errorbar(line.x, line.y, yerr=line.noise, fmt=marker, capsize=2, **style)
        for letter in panel.log:
            getattr(axis, f"set_{letter}scale")("log")
            getattr(axis, f"{letter}axis").set_minor_formatter(plots.matplotlib.ticker.LogFormatter())
        if panel.limit:
            axis.axhline(panel.limit, color="tab:red", linewidth=0.8, linestyle=":")
        axis.set_title(panel.title, fontsize=8)
        axis.set_xlabel(panel.x, fontsize=8)
        axis.set_ylabel(panel.y, fontsize=8)
        axis.tick_params(which="both", labelsize=7)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=6, **({"bbox_to_anchor": (1, 1), "loc": "upper left"} if len(panel.lines) > 8 else {}))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=100, format="png")
    plots.close(figure)


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside the block torch and the compiled step use one thread, so that times are processor times."""
    import numba

    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


@contextmanager
def peak_memory() -> Iterator[dict[str, float | None]]:
    """Sets "mib" to the largest growth of the process inside the block; None if Linux does not report it."""
    peak: dict[str, float | None] = {"mib": None}
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # resets the peak
        before = _status("VmRSS")
    except OSError:
        yield peak
        return
    yield peak
    peak["mib"] = max(0.0, _status("VmHWM") - before) / 1024


def _status(name: str) -> float:
    """kB of an entry of /proc/self/status."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
