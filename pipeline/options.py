"""The options of a reconstruction, and the config.yaml that keeps them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sdfsim.errors import SdfsimError
from sdfsim.files import CONFIG, write_text

PRESETS = ("quick", "standard", "fine", "paper")
COMMAND = "reconstruct"
DROPS = ("box", "ball", "none")
DEVICES = ("auto", "cpu", "cuda")


@dataclass
class Options:
    """Every option of a reconstruction, as written to config.yaml.

    Attributes:
        photos: what the user gave, an absolute path.
        preset: quick, standard, fine, or paper.
        size: widest side of the scene, m; None: assumed to be 1 m.
        budget: s for everything; None: what the preset takes.
        seed: of everything random.
        device: auto, cpu or cuda.
        recipe: of the fit; None: quick for the preset quick, else the default one.
        distance: two places and the metres between them, see `Known`; None: size counts.
        crop: m, corners x, y, z, x, y, z of the box that is kept; None: everything.
        keep: pieces to keep that would be left out, by name; "all" for every one.
        static: bodies that are to stay where they are, by name.
        drop: what is dropped onto the scene: box, ball or none.
    """

    photos: str = ""
    preset: str = "standard"
    size: float | None = None
    budget: float | None = None
    seed: int = 0
    device: str = "auto"
    recipe: str | None = None
    distance: list | None = None
    crop: list[float] | None = None
    keep: list[str] = field(default_factory=list)
    static: list[str] = field(default_factory=list)
    drop: str = "box"

    def check(self) -> None:
        """Raises SdfsimError where a value makes no sense."""
        if self.preset not in PRESETS:
            raise SdfsimError(f"preset: {self.preset!r} is not one of {', '.join(PRESETS)}")
        if self.size is not None and not 1e-4 <= self.size <= 1e5:
            raise SdfsimError(f"size: must be between 0.0001 and 100000 m (got {self.size:g})")
        if self.budget is not None and not self.budget > 0:
            raise SdfsimError(f"budget: must be > 0 s (got {self.budget:g})")
        if self.size is not None and self.distance is not None:
            raise SdfsimError("size and distance: both set the scale", "give one of them")
        if self.device not in DEVICES:
            raise SdfsimError(f"device: {self.device!r} is not one of {', '.join(DEVICES)}")
        if self.drop not in DROPS:
            raise SdfsimError(f"drop: {self.drop!r} is not one of {', '.join(DROPS)}")
        if self.crop is not None and not np.less(self.crop[:3], self.crop[3:]).all():
            raise SdfsimError(
                f"crop: the second corner must lie beyond the first in x, y and z (got {self.crop})",
                "corners are x,y,z in metres, the lower one first",
            )
        self.wishes()

    def changed(self, changes: dict[str, Any]) -> Options:
        """With other values; a new size takes the place of a known distance, and the other way round."""
        instead = {"size": "distance", "distance": "size"}
        return replace(self, **({instead[key]: None for key in changes if key in instead} | changes))

    def wishes(self) -> Wishes:
        """What a person asks of the meshes.

        Raises:
            SdfsimError: the distance makes no sense.
        """
        known = None
        if self.distance is not None:
            known = Known(str(self.distance[0]), str(self.distance[1]), float(self.distance[2]))
            known.check()
        crop = None if self.crop is None else np.reshape(self.crop, (2, 3))
        return Wishes(self.size, known, crop, tuple(self.keep))

    def fit_recipe(self) -> str:
        """The recipe of the fit, see `fit_mesh`."""
        return self.recipe or ("quick" if self.preset == "quick" else "default")

    def of_stage(self, stage: str) -> dict[str, Any]:
        """The options that a stage's result depends on."""
        common = {"preset": self.preset, "seed": self.seed}
        if stage == "photos":
            return {}
        if stage == "poses":
            return {"seed": self.seed}
        if stage == "distill":
            return {**common, "budget": self.budget}
        if stage == "mesh":
            keys = ("preset", "size", "distance", "crop", "keep")
            return {key: getattr(self, key) for key in keys}
        if stage == "fit":
            return {"seed": self.seed, "budget": self.budget, "recipe": self.fit_recipe()}
        return {"seed": self.seed, "drop": self.drop, "static": self.static}


def write_config(options: Options, folder: Path) -> None:
    """Writes config.yaml: every option as resolved."""
    text = yaml.safe_dump({"command": COMMAND, "version": 1, **asdict(options)}, sort_keys=False, allow_unicode=True)
    write_text(folder / CONFIG, text)


def read_config(folder: Path) -> Options:
    """Reads config.yaml.

    Raises:
        SdfsimError: it is missing or not one of ours.
    """
    try:
        data = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        data.pop("version", None)
        data.pop("command", None)
        return Options(**data)
    except (OSError, yaml.YAMLError, TypeError, AttributeError) as error:
        raise SdfsimError(f"{folder}: not the folder of a reconstruction", "run `sdfsim reconstruct` first") from error


@dataclass(frozen=True)
class Known:
    """A distance that a person knows.

    Attributes:
        start: `photo.jpg:x,y`, the point of the surface that this pixel shows; or `photo.jpg`, the camera itself.
        end: likewise.
        metres: between them.
    """

    start: str
    end: str
    metres: float

    def check(self) -> None:
        """Raises SdfsimError where it makes no sense."""
        if not 1e-4 <= self.metres <= 1e5:
            raise SdfsimError(f"distance: must be between 0.0001 and 100000 m (got {self.metres:g})")
        if self.start == self.end:
            raise SdfsimError(f"distance: both ends are {self.start}", "give two places that are some way apart")


@dataclass(frozen=True)
class Wishes:
    """What a person asks of the meshes.

    Attributes:
        size: widest side of the visible surface, m.
        distance: a distance known in the scene; with it `size` is not used.
        crop: [2, 3] m corners of the box outside which all is cut off, in the axes of the result.
        keep: pieces to keep that would be left out, by name.
    """

    size: float | None = None
    distance: Known | None = None
    crop: np.ndarray | None = None
    keep: Collection[str] = ()
