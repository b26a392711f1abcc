"""Seeds faults into the contact solve, one at a time, and says which laws catch each: a check of the table of laws.

    python scripts/seeded_faults.py [--only NAME ...]     # all: about an hour and a half on one core

Each fault replaces text in a copy of the package in a temporary folder, in which its laws run as plain Python: nothing
is compiled. A fault is caught if a check fails, or a law ends with an error, that does not without the fault. Ends with
code 1 if a fault is not caught.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "sdfsim"
LONGEST = 1800.0  # s that the laws of a fault may take


@dataclass(frozen=True)
class Fault:
    name: str
    file: str  # in sdfsim/physics/solver
    edits: tuple[tuple[str, str], ...]  # each text is in the file exactly once, and what replaces it
    laws: str  # arguments of `python -m sdfsim.evaluation.laws.table`


def fault(name: str, file: str, laws: str, *edits: str) -> Fault:
    return Fault(name, file, tuple(zip(edits[::2], edits[1::2], strict=True)), laws)


FAULTS = (
    fault(
        "torque of friction has the wrong sign",
        "rows.py",
        "slopes",
        "w = along(along(w, three(p, TURN), one), three(q, TURN), other)",
        "w = along(along(w, three(p, TURN), -one), three(q, TURN), -other)",
    ),
    fault(
        "restitution is applied twice",
        "contacts.py",
        "head_on",
        "bounce = world.restitution[a] * world.restitution[b] if",
        "bounce = (world.restitution[a] * world.restitution[b]) ** 2 if",
    ),
    fault(
        "coefficients of friction are added",
        "contacts.py",
        "slopes",
        "friction = world.friction[a] * world.friction[b] if",
        "friction = world.friction[a] + world.friction[b] if",
    ),
    fault(
        "the cone of friction is a box",
        "rows.py",
        "cones",
        "length = math.sqrt(one * one + other * other)",
        "length = max(abs(one), abs(other))",
    ),
    fault(
        "a contact point is in the wrong body's frame",
        "contacts.py",
        "elastic",
        "turn(matrix, b, three(point, SECOND))",
        "turn(matrix, a, three(point, SECOND))",
    ),
    fault(
        "known impulses are not applied",
        "solve.py",
        "slopes",
        "            if rows.row[c, e, IMPULSE] != 0.0:\n",
        "            if rows.row[c, e, IMPULSE] < 0.0:\n",
    ),
    fault(
        "the second body feels no normal impulse",
        "rows.py",
        "head_on",
        "v, u = along(v, axis, step * mass[a]), along(u, axis, -step * mass[b])",
        "v = along(v, axis, step * mass[a])",
    ),
    fault(
        "overlaps are resolved by velocities that last",
        "contacts.py",
        "parting",
        "deep = max(-gap - rules.slop, 0.0) * rules.erp / h",
        "target = max(-gap - rules.slop, 0.0) * rules.erp / h",
    ),
    fault(
        "friction of a face acts at its corners",
        "contacts.py",
        "plates",
        "if point[TORSION] < 1.0:",
        "if point[TORSION] < 0.0:",
    ),
    fault(
        "only fast bodies rebound",
        "contacts.py",
        "bounces",
        "bounce > 0.0 and abs(approach) > rules.slow",
        "bounce > 0.0 and abs(approach) > 100.0 * rules.slow",
    ),
    fault("there is one sweep only", "tolerances.py", "elastic", "rounds: int = ROUNDS", "rounds: int = 1"),
    fault(
        "a fifth of gravity is missing",
        "advance.py",
        "slopes",
        "pulled, spun = pull_of(world, work.matrix, work.wrench, rules, kick_of(phase), b)",
        "pulled, spun = pull_of(world, work.matrix, work.wrench, rules, 0.8 * kick_of(phase), b)",
    ),
    fault(
        "a grid that rolls is pushed at a ripple it has passed",
        "surface_distance.py",
        "rocking",
        "way > PROBED * own * _cell(shapes, r)",
        "way < -1.0",
    ),
    fault(
        "a mesh that rolls is pushed at a corner it has passed",
        "surface_distance.py",
        "rocking",
        "level = norm(sub(q, p)) <= LEVEL_FACE * step",
        "level = norm(sub(q, p)) < 0.0",
    ),
    fault(
        "inverse inertia is not rotated",
        "advance.py",
        "elastic",
        "rotated_matrix(matrix, world.inverse_inertia, b, inverse[b])",
        "inverse[b] = world.inverse_inertia[b]",
    ),
    fault(
        "the gyroscopic term is missing",
        "flight.py",
        "elastic",
        "if world.moves[b] and not world.isotropic[b]:",
        "if world.moves[b] and world.radius[b] < 0.0:",
    ),
    fault(
        "the velocity of bodies on paths is ignored",
        "advance.py",
        "trays",
        "motion.velocity[script.body[s], x] = script.velocity[step, k, s, x]",
        "motion.velocity[script.body[s], x] = 0.0",
    ),
    fault(
        "bodies turn about their own axes",
        "vectors.py",
        "elastic",
        "n0 = w * a + x * d + y * c - z * b",
        "n0 = w * a + x * d - y * c + z * b",
        "n1 = w * b + y * d + z * a - x * c",
        "n1 = w * b + y * d - z * a + x * c",
        "n2 = w * c + z * d + x * b - y * a",
        "n2 = w * c + z * d - x * b + y * a",
    ),
    fault(
        "static bodies have a mass",
        "prepare.py",
        "drops",
        'inverse_mass=array["inverse_mass"], inertia=inertia,',
        'inverse_mass=array["inverse_mass"] + ~moves, inertia=inertia,',
    ),
    fault(
        "a manifold has one point",
        "narrow_phase.py",
        "drops",
        "manifolds.count[p] = renewed(rules, manifolds.point, p, known, scratch, count)",
        "manifolds.count[p] = renewed(rules, manifolds.point, p, known, scratch, min(count, 1))",
    ),
    fault(
        "the boxes of bodies do not turn with them",
        "broad_phase.py",
        "edges",
        "wide += abs(matrix[b, a, c]) * world.half[b, c]",
        "wide += (1.0 if a == c else 0.0) * world.half[b, c]",
    ),
    fault(
        "the time of impact is never used",
        "time_of_impact.py",
        "bullets",
        "if speed * rules.substep_dt > depth and not away > speed * rules.substep_dt:",
        "if speed < 0.0:",
    ),
    fault(
        "nothing wakes",
        "sleep.py",
        "sleepers",
        "if motion.island[sleeper] < 0 or not stirs(world, motion, other):",
        "if other >= 0 or not stirs(world, motion, other):",
    ),
    fault(
        "bodies fall asleep out of balance",
        "sleep.py",
        "gentle",
        "return 0.5 * gain * whole * whole < rules.drift",
        "return gain >= 0.0",
    ),
    fault(
        "limits of joints are on the wrong side",
        "joints.py",
        "doors",
        "sign = 1.0 - 2.0 * side",
        "sign = 2.0 * side - 1.0",
    ),
    fault(
        "the strength of motors is ignored",
        "joints.py",
        "motors",
        "kick * h * number[MAX_FORCE] if",
        "kick * h * 1e9 if",
    ),
    fault(
        "springs push the wrong way",
        "rows.py",
        "doors",
        "push = span * (stiff * away - damping",
        "push = span * (-stiff * away - damping",
    ),
    fault(
        "a hinge holds one axis only",
        "joints.py",
        "doors",
        "        for k in range(2):\n            write_turn(row[j, 3 + k]",
        "        for k in range(1):\n            write_turn(row[j, 3 + k]",
    ),
    fault(
        "what a joint holds touches",
        "broad_phase.py",
        "linkages",
        "            if world.apart[k] == b:",
        "            if world.apart[k] == -2:",
    ),
)


def failures(package: Path, laws: str) -> set[str]:
    """What does not hold, or the last line of an error, when the laws run with a package."""
    environment = os.environ | {"PYTHONPATH": str(package.parent), "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "sdfsim.evaluation.laws.table", "--failed", *laws.split()]
    try:
        done = subprocess.run(
            command, cwd=package.parent, env=environment, capture_output=True, text=True, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return {f"not done after {LONGEST:g} s"}
    failed = {line.rpartition(": ")[0][5:] for line in done.stdout.splitlines() if line.startswith("FAIL")}
    return failed or ({done.stderr.strip().splitlines()[-1]} if done.returncode else set())


def seeded(one: Fault, folder: Path) -> Path:
    """A copy of the package with a fault."""
    package = folder / "sdfsim"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    file = package / "physics" / "solver" / one.file
    text = file.read_text(encoding="utf-8")
    for right, wrong in one.edits:
        assert text.count(right) == 1, f"{one.name}: {one.file} has {text.count(right)} times: {right}"
        text = text.replace(right, wrong)
    file.write_text(text, encoding="utf-8")
    return package


def main(arguments: Iterable[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="parts of names of faults")
    only = parser.parse_args(None if arguments is None else list(arguments)).only or [""]
    known: dict[str, set[str]] = {}
    missed = 0
    print("| fault | caught by |\n| --- | --- |")
    for one in FAULTS:
        if not any(part in one.name for part in only):
            continue
        if one.laws not in known:
            known[one.laws] = failures(PACKAGE, one.laws)
        with tempfile.TemporaryDirectory() as scratch:
            found = sorted(failures(seeded(one, Path(scratch)), one.laws) - known[one.laws])
        missed += not found
        caught = f"`{one.laws}`: {found[0]} ({len(found)} in all)" if found else "**nothing**"
        print(f"| {one.name} | {caught} |", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
