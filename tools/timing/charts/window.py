"""The window of time that a chart shows, chosen with the options of the command."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rack.boards.timing.tasks import TimedTask
from rack.tools.console.answer import Failure
from rack.tools.console.tables import format_ms

DEFAULT_SLICES = 2
"""Number of plans in a default chart."""
MAX_DEFAULT_CYCLES = 48
"""Maximum number of the fastest task's cycles in a default chart."""
MAX_CYCLES = 2000
"""Maximum number of a level's cycles in any chart."""


class WindowOptions(NamedTuple):
    """Window that the user asked for, in ns. None for a limit that is not given."""

    from_ns: int | None = None
    to_ns: int | None = None

    def choose_window(
        self, task: TimedTask, extent_ns: int | None, start_ns: int, length_ns: int | None = None
    ) -> tuple[int, int]:
        """Return the start and the end of the window, in ns.

        Args:
            task: Task that determines the window. It shows at most `MAX_CYCLES` of its cycles.
            extent_ns: Length of the run, ns. None for a schedule, which has no end.
            start_ns: Default start, ns.
            length_ns: Default length, ns. None for two plans of the task.

        Raises:
            Failure: If the window is empty, too long, or outside the run.
        """
        start = start_ns if self.from_ns is None else self.from_ns
        end = (
            start + (length_ns or DEFAULT_SLICES * task.period_ns)
            if self.to_ns is None
            else self.to_ns
        )
        if extent_ns is not None:
            if start >= extent_ns or (end > extent_ns and self.to_ns is not None):
                raise Failure(
                    f"{_format_window(start, end)}: is outside the run, which lasts from 0 to"
                    f" {format_ms(extent_ns)} ms",
                    2,
                )
            end = min(end, extent_ns)
        if start >= end:
            raise Failure(f"{_format_window(start, end)}: --to-ms must be later than --from-ms", 2)
        if end - start > (longest_ns := MAX_CYCLES * task.every_ns):
            raise Failure(
                f"{_format_window(start, end)}: a chart shows at most {MAX_CYCLES} cycles of"
                f" '{task.board}', {format_ms(longest_ns)} ms",
                2,
            )
        return start, end


def choose_task(tasks: Sequence[TimedTask]) -> TimedTask:
    """Return the task whose cycles determine the default window.

    It is the slowest task that fits into a chart, if possible a tightly coupled planner.
    """
    tasks = [task for task in tasks if task.role != "clock"]
    fastest = min(task.every_ns for task in tasks)
    cores = {(task.board, task.core) for task in tasks if task.role == "executor"}
    shown = [
        task for task in tasks if DEFAULT_SLICES * task.period_ns <= MAX_DEFAULT_CYCLES * fastest
    ]
    tight = [task for task in shown if task.role == "planner" and (task.board, task.core) in cores]
    return max(
        tight or shown or [min(tasks, key=lambda task: task.period_ns)],
        key=lambda task: task.period_ns,
    )


def _format_window(start_ns: int, end_ns: int) -> str:
    """Format the start and the end of a window in ms."""
    return f"{format_ms(start_ns)} to {format_ms(end_ns)} ms"
