"""Where the compiled code of the step is kept: in the user's cache folder, under a hash of all files of the step."""

from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path

from sdfsim.base.compiling import cache_of, kept


def sources() -> list[Path]:
    """The files of the compiled step."""
    here = Path(__file__).parent
    files = [*sorted(here.glob("*.py")), here.parent / "joint_columns.py"]
    return [file for file in files if file.name != "prepare.py"]


@cache
def code_folder() -> Path:
    """The folder of the compiled step, named after a hash of its source."""
    return cache_of(sources())


def kept_here() -> AbstractContextManager[None]:
    """Keep the compiled code of functions that are defined in the block in the folder of the compiled step."""
    return kept(code_folder())
