"""What every effect costs, and what is saved where it is off: prints the table and the claims of docs/effects.md.

    python benchmarks/effects.py [--only samples|claims|always-on] [--steps 50] [--data DATA] [--paper MODEL]

DATA is a dataset folder: the default model's error on its held-out frames then stands beside what friction leaves out.
MODEL is a *paper* network: the samples then also run with every body in it in every step, as published.

Times are medians of whole steps on one thread; the two sides of a comparison take turns, so that a busy machine
slows both.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sdfsim import Simulator, load_scene
from sdfsim.dynamics.contacts import find_contacts
from sdfsim.dynamics.model import load_model
from sdfsim.dynamics.simulator import SimulationError
from sdfsim.dynamics.sleep import STEPS as SLEEP_STEPS
from sdfsim.dynamics.step import contact_graph, fly
from sdfsim.errors import run_main
from sdfsim.progress import columns
from sdfsim.scene.types import Body, Effects, Limits, Scene
from sdfsim.shape.shape import analytic_shape
from sdfsim.training.contact_cache import contact_frames
from sdfsim.training.impulse_task import ImpulseTask

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
HELD_OUT = 20  # batches of frames
SETTLE = 300  # steps after which what is not asleep is not waited for
EARTH = np.array([0.0, 0.0, -9.81])
VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "as it is": lambda scene: scene,
    "sleep on": lambda scene: replace(scene, effects=Effects(sleep="on")),
    "gravity 0": lambda scene: replace(scene, gravity=np.zeros(3)),
    "friction off": lambda scene: replace(scene, effects=Effects(friction="off")),
    "restitution off": lambda scene: replace(scene, effects=Effects(restitution="off")),
    "rotation off": lambda scene: replace(scene, effects=Effects(rotation="off")),
    "contact off": lambda scene: replace(scene, effects=Effects(contact="off")),
    "memory 0.01 GiB": lambda scene: replace(scene, limits=Limits(0.01)),
}


def body(name: str, shape: int, position, motion: str = "dynamic", **fields) -> Body:
    defaults = {"quat_xyzw": np.array([0.0, 0.0, 0.0, 1.0]), "velocity": np.zeros(3), "angular_velocity": np.zeros(3)}
    defaults |= {"scale": 1.0, "friction": 0.5, "restitution": 0.5, "mass": 1.0 if motion == "dynamic" else 0.0}
    return Body(name, shape, motion, position=np.asarray(position, dtype=float), **(defaults | fields))  # type: ignore


def scene_of(bodies: list[Body], **changes) -> Scene:
    shapes = (analytic_shape("plane"), analytic_shape("box", size=(1.0, 1.0, 1.0)))
    return Scene(shapes, tuple(bodies), gravity=EARTH, duration=1.0, **changes)


def grid(count: int, spacing: float, height: float) -> np.ndarray:
    side = int(np.ceil(count**0.5))
    place = np.stack(np.divmod(np.arange(count), side), -1) * spacing
    return np.concatenate([place, np.full((count, 1), height)], 1)


FLOOR = body("floor", 0, [0, 0, 0], "static")


def pile(count: int, layers: int = 2, spacing: float = 1.05) -> list[Body]:
    """Stacks of boxes; at the default spacing in m they are within reach of each other."""
    places = grid(count // layers, spacing, 0.5)
    return [FLOOR] + [body(f"{i}/{k}", 1, p + np.array([0, 0, k])) for i, p in enumerate(places) for k in range(layers)]


def far_scenery(count: int) -> Scene:
    far = [body(f"s{k}", 1, p + np.array([1e3, 0, 0]), "static") for k, p in enumerate(grid(count, 2.0, 0.5))]
    return scene_of([*pile(8), *far])


def thinned(count: int, touching: int) -> Scene:
    """The pile of so many bodies, of which all but the first few hang in the air, out of each other's reach."""
    bodies = pile(count)
    apart = [replace(b, position=b.position * 3 + np.array([0, 0, 500.0])) for b in bodies[1 + touching :]]
    return scene_of(bodies[: 1 + touching] + apart)


def timed(simulators: list[Simulator], steps: int) -> list[float]:
    """Median ms of a step of each, in turns, the first steps left out."""
    taken = [[] for _ in simulators]
    for k in range(steps + 3):
        for times, simulator in zip(taken, simulators, strict=True):
            ms = float(simulator.run(steps=1).counters["step_ms"][-1])
            if k >= 3:
                times.append(ms)
    return [float(np.median(times)) for times in taken]


def samples(steps: int) -> None:
    """A row for each variant of each sample: the cost of its whole run."""
    rows = [("scene", "variant", "ms a step", "distances", "waiting", "edges", "active", "asleep")]
    for file in sorted(SAMPLES.glob("*.yaml")):
        scene = load_scene(file)
        for name, change in VARIANTS.items():
            counters = Simulator(change(scene), device="cpu").run(steps=steps).counters
            values = [f"{np.median(counters['step_ms'][1:]):.2f}"]
            told = ("sdf_queries", "sdf_waiting", "edges", "active", "asleep")
            values += [f"{counters[k][1:].mean():.1f}" for k in told]
            rows.append((file.stem, name, *values))
    print("\n".join(columns(rows)))


def claims(steps: int, data: Path | None) -> None:
    """What must hold, with what was measured."""
    rows = [("claim", "measured", "wanted")]
    few, many = Simulator(far_scenery(10)), Simulator(far_scenery(10_000))
    ms = timed([few, many], steps)
    queries = [s.memory.counts["sdf_queries"] for s in (few, many)]
    rows.append(("10,000 static bodies far away against 10: time", f"{ms[1] / ms[0]:.3f}", "<= 1.05"))
    rows.append(("the same: signed distances", f"{queries[1]:.0f} against {queries[0]:.0f}", "equal"))
    ms = timed([Simulator(thinned(1000, 5)), Simulator(thinned(1000, 1000))], max(5, steps // 5))
    rows.append(("1,000 bodies of which 5 touch, against all: time", f"1/{ms[1] / ms[0]:.0f}", "<= 1/20"))
    asleep = replace(scene_of(pile(24)), effects=Effects(sleep="on"))
    awake = [Simulator(scene_of(pile(24))), Simulator(asleep)]
    ms = timed(awake, min(steps, SLEEP_STEPS - 4))
    rows.append(("sleep on, nothing asleep, against off: time", f"{ms[1] / ms[0]:.3f}", "<= 1.03"))
    rows += sleeping(scene_of(pile(200, layers=4, spacing=1.5)), "fifty towers of four", steps)
    rows += sleeping(scene_of(pile(200)), "a packed pile", steps)
    rows += frictionless(steps)
    if data:
        rows += test_error(data)
    print("\n".join(columns(rows)))


def sleeping(scene: Scene, name: str, steps: int) -> list[tuple[str, str, str]]:
    """A scene run until all of it sleeps; then its first body is poked."""
    count = len(scene.bodies) - 1
    tired = Simulator(replace(scene, effects=Effects(sleep="on")))
    try:
        while tired.memory.counts["asleep"] < count and tired.steps_done < SETTLE:
            tired.run(steps=1)
    except SimulationError as error:
        return [(f"{name} asleep", error.message, "<= 1/50")]
    asleep = int(tired.memory.counts["asleep"])
    ms = timed([tired, Simulator(scene)], max(5, steps // 5))
    label = f"{name}: {asleep} of {count} asleep after {tired.steps_done} steps, against awake: time"
    rows = [(label, f"1/{ms[1] / ms[0]:.0f}", "<= 1/50")]
    if asleep == count and tired.state.sleep is not None:
        island = tired.state.sleep.island
        velocity = tired.state.velocity.clone()
        velocity[1, 2] = 1.0
        tired.state = replace(tired.state, velocity=velocity)
        tired.run(steps=1)
        assert tired.state.sleep is not None
        woke = (tired.state.sleep.island < 0) & (island >= 0)
        exact = bool(torch.equal(woke, island == island[1]))
        told = f"one of them poked: awake is exactly its island, of {int(woke.sum())} bodies"
        rows.append((told, str(exact), "True"))
    return rows


def frictionless(steps: int) -> list[tuple[str, str, str]]:
    """Friction off against on: time, and the network's answer to a friction of 0."""
    rough = scene_of(pile(100))
    smooth = replace(rough, bodies=tuple(replace(b, friction=0.0) for b in rough.bodies))
    one, other = Simulator(smooth), Simulator(rough)
    ms = timed([one, other], max(5, steps // 3))
    free = fly(one.bodies, one.state, one.rules)
    reach, dt = one.model.reach, one.rules.dt
    contacts = find_contacts(one.bodies, one.state, one.rules.gravity, reach, dt, thin=True)
    graph = contact_graph(one.bodies, one.state, free, contacts, one.rules)[1]
    with torch.no_grad():
        left, full = one.model.network(graph, friction=False), one.model.network(graph, friction=True)
    apart = float((left.velocity - full.velocity).norm(dim=-1).mean()) * one.units.velocity
    return [
        ("friction off against on: time", f"{ms[0] / ms[1]:.3f}", "< 1"),
        ("tangential change of velocity that the network gives at friction 0", f"{apart:.4f} m/s", "small"),
    ]


def test_error(data: Path) -> list[tuple[str, str, str]]:
    """The default model's error of one step on held-out frames: what a difference of its answers compares with."""
    model = load_model()
    task = ImpulseTask(contact_frames(data, "validation", model.reach), torch.device("cpu"), None)
    rng, errors = np.random.default_rng(0), []
    with torch.no_grad():
        for _ in range(HELD_OUT):
            batch = task.batch(rng.choice(len(task.frames), size=64))
            error = (model.network(batch.graph).velocity - batch.truth.velocity).norm(dim=-1)
            errors.append(error[batch.counts])
    told = f"{float(torch.cat(errors).mean()):.4f} m/s"
    return [("error of a step's velocity on held-out frames, bodies in contact", told, "the scale of the above")]


def always_on(paper: Path, steps: int) -> None:
    """Each sample with every body in the network in every step, as published, against as planned."""
    rows = [("scene", "published, ms a step", "only in contact", "ratio", "impulse network", "ratio")]
    for file in sorted(SAMPLES.glob("*.yaml")):
        scene = load_scene(file)
        published = Simulator(scene, paper, free_flight="learned")
        ms = timed([published, Simulator(scene, paper), Simulator(scene)], max(5, steps))
        rows.append((file.stem, f"{ms[0]:.1f}", f"{ms[1]:.1f}", f"{ms[0] / ms[1]:.2f}", f"{ms[2]:.2f}"))
        rows[-1] += (f"{ms[0] / ms[2]:.1f}",)
    print("\n".join(columns(rows)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("samples", "claims", "always-on"))
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--paper", type=Path)
    chosen = parser.parse_args()
    if chosen.only == "always-on" and chosen.paper is None:
        parser.error("--only always-on needs --paper")
    torch.set_num_threads(1)
    if chosen.only in (None, "samples"):
        samples(chosen.steps)
        print()
    if chosen.only in (None, "claims"):
        claims(chosen.steps, chosen.data)
    if chosen.only in (None, "always-on") and chosen.paper:
        always_on(chosen.paper, chosen.steps)


if __name__ == "__main__":
    run_main(main)
