"""What the machine did to its cores during a run, apart from our own lateness.

Steal is time during which the hypervisor held a core that this machine needed; /proc/stat counts it
by core. A core that runs at a lower frequency computes longer; cpufreq shows it, or else
/proc/cpuinfo where it has the field.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple, Self

from pydantic import TypeAdapter

from rack.backplane.json_text import encode_json

STAT = Path("/proc/stat")
CPUINFO = Path("/proc/cpuinfo")
CPUFREQ = Path("/sys/devices/system/cpu")
STEAL = 8
"""Column of a core's line."""
FREQUENCY_S = 0.5
"""Time between two looks at the frequency: some kernels interrupt every core for an answer."""
_MS = 1000 // os.sysconf("SC_CLK_TCK")


class Stolen(NamedTuple):
    """Time stolen from a core between two looks (CLOCK_MONOTONIC); the kernel counts in steps of 10
    ms.
    """

    from_ns: int
    to_ns: int
    core: int
    ms: int


@dataclass(frozen=True)
class CoreRecord:
    """What was seen in `lasted_ns`: the rises of steal, earliest first, and lowest and highest MHz
    by core.

    `stolen` is None where steal was not measured; a core without a frequency is not in `mhz`.
    """

    lasted_ns: int = 0
    stolen: tuple[Stolen, ...] | None = None
    mhz: tuple[tuple[int, float, float], ...] = ()

    def text(self) -> str:
        """Return it as JSON."""
        return encode_json(asdict(self))

    @classmethod
    def of(cls, text: str | bytes) -> Self:
        """Return the record in JSON. Raises `ValueError` for anything else."""
        return TypeAdapter(cls).validate_json(text)

    def stolen_ms(self) -> dict[int, int]:
        """Return the time stolen by core; cores that lost none are left out."""
        spans = self.stolen or ()
        return {
            core: sum(s.ms for s in spans if s.core == core)
            for core in sorted({s.core for s in spans})
        }


UNMEASURED = CoreRecord()
"""Nothing was measured."""


class CoreMeter:
    """Reads the counters now and then; `record` has what they showed."""

    def __init__(self) -> None:
        self._stolen: list[Stolen] = []
        self._mhz: dict[int, tuple[float, float]] = {}
        self._counts = _counts()
        self._began_ns = self._looked_ns = time.monotonic_ns()
        self._frequency_at = 0.0

    def look(self) -> None:
        """Compare the counters with those of the last look."""
        counts = _counts()
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
            for core, mhz in _frequencies():
                low, high = self._mhz.get(core, (mhz, mhz))
                self._mhz[core] = min(low, mhz), max(high, mhz)

    def record(self) -> CoreRecord:
        """Return what was seen up to the last look."""
        mhz = tuple((core, low, high) for core, (low, high) in sorted(self._mhz.items()))
        return CoreRecord(
            self._looked_ns - self._began_ns, tuple(self._stolen) if self._counts else None, mhz
        )


def _counts() -> dict[int, int]:
    """Return steal by core, in the kernel's ticks; empty where the kernel does not count it."""
    lines = [line.split() for line in STAT.read_text().splitlines()]
    return {
        int(line[0].removeprefix("cpu")): int(line[STEAL])
        for line in lines
        if re.fullmatch(r"cpu\d+", line[0]) and len(line) > STEAL
    }


def _frequencies() -> Iterator[tuple[int, float]]:
    """Yield core and MHz; nothing where the machine does not show them."""
    found = sorted(CPUFREQ.glob("cpu[0-9]*/cpufreq/scaling_cur_freq"))
    # A core that has been switched off has no readable frequency.
    for path in found:
        with suppress(OSError, ValueError):
            yield int(path.parts[-3].removeprefix("cpu")), int(path.read_text()) / 1000
    for block in () if found else CPUINFO.read_text().split("\n\n"):
        fields = {
            name.strip(): value
            for name, _, value in (line.partition(":") for line in block.splitlines())
        }
        with suppress(KeyError, ValueError):
            yield int(fields["processor"]), float(fields["cpu MHz"])
