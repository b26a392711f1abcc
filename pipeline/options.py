"""The options of a reconstruction, and the config.yaml that keeps them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pipeline.materials import choose
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import CONFIG, write_text

COMMAND = "reconstruct"
ALLOWED = {
    "preset": ("quick", "standard", "fine", "volsdf"),
    "device": ("auto", "cpu", "cuda"),
    "drop": ("box", "ball", "none"),
}
METRES = (1e-4, 1e5)  # smallest and largest length that can be given


@dataclass
class Options:
    """Every option of a reconstruction, as written to config.yaml."""

    photos: str = ""  # what the user gave, an absolute path
    preset: str = "standard"  # quick, standard, fine, or volsdf
    size: float | None = None  # widest side of the scene, m; None: assumed to be 1 m
    budget: float | None = None  # s for everything; None: what the preset takes
    seed: int = 0  # of everything random
    device: str = "auto"  # auto, cpu or cuda
    recipe: str | None = None  # of the fit; None: quick for the preset quick, else the default one
    # two places and the metres between them; None: size counts. A place is `photo.jpg:x,y`, the point of the surface
    # that this pixel shows, or `photo.jpg`, the camera itself.
    distance: list | None = None
    crop: list[float] | None = None  # m, corners x, y, z, x, y, z of the box that is kept; None: everything
    drop: str = "box"  # what is dropped onto the scene: box, ball or none
    # by body, what it is made of, such as `ceramic`, or `ceramic:4mm` for a hollow body's wall
    material: dict[str, str] = field(default_factory=dict)

    def check(self) -> None:
        """Raises SdfsimError where a value makes no sense."""
        for name, allowed in ALLOWED.items():
            if getattr(self, name) not in allowed:
                raise SdfsimError(f"{name}: {getattr(self, name)!r} is not one of {', '.join(allowed)}")
        lengths = {"size": self.size, "distance": self.distance[2] if self.distance else None}
        for name, metres in lengths.items():
            if metres is not None and not METRES[0] <= metres <= METRES[1]:
                raise SdfsimError(f"{name}: must be between {METRES[0]:g} and {METRES[1]:g} m (got {metres:g})")
        if self.budget is not None and not self.budget > 0:
            raise SdfsimError(f"budget: must be > 0 s (got {self.budget:g})")
        if self.size is not None and self.distance is not None:
            raise SdfsimError("size and distance: both set the scale", "give one of them")
        if self.distance is not None and self.distance[0] == self.distance[1]:
            raise SdfsimError(f"distance: both ends are {self.distance[0]}")
        if self.crop is not None and not np.less(self.crop[:3], self.crop[3:]).all():
            raise SdfsimError(f"crop: the second corner must lie beyond the first in x, y and z (got {self.crop})")
        choose(self.material)

    def changed(self, changes: dict[str, Any]) -> Options:
        """The options with other values; a new size takes the place of a known distance, and the other way round."""
        instead = {"size": "distance", "distance": "size"}
        return replace(self, **({instead[key]: None for key in changes if key in instead} | changes))

    def longer(self) -> str:
        """What trains for longer than these options."""
        if self.budget is not None:
            return "train for longer (a larger --budget)"
        better = {"quick": "standard", "standard": "fine"}.get(self.preset)
        return f"train for longer (--preset {better})" if better else "take more and sharper photos"

    def fit_recipe(self) -> str:
        """The recipe of the fit, see `fit_mesh`."""
        return self.recipe or ("quick" if self.preset == "quick" else "default")


def write_config(options: Options, folder: Path) -> None:
    """Writes config.yaml: every option as resolved."""
    text = yaml.safe_dump({"command": COMMAND, "version": 1, **asdict(options)}, sort_keys=False, allow_unicode=True)
    write_text(folder / CONFIG, text)


def read_config(folder: Path) -> Options:
    """Reads config.yaml. Raises SdfsimError: it is missing or not one of ours."""
    try:
        data = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        return Options(**{key: value for key, value in data.items() if key not in ("version", "command")})
    except (OSError, yaml.YAMLError, TypeError, AttributeError) as error:
        raise SdfsimError(f"{folder}: not the folder of a reconstruction", "run `sdfsim reconstruct` first") from error
