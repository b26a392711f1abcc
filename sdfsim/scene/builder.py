"""Scenes written in Python: the keys of scene.yaml as keyword arguments, and the same checks."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
import yaml
from pydantic import ValidationError

from sdfsim.base.errors import SceneError, SdfsimError
from sdfsim.base.files import path_from, write_text
from sdfsim.base.parallel import Progress, silent
from sdfsim.scene.bundled import find_scene
from sdfsim.scene.document import NOTHING, Faults, Numeral, at
from sdfsim.scene.load import checked, load_scene, read_scene, scene_of
from sdfsim.scene.scene import WORLD, JointKind, Motion, Scene
from sdfsim.scene.schema import (
    VERSION,
    BodyTable,
    CouplingTable,
    FrameTable,
    JointTable,
    KeyframeTable,
    SceneTable,
    ShapeTable,
    Table,
    meant,
)
from sdfsim.shape.shape import SdfKind

_OF_SHAPE = [key for key in ShapeTable.model_fields if key not in BodyTable.model_fields]
_ENTRIES = ("shapes", "bodies", "joints", "frames", "keyframes", "couplings")
_LISTED = ("version", *_ENTRIES)  # the keys of the file that are no settings
_PATHS = ("asset", "mesh")
_CONTEXT = {"folder": Path(), "allow_outside": True}  # paths start at the current folder


# The keys of bodies and joints as arguments, for type checkers. `schema` says what they mean and checks their values; a
# test checks that both have the same keys.
Numbers = Sequence[float] | np.ndarray
Group = Mapping[str, Any]
Switch = bool | Literal["on", "off"]


class BodyKeys(TypedDict, total=False):
    """Keyword arguments of `Scene.add`: the keys of a body and those of its shape."""

    asset: Path | str | None
    mesh: Path | str | None
    primitive: Group | None
    sphere: Group | None
    capsule: Group | None
    box: Group | None
    cylinder: Group | None
    cone: Group | None
    torus: Group | None
    plane: Group | None
    parts: Sequence[Group] | None
    units: Literal["m", "cm", "mm", "in"] | None
    cap: Switch | None
    thicken: float | None
    centre: Switch | None
    round: Literal["auto", "off"] | None
    wall: float | None
    sdf: SdfKind | None
    resolution: int | None
    nodes: int | None
    shape: str | None
    motion: Motion | None
    position: Numbers | None
    quat_xyzw: Numbers | None
    quat_wxyz: Numbers | None
    euler_xyz_deg: Numbers | None
    velocity: Numbers | None
    angular_velocity: Numbers | None
    scale: float | None
    mass: float | None
    density: float | None
    inertia_factor: float | None
    friction: float | None
    restitution: float | None
    stiffness: float | None
    damping: float | None
    collides_with: Literal["all"] | Sequence[str] | None
    avoids: Sequence[str]
    path: Sequence[Group] | None
    color: Numbers | None
    count: int | None
    arrange: Group | None


class JointKeys(TypedDict, total=False):
    """Of `Scene.join`."""

    anchor: Numbers | None
    to: Numbers | None
    axis: Numbers | None
    frame: str | None
    start: float | None
    start_deg: float | None
    limits: Numbers | None
    limits_deg: Numbers | None
    cone_deg: float | None
    rod: float | None
    rope: float | None
    restitution: float | None
    damping: float | None
    friction: float | None
    armature: float | None
    spring: Group | None
    motor: Group | None
    breaks_at: Group | None
    collide: Switch | None


class SceneBuilder:
    """A scene that is being written in Python. `print` shows it as the file that `save` writes. Settings are the
    top-level keys of the file: gravity, duration, seed, model, effects. Raises SceneError for an unknown key.

    Attributes:
        settings, shapes, bodies, joints, frames, keyframes, couplings: what the file has, as dicts and lists of texts
            and numbers.
    """

    def __init__(self, **settings: Any) -> None:
        _known(settings, [key for key in SceneTable.model_fields if key not in _LISTED], "a scene")
        self.settings: dict[str, Any] = plain(settings)
        validated(
            "a scene", (SceneTable, {"version": VERSION, **self.settings, "bodies": [{"name": "a", "plane": {}}]})
        )
        self.shapes: dict[str, dict[str, Any]] = {}
        self.bodies: list[dict[str, Any]] = []
        self.joints: list[dict[str, Any]] = []
        self.frames: list[dict[str, Any]] = []
        self.keyframes: dict[str, dict[str, Any]] = {}
        self.couplings: list[dict[str, Any]] = []

    @classmethod
    def read(cls, path: Path | str, *, allow_outside: bool = False) -> "SceneBuilder":
        """Read a scene file, or a sample by its name, to extend it: `Scene.read("arm.yaml").add(...)`. Raises
        SceneError as `load_scene` does, with one line for every fault."""
        path = find_scene(path)
        document = plain(read_scene(path, allow_outside=allow_outside)[1].data)
        scene, home = cls(), path.parent
        vars(scene).update({key: document[key] for key in _ENTRIES if document.get(key)})
        scene.settings = {key: value for key, value in document.items() if key not in _LISTED}
        scene.shapes = {name: _moved(entry, lambda path: str(home / path)) for name, entry in scene.shapes.items()}
        if str(scene.settings.get("model", "")).endswith(".safetensors"):
            scene.settings["model"] = str(home / scene.settings["model"])
        return scene

    def add(self, name: str, **keys: Unpack[BodyKeys]) -> "SceneBuilder":
        """Add a body, or many copies of one, and return the scene.

        The keys are those of a body and of its shape in docs/scene.md, such as sphere={"radius": 0.1}, position=(0, 0,
        1); the shape gets the name of the body. Paths of meshes and folders start at the current folder. To reuse the
        shape of an earlier body, give shape="name of that body". Raises SceneError for an unknown key or an invalid
        value; `load` checks whether all of them fit together.
        """
        what = f"body {name!r}"
        _known(keys, [*_OF_SHAPE, *(key for key in BodyTable.model_fields if key != "name")], what)
        if any(body["name"] == name for body in self.bodies):
            raise SceneError([f"{what}: two bodies have this name"], "give each a name of its own")
        shape = plain({key: value for key, value in keys.items() if key in _OF_SHAPE})
        own = plain({key: value for key, value in keys.items() if key not in _OF_SHAPE})
        body = {"name": name, **({"shape": name} if shape else {}), **own}
        validated(what, *([(ShapeTable, shape)] if shape else []), (BodyTable, body))
        self.shapes |= {name: shape} if shape else {}
        self.bodies.append(body)
        return self

    def join(self, name: str, type: JointKind, *bodies: str, **keys: Unpack[JointKeys]) -> "SceneBuilder":
        """Add a joint between two bodies, and return the scene. The second body may be "world", which is also the
        default.

        The keys are those of `joints` in docs/scene.md, as in `join("door", "hinge", "leaf", anchor=(0, 0, 1), ...)`.
        Raises SceneError for an unknown key or an invalid value; `load` checks whether the bodies exist.
        """
        given = ("name", "type", "bodies")
        _known(keys, [key for key in JointTable.model_fields if key not in given], f"joint {name!r}")
        held = [*bodies, WORLD] if len(bodies) == 1 else list(bodies)
        joint = plain({"name": name, "type": type, "bodies": held, **keys})
        validated(f"joint {name!r}", (JointTable, joint))
        self.joints.append(joint)
        return self

    def frame(self, name: str, body: str, **keys: Any) -> "SceneBuilder":
        """Add a named pose on a body, or on the "world", and return the scene: `position` from the body's origin, and
        an orientation, as `frames` in docs/scene.md. Raises SceneError as `join` does."""
        self.frames.append(self._checked(f"frame {name!r}", FrameTable, {"name": name, "body": body, **keys}))
        return self

    def keyframe(self, name: str, **keys: Any) -> "SceneBuilder":
        """Add a pose of all joints for `Simulator.reset`, and return the scene, as in `keyframe("home",
        angles_deg={"elbow": 90})`; docs/scene.md has the keys. Raises SceneError as `join` does."""
        self.keyframes[name] = self._checked(f"keyframe {name!r}", KeyframeTable, keys)
        return self

    def couple(self, first: str, second: str, **keys: Any) -> "SceneBuilder":
        """Add a coupling, by which the joint `first` follows `second`, and return the scene, with the keys of
        `couplings` in docs/scene.md. Raises SceneError as `join` does."""
        self.couplings.append(
            self._checked(f"coupling of {first!r}", CouplingTable, {"joints": [first, second], **keys})
        )
        return self

    def _checked(self, what: str, table: type[Table], keys: dict[str, Any]) -> dict[str, Any]:
        _known(keys, list(table.model_fields), what)
        validated(what, (table, entry := plain(keys)))
        return entry

    def load(self, on_progress: Progress = silent) -> Scene:
        """The immutable scene that a simulator needs; `Simulator` calls this itself. Shapes are loaded or fitted as in
        `load_scene`. Raises SceneError with one line for every fault."""
        faults = Faults(self._document(None))
        return scene_of(checked(faults, _CONTEXT), faults, on_progress)

    def save(self, path: Path | str) -> Path:
        """Write a scene.yaml, with paths relative to its folder. Nothing is checked: `load_scene` does that. Raises
        SdfsimError if the file cannot be written."""
        path = Path(path)
        write_text(path, _text(self._document(path.resolve().parent)))
        return path

    def __str__(self) -> str:
        return _text(self._document(None))

    def _document(self, folder: Path | None) -> dict[str, Any]:
        """What the file has, with paths relative to `folder`, or unchanged for None."""

        def moved(path: Any) -> Any:
            return path_from(folder, path) if folder and isinstance(path, str) else path

        document = {"version": VERSION, **self.settings}
        if str(document.get("model", "")).endswith(".safetensors"):
            document["model"] = moved(document["model"])
        shapes = {name: _moved(entry, moved) for name, entry in self.shapes.items()}
        listed = {name: getattr(self, name) for name in _ENTRIES} | {"shapes": shapes}
        return document | {key: value for key, value in listed.items() if value}


def _moved(entry: dict[str, Any], move: Callable[[str], str]) -> dict[str, Any]:
    """A shape or a part of one, with other paths."""
    made = {key: move(value) if key in _PATHS else value for key, value in entry.items()}
    return made | ({"parts": [_moved(part, move) for part in entry["parts"]]} if "parts" in entry else {})


def _text(document: dict[str, Any]) -> str:
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


def validated(what: str, *parts: tuple[type[Table], dict[str, Any]]) -> list[Any]:
    """The tables of these plain values. Raises SceneError with a line for every fault; each line begins with `what`."""
    found: dict[str, None] = {}
    made = []
    for table, data in parts:
        try:
            made.append(table.model_validate(data, context=_CONTEXT))
        except ValidationError as error:
            found |= {f"{what}: {at(e['loc'], e['msg'])}": None for e in error.errors(include_url=False)}
    if found:
        raise SceneError(list(found), "docs/scene.md has every key")
    return made


def _known(keys: Mapping[str, Any], known: list[str], what: str) -> None:
    wrong = [f"{what}: unknown key {key!r}{meant(key, known)}" for key in keys if key not in known]
    if wrong:
        raise SceneError(wrong, f"known keys: {', '.join(known)}")


def plain(value: Any) -> Any:
    """A value of Python or of a document as dicts, lists, texts and numbers only: arrays and tuples become lists, paths
    become texts, and True and False become "on" and "off"."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items() if entry is not None}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, Numeral):
        return int(value) if value.lstrip("+-").isdigit() else float(value)
    if isinstance(value, bool):
        return "on" if value else "off"
    return {} if value is NOTHING else str(value) if isinstance(value, Path) else value
