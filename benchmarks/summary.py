"""The first lists of RESULTS.md, from the tables of all pages: where sdfsim is worse, then where it is better.

    python -m benchmarks summary

No number in them is written by hand. Run this command after any table was measured again.
"""

import re
from collections.abc import Iterator

from benchmarks.results import ROOT, section, write_section
from sdfsim.evaluation.harness import number

OURS, PULLED = "sdfsim", ("PyBullet, pieces", "MuJoCo, pieces")  # engines on convex pieces


def cells_of(text: str) -> list[list[str]]:
    """The rows of the first table in a text, with its head first."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]
    return [row for row in rows if not set("".join(row)) <= set("-: ")]


def figures(cell: str) -> list[float]:
    """All numbers of a cell."""
    return [float(found.replace(",", "")) for found in re.findall(r"-?\d[\d,]*\.?\d*(?:e-?\d+)?", cell)]


def joined(parts: list[str]) -> str:
    return ", ".join(parts) or "none"


def in_turn() -> tuple[list[str], list[str]]:
    """Cases in which ours is slower than an engine, and those in which it is faster than both, as median ratios."""
    head, *rows = cells_of(section("rivals in turn"))
    names = [title.removeprefix(f"{OURS} / ") for title in head[4:]]
    longer, less = [], []
    for row in rows:
        ratios = {name.partition(",")[0]: figures(cell)[0] for name, cell in zip(names, row[4:], strict=True)}
        longer += [f"{row[0]} {ratio:.2f} of {name}'s" for name, ratio in ratios.items() if ratio > 1.0]
        if all(ratio <= 1.0 for ratio in ratios.values()):
            less.append(f"{row[0]} " + " and ".join(f"{ratio:.2f}" for ratio in ratios.values()))
    return longer, less


def of_tosses() -> tuple[list[str], list[str]]:
    """Engines with a smaller position or rotation error on the real cube, and the lead of ours in position."""
    nearer, lead = [], []
    for row in cells_of(section("reality"))[1:]:
        if "/" not in row[3] or "tosses" in row[0]:
            continue
        for part, what in zip(row[3].split("/"), ("% of its side in position", "degrees in rotation"), strict=True):
            less, low, high = figures(part)
            told = f"{row[0]} by {number(abs(less), 2)} {what} ({number(low, 2)} to {number(high, 2)})"
            if less > 0.0:
                nearer.append(told)
        lead.append(-figures(row[3])[0])
    return nearer, [f"{number(min(lead), 2)} to {number(max(lead), 2)} % of the side" if min(lead) > 0 else ""]


def of_elbows() -> list[str]:
    """Engines with a smaller error on the real elbow, for any of its errors."""
    text = (ROOT / "docs" / "joints.md").read_text(encoding="utf-8").partition("## Real tosses of an elbow")[2]
    nearer = []
    for row in cells_of(text.partition("\n## ")[0])[1:]:
        whats = ("% of a link", "degrees of rotation", "degrees of the hinge")
        for part, what in zip(row[4].split("/") if row[4] else (), whats, strict=False):
            less, low, high = figures(part)
            if less > 0.0:
                nearer.append(f"{row[0]} by {number(less, 2)} {what} ({number(low, 2)} to {number(high, 2)})")
    return nearer


def deeper() -> Iterator[str]:
    """Cases in which our bodies overlap more than those of both engines on convex pieces."""
    rows = cells_of(section("rivals"))[1:]
    for case in dict.fromkeys(row[0] for row in rows):
        depth = {row[1]: figures(row[3]) for row in rows if row[0] == case}
        if depth[OURS] and all(depth[OURS][0] > depth[name][0] for name in PULLED):
            others = " and ".join(f"{depth[name][0]:g}" for name in PULLED)
            yield f"{case} {depth[OURS][0]:g} against {others} %"


def without_pieces() -> tuple[float, float, list[str]]:
    """Time of engines that collide meshes without pieces, divided by ours: least and most; and what they lose."""
    ratios, lost = [], []
    rows = cells_of(section("rivals"))[1:]
    ours = {row[0]: figures(row[2])[0] for row in rows if row[1] == OURS}
    for row in rows:
        if row[1] in (OURS, *PULLED):
            continue
        if len(row) < 6 or not row[5]:
            lost.append(f"{row[1].partition(',')[0]} does not finish {row[0]}")
            continue
        ratios.append(figures(row[2])[0] / ours[row[0]])
        if int(row[5]):
            lost.append(f"{row[1]} loses {row[5]} of the bodies of {row[0]}")
    return min(ratios), max(ratios), lost


def grown() -> tuple[list[str], dict[str, list[str]]]:
    """Engine's time divided by ours (64 nodes) with 1 to 512 spheres: where an engine is faster, and for each the other
    numbers of spheres."""
    rows = cells_of(section("growth"))[1:]
    time = {(row[0], row[1]): figures(row[2]) for row in rows if row[0].endswith("spheres in a bowl")}
    slower: list[str] = []
    faster: dict[str, list[str]] = {}
    for name in ("PyBullet", "MuJoCo"):
        for case, ours in ((case, took[0]) for (case, who), took in time.items() if who == "solver, 64 nodes"):
            theirs, count = time[case, name], f"{figures(case)[0]:g}"
            if theirs and theirs[0] < ours:
                slower.append(f"{count} spheres {number(ours / theirs[0], 2)} of {name}'s")
            else:
                faster.setdefault(name, []).append(f"{count}: {number(theirs[0] / ours, 2) if theirs else 'not ended'}")
    return slower, faster


def of_joints() -> tuple[list[str], list[str]]:
    """Scenes with joints in which ours is slower than MuJoCo, and those in which it is faster."""
    longer, less = [], []
    for row in cells_of(section("joints"))[1:]:
        ours, theirs = figures(row[4])[0], figures(row[5])[0]
        (longer if ours > theirs else less).append(f"{row[0]} {number(ours / theirs, 2)}")
    return longer, less


def counts(cell: str) -> tuple[int, int]:
    """Checks that hold, and all checks."""
    held, run = figures(cell)[:2]
    return int(held), int(run)


def summary() -> str:
    """Both lists."""
    longer, less = in_turn()
    nearer, lead = of_tosses()
    slow_joints, fast_joints = of_joints()
    at_least, at_most, lost = without_pieces()
    errors = {row[0]: [figures(cell)[0] for cell in row[1:]] for row in cells_of(section("MOVi-B"))[1:]}
    head, *rows = cells_of(section("everyday"))
    total = dict(zip(head[1:], map(counts, rows[-1][1:]), strict=True))
    start = {row[0]: row for row in cells_of(section("start"))[1:]}
    steps = {row[0]: row for row in cells_of(section("contact step"))[1:]}
    hard = re.findall(r"- (.+): (\d+) figures, (\d+) missed, (\d+) behind", section("hard cases"))
    solver, engine = errors["`solver`"], errors["the engine again, starts 1e-3 m/s off"]
    fewer, growth = grown()
    losses = [
        "[Hard shapes](#hard-shapes-beside-other-engines), slower than an engine at equal depth: "
        f"{joined(longer)} time; at the same step [spheres in a bowl](../docs/notes/growth.md): {joined(fewer)}.",
        f"Bodies overlap more than in both engines: {joined(list(deeper()))} of the smallest body.",
        f"[Real tosses](#real-tosses-of-a-cube), engines with smaller errors: {joined(nearer)}. "
        f"[Elbows](../docs/joints.md#real-tosses-of-an-elbow): {joined(of_elbows())}.",
        f"[MOVi-B](#movi-b), 50 steps: an error of {solver[0]:g} m, and {engine[0]:g} m for PyBullet itself from "
        f"starts 1 mm/s off. The graph network `gnn` has {errors['`gnn`'][0]:g} m.",
        f"[Everyday checks](#everyday-scenes-beside-other-engines): {total[OURS][1] - total[OURS][0]} missed of "
        f"{total[OURS][1]}. [Hard cases](#hard-cases): {hard[0][2]} missed, {hard[0][3]} worse than PyBullet.",
        f"[Joints](../docs/joints.md#time), slower than MuJoCo: {joined(slow_joints)} times its time.",
        f"[Cold start](#cold-start): a falling box takes {start['a box that falls for 0.4 s'][1]} s, in MuJoCo "
        f"{start['the same in MuJoCo'][1]} s.",
    ]
    wins = [
        "[Spheres in a bowl](../docs/notes/growth.md), an engine's time divided by ours at the same step: "
        + "; ".join(f"{name} {joined(ratios)}" for name, ratios in growth.items())
        + ".",
        f"Hard shapes at equal depth, relative to the time of PyBullet and MuJoCo: {joined(less)}. 512 spheres in a "
        f"bowl take {steps['512 spheres in a bowl'][5]} of PyBullet's.",
        f"Engines that collide meshes without pieces, like ours, take {number(at_least, 2)} to {number(at_most, 2)} "
        f"times as long ([all of them](../docs/notes/hard-shapes.md)). {joined(lost)}.",
        *([f"Real tosses: a smaller position error than every other engine, by {lead[0]}."] if lead[0] else []),
        "Everyday checks that other engines miss: "
        + joined([f"{name} {run - held} of {run}" for name, (held, run) in total.items() if name != OURS])
        + ". Hard cases that they miss: "
        + joined([f"{who.replace('teacher', 'PyBullet')} {missed}" for who, _, missed, _ in hard[1:]])
        + ".",
        f"Joints, relative to MuJoCo's time: {joined(fast_joints)}.",
    ]
    return (
        "**Where sdfsim is worse**\n\n"
        + "".join(f"- {line}\n" for line in losses)
        + "\n**Where sdfsim is better**\n\n"
        + "".join(f"- {line}\n" for line in wins)
    )


def main() -> None:
    write_section("summary", "python -m benchmarks summary", summary())
