"""Motions of the hard cases' scenes: with a model, with the same model in other arithmetic, or with the teacher."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sdfsim.dynamics.model import Model
from sdfsim.dynamics.precision import in_bfloat16
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, Simulator
from sdfsim.evaluation.hard_cases import Case, Variant
from sdfsim.evaluation.hard_cases_measures import Run, ran_away
from sdfsim.evaluation.hard_cases_teacher import teach
from sdfsim.scene.scene import Scene


def simulated(case: Case, scenes: list[Scene], model: Model, device: str) -> list[Run]:
    """Every scene once; where the case is about another way to compute, then once more in that way."""
    runs = [_simulated(case, scene, model, device) for scene in scenes]
    if case.variant != "float32":
        second, other_device = in_variant(model, case.variant, device)
        runs += [_simulated(case, scene, second, other_device) for scene in scenes]
    return runs


def taught(case: Case, scenes: list[Scene], folder: Path) -> list[Run]:
    """Every scene once with the teacher, whose files are in `folder`."""
    return [_checked(scene, teach(scene, folder, seconds=case.seconds, steps=case.steps)) for scene in scenes]


def _simulated(case: Case, scene: Scene, model: Model, device: str) -> Run:
    simulator = Simulator(scene, model=model, device=device)
    try:
        rollout = simulator.run(seconds=case.seconds, steps=case.steps)
    except SimulationError as error:
        return Run(scene, error.rollout, error.message)
    return _checked(scene, rollout)


def _checked(scene: Scene, rollout: Rollout) -> Run:
    """A complete motion; one that ran away is told as broken."""
    run = Run(scene, rollout)
    return replace(run, broke=ran_away(run))


def in_variant(model: Model, variant: Variant, device: str) -> tuple[Model, str]:
    """The model as a case wants it, and the device that it runs on."""
    if variant == "bfloat16":
        return replace(model, network=in_bfloat16(model.network)), device
    return model, "cuda"
