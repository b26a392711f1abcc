"""Training rays: the photos' pixels with the cameras they were seen from, drawn in seeded batches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from pipeline.cameras import View
from pipeline.inputs.images import reduced
from sdfsim.errors import SdfsimError


@dataclass(frozen=True)
class Rays:
    """All pixels of some views whose ray meets the unit sphere."""

    rgb: Tensor  # [N, 3] uint8
    mask: Tensor | None  # [N] uint8 (255 = object), or None
    view: Tensor  # [N] int16 index into the camera tables
    pixel: Tensor  # [N, 2] int16 column and row
    intrinsics: Tensor  # [V, 4] focal, cx, cy, k of the downscaled photos
    rotation: Tensor  # [V, 3, 3] world to camera
    center: Tensor  # [V, 3] camera centres
    sizes: Tensor  # [V, 2] width and height of the downscaled photos

    def __len__(self) -> int:
        return len(self.rgb)

    def to(self, device: str) -> Rays:
        """The same rays on another device."""
        moved: dict[str, Any] = {name: None if part is None else part.to(device) for name, part in vars(self).items()}
        return Rays(**moved)

    def at(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions [R, 3] of the rays with these indices [R]."""
        view = self.view[index].long()
        return camera_rays(
            self.intrinsics[view], self.rotation[view], self.center[view], self.pixel[index].float() + 0.5
        )

    def batch(self, count: int, seed: int, iteration: int) -> Tensor:
        """Indices [count] of a random batch; depends on nothing but its arguments, so a resumed run draws the same."""
        rng = torch.Generator().manual_seed(seed * 1_000_003 + iteration)
        return torch.randint(len(self), (count,), generator=rng).to(self.rgb.device)


def camera_rays(intrinsics: Tensor, rotation: Tensor, center: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Rays through pixels (see `View.rays`, the slow twin): intrinsics [R, 4], rotation [R, 3, 3], uv [R, 2]."""
    distorted = (uv - intrinsics[:, 1:3]) / intrinsics[:, :1]
    xy = distorted
    for _ in range(8):
        xy = distorted / (1 + intrinsics[:, 3:] * (xy * xy).sum(1, keepdim=True).clamp_max(4))
    local = torch.cat([xy, torch.ones_like(xy[:, :1])], 1)
    direction = (local[:, None] @ rotation)[:, 0]
    return center, direction / direction.norm(dim=1, keepdim=True)


def load_rays(views: list[View], photos_folder: Path, long_side: int, *, masks: bool) -> Rays:
    """Reads the photos of `views` (in normalised space), downscaled to `long_side` px. With masks, a view without one
    counts as all object. Raises SdfsimError where a photo is missing."""
    rgb, mask, view_of, pixel, intrinsics, sizes = [], [], [], [], [], []
    for index, view in enumerate(views):
        try:
            with Image.open(Path(photos_folder) / "images" / view.name) as image:
                image.load()
                size = reduced(image.size, long_side)
                pixels = np.asarray(image.convert("RGB").resize(size, Image.Resampling.BOX))
            shade = None
            file = Path(photos_folder) / "masks" / (view.name + ".png")
            if masks and file.exists():
                with Image.open(file) as image:
                    shade = np.asarray(image.convert("L").resize(size, Image.Resampling.BOX))
        except OSError as error:
            raise SdfsimError(f"{photos_folder}: cannot read {view.name}", "run the photos stage again") from error
        sx, sy = size[0] / view.width, size[1] / view.height
        intrinsics.append([view.focal * (sx + sy) / 2, view.cx * sx, view.cy * sy, view.k])
        sizes.append(size)
        column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        column, row = column.ravel(), row.ravel()
        direction = view.rays((column + 0.5) / sx, (row + 0.5) / sy)
        along = -(direction @ view.center)
        # Rays that miss the sphere say nothing about what is in it.
        meets = ((view.center**2).sum() - along**2 < 0.998) & (along > 0)
        rgb.append(pixels.reshape(-1, 3)[meets])
        mask.append(shade.reshape(-1)[meets] if shade is not None else np.full(meets.sum(), 255, np.uint8))
        view_of.append(np.full(meets.sum(), index, np.int16))
        pixel.append(np.stack([column[meets], row[meets]], 1).astype(np.int16))
    return Rays(
        rgb=torch.from_numpy(np.concatenate(rgb)),
        mask=torch.from_numpy(np.concatenate(mask)) if masks else None,
        view=torch.from_numpy(np.concatenate(view_of)),
        pixel=torch.from_numpy(np.concatenate(pixel)),
        intrinsics=torch.tensor(intrinsics, dtype=torch.float32),
        rotation=torch.tensor(np.array([v.rotation for v in views]), dtype=torch.float32),
        center=torch.tensor(np.array([v.center for v in views]), dtype=torch.float32),
        sizes=torch.tensor(sizes),
    )


def held_out(count: int) -> list[int]:
    """Indices of the views kept for measuring: every 8th, none where there are too few to spare."""
    return list(range(4, count, 8)) if count >= 16 else []
