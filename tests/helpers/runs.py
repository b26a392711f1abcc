"""Runs that are interrupted, and recordings that are read back."""

from pathlib import Path

import numpy as np

from sdfsim import State
from sdfsim.apps import run


def read(path: Path) -> dict[str, dict[str, list]]:
    """Entity -> column -> rows of all its chunks, in time order; static columns under the entity's name and `!`."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch().to_pydict()
        columns = found.setdefault(str(chunk.entity_path) + ("!" if chunk.is_static else ""), {})
        for name, rows in batch.items():
            columns.setdefault(name, []).extend(rows)
    for columns in found.values():
        if "step" in columns:
            order = np.argsort(columns["step"])
            for name in columns:
                columns[name] = [columns[name][i] for i in order]
    return found


def simulate(scene: Path, out: Path, *, stop: float | None = None, kind=KeyboardInterrupt, seconds=0.15, **options):
    def on_progress(stage: str, fraction: float, message: str) -> None:
        if stop is not None and stage == "simulate" and stop < fraction < 1:
            raise kind

    settings = {"model": None, "seed": None, "viewer": "none", "device": "cpu"}
    settings |= {"on_progress": on_progress, "say": print, "seconds": seconds}
    return run.simulate(scene, out, **(settings | options))


class Killed(Exception):
    """Ends a run without a chance to keep anything more."""


def same(one: State, other: State) -> bool:
    return same_arrays(one.arrays(), other.arrays())


def same_arrays(mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> bool:
    for arrays in (mine, theirs):  # behind the points of a pair there is room for more, with anything in it
        counted = np.arange(arrays["touch.point"].shape[1]) < arrays["touch.count"][:, None]
        arrays["touch.point"] = np.where(counted[:, :, None], arrays["touch.point"], 0.0)
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[name], theirs[name]) for name in mine)
