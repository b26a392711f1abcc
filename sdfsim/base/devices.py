"""Where to compute."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from sdfsim.base.errors import SdfsimError

if TYPE_CHECKING:
    import torch
else:
    from sdfsim.base.lazy import torch  # it takes its time to load


def check_device(name: str) -> None:
    """Raises SdfsimError if `name` is not a device ("auto", "cpu", "cuda" or "cuda:0"), or if there is no CUDA. Imports
    torch only to check CUDA."""
    if name not in ("auto", "cpu"):
        pick_device(name)


def pick_device(name: str) -> torch.device:
    """A device: "auto", "cpu", "cuda" or "cuda:0". Raises SdfsimError for another name, or if there is no CUDA."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name, re.ASCII):
        raise SdfsimError(f"device: {name!r} is not auto, cpu or cuda")
    place = torch.device(name)
    there = torch.cuda.is_available() and (place.index is None or place.index < torch.cuda.device_count())
    if place.type == "cuda" and not there:
        raise SdfsimError(f"--device {name}: no CUDA device here", "use --device cpu")
    return place
