"""Verdicts: comparisons of measured with demanded values, and the rulings that follow from them."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

MAX_STRAY_SHARE = 0.02
"""Largest share of missed cycles, plans or messages that is attributed to this machine.

Up to this share the claim still holds within bounds.
"""
COMPARISONS = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
}


class Ruling(StrEnum):
    """Outcome of the test of a claim."""

    HOLDS = "holds"
    BOUNDED = "bounded"
    CONTRADICTS = "contradicts"
    UNTESTABLE = "untestable"
    FAILS = "fails"
    UNMADE = "unmade"


@dataclass(frozen=True)
class Check:
    """Comparison of a measured value with a required one.

    Attributes:
        compared: Name of the quantity, with its unit if it has one.
        measured: Measured value.
        sign: Key of `COMPARISONS`.
        demanded: Required value, on the right of the sign.
        met: Whether the comparison is true.
    """

    compared: str
    measured: float
    sign: str
    demanded: float
    met: bool

    def __str__(self) -> str:
        return f"{self.compared} {self.measured:.6g}, not {self.sign} {self.demanded:.6g}"


def compare_value(name: str, measured: float, sign: str, demanded: float) -> Check:
    """Compare a measured value with a required one.

    Args:
        name: Name of the quantity, with its unit if it has one.
        measured: Measured value.
        sign: Key of `COMPARISONS`.
        demanded: Value on the right of the sign.
    """
    is_met = bool(COMPARISONS[sign](measured, demanded))
    return Check(name, float(measured), sign, float(demanded), is_met)


def describe_unmet(checks: Iterable[Check]) -> str:
    """Format the comparisons that are not met. Empty if all are met."""
    return "; ".join(str(check) for check in checks if not check.met)


@dataclass(frozen=True)
class ClaimVerdict:
    """A ruling with the comparisons from which it follows."""

    ruling: Ruling
    checks: tuple[Check, ...]


def check_none(**counts: float) -> list[Check]:
    """Check that the counts of unwanted events are 0."""
    return [compare_value(name, count, "=", 0) for name, count in counts.items()]


def rule_on(
    *always: Check,
    ideal: Sequence[Check] = (),
    here: Sequence[Check] = (),
    needs: Sequence[Check] = (),
    holding: Ruling = Ruling.HOLDS,
) -> ClaimVerdict:
    """Derive the ruling on a claim from comparisons.

    Args:
        always: Comparisons that the claim requires on every machine.
        ideal: Further comparisons, which may fail because of disturbances of this machine.
        here: Weaker comparisons. If an ideal one fails but these are met, the claim holds within
            bounds.
        needs: Conditions without which a run cannot test the claim.
        holding: Ruling if all comparisons except `here` are met.

    Returns:
        The ruling with every comparison, without repetitions.
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


def rule_on_rare_event(name: str, bad: int, due: int, *needs: Check) -> ClaimVerdict:
    """Return the ruling on a claim that an event never happens.

    The claim holds within bounds if the event happened in at most `MAX_STRAY_SHARE` of all cases.

    Args:
        name: Name of the event.
        bad: Number of times that it happened.
        due: Number of times that it could have happened.
        needs: Conditions without which a run cannot test the claim.
    """
    return rule_on(
        ideal=[compare_value(name, bad, "=", 0)],
        here=[compare_value(f"{name}_share", bad / max(due, 1), "<=", MAX_STRAY_SHARE)],
        needs=[*needs, compare_value(f"{name}_of", due, ">=", 1)],
    )
