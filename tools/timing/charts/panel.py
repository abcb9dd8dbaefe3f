"""Panel of a Gantt chart, with the lanes, late jobs and patterns of a schedule or of a run.

It also has functions for sets of stretches.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rack.boards.timing.schedule import Chart, Job, Span
from rack.tools.console.answer import Document
from rack.tools.timing.charts.patterns import Lane, Patterns, Stretch

NS_PER_MS = 1_000_000


@dataclass(frozen=True)
class JobCount:
    """Numbers of jobs, late jobs and skipped jobs of a task.

    A skipped job never began. It also counts as late.
    """

    jobs: int = 0
    late: int = 0
    skipped: int = 0

    @classmethod
    def count_jobs(cls, chart: Chart, task: str, start_ns: int, end_ns: int) -> JobCount:
        """Count the jobs that were released from `start_ns` up to `end_ns`.

        Args:
            chart: Chart that contains the jobs.
            task: Task to count.
            start_ns: Start of the interval, ns.
            end_ns: End of the interval, ns, not included.
        """
        releases = [job.release_ns for job in chart.jobs if job.task == task]
        late = [job for job in chart.list_late_jobs(task) if start_ns <= job.release_ns < end_ns]
        # The newest job may still be running and does not count as skipped.
        skipped = sum(job.end_ns is None and job.release_ns < releases[-1] for job in late)
        return cls(sum(start_ns <= release < end_ns for release in releases), len(late), skipped)

    def __add__(self, other: JobCount) -> JobCount:
        return JobCount(
            self.jobs + other.jobs, self.late + other.late, self.skipped + other.skipped
        )


@dataclass(frozen=True)
class Panel:
    """A chart cut to a window of time, with its lanes.

    Attributes:
        kind: "schedule" or "measured".
        chart: Spans and jobs in the window.
        lanes: Rows of the chart.
        patterns: Dictionary from lane names to patterns. They are counted over the whole run or, in
            a schedule, over several slices of the slowest task.
        counts: Dictionary from task names to numbers of jobs, counted over the same time.
        frame_ns: Minor frame of a static schedule, ns. 0 if there is none.
    """

    kind: Literal["schedule", "measured"]
    chart: Chart
    lanes: tuple[Lane, ...]
    patterns: Mapping[str, Patterns]
    counts: Mapping[str, JobCount]
    frame_ns: int = 0

    @property
    def frames(self) -> dict[int, int]:
        """Dictionary from the numbers of minor frames that begin in the window to their starts.

        Frames are numbered from the start of the run. Starts are in ns.
        """
        if not self.frame_ns:
            return {}
        numbers = range(
            -(-self.chart.start_ns // self.frame_ns), -(-self.chart.end_ns // self.frame_ns)
        )
        return {number: number * self.frame_ns for number in numbers}

    def list_late_jobs(self, lane: Lane) -> list[Job]:
        """Return the jobs of a lane that were late in the window, sorted by deadline."""
        late_jobs = [job for task in lane.tasks for job in self.chart.list_late_jobs(task)]
        return sorted(
            (job for job in late_jobs if job.deadline_ns <= self.chart.end_ns),
            key=lambda job: job.deadline_ns,
        )

    def to_document(self) -> Document:
        """Convert the panel to plain data, with times in ms."""
        late = {job for lane in self.lanes for job in self.list_late_jobs(lane)}
        return {
            "kind": self.kind,
            "from_ms": self.chart.start_ns / NS_PER_MS,
            "to_ms": self.chart.end_ns / NS_PER_MS,
            "frame_ms": self.frame_ns / NS_PER_MS or None,
            "lanes": [{"tasks": list(lane.tasks), **_convert_to_ms(lane)} for lane in self.lanes],
            "spans": [_convert_to_ms(span) for span in self.chart.spans],
            "jobs": [{**_convert_to_ms(job), "late": job in late} for job in self.chart.jobs],
            "patterns": {
                lane: {kind: dict(counts.most_common()) for kind, counts in found._asdict().items()}
                for lane, found in self.patterns.items()
            },
            "counts": {task: vars(count) for task, count in self.counts.items()},
        }


def _convert_to_ms(entry: Span | Job | Lane) -> Document:
    """Return the fields of an entry. Times are in ms, and their keys end in "_ms"."""
    return {
        name.replace("_ns", "_ms"): value / NS_PER_MS
        if name[-3:] == "_ns" and value is not None
        else value
        for name, value in vars(entry).items()
    }


def subtract_stretches(stretch: Stretch, busy: Sequence[Stretch]) -> Iterator[Stretch]:
    """Yield the parts of a stretch that are not in `busy`, which is sorted and without overlaps."""
    start, end = stretch
    for index in range(bisect_right(busy, start, key=lambda entry: entry[1]), len(busy)):
        if busy[index][0] >= end:
            break
        if busy[index][0] > start:
            yield start, busy[index][0]
        start = busy[index][1]
    if start < end:
        yield start, end


def merge_stretches(stretches: Iterable[Stretch]) -> list[Stretch]:
    """Return the union of the stretches, sorted and without overlaps."""
    merged: list[Stretch] = []
    for start, end in sorted(stretches):
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(merged[-1][1], end)
        else:
            merged.append((start, end))
    return merged
