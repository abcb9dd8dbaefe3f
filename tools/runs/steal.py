"""Steal: time during which the hypervisor held a core that this machine needed. /proc/stat counts it by core."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

STAT = Path("/proc/stat")
STEAL = 8
"""Column of a core's line."""
_MS = 1000 // os.sysconf("SC_CLK_TCK")


class Stolen(NamedTuple):
    """Time stolen from a core between two looks (CLOCK_MONOTONIC); the kernel counts in steps of 10 ms."""

    from_ns: int
    to_ns: int
    core: int
    ms: int


class StealMeter:
    """Reads the counters now and then; `stolen` has the rises found, earliest first."""

    def __init__(self) -> None:
        self.stolen: list[Stolen] = []
        self._counts, self._looked_ns = _counts(), time.monotonic_ns()

    def look(self) -> None:
        """Compare the counters with those of the last look."""
        counts, now = _counts(), time.monotonic_ns()
        if counts != self._counts:
            rises = {core: count - self._counts.get(core, count) for core, count in counts.items()}
            self.stolen += [Stolen(self._looked_ns, now, core, rise * _MS) for core, rise in rises.items() if rise > 0]
        self._counts, self._looked_ns = counts, now


def _counts() -> dict[int, int]:
    """Return steal by core, in the kernel's ticks; empty where the kernel does not count it."""
    lines = [line.split() for line in STAT.read_text().splitlines()]
    cores = [line for line in lines if line[0].startswith("cpu") and line[0] != "cpu" and len(line) > STEAL]
    return {int(line[0].removeprefix("cpu")): int(line[STEAL]) for line in cores}
