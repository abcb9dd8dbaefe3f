"""cyclictest: the lateness of every wake from its histogram, its absence and its refusal."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.cyclictest import (
    WakeGrid,
    compute_late_share,
    find_missing_cyclictest,
    run_cyclictest,
)
from tests.machine import needs_fifo
from tests.tools.lab.benches import peers

GRID = WakeGrid(0, 1_000_000, 50, 80)
needs_cyclictest = pytest.mark.skipif(
    shutil.which("cyclictest") is None, reason="needs cyclictest (rt-tests)"
)


@needs_fifo
@needs_cyclictest
def test_every_wake_has_its_lateness() -> None:
    found = run_cyclictest(GRID)
    assert len(found) == GRID.wakes
    assert (found >= 0).all()


def test_wakes_beyond_the_histogram_count_as_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)))
    found = run_cyclictest(GRID)
    assert np.unique(found, return_counts=True)[1].tolist() == [47, 1, 2]
    assert found.max() == 150_000.0


def test_a_refusal_by_cyclictest_is_a_failure_with_its_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(peers.program(tmp_path, "cyclictest", peers.REFUSED)))
    with pytest.raises(Failure, match="cyclictest: Unable to change scheduling policy!"):
        run_cyclictest(GRID)


def test_cyclictest_is_absent_without_the_program_or_the_permission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    (absent,) = find_missing_cyclictest()
    assert "apt-get install rt-tests" in absent.message
    peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)
    monkeypatch.setattr("rack.tools.lab.benches.cyclictest.is_fifo_permitted", lambda: False)
    (absent,) = find_missing_cyclictest()
    assert "SCHED_FIFO is refused" in absent.message


def test_a_wake_is_late_at_each_grid_point_that_it_passed() -> None:
    period_ns = 1_000_000
    assert compute_late_share([np.array([0.0, 999.0])], period_ns) == 0.0
    # The second wake was 3.2 cycles late. It lost three points, two of which had no wake.
    assert compute_late_share([np.array([0.0, 3200.0])], period_ns) == 3 / 4
    assert compute_late_share([np.array([])], period_ns) == 0.0
    assert compute_late_share([], period_ns) is None
