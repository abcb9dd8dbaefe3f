"""The utility lines of the bus as shared words: SYSFAIL, SYSRESET, ACFAIL, and the emergency stop."""

from __future__ import annotations

from backplane.segment import Segment
from backplane.words import System


class UtilityLines:
    """The lines of one rack. SYSFAIL has a word a slot, so that every word has one writer."""

    def __init__(self, segment: Segment) -> None:
        self._words = segment.words
        self._slots = sorted({task.slot for task in segment.layout.tasks})

    def release_sysfail(self, slot: int) -> None:
        """Say that the board in `slot` has passed its self-test."""
        self._words[System.SYSFAIL + slot] = 0

    def assert_sysfail(self, slot: int) -> None:
        """Say that the board in `slot` has failed."""
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
