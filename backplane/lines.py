"""Utility lines of the bus as shared words: SYSFAIL, SYSRESET, ACFAIL and emergency stop."""

from __future__ import annotations

from rack.backplane.errors import EmergencyStopError
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System


class UtilityLines:
    """Utility lines of one rack. SYSFAIL has a word per slot, so that every word has one writer."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        self._slots = sorted({task.slot for task in segment.layout.tasks})
        self._blocks = {task.name: segment.get_block(task.name) for task in segment.layout.tasks}

    def release_sysfail(self, slot: int) -> None:
        """Release SYSFAIL for a slot whose board has passed its self-test."""
        self._words[System.SYSFAIL + slot] = 0

    def assert_sysfail(self, slot: int) -> None:
        """Assert SYSFAIL for a slot whose board has failed."""
        self._words[System.SYSFAIL + slot] = 1

    @property
    def sysfail(self) -> list[int]:
        """Slots for which SYSFAIL is asserted."""
        return [slot for slot in self._slots if self._words[System.SYSFAIL + slot]]

    @property
    def acfail(self) -> bool:
        """True if the power supply is failing and the run must end now."""
        return bool(self._words[System.ACFAIL])

    @property
    def sysreset(self) -> bool:
        """True if the system is to be reset."""
        return bool(self._words[System.SYSRESET])

    @property
    def emergency_stop(self) -> bool:
        """True if the emergency-stop latch is set."""
        return bool(self._words[System.EMERGENCY_STOP])

    @property
    def reset_obstacles(self) -> list[str]:
        """Texts that state why the emergency stop must not be reset. Empty if it may be reset.

        The possible reasons are an asserted SYSFAIL, an asserted ACFAIL and lost boards.
        """
        reasons = [f"SYSFAIL of slot {slot}" for slot in self.sysfail]
        reasons += ["ACFAIL"] if self.acfail else []
        return reasons + [
            f"board '{name}' is lost" for name, block in self._blocks.items() if block[Block.LOST]
        ]

    def latch_emergency_stop(self) -> None:
        """Set the emergency-stop latch. The arm brakes until `reset_emergency_stop` clears it."""
        self._words[System.EMERGENCY_STOP] = 1

    def reset_emergency_stop(self) -> None:
        """Clear the emergency-stop latch.

        Raises:
            EmergencyStopError: There are `reset_obstacles`, which the error lists. The latch stays
                set.
        """
        if bad := self.reset_obstacles:
            raise EmergencyStopError(f"the emergency stop stays latched: {', '.join(bad)}")
        self._words[System.EMERGENCY_STOP] = 0
