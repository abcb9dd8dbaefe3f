"""LinuxCNC's thread: its intervals as lateness on a grid, its scheduling, and what it says when it
is absent."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.cyclictest import WakeGrid, permits_fifo
from rack.tools.lab.benches.linuxcnc import absent_linuxcnc, lateness_us, linuxcnc
from tests.tools.lab.benches import peers

GRID = WakeGrid((min(os.sched_getaffinity(0)),), 1_000_000, 60, 80 if permits_fifo() else 0)
needs_linuxcnc = pytest.mark.skipif(
    shutil.which("halrun") is None, reason="needs LinuxCNC (linuxcnc-uspace)"
)


def with_halrun(folder: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a stand-in before the rest of the path."""
    monkeypatch.setenv("PATH", str(peers.program(folder, "halrun", text)))


@needs_linuxcnc
def test_a_thread_of_linuxcnc_wakes_on_the_grid_of_its_earliest_run() -> None:
    found = linuxcnc(GRID)
    assert len(found) == GRID.wakes
    assert found.min() == 0.0


def test_intervals_become_lateness_after_the_earliest_run() -> None:
    intervals = np.array([1_000_000, 1_005_000, 995_000, 998_000, 1_002_000])
    assert lateness_us(intervals, 1_000_000).tolist() == [2.0, 7.0, 2.0, 0.0, 2.0]


def test_what_the_thread_prints_before_its_first_interval_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_halrun(tmp_path, peers.HALRUN, monkeypatch)
    found = linuxcnc(GRID)
    assert len(found) == 63
    assert set(found.tolist()) == {0.0, 5.0}


def test_a_thread_that_never_runs_is_a_failure_in_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_halrun(
        tmp_path, "import sys\nsys.exit('insmod for threads failed, returned -1')\n", monkeypatch
    )
    with pytest.raises(Failure, match="LinuxCNC thread: insmod for threads failed"):
        linuxcnc(GRID)


def test_it_is_absent_without_its_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    (absent,) = absent_linuxcnc()
    assert "apt-get install linuxcnc-uspace" in absent.line
