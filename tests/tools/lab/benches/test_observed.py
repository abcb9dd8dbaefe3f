"""A rack observed by its rings: its cycles are counted against the clock's grid, not against the
records it left."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.trace import RECORD, Flag
from rack.boards.config import loads, wire
from rack.boards.events import Outcome
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import CycleCount, Observed, missed_share, observe

LAYOUT = wire(loads(Chain(1, 400).text()))


def run(ticks: list[int], late: tuple[int, ...] = (), lost: int = 0) -> Observed:
    """Return a run of ten ticks that left records of these, some of them late."""
    rows = np.zeros(len(ticks), RECORD)
    rows["tick"] = ticks
    rows["flags"][np.isin(ticks, late)] = Flag.MISSED
    outcome = Outcome("time over", 10, "", "", "", ())
    return Observed({"board1": rows}, {"board1": lost}, {}, LAYOUT, outcome)


@pytest.mark.parametrize(
    ("observed", "found"),
    [
        (run(list(range(10))), (0, 9)),
        (run(list(range(9))), (0, 9)),
        (run([0, 1, 2, 5, 6, 7, 8, 9], late=(2, 9)), (3, 9)),
        (run([4, 5, 6, 7, 8, 9], lost=4), (0, 5)),
        (run([]), (9, 9)),
    ],
    ids=["all in time", "the last not read yet", "skipped and late", "overwritten", "never ran"],
)
def test_every_cycle_that_was_due_counts(observed: Observed, found: tuple[int, int]) -> None:
    assert observed.cycles("board1") == found


def test_shares_are_of_all_tasks_together() -> None:
    assert missed_share([CycleCount(1, 100), CycleCount(0, 300)]) == 0.0025


@pytest.mark.slow
def test_a_run_leaves_traces_messages_and_its_outcome() -> None:
    chain = Chain(2, 400, "lockstep")
    found = observe(loads(chain.text()), 0.1, True, ["board2.status"])
    assert found.outcome.ticks == 40
    assert [found.cycles(name) for name in chain.names] == [(0, 39), (0, 39)]
    assert found.messages["board2.status"]["message"]["sent"].tolist() == [-1, *range(39)]
