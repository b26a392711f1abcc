"""Shapes, scenes and runs for other programs: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdfsim.commands.arguments import Outside, command
from sdfsim.console import Session


@command
def export(
    session: Session,
    source: Annotated[Path, typer.Argument(help="Run folder, rollout.npz, scene.yaml or Shape folder.")],
    out: Annotated[
        Path,
        typer.Option("-o", "--out", metavar="FILE", help="Ends in .glb .usd .usda .usdc .xml .mjcf .urdf or .csv."),
    ],
    scene: Annotated[Path | None, typer.Option(help="scene.yaml of a run (default: that of the run folder).")] = None,
    allow_outside: Outside = False,
) -> None:
    """Shape, scene or run -> a file of other programs (docs/export.md)."""
    from sdfsim import export as room

    report = room.export(source, out, scene_file=scene, allow_outside=allow_outside, on_progress=session.stage_progress)
    files = report["files"]
    lines = [
        f"bodies {report['bodies']}, frames {report['frames']}",
        f"wrote {files[0]}" + (f" and {len(files) - 1} files beside it" if len(files) > 1 else ""),
        *(f"not in it: {line}" for line in report["left_out"]),
    ]
    session.report(report, lines)
