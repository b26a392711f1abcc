"""The optimisers of a network: Muon for its hidden matrices, Adam for all else."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sdfsim.training.presets import Preset

SMALLEST = 16  # rows and columns of a matrix that counts as hidden; smaller ones are heads


class Optimiser:
    """Two optimisers that act as one.

    Muon (Jordan et al., 2024) takes steps along the nearest orthogonal matrix to the momentum, so that every direction
    of a hidden matrix learns at one pace. On contact frames a step of it was worth more than three of Adam's.
    """

    def __init__(self, network: nn.Module, plan: Preset) -> None:
        hidden = [p for p in network.parameters() if p.ndim == 2 and min(p.shape) >= SMALLEST]
        chosen = {id(p) for p in hidden} if plan.matrix_rate else set()
        others = [p for p in network.parameters() if id(p) not in chosen]
        self.parts: list[torch.optim.Optimizer] = [torch.optim.Adam(others, lr=plan.rate, fused=True)]
        self.rates = [plan.rate]
        if plan.matrix_rate:
            # Four Newton-Schulz iterations are enough for a direction, and a fifth less work than the usual five.
            muon = torch.optim.Muon(hidden, lr=plan.matrix_rate, momentum=0.95, weight_decay=0.0, ns_steps=4)
            self.parts.append(muon)
            self.rates.append(plan.matrix_rate)

    def step(self, share: float) -> None:
        """One step at `share` of the peak learning rates."""
        for part, rate in zip(self.parts, self.rates, strict=True):
            for group in part.param_groups:
                group["lr"] = share * rate
            part.step()

    def zero_grad(self) -> None:
        """Forget gradients."""
        for part in self.parts:
            part.zero_grad()

    def state(self) -> dict[str, Tensor]:
        """What it remembers, by name."""
        return {
            f"{which}/{index}/{name}": value
            for which, part in enumerate(self.parts)
            for index, slot in part.state_dict()["state"].items()
            for name, value in slot.items()
        }

    def load(self, state: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        for which, part in enumerate(self.parts):
            slots: dict[int, dict[str, Tensor]] = {}
            for key, value in state.items():
                place, index, name = key.split("/", 2)
                if int(place) == which:
                    slots.setdefault(int(index), {})[name] = value.cpu() if name == "step" else value
            part.load_state_dict({"state": slots, "param_groups": part.state_dict()["param_groups"]})
