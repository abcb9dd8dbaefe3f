"""Faults of a task's messages: each message passes through one step per fault on its way to the
mailbox.

Faults compose: each step passes any number of messages on to the next, at once or in a later cycle.
The content is in the writer's own message. Random choices depend only on the fault's seed and the
message's release tick, so they repeat.
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
    """A message in transit: written in the cycle of tick `at`, made in that of `released`;
    `damage`: bits to flip. `content`: of one that was delayed; None: that of the writer's own.
    """

    at: int
    released: int
    visible_at: int
    basis: int
    damage: tuple[int, ...] = ()
    content: bytes | None = None


Send = Callable[[Outgoing], None]


class MessageStep:
    """One fault on one mailbox, at `index` in the layout; this base class changes nothing. `held`:
    delayed messages.
    """

    def __init__(self, entry: FaultEntry, writer: Writer, index: int) -> None:
        self.entry = entry
        self.writer = writer
        self.onward: Send
        self.held: list[Outgoing] = []
        self._seed = f"{entry.seed} {index}"

    def send(self, message: Outgoing) -> None:
        """Take a message and pass on the result."""
        self.onward(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Pass on the messages delayed until `tick`."""

    def acts(self, message: Outgoing) -> None:
        """Count that the fault acts, in the cycle that writes the message."""
        self.entry.acted(message.at)

    def chance(self, message: Outgoing) -> random.Random:
        """Return the random generator for a message."""
        return random.Random(f"{self._seed} {message.released}")

    def hold(self, message: Outgoing) -> None:
        """Delay a message: keep it with its content."""
        content = message.content or bytes(self.writer.message.raw)
        self.held.append(message._replace(content=content))


class Mute(MessageStep):
    """Writes nothing."""

    def send(self, message: Outgoing) -> None:
        """Suppress a message."""
        self.acts(message)


class Drop(MessageStep):
    """Loses messages in transit: their serials are used, their slots stay unfilled."""

    def send(self, message: Outgoing) -> None:
        """Lose a message, or pass it on."""
        if self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.writer.lose()
        else:
            self.onward(message)


class Delay(MessageStep):
    """Delays every message by a number of cycles."""

    def send(self, message: Outgoing) -> None:
        """Delay a message."""
        self.acts(message)
        self.hold(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Pass on the messages whose delay is over."""
        span = round(self.entry.parameters[0]) * self.writer.spec.every
        due = [held for held in self.held if held.at + span <= tick]
        self.held = self.held[len(due) :]
        for held in due:
            self.onward(held._replace(at=tick, visible_at=visible_at))


class Reorder(MessageStep):
    """Swaps a message with the next one."""

    def send(self, message: Outgoing) -> None:
        """Pass on a message and then the delayed one, or delay it."""
        if self.held:
            self.onward(message)
            held = self.held.pop()
            self.onward(held._replace(at=message.at, visible_at=message.visible_at))
        elif self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.hold(message)
        else:
            self.onward(message)


class Corrupt(MessageStep):
    """Flips bits of a message in its slot."""

    def send(self, message: Outgoing) -> None:
        """Damage a message, or pass it on unchanged."""
        probability, bits, *_ = self.entry.parameters
        chance = self.chance(message)
        size = 8 * self.writer.spec.size
        if chance.random() < probability:
            self.acts(message)
            # Each bit at most once: a second flip would restore it.
            message = message._replace(
                damage=tuple(chance.sample(range(size), min(size, round(bits))))
            )
        self.onward(message)


class Babble(MessageStep):
    """Writes each message many times."""

    def send(self, message: Outgoing) -> None:
        """Pass a message on repeatedly."""
        self.acts(message)
        for _ in range(round(self.entry.parameters[0])):
            self.onward(message)


class HoldLock(MessageStep):
    """Stops or kills the process while it holds the mailbox's lock, once."""

    def send(self, message: Outgoing) -> None:
        """Stop or die while holding the lock; a stopped process releases it when it continues."""
        writer = self.writer
        is_killed = bool(self.entry.parameters[0])
        if isinstance(writer, LockWriter) and not self.entry.count and writer.lock.acquire():
            self.acts(message)
            number = signal.SIGKILL if is_killed else signal.SIGSTOP
            os.kill(os.getpid(), number)
            writer.lock.release()
        self.onward(message)


class FaultyWriter:
    """Replaces the writer of a mailbox that has faults. `index` is the mailbox's in the layout."""

    def __init__(self, writer: Writer, index: int) -> None:
        self._writer = writer
        self._index = index
        self._steps: dict[int, MessageStep] = {}
        self._first = self._publish
        self._late: list[Outgoing] = []
        self._written = True

    def apply(self, faults: Sequence[FaultEntry]) -> None:
        """Apply these faults from now on; those that continue keep their delayed
        messages.
        """
        steps = {}
        for entry in faults:
            kind = kind_of(entry).step
            assert isinstance(kind, type), "it acts on messages"
            assert issubclass(kind, MessageStep)
            before = self._steps.get(entry.index)
            steps[entry.index] = before or kind(entry, self._writer, self._index)
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
        """Whether no fault and no delayed message is left."""
        return not self._steps and not self._late

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Write the message as its faults leave it; return False if the message itself is too late.

        A delayed message becomes visible together with that of the cycle in which it is written, so
        that reads depend on ticks alone, even with faults.
        """
        self.flush(tick, now)
        self._written = True
        visible_at = self._writer.visible_at(tick, now)
        for _ in self._writer.outgoing():
            self._first(Outgoing(tick, tick, visible_at, tick if basis is None else basis))
        self._show()
        return self._written and self._writer.is_in_time(tick, now)

    def flush(self, tick: int, now: int | None = None) -> None:
        """Publish the delayed messages that are due."""
        visible_at = self._writer.visible_at(tick, now)
        late = self._late
        self._late = []
        for held in late:
            self._publish(held._replace(at=tick, visible_at=visible_at))
        for step in self._steps.values():
            step.flush(tick, visible_at)
        self._show()

    def _show(self) -> None:
        self._writer.held = len(self._late) + sum(len(step.held) for step in self._steps.values())
        self._writer.show()

    def _publish(self, message: Outgoing) -> None:
        raw = self._writer.message.raw
        # The writer's own message keeps the level's content.
        present = bytes(raw)
        raw[:] = message.content or present
        if not self._writer.publish(
            message.released, message.visible_at, message.basis, message.damage
        ):
            self._written = False
        raw[:] = present


def forge(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a message as a second writer, which has not claimed the mailbox; it is visible at
    `tick`.

    Only its writer is wrong. Its content is the newest message with every bit inverted, so that any
    reader that accepts it is noticed.
    """
    slots = Slots(segment, segment.layout.mailbox(mailbox))
    head = slots.box[Box.HEAD]
    if head:
        slots.fetch(head)
    slots.message.raw[:] = bytes(byte ^ 0xFF for byte in slots.message.raw)
    slots.resume(claim(slots.box[Box.EPOCH], os.getpid()))
    slots.publish(tick, tick, tick)
