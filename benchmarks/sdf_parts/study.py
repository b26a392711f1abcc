"""What the parts share: the meshes, the results file that outlives an interruption, and the fitted shapes."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdfsim.errors import SdfsimError
from sdfsim.files import read_json, write_json
from sdfsim.shape.distance import MeshDistance
from sdfsim.shape.fit import FIT_VERSION, PLANS, fit_mesh
from sdfsim.shape.fit_metrics import EXACT
from sdfsim.shape.mesh import load_mesh
from sdfsim.shape.shape import RECORD_FILE, Shape, load_shape
from sdfsim.shape.watertight import solidify
from sdfsim.threads import limit_threads

RESULTS = "sdf.json"
ERRORS = tuple(key for key, _ in EXACT)
_STEP = re.compile(r"step (\d+) of \d+, error (\S+) near, (\S+) in the box")


@dataclass
class Study:
    """One run of the study; what its results file holds already is not measured again.

    Attributes:
        meshes: mesh file by shape name.
        out: folder of the results file and the fitted shapes.
        pictures: folder of the PNG files.
        seconds: budget of a fit.
        threads: CPU threads at most.
        chosen: shapes that every part takes; None: each part its own.
        points: in a timed query.
        results: content of the results file.
    """

    meshes: dict[str, Path]
    out: Path
    pictures: Path
    seconds: float
    threads: int
    chosen: tuple[str, ...] | None
    points: int
    results: dict[str, Any] = field(default_factory=dict)
    _oracles: dict[str, MeshDistance] = field(default_factory=dict)

    def open(self) -> None:
        """Read the results so far.

        Raises:
            SdfsimError: they were measured with other settings, so that the two would not compare.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        self.pictures.mkdir(parents=True, exist_ok=True)
        limit_threads(self.threads)
        settings = {
            "seconds": self.seconds,
            "threads": self.threads,
            "points": self.points,
            "fit_version": FIT_VERSION,
            "torch": torch.__version__,
            # Through JSON, in which tuples are lists.
            "plans": json.loads(json.dumps({recipe: asdict(plan) for recipe, plan in PLANS.items()})),
        }
        path = self.out / RESULTS
        self.results = read_json(path) if path.exists() else {"settings": settings}
        before = self.results["settings"]
        other = [key for key in settings if before.get(key) != settings[key]]
        if other:
            raise SdfsimError(f"{path}: was measured with other {', '.join(other)}", "use another -o")

    def keep(self, value: Any, *keys: str) -> None:
        """Put `value` under nested `keys` of the results, and on disk."""
        self.section(*keys[:-1])[keys[-1]] = value
        write_json(self.out / RESULTS, self.results)

    def section(self, *keys: str) -> dict[str, Any]:
        """The dict under nested `keys` of the results, made when absent."""
        place = self.results
        for key in keys:
            place = place.setdefault(key, {})
        return place

    def names(self, own: Sequence[str] | None = None) -> list[str]:
        """The shapes that a part takes: those asked for, else its `own`, else all."""
        wanted = self.chosen or own or self.meshes
        return [name for name in wanted if name in self.meshes]

    def oracle(self, name: str) -> MeshDistance:
        """True distances to a shape."""
        if name not in self._oracles:
            self._oracles[name] = MeshDistance(solidify(load_mesh(self.meshes[name]), name=name))
        return self._oracles[name]

    def fitted(self, variant: str, name: str, *, hurried: bool = True, **changes: Any) -> Shape:
        """A fit with its record in the results under "fits", `variant`, `name`; made unless both are there already.

        Args:
            variant: "default" or "paper", followed by whatever tells the changes.
            name: of the shape.
            hurried: whether the budget counts.
            changes: fields of the plan that differ from the recipe's.
        """
        folder = self.out / "shapes" / variant / name
        if name in self.section("fits", variant) and (folder / RECORD_FILE).exists():
            return load_shape(folder)
        recipe = "paper" if variant.startswith("paper") else "default"
        oracle = self.oracle(name)
        curve: list[list[float]] = []
        trained = 0.0
        started = time.monotonic()

        def listen(_: float, message: str) -> None:
            nonlocal trained
            now = time.monotonic() - started
            if message == "measuring":
                trained = now
            found = _STEP.match(message)
            if found:
                step, near, box = (float(part) for part in found.groups())
                if np.isfinite([near, box]).all():
                    curve.append([step, round(now, 3), near, box])

        with _changed(recipe, changes):
            budget = self.seconds if hurried else None
            shape = fit_mesh(oracle, name=name, recipe=recipe, budget=budget, on_progress=listen)
        certificate = shape.certificate
        record = {
            "errors": {key: certificate[key] for key in ERRORS},
            "passed": certificate["passed"] and not certificate["caveat"],
            "reason": certificate["reason"] or certificate["caveat"],
            "updates": certificate["steps"],
            "seconds": round(time.monotonic() - started, 2),
            "training": round(trained, 2),
            # The fit takes one thread where a second would slow it down.
            "threads": torch.get_num_threads(),
            "curve": curve,
        }
        shape.save(folder)
        self.keep(record, "fits", variant, name)
        say(
            f"{variant} {name}: {record['updates']} updates, {record['seconds']:.1f} s, "
            f"in the box {certificate['error_in_box']:.2g}"
        )
        return shape


@contextmanager
def _changed(recipe: str, changes: dict[str, Any]) -> Iterator[None]:
    """The recipe with other values in some fields, for as long as the block lasts."""
    before = PLANS[recipe]
    PLANS[recipe] = replace(before, **changes)
    try:
        yield
    finally:
        PLANS[recipe] = before


def interleaved(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Seconds of `repeats` runs of each call, taken in turn, so that whatever else the machine does hits all alike.

    Each is called once before, untimed, for its memory and threads.
    """
    took: dict[str, list[float]] = {key: [] for key in calls}
    for call in calls.values():
        call()
    for _ in range(repeats):
        for key, call in calls.items():
            began = time.perf_counter()
            call()
            took[key].append(time.perf_counter() - began)
    return took


def say(message: str) -> None:
    """A line on what goes on, beside the results."""
    print(message, file=sys.stderr, flush=True)
