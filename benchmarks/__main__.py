"""`python -m benchmarks NAME ...` runs the benchmark of that name, in the folder that holds them all."""

import sys
from importlib import import_module
from pathlib import Path

import typer

if __name__ == "__main__":
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    from sdfsim.base.errors import run_main

    here = sorted(file.stem for file in Path(__file__).parent.glob("[a-z]*.py") if file.stem != "records")
    if name not in here:
        sys.exit(f"usage: python -m benchmarks NAME ...   (NAME: {', '.join(here)})")
    module = import_module(f"benchmarks.{name}")
    app = typer.Typer(
        help=module.__doc__, no_args_is_help=False, add_completion=False, pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )  # fmt: skip
    for command in getattr(module, "COMMANDS", None) or [module.main]:
        app.command(help=command.__doc__ or module.__doc__)(command)
    del sys.argv[1]
    run_main(lambda: app(prog_name=f"python -m benchmarks {name}"))
