"""Throws a ball at a body of a reconstruction, towards the nearest edge of its support.

    sdfsim reconstruct samples/photos/table_vase -o table --preset quick --distance 026.jpg:50,200 026.jpg:428,370 1.2
    python samples/knock.py table object1           # writes table/knock.yaml
    sdfsim simulate table/knock.yaml -o run

The body that was dropped onto the scene is left out; everything else is as in scene.yaml.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from pipeline.materials import SCENERY
from pipeline.mesh.meshing import rounded
from pipeline.mesh.visibility import heights
from sdfsim.base.errors import run_main
from sdfsim.base.files import write_text
from sdfsim.geometry.mesh import Mesh
from sdfsim.scene.load import load_scene
from sdfsim.shape.shape import Shape, load_shape

GRAVITY = 9.81  # m/s^2
HEAVIER = 2.0  # the ball's mass relative to the body's
SPARE = 1.4  # speed relative to that needed for sliding to the edge
SLOWEST = 1.5  # m/s
SECONDS = 2.0  # until everything knocked off lies on the floor


def edge(support: Mesh, at: np.ndarray, base: float, size: float) -> tuple[np.ndarray, float]:
    """The direction [2] in which the support ends first, and the distance, m."""
    angles = np.arange(32) * 2 * np.pi / 32
    directions = np.stack([np.cos(angles), np.sin(angles)], 1)
    away = np.arange(0.5, 20, 0.1) * size
    gone = ~(heights(support, at + away[:, None, None] * directions) > base - 0.3 * size)
    first = np.where(gone.any(0), away[gone.argmax(0)], np.inf)
    best = int(first.argmin())
    return directions[best], float(min(first[best], away[-1]))


def throw(body: dict, mass: float, friction: float, shape: Shape, support: Mesh) -> tuple[float, dict]:
    """Radius m of the ball, and its entry among the bodies.

    Args:
        body: its entry in scene.yaml.
        mass: of it, kg.
        friction: between it and its support.
        shape: of it.
        support: mesh of the support.
    """
    low, high = np.stack([shape.mesh.vertices.min(0), shape.mesh.vertices.max(0)])
    height, wide = float(high[2] - low[2]), float(max(high[:2] - low[:2]))
    base = np.array(body["position"])
    direction, away = edge(support, base[:2], float(base[2]), max(height, wide))
    radius = 0.15 * height
    bounce = float(body["restitution"]) ** 2
    sliding = SPARE * np.sqrt(2 * friction * GRAVITY * away)
    speed = max(SLOWEST, sliding * (1 + HEAVIER) / (HEAVIER * (1 + bounce)))
    flight = wide / 2 + 3 * radius
    start = np.array([*(base[:2] - (flight + radius) * direction), base[2] + 0.55 * height])
    # The upward speed that gravity takes away on half of the way: it hits at its starting height.
    velocity = [*(speed * direction), 0.5 * GRAVITY * flight / speed]
    return radius, {
        "name": "thrown", "shape": "thrown", "position": rounded(start).tolist(),
        "velocity": rounded(velocity).tolist(),
        "mass": float(rounded(HEAVIER * mass)),
        "friction": body["friction"], "restitution": body["restitution"],
    }  # fmt: skip


def main() -> None:
    """Writes knock.yaml next to scene.yaml."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a reconstruction")
    parser.add_argument("body", help="its name in scene.yaml (mesh/objects.png shows the names)")
    arguments = parser.parse_args()
    loaded = {body.name: body for body in load_scene(arguments.folder / "scene.yaml").bodies}
    scene = yaml.safe_load((arguments.folder / "scene.yaml").read_text(encoding="utf-8"))
    assets = {name: shape["asset"] for name, shape in scene["shapes"].items() if "asset" in shape}
    bodies = [body for body in scene["bodies"] if "plane" in body or body["shape"] in assets]
    target = next((body for body in bodies if body["name"] == arguments.body and "density" in body), None)
    if target is None:
        names = [body["name"] for body in bodies if "density" in body]
        parser.error(f"{arguments.folder}/scene.yaml has no body {arguments.body!r} that can move (it has {names})")
    if SCENERY not in assets:
        parser.error(f"{arguments.folder}/scene.yaml has no scenery, so there is no edge to knock a body over")
    shapes = {name: load_shape(arguments.folder / asset) for name, asset in assets.items()}
    own = loaded[target["name"]]
    friction = own.friction * loaded[SCENERY].friction
    radius, ball = throw(target, own.mass, friction, shapes[target["shape"]], shapes[SCENERY].mesh)
    scene["shapes"] = {name: scene["shapes"][name] for name in assets}
    scene["shapes"]["thrown"] = {"sphere": {"radius": float(rounded(radius))}}
    scene["bodies"] = [*bodies, ball]
    scene["duration"] = SECONDS
    write_text(arguments.folder / "knock.yaml", yaml.safe_dump(scene, sort_keys=False))
    print(f"wrote {arguments.folder / 'knock.yaml'}")


if __name__ == "__main__":
    run_main(main)
