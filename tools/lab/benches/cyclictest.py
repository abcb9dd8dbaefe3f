"""`cyclictest` of rt-tests: how late this machine wakes a C program that sleeps to the points of a
grid.

No board can wake earlier than that, so it is the measure of every board's lateness, and of the
deadlines that the machine itself breaks: under a hypervisor a core is away for milliseconds at a
time.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from rack.backplane.process import set_priority
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import Absent, finished

CYCLICTEST = "cyclictest"
LONGEST_US = 100_000
"""Largest lateness that has a place of its own in the histogram; one beyond it counts as the
maximum."""
PATIENCE_S = 30.0
"""Time that it may take in addition to its wakes."""


class WakeGrid(NamedTuple):
    """Points in time to sleep to on `core`: `wakes` of them, `period_ns` apart, at a `priority` of
    SCHED_FIFO.
    """

    core: int
    period_ns: int
    wakes: int
    priority: int


def absent_cyclictest() -> tuple[Absent, ...]:
    """Return what `cyclictest` lacks; nothing if it can run."""
    if shutil.which(CYCLICTEST) is None:
        return (Absent(CYCLICTEST, f"no program '{CYCLICTEST}'", "apt-get install rt-tests"),)
    if not permits_fifo():
        return (Absent(CYCLICTEST, "SCHED_FIFO is refused (see `ulimit -r`)"),)
    return ()


def permits_fifo() -> bool:
    """Return whether this process may take a real-time priority."""
    return set_priority(1) and set_priority(0)


def cyclictest(grid: WakeGrid) -> np.ndarray:
    """Return the lateness of every wake, us, shape (n,), smallest first.

    It leaves idle cores as they are, as a rack does by default (`--laptop`).

    Raises:
        Failure: If it cannot run.
    """
    with TemporaryDirectory(prefix="rack-bench-") as folder:
        path = Path(folder) / "found.json"
        command = [
            *(CYCLICTEST, "--quiet", "--mlockall", "--policy=fifo", "--laptop", "--threads=1"),
            f"--affinity={grid.core}",
            f"--priority={grid.priority}",
            f"--interval={grid.period_ns // 1000}",
            f"--loops={grid.wakes}",
            f"--histogram={LONGEST_US}",
            f"--json={path}",
        ]
        bound_s = grid.wakes * grid.period_ns * 1e-9 + PATIENCE_S
        done = finished(CYCLICTEST, command, bound_s)
        if done.returncode or not path.is_file():
            status = f"exit status {done.returncode}, and no figures"
            raise Failure(f"{CYCLICTEST}: {' '.join(done.stderr.split()) or status}")
        (thread,) = json.loads(path.read_text())["thread"].values()
    counts = thread["histogram"]
    beyond = thread["cycles"] - sum(counts.values())
    return np.repeat([*map(float, counts), float(thread["max"])], [*counts.values(), beyond])


def late_share(runs: Sequence[np.ndarray], period_ns: int) -> float | None:
    """Return the share of grid points at which a sleeper was late by a cycle or more, those it
    skipped included; `runs` have the lateness of its wakes, us. None without any run.
    """
    if not runs:
        return None
    passed = np.floor(np.concatenate(runs) * 1e3 / period_ns)
    points = len(passed) + np.clip(passed - 1, 0, None).sum()
    return float(passed.sum() / points) if points else 0.0
