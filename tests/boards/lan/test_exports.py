"""A mailbox of this rack, sent to others: each new message once, and on after a restart."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config.loader import load_text
from rack.boards.lan.entries import Export
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import out_key
from rack.boards.lan.status import build_status_class
from tests.boards.lan.conftest import EVERY, LAUNCH, Network


class Exporting:
    """The adapter's export of `pulse.status`, and the level that writes it."""

    def __init__(self, segment: Segment) -> None:
        config = load_text(segment.config)
        assert config.adapter.lan is not None
        self.segment, self.network = segment, Network()
        self.table = config.adapter.lan.exports["pulse"]
        self.writer = open_writer(segment, "pulse.status")
        self.status = build_status_class(("pulse",), ()).zeros({})
        self.open()

    def open(self) -> None:
        self.entry = Export(self.segment, self.table, LAUNCH, OwnGrid(self.segment, EVERY))
        self.entry.open(self.network, Sealer())  # type: ignore[arg-type]

    def send(self, *ticks: int) -> None:
        for tick in ticks:
            self.entry.send_newest(tick)

    def restart(self) -> None:
        """Begin another adapter with the counts of the first."""
        self.entry.write_counts(self.status.export_pulse)
        self.heads()
        self.open()
        self.entry.restore_counts(self.status.export_pulse)

    def heads(self) -> list[Envelope]:
        """Return the heads of what was sent since the last call."""
        sent, self.network.sent = self.network.sent, []
        key = out_key(self.segment.rack, "pulse.status")
        found = [Sealer().open_message(key, envelope, payload) for payload, envelope in sent]
        assert all(isinstance(head, Envelope) for head in found)
        return found  # type: ignore[return-value]


@pytest.fixture
def exporting(segment: Segment) -> Exporting:
    return Exporting(segment)


def test_each_new_message_is_sent_once(exporting: Exporting) -> None:
    exporting.send(0)
    assert exporting.heads() == []
    exporting.writer.write(0)
    exporting.send(8, 16)
    exporting.writer.write(8)
    exporting.writer.write(16)
    exporting.send(24)
    heads = exporting.heads()
    assert [(head.number, head.serial, head.tick) for head in heads] == [(1, 1, 0), (2, 3, 16)]
    assert heads[1].time_ns == heads[1].stamp_ns == 16 * 2_500_000


def test_the_last_message_before_a_restart_is_sent_again(exporting: Exporting) -> None:
    for tick in (0, 8):
        exporting.writer.write(tick)
        exporting.send(tick + 8)
    exporting.entry.write_counts(exporting.status.export_pulse)
    sent = exporting.heads()
    # Time has gone on meanwhile.
    exporting.writer.write(32)
    for died_after, again in ((16, sent[1:]), (24, [])):
        exporting.restart()
        exporting.entry.resend_last(died_after, EVERY)
        assert exporting.heads() == again
        assert exporting.entry.count.sent == 2


def test_a_rack_that_joins_gets_the_newest_message_again(exporting: Exporting) -> None:
    exporting.writer.write(0)
    exporting.send(8)
    exporting.entry.must_resend = True
    exporting.send(16, 24)
    # In lockstep nobody comes late, and nothing may depend on when a token comes.
    times = 1 if exporting.segment.words[System.LOCKSTEP] else 2
    assert [(head.number, head.serial) for head in exporting.heads()] == [(1, 1)] * times
    assert exporting.entry.count.sent == 1


def test_a_restarted_adapter_continues_the_numbers(exporting: Exporting) -> None:
    for tick in (0, 8, 16):
        exporting.writer.write(tick)
        exporting.send(tick + 8)
    exporting.restart()
    exporting.send(32)
    assert exporting.heads() == []
    exporting.writer.write(32)
    exporting.send(40)
    assert [(head.number, head.serial) for head in exporting.heads()] == [(4, 4)]
