"""The commands, as the shell calls them."""

from typer.testing import CliRunner

import cli

SCENE = """
version: 1
duration: 0.2
shapes:
  ball: {sphere: {radius: 0.5}}
bodies:
  - {name: floor, plane: {}}
  - {name: ball, shape: ball, position: [0, 0, 5]}
"""


def run(*arguments: object):
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])
