"""The bench of rates: a rack at another rate, and which rates it holds beyond what the machine
breaks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import load, loads, wire
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import Absent
from rack.tools.lab.benches.observed import Runs
from rack.tools.lab.benches.rate import RATES_HZ, STEP_MS, RateFigures, Rates, at_rate, measure
from tests.boards.conftest import PLAIN
from tests.tools.command_line import rack
from tests.tools.lab.benches import peers

HELD = RateFigures(400.0, 6000, 0.0012, 0.0005, None, 500.0, "")
RATES = Rates("nasrem", "servo", 1, (HELD, replace(HELD, rate_hz=1000.0, missed=0.0016)), ())


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_only_the_servo_level_changes_its_rate(rate_hz: int) -> None:
    config = load("nasrem")
    found = at_rate(config, rate_hz)
    tasks = {task.name: task for task in wire(found).tasks}
    assert tasks["servo"].every == 1
    assert found.clock.period_ms == pytest.approx(1000 / rate_hz)
    # Of the rates, 1250 Hz alone is no multiple of 4 Hz.
    for name in config.board:
        before = config.every(name) * config.clock.period_ms
        assert name == "servo" or found.every(name) * found.clock.period_ms == pytest.approx(
            before, rel=0.002
        )
    assert tasks["servo.planner"].within_cycles * found.clock.period_ms == pytest.approx(20.0)
    assert found.robot is not None
    step_ms = found.clock.period_ms / found.robot.substeps
    assert STEP_MS / 2 < step_ms <= STEP_MS * 1.000001


def test_a_rack_without_a_board_at_every_tick_is_refused() -> None:
    config = loads(PLAIN.replace("rate_hz = 400", "rate_hz = 200"))
    with pytest.raises(Failure, match="no board cycles at every tick"):
        at_rate(config, 1000)


def test_a_rate_is_held_up_to_its_bound_beyond_cyclictest() -> None:
    assert HELD.held
    assert not replace(HELD, missed=0.0016).held
    # What the machine breaks does not count; without cyclictest everything does.
    assert replace(HELD, missed=0.02, late=0.0195).held
    assert not replace(HELD, late=None).held
    assert replace(HELD, failure="board lost: servo").verdict == "board lost: servo"
    assert RATES.highest_held_hz == 400.0
    assert "highest rate held: 400 Hz" in list(RATES.lines())[-1]
    assert replace(RATES, rates=RATES.rates[1:]).highest_held_hz is None


@pytest.mark.slow
def test_a_rack_is_run_at_every_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "waves.toml"
    path.write_text(PLAIN)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure(str(path), (800, 400), Runs(0.8, 1, True), Progress())
    assert [one.rate_hz for one in found.rates] == [400, 800]
    assert found.board == "wave"
    for one in found.rates:
        assert 0 < one.cycles <= 0.8 * one.rate_hz
        assert (one.late, one.failure) == (None, "")
        assert one.processor_us > 0
    assert isinstance(found.absent[0], Absent)
    assert any("rt-tests" in line for line in found.lines())
    assert found.document()["absent"]
    assert all(picture.stat().st_size for picture in found.plot(tmp_path))


@pytest.mark.slow
def test_late_wakes_of_cyclictest_are_a_share_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "waves.toml"
    path.write_text(PLAIN)
    monkeypatch.setenv("PATH", str(peers.program(tmp_path, "cyclictest", peers.CYCLICTEST)))
    monkeypatch.setattr("rack.tools.lab.benches.cyclictest.permits_fifo", lambda: True)
    (one,) = measure(str(path), (400,), Runs(0.3, 2, True), Progress()).rates
    # Of 120 wakes two rounds have two at 2.5 ms and four at 150 ms: 1 and 60 points of this grid.
    assert one.late == pytest.approx((2 * 1 + 4 * 60) / (2 * 120 + 4 * 59))


@pytest.mark.slow
def test_the_command_prints_one_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "waves.toml"
    path.write_text(PLAIN)
    monkeypatch.setenv("PATH", str(tmp_path))
    options = ("--rate", 400, "--seconds", 0.2, "--rounds", 1, "--share", "--plot", tmp_path)
    done = rack("bench", "rate", "--config", path, *options, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert [one["rate_hz"] for one in found["rates"]] == [400]
    assert (tmp_path / "rate.png").is_file()
