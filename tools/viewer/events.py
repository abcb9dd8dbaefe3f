"""Writes a rack's events as log lines and lanes, and the recorder's lost rows as log lines.

The lane of a board shows the kind of the board's last event, until the next event. A second lane
of a board with a standby shows which copy is active.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

from rack.backplane.layout import Layout
from rack.backplane.standby import find_original
from rack.boards.events import Event
from rack.tools.recording.current_run import EventFile
from rack.tools.viewer.cell import MarkWriter
from rack.tools.viewer.stream import Moment, Stream
from rack.tools.viewer.style import EVENT_COLOURS, style_lane, write_span

EVENTS = "events"
KINDS_WITHOUT_LANE = ("printed", "miss")
"""Kinds of events without a lane. Missed cycles are in the lanes of cycles."""
CAUSE_ORDER = ("command", "fault", "died", "miss", "detection", "reaction", "recovery")
"""Kinds of events of the same tick, in the order of cause and effect. Other kinds follow."""
RACK_LANE = "rack"
"""Lane of events that belong to no board."""
LOG_LEVELS = {
    "died": "ERROR",
    "detection": "ERROR",
    "fault": "WARN",
    "reaction": "WARN",
    "stop": "WARN",
    "miss": "DEBUG",
    "printed": "DEBUG",
}
"""Log level by kind of event. Other kinds have level INFO."""


class EventWriter:
    """Follows events.jsonl during a run, and writes each new event to the view.

    Faults, brakes and lost tasks are also shown in other views.

    Args:
        stream: Stream to write to.
        path: Path of events.jsonl.
        layout: Layout of the rack.
        names: Dictionary from task to its name in lanes.
        mark_lost: Function that shows the loss of a task, given when it was noticed.
        marks: Writer of marks in 3D, or None without an arm.
    """

    def __init__(
        self,
        stream: Stream,
        path: Path,
        layout: Layout,
        names: Mapping[str, str],
        mark_lost: Callable[[Moment, str], None],
        marks: MarkWriter | None,
    ) -> None:
        self._stream = stream
        self._file = EventFile(path)
        self._layout = layout
        self._names = names
        self._mark_lost = mark_lost
        self._lost: set[str] = set()
        self._marks = marks
        self._waiting: list[Event] = []
        self._lanes: dict[str, str] = {}  # state that each board's lane shows

    def write_events(self, tick: float) -> None:
        """Write all new events before `tick`, causes before effects.

        Args:
            tick: Tick before which all rows have been written. Later events wait for their rows.
        """
        self._waiting += self._file.read_new_events()
        due = [event for event in self._waiting if event.tick < tick]
        self._waiting = [event for event in self._waiting if event.tick >= tick]
        for event in sorted(due, key=get_cause_order):
            self._write(event)

    def _write(self, event: Event) -> None:
        """Write an event to the log and its lane. Faults and lost boards go to other views too."""
        board = event.board or RACK_LANE
        when = Moment(max(0, event.tick), self._stream.times.to_monotonic(event.time_ns))
        text = f"{event.kind}: {board}: {event.text}"
        self._stream.log_line(when, "events", text, LOG_LEVELS.get(event.kind, "INFO"))
        if event.kind not in KINDS_WITHOUT_LANE:
            self._write_lane(when, board, event)
        if event.code in ("active", "taken_over"):
            task = find_original(self._layout, event.subject)
            lane = (EVENTS, self._names.get(task, task), "active")
            write_span(self._stream, when, lane, event.subject)
        if self._marks is not None:
            self._marks.mark_event(when, event)
        lost = board if event.kind == "died" else event.subject if event.code == "hang" else ""
        # A task that hangs is killed later, but is lost only once.
        if lost in self._names.keys() - self._lost:
            self._lost.add(lost)
            self._mark_lost(when, lost)
        elif event.code == "rejoined":
            self._lost.discard(board)

    def _write_lane(self, when: Moment, board: str, event: Event) -> None:
        """Write an event as the new state of its board's lane."""
        lane = (EVENTS, self._names.get(board, board))
        if board not in self._lanes:
            style_lane(self._stream, lane, EVENT_COLOURS)
        # The end of a fault ends the span of that fault, but not the span of a later event.
        if event.code != "ends" or self._lanes.get(board) == event.kind:
            self._lanes[board] = "" if event.code == "ends" else event.kind
            write_span(self._stream, when, lane, self._lanes[board])


def get_cause_order(event: Event) -> tuple[int, int]:
    """Return a sort key that places events in the order of their ticks, and causes before effects.

    Some events are reported late: a lost board that drives an arm reports only after it has
    rejoined that the brakes had engaged.
    """
    is_effect = event.kind in CAUSE_ORDER and event.code != "ends"
    return event.tick, CAUSE_ORDER.index(event.kind) - len(CAUSE_ORDER) if is_effect else 0


def build_loss_lines(stream: Stream) -> Callable[[int, Mapping[str, int]], None]:
    """Return a function that logs every new loss of rows.

    Its arguments are the tick, and a dictionary from ring to the number of rows that were
    overwritten before the recorder read them.
    """
    logged = Counter[str]()

    def write(tick: int, lost: Mapping[str, int]) -> None:
        """Log the new losses."""
        nonlocal logged
        for ring, more in (Counter(lost) - logged).items():
            text = f"recorder: {more} rows of {ring} lost"
            stream.log_line(stream.times.estimate_moment(tick), "recorder", text, "ERROR")
        logged = Counter(lost)

    return write
