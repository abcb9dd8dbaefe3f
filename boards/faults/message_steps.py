"""What each fault of a writer does to the messages that pass through it.

A step finds the message's content in the writer's own message, and hands it on by `onward`. What is random depends on
the fault's seed and on the release tick of the message alone, so it repeats.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable, Mapping
from time import monotonic_ns
from typing import NamedTuple

from rack.backplane.fault_table import Entry, FaultEntry
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import LockWriter


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
        """Hand it on in the cycle of tick `at`; the writer's own message stays as the level has filled it."""
        present = bytes(writer.message.raw)
        writer.message.raw[:] = self.content
        onward(self.message._replace(at=at, visible_at=visible_at))
        writer.message.raw[:] = present


class Step:
    """One fault on one mailbox; by itself it changes nothing. `held` are the messages that it holds back."""

    def __init__(self, entry: FaultEntry, writer: Writer, index: int) -> None:
        self.entry, self.writer = entry, writer
        self.onward: Send
        self.held: list[Held] = []
        self._seed = f"{entry[Entry.SEED]} {index}"

    def send(self, message: Outgoing) -> None:
        """Take a message, and hand on what comes of it."""
        self.onward(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Hand on what has been held back until `tick`."""

    def acts(self, message: Outgoing) -> None:
        """Count that the fault acts, in the cycle in which the message is written."""
        self.entry.acted(message.at, monotonic_ns())

    def chance(self, message: Outgoing) -> random.Random:
        """Return the generator for a message."""
        return random.Random(f"{self._seed} {message.released}")

    def hold(self, message: Outgoing) -> None:
        """Keep a message with its content."""
        self.held.append(Held(message, bytes(self.writer.message.raw)))


class Mute(Step):
    """Writes nothing."""

    def send(self, message: Outgoing) -> None:
        """Suppress a message."""
        self.acts(message)


class Drop(Step):
    """Loses messages on their way: their serials are taken, their slots are not filled."""

    def send(self, message: Outgoing) -> None:
        """Lose a message, or hand it on."""
        if self.chance(message).random() < self.entry.parameters[0]:
            self.acts(message)
            self.writer.lose()
        else:
            self.onward(message)


class Delay(Step):
    """Holds every message back for so many cycles."""

    def send(self, message: Outgoing) -> None:
        """Hold a message back."""
        self.acts(message)
        self.hold(message)

    def flush(self, tick: int, visible_at: int) -> None:
        """Hand on the messages whose time has come."""
        span = round(self.entry.parameters[0]) * self.writer.spec.every
        due = [held for held in self.held if held.message.at + span <= tick]
        self.held = self.held[len(due) :]
        for held in due:
            held.send(self.writer, tick, visible_at, self.onward)


class Reorder(Step):
    """Exchanges a message with the one behind it."""

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


class Corrupt(Step):
    """Flips bits of a message in its slot."""

    def send(self, message: Outgoing) -> None:
        """Damage a message, or hand it on."""
        probability, bits, *_ = self.entry.parameters
        chance, size = self.chance(message), 8 * self.writer.spec.size
        if chance.random() < probability:
            self.acts(message)
            # Each bit once: flipped twice it is as it was.
            message = message._replace(damage=tuple(chance.sample(range(size), min(size, round(bits)))))
        self.onward(message)


class Babble(Step):
    """Writes a message again and again."""

    def send(self, message: Outgoing) -> None:
        """Hand a message on so many times."""
        self.acts(message)
        for _ in range(round(self.entry.parameters[0])):
            self.onward(message)


class HoldLock(Step):
    """Has the process stopped or killed while it holds the mailbox's lock, once."""

    def send(self, message: Outgoing) -> None:
        """Take the lock and end inside it; a process that is let go on gives it back."""
        writer, is_killed = self.writer, bool(self.entry.parameters[0])
        if isinstance(writer, LockWriter) and not self.entry[Entry.COUNT] and writer.lock.acquire():
            self.acts(message)
            os.kill(os.getpid(), signal.SIGKILL if is_killed else signal.SIGSTOP)
            writer.lock.release()
        self.onward(message)


STEPS: Mapping[str, type[Step]] = {
    "mute": Mute,
    "drop": Drop,
    "delay": Delay,
    "reorder": Reorder,
    "corrupt": Corrupt,
    "babble": Babble,
    "lock-held": HoldLock,
}
"""By kind: see `rack.boards.faults.kinds`."""
