"""Simulated schedule of tasks under their schedulers, as data for Gantt charts.

The schedule follows the rules of the rack (backplane/clock/wake.py, boards/run/control_loop.py). A
late task takes the newest release and skips the others. The next release of a planner comes after
the time slice of its plan.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

from rack.boards.timing.tasks import TURN_NS, Part, TimedTask, Unit, Urgency, compute_urgency


@dataclass(frozen=True)
class Span:
    """Uninterrupted interval in which a task runs one unit function.

    Attributes:
        task: Name of the task.
        core: Its core.
        unit: The unit function.
        start_ns: Start of the interval.
        end_ns: End of the interval.
        release_ns: Release of the job.
    """

    task: str
    core: int
    unit: Unit
    start_ns: int
    end_ns: int
    release_ns: int


@dataclass(frozen=True)
class Job:
    """Work of one release. If a late executor skips the release, the job never ends.

    Attributes:
        task: Name of the task.
        release_ns: Time of the release.
        deadline_ns: Time of the deadline.
        end_ns: Time of the end. None if the job is unfinished.
    """

    task: str
    release_ns: int
    deadline_ns: int
    end_ns: int | None


@dataclass(frozen=True)
class Chart:
    """Schedule between two times, with spans and jobs sorted by time."""

    start_ns: int
    end_ns: int
    spans: tuple[Span, ...]
    jobs: tuple[Job, ...]

    def list_late_jobs(self, task: str) -> list[Job]:
        """Return the jobs of a task, finished or not, that missed their deadlines."""
        # An unfinished job has also missed a deadline that coincides with the end of the chart.
        unfinished = self.end_ns + 1
        return [
            job
            for job in self.jobs
            if job.task == task
            and job.deadline_ns < (unfinished if job.end_ns is None else job.end_ns)
        ]

    def cut_window(self, start_ns: int, end_ns: int) -> Chart:
        """Return the part of the chart between two times.

        Spans are cut at both times. Jobs are kept whole: those released in the window, and earlier
        ones that are unfinished or not yet due at its start.
        """
        spans = tuple(
            replace(span, start_ns=max(span.start_ns, start_ns), end_ns=min(span.end_ns, end_ns))
            for span in self.spans
            if span.start_ns < end_ns and span.end_ns > start_ns
        )
        jobs = tuple(
            j
            for j in self.jobs
            if j.release_ns < end_ns and max(j.deadline_ns, j.end_ns or 0) > start_ns
        )
        return Chart(start_ns, end_ns, spans, jobs)


def simulate_schedule(
    tasks: Sequence[TimedTask],
    until_ns: int,
    context_switch_ns: int = 0,
    tick_ns: int | None = None,
) -> Chart:
    """Compute the schedule of tasks from time 0.

    A job has two context switches, one before its parts and one after them, which appear as idle
    time. Among tasks of equal priority, the one that has waited longest runs first. Under ordinary
    scheduling (priority 0) they take turns of `TURN_NS`.

    Args:
        tasks: The tasks, on any cores. Each is first released at its phase.
        until_ns: End of the schedule.
        context_switch_ns: Time of one context switch.
        tick_ns: Length of a tick. Maximum urgency first compares jobs again in each tick, besides
            releases and ends. None if it does not.
    """
    runners = [_TaskSimulation(task, context_switch_ns) for task in tasks]
    for core in {task.core for task in tasks}:
        of_core = [runner for runner in runners if runner.task.core == core]
        step_ns = tick_ns or until_ns
        for start_ns in range(0, until_ns, step_ns):
            for _ in simulate_core(of_core, start_ns, min(start_ns + step_ns, until_ns)):
                pass
    spans = sorted(
        (s for r in runners for s in r.spans), key=lambda span: (span.start_ns, span.core)
    )
    jobs = sorted(
        (j for r in runners for j in r.list_jobs(until_ns)),
        key=lambda job: (job.release_ns, job.task),
    )
    return Chart(0, until_ns, tuple(spans), tuple(jobs))


class CoreTask(Protocol):
    """A task or job that competes for a core."""

    @property
    def ready_at(self) -> int:
        """Time in ns from which it can run."""

    def get_urgency(self, now_ns: int) -> Urgency:
        """Return its urgency at a time."""

    def run_step(self, now_ns: int, until_ns: int) -> int:
        """Run it until a part of it or the time is over, and return the end in ns."""


AnyCoreTask = TypeVar("AnyCoreTask", bound=CoreTask)


def simulate_core(
    tasks: Sequence[AnyCoreTask], start_ns: int, until_ns: int
) -> Iterator[tuple[int, AnyCoreTask]]:
    """Simulate one core. At each release and end of a part, choose the task to run.

    Args:
        tasks: The tasks of the core.
        start_ns: Start of the simulation.
        until_ns: End of the simulation.

    Yields:
        The end of each step in ns, and the task that ran.
    """
    now = start_ns
    while now < until_ns:
        ready = [task for task in tasks if task.ready_at <= now]
        next_release = min((t.ready_at for t in tasks if t.ready_at > now), default=until_ns)
        if not ready:
            now = next_release
            continue
        first = min(ready, key=lambda task: task.get_urgency(now))
        now = first.run_step(now, min(next_release, until_ns))
        yield now, first


class _TaskSimulation:
    """Simulation of one task.

    Attributes:
        task: The task.
        spans: Spans of the task that have been simulated.
        ready_at: Time in ns from which the task's present job, or else its next job, can run.
    """

    def __init__(self, task: TimedTask, context_switch_ns: int) -> None:
        self.task = task
        self.spans: list[Span] = []
        self.ready_at = task.phase_ns
        # Time at which the task joined the queue of its priority. A late task does not leave the
        # queue, so it keeps its place. Under ordinary scheduling, the task also has the rest of its
        # turn.
        self._queued_at = task.phase_ns
        self._turn_ns = TURN_NS
        self._switch = Part(None, context_switch_ns)
        # Remaining steps of the job, and the time already spent on the first of them.
        self._steps: list[Part] = []
        self._spent_ns = 0
        self._release = -1
        # Largest age in ns of a release that the next job may take. The first job takes the newest.
        self._slack_ns = 0
        self._ends: dict[int, int | None] = {}

    def get_urgency(self, now_ns: int) -> Urgency:
        """Return the key by which ready tasks are sorted. The task with the smallest key runs."""
        is_locked = self._spent_ns > 0 and not self._steps[0].preemptible
        priority = max(self.task.priority, self.task.ceiling) if is_locked else self.task.priority
        release = self._release if self._steps else self._find_release(now_ns)
        deadline_ns = release + self.task.period_ns
        left_ns = sum(step.time_ns for step in self._steps or self.task.parts) - self._spent_ns
        urgency = compute_urgency(
            self.task.scheduler,
            priority,
            deadline_ns,
            deadline_ns - now_ns - left_ns,
            is_critical=self.task.is_critical,
        )
        # Once begun, a part that is not preemptible precedes other tasks of equal priority.
        return *urgency, not is_locked, self._queued_at, self.task.name

    def run_step(self, now_ns: int, until_ns: int) -> int:
        """Run the task from `now_ns` to the end of a part or `until_ns`, and return that time."""
        if not self._steps:
            self._begin_job(now_ns)
        if not self._steps:
            self._end_job(now_ns)
            return now_ns
        step = self._steps[0]
        end = min(now_ns + step.time_ns - self._spent_ns, until_ns)
        if not self.task.priority:
            end = min(end, now_ns + self._turn_ns)
            self._turn_ns -= end - now_ns
            if not self._turn_ns:
                self._queued_at, self._turn_ns = end, TURN_NS
        if step.unit is not None:
            last = self.spans[-1] if self.spans else None
            if last is not None and (last.unit, last.end_ns, last.release_ns) == (
                step.unit,
                now_ns,
                self._release,
            ):
                self.spans[-1] = replace(last, end_ns=end)
            else:
                self.spans.append(
                    Span(self.task.name, self.task.core, step.unit, now_ns, end, self._release)
                )
        self._spent_ns += end - now_ns
        if self._spent_ns == step.time_ns:
            self._spent_ns = 0
            del self._steps[0]
            if not any(left.unit for left in self._steps):
                self._ends.setdefault(self._release, end)
            if not self._steps:
                self._end_job(end)
        return end

    def _begin_job(self, now_ns: int) -> None:
        """Begin the job of the oldest release that has not expired.

        Executors skip the releases that have expired.
        """
        every = self.task.every_ns
        self._release = self._find_release(now_ns)
        if self.task.role != "planner":
            self._ends |= dict.fromkeys(range(self.ready_at, self._release, every))
        self._slack_ns = self.task.period_ns - every
        steps = [self._switch, *self.task.parts, self._switch]
        self._steps = [step for step in steps if step.time_ns]

    def _find_release(self, now_ns: int) -> int:
        """Return the release that a job takes which begins at a time."""
        newest = now_ns - (now_ns - self.task.phase_ns) % self.task.every_ns
        return max(self.ready_at, newest - self._slack_ns)

    def _end_job(self, now_ns: int) -> None:
        """Record the end of the present job and determine the release of the next one."""
        self._ends.setdefault(self._release, now_ns)
        self.ready_at = self._release + self.task.period_ns
        if self.ready_at > now_ns:
            self._queued_at, self._turn_ns = self.ready_at, TURN_NS

    def list_jobs(self, until_ns: int) -> Iterator[Job]:
        """Yield the jobs released before `until_ns`. Call this when the schedule is complete."""
        if not self._steps and self.ready_at < until_ns:
            self._begin_job(until_ns - 1)
        if self._release not in self._ends and self._release >= 0:
            self._ends[self._release] = None
        for release, end in self._ends.items():
            yield Job(self.task.name, release, release + self.task.deadline_ns, end)
