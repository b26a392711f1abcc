"""Named materials: how heavy, how rough and how bouncy a body is, and where each number comes from."""

import math
import re
from dataclasses import dataclass, replace

from sdfsim.base.errors import SdfsimError, nearest

CRC = "CRC Handbook of Chemistry and Physics"
TOOLBOX = "Engineering ToolBox"
FACTBOOK = "The Physics Factbook"
EUROCODE = "EN 1991-1-1"
ROUGH = "rough"
SCENERY = "scenery"  # the name of the static body
SURROUNDINGS = "surroundings"  # the name of the room around it
UNMOVED = ("floor", SCENERY, SURROUNDINGS)  # bodies whose mass never counts
_WALL = re.compile(r"(\d+\.?\d*|\.\d+)(mm|cm|m)", re.ASCII)
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True)
class Material:
    """A material, with typical numbers.

    A contact has the product of its two bodies' friction, and the product of their restitution. So `friction` is the
    square root of the material's friction on itself, adjusted within the published range for its other common pairs.
    `restitution` times concrete's 0.8 is the value for a ball of the material on a hard floor.
    """

    density: float  # kg/m^3
    friction: float  # Coulomb coefficient of the body itself
    restitution: float  # of the body itself
    # density_from, friction_from, restitution_from: the source; `rough` if the number is only plausible
    density_from: str = ROUGH
    friction_from: str = ROUGH
    restitution_from: str = ROUGH

    @property
    def source(self) -> str:
        """One line that names the source of each number."""
        return f"density: {self.density_from}; friction: {self.friction_from}; restitution: {self.restitution_from}"


ASSUMED = Material(400.0, 0.8, 0.4)  # of a light wood; photos do not show the material
MATERIALS = {
    "wood": Material(650, 0.65, 0.75, CRC, TOOLBOX, FACTBOOK),
    "plywood": Material(600, 0.65, 0.7),
    "cardboard": Material(690, 0.7, 0.5, CRC, TOOLBOX),
    "paper": Material(800, 0.6, 0.3, CRC),
    "ceramic": Material(2400, 0.65, 0.8, CRC),
    "glass": Material(2500, 0.65, 0.8, CRC, TOOLBOX, FACTBOOK),
    "steel": Material(7850, 0.75, 0.8, EUROCODE, TOOLBOX, FACTBOOK),
    "aluminium": Material(2700, 0.7, 0.7, CRC, TOOLBOX),
    "plastic": Material(1050, 0.6, 0.85, TOOLBOX, TOOLBOX, FACTBOOK),
    "rubber": Material(1100, 1.1, 0.95, CRC, TOOLBOX, FACTBOOK),
    "cork": Material(240, 0.7, 0.7, CRC),
    "foam": Material(30, 0.7, 0.5),
    "stone": Material(2650, 0.8, 0.8, CRC),
    "concrete": Material(2400, 0.8, 0.8, EUROCODE, TOOLBOX),
    "leather": Material(860, 0.65, 0.4, CRC, TOOLBOX),
    "textile": Material(200, 0.6, 0.2, ROUGH, TOOLBOX),
}


@dataclass(frozen=True)
class Choice:
    """The material of one body."""

    name: str = "assumed"  # in `MATERIALS`, or `assumed`
    material: Material = ASSUMED  # its numbers
    wall: float | None = None  # m, thickness of the wall of a hollow body; None for a solid one
    mass: float | None = None  # kg, in place of the density's; None if it is unknown


def materials_of(given: dict[str, str], masses: dict[str, float] | None = None) -> dict[str, Choice]:
    """Looks up the materials of bodies: for each body's name, a name in `MATERIALS`, optionally with the thickness of a
    hollow body's wall (mm, cm or m), such as `ceramic:4mm`; and adds known `masses`, kg, by body. Raises SdfsimError
    for an invalid entry."""
    found = {}
    for body, text in given.items():
        name, colon, thickness = text.partition(":")
        if name not in MATERIALS:
            message = f"material: {body}: no such material: {name!r}{nearest(name, MATERIALS)}"
            raise SdfsimError(message, "there are " + ", ".join(MATERIALS))
        if colon and body in UNMOVED:
            raise SdfsimError(f"material: {body}: needs no thickness: it does not move, so its mass does not matter")
        match = _WALL.fullmatch(thickness)
        wall = float(match[1]) * _METRES[match[2]] if match else None
        if colon and not wall:
            message = f"material: {body}: {thickness!r} is not the thickness of a wall"
            raise SdfsimError(message, "give one such as 4mm or 0.4cm")
        found[body] = Choice(name, MATERIALS[name], wall)
    for body, mass in (masses or {}).items():
        if body in UNMOVED:
            raise SdfsimError(f"mass: {body}: does not move, so its mass does not matter")
        if not 0 < mass < math.inf:
            raise SdfsimError(f"mass: {body}: must be more than 0 kg (got {mass:g})")
        found[body] = replace(found.get(body, Choice()), mass=mass)
    return found
