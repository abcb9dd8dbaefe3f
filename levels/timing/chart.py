"""A Gantt chart as data, whether a schedule has made it or a run: who computed what, when, on which core."""

from __future__ import annotations

from dataclasses import dataclass

from levels.timing.tasks import Unit


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
    """What one release made a task compute. `end_ns` is None while it is not done; all times ns."""

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
