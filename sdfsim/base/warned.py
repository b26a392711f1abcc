"""Tells who calls from Python what a command would print."""

import logging

_log = logging.getLogger(__name__)
_said: set[str] = set()


def warn_once(line: str) -> None:
    """Warn, unless the same line has been said in this process: scenes are loaded again and again."""
    if line not in _said:
        _said.add(line)
        _log.warning("%s", line)
