"""Resuming a fit that was cut off."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from sdfsim.shape.mesh import Mesh
from sdfsim.shape.shape import write
from sdfsim.shape.soap import Adam

VERSION = 3  # of the file's tensors


class Checkpoint:
    """The state of a running fit in one safetensors file, with a fingerprint of what is being fitted.

    Args:
        path: of the file.
        settings: everything but the geometry that decides the result.
        surface: the geometry.
    """

    def __init__(self, path: Path, settings: str, surface: Mesh) -> None:
        self.path = path
        self.fingerprint = hashlib.sha256(f"{VERSION}|{settings}|{surface.digest()}".encode()).hexdigest()

    def save(
        self,
        parameters: list[torch.Tensor],
        average: list[torch.Tensor],
        optimiser: Adam,
        generator: torch.Generator,
        progress: tuple[float, ...],
    ) -> None:
        """Write everything that the next step depends on; `progress` comes back from `load`."""
        from safetensors.torch import save

        tensors = {f"parameter{i}": p.detach() for i, p in enumerate(parameters)}
        tensors |= {f"average{i}": p for i, p in enumerate(average)}
        tensors |= {f"optimiser.{key}": value.contiguous() for key, value in optimiser.tensors().items()}
        tensors["generator"] = generator.get_state()
        tensors["progress"] = torch.tensor(progress, dtype=torch.float64)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write(self.path, save(tensors, {"fingerprint": self.fingerprint}))

    def load(
        self,
        parameters: list[torch.Tensor],
        average: list[torch.Tensor],
        optimiser: Adam,
        generator: torch.Generator,
    ) -> tuple[float, ...] | None:
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
        own = "optimiser."
        optimiser.restore({key.removeprefix(own): value for key, value in tensors.items() if key.startswith(own)})
        generator.set_state(tensors["generator"])
        return tuple(tensors["progress"].tolist())

    def remove(self) -> None:
        """The fit is done."""
        self.path.unlink(missing_ok=True)
