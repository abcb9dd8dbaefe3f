"""Protocol interrupt: every message interrupts each board that reads it.

A handler at the reading board serves one message at a time. A message is sent at an instant that is
computed, not measured: the release of the writing cycle plus the worst-case response of its task
(`rack.boards.config.layout`), or plus one tick if there is no budget. A plan is sent at the end of
its time slice. At the reading board a message joins the `Inbox`. A level can read it at the level's
first release at or after the end of its service. If too many messages wait at a board, the message
is lost at that board only.

Every reading task computes its board's inbox independently, from the ticks in the heads of the
slots in shared memory. The result depends on ticks alone, so all tasks of a board agree and runs
repeat exactly, provided that each message is in memory when it is sent. A message must therefore be
written before the first tick at or after its instant of sending, and in lockstep the clock waits
for it. A late message counts as a missed deadline of its writer, and as sent in the tick in which
it is written.

A restarted reader computes the inbox from the messages that are still in the slots, those of the
last two seconds or more. The result is the same as in the process before it if the inbox was empty
at any time within that span. A restarted writer continues as under time-slice.

Between tasks in one slot a message crosses no bus, so it interrupts no board and is read as under
time-slice.

Alternatives considered: the real time of the write (runs would differ even if no deadline is
missed), the end of the writer's cycle (this would be time-slice plus the handler's time, without
the benefit of interrupts that a message need not wait for the end of a cycle), and a process per
board that serves interrupts and holds the inbox in shared memory (a context switch for each
message, and one more process that may die).
"""

from __future__ import annotations

from collections import deque

from rack.backplane.address_map import compute_oldest_intact
from rack.backplane.layout import InterruptSpec, Layout, MailboxSpec
from rack.backplane.mailbox.inbox import Inbox, InterruptSource
from rack.backplane.mailbox.mailbox import MAX_STEP_BACK, Reader, Reading, Writer
from rack.backplane.mailbox.slots import Slots
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.words import Slot


def get_interrupt_spec(spec: MailboxSpec) -> InterruptSpec:
    """Return `spec.interrupt` of a mailbox, which must have protocol interrupt."""
    assert spec.interrupt is not None, f"mailbox '{spec.name}' is of protocol {spec.protocol}"
    return spec.interrupt


def compute_send_offset_ns(spec: MailboxSpec, clock_ns: int) -> int:
    """Return when a message is sent, in ns relative to the earliest tick at which it is visible.

    The result is negative, because a message is sent before it is visible.
    """
    return get_interrupt_spec(spec).sent_ns - spec.delay * clock_ns


class InterruptWriter(Writer):
    """Writer of a mailbox under protocol interrupt.

    A message must be written before the tick at which it is due (`InterruptSpec.due`).
    """

    def compute_visible_tick(self, tick: int, now: int | None) -> int:
        """Return the earliest tick at which a message is visible.

        A message that is written too late is treated as sent in the tick in which it is written.

        Args:
            tick: Release tick of the cycle that writes.
            now: Current tick. None if the cycle is known to be on time.
        """
        released = tick if now is None else max(tick, now - self._due + 1)
        return released + self._delay


class InterruptLine:
    """Messages of one mailbox that interrupt a board, as collected by one task of the board."""

    def __init__(self, segment: Segment, spec: MailboxSpec) -> None:
        self.service_ns = get_interrupt_spec(spec).service_ns
        self.lost = 0
        """Number of messages of this mailbox lost at this board because too many waited."""
        self.served: deque[int] = deque(maxlen=MAX_STEP_BACK)
        """Serials of the last few messages served."""
        self._slots = Slots(segment, spec)
        self._clock_ns = segment.layout.clock_ns
        self._sent_ns = compute_send_offset_ns(spec, self._clock_ns)
        self._passed = self._signature = self._missing = self._suspect = 0
        self._last_ns = 0

    @property
    def newest_serial(self) -> int:
        """Newest serial that a reader must examine.

        It belongs to a served message, to a slot that was never filled, or to a forged message.
        """
        return max(self.served[-1] if self.served else 0, self._missing, self._suspect)

    def collect_arrivals(
        self, until_ns: int, number: int, arrivals: list[tuple[int, int, int]]
    ) -> None:
        """Append to `arrivals` the messages that were sent since the last call.

        Args:
            until_ns: Time up to which messages are collected.
            number: Index of this line among the board's lines, stored with each arrival.
            arrivals: List of (time of arrival, index of the line, serial) to extend.
        """
        slots = self._slots
        head = slots.box[0]
        serial = self._passed + 1
        self._suspect = 0
        if serial > head:
            return
        slots.fence()
        serial = max(serial, compute_oldest_intact(head, slots.depth))
        while serial <= head:
            words = slots.heads[serial & slots.mask]
            if words[Slot.SERIAL] != serial:
                # The slot was never filled, so the message raises no interrupt.
                self._missing = serial
            elif words[Slot.EPOCH] != self._signature and not self._accept_writer(serial):
                # The message is forged. The true one, with the same serial, will overwrite it.
                self._suspect = serial
                break
            else:
                at_ns = words[Slot.VISIBLE_AT] * self._clock_ns + self._sent_ns
                if at_ns > until_ns:
                    break
                self._last_ns = max(self._last_ns, at_ns)
                arrivals.append((self._last_ns, number, serial))
            serial += 1
        self._passed = serial - 1

    def _accept_writer(self, serial: int) -> bool:
        """Check whether a message's writer held the claim. If so, store the writer's signature."""
        slots = self._slots
        if not slots.copy_slot(serial) or not slots.is_from_claimant(self._signature):
            return False
        self._signature = slots.signature
        return True


class BoardInbox:
    """Inbox of the board in a slot, computed by one of the board's tasks.

    Attributes:
        lines: Mailboxes that interrupt the board, keyed by name.
        inbox: Model of the inbox, which computes when messages are served.
    """

    def __init__(self, segment: Segment, slot: int) -> None:
        boxes = segment.layout.list_interrupting_mailboxes(slot)
        self.lines = {box.name: InterruptLine(segment, box) for box in boxes}
        self.inbox = Inbox(min(get_interrupt_spec(box).depth for box in boxes))
        self.count = 0
        """Number of messages served."""
        self.accepted_ns = 0
        """Total time that the handler takes for all messages that were not lost."""
        self.sources = list_sources(segment.layout, slot)
        """Messages that interrupt the board, of all mailboxes."""
        self._lines = tuple(self.lines.values())
        self._clock_ns = segment.layout.clock_ns
        self._tick = -1
        self._until_ns = -1
        self._newest_ns = 0
        # End of the service, line and serial of each message that waits or is being served.
        self._in_service: deque[tuple[int, InterruptLine, int]] = deque()

    def advance_to(self, tick: int) -> None:
        """Process all arrivals and ends of service up to `tick` that were not processed before."""
        if tick <= self._tick:
            return
        self._tick = tick
        until_ns = tick * self._clock_ns
        self.collect_arrivals(until_ns)
        in_service = self._in_service
        while in_service and in_service[0][0] <= until_ns:
            _, line, serial = in_service.popleft()
            line.served.append(serial)
            self.count += 1

    def collect_arrivals(self, until_ns: int) -> None:
        """Process all arrivals up to `until_ns` that were not processed before.

        Their messages can be read only once `advance_to` has reached the end of their service.
        """
        if until_ns <= self._until_ns:
            return
        self._until_ns = until_ns
        arrivals: list[tuple[int, int, int]] = []
        for number, line in enumerate(self._lines):
            line.collect_arrivals(until_ns, number, arrivals)
        if len(arrivals) > 1:
            arrivals.sort()
        for at_ns, number, serial in arrivals:
            self._add_arrival(at_ns, self._lines[number], serial)

    def _add_arrival(self, at_ns: int, line: InterruptLine, serial: int) -> None:
        """Add the arrival of a message to the inbox, or count it as lost if too many wait."""
        # A late message cannot be inserted before messages that have already been added, so it
        # arrives at the same time as the last of them.
        self._newest_ns = max(self._newest_ns, at_ns)
        end_ns = self.inbox.add_message(self._newest_ns, line.service_ns)
        if end_ns is None:
            line.lost += 1
        else:
            self._in_service.append((end_ns, line, serial))
            self.accepted_ns += line.service_ns


def list_sources(layout: Layout, slot: int) -> tuple[InterruptSource, ...]:
    """Return the messages that interrupt the board in a slot, by mailbox.

    It is assumed that a task writes in each of its cycles.
    """
    sources = []
    for box in layout.list_interrupting_mailboxes(slot):
        spec = get_interrupt_spec(box)
        writer = layout.find_task(box.writer)
        at_ns = writer.phase * layout.clock_ns + spec.sent_ns
        sources.append(
            InterruptSource(
                box.every * layout.clock_ns, spec.service_ns, at_ns, writer.role != "planner"
            )
        )
    return tuple(sources)


def open_inbox(segment: Segment, task: str) -> BoardInbox | None:
    """Open the inbox of a task's board. Returns None if nothing interrupts the board."""
    slot = segment.layout.find_task(task).slot
    return BoardInbox(segment, slot) if segment.layout.list_interrupting_mailboxes(slot) else None


class InterruptReader(Reader):
    """Reader of a mailbox whose messages interrupt its board."""

    def __init__(self, segment: Segment, name: str, inbox: BoardInbox) -> None:
        super().__init__(segment, name)
        self._inbox = inbox
        self._line = inbox.lines[name]

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest message whose service has ended by `tick`, with its verdict."""
        self.accesses += 1
        self._inbox.advance_to(tick)
        return self._accept(self._line.newest_serial, tick)

    def _step_back(self, serial: int, tick: int) -> Reading[AnyMessage]:
        """Return the newest unread good message that was served before a bad one.

        Args:
            serial: Serial of the bad message.
            tick: Release tick of the reading cycle.

        Returns:
            The reading with this message. If there is none, the last good message again.
        """
        for older in reversed(self._line.served):
            if self.serial < older < serial:
                if self._fetch_good(older):
                    return self._new
                self._count_bad_message(older)
        return self._unchanged
