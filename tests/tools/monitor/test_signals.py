"""Tests that no message of a signal is missed, and that signals are merged by tick."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rack.tools.monitor.signals import SignalHistory
from rack.tools.recording.signal import Signal
from tests.backplane.bus import NAME
from tests.link import Link, links


@pytest.fixture
def link(rack_name: str) -> Iterator[Link]:
    """A writer that writes every second tick."""
    with links(rack_name) as make:
        yield make(rates=(2, 1), depth=64)


@pytest.fixture
def history(link: Link) -> SignalHistory:
    """Two signals of its mailbox."""
    boxes = link.segment.layout.mailboxes
    signals = [Signal.parse(f"{NAME}.{name}", boxes) for name in ("row[3]", "id")]
    return SignalHistory(link.segment, signals, span=20)


def test_every_message_is_read_once_and_overwritten_ones_are_counted(
    link: Link, history: SignalHistory
) -> None:
    taken: list[tuple[int, int]] = []
    for first in range(0, 60, 20):
        link.run(first, first + 20)
        rows = history.read_new()[NAME]
        taken += zip(rows["tick"].tolist(), rows["message"]["id"].tolist(), strict=True)
    assert taken == [(tick, tick) for tick in range(0, 60, 2)]
    assert (len(history.read_new()[NAME]), history.lost) == (0, 0)
    link.run(60, 460)
    rows = history.read_new()[NAME]
    assert history.lost + len(rows) == 200
    assert history.lost > 0


def test_a_strip_has_a_row_for_each_tick_and_keeps_its_span(
    link: Link, history: SignalHistory
) -> None:
    link.run(0, 40)
    history.read_new()
    assert history.list_rows(10, 15) == [(10, (10, 10)), (12, (12, 12)), (14, (14, 14))]
    for first in range(40, 400, 40):
        link.run(first, first + 40)
        history.read_new()
    kept = history.list_rows(0, 400)
    assert kept[-1] == (398, (398, 398))
    # The span, and as much as one reading may bring: the ring, and what is being written. The
    # oldest block of 40 ticks may reach further back.
    first = 398 - 20 - 2 * 64 - 4
    assert first - 40 <= kept[0][0] < first


def test_a_signal_keeps_its_value_between_messages(link: Link, history: SignalHistory) -> None:
    assert history.list_rows(0, 10) == []
    link.run(0, 8)
    history.read_new()
    assert history.list_rows(5, 6) == [(6, (6, 6))]
    assert history.to_time_s(6) == 0.015
