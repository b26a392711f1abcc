"""Shared by benchmarks: command lines, lines of progress, and the pages of results with one section per benchmark."""

import argparse
import inspect
import re
import typing
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from sdfsim.base.errors import run_main
from sdfsim.base.files import write_text
from sdfsim.evaluation.harness import number

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path(__file__).with_name("RESULTS.md")


def script(doc: str | None, *functions: Callable[..., None]) -> None:
    """Run a function with the arguments of the command line, which names the function first if there are several.

    Keyword-only parameters are options, `out` also as -o; lists take several values.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True) if len(functions) > 1 else None
    for function in functions:
        own = commands.add_parser(function.__name__) if commands else parser
        own.set_defaults(function=function)
        hints = typing.get_type_hints(function)
        for name, parameter in inspect.signature(function).parameters.items():
            usual, needed = parameter.default, parameter.default is parameter.empty
            hint, *other = typing.get_args(hints[name]) or [hints[name]]
            hint = hint if type(None) in other else hints[name]
            given: dict[str, Any] = {"type": (*typing.get_args(hint), hint)[0], "default": None if needed else usual}
            if typing.get_origin(hint) is list:
                given["nargs"] = "+"
            if usual is False:
                given = {"action": "store_true"}
            if parameter.kind is parameter.KEYWORD_ONLY:
                names = [f"--{name.replace('_', '-')}", *(["-o"] if name == "out" else [])]
                own.add_argument(*names, required=needed, **given)
            else:
                own.add_argument(name, **(given if needed else given | {"nargs": "?"}))
    chosen = vars(parser.parse_args())
    run_main(lambda: chosen.pop("function")(**chosen))


def progress(fraction: float, message: str) -> None:
    print(f"{fraction:6.1%}  {message}", flush=True)


def in_turn(calls: Sequence[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Results of the calls, [rounds, calls, ...], in alternating order, so that other work on the machine slows all of
    them alike. A first round, which loads and compiles, is left out."""
    return np.array([[call() for call in calls] for _ in range(rounds + 1)])[1:]


def spread(values: np.ndarray) -> str:
    """Median and range of [rounds]."""
    return f"{number(float(np.median(values)))} ({number(values.min())} to {number(values.max())})"


def pages() -> list[Path]:
    """The pages that may hold sections of benchmarks: RESULTS.md, docs/notes and docs."""
    return [PAGE, *sorted((ROOT / "docs" / "notes").glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]


def page_of(name: str) -> Path:
    """The page that holds a section. Raises ValueError if none does."""
    found = [page for page in pages() if f"<!-- {name} -->" in page.read_text(encoding="utf-8")]
    if not found:
        raise ValueError(f"no section {name} in RESULTS.md, docs/notes or docs")
    return found[0]


def section(name: str, page: Path | None = None) -> str:
    """The text between the marks of a section, with its command first."""
    text = (page or page_of(name)).read_text(encoding="utf-8")
    return text.partition(f"<!-- {name} -->")[2].partition(f"<!-- end of {name} -->")[0].strip()


def write_section(name: str, command: str, content: str, page: Path | None = None) -> None:
    """Print `content`, and write it between the marks of a section, below the command that repeats it and the day.

    The default page is the one of `pages` that has the section.

    Raises:
        ValueError: the page, or every page, has no such section.
    """
    print(content)
    page = page or page_of(name)
    marks = f"<!-- {name} -->", f"<!-- end of {name} -->"
    day = date.today()
    head = f"    {command}        # {day.day} {day:%B %Y}"
    text, shown = page.read_text(encoding="utf-8"), f"{marks[0]}\n\n{head}\n\n{content.strip()}\n\n{marks[1]}"
    pattern = re.compile(f"{re.escape(marks[0])}.*?{re.escape(marks[1])}", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"{page}: no section {name}")
    write_text(page, pattern.sub(lambda _: shown, text, count=1))
