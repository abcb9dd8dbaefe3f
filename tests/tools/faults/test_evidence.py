"""Events as evidence: which can be the detection of a fault, what explains what, and what undoes a
reaction."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.tools.faults.evidence import Aftermath, count_skipped_ticks, find_aftermath
from tests.tools.fault_events import event, strike

KILL = strike("kill", "lower", 100)


SKIPS = [
    replace(event(10, "miss", "clock_skipped", "a"), value=2.0),
    replace(event(20, "miss", "clock_skipped", "a"), value=3.0),
    replace(event(20, "miss", "clock_skipped", "b"), value=4.0),
    replace(event(20, "detection", "clock_skipped", "c"), value=90.0),
    replace(event(20, "miss", "late", "d"), value=90.0),
]


@pytest.mark.parametrize(
    ("first", "last", "skipped"),
    [
        (0, 100, 5),
        (9, 10, 1),
        (8, 10, 2),
        (10, 19, 0),
        (10, 20, 4),
        (0, 9, 0),
        (100, 0, 0),
        (17, 20, 3),
    ],
)
def test_skipped_ticks_are_counted_by_one_task_and_bounded(
    first: int, last: int, skipped: int
) -> None:
    assert count_skipped_ticks(SKIPS, first, last) == skipped


RESTART = event(105, "reaction", "restart", "lower")
REJOINED = event(130, "recovery", "rejoined", "lower")


def test_each_reaction_is_undone_by_its_recovery() -> None:
    assert find_aftermath(KILL, [RESTART], 500, ()) == Aftermath(("restart",), False, None, ())
    other = replace(REJOINED, board="upper")
    early = replace(REJOINED, tick=104)
    assert not find_aftermath(KILL, [RESTART, other, early], 500, ()).is_undone
    done = find_aftermath(KILL, [RESTART, REJOINED, replace(REJOINED, tick=140)], 500, ())
    assert done == Aftermath(("restart",), True, 30, ())
    # Not to it: before it, or from the horizon on. A board that is killed must be restarted.
    nothing = Aftermath((), True, None, ("restart",))
    assert find_aftermath(KILL, [replace(RESTART, tick=99)], 500, ()) == nothing
    assert find_aftermath(KILL, [RESTART], 105, ()) == nothing
    assert find_aftermath(replace(KILL, tick=-1), [RESTART], 500, ()) == Aftermath()
