"""Causes of lost cycles: steal, and absences without steal. None enters a budget."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config.layout import find_core
from rack.tools.recording.cores import CoreRecord, Stolen
from rack.tools.recording.cycles import measure_budgets, read_cycles
from rack.tools.recording.recording import Recording
from rack.tools.recording.stalls import Absence, Stalls, analyze_stalls
from rack.tools.report.analysis import Analysis
from rack.tools.report.report import build_report
from rack.tools.report.report_markdown import format_markdown
from rack.tools.report.tables import build_document
from tests.tools.analysis_text import text
from tests.tools.conftest import Record
from tests.tools.recordings import MS, Cycle, Traces

MISSED, PLANNED = int(Flag.MISSED), int(Flag.PLANNED)
TICK_MS = 2.5
PLAIN = (0.0, 0.1, 1.0, 0.1)
SETTLED = 40
FIRST = find_core(0)
"""The clock's core."""
OTHER = FIRST + 1
"""The core of the lower level and of its planner, whatever cores this machine has."""


def skipping(count: int) -> int:
    """Return the flags of a cycle before which `count` releases were skipped."""
    return count << SKIPPED_SHIFT | int(Flag.SKIPPED)


def plain_cycles(first: int, last: int) -> list[Cycle]:
    return [Cycle(tick, PLAIN) for tick in range(first, last)]


def late_clock(tick: int, since: int, late_ms: float) -> dict[str, Any]:
    """Return the event of a clock board that was due at tick `since` and woke `late_ms` later."""
    about = {"kind": "miss", "board": "clock", "code": "clock_late", "text": "", "time_ns": 0}
    return about | {"tick": tick, "since": since, "value": late_ms * MS}


def run(
    record: Record, traces: Traces, *events: dict[str, Any], priority: int = 80, settings: str = ""
) -> Recording:
    """Return a recording whose lower level had a core of its own."""
    lost = {"missed": 0, "skipped": 0}
    places = {"upper": lost | {"core": FIRST, "priority": priority - 10 if priority else 0}}
    places |= {
        name: lost | {"core": OTHER, "priority": priority} for name in ("lower", "lower.planner")
    }
    outcome = {"kind": "outcome", "outcome": {}, "tasks": places}
    return record(traces, "clock.priority=90", *settings.split(), events=[*events, outcome])


def find_stalls(recording: Recording) -> Stalls:
    return analyze_stalls(recording)[0]


def test_skipped_cycles_are_attributed_to_steal_of_their_core(record: Record) -> None:
    skipped = [Cycle(20, PLAIN, flags=skipping(5)), Cycle(30, PLAIN, flags=skipping(2))]
    recording = run(record, {"lower": [*plain_cycles(8, 15), *skipped]})
    # Releases 15 to 19 were skipped. The next record begins at tick 20.
    for first, last, during in ((14.0, 14.8, 0), (15.2, 16.0, 5), (19.2, 19.8, 5), (20.2, 20.9, 0)):
        span = Stolen(int(first * TICK_MS * MS), int(last * TICK_MS * MS), OTHER, 10)
        recording.cores = CoreRecord(100 * MS, (span,))
        found = find_stalls(recording)
        assert (found.lost, found.during_steal) == (7, during)
    recording.cores = CoreRecord(100 * MS, (Stolen(0, 50 * MS, OTHER, 10),))
    line = f"took core {OTHER} for 10.00 % of the run (steal); 5 of 7 lost cycles were due at these"
    assert line in format_markdown(build_report(recording))


def absence_trace() -> dict[str, list[Cycle]]:
    """Return traces in which the other core was away from tick 50 until 1 ms after tick 52."""
    late = Cycle(52, PLAIN, late=1.0, flags=skipping(2))
    return {"lower": [*plain_cycles(SETTLED, 50), late, *plain_cycles(53, 60)]}


def test_an_absence_of_a_core_without_steal_is_reported(record: Record) -> None:
    recording = run(record, absence_trace())
    absence = Absence(OTHER, times=1, longest_ms=6.0, lost=2)
    assert find_stalls(recording).absences == [absence]
    report = build_report(recording)
    assert report["stalls"]["absences"] == [asdict(absence)]
    unstolen = "although no steal was counted (stalls: 1, longest 6 ms)"
    assert f"- core {OTHER} was away {unstolen}; 2 of 2 " in format_markdown(report)


def test_a_core_that_ran_another_task_was_not_absent(record: Record) -> None:
    # The planner ends its plan, at a higher priority, 0.2 ms before the executor gets the core.
    plan = Cycle(48, (0.0, 0.1, 10.6, 0.1), flags=PLANNED)
    recording = run(record, absence_trace() | {"lower.planner": [plan]})
    assert not find_stalls(recording).absences


def test_a_task_without_real_time_priority_shows_no_absence(record: Record) -> None:
    # The launch obtained no real-time priority.
    long = {"upper": [Cycle(48, (0.0, 0.1, 15.0, 0.1)), Cycle(88, PLAIN)]}
    late = late_clock(52, since=50, late_ms=5.9)
    refused = run(record, absence_trace() | long, late, priority=0)
    assert not find_stalls(refused).absences
    assert [cycles.stalled_count for cycles in read_cycles(refused).values()] == [0, 0]


def test_counted_steal_is_not_reported_as_an_absence_again(record: Record) -> None:
    recording = run(record, absence_trace())
    recording.cores = CoreRecord(200 * MS, (Stolen(120 * MS, 130 * MS, OTHER, 10),))
    assert (find_stalls(recording).during_steal, find_stalls(recording).absences) == (2, [])


def test_cycles_lost_to_a_late_clock_are_attributed_to_the_clocks_core(record: Record) -> None:
    recording = run(record, absence_trace(), late_clock(52, since=50, late_ms=5.9))
    assert find_stalls(recording).absences == [Absence(FIRST, times=1, longest_ms=5.9, lost=2)]


def test_lockstep_has_no_stalls(record: Record) -> None:
    long = {"lower.planner": [Cycle(SETTLED, (0.0, 0.1, 60.0, 0.1), flags=PLANNED)]}
    recording = run(record, absence_trace() | long, settings="clock.mode=lockstep")
    assert find_stalls(recording) == Stalls(2, 0, [])
    assert [cycles.stalled_count for cycles in read_cycles(recording).values()] == [0, 0]


def test_stalled_cycles_do_not_count_towards_a_budget(record: Record) -> None:
    long = [Cycle(50, (0.0, 0.1, 6.3, 0.1)), Cycle(53, PLAIN, flags=skipping(2))]
    trace = {"lower": [*plain_cycles(SETTLED, 50), *long, *plain_cycles(54, 60)]}
    computed = run(record, trace)
    assert measure_budgets(computed)["lower"].process_ns == round(6.3 * MS)
    assert read_cycles(computed)["lower"].stalled_count == 0
    stolen = run(record, trace)
    stolen.cores = CoreRecord(200 * MS, (Stolen(126 * MS, 130 * MS, OTHER, 10),))
    # The clock board was away at that time, so the whole machine may have been.
    away = run(record, trace, late_clock(52, since=51, late_ms=3.0))
    for recording in (stolen, away):
        assert measure_budgets(recording)["lower"].process_ns == MS
        analysis = Analysis.from_recording(recording)
        assert "stalled cycles are not judged: lower 1\n" in text(analysis)
        task = build_document(analysis)["tasks"]["lower"]
        left = len(trace["lower"]) - 1
        assert (task["cycles"], task["start_up"], task["stalled"]) == (left, 0, 1)
        # The report gives the times of all cycles.
        assert build_report(recording)["tasks"]["lower"]["execution_ms"]["max"] == 6.3
