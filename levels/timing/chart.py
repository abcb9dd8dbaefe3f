"""A Gantt chart as data, whether a schedule has made it or a run: who computed what, when, on which core."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rack.levels.timing.tasks import Unit


@dataclass(frozen=True)
class Span:
    """An uninterrupted stretch in which a task computed one unit function, ns; `release_ns` is its job's."""

    task: str
    core: int
    unit: Unit
    start_ns: int
    end_ns: int
    release_ns: int


@dataclass(frozen=True)
class Job:
    """What one release made a task compute. `end_ns` is None while it is not done; all times ns.

    A release that an executor skipped, because the next one had come, is a job that is never done.
    """

    task: str
    release_ns: int
    deadline_ns: int
    end_ns: int | None

    @property
    def is_late(self) -> bool:
        """Whether it ended behind its deadline; one that has not ended is judged by `Chart.late`."""
        return self.end_ns is not None and self.end_ns > self.deadline_ns


@dataclass(frozen=True)
class Chart:
    """Spans and jobs of a stretch of time from `start_ns` to `end_ns`, each in order of time."""

    start_ns: int
    end_ns: int
    spans: tuple[Span, ...]
    jobs: tuple[Job, ...]

    def late(self, task: str) -> list[Job]:
        """Return the jobs of a task that missed their deadline, those not done by it counted."""
        jobs = [job for job in self.jobs if job.task == task]
        return [job for job in jobs if job.is_late or (job.end_ns is None and job.deadline_ns <= self.end_ns)]

    def window(self, start_ns: int, end_ns: int) -> Chart:
        """Return the chart from `start_ns` to `end_ns`: spans are cut there; jobs are kept whole.

        A job belongs to it when it was released in it, or was not done, or not due, when it began.
        """
        spans = tuple(
            replace(span, start_ns=max(span.start_ns, start_ns), end_ns=min(span.end_ns, end_ns))
            for span in self.spans
            if span.start_ns < end_ns and span.end_ns > start_ns
        )
        jobs = tuple(j for j in self.jobs if j.release_ns < end_ns and max(j.deadline_ns, j.end_ns or 0) > start_ns)
        return Chart(start_ns, end_ns, spans, jobs)
