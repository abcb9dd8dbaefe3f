"""A writer with faults: what a task writes passes through one step a fault, and then into its mailbox, or not.

The steps are in `rack.boards.faults.message_steps`. Faults compose: each step hands on to the next as many messages
as it likes, at once or in a later cycle.
"""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.fault_table import FaultEntry
from rack.backplane.mailbox.mailbox import Writer
from rack.boards.faults.message_steps import STEPS, Held, Outgoing, Step


class FaultyWriter:
    """Stands in for the writer of a mailbox while it has faults. `index` is the mailbox's in the layout."""

    def __init__(self, writer: Writer, index: int) -> None:
        self._writer, self._index = writer, index
        self._steps: dict[int, Step] = {}
        self._first = self._publish
        self._late: list[Held] = []
        self._written = True

    def apply(self, faults: Sequence[tuple[str, FaultEntry]]) -> None:
        """Write with these faults from now on; those that go on keep what they hold back."""
        steps = {e.index: self._steps.get(e.index) or STEPS[k](e, self._writer, self._index) for k, e in faults}
        for index, step in self._steps.items():
            if index not in steps:
                self._late += step.held
        self._steps = steps
        onward = self._publish
        for step in reversed(steps.values()):
            step.onward = onward
            onward = step.send
        self._first = onward

    @property
    def is_over(self) -> bool:
        """Whether there is no fault any more, and nothing held back by one."""
        return not self._steps and not self._late

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Write `message` as its faults have it; return False when it comes too late by itself.

        A message that a fault has held back is visible from when that of the cycle is, or would be: what is read
        depends on ticks alone, with faults too.
        """
        self.flush(tick, now)
        spec, self._written = self._writer.spec, True
        visible_at = self._writer.visible_at(tick, now)
        self._first(Outgoing(tick, tick, visible_at, tick if basis is None else basis))
        return self._written and (now is None or now < tick + spec.delay)

    def flush(self, tick: int, now: int | None = None) -> None:
        """Publish what faults have held back until now."""
        visible_at = self._writer.visible_at(tick, now)
        late, self._late = self._late, []
        for held in late:
            held.send(self._writer, tick, visible_at, self._publish)
        for step in self._steps.values():
            step.flush(tick, visible_at)

    def _publish(self, message: Outgoing) -> None:
        if not self._writer.publish(message.released, message.visible_at, message.basis, message.damage):
            self._written = False
