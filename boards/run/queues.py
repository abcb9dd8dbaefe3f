"""A task's ports to the queues that it writes."""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.mailbox.queue import QueueWriter
from rack.backplane.watch.alarms import Alarm, Episodes

Write = Callable[[int, int | None, int | None], bool]


class QueuePort:
    """Writes one queue for a task, and raises an alarm when it is full.

    A level that does not send by itself (`sends`) has its message sent in every cycle in which it is written.
    """

    def __init__(self, writer: QueueWriter, episodes: Episodes, sends: bool) -> None:
        self.writer = writer
        self._episodes, self._sends = episodes, sends
        self._refused = 0

    def noting(self, read: Callable[[int], Reading]) -> Callable[[int], Reading]:
        """Return a function that reads the position of the queue's reader as of a tick, by `read`, and notes it."""

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
            refused, self._refused = writer.refused - self._refused, writer.refused
            self._episodes.find(Alarm.QUEUE_FULL, writer.serial + writer.refused, tick, refused)
        return in_time
