"""Charts: what was late, and what a window shows."""

from __future__ import annotations

from rack.levels.timing.chart import Chart, Job, Span
from rack.levels.timing.tasks import Unit

SPANS = (
    Span("a", 0, Unit.PROCESS, 0, 10, 0),
    Span("a", 0, Unit.WRITE, 10, 14, 0),
    Span("a", 0, Unit.PROCESS, 20, 26, 20),
)
JOBS = (Job("a", 0, 20, 14), Job("a", 20, 40, 45), Job("b", 0, 30, None), Job("b", 40, 70, None))
CHART = Chart(0, 60, SPANS, JOBS)


def test_a_job_is_late_when_it_ended_behind_its_deadline_or_did_not_end_by_then() -> None:
    assert CHART.late("a") == [JOBS[1]]
    # The second one still has time when the chart ends.
    assert CHART.late("b") == [JOBS[2]]


def test_a_window_cuts_spans_and_leaves_out_what_lies_outside() -> None:
    window = CHART.window(4, 12)
    assert [(span.unit, span.start_ns, span.end_ns) for span in window.spans] == [("X", 4, 10), ("W", 10, 12)]
    assert (window.start_ns, window.end_ns) == (4, 12)


def test_a_window_keeps_the_jobs_that_it_has_to_do_with_whole() -> None:
    assert CHART.window(42, 50).jobs == (JOBS[1], JOBS[3])
    assert CHART.window(20, 25).jobs == (JOBS[1], JOBS[2])


def test_a_job_that_is_not_due_within_the_window_is_not_late_in_it() -> None:
    assert CHART.window(0, 25).late("b") == []
    assert CHART.window(0, 30).late("b") == [JOBS[2]]
