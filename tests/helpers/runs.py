"""Runs that are interrupted, and recordings that are read back."""

from pathlib import Path

import numpy as np

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
