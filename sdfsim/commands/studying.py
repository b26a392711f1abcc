"""Studies of the simulator: tradeoff, stress."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sdfsim.commands.arguments import Out, command, tell_failed
from sdfsim.console import Session, columns

Models = Annotated[
    list[str] | None, typer.Option(help="Bundled model or path; may be given again (default: all bundled ones).")
]


@command
def tradeoff(
    session: Session,
    out: Out,
    source: Annotated[
        Path | None,
        typer.Argument(metavar="SCENE|DATA_DIR", help="scene.yaml or dataset folder (default: a random scene)."),
    ] = None,
    model: Models = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few settings, in minutes.")] = False,
) -> None:
    """What accuracy costs in time: knobs, models and engines on the same scenes; what is measured is kept in -o."""
    from sdfsim.evaluation import tradeoff as study
    from sdfsim.evaluation.harness import check_matplotlib

    check_matplotlib()
    report = study.tradeoff(source, out, models=model or [], quick=quick, on_progress=session.stage_progress)
    rows, notes = study.told(report)
    session.report(report, [*columns(rows), *notes])


@command
def stress(
    session: Session,
    out: Out = Path("stress"),
    model: Models = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter cases, in minutes.")] = False,
    shapes: Annotated[
        Path | None, typer.Option(help="Folder of meshes that are to rest on the floor too, or ycb: downloaded once.")
    ] = None,
    device: str = "auto",
) -> None:
    """The hard cases, with every model and the teacher: a table, plots, and recordings of what went wrong."""
    from sdfsim.evaluation import stress as study
    from sdfsim.evaluation.harness import check_matplotlib

    check_matplotlib()
    options: Any = {"models": model or [], "quick": quick, "shapes": shapes, "device": device}
    found = study.stress(out, **options, on_progress=session.progress)
    report = study.write_report(found, out)
    tell_failed(session, report)
    table = columns(study.rows(found, {"missed": "!", "behind": "<"}))
    notes = ["! beyond what is wanted, < worse than the teacher", *study.loss_lines(found), f"wrote {out}"]
    session.report(report, [*table, *notes])
