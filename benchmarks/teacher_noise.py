"""How exact a step must be for a rollout to be so: the teacher itself, disturbed at every step, against its recordings.

    python benchmarks/teacher_noise.py DATA [--split validation] [--trajectories 100] [--model small]

DATA is a movi-b dataset. Every row runs the teacher from the recorded starts and disturbs it at the end of each
recorded step: it forgets its contact points from earlier steps, bodies are displaced, or what contact did to their
velocities is changed by a part of it. A learned model that errs by as much in each of its steps can hardly do better.
The first row is the undisturbed teacher. Below the table is by how much MODEL errs in one step from a recorded state.
Needs the extra `data`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from sdfsim.data import metrics
from sdfsim.data.dataset import FLOOR, Trajectory, trajectory_files
from sdfsim.data.pybullet_sim import Teacher
from sdfsim.dynamics.model import load_model
from sdfsim.errors import run_main
from sdfsim.evaluation.baselines import engine_file, started
from sdfsim.evaluation.evaluate import score
from sdfsim.parallel import parallel
from sdfsim.training.contact_cache import contact_frames
from sdfsim.training.impulse_task import ImpulseTask

HORIZONS = (50, 100)
SHIFTS = (1e-4, 1e-3, 3e-3)  # m
PARTS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
ASIDE = 50.0  # m between bodies while contact points are forgotten
HIT = 0.25  # m/s
TOUCHED = 1e-3  # m/s, changes of velocity below which nothing has touched a body

STATE = ("position", "quat_xyzw", "velocity", "angular_velocity")
State = list[np.ndarray]  # [N, 3 or 4] each, of all bodies


@dataclass(frozen=True)
class Disturbance:
    """What is done to the teacher after each step.

    Attributes:
        name: in the table.
        forgets: contact points from earlier steps are lost.
        shift: m, standard deviation of displacements along each axis; they do not add up: the next step ends where it
            would have without them, but for what they changed.
        part: of the change of velocity by contact, standard deviation of its error over all six components together.
    """

    name: str
    forgets: bool = False
    shift: float = 0.0
    part: float = 0.0


DISTURBANCES = [
    Disturbance("none"),
    Disturbance("contact points forgotten", forgets=True),
    *(Disturbance(f"placed {1e3 * shift:g} mm off", forgets=True, shift=shift) for shift in SHIFTS),
    *(Disturbance(f"impulses {100 * part:g} % off", part=part) for part in PARTS),
]


def disturbed(t: Trajectory, how: Disturbance, urdfs: dict[str, Path], seed: list[int]) -> Trajectory:
    """The teacher's motion from the first frame of `t`, disturbed after each step."""
    rng = np.random.default_rng(seed)
    with started(t, urdfs, FLOOR) as teacher:
        states = [[getattr(t, name)[0] for name in STATE]]
        for _ in range(len(t.position) - 1):
            before = states[-1]
            shift = how.shift * rng.normal(size=before[0].shape) * ~t.static[:, None]
            if how.forgets:
                _forget(teacher, t)
                _put(teacher, t, [before[0] + shift, *before[1:]])
            step = teacher.run(1)
            after = [step[name][-1] for name in STATE]
            if how.part:
                after = _hit_otherwise(t, before, after, how.part, rng)
                _put(teacher, t, after)
            states.append([after[0] - shift, *after[1:]])
    motion = {name: np.array(values) for name, values in zip(STATE, zip(*states, strict=True), strict=True)}
    return replace(t, **motion)


def _put(teacher: Teacher, t: Trajectory, state: State) -> None:
    for i in np.flatnonzero(~t.static).tolist():
        teacher.place(i, state[0][i], state[1][i])
        teacher.push(i, state[2][i], state[3][i])


def _forget(teacher: Teacher, t: Trajectory) -> None:
    """All bodies are put apart for a moment: the engine drops what it kept of their contacts."""
    for i in np.flatnonzero(~t.static).tolist():
        teacher.place(i, np.array([ASIDE * (1 + i), ASIDE, ASIDE]), np.array([0.0, 0.0, 0.0, 1.0]))
    teacher.overlaps(0)  # makes it look


def _hit_otherwise(t: Trajectory, before: State, after: State, part: float, rng: np.random.Generator) -> State:
    """The state after a step whose contacts changed velocities by a little more, less, or elsewhere."""
    position, quat, velocity, angular = after
    lever = 0.5 * t.scale[:, None]
    hit = np.concatenate([velocity - before[2] - t.gravity * t.dt, (angular - before[3]) * lever], axis=1)
    size = np.linalg.norm(hit, axis=1, keepdims=True) * (~t.static[:, None])
    error = part * np.where(size > TOUCHED, size, 0.0) * rng.normal(size=hit.shape) / np.sqrt(6.0)
    # On average a hit falls in the middle of the step.
    return [position + 0.5 * t.dt * error[:, :3], quat, velocity + error[:, :3], angular + error[:, 3:] / lever]


def row(how: Disturbance, motions: list[Trajectory], recorded: list[Trajectory]) -> str:
    """A line of the table."""
    scores = [score(motion, truth, list(HORIZONS)) for motion, truth in zip(motions, recorded, strict=True)]
    bodies = np.array([s.bodies for s in scores])
    share = bodies / bodies.mean()
    cells = []
    for h in HORIZONS:
        squared = np.array([s.squared[h] for s in scores]) * share
        low, high = (np.sqrt(v) for v in metrics.interval(squared))
        degrees = (np.array([s.angle[h] for s in scores]) * share).mean()
        cells += [f"{np.sqrt(squared.mean()):.3f} ({low:.3f} to {high:.3f})", f"{degrees:.1f}"]
    return f"| {how.name} | " + " | ".join(cells) + " |"


def one_step(data: Path, split: str, name: str) -> str:
    """How far a model is off after one step from recorded states, in parts of what contact did to the velocities."""
    model, frames = load_model(name), contact_frames(data, split, load_model(name, weights=False).reach)
    task, errors, hits = ImpulseTask(frames, torch.device("cpu"), None), [], []
    with torch.no_grad():
        for part in np.array_split(np.arange(len(frames)), len(frames) // 64 + 1):
            batch = task.batch(part)
            found, free, lever = model.network(batch.graph), batch.graph, 0.5 * batch.size[:, None]
            off = (found.velocity - batch.truth.velocity, (found.angular - batch.truth.angular) * lever)
            hit = (batch.truth.velocity - free.free_velocity, (batch.truth.angular - free.free_angular) * lever)
            for kept, pair in ((errors, off), (hits, hit)):
                kept.append(torch.cat(pair, 1)[batch.counts].norm(dim=1))
    error, size = torch.cat(errors).numpy(), torch.cat(hits).numpy()
    part = 100 * np.sqrt(np.square(error).sum() / np.square(size).sum())
    middle = 100 * np.median(error[size > HIT] / size[size > HIT])
    return (
        f"{name}, one step from recorded states: {part:.0f} % off (root mean square of all over that of what contact "
        f"did); median of hits beyond {HIT} m/s: {middle:.0f} %"
    )


def main() -> None:
    """Command line of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="validation")
    parser.add_argument("--trajectories", type=int, default=100)
    parser.add_argument("--model", default="small", help="an impulse model")
    args = parser.parse_args()
    files = trajectory_files(args.data, args.split)[: args.trajectories]
    recorded = [Trajectory.load(f, as_recorded=True) for f in files]
    urdfs = {name: engine_file(args.data, name) for name in {str(n) for t in recorded for n in t.shape}}
    print("| each step | m, 50 steps | degrees | m, 100 steps | degrees |\n| --- | --- | --- | --- | --- |")
    for how in DISTURBANCES:
        jobs = [(t, how, urdfs, [0, k]) for k, t in enumerate(recorded)]
        done = dict(parallel(disturbed, jobs))
        print(row(how, [done[k] for k in range(len(recorded))], recorded), flush=True)
    print("\n" + one_step(args.data, args.split, args.model))


if __name__ == "__main__":
    run_main(main)
