"""The page of results: every benchmark writes its own section, and only that."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.results import PAGE, write_section


def test_a_section_is_replaced_and_nothing_else(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- a -->\nold\n<!-- end of a -->\n\n<!-- b -->\nkept\n<!-- end of b -->\n")
    write_section("a", "python a.py", "| \\1 |", page)
    write_section("a", "python a.py", "| \\1 new |\n", page)
    assert page.read_text() == (
        "before\n\n<!-- a -->\n\n    python a.py\n\n| \\1 new |\n\n<!-- end of a -->\n\n"
        "<!-- b -->\nkept\n<!-- end of b -->\n"
    )
    with pytest.raises(ValueError, match="no section c"):
        write_section("c", "", "", page)


def test_the_page_has_a_section_for_every_benchmark_that_writes_one():
    sources = "".join(file.read_text() for file in Path(PAGE.parent).glob("*.py"))
    written = set(re.findall(r'write_section\("([^"]+)"', sources))
    there = re.findall(r"<!-- end of (.+) -->", PAGE.read_text())
    assert set(there) == written and len(there) == len(written) > 5
