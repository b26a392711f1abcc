"""The options of a reconstruction, and the config.yaml that keeps them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from sdfsim.errors import SdfsimError
from sdfsim.files import write_text

PRESETS = ("quick", "standard", "fine")
LONG_SIDE = {"quick": 800, "standard": 1200, "fine": 1600}  # px of the prepared photos


@dataclass
class Options:
    """Every option of a reconstruction, as written to config.yaml.

    Attributes:
        photos: the user's folder.
        preset: quick, standard or fine.
        size: widest side of the scene, m; None: assumed to be 1 m.
        budget: s for everything; None: what the preset takes.
        seed: of everything random.
        device: auto, cpu or cuda.
        recipe: of the fit.
    """

    photos: str = ""
    preset: str = "standard"
    size: float | None = None
    budget: float | None = None
    seed: int = 0
    device: str = "auto"
    recipe: str = "default"

    def check(self) -> None:
        """Raises SdfsimError where a value makes no sense."""
        if self.preset not in PRESETS:
            raise SdfsimError(f"preset: {self.preset!r} is not one of {', '.join(PRESETS)}")
        if self.size is not None and not 1e-4 <= self.size <= 1e5:
            raise SdfsimError(f"size: must be between 0.0001 and 100000 m (got {self.size:g})")
        if self.budget is not None and not self.budget > 0:
            raise SdfsimError(f"budget: must be > 0 s (got {self.budget:g})")

    def of_stage(self, stage: str) -> dict[str, Any]:
        """The options that a stage's result depends on."""
        common = {"preset": self.preset, "seed": self.seed}
        if stage == "photos":
            return {"long_side": LONG_SIDE[self.preset]}
        if stage == "poses":
            return {"seed": self.seed}
        if stage == "distill":
            return {**common, "budget": self.budget}
        if stage == "mesh":
            return {"preset": self.preset, "size": self.size}
        if stage == "fit":
            return {"seed": self.seed, "budget": self.budget, "recipe": self.recipe}
        return {"seed": self.seed}


def write_config(options: Options, folder: Path) -> None:
    """Writes config.yaml: every option as resolved."""
    text = yaml.safe_dump({"version": 1, **asdict(options)}, sort_keys=False, allow_unicode=True)
    write_text(folder / "config.yaml", text)


def read_config(folder: Path) -> Options:
    """Reads config.yaml.

    Raises:
        SdfsimError: it is missing or not one of ours.
    """
    try:
        data = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
        data.pop("version", None)
        return Options(**data)
    except (OSError, yaml.YAMLError, TypeError, AttributeError) as error:
        raise SdfsimError(f"{folder}: not the folder of a reconstruction", "run `sdfsim reconstruct` first") from error
