"""Everyday scenes by the bundled networks, as simulators of their own: how many checks hold, beside the solve.

    python -m benchmarks networks [--model gnn --model sdf-sim] [--seconds 900]

Writes the record of docs/stability.md. If a motion fails, none of its checks hold. A law that takes a network longer
than so many seconds of the processor is cut off, and its remaining checks are not counted.
"""

import time
from functools import partial
from itertools import takewhile

from benchmarks.everyday import judged
from benchmarks.records import progress, write_record
from sdfsim.evaluation.engines import by_model
from sdfsim.evaluation.harness import one_thread
from sdfsim.evaluation.laws.everyday import EVERYDAY
from sdfsim.evaluation.laws.scenes import Setting
from sdfsim.learned.model import SOLVER, load_model, model_names

MODELS = [SOLVER, *(name for name in model_names() if name != SOLVER)]


@one_thread()
def held(law: str, model: str, seconds: float) -> tuple[int, int]:
    """How many checks of a law hold for a model, and of how many."""
    until = time.process_time() + seconds
    run = partial(by_model, model=load_model(model))
    found = takewhile(lambda _: time.process_time() < until, judged(law, Setting(), run))
    verdicts = [check.holds and not broke for _, check, _, broke in found]
    return sum(verdicts), len(verdicts)


def main(model: list[str] = MODELS, seconds: float = 900.0) -> None:
    found = {}
    for law in EVERYDAY:
        found[law.__name__.replace("_", " ")] = [held(law.__name__, name, seconds) for name in model]
        progress(len(found) / len(EVERYDAY), f"{law.__name__}: {found[law.__name__.replace('_', ' ')]}")
    worst = sorted(found, key=lambda law: found[law][-1][0] - found[law][-1][1])
    totals = [tuple(map(sum, zip(*of, strict=True))) for of in zip(*found.values(), strict=True)]
    rows = [("all", totals), *((law, found[law]) for law in worst)]
    data = (
        "Checks of everyday scenes of 10 cm in closed form that hold, by model; where most are missed first. A law is "
        "cut off after so many seconds: fewer checks are then counted."
    )
    table = [[law, *(f"{n} of {of}" for n, of in counts)] for law, counts in rows]
    asked = "".join(f" --model {name}" for name in model)
    write_record("networks", f"python -m benchmarks networks{asked} --seconds {seconds:g}", data, ("", *model), table)
