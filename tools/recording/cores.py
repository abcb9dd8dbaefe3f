"""Measures the stolen time of the machine's cores during a run.

Steal is time for which the hypervisor withheld a core that this machine needed; /proc/stat counts
it for each core. The cores' frequency is not read: the kernel interrupts every core for it.
"""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

STAT = Path("/proc/stat")
STEAL_COLUMN = 8
"""Column of the steal count in a core's line of /proc/stat."""
_MS = 1000 // os.sysconf("SC_CLK_TCK")


class Stolen(NamedTuple):
    """Time stolen from a core between two readings, in CLOCK_MONOTONIC.

    The kernel counts in steps of 10 ms.
    """

    from_ns: int
    to_ns: int
    core: int
    ms: int


@dataclass(frozen=True)
class CoreRecord:
    """Measurements of a `CoreMeter`.

    Attributes:
        lasted_ns: Duration of the measurement.
        stolen: Increases of steal, earliest first, or None if steal was not measured.
    """

    lasted_ns: int = 0
    stolen: tuple[Stolen, ...] | None = None


UNMEASURED = CoreRecord()
"""Record of a run in which nothing was measured."""


class CoreMeter:
    """Measures the steal of the cores by reading the kernel's counters repeatedly."""

    def __init__(self) -> None:
        self._stolen: list[Stolen] = []
        self._counts = _read_steal()
        self._began_ns = self._looked_ns = time.monotonic_ns()

    def read_counters(self) -> None:
        """Read the counters, and update the stolen times."""
        counts = _read_steal()
        now = time.monotonic_ns()
        if counts != self._counts:
            rises = {core: count - self._counts.get(core, count) for core, count in counts.items()}
            self._stolen += [
                Stolen(self._looked_ns, now, core, rise * _MS)
                for core, rise in rises.items()
                if rise > 0
            ]
        self._counts = counts
        self._looked_ns = now

    def build_record(self) -> CoreRecord:
        """Return all measurements from the start to the last reading as a record."""
        return CoreRecord(
            self._looked_ns - self._began_ns, tuple(self._stolen) if self._counts else None
        )


def _read_steal() -> dict[int, int]:
    """Return the steal of each core in kernel ticks, or {} if the kernel does not count it."""
    lines = [line.split() for line in STAT.read_text().splitlines()]
    return {
        int(line[0].removeprefix("cpu")): int(line[STEAL_COLUMN])
        for line in lines
        if re.fullmatch(r"cpu\d+", line[0]) and len(line) > STEAL_COLUMN
    }
