"""Steps a second of environments for learning, alone and many at once, beside MuJoCo's threaded rollout.

    python -m benchmarks learn [--rounds 5] [--memory 1000000]

A step is an action: 0.1 s under random targets, from the start of the scene, without resets. MuJoCo runs the exported
scene in its own steps of 2 ms (`mujoco.rollout`). The two engines take turns.
"""

import gc
import os
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from benchmarks.records import ROOT, in_turn, spread, write_record
from sdfsim.apps.mujoco_world import MujocoWorld
from sdfsim.envs import Grasp, Push
from sdfsim.scene.builder import SceneBuilder

STEP, ACTIONS = 0.002, 3  # s, of MuJoCo; in each measurement
WORLDS = 128  # of each Dask worker


def on_table(**body: object) -> SceneBuilder:
    made = SceneBuilder(model="solver")
    made.add("table", box={"size": [1.0, 0.8, 0.04]}, position=(0, 0, 0.38), motion="static")
    return made.add("body", mass=0.3, **body)  # type: ignore[arg-type]


BOX = {"box": {"size": [0.07, 0.07, 0.1]}, "position": (0, 0, 0.45)}
VASE = {"asset": str(ROOT / "samples" / "shapes" / "vase"), "scale": 0.4}
SCENES = {
    "push a vase (hollow)": lambda: (Push, on_table(position=(0, 0, 0.4), **VASE)),
    "push a can": lambda: (Push, None),
    "push a box": lambda: (Push, on_table(**BOX)),
    "lift a box, arm with gripper": lambda: (Grasp, on_table(**BOX)),
}


def rates(task: type, scene: object, worlds: int, threads: int) -> list[Callable[[], float]]:
    """Measures actions a second: of sdfsim, of MuJoCo."""
    import mujoco.rollout

    env = task(worlds, scene=scene, threads=threads)
    batch, every, rng = env.batch, round(env.period / env.batch.dt), np.random.default_rng(0)
    targets = rng.uniform(-0.05, 0.15, (ACTIONS, worlds, len(batch.columns)))
    other = MujocoWorld(env.batch.scene, STEP)
    model, count = other.model, round(env.period / STEP)
    names = [entry.split(" ")[1] for entry in batch.columns]
    control = np.zeros((worlds, ACTIONS * count, model.nu))
    control[:, :, [model.actuator(f"{name}_motor").id for name in names]] = np.repeat(targets, count, 0).swapaxes(0, 1)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.empty(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, other.data, start, full)
    data = [mujoco.MjData(model) for _ in range(threads)]
    begin = np.repeat(start[None], worlds, 0)

    def ours() -> float:
        batch.reset()
        began = time.perf_counter()
        for actions in targets:
            batch.step(actions, every)
        return ACTIONS * worlds / (time.perf_counter() - began)

    def theirs() -> float:
        began = time.perf_counter()
        mujoco.rollout.rollout(model, data, begin, control)
        return ACTIONS * worlds / (time.perf_counter() - began)

    return [ours, theirs]


@cache
def pushed() -> Push:
    return Push(WORLDS, threads=1)


def acted(seed: int) -> None:
    """A task of a Dask worker: each has worlds of its own."""
    pushed().reset(seed=seed)
    for _ in range(10 * ACTIONS):
        pushed().step(np.zeros((WORLDS, 2), np.float32))


def on_workers(count: int) -> float:
    """Actions a second of Dask workers with one thread each."""
    from distributed import Client, LocalCluster

    local: Any = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address="")
    with local, Client(local) as client:
        places = list(client.scheduler_info()["workers"])
        for _ in range(2):  # the first time each makes its worlds
            began = time.perf_counter()
            client.gather([client.submit(acted, k, workers=[at], pure=False) for k, at in enumerate(places)])
    return count * 10 * ACTIONS * WORLDS / (time.perf_counter() - began)


def grown(steps: int) -> float:
    """MiB that a process grows by in `steps` steps of dt in all worlds together, with resets."""
    env, worlds = Push(100), 100
    sizes = []
    for k in range(max(2, steps // (worlds * 10))):
        env.step(np.full((worlds, 2), np.sin(k), np.float32))
        if k % 20 == 0:
            gc.collect()
            with open("/proc/self/statm") as file:
                sizes.append(int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20)
    return sizes[-1] - sizes[min(3, len(sizes) - 1)]


def main(*, rounds: int = 5, memory: int = 1_000_000) -> None:
    rows = []
    for name, make in SCENES.items():
        for worlds, threads in ((1, 1), (256, 1), (256, 2)):
            found = in_turn(rates(*make(), worlds, threads), rounds).T
            rows.append(
                [f"{name}: {worlds} worlds, {threads} threads", *map(spread, found), spread(found[0] / found[1])]
            )
    pictured = Push(1, obs_type="pixels")
    pictured.batch.image(pictured.camera, 0)  # the first one prepares the rays
    spent = time.perf_counter()
    for _ in range(20):
        pictured.batch.image(pictured.camera, 0)
    image = (time.perf_counter() - spent) / 20
    rows.sort(key=lambda row: row[3][0])
    rows += [
        [f"push a can: {WORLDS} worlds on each of {count} Dask workers", on_workers(count), "", ""] for count in (1, 2)
    ]
    notes = [
        "Dask workers have one thread each; their worlds begin anew at the end of each episode.",
        f"An image of 96 x 96 px takes {1e3 * image:.1f} ms of one core.",
        f"Memory grew by {grown(memory):.1f} MiB over {memory:,} steps of 0.01 s with resets, of 100 worlds.",
    ]
    columns = ("task", "sdfsim, actions/s", "MuJoCo, actions/s", "sdfsim / MuJoCo")
    write_record("learn", "python -m benchmarks learn", str(__doc__).rpartition("\n\n")[2].strip().replace("\n", " "),
                 columns, rows, notes)  # fmt: skip
