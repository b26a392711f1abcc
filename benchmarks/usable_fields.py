"""What errors of a signed-distance field do to bodies on it, and the limits of a certificate that follow.

    python benchmarks/usable_fields.py [-o DIR] [--model small]

A table is disturbed in three ways: waves of many heights and lengths in its distances, and bumps and dents of many
sizes. Cubes and balls a tenth as large as the table are laid on each field and dropped onto it. The same bodies on the
exact table are the reference. A field is usable if in the mean over bodies they rest at the height where they should,
no faster than there, and leave the first hit as they should.

Every field has its certificate, as a fitted shape has. The limit of a figure is the largest value that a usable field
had: what is beyond it was not usable here, whatever its other figures were. Writes DIR/fields.json; some minutes.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.dynamics.simulator import Simulator
from sdfsim.errors import run_main
from sdfsim.files import write_json
from sdfsim.progress import columns
from sdfsim.scene.types import Body, Scene
from sdfsim.shape.distance import MeshDistance
from sdfsim.shape.fit import surface_nodes
from sdfsim.shape.fit_metrics import EXACT, USABLE, certify
from sdfsim.shape.sdf import BoxSdf, accepts_numpy
from sdfsim.shape.shape import Shape, analytic_shape

SIZE = (2.0, 2.0, 0.3)  # m, of the table
EXTENT = max(SIZE)
BODY = 0.1 * EXTENT  # m, of what lies on it
ROWS = 5  # bodies along each side of the table
HEIGHT = 2.5 * BODY  # m, of the drops
SECONDS = 2.0
# What a body may do otherwise than on the exact table, in the mean over bodies.
HEIGHT_OFF = 0.05  # of its size, at rest
CREEP = 0.05  # of its size a second, at rest
DEFLECTED = 0.1  # sideways, of the speed of a straight hit: 6 degrees

AMPLITUDES = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)  # of EXTENT, root mean square
WAVELENGTHS = (0.02, 0.05, 0.1, 0.3)  # of EXTENT
RADII = (0.005, 0.01, 0.02, 0.04)  # of EXTENT
SHARES = (0.02, 0.1)  # of the surface that bumps or dents cover


@dataclass(frozen=True, eq=False)
class Waves:
    """The table with waves in its distances.

    Attributes:
        table: the exact one.
        way: [W, 3] wave vectors, rad/m.
        phase: [W] rad.
        height: m, of each wave.
    """

    table: BoxSdf
    way: torch.Tensor
    phase: torch.Tensor
    height: float

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        return self.table.bounds

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m."""
        distance, gradient = self.table(points)
        angle = points.double() @ self.way.T + self.phase
        wave = self.height * angle.sin().sum(1)
        slope = self.height * angle.cos() @ self.way
        return distance + wave.to(points), gradient + slope.to(points)


@dataclass(frozen=True, eq=False)
class Bumps:
    """The table with balls added to it, or cut out of it.

    Attributes:
        table: the exact one.
        centre: [B, 3] m.
        radius: m, negative where balls are cut out.
    """

    table: BoxSdf
    centre: torch.Tensor
    radius: float

    @property
    def bounds(self) -> np.ndarray:
        """[2, 3] m."""
        return self.table.bounds

    @accepts_numpy
    def __call__(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance [P] m and gradient [P, 3] at `points` [P, 3] m."""
        distance, gradient = self.table(points)
        away, nearest = torch.cdist(points.double(), self.centre).min(1)
        outward = torch.nn.functional.normalize(points.double() - self.centre[nearest], dim=1)
        ball, sign = (away - abs(self.radius)).to(points), math.copysign(1.0, self.radius)
        inside = ball < distance if sign > 0 else -ball > distance
        slope = torch.where(inside[:, None], sign * outward.to(points), gradient)
        return torch.where(inside, sign * ball, distance), slope


def fields() -> dict[str, Waves | Bumps]:
    """All disturbed tables by name."""
    table = BoxSdf(tuple(side / 2 for side in SIZE))
    found: dict[str, Waves | Bumps] = {}
    generator = torch.Generator().manual_seed(0)
    for length in WAVELENGTHS:
        for amplitude in AMPLITUDES:
            way = torch.nn.functional.normalize(torch.randn(32, 3, generator=generator, dtype=torch.float64), dim=1)
            phase = 2 * math.pi * torch.rand(32, generator=generator, dtype=torch.float64)
            height = amplitude * EXTENT * math.sqrt(2 / len(way))
            found[f"waves {amplitude:g} high, {length:g} long"] = Waves(
                table, way * 2 * math.pi / (length * EXTENT), phase, height
            )
    for radius in RADII:
        for share in SHARES:
            count = max(1, round(share * SIZE[0] * SIZE[1] / (math.pi * (radius * EXTENT) ** 2)))
            centre = (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor(SIZE)
            centre[:, 2] = SIZE[2] / 2
            for name, sign in (("bumps", 1), ("dents", -1)):
                found[f"{name} {radius:g}, {share:.0%} of the top"] = Bumps(table, centre, sign * radius * EXTENT)
    return found


def scene_on(table: Shape, gap: float) -> Scene:
    """Cubes and balls `gap` m above the top of a table."""
    shapes = (analytic_shape("box", size=(BODY,) * 3), analytic_shape("sphere", radius=BODY / 2), table)
    common = {"scale": 1.0, "quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0]), "velocity": np.zeros(3),
              "angular_velocity": np.zeros(3), "friction": 0.8, "restitution": 0.7}  # fmt: skip
    places = (np.arange(ROWS) - (ROWS - 1) / 2) * 0.85 * EXTENT / ROWS
    bodies = [
        Body(name=f"{i} {j}", shape=(i + j) % 2, motion="dynamic", mass=1.0, **common,
             position=np.array([x, y, SIZE[2] / 2 + BODY / 2 + gap]))
        for i, x in enumerate(places) for j, y in enumerate(places)
    ]  # fmt: skip
    bodies.append(Body(name="table", shape=2, motion="static", mass=0.0, position=np.zeros(3), **common))
    return Scene(shapes, tuple(bodies), np.array([0.0, 0.0, -10.0]), SECONDS)


def behaviour(table: Shape, model: str) -> dict[str, np.ndarray]:
    """Of cubes `height` [C] m and `creep` [C] m/s at rest; of balls `after` [B, 2] m/s, sideways after a hit."""
    laid = Simulator(scene_on(table, 0.0), model).run(SECONDS)
    fallen = Simulator(scene_on(table, HEIGHT), model).run(SECONDS)
    count = ROWS * ROWS
    position, half = laid.position[:, :count], len(laid.time) // 2
    seconds = laid.time[-1] - laid.time[half]
    speed = np.linalg.norm((position[-1] - position[half])[:, :2], axis=1) / seconds
    cubes = np.array([(i + j) % 2 == 0 for i in range(ROWS) for j in range(ROWS)])
    velocity = fallen.velocity[:, :count]
    # The first step in which a body no longer falls, and one more: a hit may take two.
    hit = np.argmax(velocity[1:, :, 2] > velocity[:-1, :, 2] + 0.5, axis=0) + 2
    after = velocity[np.minimum(hit, len(velocity) - 1), np.arange(count)]
    # How a cube that falls flat leaves a hit is chance on any field, and how fast hangs on when it hits.
    return {"height": position[-1, cubes, 2], "creep": speed[cubes], "after": after[~cubes, :2]}


def compared(found: dict[str, np.ndarray], exact: dict[str, np.ndarray]) -> dict[str, float]:
    """How far bodies do otherwise than on the exact table, relative as the tolerances are; means over bodies."""
    hit = math.sqrt(2 * 10.0 * HEIGHT)
    return {
        "height": float(np.abs(found["height"] - exact["height"]).mean() / BODY),
        "creep": float(np.maximum(found["creep"] - exact["creep"], 0.0).mean() / BODY),
        "deflected": float(np.linalg.norm(found["after"] - exact["after"], axis=1).mean() / hit),
    }


def main() -> None:
    """Run all fields, print the table and the limits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/usable_fields"))
    parser.add_argument("--model", default="small")
    arguments = parser.parse_args()
    exact = analytic_shape("box", size=SIZE)
    oracle = MeshDistance(exact.mesh)
    reference = behaviour(replace(exact, nodes=surface_nodes(exact.sdf, exact.mesh, 512)), arguments.model)
    allowed = {"height": HEIGHT_OFF, "creep": CREEP, "deflected": DEFLECTED}
    rows = []
    for name, sdf in {"exact": exact.sdf, **fields()}.items():
        certificate = certify(sdf, oracle)
        table = replace(exact, sdf=sdf, nodes=surface_nodes(sdf, exact.mesh, 512))
        off = compared(behaviour(table, arguments.model), reference)
        figures = {key: certificate[key] for key, _ in EXACT}
        usable = all(off[key] <= allowed[key] for key in allowed)
        rows.append({"field": name, "usable": usable, **off, **figures})
        print(f"{name}: {'usable' if usable else 'not usable'} {off}", flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    limits = {key: max((row[key] for row in rows if row["usable"]), default=None) for key, _ in EXACT}
    within = [row for row in rows if all(row[key] <= limits[key] for key in limits)]
    write_json(arguments.out / "fields.json", {"allowed": allowed, "limits": limits, "fields": rows})
    heads = ["", "usable", *allowed, *limits]
    lines = [heads]
    for row in rows:
        lines.append([row["field"], "yes" if row["usable"] else "no", *(f"{row[key]:.2g}" for key in heads[2:])])
    lines.append(["largest usable", "", "", "", "", *(f"{limit:.2g}" for limit in limits.values())])
    lines.append(
        ["limit in use", "", "", "", "", *(f"{dict(USABLE)[k]:.2g}" if k in dict(USABLE) else "" for k in limits)]
    )
    print("\n".join(columns(lines)))
    wrong = sum(not row["usable"] for row in within)
    print(f"{len(rows) - len(within)} of {len(rows)} fields are beyond a limit, {wrong} of the others are not usable")


if __name__ == "__main__":
    run_main(main)
