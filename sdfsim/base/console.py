"""How a command reports: progress and errors on stderr, the result on stdout, and its exit code."""

import contextlib
import io
import json
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from functools import partial
from types import FrameType, TracebackType
from typing import Any

from sdfsim.base.errors import EXIT_ERROR, EXIT_INTERRUPTED, SceneError, SdfsimError, printable

_PLAIN_SECONDS = 5.0  # between two plain lines of one stage


class Session:
    """One command from start to exit code; a context manager around its work.

    Errors inside become one line and a hint on stderr, and a `SystemExit`: see `sdfsim.base.errors` for the codes. With
    `as_json` stdout carries exactly one JSON object (also for an error), and what libraries print goes to stderr.
    """

    def __init__(self, *, as_json: bool = False, verbose: bool = False) -> None:
        self.as_json = as_json
        self.verbose = verbose
        self.exit_code = 0
        self.options: dict[str, Any] = {}  # what the command was given
        self._result: dict[str, Any] | None = None
        self._pressed = False
        self._clean_up = contextlib.ExitStack()
        self._bar = _Bar()
        self.say = self._bar.say  # a line on stderr
        # Called with the name of a stage (each has its own bar and ETA), the fraction (0 to 1) of the work that is
        # done, and a message. `progress` is called without the name.
        self.stage_progress = self._bar.update
        self.progress = partial(self._bar.update, "")

    def __enter__(self) -> "Session":
        # Windows consoles show few characters; others are escaped, as Python already does on stderr.
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")
        default = signal.default_int_handler
        if signal.getsignal(signal.SIGINT) is default:
            signal.signal(signal.SIGINT, self._press)
            self._clean_up.callback(signal.signal, signal.SIGINT, default)
        if self.as_json:
            sys.stdout.flush()
            real = os.dup(1)  # native libraries write to the descriptor, past sys.stdout
            os.dup2(2, 1)
            self._clean_up.callback(os.close, real)
            self._clean_up.callback(os.dup2, real, 1)
            self._clean_up.enter_context(contextlib.redirect_stdout(sys.stderr))
        return self

    def _press(self, number: int, frame: FrameType | None) -> None:
        self._pressed = True  # a library that is interrupted during its import raises errors of its own
        raise KeyboardInterrupt

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        if error is not None and not isinstance(error, Exception | KeyboardInterrupt):
            self._clean_up.close()
            return
        if error is not None:
            self._explain(error)
        with self._clean_up:
            sys.stdout.flush()
        if self.as_json and self._result is not None:
            self._print(json.dumps(plain(self._result)))
        raise SystemExit(self.exit_code) from None

    def _explain(self, error: BaseException) -> None:
        """Print the error; its type decides the exit code."""
        hint, self.exit_code, more = "", EXIT_ERROR, {}
        if isinstance(error, SdfsimError):
            message, hint, self.exit_code = error.message, error.hint, error.exit_code
            more = {"problems": error.problems} if isinstance(error, SceneError) else {}
        elif isinstance(error, KeyboardInterrupt) or (self._pressed and not isinstance(error, OSError)):
            message, self.exit_code = "interrupted; finished work is kept", EXIT_INTERRUPTED
        elif isinstance(error, OSError):
            message = (f"{error.filename}: " if error.filename else "") + str(error.strerror or error)
        else:
            message = f"internal error: {type(error).__name__}: {error}"
            hint = "" if self.verbose else "this is a bug in sdfsim; -v shows where"
        if self.verbose:
            traceback.print_exc(file=sys.stderr)
        self.say("\n".join(f"error: {line}" for line in message.splitlines()))
        if hint:
            self.say(f"hint: {hint}")
        failure = {"error": message, "hint": hint, "exit_code": self.exit_code}
        self._result = (self._result or {}) | failure | more

    def _print(self, text: str) -> None:
        """Print on stdout. A reader that has closed the pipe, such as `head`, is not an error."""
        try:
            print(text, flush=True)
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else Python tries again when it exits, and prints an error
            if not isinstance(error, BrokenPipeError):
                self.say(f"error: the report cannot be written: {error.strerror}")
            self.exit_code = self.exit_code or EXIT_ERROR

    def report(self, result: dict[str, Any], lines: list[str] | None = None) -> None:
        """Print the outcome: `result` for --json, `lines` (or the entries of `result`) for people."""
        self._result = result
        if not self.as_json:
            self._bar.close()
            self._print("\n".join(map(printable, _as_lines(plain(result)) if lines is None else lines)))

    def given(self, *others: str) -> dict[str, Any]:
        """The options of the command except these: those that it passes on unchanged."""
        return {name: value for name, value in self.options.items() if name not in others}

    def hold(self, why: str) -> None:
        """Wait for Ctrl-C or another end of the process, such as `kill`. The report is printed before."""
        if self.as_json and self._result is not None:
            self._print(json.dumps(plain(self._result)))
            self._result = None
        self.say(why)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


class _Bar:
    """A progress bar with an ETA on a terminal; elsewhere a plain line every few seconds."""

    def __init__(self) -> None:
        self._progress: Any = None
        self._task: Any = None
        self._stage: str | None = None
        self._printed = 0.0
        self._ended = False

    def update(self, stage: str, fraction: float, message: str) -> None:
        fraction, now = min(max(fraction, 0.0), 1.0), time.monotonic()
        title = f"{stage}: {message}" if stage and message else stage or message
        fresh, self._stage = stage != self._stage, stage
        if sys.stderr.isatty():
            self._draw(fresh, fraction, title)
            return
        ended = fraction >= 1 and (fresh or not self._ended)
        if fresh or ended or (fraction < 1 and now - self._printed >= _PLAIN_SECONDS):
            self._printed, self._ended = now, fraction >= 1
            self.say(f"[{fraction:4.0%}] {title}")

    def _draw(self, fresh: bool, fraction: float, title: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Eta

        if self._progress is None:
            texts = TextColumn("{task.description}", markup=False)
            parts = (BarColumn(24), TaskProgressColumn(), TimeElapsedColumn(), "left:", Eta(), texts)
            self._progress = Progress(*parts, console=Console(stderr=True))
            self._progress.start()
        if fresh:
            self._task = self._progress.add_task(title, total=1.0)
        self._progress.update(self._task, completed=fraction, description=title)

    def say(self, text: str) -> None:
        if self._progress is not None:
            self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the bar and go to the next line."""
        if self._progress is not None:
            self._progress.stop()
        self._progress, self._stage = None, None


def duration(seconds: float) -> str:
    """`42 s`, `3 min 20 s`, `1 h 5 min`."""
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{rest} s"
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """The rows of a table as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def plain(value: Any) -> Any:
    """A value for JSON: NumPy numbers, arrays and paths become plain types; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _as_lines(result: dict[str, Any], indent: str = "") -> list[str]:
    lines = []
    for key, value in result.items():
        if isinstance(value, dict):
            lines += [f"{indent}{key}:", *_as_lines(value, indent + "  ")]
        else:
            lines.append(f"{indent}{key}: {f'{value:.6g}' if isinstance(value, float) else value}")
    return lines
