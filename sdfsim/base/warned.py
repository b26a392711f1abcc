"""Warnings for callers from Python, in place of the lines that a command prints."""

import logging

_log = logging.getLogger(__name__)
_said: set[str] = set()


def warn_once(line: str) -> None:
    """Warn, unless this process has given the same warning before: scenes are loaded again and again."""
    if line not in _said:
        _said.add(line)
        _log.warning("%s", line)
