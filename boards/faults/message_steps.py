"""Faults of a task's messages. Each message passes through one step for each active fault.

Faults can be combined: a step may pass any number of messages on to the next one, at once or in a
later cycle. The content of a message is in the writer's own message buffer. Random choices depend
only on the fault's seed and the tick of the message's release, so a run repeats exactly.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rack.backplane.fault_table import FaultEntry
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import LockWriter
from rack.backplane.mailbox.slots import Slots, claim
from rack.backplane.segment import Segment
from rack.backplane.words import Box
from rack.boards.faults.kind import kind_of


class Outgoing(NamedTuple):
    """A message on its way to the mailbox.

    Attributes:
        at: Release of the cycle that publishes it, a tick.
        released: Release of the cycle that made it, a tick.
        visible_at: Tick at which it becomes visible.
        basis: Tick of the information that it is based on.
        damage: Indices of bits to flip.
        content: Content of a delayed message. None if it is still in the writer's buffer.
    """

    at: int
    released: int
    visible_at: int
    basis: int
    damage: tuple[int, ...] = ()
    content: bytes | None = None


Send = Callable[[Outgoing], None]


class MessageStep:
    """One fault on one mailbox. This base class passes messages on unchanged.

    Attributes:
        entry: The fault in the fault table.
        writer: Writer of the mailbox.
        onward: Next step, or the function that publishes.
        held: Delayed messages.
    """

    def __init__(self, entry: FaultEntry, writer: Writer, index: int) -> None:
        self.entry = entry
        self.writer = writer
        self.onward: Send
        self.held: list[Outgoing] = []
        self._seed = f"{entry.seed} {index}"

    def send(self, message: Outgoing) -> None:
        """Process a message and pass on the result."""
        self.onward(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Pass on the delayed messages that are due at `tick`."""

    def acts(self, message: Outgoing) -> None:
        """Record in the fault table that the fault acted, in the cycle that writes the message."""
        self.entry.acted(message.at)

    def chance(self, message: Outgoing) -> random.Random:
        """Return a random generator seeded by the fault and the message's release alone."""
        return random.Random(f"{self._seed} {message.released}")

    def hold(self, message: Outgoing) -> None:
        """Delay a message. Its content is copied, because the writer's buffer will be reused."""
        content = message.content or bytes(self.writer.message.raw)
        self.held.append(message._replace(content=content))


class Mute(MessageStep):
    """Suppresses all messages."""

    def send(self, message: Outgoing) -> None:
        """Discard the message."""
        self.acts(message)


class Drop(MessageStep):
    """Loses messages in transit: their serials are used up, but their slots are not filled."""

    def send(self, message: Outgoing) -> None:
        """Lose the message with the fault's probability, else pass it on."""
        if self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.writer.lose()
        else:
            self.onward(message)


class Delay(MessageStep):
    """Delays every message by a number of cycles."""

    def send(self, message: Outgoing) -> None:
        """Hold the message back."""
        self.acts(message)
        self.hold(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Pass on the messages whose delay is over."""
        delay_ticks = round(self.entry.parameters[0]) * self.writer.spec.every
        due = [message for message in self.held if message.at + delay_ticks <= tick]
        self.held = self.held[len(due) :]
        for message in due:
            self.onward(message._replace(at=tick, visible_at=visible_at))


class Reorder(MessageStep):
    """Swaps messages with their successors."""

    def send(self, message: Outgoing) -> None:
        """Pass the message on before the one held back, or hold it back at random."""
        if self.held:
            self.onward(message)
            held_message = self.held.pop()
            self.onward(held_message._replace(at=message.at, visible_at=message.visible_at))
        elif self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.hold(message)
        else:
            self.onward(message)


class Corrupt(MessageStep):
    """Flips bits of messages in their slots at random."""

    def send(self, message: Outgoing) -> None:
        """Choose bits to flip with the fault's probability, and pass the message on."""
        probability, bits, *_ = self.entry.parameters
        chance = self.chance(message)
        size = 8 * self.writer.spec.size
        if chance.random() < probability:
            self.acts(message)
            # Sample without repetition: a second flip would restore a bit.
            message = message._replace(
                damage=tuple(chance.sample(range(size), min(size, round(bits))))
            )
        self.onward(message)


class Babble(MessageStep):
    """Writes each message many times."""

    def send(self, message: Outgoing) -> None:
        """Pass the message on as often as the fault says."""
        self.acts(message)
        for _ in range(round(self.entry.parameters[0])):
            self.onward(message)


class HoldLock(MessageStep):
    """Stops or kills the process once, while it holds the mailbox's lock."""

    def send(self, message: Outgoing) -> None:
        """Take the lock and stop or die. A stopped process releases the lock when it continues."""
        writer = self.writer
        is_killed = bool(self.entry.parameters[0])
        if isinstance(writer, LockWriter) and not self.entry.count and writer.lock.acquire():
            self.acts(message)
            number = signal.SIGKILL if is_killed else signal.SIGSTOP
            os.kill(os.getpid(), number)
            writer.lock.release()
        self.onward(message)


class FaultyWriter:
    """Replaces the writer of a mailbox that has faults.

    `index` is the index of the mailbox in the layout.
    """

    def __init__(self, writer: Writer, index: int) -> None:
        self._writer = writer
        self._index = index
        self._steps: dict[int, MessageStep] = {}
        self._first = self._publish
        self._late: list[Outgoing] = []
        self._written = True

    def apply(self, faults: Sequence[FaultEntry]) -> None:
        """Set the active faults. Faults that were already active keep their delayed messages.

        Delayed messages of faults that have ended are published in the next cycle.
        """
        steps = {}
        for entry in faults:
            kind = kind_of(entry).step
            assert isinstance(kind, type), "it acts on messages"
            assert issubclass(kind, MessageStep)
            running_step = self._steps.get(entry.index)
            steps[entry.index] = running_step or kind(entry, self._writer, self._index)
        for index, step in self._steps.items():
            if index not in steps:
                self._late += step.held
        self._steps = steps
        onward = self._publish
        for step in reversed(steps.values()):
            step.onward = onward
            onward = step.send
        self._first = onward

    @property
    def is_over(self) -> bool:
        """Whether neither a fault nor a delayed message is left."""
        return not self._steps and not self._late

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Pass the message through all faults and publish the results.

        A delayed message becomes visible together with the messages of the cycle that publishes it.
        What readers see therefore depends on ticks alone, even with faults.

        Args:
            tick: Release of the cycle that writes.
            now: Current tick of the clock. None if the message cannot be late.
            basis: Tick of the information that the message is based on. None means `tick`.

        Returns:
            False if the message was written too late for its readers.
        """
        self.flush(tick, now)
        self._written = True
        visible_at = self._writer.visible_at(tick, now)
        for _ in self._writer.outgoing():
            self._first(Outgoing(tick, tick, visible_at, tick if basis is None else basis))
        self._show()
        return self._written and self._writer.is_in_time(tick, now)

    def flush(self, tick: int, now: int | None = None) -> None:
        """Publish the delayed messages that are due at `tick`."""
        visible_at = self._writer.visible_at(tick, now)
        late_messages = self._late
        self._late = []
        for message in late_messages:
            self._publish(message._replace(at=tick, visible_at=visible_at))
        for step in self._steps.values():
            step.flush(tick, visible_at)
        self._show()

    def _show(self) -> None:
        """Update the count of delayed messages and show published messages to readers."""
        self._writer.held = len(self._late) + sum(len(step.held) for step in self._steps.values())
        self._writer.show()

    def _publish(self, message: Outgoing) -> None:
        """Publish a message with its own content and restore the writer's buffer."""
        raw = self._writer.message.raw
        # Restore the buffer afterwards, because it contains the level's newest message.
        present = bytes(raw)
        raw[:] = message.content or present
        if not self._writer.publish(
            message.released, message.visible_at, message.basis, message.damage
        ):
            self._written = False
        raw[:] = present


def forge(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a message as a second writer that has not claimed the mailbox.

    Its content is the newest message with all bits inverted, so that a reader that accepts it is
    noticed. Apart from its writer, the message is valid.

    Args:
        segment: Segment of the rack.
        mailbox: Name of the mailbox.
        tick: Tick at which the message becomes visible.
    """
    slots = Slots(segment, segment.layout.mailbox(mailbox))
    head = slots.box[Box.HEAD]
    if head:
        slots.fetch(head)
    slots.message.raw[:] = bytes(byte ^ 0xFF for byte in slots.message.raw)
    slots.resume(claim(slots.box[Box.EPOCH], os.getpid()))
    slots.publish(tick, tick, tick)
