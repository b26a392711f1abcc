"""The command line: puts the commands of all rooms together."""

from __future__ import annotations

import typer

from pipeline.commands import distill, fit, mesh, poses, reconstruct
from sdfsim.commands.learning import dataset, evaluate, train
from sdfsim.commands.simulating import identify, info, plan, simulate, view
from sdfsim.commands.studying import stress, tradeoff

app = typer.Typer(
    name="sdfsim",
    help="Rigid-body simulation over learned signed-distance functions, from photos to motion.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    reconstruct,
    poses,
    distill,
    mesh,
    fit,
    simulate,
    plan,
    view,
    identify,
    dataset,
    train,
    evaluate,
    tradeoff,
    stress,
    info,
):
    app.command()(command)

if __name__ == "__main__":
    app()
