"""Shows records (`benchmarks/results`) on RESULTS.md, README.md and the pages of docs.

    python -m benchmarks render

A page shows a record between `<!-- NAME -->` and `<!-- end -->`: its command, day, data, table and notes. A part of its
table is between `<!-- NAME[ROWS][COLUMNS] -->` and `<!-- end -->`: names separated by semicolons, none for all. A row
has the name of its first cell, or of its first two with a comma. One row and one column are a number in a sentence.
"""

import re
from collections.abc import Sequence
from datetime import date

from benchmarks.records import RECORDS, ROOT, UNKNOWN, Record, read_record, shown, table
from sdfsim.base.errors import SdfsimError
from sdfsim.base.files import write_text

MARK = re.compile(r"<!-- (\w+)(?:\[([^]]*)\]\[([^]]*)\])? -->.*?<!-- end -->", re.DOTALL)
PAGES = [ROOT / "README.md", RECORDS.with_name("RESULTS.md"), *sorted((ROOT / "docs").rglob("*.md"))]


def rendered(page: str) -> str:
    """A page with what its marks name. Raises SdfsimError for a record, row or column that is absent."""
    return MARK.sub(lambda mark: f"{mark[0].partition('-->')[0]}-->{_part(*mark.groups())}<!-- end -->", page)


def _part(name: str, rows: str | None, columns: str | None) -> str:
    record = read_record(name)
    if rows is None or columns is None:
        return f"\n\n{_whole(record)}\n"
    down = _indices(name, rows, [[str(cell) for cell in row[:2]] for row in record.rows])
    across = _indices(name, columns, [[column] for column in record.columns])
    part = [[record.rows[k][c] for c in across] for k in down]
    if rows and columns and len(down) == len(across) == 1:
        (cell,) = part[0]
        return shown(cell[0] if isinstance(cell, list) else cell)
    return f"\n\n{table([record.columns[c] for c in across], part)}\n"


def _indices(record: str, names: str, known: Sequence[Sequence[str]]) -> list[int]:
    found: list[int] = []
    for name in names.split(";") if names else ():
        at = [k for k, cells in enumerate(known) if name.strip() in (cells[0], ", ".join(cells))]
        if len(at) != 1:
            raise SdfsimError(f"{record}: {len(at)} rows or columns are called {name.strip()!r}")
        found += at
    return found or list(range(len(known)))


def _whole(record: Record) -> str:
    day = "day unknown" if record.day == UNKNOWN else f"{date.fromisoformat(record.day):%-d %B %Y}"
    origin = [f"commit {record.commit}" if record.commit != UNKNOWN else UNKNOWN, record.machine]
    head = f"    {record.command}        # {', '.join([day, *(part for part in origin if part != UNKNOWN)])}"
    notes = "".join(f"{line}\n" for line in record.notes)
    parts = (head, record.data, table(record.columns, record.rows).strip(), notes.strip())
    return "\n\n".join(filter(None, parts)) + "\n"


def main() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := rendered(text)) != text:
            write_text(page, new)
            print(page.relative_to(ROOT))
