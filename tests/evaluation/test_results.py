"""Benchmarks take what their functions say, and each writes its own section of the page of results, and only that."""

import re
import sys
from datetime import date
from pathlib import Path

import pytest

from benchmarks import results
from benchmarks.results import PAGE, page_of, pages, script, section, write_section

SEEN: list[tuple] = []


def few(data: Path | None = None, *, quick: bool = False) -> None:
    SEEN.append((data, quick))


def many(data: list[Path], *, out: Path, minutes: list[float] = [5.0], seeds: int | None = None) -> None:  # noqa: B006
    SEEN.append((data, out, minutes, seeds))


def cut(*, at: list[str] | None = None, share: float | None = None) -> None:
    SEEN.append((at, share))


@pytest.mark.parametrize(
    ("line", "functions", "seen"),
    [
        ("", [few], (None, False)),
        ("here --quick", [few], (Path("here"), True)),
        ("few here", [few, many], (Path("here"), False)),
        ("many a b -o c --minutes 2 5 --seeds 3", [few, many], ([Path("a"), Path("b")], Path("c"), [2.0, 5.0], 3)),
        ("", [cut], (None, None)),
        ("--at left 3,4 --share 0.5", [cut], (["left", "3,4"], 0.5)),
        ("many a --out c", [few, many], ([Path("a")], Path("c"), [5.0], None)),
    ],
)
def test_a_signature_is_a_command_line(monkeypatch, line, functions, seen):
    monkeypatch.setattr(sys, "argv", ["script", *line.split()])
    script("", *functions)
    assert SEEN[-1] == seen


def test_a_section_is_replaced_and_nothing_else(tmp_path, monkeypatch):
    """It says on which day."""
    monkeypatch.setattr(results, "date", type("Day", (), {"today": staticmethod(lambda: date(2026, 3, 9))}))
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- a -->\nold\n<!-- end of a -->\n\n<!-- b -->\nkept\n<!-- end of b -->\n")
    write_section("a", "python a.py", "| \\1 |", page)
    write_section("a", "python a.py", "| \\1 new |\n", page)
    assert page.read_text() == (
        "before\n\n<!-- a -->\n\n    python a.py        # 9 March 2026\n\n| \\1 new |\n\n<!-- end of a -->\n\n"
        "<!-- b -->\nkept\n<!-- end of b -->\n"
    )
    assert section("a", page).endswith("| \\1 new |") and section("b", page) == "kept"
    with pytest.raises(ValueError, match="no section c"):
        write_section("c", "", "", page)
    with pytest.raises(ValueError, match="no section c"):
        write_section("c", "", "")


def test_a_section_is_written_where_it_stands(tmp_path, monkeypatch):
    """On whichever page: RESULTS.md, one of docs, or a note."""
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "PAGE", tmp_path / "RESULTS.md")
    (tmp_path / "docs" / "notes").mkdir(parents=True)
    places = {"a": tmp_path / "RESULTS.md", "b": tmp_path / "docs" / "b.md", "c": tmp_path / "docs" / "notes" / "c.md"}
    for name, file in places.items():
        file.write_text(f"<!-- {name} -->\n<!-- end of {name} -->\n")
    for name, file in places.items():
        write_section(name, "python x.py", f"of {name}")
        assert page_of(name) == file and f"of {name}\n" in file.read_text()


def test_there_is_a_section_for_every_benchmark_that_writes_one():
    sources = "".join(file.read_text() for file in Path(PAGE.parent).glob("*.py"))
    written = set(re.findall(r'write_section\(\s*"([^"]+)"', sources))
    written |= {"MOVi-B", "MOVi-C", "strangers mesh", "strangers photos", "strangers recordings"}  # by their data
    there = [name for page in pages() for name in re.findall(r"<!-- end of (.+) -->", page.read_text())]
    there.remove("hard cases")  # on two pages
    assert set(there) == written and len(there) == len(written) > 5
