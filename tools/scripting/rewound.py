"""Navigation through a recorded run, tick by tick, with branches.

`rack rewind` is its prompt. A tick is shown in the state that the tasks released at it are about to
read. Messages come from the recording. Objects of levels are read from snapshots, which are copies
of their processes that a repeated run makes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

from rack.boards.events import Event
from rack.tools.console.answer import Document, Failure, convert_errors
from rack.tools.console.tables import format_fitted_table
from rack.tools.launch.continued import RepeatedRun, load_branch_config, parse_tick
from rack.tools.launch.folder import choose_run_folder
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display, format_event
from rack.tools.monitor.message_text import MessageFormatter
from rack.tools.monitor.signals import format_value
from rack.tools.recording.divergence import find_first_difference, find_tick_range
from rack.tools.recording.in_force import VisibleMessages
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import MAX_SUGGESTIONS, Signal, Trigger
from rack.tools.report.report import write_report
from rack.tools.scripting.moment import RecordedMoment


@dataclass(frozen=True)
class RewindAnswer:
    """The answer to one command of the navigation, as plain data and as readable lines."""

    document: Document
    lines: Iterable[str]


class RewoundRun:
    """A recorded run that is inspected at a current `tick`.

    Use it as a context. To show objects of levels or run branches, it repeats the run in the
    background. The processes of the repeated run end with the context.
    """

    def __init__(self, folder: Path, anyway: bool = False) -> None:
        self._anyway = anyway
        self.recording = Recording(folder)
        self._layout = self.recording.layout
        self._first, self._end = find_tick_range(self.recording)
        self.tick = self._first
        self._in_force = VisibleMessages(self.recording)
        self._signals = Signal.build_by_name(self._layout.timed)
        self._boxes = {box.name: box for box in self._layout.timed}
        self._tasks = [task.name for task in self._layout.tasks]
        self._levels: tuple[int, Mapping[str, Document]] = -1, {}
        self._again: RepeatedRun | None = None

    def __enter__(self) -> Self:
        # Start the crate early, so that it imports while the user types. If the run cannot be
        # repeated, the first command that needs this reports the reason.
        with suppress(Failure):
            self._prepare_repeated_run()
        return self

    def __exit__(self, *error: object) -> None:
        if self._again is not None:
            self._again.crate.end_crate()

    def _prepare_repeated_run(self) -> RepeatedRun:
        """Return the repeated run. If its crate has ended, start a new one."""
        if self._again is None or self._again.crate.is_over:
            self._again = RepeatedRun(self.recording, anyway=self._anyway)
        return self._again

    @property
    def names(self) -> list[str]:
        """Names that can be shown: tasks, mailboxes and signals."""
        return [*self._tasks, *self._boxes, *self._signals]

    def to_time_s(self, tick: int) -> float:
        """Convert a tick to simulated time in s."""
        return round(tick * self._layout.clock_ns * 1e-9, 9)

    def go_to_time(self, time_s: str) -> RewindAnswer:
        """Go to a simulated time, given in s. Raises `Failure` if it was not recorded."""
        return self._go_to_tick(parse_tick(self.recording, time_s))

    def step(self, ticks: int) -> RewindAnswer:
        """Go forward by a number of ticks, or back if the number is negative."""
        return self._go_to_tick(parse_tick(self.recording, str(self.to_time_s(self.tick + ticks))))

    def go_to_condition(self, condition: str, back: bool = False) -> RewindAnswer:
        """Go to the next tick at which a condition begins to hold, or back to the previous one.

        Raises `Failure` if there is no such tick.
        """
        begin_ticks = self._in_force.find_trigger_ticks(
            Trigger.parse(condition, self._layout.timed)
        )
        before = begin_ticks[(begin_ticks >= self._first) & (begin_ticks < self.tick)][-1:]
        after = begin_ticks[(begin_ticks > self.tick) & (begin_ticks < self._end)][:1]
        for tick in before if back else after:
            return self._go_to_tick(int(tick))
        where = "before" if back else "after"
        raise Failure(f'"{condition}": does not begin to hold {where} {self._time_text}', 2)

    @property
    def _moment(self) -> RecordedMoment:
        """The recorded run at the current tick."""
        return RecordedMoment(self.recording, self._in_force, self.tick)

    @property
    def _time_text(self) -> str:
        """Current time and tick as text."""
        return f"{self.to_time_s(self.tick):g} s, tick {self.tick}"

    def _go_to_tick(self, tick: int) -> RewindAnswer:
        """Make a tick the current one, and return it as the answer."""
        self.tick = tick
        return RewindAnswer({"tick": tick, "time_s": self.to_time_s(tick)}, [self._time_text])

    def show_name(self, name: str) -> RewindAnswer:
        """Show the attributes of a level, the message of a mailbox at this tick, or a signal.

        Raises `Failure` with the nearest names for an unknown one.
        """
        whole = name.partition("[")[0]
        if name in self._tasks:
            return self._show_level(name)
        if name in self._boxes:
            return self._show_message(name)
        if whole in self._signals:
            signal = Signal.parse(name, self._layout.timed)
            value = signal.extract_plain(self._moment.row(signal.mailbox)["message"][None])[0]
            return self._build_answer(
                name, value, [f"{name} = {format_value(value)} {signal.unit}".rstrip()]
            )
        nearest_names = get_close_matches(whole, self.names, MAX_SUGGESTIONS) or [
            *self._tasks,
            *self._boxes,
        ]
        raise Failure(
            f"{name}: no such level, mailbox or signal; nearest: {', '.join(nearest_names)}", 2
        )

    def _build_answer(self, name: str, value: Any, lines: Iterable[str]) -> RewindAnswer:
        """Combine plain data and lines into the answer of `show_name`."""
        where = {"tick": self.tick, "time_s": self.to_time_s(self.tick)}
        return RewindAnswer({**where, "name": name, "value": value}, lines)

    def _show_message(self, mailbox: str) -> RewindAnswer:
        """Show the message of a mailbox that a task released at this tick would read."""
        text = MessageFormatter(self._boxes[mailbox], self._layout.clock_ns)
        document = text.to_document(self._moment.row(mailbox), self.tick)
        return self._build_answer(mailbox, document, text.format_lines(document))

    def _show_level(self, task: str) -> RewindAnswer:
        """Show the attributes of a level. They are read again only when the tick has changed."""
        tick, levels = self._levels
        if tick != self.tick:
            with convert_errors():
                levels = self._prepare_repeated_run().read_levels(self.tick)
            self._levels = self.tick, levels
        rows = [[name, format_value(value)] for name, value in _flatten_attributes(levels[task])]
        return self._build_answer(
            task, levels[task], format_fitted_table(("attribute", "value"), rows)
        )

    def list_events(self, around_s: float) -> RewindAnswer:
        """Show the events within `around_s` before and after this tick."""
        span = around_s * 1e9 / self._layout.clock_ns
        events = (event for event in self.recording.events if event.get("tick", -1) >= 0)
        nearby_events = [event for event in events if abs(event["tick"] - self.tick) <= span]
        lines = [
            f"{self.to_time_s(near['tick']):g} s  {format_event(Event(**near))}"
            for near in nearby_events
        ]
        nothing = f"no events within {around_s:g} s of {self._time_text}"
        return RewindAnswer({"tick": self.tick, "events": nearby_events}, lines or [nothing])

    def run_branch(
        self,
        settings: Sequence[str],
        faults: str | None,
        out: Path | None,
        seconds: float | None,
        display: Display,
    ) -> RewindAnswer:
        """Run the rack from this tick with other settings or faults, and record the branch.

        Args:
            settings: Changed values, as KEY=VALUE.
            faults: A fault script by name or path, or None.
            out: Folder of the branch. None for runs/<rack>-<time>.
            seconds: Simulated time from the beginning of the recorded run. None for the duration of
                that run if it was limited, otherwise until the task ends.
            display: Shows the branch while it runs.

        Raises:
            ConfigError: The changed config has mistakes.
            Failure: The run cannot be repeated, or the branch cannot be recorded.
        """
        config = load_branch_config(self.recording, settings, faults)
        outcome = self.recording.end_counts.get("outcome", {})
        if seconds is None and outcome.get("cause") == "time over":
            seconds = self.to_time_s(self._end)
        folder = choose_run_folder(out, config.name)
        begins = self._prepare_repeated_run().continue_at(self.tick)
        result = run_rack(config, seconds, folder, display, beginning=begins)
        report, _ = write_report(folder)
        difference = find_first_difference(self.recording, Recording(folder))
        where = "all messages that both runs wrote are equal"
        if difference is not None:
            place = f"{self.to_time_s(difference.tick):g} s, tick {difference.tick}, in"
            where = f"differs from {self.recording.folder} first at {place} {difference.mailbox}"
        document = {
            "folder": str(folder),
            "tick": self.tick,
            "outcome": asdict(result.outcome),
            "first_difference": None if difference is None else asdict(difference),
        }
        return RewindAnswer(document, [*report["summary"], where, f"recorded into {folder}"])


def _flatten_attributes(
    attributes: Mapping[str, Any], outer: str = ""
) -> Iterable[tuple[str, Any]]:
    """Yield attributes under dotted names. Nested objects are replaced by their attributes."""
    for name, value in attributes.items():
        if isinstance(value, dict):
            yield from _flatten_attributes(value, f"{outer}{name}.")
        else:
            yield f"{outer}{name}", value
