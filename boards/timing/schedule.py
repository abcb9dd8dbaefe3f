"""Gantt charts as data, and the schedule of tasks under fixed priorities, computed instead of run.

The schedule follows the rack's own rules (backplane/clock/wake.py, boards/run/control_loop.py): a
late task takes up the newest release and skips the others; a planner's release lasts as long as the
time slice of its plan, and the next release comes after that slice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from rack.boards.timing.tasks import Part, TimedTask, Unit

Variants = Mapping[str, Sequence[Sequence[Part]]]
"""Parts of tasks that differ from cycle to cycle, by task: one sequence per cycle, in turn."""


@dataclass(frozen=True)
class Span:
    """An uninterrupted stretch in which a task computed one unit function, ns; `release_ns` is its
    job's.
    """

    task: str
    core: int
    unit: Unit
    start_ns: int
    end_ns: int
    release_ns: int


@dataclass(frozen=True)
class Job:
    """The work of one release, times in ns. `end_ns` is None while the job is unfinished.

    A release that an executor skipped, because it was late, is a job that never ends.
    """

    task: str
    release_ns: int
    deadline_ns: int
    end_ns: int | None


@dataclass(frozen=True)
class Chart:
    """Spans and jobs between `start_ns` and `end_ns`, each in order of time."""

    start_ns: int
    end_ns: int
    spans: tuple[Span, ...]
    jobs: tuple[Job, ...]

    def late(self, task: str) -> list[Job]:
        """Return the jobs of a task that missed their deadline, unfinished ones included."""
        unfinished = self.end_ns + 1  # on a deadline at the end, too
        return [
            job
            for job in self.jobs
            if job.task == task
            and job.deadline_ns < (unfinished if job.end_ns is None else job.end_ns)
        ]

    def window(self, start_ns: int, end_ns: int) -> Chart:
        """Return the chart from `start_ns` to `end_ns`: spans are cut there, jobs kept whole.

        A job is in the window if it was released in it, or was unfinished or not yet due at its
        start.
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


def simulate(
    tasks: Sequence[TimedTask],
    until_ns: int,
    context_switch_ns: int = 0,
    variants: Variants | None = None,
) -> Chart:
    """Return the exact schedule of `tasks` from 0 until `until_ns`; each is first released at its
    phase.

    A job takes two context switches, one before its parts and one after; they show as idle time.
    Ordinary scheduling, priority 0, is simulated as first come, first served.
    """
    runners = [
        _Runner(task, context_switch_ns, (variants or {}).get(task.name, (task.parts,)))
        for task in tasks
    ]
    for core in {task.core for task in tasks}:
        _run([runner for runner in runners if runner.task.core == core], until_ns)
    spans = sorted(
        (s for r in runners for s in r.spans), key=lambda span: (span.start_ns, span.core)
    )
    jobs = sorted(
        (j for r in runners for j in r.jobs(until_ns)), key=lambda job: (job.release_ns, job.task)
    )
    return Chart(0, until_ns, tuple(spans), tuple(jobs))


def _run(runners: list[_Runner], until_ns: int) -> None:
    """Run the tasks of one core, from one possible preemption to the next."""
    now = 0
    while now < until_ns:
        ready = [runner for runner in runners if runner.ready_at <= now]
        coming = min((r.ready_at for r in runners if r.ready_at > now), default=until_ns)
        if not ready:
            now = coming
            continue
        first = min(ready, key=_Runner.order)
        now = first.compute(now, min(coming, until_ns))


class _Runner:
    """One task, job by job. `ready_at` is the time at which its job, or the next one, can begin,
    ns.
    """

    def __init__(
        self, task: TimedTask, context_switch_ns: int, variants: Sequence[Sequence[Part]]
    ) -> None:
        self.task = task
        self.spans: list[Span] = []
        self.ready_at = task.phase_ns
        self._switch = [Part(None, context_switch_ns)] if context_switch_ns else []
        self._variants = variants
        self._steps: list[Part] = []  # remaining steps of the job
        self._spent_ns = 0  # on the first remaining step
        self._release = -1
        # A planner cannot be late for its first plan.
        self._slack_ns = 0
        self._ends: dict[int, int | None] = {}

    def order(self) -> tuple[int, bool, int, str]:
        """Return its rank among the ready tasks: the lowest computes."""
        is_locked = self._spent_ns > 0 and not self._steps[0].preemptible
        priority = max(self.task.priority, self.task.ceiling) if is_locked else self.task.priority
        # A protected part continues before tasks of that priority that were released meanwhile.
        return -priority, not is_locked, self.ready_at, self.task.name

    def compute(self, now_ns: int, until_ns: int) -> int:
        """Compute from `now_ns` until a part ends, at most until `until_ns`; return that time."""
        if not self._steps:
            self._take(now_ns)
        if not self._steps:
            self._end(now_ns)
            return now_ns
        step = self._steps[0]
        end = min(now_ns + step.time_ns - self._spent_ns, until_ns)
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
                self._end(end)
        return end

    def _take(self, now_ns: int) -> None:
        """Take up the oldest release that has not expired."""
        every = self.task.every_ns
        first = self.task.phase_ns
        newest = first + (now_ns - first) // every * every
        self._release = max(self.ready_at, newest - self._slack_ns)
        if self.task.role != "planner":
            self._ends |= dict.fromkeys(range(self.ready_at, self._release, every))
        self._slack_ns = self.task.period_ns - every
        parts = self._variants[self._release // every % len(self._variants)]
        steps = [part for part in parts if part.time_ns]
        self._steps = [*self._switch, *steps, *self._switch]

    def _end(self, now_ns: int) -> None:
        self._ends.setdefault(self._release, now_ns)
        self.ready_at = self._release + self.task.period_ns

    def jobs(self, until_ns: int) -> Iterator[Job]:
        """Yield the jobs released before `until_ns`; call it once the schedule is complete."""
        if not self._steps and self.ready_at < until_ns:
            self._take(until_ns - 1)
        if self._release not in self._ends and self._release >= 0:
            self._ends[self._release] = None
        for release, end in self._ends.items():
            yield Job(self.task.name, release, release + self.task.period_ns, end)
