"""Steal: what the hypervisor took, and which misses came meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.trace import Flag
from rack.boards.config import load
from rack.tools.analysis.report import report_of
from rack.tools.analysis.report_markdown import markdown
from rack.tools.recorder import steal as meter
from rack.tools.recorder.steal import Stolen
from tests.tools.recordings import MS, Cycle, recorded

HEAD = "cpu  9 9 9 9 9 9 9 99 0 0\n"


def test_a_rise_is_found_with_its_core_and_the_looks_around_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stat = tmp_path / "stat"
    monkeypatch.setattr(meter, "STAT", stat)

    def counts(first: int, second: int) -> None:
        stat.write_text(f"{HEAD}cpu0 1 1 1 1 1 1 1 {first} 0 0\ncpu1 1 1 1 1 1 1 1 {second} 0 0\nintr 5\n")

    counts(3, 7)
    found = meter.StealMeter()
    found.look()
    assert found.stolen == []
    counts(3, 9)
    found.look()
    (stolen,) = found.stolen
    assert (stolen.core, stolen.ms) == (1, 20)
    assert stolen.from_ns < stolen.to_ns


def test_misses_are_told_apart_by_core_and_time(small: Path, tmp_path: Path) -> None:
    config = load(small, ["clock.mode=realtime", "board.lower.core=1"])
    late = [Cycle(tick, (0.1, 0.1, 2.6, 0.1), flags=int(Flag.MISSED)) for tick in (10, 20, 30)]
    recording = recorded(tmp_path / "run", config, {"lower": late})
    period_ns = config.clock_ns
    core = recording.layout.task("lower").core
    during = Stolen(20 * period_ns - MS, 20 * period_ns + MS, core, 10)
    elsewhere = Stolen(30 * period_ns - MS, 30 * period_ns + MS, core + 1, 30)
    recording.stolen = [during, elsewhere]
    report = report_of(recording)
    assert report["steal"] == {"ms": {str(core): 10, str(core + 1): 30}, "missed": 3, "missed_during": 1}
    assert "1 of 3 misses while the hypervisor had the core" in markdown(report)
