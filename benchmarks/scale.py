"""Question: what do large scenes cost, against nodes, bodies and contacts, beside the paper's network and two engines?

    python benchmarks/scale.py -o runs/scale_study [--only growth,nodes,apart,network,engines,selection,accuracy]

Every case runs in a process of its own on one thread and is kept as a JSON file in the folder; what is there is not
measured again. Times are CPU times, so that other work on the machine does not count. At the end the tables go
into docs/scale.md and the picture to docs/images/scale.png. The *paper* network is that of --paper, where given.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "samples"))

import large

from benchmarks.scale_parts import accuracy, engines, ours, page
from sdfsim import Simulator, load_scene
from sdfsim.errors import run_main
from sdfsim.files import read_json, write_json

BOWLS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
KNOTS = (8, 64, 270)
Case = tuple[str, Callable[..., dict], tuple[Any, ...], dict[str, Any]]


class Study:
    """The cases and where they are kept.

    Args:
        folder: of the results and scenes.
        paper: weights of a *paper* network, or None.
    """

    def __init__(self, folder: Path, paper: str | None) -> None:
        self.folder, self.paper = folder, paper

    def scene(self, name: str, count: int, nodes: int | None = 0) -> str:
        """A scene file of samples/large.py, written on first use."""
        folder = self.folder / "scenes" / f"{name}_{count}_{nodes}"
        if not (folder / "scene.yaml").exists():
            large.write_scene(name, folder, count, nodes)
        return str(folder / "scene.yaml")

    def growth(self) -> list[Case]:
        """Whole runs of bowls with more and more spheres."""
        return [
            (f"growth_{nodes}_{count}", ours.run, (self.scene("bowl", count, nodes), 200), {})
            for count in BOWLS
            for nodes in (64, 512)
        ]

    def nodes(self) -> list[Case]:
        """One bowl and one heap with more and more nodes a body."""
        cases: list[Case] = []
        for nodes in (64, 128, 256, 512, 1024):
            cases.append((f"nodes_bowl_{nodes}", ours.run, (self.scene("bowl", 128, nodes), 100), {}))
        for parts in (16, 8, 4, 2, 1):
            file = self.scene("knots", 64, 2844)
            cases.append((f"nodes_knots_{2844 // parts}", ours.run_cut, (file, 1 / parts, 100), {}))
        return cases

    def apart(self) -> list[Case]:
        """Bodies that never meet."""
        return [(f"apart_{count}", ours.run_apart, (count, 30), {}) for count in (125, 250, 500, 1000, 2000, 4000)]

    def network(self) -> list[Case]:
        """The *paper* network predicting all motion of all bodies, ours beside it from the same start."""
        cases: list[Case] = []
        for count in (16, 64, 256, 512):
            file, steps = self.scene("bowl", count, 64), 10 if count <= 64 else 3
            cases.append((f"network_ours_{count}", ours.run, (file, steps), {}))
            if self.paper:
                cases.append((f"network_paper_{count}", ours.run, (file, steps), {"model": self.paper, "always": True}))
        return cases

    def engines(self) -> list[Case]:
        """PyBullet and MuJoCo on bowls and knots."""
        cases: list[Case] = []
        for name, counts in (("bowl", (16, 64, 256, 512)), ("knots", KNOTS)):
            for count in counts:
                file = self.scene(name, count)
                dt = Simulator(load_scene(file)).dt
                for engine in ("bullet", "bullet concave", "mujoco"):
                    if name == "bowl" or engine != "bullet concave":
                        key = f"engine_{name}_{engine.replace(' ', '_')}_{count}"
                        cases.append((key, engines.run, (engine, file, dt, 200 if name == "bowl" else 40), {}))
        return cases

    def selection(self) -> list[Case]:
        """What choosing edges changes."""
        return [
            (f"selection_{name}_{nodes}", ours.selection, (self.scene(name, 64, nodes), steps), {})
            for name, nodes, steps in (("bowl", 64, 100), ("bowl", 512, 100), ("knots", 1422, 60))
        ]

    def accuracy(self) -> list[Case]:
        """Bowls against the teacher."""
        cases: list[Case] = []
        for count in (16, 64, 140):
            file = self.scene("bowl", count, 64)
            cases.append((f"accuracy_small_{count}", accuracy.run, (file, 100), {}))
            if self.paper and count <= 64:
                settings = {"model": self.paper, "always": True}
                cases.append((f"accuracy_paper_{count}", accuracy.run, (file, 100), settings))
        return cases

    def measure(self, parts: list[str]) -> None:
        """Fill in what is missing."""
        context = multiprocessing.get_context("spawn")
        for part in parts:
            for key, function, args, options in getattr(self, part)():
                path = self.folder / f"{key}.json"
                if path.exists():
                    continue
                with ProcessPoolExecutor(1, mp_context=context) as pool:  # a fresh process: its peak is the case's
                    result = pool.submit(function, *args, **options).result()
                write_json(path, result)
                print(key, {k: v for k, v in result.items() if isinstance(v, int | float)}, flush=True)

    def results(self) -> dict[str, dict]:
        """Everything measured so far, by case."""
        return {path.stem: read_json(path) for path in sorted(self.folder.glob("*.json"))}


PARTS = ("growth", "nodes", "apart", "network", "engines", "selection", "accuracy")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, separated by commas")
    parser.add_argument("--paper", help="weights of a paper network")
    chosen = parser.parse_args()
    parts = chosen.only.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    study = Study(chosen.out, chosen.paper)
    chosen.out.mkdir(parents=True, exist_ok=True)
    study.measure(parts)
    results = study.results()
    docs = Path(__file__).resolve().parents[1] / "docs"
    page.insert(page.tables(results), docs / "scale.md")
    page.draw(results, docs / "images/scale.png")
    print(docs / "scale.md")


if __name__ == "__main__":
    run_main(main)
