"""Exceptions of the backplane, with the cause of each.

`BackplaneError` is the root. Catching it catches every error that this package raises on purpose.

- `SegmentError`: a rack name that is in use, a segment of another layout or owner, a full /dev/shm.
- `DamageError`: values in shared memory that no correct process of the rack writes.
- `MailboxError`: an unknown mailbox, a second writer, a message that does not fit its type.
- `ClockError`: a rate that is not positive or does not divide the clock's rate.
- `FaultTableError`: more faults than one run can have.
- `OperatorTableError`: more commands waiting for their ticks than the table holds.
- `EmergencyStopError`: a reset of the emergency stop while an input is bad.
"""

from __future__ import annotations


class BackplaneError(Exception):
    """Base class of all errors of this package. The error text is one line for the user."""


class SegmentError(BackplaneError):
    """Raised if a segment cannot be created, attached or removed."""


class RackInUseError(SegmentError):
    """Raised if the segment belongs to a running rack."""


class DamageError(SegmentError):
    """Raised if shared memory contains a value that no correct process of the rack writes."""

    def __init__(self, detail: str) -> None:
        super().__init__(f"the rack's shared memory is damaged: {detail}")


class MailboxError(BackplaneError):
    """Raised if a mailbox cannot be opened, claimed or matched with a message type."""


class ClockError(BackplaneError):
    """Raised for a rate that is not the system clock's rate divided by a whole number."""


class FaultTableError(BackplaneError):
    """Raised if a fault cannot be injected."""


class OperatorTableError(BackplaneError):
    """Raised if an operator's command cannot be entered into the operator table."""


class EmergencyStopError(BackplaneError):
    """Raised if the emergency-stop latch cannot be reset."""
