"""What a step costs, as a sum over what is in it: fitted to measured steps, used by `plan`.

`python -m sdfsim.studies.tradeoff_cost DIR` stores what `sdfsim tradeoff -o DIR` has measured, for the bundled models.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.dynamics.model import BUNDLED, Model
from sdfsim.errors import SdfsimError, run_main
from sdfsim.files import read_json, write_json

COSTS_FILE = BUNDLED / "costs.json"


@dataclass(frozen=True)
class Load:
    """What is in a step, in the mean of a run.

    Attributes:
        bodies: that move.
        touching: share of the steps in which anything touches: the network is asked at all.
        nodes: surface nodes of the bodies that have a contact.
        edges: contact edges that the network sees.
        roundness: share of the moving bodies' nodes that lie on smooth surfaces, which meet in few edges; the time of
            a step is no matter of it.
    """

    bodies: float
    touching: float
    nodes: float
    edges: float
    roundness: float = 0.0

    def row(self) -> list[float]:
        """One, then the quantities."""
        return [1.0, self.bodies, self.touching, self.nodes, self.edges]


@dataclass(frozen=True)
class CostModel:
    """Milliseconds of a step on the machine that it was fitted on; on others its ratios count.

    Attributes:
        base: of any step.
        body, node, edge: of each of them.
        touching: of the network's being asked at all.
        edges_a_body, edges_a_round_body: contact edges of a body that has any, with corners or without; in the
            median of the scenes it was fitted to.
    """

    base: float
    body: float
    touching: float
    node: float
    edge: float
    edges_a_body: float
    edges_a_round_body: float

    def __call__(self, load: Load) -> float:
        """ms of a step."""
        weights = (self.base, self.body, self.touching, self.node, self.edge)
        return float(np.dot(weights, load.row()))

    def edges(self, in_contact: float, roundness: float) -> float:
        """Contact edges of so many bodies that touch something."""
        return in_contact * (self.edges_a_body * (1 - roundness) + self.edges_a_round_body * roundness)

    def to_json(self) -> dict[str, float]:
        """All coefficients by name."""
        return asdict(self)


def fit_cost(loads: Sequence[Load], milliseconds: Sequence[float]) -> CostModel:
    """The cost model that is off by the least squares of relative errors; no coefficient is negative.

    Args:
        loads: of S steps (or means over runs).
        milliseconds: [S] that they took, > 0.

    Raises:
        SdfsimError: fewer steps than coefficients.
    """
    from scipy.optimize import nnls

    rows, taken = np.array([load.row() for load in loads]), np.asarray(milliseconds, dtype=float)
    if len(rows) < rows.shape[1]:
        raise SdfsimError(f"a cost model needs at least {rows.shape[1]} scenes (got {len(rows)})")
    scale = np.maximum(np.abs(rows).max(0), 1e-12)
    weights = nnls(rows / scale / taken[:, None], np.ones(len(taken)))[0] / scale
    kinds: dict[bool, list[float]] = {False: [], True: []}
    for load in loads:
        if load.edges > 0:
            kinds[load.roundness > 0.5].append(load.edges / load.bodies)
    edges = [float(np.median(known)) if known else 0.0 for known in kinds.values()]
    return CostModel(*(float(w) for w in weights), *edges)


def relative_errors(model: CostModel, loads: Sequence[Load], milliseconds: Sequence[float]) -> np.ndarray:
    """[S] predicted over measured, less one."""
    return np.array([model(load) for load in loads]) / np.asarray(milliseconds, dtype=float) - 1.0


def stored_cost(model: Model, path: Path = COSTS_FILE) -> CostModel | None:
    """The cost model of a model, else that of a bundled one of its kind; None where none was measured.

    Raises:
        SdfsimError: the file is not readable.
    """
    if not path.exists():
        return None
    known: Mapping[str, Any] = read_json(path)["models"]
    same_kind = [entry for entry in known.values() if entry["kind"] == model.kind]
    entry = known.get(model.name) or (same_kind[0] if same_kind else None)
    return CostModel(**entry["cost"]) if entry else None


def store_cost(folder: Path, path: Path = COSTS_FILE) -> None:
    """Keep the cost model of a folder of `sdfsim tradeoff -o`, beside those of other models.

    Raises:
        SdfsimError: the folder holds none.
    """
    report = read_json(folder / "growth.json", "measure it: sdfsim tradeoff -o DIR")
    models = read_json(path)["models"] if path.exists() else {}
    kept = ("kind", "quick", "cost", "held_out_median", "held_out_within")
    models[report["model"]] = {what: report[what] for what in kept}
    write_json(path, {"models": models})


def main() -> None:
    """Command line of this module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    store_cost(parser.parse_args().folder)
    print(f"wrote {COSTS_FILE}")


if __name__ == "__main__":
    run_main(main)
