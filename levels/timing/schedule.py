"""A schedule: what tasks do to each other on their cores, by fixed priorities, worked out instead of run.

It follows the rack's own rules (backplane/wake.py, boards/planner_task.py): who is late takes up the newest release,
never two; a planner's release lasts as long as the slice of its plan, and the next one lies behind that slice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from rack.levels.timing.chart import Chart, Job, Span
from rack.levels.timing.tasks import Part, TimedTask, Unit

Variants = Mapping[str, Sequence[Sequence[Part]]]
"""Parts of a task that are not the same in every cycle, by task: those of its cycles in turn."""


def simulate(
    tasks: Sequence[TimedTask], until_ns: int, context_switch_ns: int = 0, variants: Variants | None = None
) -> Chart:
    """Return what `tasks` compute from their common release at 0 until `until_ns`, exactly.

    A job takes two context switches, one before its parts and one behind them; they show as time in which nobody
    computes. Ordinary scheduling, priority 0, is simulated as first come, first served.
    """
    runners = [_Runner(task, context_switch_ns, (variants or {}).get(task.name, (task.parts,))) for task in tasks]
    for core in {task.core for task in tasks}:
        _run([runner for runner in runners if runner.task.core == core], until_ns)
    spans = sorted((s for r in runners for s in r.spans), key=lambda span: (span.start_ns, span.core))
    jobs = sorted((j for r in runners for j in r.jobs(until_ns)), key=lambda job: (job.release_ns, job.task))
    return Chart(0, until_ns, tuple(spans), tuple(jobs))


def _run(runners: list[_Runner], until_ns: int) -> None:
    """Run the tasks of one core, from one moment at which another may have to compute to the next."""
    now = 0
    while now < until_ns:
        ready = [runner for runner in runners if runner.ready_at <= now]
        coming = min((r.ready_at for r in runners if r.ready_at > now), default=until_ns)
        if not ready:
            now = coming
            continue
        first = min(ready, key=_Runner.order)
        now = first.compute(now, min(coming, until_ns))


class _Step(NamedTuple):
    """A part of a job; a context switch has no unit."""

    unit: Unit | None
    time_ns: int
    preemptible: bool = True


class _Runner:
    """One task, job by job. `ready_at` is when its job, or the next one, can begin, ns."""

    def __init__(self, task: TimedTask, context_switch_ns: int, variants: Sequence[Sequence[Part]]) -> None:
        self.task = task
        self.spans: list[Span] = []
        self.ready_at = task.jitter_ns
        self._switch = [_Step(None, context_switch_ns)] if context_switch_ns else []
        self._variants = variants
        self._steps: list[_Step] = []  # those left of the job
        self._spent_ns = 0  # on the first of them
        self._release = -1
        # Before its first plan a planner takes nothing late.
        self._slack_ns = 0
        self._ends: dict[int, int | None] = {}

    def order(self) -> tuple[int, bool, int, str]:
        """Return its place among those that could compute: the lowest does."""
        is_locked = self._spent_ns > 0 and not self._steps[0].preemptible
        priority = max(self.task.priority, self.task.ceiling) if is_locked else self.task.priority
        # What its ceiling protects goes on before all that has come to that priority meanwhile.
        return -priority, not is_locked, self.ready_at, self.task.name

    def compute(self, now_ns: int, until_ns: int) -> int:
        """Compute from `now_ns` until one part is done, `until_ns` at most; return when that was."""
        if not self._steps:
            self._take(now_ns)
        if not self._steps:
            self._end(now_ns)
            return now_ns
        step = self._steps[0]
        end = min(now_ns + step.time_ns - self._spent_ns, until_ns)
        if step.unit is not None:
            self._draw(step.unit, now_ns, end)
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
        """Take up the oldest release that has not passed."""
        every, expected = self.task.every_ns, self.ready_at - self.task.jitter_ns
        newest = (now_ns - self.task.jitter_ns) // every * every
        self._release = max(expected, newest - self._slack_ns)
        if self.task.role != "planner":
            self._ends |= dict.fromkeys(range(expected, self._release, every))
        self._slack_ns = self.task.period_ns - every
        parts = self._variants[self._release // every % len(self._variants)]
        steps = [_Step(part.unit, part.time_ns, part.preemptible) for part in parts if part.time_ns]
        self._steps = [*self._switch, *steps, *self._switch]

    def _end(self, now_ns: int) -> None:
        self._ends.setdefault(self._release, now_ns)
        self.ready_at = self._release + self.task.period_ns + self.task.jitter_ns

    def _draw(self, unit: Unit, start_ns: int, end_ns: int) -> None:
        last = self.spans[-1] if self.spans else None
        if last is not None and (last.unit, last.end_ns, last.release_ns) == (unit, start_ns, self._release):
            self.spans[-1] = replace(last, end_ns=end_ns)
        else:
            self.spans.append(Span(self.task.name, self.task.core, unit, start_ns, end_ns, self._release))

    def jobs(self, until_ns: int) -> Iterator[Job]:
        """Yield the jobs released before `until_ns`; to be called when the schedule is over."""
        if not self._steps and self.ready_at < until_ns:
            self._take(until_ns - 1)
        if self._release not in self._ends and self._release >= 0:
            self._ends[self._release] = None
        for release, end in self._ends.items():
            yield Job(self.task.name, release, release + self.task.period_ns, end)
