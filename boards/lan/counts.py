"""What came of an import: counts, and the order of its messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rack.boards.lan.envelope import Envelope
from rack.boards.lan.peers import NONE

WINDOW = 64
"""Newest messages of an import of which it is known whether they came."""
_WHOLE = (1 << WINDOW) - 1


@dataclass
class ImportCount:
    """The first fields of `rack.boards.lan.messages.IMPORT`, in their order."""

    taken: int = 0
    missing: int = 0
    disordered: int = 0
    repeated: int = 0
    late: int = 0
    refused: int = 0
    unknown_launch: int = 0
    superseded: int = 0

    @property
    def values(self) -> tuple[int, ...]:
        """The counts."""
        return tuple(vars(self).values())

    def resume(self, record: Any) -> None:
        """Continue with the counts in a status."""
        for name in vars(self):
            setattr(self, name, int(record[name]))


class MessageOrder:
    """The messages of one import as they were sent: which is new, which came twice, which are
    missing.

    `launch`, `number` and `serial` are those of the newest one: see `Envelope`.
    """

    def __init__(self, count: ImportCount) -> None:
        self._count = count
        self.launch = NONE
        self.number = 0
        self.serial = 0
        self._came = 0  # bit n: message `number` - n came

    def resume(self, launch: int, number: int, serial: int) -> None:
        """Continue after that message; those before it count as having come."""
        self.launch = launch
        self.number = number
        self.serial = serial
        self._came = _WHOLE

    def admits(self, head: Envelope) -> bool:
        """Say whether a message is newer than all before it; count what is missing, or why it is
        not."""
        if head.launch != self.launch:
            self._begin(head)
        if head.serial <= self.serial:
            self._note_old(head)
            return False
        # A sender that was restarted may give one number twice.
        step = max(0, head.number - self.number)
        self._count.missing += max(0, step - 1)
        self._came = (self._came << min(step, WINDOW) | 1) & _WHOLE
        self.number = head.number
        self.serial = head.serial
        return True

    def _begin(self, head: Envelope) -> None:
        """Begin with the messages of a launch; what it sent before is not missing."""
        if self.launch == NONE and self.serial:
            # Resumed in lockstep, where launches are not on record: it is the same one.
            self.launch = head.launch
        else:
            self.launch = head.launch
            self.number = head.number
            self.serial = 0
            self._came = 0

    def _note_old(self, head: Envelope) -> None:
        bit = 1 << min(max(0, self.number - head.number), WINDOW)
        if head.serial == self.serial or self._came & bit:
            self._count.repeated += 1
        else:
            self._count.disordered += 1
            self._came |= bit & _WHOLE
