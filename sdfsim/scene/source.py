"""A scene file -> the nodes of its YAML, or one line saying why not. Whoever wrote it need not be a friend."""

from __future__ import annotations

import errno
from pathlib import Path

import yaml

from sdfsim.errors import SceneError
from sdfsim.scene.document import Problems, Value

MOST_BYTES = 16 * 2**20  # of a file
# By its aliases a file may grow to so many values, or to so many times what is written. No key lies deeper.
_FEW_VALUES, _MOST_GROWTH, _LEVELS = 100_000, 10, 8


def read_document(path: Path) -> Value:
    """Parse one YAML file into its root value.

    Raises:
        SceneError: when it is missing, too large, not UTF-8, not YAML (with the line), or empty, or when its aliases
            multiply it.
    """
    try:
        if path.exists() and not path.is_dir() and not path.is_file():
            raise OSError(errno.EINVAL, "not a file")  # a device or a pipe may have no end
        if path.is_file() and (size := path.stat().st_size) > MOST_BYTES:
            told = f"{size / 2**20:.0f} MiB, at most {MOST_BYTES // 2**20}"
            raise SceneError([f"{path}: too large for a scene ({told})"], "arrange makes many bodies of one entry")
        text = path.read_bytes().decode("utf-8")
    except FileNotFoundError as error:
        raise SceneError([f"{path}: no such file"], "give the path of a scene.yaml") from error
    except OSError as error:
        raise SceneError([f"{path}: cannot be read: {error.strerror}"], "give the path of a scene.yaml") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError([f"{path}:{line}: not a text in UTF-8"], "a scene is a YAML text file") from error
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise SceneError([f"{path}:{line}: not valid YAML: {error.problem or error.context}"]) from error
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        raise SceneError([f"{path}:{line}: not valid YAML: {error.reason}"]) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise SceneError([f"{path}:1: not valid YAML: {type(error).__name__}"]) from error
    if root is None:
        raise SceneError([f"{path}:1: the file is empty"], "a scene needs at least version and bodies")
    _check_growth(root, path)
    return Value(root, "", Problems(str(path)))


def _check_growth(root: yaml.Node, path: Path) -> None:
    """Raise SceneError where aliases of aliases make a huge document of a small file, or one without an end."""
    counts: dict[tuple[int, int], int] = {}  # values below a node, by it and the levels that are looked at
    written: dict[int, int] = {}  # by node: the same node is met again through its aliases

    def count(node: yaml.Node, levels: int) -> int:
        if isinstance(node, yaml.ScalarNode) or not levels:
            return 1
        if (id(node), levels) not in counts:
            parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
            written[id(node)] = len(parts)
            counts[id(node), levels] = 1 + sum(count(part, levels - 1) for part in parts)
        return counts[id(node), levels]

    grown, said = count(root, _LEVELS), sum(written.values())
    if grown > max(_FEW_VALUES, _MOST_GROWTH * said):
        raise SceneError([f"{path}:1: its aliases make {grown} values of the {said} that are written"])
