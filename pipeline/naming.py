"""Allowed names of bodies."""

import re

import yaml

# Names that a scene file uses already, and the folder of the scenery's shape.
TAKEN = ("scenery", "scene", "surroundings", "floor", "box", "ball")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
NAMING = f"use letters, digits, - and _, a letter first; not {', '.join(TAKEN)}"


def can_be_named(name: str) -> bool:
    """Whether a body can have this name in a scene file and as a folder."""
    # "no" would be read as False
    return bool(NAME.fullmatch(name)) and yaml.safe_load(name) == name and name not in TAKEN
