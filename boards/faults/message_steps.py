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
from typing import NamedTuple, cast

import numpy as np

from rack.backplane.fault_table import FaultEntry
from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import LockWriter
from rack.backplane.mailbox.slots import Slots, build_signature
from rack.backplane.segment import Segment
from rack.backplane.words import Box
from rack.boards.faults.kind import find_kind


class Outgoing(NamedTuple):
    """A message that is about to be published.

    Attributes:
        at: Tick at which the cycle that publishes the message was released.
        released: Tick at which the cycle that made the message was released.
        visible_at: Tick at which the message becomes visible.
        basis: Tick of the information on which the message is based.
        damage: Indices of the bits to flip.
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

    def send_message(self, message: Outgoing) -> None:
        """Pass the message on. Subclasses change, delay or discard it."""
        self.onward(message)

    def flush_due(self, tick: int, visible_at: int) -> None:
        """Pass on the delayed messages that are due at `tick`. Steps that delay none do nothing."""

    def change_content(self, tick: int, content: bytes | memoryview) -> bytes | memoryview:
        """Return the content of a message of the cycle released at `tick`, by default unchanged."""
        return content

    def count_action(self, message: Outgoing) -> None:
        """Record in the fault table that the fault acted, in the cycle that writes the message."""
        self.entry.record_action(message.at)

    def create_random(self, message: Outgoing) -> random.Random:
        """Return a generator seeded from the fault, the mailbox and the message's release alone."""
        return random.Random(f"{self._seed} {message.released}")

    def hold_message(self, message: Outgoing) -> None:
        """Store a message with a copy of its content, because the buffer will be reused."""
        self.held.append(
            message._replace(content=message.content or bytes(self.writer.message.raw))
        )


class Mute(MessageStep):
    """Suppresses all messages."""

    def send_message(self, message: Outgoing) -> None:
        """Discard the message."""
        self.count_action(message)


class Drop(MessageStep):
    """Loses messages in transit: each uses up a serial, but is not written to its slot."""

    def send_message(self, message: Outgoing) -> None:
        """Lose the message with the fault's probability. Otherwise pass it on."""
        if self.create_random(message).random() < self.entry.parameters[0]:
            self.count_action(message)
            self.writer.lose_message()
        else:
            self.onward(message)


class Delay(MessageStep):
    """Delays every message by a number of cycles."""

    def send_message(self, message: Outgoing) -> None:
        """Store the message until its delay is over."""
        self.count_action(message)
        self.hold_message(message)

    def flush_due(self, tick: int, visible_at: int) -> None:
        """Pass on the messages whose delay is over."""
        delay_ticks = round(self.entry.parameters[0]) * self.writer.spec.every
        due = [message for message in self.held if message.at + delay_ticks <= tick]
        self.held = self.held[len(due) :]
        for message in due:
            self.onward(message._replace(at=tick, visible_at=visible_at))


class Reorder(MessageStep):
    """Swaps messages with their successors."""

    def send_message(self, message: Outgoing) -> None:
        """If a message is held back, pass on the new message and then the one held back.

        Otherwise hold the new message back with the fault's probability, or pass it on.
        """
        if self.held:
            self.onward(message)
            held_message = self.held.pop()
            self.onward(held_message._replace(at=message.at, visible_at=message.visible_at))
        elif self.create_random(message).random() < self.entry.parameters[0]:
            self.count_action(message)
            self.hold_message(message)
        else:
            self.onward(message)


class Corrupt(MessageStep):
    """Flips random bits of messages in their slots."""

    def send_message(self, message: Outgoing) -> None:
        """With the fault's probability, mark random bits to be flipped. Pass the message on."""
        probability, bits, *_ = self.entry.parameters
        chance = self.create_random(message)
        size = 8 * self.writer.spec.size
        if chance.random() < probability:
            self.count_action(message)
            # Sample without repetition: a second flip would restore a bit.
            message = message._replace(
                damage=tuple(chance.sample(range(size), min(size, round(bits))))
            )
        self.onward(message)


def choose_wrong_bit(entry: FaultEntry, spec: MailboxSpec) -> tuple[FieldSpec, int]:
    """Return the wrong field of a mailbox's messages, and the bit of it to flip.

    Both are drawn from the seed of the fault unless its parameters state them.
    """
    chance = random.Random(f"{entry.seed} {spec.name}")
    fields = spec.fields
    number, bit, *_ = map(int, entry.parameters)
    field = fields[number] if 0 <= number < len(fields) else chance.choice(fields)
    size = np.dtype((field.kind, field.shape)).itemsize * 8
    return field, bit % size if bit >= 0 else chance.randrange(size)


def describe_wrong_value(entry: FaultEntry, spec: MailboxSpec) -> str:
    """Return the wrong field of a mailbox's messages, and what is wrong, as text."""
    field, bit = choose_wrong_bit(entry, spec)
    offset = entry.parameters[2]
    return f"{field.name}, " + (f"offset {offset:g} {field.unit}" if offset else f"bit {bit}")


class WrongOutput(MessageStep):
    """Computes one field of each message wrongly. Readers cannot tell: the checksum is correct."""

    def change_content(self, tick: int, content: bytes | memoryview) -> bytes:
        """Flip a bit of the field or, if the fault has an offset, add it to each of its numbers."""
        self.entry.record_action(tick)
        changed = bytearray(content)
        field, bit = choose_wrong_bit(self.entry, self.writer.spec)
        kind = np.dtype(field.kind)
        offset = self.entry.parameters[2]
        if offset and kind.kind in "iuf":
            count = int(np.prod(field.shape, dtype=int))
            numbers = np.frombuffer(changed, kind, count, field.offset)
            np.add(numbers, offset, out=numbers, casting="unsafe")
        else:
            changed[field.offset + (bit >> 3)] ^= 1 << (bit & 7)
        return bytes(changed)

    def send_message(self, message: Outgoing) -> None:
        """Pass a wrong message on."""
        content = message.content or self.writer.message.raw
        self.onward(message._replace(content=self.change_content(message.at, content)))


class Babble(MessageStep):
    """Writes each message many times."""

    def send_message(self, message: Outgoing) -> None:
        """Pass the message on as many times as the parameter `writes` specifies."""
        self.count_action(message)
        for _ in range(round(self.entry.parameters[0])):
            self.onward(message)


class HoldLock(MessageStep):
    """Stops or kills the process once, while it holds the mailbox's lock."""

    def send_message(self, message: Outgoing) -> None:
        """Acquire the lock and stop or kill this process, unless the fault has already acted.

        When a stopped process continues, it releases the lock and passes the message on.
        """
        writer = self.writer
        if isinstance(writer, LockWriter) and not self.entry.count and writer.lock.acquire():
            self.count_action(message)
            is_killed = self.entry.parameters[0]
            os.kill(os.getpid(), signal.SIGKILL if is_killed else signal.SIGSTOP)
            writer.lock.release()
        self.onward(message)


class FaultyWriter:
    """Writer of a mailbox that has faults, used in place of the ordinary writer.

    Args:
        writer: Writer of the mailbox.
        index: Index of the mailbox in the layout.
    """

    def __init__(self, writer: Writer, index: int) -> None:
        self._writer = writer
        self._index = index
        self._steps: dict[int, MessageStep] = {}
        self._first = self._publish_message
        self._late: list[Outgoing] = []
        self._written = True

    def apply_faults(self, faults: Sequence[FaultEntry]) -> None:
        """Set the active faults. Faults that were already active keep their delayed messages.

        Delayed messages of faults that have ended are published in the next cycle.
        """
        steps = {}
        for entry in faults:
            kind = cast("type[MessageStep]", find_kind(entry).step)
            steps[entry.index] = self._steps.get(entry.index) or kind(
                entry, self._writer, self._index
            )
        for index, step in self._steps.items():
            if index not in steps:
                self._late += step.held
        self._steps = steps
        onward = self._publish_message
        for step in reversed(steps.values()):
            step.onward = onward
            onward = step.send_message
        self._first = onward

    def find_content(self, tick: int) -> bytes | memoryview:
        """Return the message that a standby holds back in the cycle released at `tick`."""
        content: bytes | memoryview = self._writer.message.raw
        for step in self._steps.values():
            content = step.change_content(tick, content)
        return content

    @property
    def is_over(self) -> bool:
        """Whether no fault is active and no delayed message waits to be published."""
        return not self._steps and not self._late

    def write(self, tick: int, now: int | None, basis: int) -> bool:
        """Pass the message through all faults and publish the results.

        A delayed message becomes visible together with the messages of the cycle that publishes it.
        Runs with delayed messages therefore repeat exactly in lockstep.

        Args:
            tick: Release of the cycle that writes.
            now: Current tick of the clock. None if the message cannot be late.
            basis: Tick of the information that the message is based on.

        Returns:
            True if everything was published, and in time for the readers.
        """
        self.flush_due(tick, now)
        self._written = True
        visible_at = self._writer.compute_visible_tick(tick, now)
        for _ in self._writer.iterate_outgoing():
            self._first(Outgoing(tick, tick, visible_at, basis))
        self._show_messages()
        return self._written and self._writer.is_in_time(tick, now)

    def flush_due(self, tick: int, now: int | None) -> None:
        """Publish delayed messages that are due at `tick` or whose fault is over."""
        visible_at = self._writer.compute_visible_tick(tick, now)
        late_messages = self._late
        self._late = []
        for message in late_messages:
            self._publish_message(message._replace(at=tick, visible_at=visible_at))
        for step in self._steps.values():
            step.flush_due(tick, visible_at)
        self._show_messages()

    def _show_messages(self) -> None:
        """Update the count of delayed messages and make published ones visible to readers."""
        self._writer.held = len(self._late) + sum(len(step.held) for step in self._steps.values())
        self._writer.show_published()

    def _publish_message(self, message: Outgoing) -> None:
        """Publish a message through the writer's buffer.

        Stored content, if any, temporarily replaces the content of the buffer.
        """
        raw = self._writer.message.raw
        # Restore the buffer afterwards, because it contains the level's newest message.
        present = bytes(raw)
        raw[:] = message.content or present
        if not self._writer.publish_message(
            message.released, message.visible_at, message.basis, message.damage
        ):
            self._written = False
        raw[:] = present


def forge_message(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a message as a second writer that has not claimed the mailbox.

    Its content is the newest message with all bits inverted, so that a reader that accepts it is
    noticed. Apart from its writer, the message is valid.

    Args:
        segment: Segment of the rack.
        mailbox: Name of the mailbox.
        tick: Tick at which the message becomes visible.
    """
    slots = Slots(segment, segment.layout.find_mailbox(mailbox))
    head = slots.box[Box.HEAD]
    if head:
        slots.fetch_message(head)
    slots.message.raw[:] = bytes(byte ^ 0xFF for byte in slots.message.raw)
    slots.resume_writing(build_signature(slots.box[Box.EPOCH], os.getpid()), head)
    slots.publish_message(tick, tick, tick)
