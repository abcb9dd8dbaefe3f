"""Shows lost tasks, which died or hang, from the instant of their loss until their return."""

from __future__ import annotations

from collections.abc import Container, Mapping

from rack.tools.viewer.cell import MarkWriter
from rack.tools.viewer.levels import LEVELS, Hierarchy
from rack.tools.viewer.stream import Moment, Stream
from rack.tools.viewer.style import write_span
from rack.tools.viewer.timing import CycleLane


class LossWriter:
    """Writes the losses of tasks into lanes, into the graph of the hierarchy, and at the arm.

    Call it after all rows before the loss have been written. The first row of a task after its
    return ends the marks.

    Args:
        stream: Stream to write to.
        names: Dictionary from task to its name in lanes.
        cycles: Dictionary from task to the lane of its cycles.
        hierarchy: Graph of the hierarchy.
        marks: Writer of marks at the arm, or None without an arm.
        with_states: Boards whose messages contain the state of their level.
    """

    def __init__(
        self,
        stream: Stream,
        names: Mapping[str, str],
        cycles: Mapping[str, CycleLane],
        hierarchy: Hierarchy,
        marks: MarkWriter | None,
        with_states: Container[str],
    ) -> None:
        self._stream = stream
        self._names = names
        self._cycles = cycles
        self._hierarchy = hierarchy
        self._marks = marks
        self._with_states = with_states
        self._lost: set[str] = set()

    def mark_lost(self, when: Moment, task: str) -> None:
        """Mark a task as lost, unless it already is: a task that hangs is killed later."""
        if task not in self._names or task in self._lost:
            return
        self._lost.add(task)
        self._cycles[task].mark_lost(when)
        self._hierarchy.add_change(when, task, "lost")
        if task in self._with_states:
            write_span(self._stream, when, (LEVELS, self._names[task], "state"), "lost")
        if self._marks is not None:
            self._marks.mark_lost(when, task)

    def mark_returned(self, task: str) -> None:
        """Note that a task has returned, so that it can be lost again."""
        self._lost.discard(task)
