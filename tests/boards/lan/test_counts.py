"""The order of an import's messages: loss, duplicates, disorder and restarts, counted exactly."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rack.boards.host.entries import zero_counts
from rack.boards.lan.entries import WINDOW_MESSAGES, SequenceTracker
from rack.boards.lan.envelope import Envelope
from rack.boards.lan.status import LanImport


def head(number: int, serial: int = 0) -> Envelope:
    """Return the head of the message of that number; each is of a later write than the one
    before."""
    return Envelope(1, 7, serial or 3 * number, number, 0, 0, 0)


NEW, OLD, AGAIN = "new", "disordered", "repeated"


CASES: dict[str, tuple[tuple[int, ...], list[tuple[int, int, str]], int]] = {
    "a reader restarts": ((7, 20), [(20, 0, AGAIN), (19, 0, AGAIN), (23, 0, NEW)], 2),
    "with no launch known": ((0, 20), [(20, 0, AGAIN), (21, 0, NEW)], 0),
    "a restarted sender's number": ((), [(20, 60, NEW), (20, 64, NEW), (21, 65, NEW)], 0),
    "older than the window": (
        (),
        [(1, 0, NEW), (WINDOW_MESSAGES * 4, 0, NEW), (2, 0, OLD), (2, 0, OLD)],
        WINDOW_MESSAGES * 4 - 2,
    ),
    # The third has not come, the second has.
    "a number used twice changes no other count": (
        (),
        [(2, 0, NEW), (4, 0, NEW), (5, 0, NEW), (5, 16, NEW), (3, 0, OLD), (2, 0, AGAIN)],
        1,
    ),
    "a number used twice hides no missing one": (
        (),
        [(18, 54, NEW), (20, 60, NEW), (20, 64, NEW), (19, 57, OLD)],
        1,
    ),
    "an old write under the newest number": (
        (),
        [(18, 54, NEW), (20, 60, NEW), (20, 59, AGAIN), (21, 58, AGAIN)],
        1,
    ),
}
"""Launch and number that a resumed reader knows; messages as number, serial (0: that of their
number) and what each counts as; how many are missing."""


@pytest.mark.parametrize(("resumed", "messages", "missing"), CASES.values(), ids=CASES)
def test_each_message_is_counted_as_what_it_is(
    resumed: tuple[int, ...], messages: list[tuple[int, int, str]], missing: int
) -> None:
    count = zero_counts(LanImport)
    found = SequenceTracker(count)
    if resumed:
        count.launch, count.number = resumed
        count.serial = 3 * count.number
        found.restore_counts(count.record.copy())
    for number, serial, expected in messages:
        before = count.disordered, count.repeated
        is_new = found.accept_message(head(number, serial=serial))
        after = count.disordered - before[0], count.repeated - before[1]
        assert (is_new, *after) == (expected == NEW, expected == OLD, expected == AGAIN)
    newest = [(number, serial or 3 * number) for number, serial, how in messages if how == NEW][-1]
    assert (count.missing, count.number, count.serial, found.launch) == (missing, *newest, 7)


@given(st.lists(st.integers(0, 30), min_size=1, max_size=60))
def test_every_message_counts_as_new_disordered_repeated_or_missing(numbers: list[int]) -> None:
    count = zero_counts(LanImport)
    found = SequenceTracker(count)
    first = numbers[0]
    came = [number for number in numbers if number >= first]
    new = sum(found.accept_message(head(number, serial=number + 1)) for number in came)
    assert new + count.disordered + count.repeated == len(came)
    assert new + count.disordered == len(set(came))
    assert count.missing - count.disordered == max(came) - first + 1 - len(set(came))
