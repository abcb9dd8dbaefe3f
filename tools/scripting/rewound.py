"""Navigation through a recorded run, tick by tick, with branches.

`rack rewind` is the prompt for it. A tick is shown as the tasks released at it are about to find
it. Messages come from the recording. Objects of levels are read in copies of their processes:
snapshots that a repeated run of the rack leaves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

from rack.boards.events import Event
from rack.tools.console.answer import Document, Failure, as_failure
from rack.tools.console.tables import fitted
from rack.tools.launch.continued import RunAgain, branched, tick_in
from rack.tools.launch.folder import folder_of
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display, event_text
from rack.tools.monitor.message_text import MessageText
from rack.tools.monitor.signals import cell
from rack.tools.recording.divergence import first_difference, ticks_of
from rack.tools.recording.in_force import InForce
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import NEAREST, Signal, Trigger
from rack.tools.report.report import write_report
from rack.tools.report.report_markdown import summary
from rack.tools.scripting.moment import RecordedMoment


@dataclass(frozen=True)
class Glance:
    """The answer to one step of the navigation, as plain data and as lines for people."""

    document: Document
    lines: Iterable[str]


class RewoundRun:
    """A recorded run and the current `tick`.

    Use it as a context, which repeats the run in the background and keeps snapshots of it.
    """

    def __init__(self, folder: Path, anyway: bool = False) -> None:
        self._anyway = anyway
        self.recording = Recording(folder)
        self._layout = self.recording.layout
        self._first, self._end = ticks_of(self.recording)
        self.tick = self._first
        self._in_force = InForce(self.recording)
        self._signals = Signal.all(self._layout.timed)
        self._boxes = {box.name: box for box in self._layout.timed}
        self._tasks = [task.name for task in self._layout.tasks]
        self._levels: tuple[int, Mapping[str, Document]] = -1, {}
        self._again: RunAgain | None = None

    def __enter__(self) -> Self:
        # Start the crate early, so that it imports while the user types. If the run cannot be
        # repeated, the user is told when a command needs that.
        with suppress(Failure):
            self._ready()
        return self

    def __exit__(self, *error: object) -> None:
        if self._again is not None:
            self._again.crate.end()

    def _ready(self) -> RunAgain:
        """Return the repeated run, which is started again if its crate was lost."""
        if self._again is None or self._again.crate.is_over:
            self._again = RunAgain(self.recording, anyway=self._anyway)
        return self._again

    @property
    def names(self) -> list[str]:
        """Names that can be shown: tasks, mailboxes and signals."""
        return [*self._tasks, *self._boxes, *self._signals]

    def time_s(self, tick: int) -> float:
        """Convert a tick to simulated time, s."""
        return round(tick * self._layout.clock_ns * 1e-9, 9)

    def goto(self, time_s: str) -> Glance:
        """Go to a simulated time, s. Raises `Failure` if it was not recorded."""
        return self._go(tick_in(self.recording, time_s))

    def step(self, ticks: int) -> Glance:
        """Go forward by some ticks, or back if the number is negative."""
        return self._go(tick_in(self.recording, str(self.time_s(self.tick + ticks))))

    def goto_when(self, condition: str, back: bool = False) -> Glance:
        """Go to the next tick at which a condition begins to hold, or back to the previous one.

        Raises `Failure` if there is no such tick.
        """
        begin_ticks = self._in_force.begins(Trigger.of(condition, self._layout.timed))
        before = begin_ticks[(begin_ticks >= self._first) & (begin_ticks < self.tick)][-1:]
        after = begin_ticks[(begin_ticks > self.tick) & (begin_ticks < self._end)][:1]
        for tick in before if back else after:
            return self._go(int(tick))
        where = "before" if back else "after"
        raise Failure(f'"{condition}": does not begin to hold {where} {self._now}', 2)

    @property
    def _moment(self) -> RecordedMoment:
        return RecordedMoment(self.recording, self._in_force, self.tick)

    @property
    def _now(self) -> str:
        return f"{self.time_s(self.tick):g} s, tick {self.tick}"

    def _go(self, tick: int) -> Glance:
        self.tick = tick
        return Glance({"tick": tick, "time_s": self.time_s(tick)}, [self._now])

    def show(self, name: str) -> Glance:
        """Show the attributes of a level, the message in force in a mailbox, or a signal.

        Raises `Failure` with the nearest names for an unknown one.
        """
        whole = name.partition("[")[0]
        if name in self._tasks:
            return self._level(name)
        if name in self._boxes:
            return self._message(name)
        if whole in self._signals:
            signal = Signal.of(name, self._layout.timed)
            value = signal.plain(self._moment.row(signal.mailbox)["message"][None])[0]
            return self._shown(name, value, [f"{name} = {cell(value)} {signal.unit}".rstrip()])
        nearest_names = get_close_matches(whole, self.names, NEAREST) or [
            *self._tasks,
            *self._boxes,
        ]
        raise Failure(
            f"{name}: no such level, mailbox or signal; nearest: {', '.join(nearest_names)}", 2
        )

    def _shown(self, name: str, value: Any, lines: Iterable[str]) -> Glance:
        """Build the answer of `show_name`."""
        where = {"tick": self.tick, "time_s": self.time_s(self.tick)}
        return Glance({**where, "name": name, "value": value}, lines)

    def _message(self, mailbox: str) -> Glance:
        text = MessageText(self._boxes[mailbox], self._layout.clock_ns)
        document = text.document(self._moment.row(mailbox), self.tick)
        return self._shown(mailbox, document, text.lines(document))

    def _level(self, task: str) -> Glance:
        """Show the attributes of a level. They are read once for each tick."""
        tick, levels = self._levels
        if tick != self.tick:
            with as_failure():
                levels = self._ready().levels(self.tick)
            self._levels = self.tick, levels
        rows = [[name, cell(value)] for name, value in _flat(levels[task])]
        return self._shown(task, levels[task], fitted(("attribute", "value"), rows))

    def events(self, around_s: float) -> Glance:
        """Show the events within a time before and after this tick."""
        span = around_s * 1e9 / self._layout.clock_ns
        events = (event for event in self.recording.events if event.get("tick", -1) >= 0)
        nearby_events = [event for event in events if abs(event["tick"] - self.tick) <= span]
        lines = [
            f"{self.time_s(near['tick']):g} s  {event_text(Event(**near))}"
            for near in nearby_events
        ]
        nothing = f"no events within {around_s:g} s of {self._now}"
        return Glance({"tick": self.tick, "events": nearby_events}, lines or [nothing])

    def branch(
        self,
        settings: Sequence[str],
        faults: str | None,
        out: Path | None,
        seconds: float | None,
        display: Display,
    ) -> Glance:
        """Run the rack from this tick with other settings or faults, and record that.

        Args:
            settings: Changed values, as KEY=VALUE.
            faults: A fault script by name or path, or None.
            out: Folder of the branch. None for runs/<rack>-<time>.
            seconds: Simulated time from the beginning of the recorded run. None for the duration of
                that
                run if it was limited, otherwise until the task ends.
            display: Shows the branch while it runs.

        Raises:
            ConfigError: The changed config has mistakes.
            Failure: The run cannot be repeated, or the branch cannot be recorded.
        """
        config = branched(self.recording, settings, faults)
        outcome = self.recording.ended.get("outcome", {})
        if seconds is None and outcome.get("cause") == "time over":
            seconds = self.time_s(self._end)
        folder = folder_of(out, config.name)
        begins = self._ready().beginning(self.tick)
        result = run_rack(config, seconds, folder, display, begins=begins)
        report, _ = write_report(folder)
        difference = first_difference(self.recording, Recording(folder))
        where = "all messages that both runs wrote are equal"
        if difference is not None:
            place = f"{self.time_s(difference.tick):g} s, tick {difference.tick}, in"
            where = f"differs from {self.recording.folder} first at {place} {difference.mailbox}"
        document = {
            "folder": str(folder),
            "tick": self.tick,
            "outcome": asdict(result.outcome),
            "first_difference": None if difference is None else asdict(difference),
        }
        return Glance(document, [*summary(report), where, f"recorded into {folder}"])


def _flat(attributes: Mapping[str, Any], outer: str = "") -> Iterable[tuple[str, Any]]:
    """Yield attributes by dotted names, including the attributes of nested objects."""
    for name, value in attributes.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{outer}{name}.")
        else:
            yield f"{outer}{name}", value
