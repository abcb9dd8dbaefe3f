"""Which stretch of time a chart shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.levels.timing.tasks import TimedTask
from rack.tools.charting.panel import NS_PER_MS
from rack.tools.charting.text import ms
from rack.tools.console.answer import Failure

SLICES = 2
"""Plans that a chart shows where nobody says otherwise."""
MOST_CYCLES = 48
"""Most cycles of the fastest task in such a chart."""
LONGEST = 2000
"""Most cycles of a level in any chart."""


@dataclass(frozen=True)
class Wanted:
    """What the user asks for, ns; None: not said. `cycles` are the first and the last one, of `level`."""

    from_ns: int | None = None
    to_ns: int | None = None
    cycles: tuple[int, int] | None = None
    level: str | None = None

    def window(self, level: TimedTask, extent_ns: int | None, start_ns: int) -> tuple[int, int]:
        """Return start and end, ns, of the window in a run of `extent_ns`, or in a schedule, which never ends.

        `level` is the task whose cycles count, `start_ns` where to begin when nobody says. Raises `Failure` for a
        window that is none.
        """
        if self.cycles is not None:
            start, end = self.cycles[0] * level.every_ns, (self.cycles[1] + 1) * level.every_ns
        else:
            start = start_ns if self.from_ns is None else self.from_ns
            end = start + SLICES * level.period_ns if self.to_ns is None else self.to_ns
        if extent_ns is not None:
            if start >= extent_ns or (end > extent_ns and (self.to_ns is not None or self.cycles is not None)):
                raise Failure(f"{_said(start, end)}: outside the run, which lasts from 0 to {ms(extent_ns)} ms", 2)
            end = min(end, extent_ns)
        if start >= end:
            raise Failure(f"{_said(start, end)}: --to-ms must be later than --from-ms", 2)
        if end - start > LONGEST * level.every_ns:
            most = f"a chart shows {LONGEST} cycles of '{level.board}' at most, {ms(LONGEST * level.every_ns)} ms"
            raise Failure(f"{_said(start, end)}: {most}", 2)
        return start, end

    def task(self, tasks: Sequence[TimedTask]) -> TimedTask:
        """Return the task whose cycles count: of the level that is named, else the slowest that can be seen."""
        tasks = [task for task in tasks if task.role != "clock"]
        if self.level is not None:
            named = [task for task in tasks if task.board == self.level]
            if not named:
                boards = ", ".join(dict.fromkeys(task.board for task in tasks))
                raise Failure(f"--level {self.level}: no such level in the chart; levels: {boards}", 2)
            return max(named, key=lambda task: task.period_ns)
        fastest = min(task.every_ns for task in tasks)
        cores = {(task.board, task.core) for task in tasks if task.role == "executor"}
        seen = [task for task in tasks if SLICES * task.period_ns <= MOST_CYCLES * fastest]
        tight = [task for task in seen if task.role == "planner" and (task.board, task.core) in cores]
        return max(tight or seen or [min(tasks, key=lambda task: task.period_ns)], key=lambda task: task.period_ns)


def wanted(from_ms: float | None, to_ms: float | None, cycles: str | None, level: str | None) -> Wanted:
    """Return the window of the command's options. Raises `Failure` for what does not go together, or is no window."""
    if cycles is not None and (from_ms is not None or to_ms is not None):
        raise Failure("--cycles is a window already: leave out --from-ms and --to-ms", 2)
    from_ns, to_ns = (None if value is None else round(value * NS_PER_MS) for value in (from_ms, to_ms))
    return Wanted(from_ns, to_ns, None if cycles is None else _cycles(cycles), level)


def _cycles(text: str) -> tuple[int, int]:
    first, dash, last = text.partition("-")
    if not first.isdecimal() or (dash and not last.isdecimal()) or (dash and int(last) < int(first)):
        raise Failure(f"--cycles {text}: give the first and the last cycle, counted from 0, as in 10-12", 2)
    return int(first), int(last or first)


def times_of(process: Sequence[str]) -> dict[str, list[int]]:
    """Return times of X by level, ns, of texts as "level=3,2", ms. Raises `Failure`."""
    found = {}
    for text in process:
        level, _, times = text.partition("=")
        try:
            found[level] = [round(float(time) * NS_PER_MS) for time in times.split(",")]
        except (ValueError, OverflowError):
            found[level] = [-1]
        if min(found[level]) < 0:
            raise Failure(f"--process {text}: give a level and its times of X, ms, cycle by cycle, as in level=3,2", 2)
    return found


def _said(start_ns: int, end_ns: int) -> str:
    return f"{ms(start_ns)} to {ms(end_ns)} ms"
