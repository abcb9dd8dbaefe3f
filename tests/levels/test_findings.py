"""Events of a level's own: declared by its class, raised in a cycle."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.errors import LevelError
from rack.levels.level import Executor, Finding, FindingKind, LevelContext

CONTEXT = cast(LevelContext, SimpleNamespace(sizes={}, params={}))


class Feeler(Executor):
    """Finds what it is told to find."""

    contact = FindingKind(unit="N m", doc="the arm touches something")
    worn = FindingKind(unit="1", doc="a joint is worn")

    def process(self, tick: int) -> None:
        """Find nothing."""


class FinerFeeler(Feeler):
    """Finds more, and forgets wear."""

    worn = None  # type: ignore[assignment]
    warm = FindingKind(unit="K", doc="a motor is warm")


def test_a_finding_has_the_number_of_its_declaration() -> None:
    level = FinerFeeler(CONTEXT)
    level.raise_finding("warm", 41.5, unit="K", text="elbow")
    level.raise_finding("contact", value=3.2)
    assert [*FinerFeeler.finding_kinds] == ["contact", "warm"]
    assert level.findings == [
        Finding(Alarm.OWN, 1, 41.5, text="elbow"),
        Finding(Alarm.OWN, 0, 3.2),
    ]


@pytest.mark.parametrize(
    ("name", "unit", "why"),
    [
        ("contct", "", "finding 'contct' is not declared; did you mean 'contact'[?]"),
        ("x", "", "finding 'x' is not declared; declared: contact, worn"),
        ("contact", "N", "finding 'contact' is in N m, not in N"),
    ],
)
def test_an_undeclared_finding_is_refused(name: str, unit: str, why: str) -> None:
    with pytest.raises(LevelError, match=f"class Feeler: {why}"):
        Feeler(CONTEXT).raise_finding(name, 1.0, unit=unit)


@pytest.mark.parametrize(
    ("attributes", "why"),
    [
        ({"hot": FindingKind(unit="", doc="hot")}, "finding 'hot' needs a unit"),
        ({"hot": FindingKind(unit="K", doc="")}, "finding 'hot' needs a unit"),
        ({"hang": FindingKind(unit="1", doc="hangs")}, "finding 'hang' has the name of another"),
        ({"died": FindingKind(unit="1", doc="ended")}, "finding 'died' has the name of another"),
        ({"params": FindingKind(unit="1", doc="x")}, "finding 'params' has the name of another"),
        ({"contact": 3}, "attribute 'contact' has the name of a finding"),
    ],
)
def test_an_invalid_declaration_of_a_finding_is_an_error_of_the_class(
    attributes: dict[str, Any], why: str
) -> None:
    with pytest.raises(LevelError, match=f"class Mistaken: {why}"):
        type("Mistaken", (Feeler,), attributes)
