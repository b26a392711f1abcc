"""Which laws of a school book hold for a model: rebound, rolling, sliding, resting, stacks, each in closed form.

    python benchmarks/laws.py [--model MODEL ...]

Every law is tried for bodies of 2 cm, 10 cm and 1 m, lengths and times scaled with them, and from several starts that
differ by a few percent where one could be lucky. A few minutes a model. With the bundled models (no --model) the table
goes to RESULTS.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import atan, cos, degrees, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import write_section
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, Simulator
from sdfsim.errors import run_main
from sdfsim.evaluation import hard_cases
from sdfsim.evaluation.hard_cases import on_floor
from sdfsim.evaluation.harness import markdown
from sdfsim.scene.scene import Body, Effects
from sdfsim.shape.shape import Shape, analytic_shape

G = 9.81  # m/s^2
SIZES = (0.02, 0.1, 1.0)  # m
BUNDLED = ["solver", "small"]
STARTS = (0.95, 0.98, 1.0, 1.03, 1.07)


Law = tuple[str, str, str, bool]  # what it is about, what is wanted, what came out, and whether that is as wanted


def body(name: str, position: Sequence[float], size: float, **fields: Any) -> Body:
    """A body of the density of water."""
    return hard_cases.body(name, 0, position, **({"mass": 1000.0 * size**3, "friction": 0.5} | fields))


def run(
    model: str, shape: Shape, bodies: list[Body], seconds: float, *, tilt: float = 0.0, weight: float = 1.0
) -> Rollout:
    """Bodies of one shape on a floor whose coefficients are 1; gravity leans by `tilt` degrees to +x."""
    scene = on_floor([shape], bodies, tilt=tilt, friction=1.0, restitution=1.0)
    gravity = weight * G * scene.gravity / np.linalg.norm(scene.gravity)
    return Simulator(replace(scene, gravity=gravity, effects=Effects()), model).run(seconds)


def cube(size: float) -> Shape:
    """With edges of `size` m."""
    return analytic_shape("box", size=(size,) * 3)


def plank(size: float) -> Shape:
    """A plank `size` m long."""
    return analytic_shape("box", size=(size, 0.2 * size, 0.1 * size))


def tower_of_planks(size: float) -> list[Body]:
    """Six layers of three planks."""
    scale = size / hard_cases.PLANK[0]
    return [
        replace(plank, position=scale * plank.position, mass=20.0 * size**3)
        for plank in hard_cases.planks().bodies[:-1]
    ]


def ball(size: float) -> Shape:
    """With a diameter of `size` m."""
    return analytic_shape("sphere", radius=size / 2)


def rebounds(model: str, size: float) -> Iterator[Law]:
    """A ball that is dropped from about its own size comes back to e^2 of the height."""
    for e in (0.3, 0.5, 0.7, 0.9, 1.0):
        found = []
        for start in STARTS:
            height = start * size
            motion = run(model, ball(size), [body("ball", [0, 0, size / 2 + height], size, restitution=e)],
                         3.0 * sqrt(2 * height / G))  # fmt: skip
            z = motion.position[:, 0, 2] - size / 2
            found.append(z[int(np.argmax(motion.velocity[:, 0, 2] > 0)) :].max() / height)
        mean, spread = float(np.mean(found)), float(np.std(found))
        holds = abs(mean - e**2) <= 0.15 * e**2 + 0.02 and spread < 0.05
        yield (f"rebound, e = {e}", f"{e**2:.2f}, spread below 0.05", f"{mean:.2f} +- {spread:.2f}", holds)


def head_on(model: str, size: float) -> Iterator[Law]:
    """Two equal balls that meet in free space part at e times the speed; momentum stays."""
    e = 0.8
    parts = []
    drift = 0.0
    for speed in (0.3, 1.0, 3.0):
        v = speed * sqrt(size)
        bodies = [body(n, [x, 0, 10 * size], size, velocity=np.array([-np.sign(x) * v / 2, 0, 0]), restitution=sqrt(e))
                  for n, x in (("a", -0.7 * size), ("b", 0.7 * size))]  # fmt: skip
        motion = run(model, ball(size), bodies, 1.2 * size / v, weight=0.0)
        after = motion.velocity[-1, :2, 0]
        parts.append(float(after[1] - after[0]) / (e * v))
        drift = max(drift, float(np.abs(after.sum()) / v))
    told = ", ".join(f"{part:.2f}" for part in parts)
    holds = all(abs(part - 1) < 0.1 for part in parts) and drift < 1e-5
    yield ("head-on, e = 0.8", "separation e v within 10 %", f"{told} of it, momentum to {drift:.0e}", holds)


def rolling(model: str, size: float) -> Iterator[Law]:
    """A ball that rolls keeps its speed."""
    v = 0.5 * sqrt(size)
    spin = [0.0, v / (size / 2), 0.0]
    one = body("ball", [0, 0, size / 2], size, velocity=np.array([v, 0, 0]), angular_velocity=np.array(spin))
    motion = run(model, ball(size), [one],
                 3.0 * sqrt(size))  # fmt: skip
    kept = float(np.linalg.norm(motion.velocity[-1, 0]) / v)
    yield ("rolling on", "keeps 90 to 101 %", f"{100 * kept:.0f} %", 0.9 <= kept <= 1.01)


def slopes(model: str, size: float) -> Iterator[Law]:
    """Down slopes: a ball by 5/7 g sin a, a box by g (sin a - mu cos a), or not at all."""
    t = 1.5 * sqrt(size)
    motion = run(model, ball(size), [body("ball", [0, 0, size / 2], size)], t, tilt=10)
    share = float(2 * motion.position[-1, 0, 0] / t**2 / (5 / 7 * G * sin(radians(10))))
    yield ("ball down 10 degrees", "5/7 g sin a within 10 %", f"{share:.2f} of it", abs(share - 1) < 0.1)
    mu = 0.4
    for factor in (0.9, 1.3):
        angle = degrees(atan(mu)) * factor
        motion = run(model, cube(size), [body("box", [0, 0, size / 2], size, friction=mu)], t, tilt=angle)
        way = float(motion.position[-1, 0, 0])
        if factor < 1:
            yield (
                f"box on {angle:.0f} degrees, mu = {mu}",
                "holds",
                f"{way / size:.3f} of its size",
                way < 0.01 * size,
            )
        else:
            share = 2 * way / t**2 / (G * (sin(radians(angle)) - mu * cos(radians(angle))))
            yield (f"box on {angle:.0f} degrees, mu = {mu}", "slides by g (sin a - mu cos a) within 10 %",
                      f"{share:.2f} of it", abs(share - 1) < 0.1)  # fmt: skip


def stops(model: str, size: float) -> Iterator[Law]:
    """A sliding box stops after v^2 / (2 mu g)."""
    mu, v = 0.4, 2.0 * sqrt(size)
    motion = run(model, cube(size), [body("box", [0, 0, size / 2], size, friction=mu, velocity=np.array([v, 0, 0]))],
                 2.0 * v / (mu * G))  # fmt: skip
    share = float(motion.position[-1, 0, 0] / (v**2 / (2 * mu * G)))
    yield ("box slides to a stop", "after v^2 / (2 mu g) within 10 %", f"{share:.2f} of it", abs(share - 1) < 0.1)


def rests(model: str, size: float) -> Iterator[Law]:
    """What lies stays, with no speed; what falls straight lands where it was let go."""
    motion = run(model, cube(size), [body("box", [0, 0, size / 2], size)], 10.0 * sqrt(size))
    speed = float(np.linalg.norm(motion.velocity[len(motion) // 2 :, 0], axis=1).max())
    way = float(np.linalg.norm(motion.position[-1, 0] - motion.position[0, 0]) / size)
    yield (
        "box at rest",
        "slower than 1 cm/s per sqrt(m)",
        f"{100 * speed / sqrt(size):.2f} cm/s",
        speed < 0.01 * sqrt(size),
    )
    yield ("box at rest, ten seconds", "moves 0.1 % of its size", f"{100 * way:.2f} %", way < 1e-3)
    motion = run(model, cube(size), [body("box", [0, 0, size], size)], 3.0 * sqrt(size))
    way = float(np.linalg.norm(motion.position[-1, 0, :2]) / size)
    yield ("straight drop", "lands within 0.5 % of its size", f"{100 * way:.2f} %", way < 5e-3)


def stacks(model: str, size: float) -> Iterator[Law]:
    """Towers stand, and the heavy rests on the light."""
    for count in (5, 10):
        bodies = [body(str(k), [0, 0, (k + 0.5) * size], size) for k in range(count)]
        motion = run(model, cube(size), bodies, 5.0 * sqrt(size))
        way = float(np.linalg.norm(motion.position[-1, :count] - motion.position[0, :count], axis=1).max() / size)
        yield (f"tower of {count}", "none moves a tenth of its size", f"{way:.2f} of it", way < 0.1)
    for ratio in (10, 100):
        bodies = [body(str(k), [0, 0, (k + 0.5) * size], size, mass=m * size**3) for k, m in enumerate((1.0, ratio))]
        motion = run(model, cube(size), bodies, 3.0 * sqrt(size))
        way = float(np.linalg.norm(motion.position[-1, :2] - motion.position[0, :2], axis=1).max() / size)
        yield (f"{ratio}:1 on top", "holds", f"moves {way:.2f} of its size", way < 0.1)
    motion = run(model, plank(size), tower_of_planks(size), 5.0 * sqrt(size))
    way = float(np.linalg.norm(motion.position[-1, :18] - motion.position[0, :18], axis=1).max() / size)
    yield ("six layers of three planks", "none moves a tenth of its size", f"{way:.2f} of it", way < 0.1)


def weights(model: str, size: float) -> Iterator[Law]:
    """Under the light and under the heavy, contacts push as much as the bodies above weigh."""
    for ratio in (10, 30, 100):
        bodies = [body(str(k), [0, 0, (k + 0.5) * size], size, mass=m * size**3) for k, m in enumerate((1.0, ratio))]
        scene = replace(on_floor([cube(size)], bodies), effects=Effects(sleep="off"))
        simulator = Simulator(scene, model)
        simulator.run(3.0 * sqrt(size))
        inner = simulator.dt / simulator.rules.substeps
        wanted = {"floor": (1.0 + ratio) * size**3, "1": ratio * size**3}
        off = 0.0
        for name, mass in wanted.items():
            pushed = sum(float(c.impulse[2]) for c in simulator.contact_points() if {c.first, c.second} == {"0", name})
            off = max(off, abs(abs(pushed) / (mass * float(np.linalg.norm(scene.gravity)) * inner) - 1.0))
        yield (f"{ratio}:1, impulses of contacts", "the weights within 2 %", f"{100 * off:.1f} % off", off < 0.02)


LAWS: list[Callable[[str, float], Iterator[Law]]] = [rebounds, head_on, rolling, slopes, stops, rests, stacks, weights]


def tried(model: str, size: float) -> list[Law]:
    """All laws. A law that broke the simulation is one row that does not hold."""
    found: list[Law] = []
    for law in LAWS:
        try:
            found += law(model, size)
        except SimulationError as error:
            found.append((law.__name__, "a state that is one", str(error), False))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", nargs="+", default=BUNDLED)
    models = parser.parse_args().model
    columns = {(model, size): tried(model, size) for model in models for size in SIZES}
    rows: list[tuple[str, ...]] = [("law", "wanted", *(f"{model}, {size:g} m" for model, size in columns))]
    names = dict.fromkeys((name, wanted) for found in columns.values() for name, wanted, _, _ in found)
    for name, wanted in names:
        cells = []
        for found in columns.values():
            result = next(((told, holds) for one, want, told, holds in found if (one, want) == (name, wanted)), None)
            cells.append("-" if result is None else result[0] if result[1] else f"**{result[0]}**")
        rows.append((name, wanted, *cells))
    held = [
        f"{model}: {sum(holds for size in SIZES for *_, holds in columns[model, size])} of "
        f"{sum(len(columns[model, size]) for size in SIZES)} hold"
        for model in models
    ]
    text = "; ".join(held) + ". What does not hold is bold.\n\n" + markdown(rows)
    print(text)
    if models == BUNDLED:
        write_section("laws", "python benchmarks/laws.py", text)


if __name__ == "__main__":
    run_main(main)
