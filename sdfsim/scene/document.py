"""YAML with line numbers: reading a field reports what is wrong with it instead of stopping at the first fault.

Scalars are read from their text, not through YAML 1.1's guesses, which turn `off` into False, `1:30` into 90 and leave
`1e-3` a string.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable

import numpy as np
import yaml

from sdfsim.errors import SceneError

LARGEST = 1e12  # of any number: beyond it powers and products of what is legal are no longer finite
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_NOT_FINITE = re.compile(r"[-+]?\.?(nan|inf|infinity)", re.IGNORECASE)
_NULL = ("", "~", "null", "Null", "NULL")
_SHOWN = 40
MOST_LETTERS = 1000  # of a key or a text
_ALIKE = 100  # names longer than this, or more of them than ten times as many, are not searched for similar ones
_PLAIN_TAGS = {f"tag:yaml.org,2002:{t}" for t in ("str int float bool null map seq timestamp merge value".split())}


class Problems:
    """Faults found in one file, each with its line."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._found: dict[tuple[int, str], None] = {}  # in the order of the finding, and quick to look up

    def __len__(self) -> int:
        return len(self._found)

    def add(self, line: int, path: str, text: str) -> None:
        """Note a fault; `line` counts from 1, `path` is such as `bodies[2].mass` (may be empty)."""
        # An anchor used twice is one fault.
        self._found[line, f"{self.file}:{line}: {path}: {text}" if path else f"{self.file}:{line}: {text}"] = None

    def check(self) -> None:
        """Raise SceneError with every fault, in file order, if there is any."""
        if self._found:
            raise SceneError([text for _, text in sorted(self._found, key=lambda entry: entry[0])])


class Value:
    """One node of the file. Every reader returns its `default` after reporting a fault, so that reading goes on."""

    def __init__(self, node: yaml.Node, path: str, problems: Problems) -> None:
        self.node = node
        self.path = path
        self.problems = problems
        self.line = node.start_mark.line + 1
        if node.tag not in _PLAIN_TAGS:
            self.wrong(f"must be plain YAML without tags (got {node.tag!r})")

    def wrong(self, text: str) -> None:
        """Report a fault at this place."""
        self.problems.add(self.line, self.path, text)

    def shown(self) -> str:
        """What the file says here, for a message."""
        if isinstance(self.node, yaml.ScalarNode):
            if self.is_null():
                return "nothing"
            text = repr(self.node.value)
            return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "...'"
        return "a list" if isinstance(self.node, yaml.SequenceNode) else "a mapping"

    def is_null(self) -> bool:
        """True where the file says nothing, `~` or `null`."""
        return isinstance(self.node, yaml.ScalarNode) and self.node.style is None and self.node.value in _NULL

    def is_list(self) -> bool:
        """True for a YAML sequence."""
        return isinstance(self.node, yaml.SequenceNode)

    def number(
        self,
        unit: str = "",
        *,
        above: float | None = None,
        least: float | None = None,
        most: float | None = None,
        default: float = 0.0,
    ) -> float:
        """A finite number, no larger than `LARGEST`, with `above` < x, `least` <= x, `most` >= x."""
        what = "a number" + (f" in {unit}" if unit else "")
        node = self.node
        if not isinstance(node, yaml.ScalarNode) or node.style is not None:
            self.wrong(f"must be {what} (got {self.shown()})")
            return default
        value = float(node.value) if _NUMBER.fullmatch(node.value) else math.nan
        if _NOT_FINITE.fullmatch(node.value) or math.isinf(value):
            self.wrong(f"must be finite (got {node.value})")
            return default
        if math.isnan(value):
            self.wrong(f"must be {what} (got {self.shown()})")
            return default
        got = f"(got {node.value}{' ' + unit if unit else ''})"
        if abs(value) > LARGEST:
            self.wrong(f"must be at most {LARGEST:g} {got}")
        elif above is not None and value <= above:
            self.wrong(f"must be > {above:g} {got}")
        elif least is not None and value < least:
            self.wrong(f"must be >= {least:g} {got}")
        elif most is not None and value > most:
            self.wrong(f"must be <= {most:g} {got}")
        else:
            return value
        return default

    def integer(self, *, least: int, default: int) -> int:
        """A whole number that is at least `least`."""
        node = self.node
        if not isinstance(node, yaml.ScalarNode) or not re.fullmatch(r"[-+]?[0-9]{1,18}", node.value) or node.style:
            self.wrong(f"must be a whole number (got {self.shown()})")
            return default
        if int(node.value) < least:
            self.wrong(f"must be >= {least} (got {node.value})")
            return default
        return int(node.value)

    def vector(self, length: int, unit: str = "", default: Iterable[float] = ()) -> np.ndarray:
        """A list of `length` finite numbers, as float64 [length]; `default` (zeros if empty) after a fault."""
        fallback = np.array(list(default) or [0.0] * length, dtype=np.float64)
        if not isinstance(self.node, yaml.SequenceNode) or len(self.node.value) != length:
            got = f"{len(self.node.value)} values" if isinstance(self.node, yaml.SequenceNode) else self.shown()
            self.wrong(f"must be a list of {length} numbers{' in ' + unit if unit else ''} (got {got})")
            return fallback
        before = len(self.problems)
        values = [item.number(unit) for item in self.items()]
        return np.array(values, dtype=np.float64) if len(self.problems) == before else fallback

    def text(self, default: str = "") -> str:
        """A non-empty string."""
        if not isinstance(self.node, yaml.ScalarNode) or self.is_null() or not self.node.value.strip():
            self.wrong(f"must be a text (got {self.shown()})")
            return default
        if len(self.node.value) > MOST_LETTERS:
            self.wrong(f"must be a text of at most {MOST_LETTERS} letters (got {len(self.node.value)})")
            return default
        return self.node.value

    def choice(self, allowed: Iterable[str], default: str) -> str:
        """One word of `allowed`."""
        allowed = list(allowed)
        if isinstance(self.node, yaml.ScalarNode) and self.node.value in allowed:
            return self.node.value
        self.wrong(f"must be one of {', '.join(allowed)} (got {self.shown()})")
        return default

    def items(self) -> list[Value]:
        """The entries of a list."""
        if not isinstance(self.node, yaml.SequenceNode):
            self.wrong(f"must be a list (got {self.shown()})")
            return []
        return [Value(child, f"{self.path}[{i}]", self.problems) for i, child in enumerate(self.node.value)]

    def section(self, known: Iterable[str] | None = None, advice: str = "") -> Section:
        """A mapping; keys that are not in `known` are faults (None: any key goes, as for names)."""
        return Section(self, None if known is None else tuple(known), advice)


class Section:
    """A mapping of the file; `get` gives the value under a key."""

    def __init__(self, value: Value, known: tuple[str, ...] | None, advice: str) -> None:
        self.value = value
        self.line = value.line
        self._values: dict[str, Value] = {}
        self._is_mapping = isinstance(value.node, yaml.MappingNode)
        if not self._is_mapping:
            value.wrong(f"must be a mapping (got {value.shown()})")
            return
        first: dict[str, int] = {}
        for key_node, child in value.node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag not in _PLAIN_TAGS:
                value.problems.add(line, value.path, "a key must be a text without tags")
                continue
            key = key_node.value
            if len(key) > MOST_LETTERS:
                value.problems.add(line, value.path, f"a key of {len(key)} letters (at most {MOST_LETTERS})")
                continue
            path = f"{value.path}.{key}" if value.path else key
            if key in first:
                value.problems.add(line, path, f"the key appears twice (first on line {first[key]})")
                continue
            first[key] = line
            if known is not None and key not in known:
                hint = nearest(key, known) or advice or f"; known here: {', '.join(known)}"
                value.problems.add(line, path, f"unknown key{hint}")
                continue
            self._values[key] = Value(child, path, value.problems)

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def get(self, key: str) -> Value | None:
        """The value under `key`, or None."""
        return self._values.get(key)

    def __getitem__(self, key: str) -> Value:
        return self._values[key]

    def __iter__(self):
        return iter(self._values.items())

    def number(self, key: str, unit: str = "", *, default: float, **limits: float) -> float:
        """`Value.number` of a key that may be left out."""
        return self[key].number(unit, default=default, **limits) if key in self else default

    def vector(self, key: str, unit: str, default: Iterable[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
        """`Value.vector` of three numbers under a key that may be left out."""
        return self[key].vector(3, unit, default) if key in self else np.array(list(default), dtype=np.float64)

    def required(self, key: str) -> Value | None:
        """The value under `key`; its absence is a fault."""
        if key not in self:
            self.missing(key, "is required")
        return self.get(key)

    def missing(self, key: str, text: str) -> None:
        """Report something that is not there, at the mapping's own line (unless there is no mapping at all)."""
        if self._is_mapping:
            path = ".".join(part for part in (self.value.path, key) if part)
            self.value.problems.add(self.line, path, text)

    def one_of(self, keys: Iterable[str], *, required: bool) -> Value | None:
        """The value of the only one of `keys` that is there; more than one is a fault, none is one if `required`."""
        keys = tuple(keys)
        there = [key for key in keys if key in self]
        if len(there) > 1:
            self[there[1]].wrong(f"give only one of {', '.join(keys)} (got {' and '.join(there)})")
        if not there and required:
            self.missing("", f"one of {', '.join(keys)} is required")
        return self[there[0]] if there else None


def nearest(name: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` with the nearest known name, or an empty string."""
    known = [other for other in known if len(other) <= _ALIKE]
    if len(name) > _ALIKE or len(known) > 10 * _ALIKE:
        return ""
    match = difflib.get_close_matches(name, known, n=1, cutoff=0.55)
    return f" (did you mean '{match[0]}'?)" if match else ""
