"""The time of a step with each effect on and off: RESULTS.md.

    python -m benchmarks effects

Sample scenes with one effect at a time switched off; one thread, processor time, medians of five runs of 300 steps.
"The same" means that the bodies end at the same places as with all effects on, to a hundredth of their size.
"""

from dataclasses import fields, replace

import numpy as np

from benchmarks.records import ROOT, write_record
from sdfsim.evaluation.engines import timed_rollout
from sdfsim.evaluation.harness import number, one_thread
from sdfsim.physics.bodies import largest_extent
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import Scene
from sdfsim.simulate.simulator import Simulator

SCENES = ("pile", "tower", "spheres_in_bowl")
STEPS, REPEATS = 300, 5


def cost(scene: Scene) -> tuple[float, np.ndarray]:
    """Milliseconds a step, and [N, 3] m where the bodies end."""
    simulator, taken, end = Simulator(scene), [], np.zeros((0, 3))
    for _ in range(REPEATS):
        simulator.reset()
        rollout, timing = timed_rollout(simulator, STEPS)
        taken.append(timing.cpu_ms)
        end = rollout.position[-1]
    return float(np.median(taken)), end


def main() -> None:
    rows = []
    for name in SCENES:
        scene = load_scene(ROOT / "samples" / f"{name}.yaml")
        size = min(largest_extent(scene.shapes[b.shape]) * b.scale for b in scene.bodies if b.motion == "dynamic")
        with one_thread():
            usual, there = cost(scene)
            rows.append((name, "nothing", usual, 1, ""))
            for effect in (field.name for field in fields(scene.effects)):
                ms, end = cost(replace(scene, effects=replace(scene.effects, **{effect: "off"})))
                away = float(np.linalg.norm(end - there, axis=1).max()) / size
                shift = "the same" if away < 0.01 else f"up to {number(away, 2)} sizes away"
                rows.append((name, effect, ms, ms / usual, shift))
    columns = ("scene", "off", "ms a step", "relative to all on", "where bodies end")
    measured = f"Samples with one effect off at a time, {STEPS} steps on one thread, medians of {REPEATS} runs."
    write_record("effects", "python -m benchmarks effects", measured, columns, rows)
