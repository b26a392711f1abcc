"""The table of all laws: what `sdfsim stress`, the tests and the benchmarks run.

    python -m sdfsim.evaluation.laws.table [LAW ...] [--size 0.1] [--yaw 0] [--kind analytic] [--full]

prints a line for each check: the measured value, the wanted one, and whether the check holds. `--size` is the unit of
length (the size of the smallest bodies), `--yaw` turns the whole scene about the vertical, and `--kind` says how solids
are given: in closed form, as the exact distance of a mesh, or as samples of it on a grid. Hard cases, joints and
assembly have scenes of their own, which these do not change.
"""

import argparse
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from typing import NamedTuple

from sdfsim.evaluation.laws.assembly import ASSEMBLY
from sdfsim.evaluation.laws.everyday import EVERYDAY
from sdfsim.evaluation.laws.hard_cases import hard_cases
from sdfsim.evaluation.laws.joints import JOINTS
from sdfsim.evaluation.laws.scenes import KINDS, SIZES, Check, Law, Setting
from sdfsim.evaluation.laws.textbook import TEXTBOOK
from sdfsim.shape.shape import Shape


class Group(NamedTuple):
    title: str
    axis: str = ""  # label of the laws' `x`


GROUPS = {
    "yaw": Group("the whole scene turned about the vertical"),
    "overlap": Group("bodies that start inside each other"),
    "thin": Group("fast bodies of 20 cm and a plate of 1 cm", "speed (m/s)"),
    "rest": Group("bodies at rest on the floor"),
    "stack": Group("stacks, after 3 s"),
    "pile": Group("a pile in a bowl", "bodies"),
    "energy": Group("random scenes: energy from nothing"),
    "precision": Group("other arithmetic: time until motions are 10 % of a body's size apart"),
    "everyday": Group("everyday scenes: checks that do not hold"),
    "textbook": Group("laws of a textbook: checks that do not hold"),
    "joints": Group("laws of joints: checks that do not hold"),
    "assembly": Group("meshes that fit into each other: checks that do not hold"),
}

ROWS = {
    row.__name__: Law(row.__name__, group, row.__name__.replace("_", " "), row, engines=False, counted=True)
    for group, rows in (("everyday", EVERYDAY), ("textbook", TEXTBOOK), ("joints", JOINTS), ("assembly", ASSEMBLY))
    for row in rows
}


def laws(*, quick: bool = False, shapes: Mapping[str, Shape] | None = None) -> list[Law]:
    """The whole table; `quick` has fewer and shorter hard cases, and `shapes` are more bodies to rest on the floor."""
    return [*hard_cases(quick=quick, shapes=shapes), *ROWS.values()]


def settings(law: Law, *, quick: bool = False) -> list[Setting]:
    """How a counted law is run in reports."""
    if quick or law.group in ("joints", "assembly"):
        return [Setting()]
    return [*(Setting(size) for size in SIZES), Setting(yaw=37.0), *(Setting(kind=kind) for kind in KINDS[1:])]


def checks(law: Law, at: Setting) -> Iterator[tuple[str, Check]]:
    """Every check of a law with its full name, as in lists."""
    for check in law.checks(at):
        yield f"{law.name}: {check.name} [{at}]", check


def main(arguments: Iterable[str] | None = None) -> int:
    table = {law.name: law for law in laws()}
    parser = argparse.ArgumentParser(prog="python -m sdfsim.evaluation.laws.table", description=__doc__)
    parser.add_argument("law", nargs="*", help=f"of {', '.join(table)}; none for all everyday scenes")
    parser.add_argument("--size", type=float, nargs="*", default=[0.1])
    parser.add_argument("--yaw", type=float, nargs="*", default=[0.0])
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=["analytic"])
    parser.add_argument("--full", action="store_true", help="all random scenes and long runs")
    parser.add_argument("--failed", action="store_true", help="print only checks that do not hold")
    given = parser.parse_args(None if arguments is None else list(arguments))
    held = total = 0
    names = given.law or [name for name, law in table.items() if law.group == "everyday"]
    chosen = [Setting(*how, given.full) for how in product(given.size, given.yaw, given.kind)]
    for name, at in product(names, chosen):
        print(f"--- {name} [{at}]", flush=True)
        for check in table[name].checks(at):
            held, total = held + check.holds, total + 1
            if not (given.failed and check.holds):
                print(check, flush=True)
    print(f"{held} of {total} hold")
    return 0 if held == total else 1


if __name__ == "__main__":
    raise SystemExit(main())
