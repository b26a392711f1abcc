"""What the bundled networks get right: docs/simulator.md.

    python -m benchmarks network -o DIR

Runs the hard cases in their short form, with the everyday checks among them, by the solver and by every bundled network
as itself. Results in DIR are kept, so that a stopped run continues.
"""

from pathlib import Path

from benchmarks.results import progress, write_section
from sdfsim.evaluation.hard_cases import GROUPS
from sdfsim.evaluation.harness import markdown
from sdfsim.evaluation.stress import Study, stress
from sdfsim.learned.model import model_names


def main(*, out: Path) -> None:
    study = stress(out, models=model_names(), engines={}, quick=True, on_progress=progress)
    write_section("networks", "python -m benchmarks network -o DIR", markdown(rows_of(study)))


def rows_of(study: Study) -> list[tuple[str, ...]]:
    """Everyday checks that hold, figures with a limit that keep it, and cases in which no law is broken, each as
    `held / all`; one column for each model."""
    held: dict[str, dict[str, list[int]]] = {}

    def count(row: str, who: str, good: int, every: int) -> None:
        one = held.setdefault(row, {}).setdefault(who, [0, 0])
        one[0], one[1] = one[0] + good, one[1] + every

    for case in study.cases:
        for who in study.models:
            result = study.results[case.name, who]
            found = {name: values[0] for name, values in result["figures"].items()}
            if case.group == "everyday":
                every = round(found["checks"])
                for row in (f"everyday: {case.title}", "everyday checks, all"):
                    count(row, who, every - round(found["fail"]), every)
                continue
            limits = [f for f in case.figures if f.limit is not None and f.judged]
            kept = sum(found[figure.name] <= figure.limit for figure in limits)
            if limits:
                count(f"figures of {GROUPS[case.group].title}", who, kept, len(limits))
            count("cases without a broken law", who, not (result["broke"] or result["laws"]), 1)
    rows = [(row, *(f"{one[who][0]} / {one[who][1]}" for who in study.models)) for row, one in held.items()]
    return [("", *(f"`{who}`" for who in study.models)), *rows]
