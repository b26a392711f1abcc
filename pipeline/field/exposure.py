"""Exposure and white balance of each photo, learned together with the field."""

import torch
from torch import Tensor, nn

CLIPPED = 0.985  # of the range of a photo: above this the true brightness is unknown


class Exposure(nn.Module):
    """A gain and an offset for each colour channel of each photo, relative to the mean of all. Cameras set exposure and
    white balance for each photo; both are nearly such a change of a stored (gamma-coded) picture."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.change = nn.Parameter(torch.zeros(count, 2, 3))  # of gains and offsets, to which the mean is added

    def of_photos(self) -> tuple[Tensor, Tensor]:
        """Gains and offsets [V, 3]. Their means are 1 and 0, because a brighter field with darker photos is
        equivalent."""
        gain, offset = (self.change - self.change.mean(0)).unbind(1)
        return 1 + gain, offset

    def forward(self, rgb: Tensor, opacity: Tensor | None, backdrop: float, view: Tensor) -> Tensor:
        """Colours [R, 3] as the photos `view` [R] show them. With an `opacity` [R], the visible part of the constant
        backdrop has the colour of the masks' background, and does not change."""
        gain, offset = (values[view] for values in self.of_photos())
        if opacity is None:
            return gain * rgb + offset
        behind = (1 - opacity[:, None]) * backdrop
        return gain * (rgb - behind) + offset * opacity[:, None] + behind

    def penalty(self) -> Tensor:
        """Penalty that keeps gains near 1 and offsets near 0 unless the photos show otherwise."""
        return (self.change**2).mean()

    def spread(self) -> float:
        """Standard deviation of the gains, a measure of how much the photos differ."""
        return float((self.of_photos()[0] - 1).detach().square().mean().sqrt())


def color_error(rgb: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute difference of rendered colours [R, 3] from those of photos; zero where a photo is clipped and the
    rendering is brighter."""
    beyond = (truth > CLIPPED) & (rgb > truth)
    return torch.where(beyond, 0.0, (rgb - truth).abs()).mean()


def matched(rgb: Tensor, truth: Tensor) -> Tensor:
    """Rendered colours [P, 3] with the gain and the offset per channel that fit a photo's colours best, by least
    squares: the exposure of a held-out photo."""
    from_mean, to_mean = rgb - rgb.mean(0), truth - truth.mean(0)
    gain = (from_mean * to_mean).sum(0) / (from_mean**2).sum(0).clamp_min(1e-9)
    return from_mean * gain + truth.mean(0)
