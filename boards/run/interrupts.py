"""The interrupt handler of a board, under protocol interrupt: what it costs, and what it counts.

On the boards of the time it ran whenever a message came. Here the first task of the board does its
work, just before it reads: it takes as much processor time as the handler has worked since the last
cycle. So reading, t_comm of eq. 3.5, grows by it, and every task below on the same core is kept
waiting. In lockstep, where nothing waits for a processor, it takes no time.
"""

from __future__ import annotations

from time import process_time_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.mailbox.interrupt import BoardInbox
from rack.backplane.process import compute_until
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.words import Block


class InterruptHandler:
    """Serves the interrupts of a task's board: charges their time, counts them, and reports those
    that are lost."""

    def __init__(self, segment: Segment, task: str, inbox: BoardInbox, alarms: AlarmWriter) -> None:
        self._inbox = inbox
        self._block = segment.block(task)
        clock = SystemClock(segment)
        self._takes_time = not clock.is_lockstep
        self._lines = [
            (line, Episodes(segment, name, alarms)) for name, line in inbox.lines.items()
        ]
        # What happened before this process was there is neither charged nor counted.
        inbox.advance(clock.tick)
        inbox.inbox.most_waiting = 0
        self._served = inbox.count
        self._service_ns = inbox.service_ns
        self._lost = [line.lost for line in inbox.lines.values()]
        self._cycles = 0

    def serve(self, tick: int) -> None:
        """Serve everything that has come up to the release at `tick`."""
        inbox = self._inbox
        begun_ns = process_time_ns()
        self._cycles += 1
        inbox.advance(tick)
        if inbox.count != self._served:
            self._block[Block.INTERRUPTS] += inbox.count - self._served
            self._served = inbox.count
            if self._takes_time:
                compute_until(begun_ns + inbox.service_ns - self._service_ns)
            self._service_ns = inbox.service_ns
        if inbox.inbox.most_waiting > self._block[Block.INTERRUPTS_WAITING]:
            self._block[Block.INTERRUPTS_WAITING] = inbox.inbox.most_waiting
        if inbox.inbox.lost != sum(self._lost):
            # Count the messages lost in the inbox, and raise an alarm for each mailbox.
            for at, (line, episodes) in enumerate(self._lines):
                if lost := line.lost - self._lost[at]:
                    self._lost[at] = line.lost
                    self._block[Block.INTERRUPTS_LOST] += lost
                    episodes.find(Alarm.INBOX_FULL, self._cycles, tick, lost)
