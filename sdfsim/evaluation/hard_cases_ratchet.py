"""The ratchet of the hard cases: the last accepted figures with their noise, and what has become worse than them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sdfsim.errors import SdfsimError
from sdfsim.evaluation.hard_cases import Figure
from sdfsim.evaluation.hard_cases_results import TEACHER, Study
from sdfsim.files import read_json

SPREADS = 3.0  # so many standard deviations are noise
SHARE = 0.05  # of a figure: what another machine's rounding may change where repetitions agree


def accepted(study: Study) -> dict[str, Any]:
    """What the ratchet file holds: for each model every judged figure, and the cases that blew up."""
    models: dict[str, Any] = {}
    for who in study.who:
        if who == TEACHER:
            continue
        figures, broke = {}, []
        for case in study.cases:
            result = study.results[case.name, who]
            broke += [case.name] if result.broke else []
            for figure in case.figures:
                if figure.judged and (value := result.value(figure)) is not None:
                    figures[f"{case.name}/{figure.name}"] = {"value": value, "noise": result.noise(figure)}
        models[who] = {"figures": figures, "blew_up": broke}
    return {"quick": study.quick, "models": models}


def slipped_back(study: Study, file: Path) -> list[str]:
    """One line for every figure that is worse than accepted by more than noise, or that blows up now and did not.

    Args:
        study: of the same form (quick or not) as the file's.
        file: the ratchet.

    Raises:
        SdfsimError: the file is unreadable, of the other form, or does not know a model of the study.
    """
    ratchet = read_json(file, "write it with benchmarks/hard_cases.py")
    if ratchet["quick"] != study.quick:
        raise SdfsimError(f"{file}: made with the {'short' if ratchet['quick'] else 'long'} form of the cases")
    worse = []
    for who in study.who:
        if who == TEACHER:
            continue
        if who not in ratchet["models"]:
            raise SdfsimError(f"{file}: knows no model {who!r}", "write it anew with benchmarks/hard_cases.py")
        was = ratchet["models"][who]
        for case in study.cases:
            result = study.results[case.name, who]
            if result.broke and case.name not in was["blew_up"]:
                worse.append(f"{who}: {case.name}: {result.broke[0]}")
            for figure in case.figures:
                before, now = was["figures"].get(f"{case.name}/{figure.name}"), result.value(figure)
                if before and now is not None and _beyond(figure, before, now):
                    worse.append(
                        f"{who}: {case.name}: {figure.name} {now:.4g} {figure.unit}, "
                        f"accepted {before['value']:.4g} ± {before['noise']:.2g}"
                    )
    return worse


def _beyond(figure: Figure, before: dict[str, float], now: float) -> bool:
    slack = max(SPREADS * before["noise"], SHARE * abs(before["value"]), 10.0**-figure.digits)
    return (before["value"] - now if figure.longer else now - before["value"]) > slack
