"""Scenes written in Python: the keys of scene.yaml as keyword arguments, and the same checks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sdfsim.base.errors import SceneError, nearest
from sdfsim.base.files import path_from, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.scene.load import load_scene
from sdfsim.scene.scene import WORLD, Scene
from sdfsim.scene.schema import VERSION, BodyTable, JointTable, SceneTable, ShapeTable

_OF_SHAPE = [key for key in ShapeTable.model_fields if key not in BodyTable.model_fields]
_PATHS = ("asset", "mesh")
_HERE = "<scene>"  # the name in messages of a scene without a file


class SceneBuilder:
    """A scene that is being written. `print` shows it as the file that `save` writes. Settings are keys of the file
    itself: gravity, duration, seed, model, effects; raises SceneError for no such key."""

    def __init__(self, **settings: Any) -> None:
        known = [key for key in SceneTable.model_fields if key not in ("version", "shapes", "bodies", "joints")]
        _check(settings, known, "a scene")
        self._settings = _plain(settings)
        self._shapes: dict[str, dict[str, Any]] = {}
        self._bodies: list[dict[str, Any]] = []
        self._joints: list[dict[str, Any]] = []

    def add(self, name: str, **keys: Any) -> "SceneBuilder":
        """Add a body, or many copies of one, and return the scene.

        Keys are of the body and of its shape, which has the same name, as docs/scene.md has them, such as
        sphere={"radius": 0.1}, position=(0, 0, 1). Paths of meshes and folders start at the current folder. A body that
        looks like an earlier one takes shape="name of that one". Raises SceneError for no such key; values are checked
        by `load`, all at once.
        """
        _check(keys, [*_OF_SHAPE, *(key for key in BodyTable.model_fields if key != "name")], f"body {name!r}")
        shape = {key: value for key, value in keys.items() if key in _OF_SHAPE}
        body = {key: value for key, value in keys.items() if key not in _OF_SHAPE}
        if shape:
            self._shapes[name] = _plain(shape)
            body = {"shape": name, **body}
        self._bodies.append(_plain({"name": name, **body}))
        return self

    def join(self, name: str, type: str, *bodies: str, **keys: Any) -> "SceneBuilder":
        """Add a joint between two bodies, the second of which may be "world" and is so where only one is given, and
        return the scene.

        Keys are those of `joints` in docs/scene.md: `join("door", "hinge", "leaf", anchor=(0, 0, 1), axis=(0, 0, 1))`.
        Raises SceneError for no such key; values are checked by `load`, all at once.
        """
        given = ("name", "type", "bodies")
        _check(keys, [key for key in JointTable.model_fields if key not in given], f"joint {name!r}")
        held = [*bodies, WORLD] if len(bodies) == 1 else list(bodies)
        self._joints.append(_plain({"name": name, "type": type, "bodies": held, **keys}))
        return self

    def load(self, on_progress: Progress = silent) -> Scene:
        """What a simulator takes; `Simulator` calls it by itself. Shapes are loaded or fitted as `load_scene` does.
        Raises SceneError with one line for every fault, with the line that `print` shows it in."""
        found = load_scene(Path(_HERE), on_progress, allow_outside=True, text=str(self))
        return replace(found, path=None)

    def save(self, path: Path | str) -> Path:
        """Write a scene.yaml; paths in it start at its folder. Nothing is checked: `load_scene` does that. Raises
        SdfsimError where the file cannot be written."""
        path = Path(path)
        write_text(path, self._text(path.resolve().parent))
        return path

    def __str__(self) -> str:
        return self._text(None)

    def _text(self, folder: Path | None) -> str:
        """The file; paths start at `folder`, or stay as they are."""

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


def _check(keys: dict[str, Any], known: list[str], what: str) -> None:
    wrong = [f"{what}: unknown key {key!r}{nearest(key, known)}" for key in keys if key not in known]
    if wrong:
        raise SceneError(wrong, f"known are {', '.join(known)}")


def _plain(value: Any) -> Any:
    """Dicts, lists, texts and numbers only: arrays and tuples become lists, paths texts, and what is on or off so."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return ("on" if value else "off") if isinstance(value, bool) else str(value) if isinstance(value, Path) else value
