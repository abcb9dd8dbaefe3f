"""The bench of the clock: every way to wake is measured next to its peers, and who is missing is named."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from rack.boards.config.schema import Wake
from rack.tools.benches import clock
from rack.tools.benches.clock import BARE, board, measure
from rack.tools.benches.cyclictest import CYCLICTEST, WakeGrid
from rack.tools.benches.linuxcnc import LINUXCNC
from rack.tools.benches.observed import Runs
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from tests.machine import needs_fifo
from tests.tools.benches import peers


@needs_fifo
def test_boards_and_peers_are_measured_at_one_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)
    peers.program(tmp_path, "halrun", peers.HALRUN)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure((400,), Runs(0.25, 1, True), Progress())
    assert found.cases == ["400 Hz"]
    measured = {sample.who: sample for sample in found.samples}
    named = {one.who for one in found.absent}
    assert {*measured} | named == {*(f"board, {wake}" for wake in get_args(Wake)), BARE, CYCLICTEST, LINUXCNC}
    assert 0 < measured["board, signal"].count <= 100
    assert min(measured["board, signal"].values) > 0.0
    assert measured[CYCLICTEST].median == 12.0
    ratio = found.ratio(measured["board, signal"])
    assert ratio == pytest.approx(measured["board, signal"].median / 12.0)
    assert all(path.stat().st_size for path in found.plot(tmp_path))


def test_peers_that_the_machine_lacks_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure((1000,), Runs(0.1, 1, True), Progress())
    assert {CYCLICTEST, LINUXCNC} <= {one.who for one in found.absent}
    lines = list(found.lines())
    assert any("apt-get install rt-tests" in line for line in lines)
    assert any("apt-get install linuxcnc-uspace" in line for line in lines)
    # Without its baseline a case has no ratios.
    assert all(found.ratio(sample) is None for sample in found.samples)


def test_a_peer_that_fails_is_named_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(grid: WakeGrid) -> np.ndarray:
        raise Failure("cyclictest: Unable to change scheduling policy!")

    monkeypatch.setattr(clock, "_contestants", lambda share: ({CYCLICTEST: fail}, []))
    found = measure((50,), Runs(0.1, 2), Progress())
    assert found.samples == ()
    (absent,) = found.absent
    assert absent.line == "absent: cyclictest at 50 Hz, 2 of 2 rounds: cyclictest: Unable to change scheduling policy!"


def test_a_machine_without_real_time_says_so_and_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "permits_fifo", lambda: False)
    monkeypatch.setattr(clock, "_contestants", lambda share: ({BARE: clock.sleep_loop}, []))
    found = measure((1000,), Runs(0.05, 1), Progress())
    assert "SCHED_FIFO is refused" in found.title
    assert found.samples[0].count > 0


def test_the_start_of_a_run_is_left_out() -> None:
    grid = WakeGrid((0,), 2_500_000, 40, 80)
    assert 0 < len(board("signal", True, grid)) <= grid.wakes
