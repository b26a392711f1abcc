"""Scenes written in Python: the keys of scene.yaml as keyword arguments, and the same checks."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import yaml
from pydantic import ValidationError

from sdfsim.base.errors import SceneError, SdfsimError
from sdfsim.base.files import path_from, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.scene.bundled import find_scene
from sdfsim.scene.document import NOTHING, Numeral, as_written
from sdfsim.scene.keys import BodyKeys, JointKeys
from sdfsim.scene.load import load_scene, read_scene
from sdfsim.scene.scene import WORLD, JointKind, Scene
from sdfsim.scene.schema import VERSION, BodyTable, JointTable, SceneTable, ShapeTable, meant

_OF_SHAPE = [key for key in ShapeTable.model_fields if key not in BodyTable.model_fields]
_PATHS = ("asset", "mesh")
_ANY: dict[str, Any] = {"sphere": {"radius": 1.0}}  # for shapes that are not defined yet, as an entry is checked
_BALL = {"shape": "a"}
_HERE = "<scene>"  # the name of a scene without a file in messages


class SceneBuilder:
    """A scene that is being written in Python. `print` shows it as the file that `save` writes. Settings are the
    top-level keys of the file: gravity, duration, seed, model, effects. Raises SceneError for an unknown key."""

    def __init__(self, **settings: Any) -> None:
        known = [key for key in SceneTable.model_fields if key not in ("version", "shapes", "bodies", "joints")]
        _check(settings, known, "a scene")
        self._settings = _plain(settings)
        body = {"name": "a", "plane": {}}
        _refuse({"version": VERSION, **self._settings, "bodies": [body]}, "a scene", {(key,): "" for key in settings})
        self._shapes: dict[str, dict[str, Any]] = {}
        self._bodies: list[dict[str, Any]] = []
        self._joints: list[dict[str, Any]] = []

    @classmethod
    def read(cls, path: Path | str, *, allow_outside: bool = False) -> "SceneBuilder":
        """Read a scene file, or a sample by its name, to extend it: `Scene.read("arm.yaml").add(...)`. Raises
        SceneError as `load_scene` does, with one line for every fault."""
        path = find_scene(path)
        document = read_scene(path, allow_outside=allow_outside)[1].data
        scene, home = cls(), path.parent
        for key in ("shapes", "bodies", "joints"):
            setattr(scene, f"_{key}", _values(document.pop(key, {} if key == "shapes" else [])))
        scene._settings = {key: value for key, value in _values(document).items() if key != "version"}
        for entry in scene._shapes.values():
            entry |= {key: str(home / entry[key]) for key in _PATHS if key in entry}
        if str(scene._settings.get("model", "")).endswith(".safetensors"):
            scene._settings["model"] = str(home / scene._settings["model"])
        return scene

    def add(self, name: str, **keys: Unpack[BodyKeys]) -> "SceneBuilder":
        """Add a body, or many copies of one, and return the scene.

        The keys are those of a body and of its shape in docs/scene.md, such as sphere={"radius": 0.1}, position=(0, 0,
        1); the shape gets the name of the body. Paths of meshes and folders start at the current folder. To reuse the
        shape of an earlier body, give shape="name of that body". Raises SceneError for an unknown key or an invalid
        value; `load` checks whether all of them fit together.
        """
        _check(keys, [*_OF_SHAPE, *(key for key in BodyTable.model_fields if key != "name")], f"body {name!r}")
        if any(body["name"] == name for body in self._bodies):
            raise SceneError([f"body {name!r}: two bodies have this name"], "give each a name of its own")
        shape = _plain({key: value for key, value in keys.items() if key in _OF_SHAPE})
        body = _plain({"name": name, **({"shape": name} if shape else {}),
                       **{key: value for key, value in keys.items() if key not in _OF_SHAPE}})  # fmt: skip
        shapes = {name: shape} if shape else {key: self._shapes.get(key, _ANY) for key in [body.get("shape")] if key}
        lone = {"version": VERSION, "shapes": shapes, "bodies": [_without(body, "collides_with", "avoids")]}
        _refuse(lone, f"body {name!r}", {("shapes", name): "", ("bodies", 0): ""} if shape else {("bodies", 0): ""})
        self._shapes |= {name: shape} if shape else {}
        self._bodies.append(body)
        return self

    def join(self, name: str, type: JointKind, *bodies: str, **keys: Unpack[JointKeys]) -> "SceneBuilder":
        """Add a joint between two bodies, and return the scene. The second body may be "world", which is also the
        default.

        The keys are those of `joints` in docs/scene.md, as in `join("door", "hinge", "leaf", anchor=(0, 0, 1), ...)`.
        Raises SceneError for an unknown key or an invalid value; `load` checks whether the bodies exist.
        """
        given = ("name", "type", "bodies")
        _check(keys, [key for key in JointTable.model_fields if key not in given], f"joint {name!r}")
        held = [*bodies, WORLD] if len(bodies) == 1 else list(bodies)
        joint = _plain({"name": name, "type": type, "bodies": held, **keys})
        own: list[dict[str, Any]] = [{"name": one, **_BALL} for one in dict.fromkeys(map(str, held)) if one != WORLD]
        lone = {"version": VERSION, "shapes": {"a": _ANY}, "bodies": own or [{"name": "a", **_BALL}], "joints": [joint]}
        _refuse(lone, f"joint {name!r}", {("joints", 0): ""})
        self._joints.append(joint)
        return self

    def load(self, on_progress: Progress = silent) -> Scene:
        """The immutable scene that a simulator needs; `Simulator` calls this itself. Shapes are loaded or fitted as in
        `load_scene`. Raises SceneError with one line for every fault; its line numbers are those of what `print`
        shows."""
        found = load_scene(Path(_HERE), on_progress, allow_outside=True, text=str(self))
        return replace(found, path=None)

    def save(self, path: Path | str) -> Path:
        """Write a scene.yaml, with paths relative to its folder. Nothing is checked: `load_scene` does that. Raises
        SdfsimError if the file cannot be written."""
        path = Path(path)
        write_text(path, self._text(path.resolve().parent))
        return path

    def __str__(self) -> str:
        return self._text(None)

    def _text(self, folder: Path | None) -> str:
        """The text of the file, with paths relative to `folder`, or unchanged for None."""

        def moved(path: Any) -> Any:
            return path_from(folder, path) if folder and isinstance(path, str) else path

        document = {"version": VERSION, **self._settings}
        if str(document.get("model", "")).endswith(".safetensors"):
            document["model"] = moved(document["model"])
        if self._shapes:
            document["shapes"] = {
                name: {key: moved(value) if key in _PATHS else value for key, value in entry.items()}
                for name, entry in self._shapes.items()
            }
        if self._bodies:
            document["bodies"] = self._bodies
        if self._joints:
            document["joints"] = self._joints
        return yaml.safe_dump(document, default_flow_style=None, sort_keys=False, width=10**9)


def loaded(scene: Any, on_progress: Progress = silent) -> Scene:
    """The scene of a `Scene`, a `SceneBuilder`, a scene file or a sample's name. Raises SdfsimError for anything else,
    and as `load_scene` does."""
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, SceneBuilder):
        return scene.load(on_progress)
    if isinstance(scene, str | Path):
        return load_scene(scene, on_progress)
    message = f"scene: must be a Scene, the path of a scene.yaml or the name of a sample (got a {type(scene).__name__})"
    raise SdfsimError(message)


def _refuse(data: dict[str, Any], what: str, places: dict[tuple, str]) -> None:
    """Raise SceneError with a line for every fault of a scene that lies below one of `places`; each line begins with
    `what`."""
    found = []
    try:
        SceneTable.model_validate(_numerals(data), context={"folder": Path(), "allow_outside": True})
    except ValidationError as error:
        for e in error.errors(include_url=False):
            for place in places:
                if e["loc"][: len(place)] == place:
                    rest = e["loc"][len(place) :] if len(place) > 1 else e["loc"]
                    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in rest)[1:]
                    found.append(f"{what}: {where}: {e['msg']}" if where else f"{what}: {e['msg']}")
    if found:
        raise SceneError(list(dict.fromkeys(found)), "docs/scene.md has every key")


def _without(entry: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in keys}


def _numerals(value: Any) -> Any:
    """Plain values in the form that the scene file parser gives."""
    if isinstance(value, dict):
        return {key: _numerals(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_numerals(entry) for entry in value]
    return NOTHING if value is None else as_written(repr(value)) if isinstance(value, int | float) else value


def _values(value: Any) -> Any:
    """The inverse of `_numerals`."""
    if isinstance(value, dict):
        return {key: _values(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_values(entry) for entry in value]
    if isinstance(value, Numeral):
        return int(value) if value.lstrip("+-").isdigit() else float(value)
    return {} if value is NOTHING else value


def _check(keys: Mapping[str, Any], known: list[str], what: str) -> None:
    wrong = [f"{what}: unknown key {key!r}{meant(key, known)}" for key in keys if key not in known]
    if wrong:
        raise SceneError(wrong, f"known keys: {', '.join(known)}")


def _plain(value: Any) -> Any:
    """A value as dicts, lists, strings and numbers only: arrays and tuples become lists, paths become strings, and True
    and False become "on" and "off"."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return ("on" if value else "off") if isinstance(value, bool) else str(value) if isinstance(value, Path) else value
