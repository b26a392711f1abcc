"""Time of joints compared with MuJoCo: a chain of a hundred links, and the ragdoll on its stairs: docs/joints.md.

    python -m benchmarks joints

Rows are the equations of joints: three for a ball, five for a hinge. MuJoCo gets the scenes from `export`: it works in
joint coordinates, at our inner step, with its implicit integrator and its Newton solver. Both alternate, and times are
medians of processor time on one thread.
"""

import math
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.records import ROOT, write_record
from sdfsim import Scene, Simulator, load_scene
from sdfsim.apps.mujoco_world import MujocoWorld
from sdfsim.evaluation.engines import timed
from sdfsim.evaluation.harness import one_thread

ROWS = {"hinge": 5, "slider": 5, "ball": 3, "fixed": 6, "distance": 1}
SECONDS, ROUNDS = 2.0, 7


def chain(folder: Path, count: int = 100) -> Path:
    """Links that are released from a level line, fixed at one end."""
    built = Scene(model="solver", effects={"sleep": "off", "contact": "off"})
    for k in range(count):
        form = {"shape": "link0"} if k else {"box": {"size": (0.05, 0.01, 0.01)}}
        built.add(f"link{k}", **form, position=(0.05 * k + 0.025, 0, 0), mass=0.02)
        built.join(f"joint{k}", "ball", f"link{k}", f"link{k - 1}" if k else "world", anchor=(0.05 * k, 0, 0))
    return built.save(folder / "chain.yaml")


def costs(file: Path) -> tuple[float, float, float]:
    """Processor milliseconds per simulated second for ours and for MuJoCo, and the inner step in ms."""
    scene = load_scene(file)
    simulator = Simulator(scene)
    inner = simulator.dt / simulator.options.substeps
    world = MujocoWorld(scene, inner)
    taken = []
    for _ in range(ROUNDS):
        simulator.reset()
        ours = timed(simulator.step, simulator.steps_in(SECONDS)).cpu_ms / simulator.dt
        world.reset()
        theirs = timed(world.advance, math.ceil(SECONDS / inner)).cpu_ms / inner
        taken.append((ours, theirs))
    ours, theirs = np.median(taken, axis=0).tolist()
    return ours, theirs, 1e3 * inner


@one_thread()
def main() -> None:
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, file in {"chain of 100": chain(Path(scratch)), "ragdoll": ROOT / "samples" / "ragdoll.yaml"}.items():
            joints = load_scene(file).joints
            held = sum(ROWS[joint.kind] for joint in joints)
            *taken, inner = costs(file)
            each = [1e3 * took / (held * 1e3 / inner) for took in taken]
            rows.append((name, len(joints), held, inner, *taken, *each))
    columns = ("scene", "joints", "rows", "inner step, ms", "ms per s", "ms per s in MuJoCo")
    measured = f"Processor time on one thread, medians of {ROUNDS} alternating runs."
    write_record("joints", "python -m benchmarks joints", measured, (*columns, "us a row", "us a row in MuJoCo"), rows)
