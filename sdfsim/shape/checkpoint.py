"""Resuming a fit that was cut off."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch

from sdfsim.shape.mesh import Mesh
from sdfsim.shape.soap import Soap
from sdfsim.shape.storage import write


class Checkpoint:
    """The state of a running fit in one safetensors file, with a fingerprint of what is being fitted.

    Args:
        path: of the file.
        settings: everything but the geometry that decides the result.
        surface: the geometry.
    """

    def __init__(self, path: Path, settings: str, surface: Mesh) -> None:
        self.path = path
        digest = hashlib.sha256(settings.encode())
        digest.update(np.ascontiguousarray(surface.vertices).tobytes())
        digest.update(np.ascontiguousarray(surface.faces).tobytes())
        self.fingerprint = digest.hexdigest()

    def save(
        self,
        parameters: list[torch.Tensor],
        average: list[torch.Tensor],
        soap: Soap,
        generator: torch.Generator,
        progress: tuple[int, int, int],
    ) -> None:
        """Write everything that the next step depends on; `progress` is (step, turn, stop)."""
        from safetensors.torch import save

        tensors = {f"parameter{i}": p.detach() for i, p in enumerate(parameters)}
        tensors |= {f"average{i}": p for i, p in enumerate(average)}
        tensors |= {f"soap{i}.{key}": value.contiguous() for i, s in enumerate(soap.state) for key, value in s.items()}
        tensors["generator"] = generator.get_state()
        tensors["progress"] = torch.tensor([*progress, soap.count])
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write(self.path, save(tensors, {"fingerprint": self.fingerprint}))

    def load(
        self, parameters: list[torch.Tensor], average: list[torch.Tensor], soap: Soap, generator: torch.Generator
    ) -> tuple[int, int, int] | None:
        """Put a saved state in place; None (and nothing changed) when there is none for this fit."""
        from safetensors import SafetensorError, safe_open

        if not self.path.is_file():
            return None
        try:
            with safe_open(str(self.path), framework="pt") as file:
                if (file.metadata() or {}).get("fingerprint") != self.fingerprint:
                    return None
                tensors = {key: file.get_tensor(key) for key in file.keys()}
        except (SafetensorError, OSError):
            return None  # cut short by a kill: the fit starts over
        with torch.no_grad():
            for i, parameter in enumerate(parameters):
                parameter.copy_(tensors[f"parameter{i}"])
                average[i].copy_(tensors[f"average{i}"])
        for i, state in enumerate(soap.state):
            for key in state:
                state[key] = tensors[f"soap{i}.{key}"]
        generator.set_state(tensors["generator"])
        step, turn, stop, soap.count = (int(value) for value in tensors["progress"])
        return step, turn, stop

    def remove(self) -> None:
        """The fit is done."""
        self.path.unlink(missing_ok=True)
