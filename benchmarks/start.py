"""Time and memory of a command from a cold start to its end, and of a falling box: RESULTS.md.

    python -m benchmarks start [--rounds 7]

Every case is a separate process, and all alternate; figures are medians. Compiled code and other files on disk exist
from a first round, which is left out. Processor time estimates the time on an idle machine. The first rows are the very
first runs after an install, once each, one after another: what one has compiled the next one loads.
"""

import os
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks.records import ROOT, in_turn, write_record
from sdfsim.base.errors import SdfsimError

OURS = """
import sdfsim
scene = sdfsim.Scene(model="solver")
scene.add("box", box={"size": (0.2, 0.2, 0.2)}, position=(0, 0, 2), mass=1.0).add("floor", plane={})
sdfsim.Simulator(scene).run(0.4)
"""
MUJOCO = """
import mujoco
box = '<body pos="0 0 2"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
text = f'<mujoco><worldbody><geom type="plane" size="9 9 1"/>{box}</worldbody></mujoco>'
model = mujoco.MjModel.from_xml_string(text)
data = mujoco.MjData(model)
while data.time < 0.4:
    mujoco.mj_step(model, data)
"""

FIRST = {
    "tower": "the very first run: `sdfsim simulate samples/tower.yaml --viewer none`",
    "spheres_in_bowl": "then the first with a hollow shape, `spheres_in_bowl.yaml`",
    "ragdoll": "then the first with joints, `ragdoll.yaml`",
}

# A process inherits its parent's peak memory, so a small process starts each case.
LAUNCH = """
import resource, subprocess, sys, time
began = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""


def ended(command: list[str], **variables: str) -> tuple[float, ...]:
    """Wall-clock and processor seconds of a command, and its peak MiB. Raises SdfsimError if it fails."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"} | variables
    started = [sys.executable, "-c", LAUNCH, *command]
    done = subprocess.run(started, cwd=ROOT, env=kept, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SdfsimError(f"{' '.join(command)}: failed")
    return tuple(map(float, done.stdout.split()))


def main(*, rounds: int = 7) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        ours = [sys.executable, "-c", "from cli import app; app()"]
        tower = [*ours, "simulate", "samples/tower.yaml", "-o", f"{scratch}/tower"]
        cases = {
            "`sdfsim --help`": [*ours, "--help"],
            "`sdfsim simulate samples/tower.yaml --viewer none`": [*tower, "--viewer", "none"],
            "the same with a recording": tower,
            "a box that falls for 0.4 s": [sys.executable, "-c", OURS],
            "the same in MuJoCo": [sys.executable, "-c", MUJOCO],
        }
        compiled = {
            name: ended([*ours, "simulate", f"samples/{sample}.yaml", "-o", f"{scratch}/{sample}", "--viewer", "none"],
                        NUMBA_CACHE_DIR=f"{scratch}/kernels")
            for sample, name in FIRST.items()
        }  # fmt: skip
        found = np.median(in_turn([lambda some=some: ended(some) for some in cases.values()], rounds), axis=0)
    results = compiled | dict(zip(cases, found, strict=True))
    measured = f"Separate processes that alternate, medians of {rounds}; the first three ran once, after an install."
    rows = [(name, *values) for name, values in results.items()]
    write_record("start", "python -m benchmarks start", measured, ("cold start", "s", "processor s", "MiB"), rows)
