"""The command line: puts the commands of all rooms together."""

import gc
from typing import Annotated

import typer

from pipeline.commands import distill, fit, joint, measure, mesh, poses, reconstruct
from sdfsim import commands

YOUNG = 100_000  # number of new objects after which Python looks for cycles

app = typer.Typer(
    name="sdfsim", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from sdfsim.base.version import __version__

        print(f"sdfsim {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Rigid-body simulation over learned signed-distance functions, from photos to commands."""
    # Libraries make some 100,000 objects that stay. Looking for cycles among them again and again while they load takes
    # a sixth of the time to the first step.
    gc.set_threshold(YOUNG)


COMMANDS = [reconstruct, measure, poses, distill, mesh, joint, fit]
COMMANDS += [commands.simulate, commands.samples, commands.plan, commands.view, commands.render, commands.identify]
COMMANDS += [commands.export, commands.dataset, commands.train, commands.evaluate, commands.tradeoff, commands.stress]
COMMANDS += [commands.play, commands.info]
for command in COMMANDS:
    app.command()(command)
app.command("import")(commands.import_)

if __name__ == "__main__":
    app()
