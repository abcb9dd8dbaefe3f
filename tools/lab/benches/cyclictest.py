"""`cyclictest` of rt-tests: how late this machine wakes a C program that sleeps to the points of a
grid.

No board can wake earlier than that, so it is the measure of every board's lateness, and of the
deadlines that the machine itself breaks: under a hypervisor a core is away for milliseconds at a
time.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import numpy as np

from rack.backplane.process import set_priority
from rack.tools.console.answer import Failure
from rack.tools.console.tables import decimal
from rack.tools.lab.benches.chart import BASELINE, Series
from rack.tools.lab.benches.harness import Absent, absent_program

CYCLICTEST = "cyclictest"
LONGEST_US = 100_000
"""Largest lateness that has a place of its own in the histogram; one beyond it counts as the
maximum."""
PATIENCE_S = 30.0
"""Time that a peer may take in addition to its wakes."""


@dataclass(frozen=True)
class WakeGrid:
    """Points in time to sleep to: `wakes` of them, `period_ns` apart.

    The first of `cores` has the sleeper; `cyclictest` has one on each. `priority` is of SCHED_FIFO.
    """

    cores: tuple[int, ...]
    period_ns: int
    wakes: int
    priority: int

    @classmethod
    def at(cls, cores: Iterable[int], rate_hz: float, seconds: float, priority: int) -> WakeGrid:
        """Return the points of a rate for a time."""
        wakes = max(1, round(seconds * rate_hz))
        return cls(tuple(sorted(cores)), round(1e9 / rate_hz), wakes, priority)

    @property
    def patience_s(self) -> float:
        """Longest time that a program may take over it."""
        return self.wakes * self.period_ns * 1e-9 + PATIENCE_S


def absent_cyclictest() -> tuple[Absent, ...]:
    """Return what `cyclictest` lacks; nothing if it can run."""
    refused = Absent(CYCLICTEST, "SCHED_FIFO is refused (see `ulimit -r`)")
    absent = absent_program(CYCLICTEST, CYCLICTEST, "rt-tests")
    return absent or (() if permits_fifo() else (refused,))


def misses_count(absent: Sequence[Absent]) -> Iterator[str]:
    """Yield what the absence of `cyclictest` means."""
    for each in absent:
        yield f"{each.line}; every miss counts against the rack"


def permits_fifo() -> bool:
    """Say whether this process may take a real-time priority."""
    return set_priority(1) and set_priority(0)


def cyclictest(grid: WakeGrid) -> np.ndarray:
    """Return the lateness of every wake, us, shape (n,): smallest first, a thread at a time.

    It leaves idle cores as they are, as a rack does by default (`--laptop`). Raises `Failure` if it
    cannot run.
    """
    with TemporaryDirectory(prefix="rack-bench-") as folder:
        path = Path(folder) / "found.json"
        command = [CYCLICTEST, "--quiet", "--mlockall", "--policy=fifo", "--laptop"]
        command += [f"--affinity={','.join(map(str, grid.cores))}", f"--threads={len(grid.cores)}"]
        command += [
            f"--priority={grid.priority}",
            f"--interval={grid.period_ns // 1000}",
            "--distance=0",
        ]
        command += [f"--loops={grid.wakes}", f"--histogram={LONGEST_US}", f"--json={path}"]
        errors = _run(command, grid.patience_s)
        if errors or not path.is_file():
            raise Failure(f"{CYCLICTEST}: {errors or 'it wrote no figures'}")
        threads = json.loads(path.read_text())["thread"].values()
    return np.concatenate([np.fromiter(_lateness_us(thread), float) for thread in threads])


def _run(command: Sequence[str], patience_s: float) -> str:
    """Run it to its end; return why it failed, empty if it did not."""
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        _, errors = process.communicate(timeout=patience_s)
    except subprocess.TimeoutExpired:
        return f"still running after {patience_s:g} s"
    finally:
        if process.poll() is None:
            # In order: killed, it would leave its shared memory.
            process.terminate()
            process.communicate()
    return (
        (" ".join(errors.split()) or f"exit status {process.returncode}")
        if process.returncode
        else ""
    )


def _lateness_us(thread: dict[str, object]) -> Iterator[float]:
    histogram = thread["histogram"]
    assert isinstance(histogram, dict)
    for late_us, count in histogram.items():
        yield from [float(late_us)] * count
    beyond = int(str(thread["cycles"])) - sum(histogram.values())
    yield from [float(str(thread["max"]))] * beyond


BEYOND = 0.001
"""Share of missed cycles, beyond those of the machine, up to which a rate counts as held."""


class MissesBeyond:
    """Base of figures whose misses are judged by those of `cyclictest` in the same minutes; all are
    shares."""

    DERIVED: ClassVar[tuple[str, ...]] = ("beyond", "held")

    missed: float
    late: float | None  # of cyclictest's wakes, by a cycle or more; None: it is absent

    @property
    def beyond(self) -> float:
        """Share missed beyond what the machine itself breaks."""
        return self.missed - (self.late or 0.0)

    @property
    def held(self) -> bool:
        """Whether the rate is held."""
        return self.beyond <= BEYOND

    def cells(self, digits: int = 3) -> list[str]:
        """Return cells of a table: shares missed, late, and missed beyond, %."""
        late = None if self.late is None else 100 * self.late
        return [decimal(part, digits) for part in (100 * self.missed, late, 100 * self.beyond)]


def missed_by(places: Sequence[float], figures: Sequence[MissesBeyond]) -> list[Series]:
    """Return the series of what was missed, and late of `cyclictest`, by rate or number."""
    missed = [100 * one.missed for one in figures]
    late = [100 * one.late for one in figures if one.late is not None]
    series = [Series("rack: missed", places, missed, "o-")]
    if late:
        series.append(Series("cyclictest: late by a cycle", places, late, "s-", BASELINE))
    return series


def overdue(late_us: np.ndarray, period_ns: int) -> float:
    """Return the share of grid points at which the sleeper was late by a cycle or more, those it
    skipped included."""
    passed = np.floor(late_us * 1e3 / period_ns)
    return (
        float(passed.sum() / (len(late_us) + np.clip(passed - 1, 0, None).sum()))
        if len(late_us)
        else 0.0
    )
