"""One training run: everything that changes during training, and how it is saved."""

import json
import math
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import read_arrays, write_arrays
from sdfsim.training.batches import moved
from sdfsim.training.presets import Preset

EMA_DECAY = 0.999
CLIP = 1.0
BAD_BATCHES = 20  # consecutive batches without a finite gradient before training gives up
SMALLEST = 16  # rows and columns of a matrix that counts as hidden; smaller ones are heads


class Run:
    """Everything that changes during training, and how to save it.

    The task is an `ImpulseTask` or a `SurfaceTask`. The learning rate depends on `total`, the
    optimiser's steps of the whole run.
    """

    def __init__(
        self, plan: Preset, task: Any, total: int, seed: int, device: torch.device,
    ) -> None:  # fmt: skip
        from sdfsim.learned.model import new_network

        torch.manual_seed(seed)
        self.plan, self.task, self.total, self.seed, self.device = plan, task, total, seed, device
        self.origin = {"plan": json.loads(json.dumps(asdict(plan))), "seed": seed, "data": task.digest()}
        self.network: nn.Module = new_network(plan.kind, plan.config)
        self.network = self.network.to(device)
        if hasattr(task, "prepare"):
            task.prepare(self.network, np.random.default_rng([seed, 1]), device)
        # Only trained weights are averaged; feature statistics are fixed before the first step.
        self.weights = dict(self.network.named_parameters())
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimiser = Optimiser(self.network, plan)
        self.step, self.seconds, self.loss, self.skipped = 0, 0.0, math.nan, 0

    def advance(self) -> None:
        """One optimiser step on the step's batch."""
        rng = np.random.default_rng([self.seed, 0, self.step])  # the batch depends only on the seed and the step
        mirrored = bool(rng.integers(2))
        batch = moved(self.task.draw(rng, self.plan.batch), self.device)
        loss = self.task.loss(self.network, batch, mirrored=mirrored)
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), CLIP)
        if bool(norm.isfinite()):
            self.optimiser.step(self.share())
            self.skipped = 0
        else:
            self.skipped += 1
            if self.skipped >= BAD_BATCHES:
                raise SdfsimError(f"training diverged at step {self.step}: no finite gradient in {BAD_BATCHES} batches")
        self.step += 1
        value = float(loss.detach())
        self.loss = value if math.isnan(self.loss) else 0.99 * self.loss + 0.01 * value
        decay = min(EMA_DECAY, (1.0 + self.step) / (10.0 + self.step))
        follow = get_ema_multi_avg_fn(decay)
        follow([self.average[name] for name in self.weights], list(self.weights.values()), self.step)

    def share(self) -> float:
        """Factor on the peak learning rates: a warm-up over 2 % of all steps, at most 1000, then a cosine down to a
        hundredth."""
        warm = min(1.0, (self.step + 1) / max(1.0, min(1000.0, 0.02 * self.total)))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / self.total)))
        return warm * (0.01 + 0.99 * fall)

    def averaged(self) -> nn.Module:
        network = deepcopy(self.network)
        network.load_state_dict(self.average)
        return network.eval().requires_grad_(False)

    def save(self, path: Path) -> None:
        """Write everything, as arrays only: nothing is pickled."""
        states = {"network": self.network.state_dict(), "average": self.average, "optimiser": self.optimiser.state()}
        arrays = {f"{of}/{name}": value.cpu().numpy() for of, state in states.items() for name, value in state.items()}
        progress = {name: getattr(self, name) for name in ("step", "seconds", "loss", "total", "skipped")}
        write_arrays(path, arrays | {"run": np.array(json.dumps(self.origin | progress))}, compressed=False)

    def load(self, path: Path) -> None:
        """Load a saved run. Raises SdfsimError if it has another preset, seed or data, or is unreadable."""
        arrays = read_arrays(path, "a checkpoint", "delete it to start again")
        try:
            info: dict[str, Any] = json.loads(str(arrays.pop("run")))
            if any(info[name] != self.origin[name] for name in ("plan", "seed")) or info["total"] != self.total:
                raise SdfsimError(f"{path} belongs to another preset, seed or number of steps", "choose another -o")
            if info["data"] != self.origin["data"]:
                raise SdfsimError(f"{path} was trained on other data", "give the same --data, or choose another -o")
            states: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "optimiser": {}}
            for key, value in arrays.items():
                of, name = key.split("/", 1)
                states[of][name] = torch.from_numpy(value).to(self.device)
            self.network.load_state_dict(states["network"])
            self.average = states["average"]
            self.optimiser.load(states["optimiser"])
            self.step, self.seconds, self.loss = info["step"], info["seconds"], info["loss"]
            self.skipped = info["skipped"]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SdfsimError(
                f"{path}: not a checkpoint of this training: {error}", "delete it to start again"
            ) from error

    def export(self, name: str, data: list[dict[str, Any]]):
        """The averaged weights as a `Model`; `data` describes the datasets in its card."""
        from sdfsim.learned.model import Model

        card = {
            "data": data,
            "seed": self.seed,
            "optimiser_steps": self.step,
            "seconds": round(self.seconds),
            "threads": torch.get_num_threads(),
            "device": str(self.device),
            "preset_name": name,
            "preset": asdict(self.plan),
        }
        return Model(
            name=name,
            kind=self.plan.kind,
            network=self.averaged(),
            dt=self.task.dt,
            gravity=self.task.gravity,
            length=self.task.length,
            reach=self.plan.reach,
            nodes=self.plan.nodes,
            ranges=self.task.ranges(),
            card=card,
        )


class Optimiser:
    """Muon for the hidden matrices of a network, Adam for all other parameters.

    Muon (Jordan et al., 2024) makes steps along the orthogonal matrix nearest to the momentum, so that all directions
    of a hidden matrix learn at the same pace. On contact frames the loss is lower by a quarter after as many steps.
    """

    def __init__(self, network: nn.Module, plan: Preset) -> None:
        hidden = [p for p in network.parameters() if p.ndim == 2 and min(p.shape) >= SMALLEST]
        chosen = {id(p) for p in hidden} if plan.matrix_rate else set()
        others = [p for p in network.parameters() if id(p) not in chosen]
        self.parts: list[torch.optim.Optimizer] = [torch.optim.Adam(others, lr=plan.rate, fused=True)]
        self.rates = [plan.rate]
        if plan.matrix_rate:
            # Four Newton-Schulz iterations are enough for a direction, and cost a fifth less than the usual five.
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
        for part in self.parts:
            part.zero_grad()

    def state(self) -> dict[str, Tensor]:
        return {
            f"{which}/{index}/{name}": value
            for which, part in enumerate(self.parts)
            for index, slot in part.state_dict()["state"].items()
            for name, value in slot.items()
        }

    def load(self, state: dict[str, Tensor]) -> None:
        for which, part in enumerate(self.parts):
            slots: dict[int, dict[str, Tensor]] = {}
            for key, value in state.items():
                place, index, name = key.split("/", 2)
                if int(place) == which:
                    slots.setdefault(int(index), {})[name] = value.cpu() if name == "step" else value
            part.load_state_dict({"state": slots, "param_groups": part.state_dict()["param_groups"]})


def held_out_loss(run: Run, task: Any, batches: int = 8) -> float:
    """Loss of the averaged weights on a fixed set of held-out batches."""
    network, rng = run.averaged(), np.random.default_rng(12345)
    with torch.no_grad():
        losses = [float(task.loss(network, moved(task.draw(rng, 64), run.device))) for _ in range(batches)]
    return float(np.mean(losses))
