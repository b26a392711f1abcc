"""What a hard case is, and the kinds of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from sdfsim.evaluation.hard_cases_measures import Measure
from sdfsim.scene.scene import Scene

Variant = Literal["float32", "bfloat16", "cuda"]


@dataclass(frozen=True)
class Figure:
    """One number that a case gives.

    Attributes:
        name: as `Measured.figures` calls it.
        unit: of the number.
        digits: shown after the point; differences that are not shown do not count.
        limit: what is wanted is at most this; None where only the teacher says how good one can be.
        largest: of several repetitions the largest counts, not the mean.
        judged: whether lower is better; the others tell, such as the height of a rebound.
        longer: higher is better instead.
    """

    name: str
    unit: str
    digits: int = 2
    limit: float | None = None
    largest: bool = False
    judged: bool = True
    longer: bool = False


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: unique, fit for a file.
        group: name of the `Group` it belongs to.
        title: what it is.
        scenes: the scenes of one repetition, given its number; repetition 0 is the case as it is meant.
        measure: of the motions of these scenes, in their order.
        figures: what `measure` gives.
        seconds: how long.
        steps: how many steps instead.
        repeats: repetitions, from starts slightly off or with other random scenes: their spread is the noise.
        variant: the scenes are simulated a second time in this way, behind the first; "float32" is no second time.
        teacher: whether the teacher can take part.
        x: where it stands in its group's plot of the first figure; None for a case that is not one of a row.
    """

    name: str
    group: str
    title: str
    scenes: Callable[[int], list[Scene]]
    measure: Measure
    figures: tuple[Figure, ...]
    seconds: float = 3.0
    steps: int | None = None
    repeats: int = 3
    variant: Variant = "float32"
    teacher: bool = True
    x: float | None = None


@dataclass(frozen=True)
class Group:
    """Cases of one kind.

    Attributes:
        title: what they have in common.
        wanted: what a good model does, in words.
        about: the quantity of a model's ranges that the cases are about: one that never varied was not learned.
        axis: label of the cases' `x`.
        curve: labels (x, y) of what a case draws.
    """

    title: str
    wanted: str
    about: str = ""
    axis: str = ""
    curve: tuple[str, str] = ("", "")


TIME = "time (s)"
GROUPS = {
    "yaw": Group(
        "the whole scene turned about the vertical",
        "the same motion: what is left is rounding, grown by collisions",
        curve=(TIME, "deviation (% of size)"),
    ),
    "overlap": Group(
        "bodies that start inside each other", "they part at less than 3 m/s", curve=(TIME, "fastest body (m/s)")
    ),
    "thin": Group("fast bodies of 20 cm and a plate of 1 cm", "none passes through", axis="speed (m/s)"),
    "rest": Group(
        "bodies at rest on the floor",
        "drift below 1 % of size, below 0.01 m/s, height within 5 %; with sleep on exactly still",
        curve=(TIME, "drift (% of size)"),
    ),
    "stack": Group(
        "stacks", "all still stand after 3 s", axis="cubes in the tower", curve=(TIME, "largest shift (% of size)")
    ),
    "mass": Group(
        "a heavy cube on a light one",
        "as little penetration as the teacher, and no collapse",
        about="mass_ratio",
        axis="mass ratio",
        curve=(TIME, "largest shift (% of size)"),
    ),
    "bounce": Group(
        "balls dropped from about 1 m",
        "a rebound of e^2 times the height, within 5 % of it",
        about="restitution",
        axis="restitution e of the contact",
        curve=(TIME, "height of its lowest point (m)"),
    ),
    "slope": Group(
        "a box at rest on a slope",
        "it begins to slide within 2 degrees of atan(mu)",
        about="friction",
        axis="friction mu of the contact",
        curve=("degrees beyond atan(mu)", "travelled in 2 s (m)"),
    ),
    "pile": Group(
        "a pile in a bowl",
        "no body through the wall, no energy from nothing, penetration as the teacher's",
        axis="bodies",
        curve=(TIME, "energy (% of the start's)"),
    ),
    "energy": Group("random scenes: energy from nothing", "no step adds more than 1 % of the energy at the start"),
    "precision": Group(
        "other arithmetic: time until motions are 10 % of a body's size apart",
        "as late as for a start 1e-6 m/s off",
        curve=(TIME, "apart (% of size)"),
    ),
}


def group_order(found: Sequence[Case]) -> list[str]:
    """Names of the groups of some cases, in their order."""
    return list(dict.fromkeys(case.group for case in found))
