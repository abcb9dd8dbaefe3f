"""The bench of the machine: a rack at other rates, the rates that it holds, and the verdict."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import RackConfig, load, load_text, resolve_layout
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches import machine
from rack.tools.lab.benches.cyclictest import CYCLICTEST
from rack.tools.lab.benches.harness import Sample
from rack.tools.lab.benches.machine import (
    AWAKE_SUFFIX,
    MAX_STEP_MS,
    RATES_HZ,
    MachineComparison,
    RateFigures,
    change_rate,
    compare_idle_cores,
    measure_machine,
)
from rack.tools.lab.benches.observed import ObservedRun, record_rack
from tests.boards.conftest import PLAIN
from tests.tools.lab.benches import peers

WHO = "'wave' of waves"
HELD = RateFigures(400.0, 6000, 0.0012, 0.0005)
MISSED = replace(HELD, rate_hz=1000.0, missed=0.0016)
SAMPLES = tuple(
    Sample("400 Hz", who, (us,), "us") for who, us in ((WHO, 182.0), (CYCLICTEST, 120.0))
)
FOUND = MachineComparison("machine", "", SAMPLES, {}, who=WHO, is_fifo=True, rates=(HELD, MISSED))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_only_the_servo_level_changes_its_rate(rate_hz: float) -> None:
    config = load("nasrem")
    found = change_rate(config, rate_hz)
    tasks = {task.name: task for task in resolve_layout(found).tasks}
    assert tasks["servo"].every == 1
    assert found.clock.period_ms == pytest.approx(1000 / rate_hz)
    for name in config.board:
        before_ms = config.find_period(name) * config.clock.period_ms
        after_ms = found.find_period(name) * found.clock.period_ms
        assert name == "servo" or after_ms == pytest.approx(before_ms, rel=0.002)
    assert tasks["servo.planner"].within_cycles * found.clock.period_ms == pytest.approx(20.0)
    assert found.robot is not None
    step_ms = found.clock.period_ms / found.robot.substeps
    assert MAX_STEP_MS / 2 < step_ms <= MAX_STEP_MS * 1.000001


def test_a_rack_without_a_board_at_every_tick_is_refused() -> None:
    config = load_text(PLAIN.replace("rate_hz = 400", "rate_hz = 200"))
    with pytest.raises(Failure, match="no board cycles at every tick"):
        change_rate(config, 1000)


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        (HELD, "held"),
        (MISSED, "not held: the rack is late"),
        # A late machine is not fit, regardless of the rack's missed cycles.
        (replace(HELD, missed=0.02, late=0.0195), "not held: the machine is late"),
        # Without cyclictest every miss counts.
        (replace(HELD, late=None), "not held: the rack is late"),
        (replace(HELD, failure="board lost: servo"), "not held: board lost: servo"),
    ],
)
def test_a_rate_is_held_up_to_its_bound(figures: RateFigures, verdict: str) -> None:
    assert (figures.verdict, not figures.reason) == (verdict, verdict == "held")


def test_the_verdict_comes_first_with_the_highest_rate_and_the_reason() -> None:
    lines = list(FOUND.format_blocks())
    assert lines[:3] == [
        "fit for real time up to 400 Hz",
        "400 Hz held; missed 0.12% of 6000 cycles, cyclictest late in 0.05%;"
        f" worst lateness: {WHO} 182 us, cyclictest 120 us",
        "1000 Hz not held: the rack is late; missed 0.16% of 6000 cycles, cyclictest late in"
        " 0.05%; worst lateness: unknown",
    ]
    assert FOUND.is_fit
    # A rate counts only if all below it are held.
    worse = replace(FOUND, rates=(replace(HELD, missed=0.02), replace(HELD, rate_hz=1000.0)))
    assert not worse.is_fit
    assert next(worse.format_blocks()) == "not fit for real time at 400 Hz or more"
    refused = replace(FOUND, is_fifo=False)
    assert not refused.is_fit
    assert next(refused.format_blocks()).startswith("not fit for real time: SCHED_FIFO is refused")
    document = json.loads(json.dumps(FOUND.to_document()))
    assert [document[name] for name in ("fit", "highest_hz", "fifo")] == [True, 400.0, True]
    assert [one["held"] for one in document["rates"]] == [True, False]


@pytest.mark.thorough
def test_the_rack_is_compared_with_cyclictest_and_with_idle_cores_awake(
    write: Callable[[str, str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waves = write("waves.toml", PLAIN)
    monkeypatch.setenv("PATH", str(tmp_path))
    peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)
    monkeypatch.setattr("rack.tools.lab.benches.cyclictest.is_fifo_permitted", lambda: True)
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", device)
    held = []

    def record_and_note_latency(
        config: RackConfig, seconds: float | None, folder: Path, share: bool = True
    ) -> ObservedRun:
        fds = [one.readlink() for one in Path("/proc/self/fd").iterdir() if one.is_symlink()]
        held.append(device in fds)
        return record_rack(config, seconds, folder, share)

    monkeypatch.setattr(machine, "record_rack", record_and_note_latency)
    found = measure_machine(str(waves), (400,), 0.3, 2, True, Progress())
    # Of 120 wakes two rounds have two at 2.5 ms and four at 150 ms: 1 and 60 points of this grid.
    assert found.rates[0].late == pytest.approx((2 * 1 + 4 * 60) / (2 * 120 + 4 * 59))
    assert {sample.who for sample in found.samples} == {
        found.who,
        found.who + AWAKE_SUFFIX,
        CYCLICTEST,
    }
    assert sorted(held) == [False, False, True, True]
    own = found.find_sample("400 Hz", found.who)
    assert own is not None
    assert found.compute_ratio(own) == pytest.approx(own.median / 12.0)
    assert list(found.format_blocks())[-1] == found.conclusion != ""


@pytest.mark.parametrize(
    ("asleep", "awake", "suits"),
    [
        # Ten lost cycles at 400 Hz outweigh every lateness within one, also a worse one.
        ((60.0,) * 11 + (2400.0,), (20.0, 20.0) + (2500.0,) * 10, "sleep"),
        ((9000.0,) * 10 + (60.0, 60.0), (20.0,) * 11 + (9001.0,), "awake"),
        # One more may be chance. The worst wake-up then decides, never the median.
        ((60.0,) * 11 + (900.0,), (20.0,) * 11 + (2500.0,), "sleep"),
        ((20.0,) * 11 + (900.0,), (60.0,) * 11 + (300.0,), "awake"),
    ],
)
def test_idle_cores_are_chosen_by_lost_cycles_then_by_the_worst_wake_up(
    asleep: tuple[float, ...], awake: tuple[float, ...], suits: str
) -> None:
    own = [
        Sample("400 Hz", WHO, asleep, "us"),
        Sample("400 Hz", WHO + AWAKE_SUFFIX, awake, "us"),
        # The lateness of cyclictest has no effect.
        Sample("400 Hz", CYCLICTEST, (50_000.0,), "us"),
    ]
    line = compare_idle_cores(own, WHO)
    assert line.startswith(f'clock.idle_cores that suits this machine: "{suits}", ')
    for times_us in (asleep, awake):
        assert f"{sum(us >= 2500.0 for us in times_us)} wake-ups late by a period" in line
        assert f"worst {max(times_us):.0f} us" in line
    assert compare_idle_cores(own[::2], WHO) == ""
