"""Question: how good, how fast and how large are our SDF networks, beside the paper's recipe and other representations?

    python benchmarks/sdf.py MESH_FOLDER -o runs/sdf [--parts 1,2,3,4,5,6] [--shapes cube,torus] [--seconds 60]

MESH_FOLDER holds NAME/visual_geometry.obj for each shape. Parts: 1 our recipe against the paper's at equal wall time,
2 widths of the network, 3 shapes on the way through training, 4 bytes, 5 query times, 6 nodes against coverage.
Results go to sdf.json and, as markdown tables, to sdf.md in the folder, pictures to docs/images. A run that was
interrupted goes on where it was: what sdf.json holds is not measured again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.sdf_parts import cost, recipes, spread, stages
from benchmarks.sdf_parts.study import Study
from sdfsim.errors import SdfsimError, run_main
from sdfsim.files import write_text

MESH = "visual_geometry.obj"


class Part(NamedTuple):
    """One part of the study.

    Attributes:
        title: of its section.
        measure: fills what the results lack.
        tables: markdown of what the results hold; empty where they hold nothing.
        draw: writes its picture, if it has one.
    """

    title: str
    measure: Callable[[Study], None]
    tables: Callable[[Study], str]
    draw: Callable[[Study], None] | None = None


PARTS = {
    1: Part("Our recipe and the paper's at equal time", recipes.measure_recipes, recipes.tables_of_recipes,
            recipes.draw_recipes),
    2: Part("Width of the network", recipes.measure_widths, recipes.tables_of_widths),
    3: Part("Shapes on the way through training", stages.measure, stages.tables, stages.draw),
    4: Part("Bytes", cost.measure_bytes, cost.tables_of_bytes),
    5: Part("Query time", cost.measure_queries, cost.tables_of_queries),
    6: Part("Nodes and coverage", spread.measure, spread.tables, spread.draw),
}  # fmt: skip


def report(study: Study, parts: list[int]) -> str:
    """The sections of some parts, in markdown."""
    sections = [(number, PARTS[number].tables(study)) for number in parts]
    return "\n\n".join(f"## {PARTS[number].title}\n\n{text}" for number, text in sections if text) + "\n"


def find_meshes(folder: Path) -> dict[str, Path]:
    """Mesh file by shape name; folders without one are skipped.

    Raises:
        SdfsimError: there is none at all.
    """
    found = {path.parent.name: path for path in sorted(folder.glob(f"*/{MESH}"))}
    if not found:
        raise SdfsimError(f"{folder}: holds no NAME/{MESH}")
    return found


def main() -> None:
    """Measures what is missing, part by part, then prints the tables of the parts asked for."""
    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, metavar="MESH_FOLDER")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--parts", default=",".join(map(str, PARTS)), help="numbers, separated by commas")
    parser.add_argument("--shapes", help="names, separated by commas; by default what each part is meant for")
    parser.add_argument("--seconds", type=float, default=60.0, help="budget of a fit")
    parser.add_argument("--threads", type=int, default=2, help="at most")
    parser.add_argument("--points", type=int, default=250_000, help="in a timed query")
    parser.add_argument("--pictures", type=Path, default=root / "docs" / "images", metavar="DIR")
    arguments = parser.parse_args()
    try:
        parts = sorted({int(part) for part in arguments.parts.split(",")})
    except ValueError:
        parts = []
    if not parts or not set(parts) <= set(PARTS):
        parser.error(f"--parts takes numbers from 1 to {len(PARTS)}, separated by commas (got {arguments.parts})")
    meshes = find_meshes(arguments.meshes)
    chosen = tuple(arguments.shapes.split(",")) if arguments.shapes else None
    unknown = sorted(set(chosen or ()) - set(meshes))
    if unknown:
        raise SdfsimError(f"no such shape: {', '.join(unknown)}", f"there are {', '.join(meshes)}")
    study = Study(
        meshes, arguments.out, arguments.pictures, arguments.seconds, arguments.threads, chosen, arguments.points
    )
    study.open()
    for number in parts:
        PARTS[number].measure(study)
        draw = PARTS[number].draw
        if draw is not None:
            draw(study)
        write_text(study.out / "sdf.md", report(study, list(PARTS)))
    print(report(study, parts), end="")


if __name__ == "__main__":
    run_main(main)
