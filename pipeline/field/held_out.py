"""Photos that were not trained on: rendered from the field, compared, and kept as pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from pipeline.cameras import View
from pipeline.field.rays import load_rays
from pipeline.field.rendering import render
from pipeline.inputs.images import BACKDROP
from pipeline.progress import Progress, quiet

if TYPE_CHECKING:
    from pipeline.field.training import Trainer

FOLDER = "held_out"
EMPTY = 0.9  # grey of pixels whose ray misses the trained sphere


class HeldOut:
    """The photos that were not trained on, at a third of the training resolution; views are in normalised space. Those
    that show nothing of the unit sphere are passed over; `shown` has the indices of the others."""

    def __init__(self, views: list[View], photos_folder: Path, trainer: Trainer, *, masked: bool) -> None:
        self.views, self.trainer = views, trainer
        longest = max(100, trainer.settings.long_side // 3)
        self.rays = load_rays(views, photos_folder, longest, masks=False).to(trainer.device)
        self.shown: list[int] = self.rays.view.unique().tolist()
        self.backdrop = torch.full((3,), BACKDROP, device=trainer.device) if masked else None

    @torch.no_grad()
    def compare(self, number: int) -> tuple[float, np.ndarray]:
        """PSNR, dB, and render [H, W, 3] uint8 of one of the `shown` views, over pixels whose ray meets the unit
        sphere; the field's cached SDF has to be up to date."""
        trainer, rays = self.trainer, self.rays
        assert trainer.cache is not None
        index = torch.nonzero(rays.view == number)[:, 0]
        parts = []
        for part in index.split(4096):
            origins, directions = rays.at(part)
            parts.append(
                render(trainer.field, trainer.cache, origins, directions, trainer.beta,
                       samples=trainer.settings.samples, backdrop=self.backdrop)
            )  # fmt: skip
        rgb = torch.cat([part["rgb"] for part in parts])
        error = float(((rgb - rays.rgb[index].float() / 255) ** 2).mean())
        return -10 * math.log10(max(error, 1e-10)), self._picture(number, index, rgb)

    def _picture(self, number: int, index: Tensor, rgb: Tensor) -> np.ndarray:
        width, height = (int(side) for side in self.rays.sizes[number])
        picture = np.full((height, width, 3), EMPTY)
        column, row = self.rays.pixel[index].cpu().numpy().T
        picture[row, column] = rgb.cpu().numpy()
        return (255 * picture.clip(0, 1) + 0.5).astype(np.uint8)


def score(held: HeldOut, out: Path, on_progress: Progress = quiet) -> dict:
    """PSNR of the held-out views for the report, empty where none shows anything of the unit sphere; writes the renders
    to `out`/held_out."""
    if not held.shown:
        return {}
    (out / FOLDER).mkdir(exist_ok=True)
    psnr = []
    for count, number in enumerate(held.shown, 1):
        decibels, picture = held.compare(number)
        psnr.append(decibels)
        Image.fromarray(picture).save(out / FOLDER / held.views[number].name, quality=92)
        on_progress(count / len(held.shown), f"held-out view {count} of {len(held.shown)}")
    return {
        "held_out_photos": [held.views[number].source for number in held.shown],
        "psnr": round(float(np.mean(psnr)), 2), "psnr_each": [round(value, 2) for value in psnr],
    }  # fmt: skip
