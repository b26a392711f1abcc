"""Batches on a device."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch


def moved(value: Any, device: torch.device) -> Any:
    """Move a batch, its parts or a tensor to a device."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: moved(part, device) for name, part in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: moved(getattr(value, f.name), device) for f in fields(value)})
    return value
