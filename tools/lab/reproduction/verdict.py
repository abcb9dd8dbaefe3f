"""Verdicts: comparisons of measured values with what a claim demands, and the ruling that results
from them alone.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

STRAY = 0.02
"""Share of missed cycles, plans or messages up to which this machine is blamed, not the claim."""
COMPARISONS = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
}


class Ruling(StrEnum):
    """The outcome of a claim."""

    HOLDS = "holds"
    BOUNDED = "bounded"
    CONTRADICTS = "contradicts"
    UNTESTABLE = "untestable"
    FAILS = "fails"
    UNMADE = "unmade"


@dataclass(frozen=True)
class Check:
    """One comparison. `compared` names the quantity, and its unit if it has one."""

    compared: str
    measured: float
    sign: str
    demanded: float
    met: bool

    def __str__(self) -> str:
        return f"{self.compared} {self.measured:.6g}, not {self.sign} {self.demanded:.6g}"


def compare(name: str, measured: float, sign: str, demanded: float) -> Check:
    """Compare a value with what is demanded of it; `sign` is one of `COMPARISONS`."""
    is_met = bool(COMPARISONS[sign](measured, demanded))
    return Check(name, float(measured), sign, float(demanded), is_met)


def describe_unmet(checks: Iterable[Check]) -> str:
    """Return the comparisons that are not met as text, empty if all are."""
    return "; ".join(str(check) for check in checks if not check.met)


@dataclass(frozen=True)
class ClaimVerdict:
    """A ruling with the comparisons from which it results."""

    ruling: Ruling
    checks: tuple[Check, ...]


def check_none(**counts: float) -> list[Check]:
    """Compare counts of what must not happen with 0."""
    return [compare(name, count, "=", 0) for name, count in counts.items()]


def rule_on(
    *always: Check,
    ideal: Sequence[Check] = (),
    here: Sequence[Check] = (),
    needs: Sequence[Check] = (),
    holding: Ruling = Ruling.HOLDS,
) -> ClaimVerdict:
    """Rule on a claim by comparisons alone.

    Args:
        always: Comparisons that the claim demands on every machine.
        ideal: Further ones, which the disturbances of this machine may spoil.
        here: What is demanded instead of the ideal ones for the claim to hold within bounds.
        needs: What a run must show before the claim is judged by it.
        holding: The ruling if the claim is met.

    Returns:
        The ruling with every comparison, each once.
    """
    if describe_unmet(needs):
        ruling = Ruling.UNTESTABLE
    elif describe_unmet(always):
        ruling = Ruling.FAILS
    elif not describe_unmet(ideal):
        ruling = holding
    else:
        ruling = Ruling.FAILS if describe_unmet(here) else Ruling.BOUNDED
    return ClaimVerdict(ruling, tuple(dict.fromkeys((*needs, *always, *ideal, *here))))


def rule_strays(name: str, bad: int, due: int, *needs: Check) -> ClaimVerdict:
    """Rule on something that must not happen; within bounds if at most a stray share did."""
    return rule_on(
        ideal=[compare(name, bad, "=", 0)],
        here=[compare(f"{name}_share", bad / max(due, 1), "<=", STRAY)],
        needs=[*needs, compare(f"{name}_of", due, ">=", 1)],
    )
