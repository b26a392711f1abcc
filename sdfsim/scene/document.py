"""The YAML of a scene file with its line numbers, and the faults that are found in it."""

import errno
import re
from pathlib import Path
from typing import Any

import yaml

from sdfsim.base.errors import SceneError
from sdfsim.base.files import not_read
from sdfsim.geometry.mesh_io import MESH_SUFFIXES

MOST_BYTES = 16 * 2**20  # largest size of a file
MOST_VALUES = 500_000  # largest number of values in a file; a value that an alias repeats counts each time
_LEVELS = 8  # no key is nested deeper
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_NULL = ("", "~", "null", "Null", "NULL")
_PLAIN_TAGS = {f"tag:yaml.org,2002:{t}" for t in ("str int float bool null map seq timestamp merge value".split())}

Loc = tuple[str | int, ...]  # keys and indices that lead to a value


class Numeral(str):
    """A number without quotes, as the file writes it. YAML 1.1 would guess: `1:30` becomes 90, and `1e-3` a string."""


def as_written(text: str) -> str:
    """Read a value without quotes: a `Numeral` or a string."""
    return (Numeral if _NUMBER.fullmatch(text) else str)(text)


NOTHING = object()  # the value of a key that is followed by nothing, `~` or `null`


def at(loc: Loc, text: str) -> str:
    """A fault with its place below a table: `path[0].time: must be >= 0`."""
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc).removeprefix(".")[:200]
    return f"{where}: {text}" if loc else text


class Faults:
    """The faults that are found in the `data` of a scene, each with the body, joint or shape that it is about."""

    def __init__(self, data: Any) -> None:
        self.data = data
        self._found: dict[tuple[int, str], None] = {}  # line and message; in the order of finding, each once

    def wrong(self, loc: Loc, text: str) -> None:
        """Record a fault of the value at `loc`."""
        kinds = {"bodies": "body", "joints": "joint", "shapes": "shape"}
        if len(loc) > 1 and loc[0] in kinds:
            name = loc[1] if loc[0] == "shapes" else self.data[loc[0]][loc[1]]["name"]
            text, loc = f"{kinds[loc[0]]} {name!r}: {at(loc[2:], text)}", ()
        self._found[0, at(loc, text)] = None

    def check(self) -> None:
        """Raise SceneError with every fault, in the order of the file, if there is any."""
        if self._found:
            raise SceneError([text for _, text in sorted(self._found, key=lambda entry: entry[0])])


class Document(Faults):
    """The YAML of a file, and the faults found in it, each with its line.

    `data` is made of dicts, lists, strings and `Numeral`s, and of `NOTHING` for keys without a value. Raises SceneError
    if the file is missing, too large, not UTF-8, not YAML (with the line) or empty, or if its aliases multiply its
    size.
    """

    def __init__(self, path: Path, text: str | None = None) -> None:
        super().__init__(None)
        self._path = path
        self._line: dict[Loc, int] = {}  # line of every key, and of every entry of a list
        root = _compose(path, _text_of(path) if text is None else text)
        self.data = self._read(root, (), root.start_mark.line + 1)

    def wrong(self, loc: Loc, text: str, line: int | None = None) -> None:
        """Record a fault of the value at `loc`, with its own line or another."""
        if line is None:
            line = next(self._line[loc[:depth]] for depth in range(len(loc), -1, -1) if loc[:depth] in self._line)
        self._found[line, f"{self._path}:{line}: {at(loc, text)}"] = None

    def _read(self, node: yaml.Node, loc: Loc, line: int) -> Any:
        self._line[loc] = line
        if len(self._line) > MOST_VALUES:
            raise SceneError([f"{self._path}:1: it has more than {MOST_VALUES} values, repeated aliases included"])
        if node.tag not in _PLAIN_TAGS:
            self.wrong(loc, f"must be plain YAML without tags (got {node.tag!r})")
        if len(loc) > _LEVELS:
            return "..."
        if isinstance(node, yaml.SequenceNode):
            return [self._read(child, (*loc, i), child.start_mark.line + 1) for i, child in enumerate(node.value)]
        if isinstance(node, yaml.ScalarNode):
            if node.style is not None:
                return node.value
            return NOTHING if node.value in _NULL else as_written(node.value)
        found: dict[str, Any] = {}
        for key_node, child in node.value:
            key, line = key_node.value, key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag not in _PLAIN_TAGS:
                self.wrong(loc, "a key must be a text without tags", line)
            elif key in found:
                self.wrong((*loc, key), f"the key appears twice (first on line {self._line[*loc, key]})", line)
            else:
                found[key] = self._read(child, (*loc, key), line)
        return found


def _text_of(path: Path) -> str:
    try:
        if path.exists() and not path.is_dir() and not path.is_file():
            raise OSError(errno.EINVAL, "not a file")  # a device or a pipe may never end
        if path.is_file() and path.suffix.lower() in MESH_SUFFIXES:
            scene = f"shapes: {{thing: {{mesh: {path.name}}}}}"
            raise SceneError(
                [f"{path}: a mesh is not a scene"], f"name it in one: {scene} (docs/vfx.md has one to copy)"
            )
        if path.is_file() and path.stat().st_size > MOST_BYTES:
            raise SceneError([f"{path}: too large for a scene (at most {MOST_BYTES // 2**20} MiB)"])
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        raise SceneError([f"{path}: {not_read(error)}"], "give the path of a scene.yaml") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError([f"{path}:{line}: not UTF-8 text"], "a scene is a YAML text file") from error


def _compose(path: Path, text: str) -> yaml.Node:
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as error:
        mark, place = getattr(error, "problem_mark", None), getattr(error, "position", None)
        line = mark.line + 1 if mark else text[:place].count("\n") + 1 if place is not None else 1
        why = next((found for name in ("problem", "context", "reason") if (found := getattr(error, name, None))), "")
        raise SceneError([f"{path}:{line}: not valid YAML: {why or 'nested too deeply'}"]) from error
    if root is None:
        raise SceneError([f"{path}:1: the file is empty"], "a scene needs at least version and bodies")
    return root
