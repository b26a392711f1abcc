"""The options of a reconstruction: one model from which commands, stages and config.yaml take them."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, TypedDict

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from pipeline.materials import materials_of
from pipeline.naming import NAMING, can_be_named
from sdfsim.base.errors import EXIT_USAGE, SdfsimError

COMMAND = "reconstruct"
METRES = (1e-4, 1e5)  # smallest and largest length that can be given


Preset = Literal["quick", "standard"]  # what each is: PRESETS in pipeline/field/training.py


def option(default: Any, stages: Sequence[str], about: str = "", kind: Any = None, metavar: str | None = None,
           **limits: Any) -> Any:  # fmt: skip
    """A field of `Options`: the stages whose results depend on it (later stages follow), and for the command line its
    help text, the type of its value if different, and its notation."""
    extra = {"stages": [*stages], "kind": kind, "metavar": metavar}
    given = {"default_factory": default} if callable(default) else {"default": default}
    return Field(**given, description=about, json_schema_extra=extra, **limits)


class Options(BaseModel):
    """Every option of a reconstruction, as written to config.yaml. `options_of` makes one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    photos: str = ""  # what the user gave, an absolute path
    preset: Preset = option(
        "standard", ["distill", "mesh"],
        "How much time to spend.",
    )  # fmt: skip
    size: float | None = option(None, ["mesh"], "Widest side of the scene, metres.")  # None: assumed to be 1 m
    # s for all stages; None: no limit beyond the preset
    budget: float | None = option(None, ["distill", "fit"], gt=0, allow_inf_nan=False)
    seed: int = option(0, ["poses", "distill", "fit", "scene"])  # of all random numbers
    device: Literal["auto", "cpu", "cuda"] = "auto"
    recipe: Literal["quick", "default"] | None = option(
        None, ["fit"],
        "How long networks are fitted (a reconstruction: as its preset says).",
    )  # fmt: skip
    # None: a grid for the preset quick, where no recipe is given
    sdf: Literal["grid", "mlp"] | None = option(
        None, ["fit"],
        "What distances become: samples on a grid, or a fitted network (a reconstruction: as its preset says; "
        "fit -o: a network, for a scene samples a mesh file itself: mesh: FILE, sdf: grid).",
    )  # fmt: skip
    distance: tuple[str, str, float] | None = option(
        None, ["mesh"],
        "A distance that you know. A place is PHOTO:X,Y, the point at that pixel, or PHOTO, the camera itself.",
        metavar="PLACE PLACE METRES",
    )  # fmt: skip
    # m, x, y, z of the lower and of the upper corner; None: no crop
    crop: tuple[float, float, float, float, float, float] | None = option(
        None, ["mesh"], "Corners of the box to keep, metres, the lower one first.",
        kind=tuple[str, str] | None, metavar="X,Y,Z X,Y,Z",
    )  # fmt: skip
    up: str | None = option(
        None, ["mesh"],
        "What is up: PHOTO:X,Y on a level face; an axis, such as z or -y, of the cameras that were given or else of "
        "mesh.ply; or view, if all photos look straight down.",
        metavar="PLACE|AXIS|view",
    )  # fmt: skip
    # by body, places PHOTO:X,Y that show it
    body: dict[str, list[str]] = option(
        dict, ["mesh"],
        "A body that you point at: cup=041.jpg:300,200 is the body at that pixel. Can be repeated, also for one body.",
        kind=list[str] | None, metavar="NAME=PHOTO:X,Y",
    )  # fmt: skip
    drop: Literal["box", "ball", "none"] = option("box", ["scene"], "What falls onto the scene.")
    # by body, such as `ceramic`, or `ceramic:4mm` for a hollow body's wall
    material: dict[str, str] = option(
        dict, ["scene"],
        "Material of a body: object1=wood, or object1=ceramic:4mm for a hollow one. Can be repeated.",
        kind=list[str] | None, metavar="BODY=MATERIAL",
    )  # fmt: skip
    # kg, by body
    mass: dict[str, float] = option(
        dict, ["scene"], "Mass of a body, kg, if you weighed it: object1=0.35. Can be repeated.",
        kind=list[str] | None, metavar="BODY=KG",
    )  # fmt: skip

    @field_validator("crop", mode="before")
    @classmethod
    def _read_corners(cls, given: Any) -> Any:
        """Six numbers from two corners `X,Y,Z` as on the command line."""
        if not isinstance(given, Sequence) or not all(isinstance(corner, str) for corner in given):
            return given
        try:
            corners = [[float(part) for part in corner.split(",")] for corner in given]
        except ValueError:
            corners = []
        if [len(corner) for corner in corners] != [3, 3]:
            message = f"--crop takes two corners X,Y,Z in metres (got {' '.join(given)})"
            raise SdfsimError(message, exit_code=EXIT_USAGE)
        return corners[0] + corners[1]

    @field_validator("material", "mass", "body", mode="before")
    @classmethod
    def _read_by_body(cls, given: Any, info: ValidationInfo) -> Any:
        """Values by body from a list of `BODY=VALUE` as on the command line; a body may have several places."""
        if not isinstance(given, list):
            return given
        once = info.field_name != "body"
        found: dict[str, list[str]] = {}
        for text in given:
            body, _, value = text.partition("=")
            if not body or not value or (once and body in found):
                form = {
                    "material": "BODY=MATERIAL once for a body, such as object1=wood",
                    "mass": "BODY=KG once for a body, such as object1=0.35",
                    "body": "NAME=PHOTO:X,Y, such as cup=041.jpg:300,200",
                }[info.field_name or "body"]
                raise SdfsimError(f"--{info.field_name} takes {form} (got {text})", exit_code=EXIT_USAGE)
            found.setdefault(body, []).append(value)
        return {body: values[0] for body, values in found.items()} if once else found

    @field_validator("size", "distance")
    @classmethod
    def _check_length(cls, given: Any, info: ValidationInfo) -> Any:
        metres = given[2] if isinstance(given, tuple) else given
        if metres is not None and not METRES[0] <= metres <= METRES[1]:
            limits = f"must be between {METRES[0]:g} and {METRES[1]:g} m (got {metres:g})"
            raise SdfsimError(f"{info.field_name}: {limits}")
        return given

    @model_validator(mode="after")
    def _check(self) -> "Options":
        if self.size is not None and self.distance is not None:
            raise SdfsimError("size and distance: both set the scale", "give one of them")
        if self.distance is not None and self.distance[0] == self.distance[1]:
            raise SdfsimError(f"distance: both ends are {self.distance[0]}")
        if self.crop is not None and not all(a < b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            got = list(self.crop)
            raise SdfsimError(f"crop: the second corner must lie beyond the first in x, y and z (got {got})")
        for name, spots in self.body.items():
            if not can_be_named(name):
                raise SdfsimError(f"body: no body can be called {name!r}", NAMING)
            if not spots:
                raise SdfsimError(f"body: {name} has no place", "write PHOTO:X,Y")
        materials_of(self.material, self.mass)
        return self

    def changed(self, changes: dict[str, Any]) -> "Options":
        """The options with other values; a new size replaces a known distance, and vice versa. Raises the errors of
        `options_of`."""
        other = {"size": "distance", "distance": "size"}
        replaced = {other[key]: None for key in changes if key in other}
        return options_of(**self.model_dump() | replaced | changes)

    def of_stage(self, stage: str) -> dict[str, Any]:
        """The values, as JSON types, on which the result of a stage depends."""
        values = self.model_dump(mode="json") | {"recipe": self.fit_recipe(), "sdf": self.shape_sdf()}
        return {name: value for name, value in values.items() if stage in form_of(name)["stages"]}

    def longer(self) -> str:
        """Advice on options that train for longer than these."""
        if self.budget is not None:
            return "train for longer (a larger --budget)"
        return "train for longer (--preset standard)" if self.preset == "quick" else "take more and sharper photos"

    def fit_recipe(self) -> str:
        """The recipe of the fit, see `fit_mesh`. If none is given: quick for the preset quick, else the default."""
        return self.recipe or ("quick" if self.preset == "quick" else "default")

    def shape_sdf(self) -> Literal["grid", "mlp"]:
        """The representation of shapes' distances: a grid for the preset quick, else a network; a network too if a
        recipe is given."""
        return self.sdf or ("grid" if self.preset == "quick" and self.recipe is None else "mlp")


class OptionKeys(TypedDict, total=False):
    """The same options as arguments, for type checkers; a test checks that both have the same names."""

    preset: Preset
    size: float | None
    budget: float | None
    seed: int
    device: Literal["auto", "cpu", "cuda"]
    recipe: Literal["quick", "default"] | None
    sdf: Literal["grid", "mlp"] | None
    distance: tuple[str, str, float] | None
    crop: Sequence[float] | None
    up: str | None
    body: Mapping[str, Sequence[str]]
    drop: Literal["box", "ball", "none"]
    material: Mapping[str, str]
    mass: Mapping[str, float]


def form_of(name: str) -> dict[str, Any]:
    """What `option` keeps of an option: `stages`, `kind`, `metavar`."""
    extra: Any = Options.model_fields[name].json_schema_extra
    return extra or {"stages": []}


def options_of(**values: Any) -> Options:
    """Options with these values and defaults for the others. Raises SdfsimError, which names the option and the allowed
    values, for an invalid value or an unknown option."""
    try:
        return Options(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = first["loc"][0] if first["loc"] else "options"
        if first["type"] == "extra_forbidden":
            raise SdfsimError(f"no such option: {name}", f"options: {', '.join(Options.model_fields)}") from error
        wanted = "too few values" if first["type"] == "missing" else first["msg"].replace("Input should be", "must be")
        raise SdfsimError(f"{name}: {wanted} (got {first['input']!r})") from error


def write_config(options: Options, folder: Path) -> None:
    """Writes config.yaml: every option with its final value."""
    from sdfsim.base.files import CONFIG, write_text

    content = {"command": COMMAND, "version": 1, **options.model_dump(mode="json")}
    write_text(folder / CONFIG, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def read_config(folder: Path) -> Options:
    """Reads config.yaml. Raises SdfsimError if it is missing, not from a reconstruction, or has an invalid value."""
    from sdfsim.base.files import CONFIG

    path = folder / CONFIG
    data: Any = None
    with suppress(OSError, UnicodeDecodeError, yaml.YAMLError):
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(data, dict) or data.get("command") != COMMAND:
        raise SdfsimError(f"{folder}: not the folder of a reconstruction", "run `sdfsim reconstruct` first")
    try:
        return options_of(**{key: value for key, value in data.items() if key not in ("version", "command")})
    except SdfsimError as error:
        raise SdfsimError(f"{path}: {error.message}", error.hint, exit_code=error.exit_code) from error
