"""The exception tree of the bus, with the cause of each error.

`BackplaneError` is the root: catch it and every refusal of this package is caught.

- `SegmentError`: a rack name that is in use, a segment of another layout or owner, a full /dev/shm.
- `DamageError`: shared memory that holds what no process of the rack writes.
- `MailboxError`: an unknown mailbox, a second writer, a message that does not fit its type.
- `ClockError`: a rate that does not divide the clock, or is not a rate.
- `FaultTableError`: more faults than one run can have.
- `OperatorTableError`: more commands waiting for their ticks than the table holds.
- `EmergencyStopError`: a reset of the emergency stop while an input is bad.
"""

from __future__ import annotations


class BackplaneError(Exception):
    """Root of every error this package raises; its text is one line for the user."""


class SegmentError(BackplaneError):
    """A segment that cannot be made, attached or removed."""


class RackInUseError(SegmentError):
    """The segment of a rack that is running."""


class DamageError(SegmentError):
    """Shared memory that holds what no process of the rack writes there."""

    def __init__(self, what: str) -> None:
        super().__init__(f"the rack's shared memory is damaged: {what}")


class MailboxError(BackplaneError):
    """A mailbox that cannot be opened, claimed or matched with a message type."""


class ClockError(BackplaneError):
    """A rate or a period that the system clock cannot keep."""


class FaultTableError(BackplaneError):
    """A fault that cannot be injected."""


class OperatorTableError(BackplaneError):
    """A command that cannot be handed over."""


class EmergencyStopError(BackplaneError):
    """A latch that cannot be reset."""
