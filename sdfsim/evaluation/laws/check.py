"""A check: a measured number, and the range in which it should be."""

from dataclasses import dataclass
from math import inf


@dataclass(frozen=True)
class Check:
    """A measured number, and the range in which it should be."""

    name: str
    measured: float
    low: float = -inf
    high: float = inf
    unit: str = ""
    digits: int = 2  # decimals shown in reports; smaller differences do not count
    better: int = -1  # -1: lower is better, 1: higher is better, 0: it only informs, such as the height of a rebound
    worst: bool = False  # the largest of several repetitions counts, not the mean

    @property
    def holds(self) -> bool:
        return bool(self.low <= self.measured <= self.high)

    @property
    def wanted(self) -> str:
        if self.low == -inf:
            return "" if self.high == inf else f"at most {self.high:.6g}"
        return f"at least {self.low:.6g}" if self.high == inf else f"{self.low:.6g} to {self.high:.6g}"

    def __str__(self) -> str:
        wanted = f" (wanted {self.wanted})" if self.wanted else ""
        return f"{'ok  ' if self.holds else 'FAIL'} {self.name}: {self.measured:.6g} {self.unit}{wanted}"


def near(name: str, measured: float, wanted: float, part: float, unit: str = "", slack: float = 0.0) -> Check:
    """A check within a `part` of the wanted value, plus `slack`."""
    off = abs(wanted) * part + slack
    return Check(name, float(measured), wanted - off, wanted + off, unit)


def most(name: str, measured: float, limit: float, unit: str = "") -> Check:
    return Check(name, float(measured), high=limit, unit=unit)
