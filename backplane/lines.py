"""The utility lines of the bus as shared words: SYSFAIL, SYSRESET, ACFAIL, and the emergency
stop.
"""

from __future__ import annotations

from rack.backplane.errors import EmergencyStopError
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System


class UtilityLines:
    """The lines of one rack. SYSFAIL has one word per slot, so that every word has one writer."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        self._slots = sorted({task.slot for task in segment.layout.tasks})
        self._blocks = {task.name: segment.block(task.name) for task in segment.layout.tasks}

    def release_sysfail(self, slot: int) -> None:
        """Release SYSFAIL for `slot`: its board has passed its self-test."""
        self._words[System.SYSFAIL + slot] = 0

    def assert_sysfail(self, slot: int) -> None:
        """Hold SYSFAIL for `slot`: its board has failed."""
        self._words[System.SYSFAIL + slot] = 1

    @property
    def sysfail(self) -> list[int]:
        """Slots that hold SYSFAIL."""
        return [slot for slot in self._slots if self._words[System.SYSFAIL + slot]]

    @property
    def acfail(self) -> bool:
        """Power is failing: end the run now."""
        return bool(self._words[System.ACFAIL])

    @property
    def sysreset(self) -> bool:
        """The system is to be reset."""
        return bool(self._words[System.SYSRESET])

    @property
    def emergency_stop(self) -> bool:
        """The emergency-stop latch."""
        return bool(self._words[System.EMERGENCY_STOP])

    @property
    def bad_inputs(self) -> list[str]:
        """Reasons why the latch must not be reset: asserted utility lines, lost boards."""
        found = [f"SYSFAIL of slot {slot}" for slot in self.sysfail]
        found += ["ACFAIL"] if self.acfail else []
        return found + [
            f"board '{name}' is lost" for name, block in self._blocks.items() if block[Block.LOST]
        ]

    def latch_emergency_stop(self) -> None:
        """Set the latch: the arm brakes, and stays braked until the latch is reset."""
        self._words[System.EMERGENCY_STOP] = 1

    def reset_emergency_stop(self) -> None:
        """Clear the latch. Raises `EmergencyStopError` with every bad input; the latch then stays
        set.
        """
        if bad := self.bad_inputs:
            raise EmergencyStopError(f"the emergency stop stays latched: {', '.join(bad)}")
        self._words[System.EMERGENCY_STOP] = 0
