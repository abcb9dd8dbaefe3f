"""Exceptions of the backplane, with the cause of each.

`BackplaneError` is the root. Catching it catches every error that this package raises on purpose.

- `SegmentError`: a rack name that is in use, a segment of another layout or owner, a full /dev/shm.
- `DamageError`: shared memory with a content that no process of the rack writes.
- `MailboxError`: an unknown mailbox, a second writer, a message that does not fit its type.
- `ClockError`: a rate that does not divide the clock, or is not a rate.
- `FaultTableError`: more faults than one run can have.
- `OperatorTableError`: more commands waiting for their ticks than the table holds.
- `EmergencyStopError`: a reset of the emergency stop while an input is bad.
"""

from __future__ import annotations


class BackplaneError(Exception):
    """Root of all errors of this package. Its text is one line for the user."""


class SegmentError(BackplaneError):
    """Raised if a segment cannot be created, attached or removed."""


class RackInUseError(SegmentError):
    """Raised if the segment belongs to a running rack."""


class DamageError(SegmentError):
    """Raised if shared memory has a content that no process of the rack writes."""

    def __init__(self, detail: str) -> None:
        super().__init__(f"the rack's shared memory is damaged: {detail}")


class MailboxError(BackplaneError):
    """Raised if a mailbox cannot be opened, claimed or matched with a message type."""


class ClockError(BackplaneError):
    """Raised for a rate or a period that the system clock cannot keep."""


class FaultTableError(BackplaneError):
    """Raised if a fault cannot be injected."""


class OperatorTableError(BackplaneError):
    """Raised if a command cannot be handed over."""


class EmergencyStopError(BackplaneError):
    """Raised if the emergency-stop latch cannot be reset."""
