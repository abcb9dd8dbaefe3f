"""A task's ports whose messages its level sends itself: queues, and mailboxes written on demand."""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.mailbox.mailbox import Reading, Writer
from rack.backplane.mailbox.queue import QueueWriter
from rack.backplane.message import sending
from rack.backplane.watch.alarms import Alarm, Episodes

Write = Callable[[int, int | None, int | None], bool]
Flush = Callable[[int, int | None], None]


class QueuePort:
    """Writes one queue for a task, and raises an alarm when it is full.

    A level that does not send by itself (`sends`) has its message sent in every cycle in which it
    is written.
    """

    def __init__(self, writer: QueueWriter, episodes: Episodes, sends: bool) -> None:
        self.writer = writer
        self._episodes = episodes
        self._sends = sends
        self._refused = 0

    def noting(self, read: Callable[[int], Reading]) -> Callable[[int], Reading]:
        """Return a function that reads the position of the queue's reader as of a tick, by `read`,
        and notes it."""

        def note(tick: int) -> Reading:
            reading = read(tick)
            self.writer.taken = int(reading.value.taken)
            return reading

        return note

    def write(self, onward: Write, tick: int, now: int | None, basis: int | None) -> bool:
        """Write the cycle's messages by `onward`; report those that the queue has refused."""
        writer = self.writer
        if not self._sends:
            writer.message.send()
        in_time = onward(tick, now, basis)
        if writer.refused != self._refused:
            refused = writer.refused - self._refused
            self._refused = writer.refused
            self._episodes.find(Alarm.QUEUE_FULL, writer.serial + writer.refused, tick, refused)
        return in_time


class DemandPort:
    """Writes one mailbox for a task in the cycles in which its level has sent a message; `message`
    is that message."""

    def __init__(self, writer: Writer) -> None:
        self.message = sending(writer.message, self._send, lambda: 1)
        self._is_sent = False
        self._basis: int | None = None

    def _send(self, basis: int | None = None) -> bool:
        self._is_sent = True
        self._basis = basis
        return True

    def write(
        self, onward: Write, flush: Flush, tick: int, now: int | None, basis: int | None
    ) -> bool:
        """Write the cycle's message by `onward`, if there is one; else `flush` what faults have
        delayed."""
        if not self._is_sent:
            flush(tick, now)
            return True
        self._is_sent = False
        return onward(tick, now, basis if self._basis is None else self._basis)
