"""Measurements of the cores during a run: steal, and misses meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.trace import Flag
from rack.boards.config import load
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording import cores
from rack.tools.recording.cores import UNMEASURED, CoreMeter, CoreRecord, Stolen
from rack.tools.recording.recording import Recording
from rack.tools.report.report import build_report
from rack.tools.report.report_markdown import format_markdown
from tests.tools.conftest import Record
from tests.tools.recordings import MS, Cycle

HEAD = "cpu  9 9 9 9 9 9 9 99 0 0\n"
S = 1_000_000_000


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of two cores, as its file of counters in a folder."""
    monkeypatch.setattr(cores, "STAT", tmp_path / "stat")
    steal(tmp_path, 3, 7)
    return tmp_path


def steal(machine: Path, first: int, second: int) -> None:
    """Set the counters of both cores."""
    text = f"{HEAD}cpu0 1 1 1 1 1 1 1 {first} 0 0\ncpu1 1 1 1 1 1 1 1 {second} 0 0\nintr 5\n"
    (machine / "stat").write_text(text)


def test_a_rise_of_steal_is_recorded_with_its_core_and_time_span(machine: Path) -> None:
    found = CoreMeter()
    found.read_counters()
    assert found.build_record().stolen == ()
    steal(machine, 3, 9)
    found.read_counters()
    record = found.build_record()
    assert record.stolen is not None
    (stolen,) = record.stolen
    assert (stolen.core, stolen.ms) == (1, 20)
    assert stolen.from_ns < stolen.to_ns
    assert record.lasted_ns > 0


def run(record: Record, measured: CoreRecord) -> Recording:
    """Return a recording in real time with three misses and this record of the cores."""
    late = [Cycle(tick, (0.1, 0.1, 2.6, 0.1), flags=int(Flag.MISSED)) for tick in (10, 20, 30)]
    found = record({"lower": late}, "board.lower.core=1")
    found.cores = measured
    return found


def test_misses_during_steal_are_counted_by_core_and_time(record: Record) -> None:
    empty = run(record, UNMEASURED)
    period_ns, core = empty.layout.clock_ns, empty.layout.find_task("lower").core
    during = Stolen(20 * period_ns - MS, 20 * period_ns + MS, core, 10)
    elsewhere = Stolen(30 * period_ns - MS, 30 * period_ns + MS, core + 1, 30)
    report = build_report(run(record, CoreRecord(5 * S, (during, elsewhere))))
    first, second = str(core), str(core + 1)
    assert report["steal"] == {
        "measured": True,
        "ms": {first: 10, second: 30},
        "percent": {first: 0.2, second: 0.6},
    }
    assert (report["stalls"]["lost"], report["stalls"]["during_steal"]) == (3, 1)
    taken = f"core {core} for 0.20 %, core {core + 1} for 0.60 % of the run"
    line = f"- the hypervisor took {taken} (steal); 1 of 3 lost cycles were due at these times"
    assert line in format_markdown(report)


def test_a_report_mentions_only_what_happened(record: Record) -> None:
    quiet = build_report(run(record, CoreRecord(S, ())))
    assert quiet["steal"]["measured"]
    assert "hypervisor" not in format_markdown(quiet)
    unknown = build_report(run(record, UNMEASURED))
    assert not unknown["steal"]["measured"]


@pytest.mark.thorough
def test_a_recording_keeps_what_the_machine_did(
    small: Path, tmp_path: Path, rack_name: str
) -> None:
    config = load(small, [f"name={rack_name}", "clock.mode=realtime"])
    run_rack(config, 0.3, tmp_path / "run", Display())
    record = Recording(tmp_path / "run").cores
    assert record.lasted_ns >= 0.3 * S
    assert record.stolen is not None
    assert build_report(Recording(tmp_path / "run"))["steal"]["measured"]
