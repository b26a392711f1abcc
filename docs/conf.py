"""The site: the pages for users, and a reference of the Python interface and the commands, from docstrings and help.

sphinx-build -W -c docs . build/site
"""

import re
import sys
from importlib import import_module
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = html_title = "sdfsim"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme, root_doc = "furo", "README"
REFERENCE = ROOT / "build" / "reference"  # written below, where git ignores it
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "benchmarks/RESULTS.md", "sdfsim/models/*.md")
include_patterns = [*PAGES, "build/reference/*"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # the cards of models begin at the second level
autodoc_default_options = {
    "members": True,
    "member-order": "bysource",
    "inherited-members": "BaseException,Exception,VectorEnv,tuple",
}
html_copy_source = smartquotes = False
html_static_path = html_css_files = ["site.css"]
napoleon_use_ivar = True

CONTENTS = {
    "Begin": "docs/install docs/tutorial docs/python docs/scene docs/viewing",
    "Photos and films": "docs/photos docs/objects docs/identify",
    "Robots, and other programs": "docs/robotics docs/joints docs/vfx docs/import-and-export",
    "How good it is": "benchmarks/RESULTS docs/stability docs/effects docs/paper",
    "Makers": "docs/how-it-works CONTRIBUTING CHANGELOG sdfsim/models/gnn sdfsim/models/sdf-sim",
    "Reference": "build/reference/python build/reference/commands",
}
LED_TO = {  # what users meet through a name of the package, in `sdfsim`
    "Simulator": "simulate.body.BodyHandle simulate.joint.JointHandle simulate.body.FrameHandle "
    "simulate.body.ContactPoint simulate.record.Recording simulate.simulator.SimulationError",
    "Batch": "envs.task.Task",
    "Camera": "simulate.camera.Image",
    "judged": "evaluation.instruments.Verdict",
    "play": "apps.play.Playing",
}


def write_reference() -> None:
    """A page for every public name, with what it leads to, and one for the commands."""
    import sdfsim

    REFERENCE.mkdir(parents=True, exist_ok=True)
    sdfsim.Scene.__name__ = "Scene"  # as users know it
    toc = "\n".join(sdfsim.__all__)
    (REFERENCE / "python.rst").write_text(
        f"Python\n======\n\nEvery name of ``sdfsim``. Pages begin with it in use: :doc:`/docs/python`.\n\n"
        f".. toctree::\n   :maxdepth: 1\n\n   {toc}\n".replace(toc, toc.replace("\n", "\n   "))
    )
    for name in sdfsim.__all__:
        blocks = [f"sdfsim.{name}\n{'=' * 40}\n"]
        for place in (name, *LED_TO.get(name, "").split()):
            module, _, last = f"sdfsim.{place}".rpartition(".")
            found = getattr(import_module(module), last)
            kind = "function" if not isinstance(found, type) else "class"
            kind = "exception" if kind == "class" and issubclass(found, Exception) else kind
            blocks += [f"{last}\n{'-' * 40}\n"] * (place != name) + [f".. auto{kind}:: sdfsim.{place}\n"]
        (REFERENCE / f"{name}.rst").write_text("\n".join(blocks))
    (REFERENCE / "commands.md").write_text(commands())


def commands() -> str:
    """Every command with its arguments and options, as `--help` has them."""
    import typer.main

    import cli

    program = typer.main.get_command(cli.app)
    lines = ["# Commands", "", "What `sdfsim COMMAND --help` prints."]
    for name, command in sorted(program.commands.items()):
        with (
            click.Context(program, info_name="sdfsim") as above,
            command.context_class(command, info_name=name, parent=above) as context,
        ):
            usage = command.get_usage(context).removeprefix("Usage: ")
            lines += ["", f"## sdfsim {name}", "", "```text", usage, "```", "", _plain(command.help or "")]
            lines += ["", "| | |", "| --- | --- |"]
            for parameter in command.get_params(context):
                if record := parameter.get_help_record(context):
                    lines.append("| `{}` | {} |".format(*(_plain(text) for text in record)))
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


CODE = re.compile(r"(?:(?<=\n\n)|\A)((?: {4}.*\n|\n(?= {4}))+)")  # indented after an empty line


def to_rst(app, what, name, thing, options, lines) -> None:
    """Docstrings are written as Markdown: `code`, and blocks of code that are indented after an empty line."""
    if what == "property":  # napoleon takes what is before a colon for a type
        lines[0] = lines[0].replace(": ", "; ")
    parts = CODE.split("\n".join(lines) + "\n")
    lines[:] = "".join(f"::\n\n{part}\n" if k % 2 else _spans(part) for k, part in enumerate(parts)).split("\n")


def _spans(text: str) -> str:
    parts = re.split(r"`+([^`]+)`+", text)
    parts[1::2] = [f"``{' '.join(code.split())}``" for code in parts[1::2]]
    parts[::2] = [re.sub(r"[*|]|(?<=\w)_(?!\w)", r"\\\g<0>", said) for said in parts[::2]]
    return "".join(parts)


def add_contents(app, docname: str, source: list[str]) -> None:
    """The first page leads to all others; on GitHub it has a table in their place."""
    if docname == root_doc:
        for caption, pages in CONTENTS.items():
            tree = "\n".join(f"/{page}" for page in pages.split())
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{tree}\n```\n"


def short(app, what, name, thing, options, signature, returned):
    """Types without their modules."""
    texts = (text and re.sub(r"~[\w.]*\.(?=\w)", "", text) for text in (signature, returned))
    return tuple(text and re.sub(r"<(factory|function [^>]*>?)>", "...", text) for text in texts)


def setup(app) -> None:
    write_reference()
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", to_rst, priority=400)
    app.connect("autodoc-process-signature", short)
