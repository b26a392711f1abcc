"""What the hard cases gave: of one repetition, of one case, of all."""

from __future__ import annotations

import statistics
from dataclasses import dataclass

from sdfsim.evaluation.hard_cases import Case, Figure

TEACHER = "teacher"
NO_CUDA = "no CUDA device here"


@dataclass(frozen=True)
class Part:
    """What one repetition of a case gave with one model, or with the teacher.

    Attributes:
        fingerprint: of everything that it depends on.
        figures: name -> value.
        broke: what went wrong, a line for each motion that ended early or ran away.
        outside: in what the scenes lie outside the model's training.
        curve: [2, K], what is drawn.
        recording: file of the motion to watch, relative to the folder; None where there is none.
    """

    fingerprint: str
    figures: dict[str, float]
    broke: list[str]
    outside: list[str]
    curve: list[list[float]]
    recording: str | None


@dataclass(frozen=True)
class Result:
    """What all repetitions of a case gave with one model, or with the teacher.

    Attributes:
        case, who: names.
        parts: in order; none where the case was not run.
        skipped: why it was not, else empty.
    """

    case: str
    who: str
    parts: tuple[Part, ...]
    skipped: str = ""

    @property
    def broke(self) -> list[str]:
        """Every motion that ended early or ran away."""
        return [line for part in self.parts for line in part.broke]

    @property
    def outside(self) -> list[str]:
        """In what the case lies outside the model's training."""
        return list(dict.fromkeys(line for part in self.parts for line in part.outside))

    @property
    def recording(self) -> str | None:
        """The motion to watch: one that broke, if any did."""
        found = sorted(self.parts, key=lambda part: not part.broke)
        return next((part.recording for part in found if part.recording), None)

    def value(self, figure: Figure) -> float | None:
        """The mean of the repetitions, or the largest where that is what counts; None where there is none."""
        values = self._values(figure)
        if not values:
            return None
        return max(values) if figure.largest else statistics.fmean(values)

    def noise(self, figure: Figure) -> float:
        """Standard deviation over the repetitions, 0 for a single one."""
        values = self._values(figure)
        return statistics.stdev(values) if len(values) > 1 else 0.0

    def missed(self, figure: Figure) -> bool:
        """Whether the figure is beyond what is wanted."""
        value = self.value(figure)
        return value is not None and figure.limit is not None and value > figure.limit

    def _values(self, figure: Figure) -> list[float]:
        return [part.figures[figure.name] for part in self.parts]


@dataclass(frozen=True)
class Study:
    """All results of one run of the command.

    Attributes:
        cases: what was run, in order.
        who: models, then the teacher where PyBullet is installed.
        results: (case name, who) -> result; a case that the teacher has no part in has none of it.
        quick: whether it was the short form.
    """

    cases: list[Case]
    who: list[str]
    results: dict[tuple[str, str], Result]
    quick: bool
