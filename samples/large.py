"""Writes the paper's large scenes: a folder with scene.yaml and the shapes it needs.

    python samples/large.py bowl -o DIR [--count 512] [--nodes 64]   # spheres of 0.52 m into one bowl, 200 steps
    python samples/large.py shoes -o DIR                           # 300 clogs, 851k nodes, 200 steps
    python samples/large.py knots -o DIR                           # 270 torus knots, 384k nodes, 200 steps
    python samples/large.py heaps -o DIR                           # 380 bodies of eight shapes, 1.1 M nodes, 400 steps

`--resampled` uses the nodes of a 7^3 grid instead. Then: sdfsim simulate DIR/scene.yaml -o RUN

Four of the shapes come with the samples, two are exact; clog and knot are fitted on first use (half a minute each).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from sdfsim.base.errors import run_main
from sdfsim.base.files import write_text
from sdfsim.geometry.primitives import bowl_radii
from sdfsim.scene.load import load_scene
from sdfsim.shape.make import analytic_shape, shape_from_primitive
from sdfsim.shape.shape import Shape, load_shape, scaled
from sdfsim.shape.surface_nodes import sample_nodes, thin
from sdfsim.simulate.simulator import Simulator

BALL = 0.52  # m, diameter
MOST_BALLS = 512
LATTICE = 1.1  # diameters between ball centres at the start
GAP = 1.02  # bounding spheres between body centres at the start
GRID = 48  # points along each side before nodes are chosen; far more than are kept
VOXEL = 0.01
SAMPLED = ("bowl", "can", "cone", "ring")  # of samples/shapes
MIXED = ("box", "sphere", *SAMPLED, "torus_knot", "shoe")
SEED = 0


@dataclass(frozen=True)
class Heap:
    """Bodies dropped onto the floor out of a tall block.

    Attributes:
        kinds: primitives, by turns.
        count: of bodies.
        nodes: of each.
        extents: smallest and largest size, m.
        side: bodies along x and y of the block.
        steps: to simulate.
    """

    kinds: tuple[str, ...]
    count: int
    nodes: int
    extents: tuple[float, float]
    side: int
    steps: int


HEAPS = {
    "shoes": Heap(("shoe",), 300, 2837, (0.3, 0.3), 6, 200),
    "knots": Heap(("torus_knot",), 270, 1422, (0.4, 0.4), 6, 200),
    "heaps": Heap(MIXED, 380, 2895, (0.25, 0.5), 6, 400),
}
FLOOR = {"name": "floor", "plane": {"normal": [0, 0, 1], "offset": 0.0}, "friction": 0.8, "restitution": 0.4}


def sample_shape(name: str) -> Shape:
    """One of samples/shapes, scaled to a largest extent of 1 m."""
    shape = load_shape(Path(__file__).resolve().parent / "shapes" / name)
    return scaled(shape, 1.0 / float(np.ptp(shape.sdf.bounds, axis=0).max()))


def shape_with_nodes(kind: str, nodes: int | None) -> Shape:
    """A shape of size 1 m with exactly this many nodes (None: those of a 7^3 grid)."""
    if kind == "sphere":
        shape = analytic_shape("sphere", radius=0.5, name=kind)
    elif kind == "box":
        shape = analytic_shape("box", size=(1.0, 0.7, 0.5), name=kind)
    elif kind in SAMPLED:
        shape = sample_shape(kind)
    else:
        shape = shape_from_primitive(kind)
    if nodes is None:
        return replace(shape, nodes=sample_nodes(shape.sdf, grid=7))
    return replace(shape, nodes=thin(sample_nodes(shape.sdf, grid=GRID, voxel=VOXEL), nodes))


def ball_places(count: int, inner: float) -> np.ndarray:
    """[count, 3] m: centres on a lattice within a bowl of radius `inner` m, the lowest first."""
    spacing, reach = LATTICE * BALL, inner - 0.55 * BALL
    steps = np.arange(-np.ceil(inner / spacing), np.ceil(inner / spacing) + 1)
    lattice = spacing * np.stack(np.meshgrid(steps, steps, steps + 0.5, indexing="ij"), -1).reshape(-1, 3)
    inside = lattice[np.linalg.norm(np.minimum(lattice, [np.inf, np.inf, 0.0]), axis=1) < reach]
    order = np.lexsort((np.linalg.norm(inside[:, :2], axis=1), inside[:, 2]))
    return inside[order[:count]]


def bowl_scene(folder: Path, count: int, nodes: int | None) -> tuple[dict, int]:
    """Spheres a little above their places in a bowl with room for twice 512 of them."""
    inner, outer = bowl_radii(MOST_BALLS, BALL)
    shape_with_nodes("sphere", nodes).save(folder / "shapes/ball")
    sample_shape("bowl").save(folder / "shapes/bowl")
    rng = np.random.default_rng(SEED)
    places = ball_places(MOST_BALLS, inner)[:count]
    places = places + rng.uniform(-0.04, 0.04, places.shape) * BALL + [0.0, 0.0, outer + 0.5 * BALL]
    turns = Rotation.random(count, rng=rng).as_quat()
    bowl = {"name": "bowl", "shape": "bowl", "motion": "static", "scale": 2 * outer, "position": [0, 0, outer]}
    balls = [
        {"name": f"ball_{k}", "shape": "ball", "scale": BALL, "position": place, "quat_xyzw": turn}
        for k, (place, turn) in enumerate(zip(places.round(5).tolist(), turns.round(6).tolist(), strict=True))
    ]
    return {"shapes": {k: {"asset": f"shapes/{k}"} for k in ("ball", "bowl")}, "bodies": [FLOOR, bowl, *balls]}, 200


def heap_scene(folder: Path, heap: Heap, count: int, nodes: int | None) -> tuple[dict, int]:
    """Bodies with random rotations in a block with room for each one's bounding sphere."""
    shapes = {kind: shape_with_nodes(kind, nodes) for kind in heap.kinds}
    for kind, shape in shapes.items():
        shape.save(folder / "shapes" / kind)
    rng = np.random.default_rng(SEED)
    reach = max(float(np.linalg.norm(s.nodes - s.com, axis=1).max()) for s in shapes.values())
    spacing = 2 * GAP * heap.extents[1] * reach
    bodies: list[dict] = []
    for k in range(count):
        kind = heap.kinds[k % len(heap.kinds)]
        cell = np.array([k % heap.side, k // heap.side % heap.side, k // heap.side**2])
        scale, turn = rng.uniform(*heap.extents), Rotation.random(rng=rng)
        centre = (cell - [(heap.side - 1) / 2, (heap.side - 1) / 2, -0.6]) * spacing
        place = centre - turn.apply(scale * shapes[kind].com)
        pose = {"position": place.round(5).tolist(), "quat_xyzw": turn.as_quat().round(6).tolist()}
        bodies.append({"name": f"{kind}_{k}", "shape": kind, "scale": round(scale, 5), **pose})
    for body in bodies:
        body |= {"friction": 0.8, "restitution": 0.4}
    return {"shapes": {k: {"asset": f"shapes/{k}"} for k in shapes}, "bodies": [FLOOR, *bodies]}, heap.steps


def write_scene(name: str, folder: Path, count: int | None = None, nodes: int | None = 0) -> Path:
    """Write DIR/scene.yaml and its shapes.

    Args:
        name: bowl, shoes, knots or heaps.
        folder: to write.
        count: of bodies, None for the paper's (512 in the bowl).
        nodes: of a body; 0 for the paper's (64 in the bowl), None for those of a 7^3 grid.

    Returns:
        The scene file.
    """
    if name == "bowl":
        content, steps = bowl_scene(folder, count or MOST_BALLS, 64 if nodes == 0 else nodes)
    else:
        heap = HEAPS[name]
        content, steps = heap_scene(folder, heap, count or heap.count, heap.nodes if nodes == 0 else nodes)
    path = folder / "scene.yaml"
    write_text(path, _text({"version": 1, **content}))
    # The model sets its time step, so the duration of the steps is only known now.
    length = steps * Simulator(load_scene(path)).dt
    write_text(path, _text({"version": 1, "duration": round(length, 6), **content}))
    return path


def _text(content: dict) -> str:
    return yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=200)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=("bowl", *HEAPS))
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--count", type=int, help="bodies (default: the paper's)")
    parser.add_argument("--nodes", type=int, default=0, help="nodes of each (default: the paper's)")
    parser.add_argument("--resampled", action="store_true", help="the nodes of a 7^3 grid")
    chosen = parser.parse_args()
    print(write_scene(chosen.name, chosen.out, chosen.count, None if chosen.resampled else chosen.nodes))


if __name__ == "__main__":
    run_main(main)
