"""Motions of the hard cases' scenes: with a model, with the same model in other arithmetic, or with the teacher."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from sdfsim.dynamics.model import Model
from sdfsim.dynamics.rollout import Rollout
from sdfsim.dynamics.simulator import SimulationError, Simulator
from sdfsim.scene.types import Scene
from sdfsim.studies.hard_cases import Case, Variant
from sdfsim.studies.hard_cases_measures import Run, ran_away
from sdfsim.studies.hard_cases_teacher import teach


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
        return replace(model, network=Reduced(model.network)), device
    return model, "cuda"


class Reduced(nn.Module):
    """A network whose linear layers are computed in bfloat16, as mixed-precision inference does; the rest is as it was.

    Args:
        network: stays as it is.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """As the network's own."""
        hooks = [m.register_forward_hook(_in_bfloat16) for m in self.network.modules() if isinstance(m, nn.Linear)]
        try:
            return self.network(*args, **kwargs)
        finally:
            for hook in hooks:
                hook.remove()


def _in_bfloat16(layer: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> torch.Tensor:
    assert isinstance(layer, nn.Linear)
    bias = None if layer.bias is None else layer.bias.bfloat16()
    return nn.functional.linear(inputs[0].bfloat16(), layer.weight.bfloat16(), bias).to(output.dtype)
