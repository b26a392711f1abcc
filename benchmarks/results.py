"""RESULTS.md: one section a benchmark, each written by the benchmark itself."""

from __future__ import annotations

import re
from pathlib import Path

from sdfsim.files import write_text

PAGE = Path(__file__).with_name("RESULTS.md")


def write_section(name: str, command: str, content: str, page: Path = PAGE) -> None:
    """Put `content` between the marks of a section, under the command that repeats it.

    Raises:
        ValueError: the page has no such section.
    """
    marks = f"<!-- {name} -->", f"<!-- end of {name} -->"
    text, shown = page.read_text(encoding="utf-8"), f"{marks[0]}\n\n    {command}\n\n{content.strip()}\n\n{marks[1]}"
    pattern = re.compile(f"{re.escape(marks[0])}.*?{re.escape(marks[1])}", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"{page}: no section {name}")
    write_text(page, pattern.sub(lambda _: shown, text, count=1))
