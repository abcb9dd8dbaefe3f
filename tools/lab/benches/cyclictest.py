"""`cyclictest` of rt-tests: how late this machine wakes a C program that sleeps to the points of a
grid.

No board can wake earlier than that, so it is the measure of every board's lateness, and of the
deadlines that the machine itself breaks: under a hypervisor a core is away for milliseconds at a
time.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rack.backplane.process import set_priority
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import Absent, absent_program, finished

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
    absent = absent_program(CYCLICTEST, CYCLICTEST, "rt-tests")
    if absent or permits_fifo():
        return absent
    return (Absent(CYCLICTEST, "SCHED_FIFO is refused (see `ulimit -r`)"),)


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
        done = finished(CYCLICTEST, command, grid.patience_s)
        if done.returncode or not path.is_file():
            status = f"exit status {done.returncode}, and no figures"
            raise Failure(f"{CYCLICTEST}: {' '.join(done.stderr.split()) or status}")
        threads = json.loads(path.read_text())["thread"].values()
    return np.concatenate([_lateness_us(thread) for thread in threads])


def _lateness_us(thread: dict[str, Any]) -> np.ndarray:
    counts = thread["histogram"]
    beyond = thread["cycles"] - sum(counts.values())
    return np.repeat([*map(float, counts), float(thread["max"])], [*counts.values(), beyond])


def late_share(runs: Sequence[np.ndarray], period_ns: int) -> float | None:
    """Return the share of grid points at which a sleeper was late by a cycle or more, those it
    skipped included; `runs` have the lateness of its wakes, us. None without any run."""
    if not runs:
        return None
    passed = np.floor(np.concatenate(runs) * 1e3 / period_ns)
    points = len(passed) + np.clip(passed - 1, 0, None).sum()
    return float(passed.sum() / points) if points else 0.0
