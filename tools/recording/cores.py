"""Measures stolen time and frequency of the machine's cores during a run.

Steal is time for which the hypervisor withheld a core that this machine needed; /proc/stat counts
it for each core. A core at a lower frequency computes more slowly; /proc/cpuinfo shows it.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

STAT = Path("/proc/stat")
CPUINFO = Path("/proc/cpuinfo")
STEAL_COLUMN = 8
"""Column of the steal count in a core's line of /proc/stat."""
FREQUENCY_S = 0.5
"""Time between two readings of the frequency.

Some kernels interrupt every core to read it, so it is not read more often.
"""
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
        mhz: (core, lowest MHz, highest MHz) for each core with a known frequency.
    """

    lasted_ns: int = 0
    stolen: tuple[Stolen, ...] | None = None
    mhz: tuple[tuple[int, float, float], ...] = ()


UNMEASURED = CoreRecord()
"""Record of a run in which nothing was measured."""


class CoreMeter:
    """Measures steal and frequency of the cores by reading the kernel's counters repeatedly."""

    def __init__(self) -> None:
        self._stolen: list[Stolen] = []
        self._mhz: dict[int, tuple[float, float]] = {}
        self._counts = _read_steal()
        self._began_ns = self._looked_ns = time.monotonic_ns()
        self._frequency_at = 0.0

    def read_counters(self) -> None:
        """Read the counters, and update the stolen times and the frequency range of each core."""
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
        if time.monotonic() >= self._frequency_at:
            self._frequency_at = time.monotonic() + FREQUENCY_S
            for core, mhz in _read_frequencies():
                low, high = self._mhz.get(core, (mhz, mhz))
                self._mhz[core] = min(low, mhz), max(high, mhz)

    def build_record(self) -> CoreRecord:
        """Return all measurements from the start to the last reading as a record."""
        mhz = tuple((core, low, high) for core, (low, high) in sorted(self._mhz.items()))
        return CoreRecord(
            self._looked_ns - self._began_ns, tuple(self._stolen) if self._counts else None, mhz
        )


def _read_steal() -> dict[int, int]:
    """Return the steal of each core in kernel ticks, or {} if the kernel does not count it."""
    lines = [line.split() for line in STAT.read_text().splitlines()]
    return {
        int(line[0].removeprefix("cpu")): int(line[STEAL_COLUMN])
        for line in lines
        if re.fullmatch(r"cpu\d+", line[0]) and len(line) > STEAL_COLUMN
    }


def _read_frequencies() -> Iterator[tuple[int, float]]:
    """Yield (core, MHz) for every core whose frequency the kernel reports."""
    for block in CPUINFO.read_text().split("\n\n"):
        fields = {
            name.strip(): value
            for name, _, value in (line.partition(":") for line in block.splitlines())
        }
        with suppress(KeyError, ValueError):
            yield int(fields["processor"]), float(fields["cpu MHz"])
