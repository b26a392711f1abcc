"""Which laws of a school book hold for a model: rebound, rolling, sliding, resting, stacks, each in closed form.

    python benchmarks/laws.py [--model MODEL ...]

Every law is tried for bodies of 2 cm, 10 cm and 1 m, lengths and times scaled with them, and from several starts that
differ by a few percent where one could be lucky. A few minutes a model. With the bundled models (no --model) the table
goes to RESULTS.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import atan, cos, degrees, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.results import script, write_section
from sdfsim.evaluation import hard_cases
from sdfsim.evaluation.hard_cases import PLANK, ball, box, on_floor
from sdfsim.evaluation.harness import markdown
from sdfsim.physics.rollout import Rollout
from sdfsim.scene.scene import Body, Effects
from sdfsim.shape.shape import Shape
from sdfsim.simulate.simulator import SimulationError, Simulator

G = 9.81  # m/s^2
SIZES = (0.02, 0.1, 1.0)  # m
BUNDLED = ["solver", "small"]
STARTS = (0.95, 0.98, 1.0, 1.03, 1.07)

Law = tuple[str, str, str, bool]  # what it is about, what is wanted, what came out, and whether that is as wanted


def body(name: str, position: Sequence[float], size: float, **fields: Any) -> Body:
    """A body of the density of water, `position` in its sizes."""
    usual = {"mass": 1000.0 * size**3, "friction": 0.5}
    return hard_cases.body(name, 0, size * np.array(position, dtype=float), **(usual | fields))


def run(
    model: str, shape: Shape, bodies: list[Body], seconds: float, *, tilt: float = 0.0, weight: float = 1.0
) -> Rollout:
    """Bodies of one shape on a floor whose coefficients are 1; gravity leans by `tilt` degrees to +x."""
    scene = on_floor([shape], bodies, tilt=tilt, friction=1.0, restitution=1.0)
    gravity = weight * G * scene.gravity / np.linalg.norm(scene.gravity)
    return Simulator(replace(scene, gravity=gravity, effects=Effects()), model).run(seconds)


def farthest(motion: Rollout, size: float) -> float:
    """How far, in sizes, a body is at most from where it began."""
    return float(np.linalg.norm(motion.position[-1] - motion.position[0], axis=1).max() / size)


def rebounds(model: str, size: float) -> Iterator[Law]:
    """A ball that is dropped from about its own size comes back to e^2 of the height."""
    for e in (0.3, 0.5, 0.7, 0.9, 1.0):
        found = []
        for start in STARTS:
            height = start * size
            one = body("ball", [0, 0, 0.5 + start], size, restitution=e)
            motion = run(model, ball(size), [one], 3.0 * sqrt(2 * height / G))
            z = motion.position[:, 0, 2] - size / 2
            found.append(z[int(np.argmax(motion.velocity[:, 0, 2] > 0)) :].max() / height)
        mean, spread = float(np.mean(found)), float(np.std(found))
        holds = abs(mean - e**2) <= 0.15 * e**2 + 0.02 and spread < 0.05
        yield f"rebound, e = {e}", f"{e**2:.2f}, spread below 0.05", f"{mean:.2f} +- {spread:.2f}", holds


def head_on(model: str, size: float) -> Iterator[Law]:
    """Two equal balls that meet in free space part at e times the speed; momentum stays."""
    e, parts, drift = 0.8, [], 0.0
    for speed in (0.3, 1.0, 3.0):
        v = speed * sqrt(size)
        bodies = [
            body(name, [x, 0, 10], size, velocity=np.array([-np.sign(x) * v / 2, 0, 0]), restitution=sqrt(e))
            for name, x in (("a", -0.7), ("b", 0.7))
        ]
        after = run(model, ball(size), bodies, 1.2 * size / v, weight=0.0).velocity[-1, :2, 0]
        parts.append(float(after[1] - after[0]) / (e * v))
        drift = max(drift, float(np.abs(after.sum()) / v))
    told = ", ".join(f"{part:.2f}" for part in parts)
    holds = all(abs(part - 1) < 0.1 for part in parts) and drift < 1e-5
    yield "head-on, e = 0.8", "separation e v within 10 %", f"{told} of it, momentum to {drift:.0e}", holds


def rolling(model: str, size: float) -> Iterator[Law]:
    """A ball that rolls keeps its speed."""
    v = 0.5 * sqrt(size)
    spin = np.array([0.0, v / (size / 2), 0.0])
    one = body("ball", [0, 0, 0.5], size, velocity=np.array([v, 0, 0]), angular_velocity=spin)
    kept = float(np.linalg.norm(run(model, ball(size), [one], 3.0 * sqrt(size)).velocity[-1, 0]) / v)
    yield "rolling on", "keeps 90 to 101 %", f"{100 * kept:.0f} %", 0.9 <= kept <= 1.01


def slopes(model: str, size: float) -> Iterator[Law]:
    """Down slopes: a ball by 5/7 g sin a, a box by g (sin a - mu cos a), or not at all."""
    t, mu = 1.5 * sqrt(size), 0.4

    def way(shape: Shape, angle: float, friction: float) -> float:
        one = body("body", [0, 0, 0.5], size, friction=friction)
        return float(run(model, shape, [one], t, tilt=angle).position[-1, 0, 0])

    share = 2 * way(ball(size), 10, 0.5) / t**2 / (5 / 7 * G * sin(radians(10)))
    yield "ball down 10 degrees", "5/7 g sin a within 10 %", f"{share:.2f} of it", abs(share - 1) < 0.1
    angle = 0.9 * degrees(atan(mu))
    held = way(box(size), angle, mu) / size
    yield f"box on {angle:.0f} degrees, mu = {mu}", "holds", f"{held:.3f} of its size", held < 0.01
    angle = 1.3 * degrees(atan(mu))
    share = 2 * way(box(size), angle, mu) / t**2 / (G * (sin(radians(angle)) - mu * cos(radians(angle))))
    wanted = "slides by g (sin a - mu cos a) within 10 %"
    yield f"box on {angle:.0f} degrees, mu = {mu}", wanted, f"{share:.2f} of it", abs(share - 1) < 0.1


def stops(model: str, size: float) -> Iterator[Law]:
    """A sliding box stops after v^2 / (2 mu g)."""
    mu, v = 0.4, 2.0 * sqrt(size)
    one = body("box", [0, 0, 0.5], size, friction=mu, velocity=np.array([v, 0, 0]))
    motion = run(model, box(size), [one], 2.0 * v / (mu * G))
    share = float(motion.position[-1, 0, 0] / (v**2 / (2 * mu * G)))
    yield "box slides to a stop", "after v^2 / (2 mu g) within 10 %", f"{share:.2f} of it", abs(share - 1) < 0.1


def rests(model: str, size: float) -> Iterator[Law]:
    """What lies stays, with no speed; what falls straight lands where it was let go."""
    motion = run(model, box(size), [body("box", [0, 0, 0.5], size)], 10.0 * sqrt(size))
    speed = float(np.linalg.norm(motion.velocity[len(motion) // 2 :, 0], axis=1).max()) / sqrt(size)
    yield "box at rest", "slower than 1 cm/s per sqrt(m)", f"{100 * speed:.2f} cm/s", speed < 0.01
    way = farthest(motion, size)
    yield "box at rest, ten seconds", "moves 0.1 % of its size", f"{100 * way:.2f} %", way < 1e-3
    motion = run(model, box(size), [body("box", [0, 0, 1], size)], 3.0 * sqrt(size))
    way = float(np.linalg.norm(motion.position[-1, 0, :2]) / size)
    yield "straight drop", "lands within 0.5 % of its size", f"{100 * way:.2f} %", way < 5e-3


def pillar(size: float, masses: Sequence[float]) -> list[Body]:
    """Cubes on top of each other; masses are those of cubes of a metre."""
    return [body(str(k), [0, 0, k + 0.5], size, mass=mass * size**3) for k, mass in enumerate(masses)]


def stacks(model: str, size: float) -> Iterator[Law]:
    """Towers stand, and the heavy rests on the light."""
    for count in (5, 10):
        way = farthest(run(model, box(size), pillar(size, [1000.0] * count), 5.0 * sqrt(size)), size)
        yield f"tower of {count}", "none moves a tenth of its size", f"{way:.2f} of it", way < 0.1
    for ratio in (10, 100):
        way = farthest(run(model, box(size), pillar(size, (1.0, ratio)), 3.0 * sqrt(size)), size)
        yield f"{ratio}:1 on top", "holds", f"moves {way:.2f} of its size", way < 0.1
    scale = size / PLANK[0]
    planks = [
        replace(one, position=scale * one.position, mass=20.0 * size**3) for one in hard_cases.planks().bodies[:-1]
    ]
    way = farthest(run(model, box(*(scale * side for side in PLANK)), planks, 5.0 * sqrt(size)), size)
    yield "six layers of three planks", "none moves a tenth of its size", f"{way:.2f} of it", way < 0.1


def weights(model: str, size: float) -> Iterator[Law]:
    """Under the light and under the heavy, contacts push as much as the bodies above weigh."""
    for ratio in (10, 30, 100):
        scene = replace(on_floor([box(size)], pillar(size, (1.0, ratio))), effects=Effects(sleep="off"))
        simulator = Simulator(scene, model)
        simulator.run(3.0 * sqrt(size))
        inner = simulator.dt / simulator.options.substeps
        off = 0.0
        for name, mass in {"floor": (1.0 + ratio) * size**3, "1": ratio * size**3}.items():
            pushed = sum(float(c.impulse[2]) for c in simulator.contact_points() if {c.first, c.second} == {"0", name})
            off = max(off, abs(abs(pushed) / (mass * float(np.linalg.norm(scene.gravity)) * inner) - 1.0))
        yield f"{ratio}:1, impulses of contacts", "the weights within 2 %", f"{100 * off:.1f} % off", off < 0.02


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


def main(*, model: list[str] = BUNDLED) -> None:
    found = {(name, size): tried(name, size) for name in model for size in SIZES}
    rows: dict[tuple[str, str], list[str]] = {}
    for column, laws in enumerate(found.values()):
        for law, wanted, told, holds in laws:
            rows.setdefault((law, wanted), ["-"] * len(found))[column] = told if holds else f"**{told}**"
    held = []
    for name in model:
        laws = [law for size in SIZES for law in found[name, size]]
        held.append(f"{name}: {sum(law[-1] for law in laws)} of {len(laws)} hold")
    head = ("law", "wanted", *(f"{name}, {size:g} m" for name, size in found))
    table = markdown([head, *((*law, *cells) for law, cells in rows.items())])
    text = f"{'; '.join(held)}. What does not hold is bold.\n\n{table}"
    if model == BUNDLED:
        write_section("laws", "python benchmarks/laws.py", text)
    else:
        print(text)


if __name__ == "__main__":
    script(__doc__, main)
