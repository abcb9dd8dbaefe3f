"""Faults of a task's messages: each message passes through one step a fault, then into its mailbox, or not.

Faults compose: each step hands on to the next as many messages as it likes, at once or in a later cycle. A step finds
the content in the writer's own message. Random choices depend only on the fault's seed and on the message's release
tick, so they repeat.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import NamedTuple

from rack.backplane.fault_table import Entry, FaultEntry
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import LockWriter
from rack.backplane.mailbox.slots import Slots, claim
from rack.backplane.segment import Segment
from rack.backplane.words import Box
from rack.boards.faults.kind import KINDS


class Outgoing(NamedTuple):
    """A message on its way: written in the cycle of tick `at`, made in that of `released`; bits to flip in its slot."""

    at: int
    released: int
    visible_at: int
    basis: int
    damage: tuple[int, ...] = ()


Send = Callable[[Outgoing], None]


class Held(NamedTuple):
    """A message that is held back, with its content."""

    message: Outgoing
    content: bytes

    def send(self, writer: Writer, at: int, visible_at: int, onward: Send) -> None:
        """Hand it on in the cycle of tick `at`; the writer's own message keeps the level's content."""
        present = bytes(writer.message.raw)
        writer.message.raw[:] = self.content
        onward(self.message._replace(at=at, visible_at=visible_at))
        writer.message.raw[:] = present


class MessageStep:
    """One fault on one mailbox, the layout's at `index`; this class changes nothing. `held` are messages held back."""

    def __init__(self, entry: FaultEntry, writer: Writer, index: int) -> None:
        self.entry, self.writer = entry, writer
        self.onward: Send
        self.held: list[Held] = []
        self._seed = f"{entry[Entry.SEED]} {index}"

    def send(self, message: Outgoing) -> None:
        """Take a message, and hand on the result."""
        self.onward(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Hand on messages that were held back until `tick`."""

    def acts(self, message: Outgoing) -> None:
        """Count that the fault acts, in the cycle in which the message is written."""
        self.entry.acted(message.at, monotonic_ns())

    def chance(self, message: Outgoing) -> random.Random:
        """Return the generator for a message."""
        return random.Random(f"{self._seed} {message.released}")

    def hold(self, message: Outgoing) -> None:
        """Keep a message with its content."""
        self.held.append(Held(message, bytes(self.writer.message.raw)))


class Mute(MessageStep):
    """Writes nothing."""

    def send(self, message: Outgoing) -> None:
        """Suppress a message."""
        self.acts(message)


class Drop(MessageStep):
    """Loses messages on their way: their serials are taken, their slots are not filled."""

    def send(self, message: Outgoing) -> None:
        """Lose a message, or hand it on."""
        if self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.writer.lose()
        else:
            self.onward(message)


class Delay(MessageStep):
    """Holds every message back for so many cycles."""

    def send(self, message: Outgoing) -> None:
        """Hold a message back."""
        self.acts(message)
        self.hold(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Hand on the messages that have waited long enough."""
        span = round(self.entry.parameters[0]) * self.writer.spec.every
        due = [held for held in self.held if held.message.at + span <= tick]
        self.held = self.held[len(due) :]
        for held in due:
            held.send(self.writer, tick, visible_at, self.onward)


class Reorder(MessageStep):
    """Exchanges a message with the next one."""

    def send(self, message: Outgoing) -> None:
        """Hand on a message and then the one held back, or hold it back."""
        if self.held:
            self.onward(message)
            self.held.pop().send(self.writer, message.at, message.visible_at, self.onward)
        elif self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.hold(message)
        else:
            self.onward(message)


class Corrupt(MessageStep):
    """Flips bits of a message in its slot."""

    def send(self, message: Outgoing) -> None:
        """Damage a message, or hand it on."""
        probability, bits, *_ = self.entry.parameters
        chance, size = self.chance(message), 8 * self.writer.spec.size
        if chance.random() < probability:
            self.acts(message)
            # Each bit once: flipped twice it would be as before.
            message = message._replace(damage=tuple(chance.sample(range(size), min(size, round(bits)))))
        self.onward(message)


class Babble(MessageStep):
    """Writes a message again and again."""

    def send(self, message: Outgoing) -> None:
        """Hand a message on so many times."""
        self.acts(message)
        for _ in range(round(self.entry.parameters[0])):
            self.onward(message)


class HoldLock(MessageStep):
    """Stops or kills the process while it holds the mailbox's lock, once."""

    def send(self, message: Outgoing) -> None:
        """Take the lock and end inside it; a stopped process that continues gives it back."""
        writer, is_killed = self.writer, bool(self.entry.parameters[0])
        if isinstance(writer, LockWriter) and not self.entry[Entry.COUNT] and writer.lock.acquire():
            self.acts(message)
            os.kill(os.getpid(), signal.SIGKILL if is_killed else signal.SIGSTOP)
            writer.lock.release()
        self.onward(message)


class FaultyWriter:
    """Stands in for the writer of a mailbox while it has faults. `index` is the mailbox's in the layout."""

    def __init__(self, writer: Writer, index: int) -> None:
        self._writer, self._index = writer, index
        self._steps: dict[int, MessageStep] = {}
        self._first = self._publish
        self._late: list[Held] = []
        self._written = True

    def apply(self, faults: Sequence[tuple[str, FaultEntry]]) -> None:
        """Write with these faults, by kind, from now on; those that continue keep the messages they hold back."""
        steps = {entry.index: self._steps.get(entry.index) or self._step(kind, entry) for kind, entry in faults}
        for index, step in self._steps.items():
            if index not in steps:
                self._late += step.held
        self._steps = steps
        onward = self._publish
        for step in reversed(steps.values()):
            step.onward = onward
            onward = step.send
        self._first = onward

    def _step(self, kind: str, entry: FaultEntry) -> MessageStep:
        step = KINDS[kind].step
        assert isinstance(step, type), f"'{kind}' acts on messages"
        assert issubclass(step, MessageStep)
        return step(entry, self._writer, self._index)

    @property
    def is_over(self) -> bool:
        """Whether no fault is left, and no message held back by one."""
        return not self._steps and not self._late

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Write `message` as its faults leave it; return False when the message itself comes too late.

        A message that a fault has held back is visible from when that of the cycle is, or would be: reads depend on
        ticks alone, with faults too.
        """
        self.flush(tick, now)
        spec, self._written = self._writer.spec, True
        visible_at = self._writer.visible_at(tick, now)
        self._first(Outgoing(tick, tick, visible_at, tick if basis is None else basis))
        return self._written and (now is None or now < tick + spec.delay)

    def flush(self, tick: int, now: int | None = None) -> None:
        """Publish messages that faults have held back until now."""
        visible_at = self._writer.visible_at(tick, now)
        late, self._late = self._late, []
        for held in late:
            held.send(self._writer, tick, visible_at, self._publish)
        for step in self._steps.values():
            step.flush(tick, visible_at)

    def _publish(self, message: Outgoing) -> None:
        if not self._writer.publish(message.released, message.visible_at, message.basis, message.damage):
            self._written = False


def forge(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a message as a second writer, which holds no claim; it is visible at `tick`.

    It is sound but for its writer. Its content is the newest message's with every bit inverted, so that it shows
    wherever it is believed.
    """
    slots = Slots(segment, segment.layout.mailbox(mailbox))
    head = slots.box[Box.HEAD]
    if head:
        slots.fetch(head)
    slots.message.raw[:] = bytes(byte ^ 0xFF for byte in slots.message.raw)
    slots.resume(claim(slots.box[Box.EPOCH], os.getpid()))
    slots.publish(tick, tick, tick)
