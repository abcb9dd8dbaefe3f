"""The window of time that a chart shows, from the options of the command."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass

from rack.levels.timing.tasks import TimedTask
from rack.tools.console.answer import Failure
from rack.tools.console.tables import ms
from rack.tools.timing.charts.panel import NS_PER_MS

SLICES = 2
"""Plans in a default chart."""
MOST_CYCLES = 48
"""Most cycles of the fastest task in a default chart."""
LONGEST = 2000
"""Most cycles of a level in any chart."""


@dataclass(frozen=True)
class WindowOptions:
    """The window that the user asks for, ns, and the level whose cycles count; None: not given."""

    from_ns: int | None
    to_ns: int | None
    level: str | None

    def window(
        self, level: TimedTask, extent_ns: int | None, start_ns: int, length_ns: int | None = None
    ) -> tuple[int, int]:
        """Return start and end of the window, ns, in a run of `extent_ns`, or, with None, in an
        endless schedule.

        `level` is the task whose cycles count, `start_ns` the default start, `length_ns` the
        default length: None, two plans of the level. Raises `Failure` for an empty window, one that
        is too long, or one outside the run.
        """
        start = start_ns if self.from_ns is None else self.from_ns
        if length_ns is None or self.level is not None:
            length_ns = SLICES * level.period_ns
        end = start + length_ns if self.to_ns is None else self.to_ns
        if extent_ns is not None:
            if start >= extent_ns or (end > extent_ns and self.to_ns is not None):
                raise Failure(
                    f"{_window(start, end)}: outside the run, which lasts from 0 to"
                    f" {ms(extent_ns)} ms",
                    2,
                )
            end = min(end, extent_ns)
        if start >= end:
            raise Failure(f"{_window(start, end)}: --to-ms must be later than --from-ms", 2)
        if end - start > LONGEST * level.every_ns:
            most = (
                f"a chart shows at most {LONGEST} cycles of '{level.board}',"
                f" {ms(LONGEST * level.every_ns)} ms"
            )
            raise Failure(f"{_window(start, end)}: {most}", 2)
        return start, end

    def task(self, tasks: Sequence[TimedTask], known: Container[str] = ()) -> TimedTask:
        """Return the task whose cycles count: of the level asked for, else the slowest that fits
        into a chart.

        Raises `Failure` for a level that is not in the chart, with the reason if it is one of the
        rack's, `known`.
        """
        tasks = [task for task in tasks if task.role != "clock"]
        if self.level is not None:
            named = [task for task in tasks if task.board == self.level]
            if not named:
                why = "no such level in the chart"
                if self.level in known:
                    give = f"rack gantt CONFIG --set board.{self.level}.budget.process_ms=1"
                    why = f"it has no budget, from which its schedule follows, as in {give}"
                boards = ", ".join(dict.fromkeys(task.board for task in tasks))
                raise Failure(f"--level {self.level}: {why}; levels: {boards}", 2)
            return max(named, key=lambda task: task.period_ns)
        fastest = min(task.every_ns for task in tasks)
        cores = {(task.board, task.core) for task in tasks if task.role == "executor"}
        seen = [task for task in tasks if SLICES * task.period_ns <= MOST_CYCLES * fastest]
        tight = [
            task for task in seen if task.role == "planner" and (task.board, task.core) in cores
        ]
        return max(
            tight or seen or [min(tasks, key=lambda task: task.period_ns)],
            key=lambda task: task.period_ns,
        )


def times_of(process: Sequence[str]) -> dict[str, list[int]]:
    """Return times of X by level, ns, from texts such as "level=3,2", in ms. Raises `Failure`."""
    found = {}
    for text in process:
        level, _, times = text.partition("=")
        try:
            found[level] = [round(float(time) * NS_PER_MS) for time in times.split(",")]
        except (ValueError, OverflowError):
            found[level] = [-1]
        if min(found[level]) < 0:
            raise Failure(
                f"--process {text}: give a level and its times of X, ms, cycle by cycle, as in"
                " level=3,2",
                2,
            )
    return found


def _window(start_ns: int, end_ns: int) -> str:
    return f"{ms(start_ns)} to {ms(end_ns)} ms"
