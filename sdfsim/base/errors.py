"""The error types of the project; commands and `run_main` turn them into one line, a hint and an exit code. And
warnings for callers from Python, in place of the lines that a command prints."""

import difflib
import itertools
import logging
import sys
from collections.abc import Callable, Iterable
from functools import cache

EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_QUALITY = 3
EXIT_INTERRUPTED = 130


def printable(text: str) -> str:
    """`text` with unprintable characters escaped: untrusted file names and keys may hold terminal codes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def nearest(name: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` with the nearest known name, or an empty string."""
    match = difflib.get_close_matches(name[:100], itertools.islice(known, 1000), n=1, cutoff=0.55)
    return f" (did you mean '{match[0]}'?)" if match else ""


@cache
def warn_once(line: str) -> None:
    """Warn, unless this process has given the same warning before: scenes are loaded again and again."""
    logging.getLogger(__name__).warning("%s", line)


class SdfsimError(Exception):
    """An error that a user can act on.

    Args:
        message: one line: what is wrong, with the file, line and field where they are known.
        hint: what to try, in one line (may be empty).
        exit_code: `EXIT_ERROR` (1), or `EXIT_QUALITY` (3) when the work ran but failed a quality check.
    """

    def __init__(self, message: str, hint: str = "", *, exit_code: int = EXIT_ERROR) -> None:
        message = "\n".join(map(printable, message.split("\n")))
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.exit_code = exit_code

    def __str__(self) -> str:
        """The message, and the hint in a line of its own."""
        return f"{self.message}\nhint: {self.hint}" if self.hint else self.message


class SceneError(SdfsimError):
    """A scene file that cannot be used; `problems` lists every fault found in it, one line each: `FILE:LINE: FIELD:
    what is wrong (what is allowed)`."""

    def __init__(self, problems: list[str], hint: str = "") -> None:
        self.problems = [printable(problem) for problem in problems]
        super().__init__("\n".join(self.problems), hint)


def run_main(main: Callable[[], None]) -> None:
    """Run a script's `main`; end the process with one line for an SdfsimError, or quietly on Ctrl-C."""
    try:
        main()
    except SdfsimError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
