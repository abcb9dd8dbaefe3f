"""The bench of the clock: every way to wake is measured next to its peers, and who is missing is
named."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.config.schema import Wake
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches import clock
from rack.tools.lab.benches.clock import AWAKE, BARE, BOTH_WAYS, board, measure, suiting
from rack.tools.lab.benches.cyclictest import CYCLICTEST, WakeGrid
from rack.tools.lab.benches.harness import Sample
from rack.tools.lab.benches.observed import Runs
from tests.machine import needs_fifo
from tests.tools.lab.benches import peers

pytestmark = pytest.mark.thorough


@pytest.mark.slow
@needs_fifo
def test_boards_and_peers_are_measured_at_one_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure((400,), Runs(0.25, 1, True), Progress())
    assert found.cases == ["400 Hz"]
    measured = {sample.who: sample for sample in found.samples}
    named = {one.who for one in found.absent}
    both_ways = {who + ending for who in BOTH_WAYS for ending in ("", AWAKE)}
    # Where the request is refused, that is said at each rate.
    named = {who.partition(" at 400 Hz")[0] for who in named}
    assert {*measured} | named == {
        *(f"board, {wake}" for wake in get_args(Wake)),
        BARE,
        *both_ways,
    }
    assert 0 < measured["board, signal"].count <= 100
    assert min(measured["board, signal"].values) > 0.0
    assert measured[CYCLICTEST].median == 12.0
    ratio = found.ratio(measured["board, signal"])
    assert ratio == pytest.approx(measured["board, signal"].median / 12.0)
    assert all(path.stat().st_size for path in found.plot(tmp_path))


@pytest.mark.slow
def test_peers_that_the_machine_lacks_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure((1000,), Runs(0.1, 1, True), Progress())
    assert CYCLICTEST in {one.who for one in found.absent}
    lines = list(found.lines())
    assert any("apt-get install rt-tests" in line for line in lines)
    # Without its baseline a case has no ratios.
    assert all(found.ratio(sample) is None for sample in found.samples)


def test_a_peer_that_fails_is_named_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(grid: WakeGrid) -> np.ndarray:
        raise Failure("cyclictest: Unable to change scheduling policy!")

    monkeypatch.setattr(clock, "_contestants", lambda share: ({CYCLICTEST: fail}, []))
    found = measure((50,), Runs(0.1, 2), Progress())
    assert found.samples == ()
    (absent,) = found.absent
    assert (
        absent.line
        == "absent: cyclictest at 50 Hz, 2 of 2 rounds: cyclictest: Unable to change scheduling"
        " policy!"
    )


@pytest.mark.slow
def test_a_machine_without_real_time_says_so_and_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "permits_fifo", lambda: False)
    monkeypatch.setattr(clock, "_contestants", lambda share: ({BARE: clock.sleep_loop}, []))
    found = measure((1000,), Runs(0.05, 1), Progress())
    assert "SCHED_FIFO is refused" in found.title
    assert found.samples[0].count > 0


@pytest.mark.slow
def test_the_start_of_a_run_is_left_out() -> None:
    grid = WakeGrid((0,), 2_500_000, 40, 80)
    assert 0 < len(board("signal", True, grid)) <= grid.wakes


def wakes(who: str, case: str, *late_us: float) -> Sample:
    return Sample(case, who, late_us, "us")


@pytest.mark.parametrize(
    ("asleep", "awake", "suits"),
    [
        # Ten lost cycles at 400 Hz outweigh every lateness within one, also a worse one.
        ((60.0,) * 11 + (2400.0,), (20.0, 20.0) + (2500.0,) * 10, "sleep"),
        ((9000.0,) * 10 + (60.0, 60.0), (20.0,) * 11 + (9001.0,), "awake"),
        # One more may be chance: then the worst wake-up decides, never the median.
        ((60.0,) * 11 + (900.0,), (20.0,) * 11 + (2500.0,), "sleep"),
        ((60.0,) * 11 + (900.0,), (20.0,) * 11 + (300.0,), "awake"),
        ((20.0,) * 11 + (900.0,), (60.0,) * 11 + (300.0,), "awake"),
    ],
)
def test_the_setting_with_fewer_lost_cycles_suits_then_the_one_with_the_better_worst_wake_up(
    asleep: tuple[float, ...], awake: tuple[float, ...], suits: str
) -> None:
    board_and_peer = [
        wakes(BOTH_WAYS[0], "400 Hz", *asleep),
        wakes(BOTH_WAYS[0] + AWAKE, "400 Hz", *awake),
    ]
    board_and_peer += [wakes(who, "50 Hz", 10.0) for who in (CYCLICTEST, CYCLICTEST + AWAKE)]
    # Others, however late, decide nothing.
    others = [wakes(BARE, "400 Hz", 50_000.0), wakes("board, signal", "400 Hz", 50_000.0)]
    line = suiting([*board_and_peer, *others])
    assert line.startswith(f'clock.idle_cores that suits this machine: "{suits}", ')
    figures = {part[1:6].strip('",'): part for part in line.partition(": ")[2].split("; with ")}
    assert (
        f"{sum(us >= 2500.0 for us in asleep)} of 13 wake-ups late by a period" in figures["sleep"]
    )
    assert (
        f"{sum(us >= 2500.0 for us in awake)} of 13 wake-ups late by a period" in figures["awake"]
    )
    assert f"worst {max(awake):.0f} us" in figures["awake"]
    assert suiting([*board_and_peer[::2], *others]) == ""


def test_a_peer_is_measured_while_the_bench_holds_idle_cores_awake_and_only_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device, held = tmp_path / "cpu_dma_latency", []
    device.touch()
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", device)

    def look(grid: WakeGrid) -> np.ndarray:
        held.append(
            device
            in [one.readlink() for one in Path("/proc/self/fd").iterdir() if one.is_symlink()]
        )
        return np.array([10.0])

    monkeypatch.setattr(
        clock,
        "_contestants",
        lambda share: ({"board, timer": look, f"board, timer{AWAKE}": look}, []),
    )
    found = measure((50,), Runs(0.1, 2), Progress())
    assert sorted(held) == [False, False, True, True]
    assert found.document()["conclusion"] == found.conclusion == list(found.lines())[-1] != ""


def test_a_machine_that_refuses_to_hold_idle_cores_awake_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", tmp_path / "missing")
    calm = {"board, timer": lambda grid: np.array([10.0])}
    monkeypatch.setattr(
        clock,
        "_contestants",
        lambda share: ({**calm, f"board, timer{AWAKE}": calm["board, timer"]}, []),
    )
    found = measure((50,), Runs(0.1, 1), Progress())
    (absent,) = found.absent
    assert absent.who.startswith(f"board, timer{AWAKE}")
    assert "missing cannot be opened" in absent.reason
    assert found.conclusion == ""


def test_a_board_that_overslept_grid_points_is_late_from_the_first_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Overslept:
        def settled(self, task: str) -> np.ndarray:
            rows = np.zeros(2, RECORD)
            rows["start_ns"] = 100_000
            rows["flags"][1] = Flag.SKIPPED | 2 << SKIPPED_SHIFT
            return rows

    monkeypatch.setattr(clock, "observe", lambda config, seconds, share: Overslept())
    assert board("timer", True, WakeGrid((0,), 2_500_000, 40, 80)).tolist() == [100.0, 5100.0]
