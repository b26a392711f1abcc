"""Arguments that several commands share, and how a command runs."""

import inspect
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sdfsim.base.console import Session
from sdfsim.base.errors import EXIT_QUALITY


def seconds_of(text: str) -> float:
    """`90s`, `10m`, `1h` or plain seconds."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text.strip())
    if not match or float(match[1]) == 0:
        raise typer.BadParameter(f"{text!r} is not a length of time: write it as 90s, 10m or 1h")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, everything else on stderr.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Tracebacks with errors.")]
Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where to compute.")]
Outside = Annotated[bool, typer.Option("--allow-outside", help="Let the scene use files outside its own folder.")]
Out = Annotated[Path, typer.Option("-o", "--out", metavar="PATH", help="Folder to write.", show_default=False)]
Model = Annotated[str | None, typer.Option(help="Bundled model or path (default: the scene's, else the best one).")]
Budget = Annotated[
    float | None, typer.Option(parser=seconds_of, metavar="TIME", help="Time limit, such as 90s, 10m or 1h.")
]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster to run on, tcp://HOST:8786.")
]


def command(work: Callable[..., None]) -> Callable[..., None]:
    """Make a command of `work`: it gets a `Session`, and the options --json, --device and -v. If `work` takes no
    `device`, the option is still checked."""
    given = inspect.signature(work, eval_str=True).parameters

    @wraps(work)
    def run(*, as_json: bool, device: str, verbose: bool, **options: Any) -> None:
        with Session(as_json=as_json, verbose=verbose) as session:
            if device == "cuda":
                from sdfsim.base.devices import pick_device

                pick_device(device)
            session.options = options | ({"device": device} if "device" in given else {})
            work(session, **session.options)

    own = [parameter for name, parameter in given.items() if name not in ("session", "device")]
    shared = (("as_json", Json, False), ("device", Device, "auto"), ("verbose", Verbose, False))
    added = [inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=d, annotation=a) for n, a, d in shared]
    described: Any = run
    described.__signature__ = inspect.Signature([*own, *added])
    described.__annotations__ = work.__annotations__ | {name: kind for name, kind, _ in shared}
    return run


def print_failed(session: Session, report: dict) -> None:
    """Print every failed check; with one or more the exit code is 3."""
    for check in report["failed_checks"]:
        session.exit_code = EXIT_QUALITY
        session.say(f"failed check: {check}")
