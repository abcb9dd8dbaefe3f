"""Lateness of a C program on this machine, measured with `cyclictest` of rt-tests.

The program sleeps until the points of a time grid. No board can wake up earlier, so its lateness is
the reference for the lateness of every board. It also shows which deadlines the machine itself
misses: under a hypervisor a core can be unavailable for milliseconds.
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
from rack.tools.lab.benches.harness import Absent, run_program

CYCLICTEST = "cyclictest"
MAX_BIN_US = 100_000
"""Largest lateness with a separate bin in the histogram, us.

All larger ones are counted as the largest measured lateness.
"""
EXTRA_TIMEOUT_S = 30.0
"""Time that the program may take in addition to the time of its grid, s."""


class WakeGrid(NamedTuple):
    """Time grid to whose points the program sleeps.

    Attributes:
        core: Core of the program.
        period_ns: Time between two points, ns.
        wakes: Number of points.
        priority: SCHED_FIFO priority.
    """

    core: int
    period_ns: int
    wakes: int
    priority: int


def find_missing_cyclictest() -> tuple[Absent, ...]:
    """Return `cyclictest` as `Absent` if it cannot run here, or an empty tuple if it can."""
    if shutil.which(CYCLICTEST) is None:
        return (Absent(CYCLICTEST, f"no program '{CYCLICTEST}'", "apt-get install rt-tests"),)
    if not is_fifo_permitted():
        return (Absent(CYCLICTEST, "SCHED_FIFO is refused (see `ulimit -r`)"),)
    return ()


def is_fifo_permitted() -> bool:
    """Return True if this process may use a real-time priority."""
    return set_priority(1) and set_priority(0)


def run_cyclictest(grid: WakeGrid) -> np.ndarray:
    """Run `cyclictest` and return the lateness of every wake-up, (n,), in us, ascending.

    The program lets idle cores sleep (`--laptop`), as a rack does by default.

    Raises:
        Failure: If the program fails.
    """
    with TemporaryDirectory(prefix="rack-bench-") as folder:
        json_path = Path(folder) / "found.json"
        command = [
            *(CYCLICTEST, "--quiet", "--mlockall", "--policy=fifo", "--laptop", "--threads=1"),
            f"--affinity={grid.core}",
            f"--priority={grid.priority}",
            f"--interval={grid.period_ns // 1000}",
            f"--loops={grid.wakes}",
            f"--histogram={MAX_BIN_US}",
            f"--json={json_path}",
        ]
        timeout_s = grid.wakes * grid.period_ns * 1e-9 + EXTRA_TIMEOUT_S
        completed = run_program(CYCLICTEST, command, timeout_s)
        if completed.returncode or not json_path.is_file():
            status = f"exit status {completed.returncode}, and no figures"
            raise Failure(f"{CYCLICTEST}: {' '.join(completed.stderr.split()) or status}")
        (thread,) = json.loads(json_path.read_text())["thread"].values()
    counts = thread["histogram"]
    beyond_count = thread["cycles"] - sum(counts.values())
    return np.repeat([*map(float, counts), float(thread["max"])], [*counts.values(), beyond_count])


def compute_late_share(runs: Sequence[np.ndarray], period_ns: int) -> float | None:
    """Return the fraction of grid points at which a program was late by a cycle or more.

    Skipped points are included.

    Args:
        runs: Lateness of the wake-ups in each run, us.
        period_ns: Time between two grid points, ns.

    Returns:
        The fraction. None if there are no runs.
    """
    if not runs:
        return None
    periods_late = np.floor(np.concatenate(runs) * 1e3 / period_ns)
    points = len(periods_late) + np.clip(periods_late - 1, 0, None).sum()
    return float(periods_late.sum() / points) if points else 0.0
