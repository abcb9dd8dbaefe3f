"""Utility lines of the bus as shared words: SYSFAIL, SYSRESET, ACFAIL and emergency stop."""

from __future__ import annotations

from rack.backplane.errors import EmergencyStopError
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, Word


class UtilityLines:
    """Utility lines of one rack. SYSFAIL has a word per slot, so that every word has one writer."""

    acfail = Word(System.ACFAIL)  # 1 if the power supply is failing and the run must end now
    sysreset = Word(System.SYSRESET)  # 1 if the system is to be reset
    emergency_stop = Word(System.EMERGENCY_STOP)  # 1 if the emergency-stop latch is set

    def __init__(self, segment: Segment) -> None:
        self.words = segment.words
        self._slots = sorted({task.slot for task in segment.layout.tasks})
        self._blocks = {task.name: segment.get_block(task.name) for task in segment.layout.tasks}

    def release_sysfail(self, slot: int) -> None:
        """Release SYSFAIL for a slot whose board has passed its self-test."""
        self.words[System.SYSFAIL + slot] = 0

    def assert_sysfail(self, slot: int) -> None:
        """Assert SYSFAIL for a slot whose board has failed."""
        self.words[System.SYSFAIL + slot] = 1

    @property
    def sysfail(self) -> list[int]:
        """Slots for which SYSFAIL is asserted."""
        return [slot for slot in self._slots if self.words[System.SYSFAIL + slot]]

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
        self.emergency_stop = 1

    def reset_emergency_stop(self) -> None:
        """Clear the emergency-stop latch.

        Raises:
            EmergencyStopError: There are `reset_obstacles`, which the error lists. The latch stays
                set.
        """
        if bad := self.reset_obstacles:
            raise EmergencyStopError(f"the emergency stop stays latched: {', '.join(bad)}")
        self.emergency_stop = 0
