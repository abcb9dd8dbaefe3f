"""The operator's desk, part of the clock's board: writes each command into its level's mailbox at its tick."""

from __future__ import annotations

from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.clock import SystemClock
from rack.backplane.operator_table import OperatorTable, RequestEntry, RequestStage, RequestWord
from rack.backplane.protocols import open_writer
from rack.backplane.segment import Segment
from rack.backplane.words import System

# Plain integers for the hot path.
_REQUESTED, _COMMANDED = int(System.REQUESTED), int(System.COMMANDED)


class OperatorDesk:
    """Gives commands at the beginning of a tick, before anything of the tick is released."""

    def __init__(self, segment: Segment, alarms: AlarmWriter) -> None:
        self._words, self._alarms = segment.words, alarms
        self._table, self._clock = OperatorTable(segment), SystemClock(segment)
        boxes = segment.layout.mailboxes
        self._writers = {at: open_writer(segment, box.name) for at, box in enumerate(boxes) if box.writer == CLOCK}
        self._requested = -1
        self._waiting: list[RequestEntry] = []

    @property
    def is_quiet(self) -> bool:
        """True when no command waits: there is nothing to do in this tick."""
        return not self._waiting and self._words[_REQUESTED] == self._requested

    def advance(self, tick: int) -> None:
        """Give all commands due at `tick`."""
        if self._words[_REQUESTED] != self._requested:
            self._requested = self._words[_REQUESTED]
            self._waiting = self._table.waiting()
        for entry in [entry for entry in self._waiting if entry[RequestWord.TICK] <= tick]:
            self._waiting.remove(entry)
            # Mark it first, then check that it still waits: a client that withdraws it does so in the opposite order.
            entry.words[RequestWord.GIVEN_TICK] = tick
            if self._table.is_waiting(entry):
                self._give(entry, tick)
            else:
                entry.words[RequestWord.GIVEN_TICK] = -1

    def _give(self, entry: RequestEntry, tick: int) -> None:
        words, writer = entry.words, self._writers[entry[RequestWord.MAILBOX]]
        if not words[RequestWord.SERIAL]:
            # A clock that dies after this line gives the command again on its return, under the same serial.
            self._words[_COMMANDED] += 1
            words[RequestWord.SERIAL] = self._words[_COMMANDED]
        message = writer.message
        message.raw[:] = entry.message[: len(message.raw)]
        message.id = words[RequestWord.SERIAL]
        writer.write(tick, self._clock.now())
        words[RequestWord.STAGE] = RequestStage.GIVEN
        self._alarms.ring(tick, Alarm.COMMANDED, entry.index, words[RequestWord.SERIAL])
