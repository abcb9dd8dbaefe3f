"""The end of a run, judged from what its levels have written last."""

from __future__ import annotations

from rack.backplane.message import State
from rack.backplane.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.outcome import Cause


class Ending:
    """Judges the end of a run. `ends_run` and `silent` are as in `ClockWiring`."""

    def __init__(self, segment: Segment, ends_run: str | None, silent: int) -> None:
        self._segment, self._ends_run, self._silent = segment, ends_run, silent
        self._observer = None if ends_run is None else open_observer(segment, ends_run)

    def final_state(self) -> tuple[str, str]:
        """Return the last state of the level that ends the run, and the reason."""
        if self._observer is None:
            return "", ""
        status = self._observer.peek().value
        silent_s = self._silence() * self._segment.layout.clock_ns * 1e-9
        reason = f"'{self._ends_run}' has not been written for {silent_s:g} s" if silent_s else status.reason
        return State(status.state).name.lower(), reason

    def latched(self) -> list[str]:
        """Return a line for every level, except the one that ends the run, whose last status reports an error."""
        found = []
        for box in self._segment.layout.mailboxes:
            board, _, port = box.name.partition(".")
            if port != "status" or box.name == self._ends_run or "error" not in (field.name for field in box.fields):
                continue
            status = open_observer(self._segment, box.name).peek()
            if status.is_there and status.value.error:
                found.append(f"level '{board}': {status.value.reason}")
        return found

    def cause(self) -> Cause:
        """Return why a run ended that was not stopped."""
        if self._observer is None or self._ends_run is None:
            return "time over"
        status, fields = self._observer.peek().value, self._segment.layout.mailbox(self._ends_run).fields
        if status.state != State.ERROR and not self._silence():
            return "task done" if status.state == State.DONE else "time over"
        # A status with a field `moves` says how many moves its program has: none if it was refused.
        counts_moves = any(field.name == "moves" and not field.shape for field in fields)
        is_refused = counts_moves and not status.moves
        return "task refused" if is_refused else "task failed"

    def _silence(self) -> int:
        """Return the ticks since the last status of the level that ends the run; 0: within bounds, or it has ended."""
        assert self._observer is not None, "some level ends the run"
        reading = self._observer.peek()
        if reading.value.state in (State.DONE, State.ERROR):
            return 0
        ticks = self._segment.words[System.TICK] - (self._observer.newest if reading.is_there else 0)
        return ticks if ticks > self._silent else 0
