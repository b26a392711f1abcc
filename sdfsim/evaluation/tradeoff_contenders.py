"""Who takes part: our simulator in one setting or another, and what it is compared with."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import torch

from sdfsim.data.dataset import Trajectory
from sdfsim.data.replay import roll_out
from sdfsim.dynamics.model import BUNDLED, Model, load_model
from sdfsim.dynamics.simulator import Simulator, pick_device
from sdfsim.dynamics.step import FreeFlight
from sdfsim.evaluation.tradeoff_cases import Cases, PiecesSdf
from sdfsim.evaluation.tradeoff_knobs import Setting, arranged_model, arranged_scene, arranged_shape, threads_of
from sdfsim.evaluation.tradeoff_shapes import refitted, sampled
from sdfsim.scene.types import Effects, Scene
from sdfsim.shape.distance import MeshDistance, PiecesDistance
from sdfsim.shape.mlp_sdf import MlpSdf
from sdfsim.shape.shape import Shape
from sdfsim.shape.watertight import solidify


@dataclass(frozen=True)
class Timed:
    """One timed repeat over the timed scenes.

    Attributes:
        wall, cpu: s in all timed steps, by the clock and of the processor.
        simulated: s of simulated time in them.
        first_ms: the slowest first step, which is not among them.
        end: [B, 3] m where all bodies were at the end.
        scenes: a dict a scene: bodies, nodes, and means a step of edges, queries and ms.
    """

    wall: float
    cpu: float
    simulated: float
    first_ms: float
    end: np.ndarray
    scenes: list[dict[str, float]]


class Prepared(Protocol):
    """A contender that is ready to run."""

    def motions(self) -> list[Trajectory]:
        """The motion of all cases from their starts."""
        ...

    def timed(self) -> Timed:
        """One repeat of the timed scenes."""
        ...

    def fitted_s(self) -> float | None:
        """s that its distances took to fit or to sample, once for all scenes; None where there is nothing to fit."""
        ...


class Contender(Protocol):
    """One that takes part."""

    @property
    def kind(self) -> str:
        """ "ours", "engine", "baseline", or "floor" for the chaos floor."""
        ...

    @property
    def key(self) -> str:
        """A file name."""
        ...

    @property
    def label(self) -> str:
        """What a picture calls it."""
        ...

    @property
    def one_core(self) -> bool:
        """It works in one thread of this process alone: processor time is what it takes on a free core."""
        ...

    def describe(self) -> dict[str, Any]:
        """What a measurement of it depends on, for the record."""
        ...

    def prepare(self, cases: Cases) -> Prepared:
        """Load, sample and build all that it needs."""
        ...


@dataclass
class Ours:
    """Our simulator in one setting."""

    setting: Setting
    contact: bool = True

    @property
    def kind(self) -> str:
        return "ours" if self.contact else "baseline"

    @property
    def key(self) -> str:
        return self.setting.key if self.contact else "ballistic"

    @property
    def label(self) -> str:
        return self.setting.label if self.contact else "ballistic: no contact"

    @property
    def one_core(self) -> bool:
        return self.setting.threads == 1 and self.setting.device == "cpu"

    def describe(self) -> dict[str, Any]:
        return {"setting": self.setting.to_json(), "model": weights_digest(self.setting.model)}

    def prepare(self, cases: Cases) -> OursPrepared:
        with threads_of(self.setting):
            model = arranged_model(self.setting, load_model(self.setting.model)).to(pick_device(self.setting.device))
            shapes = {name: self._shape(cases, name, shape) for name, shape in cases.shapes.items()}
        return OursPrepared(self, cases, model, shapes)

    def _shape(self, cases: Cases, name: str, shape: Shape) -> Shape:
        if self.setting.sdf.startswith("grid") and isinstance(shape.sdf, MlpSdf):
            shape = sampled(shape, int(self.setting.sdf.split()[1]), cases.scratch)
            return arranged_shape(replace(self.setting, sdf="own"), shape)
        if self.setting.sdf.startswith("width") and isinstance(shape.sdf, MlpSdf):
            pieces = cases.pieces[name]
            oracle = PiecesDistance(pieces) if pieces else MeshDistance(solidify(shape.mesh, name=name))
            shape = refitted(shape, int(self.setting.sdf.split()[1]), oracle, cases.scratch)
            return arranged_shape(replace(self.setting, sdf="own"), shape)
        asked = self.setting.sdf == "exact" and cases.pieces[name]
        return arranged_shape(self.setting, shape, PiecesSdf(PiecesDistance(cases.pieces[name])) if asked else None)


@dataclass
class OursPrepared:
    """See `Prepared`; `simulator` makes one of any case."""

    ours: Ours
    cases: Cases
    model: Model
    shapes: dict[str, Shape]

    def motions(self) -> list[Trajectory]:
        known = {name: replace(s, nodes=s.nodes[: self.model.nodes]) for name, s in self.shapes.items()}
        setting, device = self.ours.setting, pick_device(self.ours.setting.device)
        with threads_of(setting):
            return roll_out(
                self.model,
                self.cases.starts,
                known,
                self.cases.steps,
                device,
                cast(FreeFlight, setting.free_flight),
                contact=self.ours.contact,
                sleep=setting.sleep,
                floor=self.cases.floor,
            )

    def timed(self) -> Timed:
        with threads_of(self.ours.setting):
            runs = [self._one(index) for index in self.cases.timed]
        return together(runs)

    def fitted_s(self) -> float | None:
        known = [s.source.get("fitted_s", s.certificate.get("seconds")) for s in self.shapes.values()]
        return float(sum(seconds for seconds in known if seconds is not None))

    def scene(self, index: int) -> Scene:
        """A case as this contender simulates it."""
        scene = self.cases.scene(index, self.shapes)
        scene = arranged_scene(self.ours.setting, scene, scene.shapes)
        return scene if self.ours.contact else replace(scene, effects=Effects(contact="off"))

    def simulator(self, index: int) -> Simulator:
        """A case at its start."""
        setting, dt = self.ours.setting, self.cases.starts[index].dt
        flight = cast(FreeFlight, setting.free_flight)
        return Simulator(self.scene(index), self.model, setting.device, dt=dt, free_flight=flight)

    def _one(self, index: int) -> Timed:
        return time_simulator(self.simulator(index), self.cases.timed_steps)


def together(runs: list[Timed]) -> Timed:
    """One repeat out of its scenes."""
    return Timed(
        wall=sum(r.wall for r in runs),
        cpu=sum(r.cpu for r in runs),
        simulated=sum(r.simulated for r in runs),
        first_ms=max(r.first_ms for r in runs),
        end=np.concatenate([r.end for r in runs]),
        scenes=[r.scenes[0] for r in runs],
    )


def clock_of(device: torch.device) -> Callable[[], float]:
    """The clock, s, that tells what a step takes: of the processor where it alone works, and in one thread."""
    return time.process_time if device.type == "cpu" and torch.get_num_threads() == 1 else time.perf_counter


def time_simulator(simulator: Simulator, steps: int) -> Timed:
    """Times all but the first of so many steps."""
    began = time.perf_counter()
    next(simulator.steps(1))
    first = time.perf_counter() - began
    counted = dict.fromkeys(("edges", "sdf_queries", "active"), 0.0)
    clock = clock_of(simulator.device)
    wall, cpu, taken = time.perf_counter(), time.process_time(), clock()
    for _ in simulator.steps(steps - 1):
        for name in counted:
            counted[name] += simulator.memory.counts[name]
    wall, cpu, taken = time.perf_counter() - wall, time.process_time() - cpu, clock() - taken
    scene = {
        "bodies": float(simulator.bodies.moves.sum()),
        "nodes": float(len(simulator.bodies.node)),
        **{name: value / (steps - 1) for name, value in counted.items()},
        "ms": 1e3 * taken / (steps - 1),
    }
    return Timed(wall, cpu, (steps - 1) * simulator.dt, 1e3 * first, simulator.si_state().position.numpy(), [scene])


@contextmanager
def peak_memory() -> Iterator[dict[str, float | None]]:
    """Puts under `mib` by how much the process grew inside the block at most; None where Linux does not tell."""
    told: dict[str, float | None] = {"mib": None}
    before = _status("VmRSS") if _forget_peak() else None
    yield told
    after = _status("VmHWM")
    if before is not None and after is not None:
        told["mib"] = max(0.0, after - before) / 1024


def _forget_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _status(name: str) -> float | None:
    """kB of an entry of /proc/self/status."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((float(line.split()[1]) for line in lines if line.startswith(f"{name}:")), None)


def weights_digest(model: str) -> str:
    """Changes with a model's weights."""
    path = Path(model) if model.endswith(".safetensors") else BUNDLED / f"{model}.safetensors"
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "absent"
