"""The picture that `sdfsim identify` writes beside the scene: the loss against each parameter."""

from __future__ import annotations

import math
from pathlib import Path

from sdfsim.apps.identify import HEADS, Identified, Profile
from sdfsim.base.files import replacing

ACROSS = 4  # panels in a row
WIDE, HIGH = 3.0, 2.2  # inches of one


def picture(found: Identified, path: Path) -> str:
    """Write a panel for every parameter as a PNG: the loss with the others fitted again, and the interval of 95 %.
    Returns what to install where matplotlib is not, else nothing."""
    try:
        import matplotlib
    except ImportError:
        return "pictures need matplotlib: pip install 'sdfsim[bench]'"
    matplotlib.use("Agg")
    from matplotlib import pyplot

    across = min(ACROSS, max(1, len(found.profiles)))
    down = max(1, math.ceil(len(found.profiles) / across))
    figure, axes = pyplot.subplots(
        down, across, figsize=(WIDE * across, HIGH * down), layout="constrained", squeeze=False
    )
    for axis in axes.flat[len(found.profiles) :]:
        axis.axis("off")
    for axis, profile in zip(axes.flat, found.profiles, strict=False):
        shown = profile.interval is not None
        if profile.interval is not None:
            axis.axvspan(*profile.interval, color="tab:blue", alpha=0.15, linewidth=0)
        axis.plot(profile.x, profile.loss, "o-", markersize=3, linewidth=1.2, color="tab:blue" if shown else "0.6")
        axis.axvline(profile.value, color="0.4", linewidth=0.8, linestyle=":")
        # What is flat looks flat: the scale holds a tenth of the loss at least.
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, 0.99), max(high, 1.1))
        axis.set_title(title(profile), fontsize=8, color="black" if shown else "0.4")
        axis.set_xlabel(profile.unit.strip() or "no unit", fontsize=7)
        axis.set_ylabel("loss over the best", fontsize=7)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, format="png")
    pyplot.close(figure)
    return ""


def title(profile: Profile) -> str:
    head = f"{HEADS[profile.kind]}: {profile.name}"
    if profile.interval is None:
        return f"{head}\nnot shown by these recordings"
    digits = 4 if profile.unit == " m" or profile.kind.startswith("joint") else 3
    low, high = (f"{end:.{digits}f}" for end in profile.interval)
    return f"{head}\n{profile.value:.{digits}f}{profile.unit} ({low} to {high})"
