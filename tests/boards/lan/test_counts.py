"""The order of an import's messages: loss, duplicates, disorder and restarts, counted exactly."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rack.boards.host.entries import zero_counts
from rack.boards.lan.entries import WINDOW_MESSAGES, SequenceTracker
from rack.boards.lan.envelope import Envelope
from rack.boards.lan.status import LanImport


def head(number: int, launch: int = 7, serial: int = 0) -> Envelope:
    """Return the head of the message of that number; each is of a later write than the one
    before."""
    return Envelope(1, launch, serial or 3 * number, number, 0, 0, 0)


def order(launch: int = 0, number: int = 0, serial: int = 0) -> tuple[SequenceTracker, LanImport]:
    """Return the order of an import; with a serial one that is resumed after that message."""
    count = zero_counts(LanImport)
    found = SequenceTracker(count)
    if serial:
        count.launch, count.number, count.serial = launch, number, serial
        found.restore_counts(count.record.copy())
    return found, count


def test_a_restarted_reader_takes_nothing_twice() -> None:
    found, count = order(7, 20, 60)
    assert not found.accept_message(head(20))
    assert not found.accept_message(head(19))
    assert (count.repeated, count.disordered) == (2, 0)
    assert found.accept_message(head(23))
    assert count.missing == 2


def test_a_restarted_sender_may_use_one_number_twice() -> None:
    found, count = order()
    assert found.accept_message(head(20, serial=60))
    assert found.accept_message(head(20, serial=64))
    assert found.accept_message(head(21, serial=65))
    assert (count.missing, count.disordered, count.repeated) == (0, 0, 0)


def test_a_reader_restored_without_a_launch_continues() -> None:
    found, count = order(0, 20, 60)
    assert not found.accept_message(head(20))
    assert found.accept_message(head(21))
    assert count.missing == 0
    assert found.launch == 7


@given(st.lists(st.integers(0, 30), min_size=1, max_size=60))
def test_every_message_counts_as_new_disordered_repeated_or_missing(
    numbers: list[int],
) -> None:
    found, count = order()
    first = numbers[0]
    came = [number for number in numbers if number >= first]
    new = sum(found.accept_message(head(number, serial=number + 1)) for number in came)
    assert new + count.disordered + count.repeated == len(came)
    assert new + count.disordered == len(set(came))
    assert count.missing - count.disordered == max(came) - first + 1 - len(set(came))


def test_messages_older_than_the_window_are_counted_within_bounds() -> None:
    found, count = order()
    assert found.accept_message(head(1))
    assert found.accept_message(head(WINDOW_MESSAGES * 4))
    assert not found.accept_message(head(2))
    assert not found.accept_message(head(2))
    assert count.disordered == 2


def test_a_number_used_twice_by_a_restarted_sender_changes_no_other_count() -> None:
    found, count = order()
    assert [found.accept_message(head(number)) for number in (2, 4, 5)] == [True] * 3
    assert found.accept_message(head(5, serial=16))
    assert (count.missing, count.repeated, count.number, count.serial) == (1, 0, 5, 16)
    # The third has not come, the second has.
    assert not found.accept_message(head(3))
    assert (count.disordered, count.repeated) == (1, 0)
    assert not found.accept_message(head(2))
    assert (count.disordered, count.repeated) == (1, 1)


def test_a_number_used_twice_does_not_hide_a_missing_one() -> None:
    found, count = order()
    assert found.accept_message(head(18, serial=54))
    assert found.accept_message(head(20, serial=60))
    assert found.accept_message(head(20, serial=64))
    assert not found.accept_message(head(19, serial=57))
    assert (count.missing, count.disordered, count.repeated) == (1, 1, 0)


def test_an_old_write_under_the_newest_number_is_repeated() -> None:
    found, count = order()
    assert found.accept_message(head(18, serial=54))
    assert found.accept_message(head(20, serial=60))
    assert not found.accept_message(head(20, serial=59))
    assert not found.accept_message(head(21, serial=58))
    assert (count.disordered, count.repeated) == (0, 2)
