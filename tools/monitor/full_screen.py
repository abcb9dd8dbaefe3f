"""The full screen of `rack top`, with keys that command the rack. It needs textual.

It shows boards, mailboxes, events and lateness, and reads rings and words five times a second.
Commands that wait for an answer run in a thread.
"""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.containers import VerticalScroll
from textual.widget import Widget
from textual.widgets import Footer, Input, OptionList, Static, TabbedContent, TabPane
from textual.widgets.option_list import Option

from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.boards.crate.alarm_events import AlarmReader
from rack.boards.faults import KINDS
from rack.boards.timing.trace_times import compute_lateness_ns
from rack.tools.console.answer import Failure, convert_errors
from rack.tools.console.tables import GAP, build_grid
from rack.tools.faults.live import LiveRack
from rack.tools.monitor import display
from rack.tools.monitor.desk import LevelCommander, parse_goal
from rack.tools.monitor.message_text import DROPPED, list_mailboxes
from rack.tools.monitor.snapshot import RackMonitor, Snapshot

REFRESH_INTERVAL_S = 0.2
LATENESS_BORDERS_US = (-np.inf, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, np.inf)
"""Borders, in us, of the lateness classes in which cycles are counted."""
SPARKS = "▁▂▃▄▅▆▇█"
"""Marks of a sparkline: the longest lateness between two refreshes, from below 50 us to 5 ms."""
SPARKLINE_LENGTH = 24
SHOWN_EVENTS = 10
"""Number of events below the boards."""
INJECT = "inject"
"""First word of a fault on the command line. Any other word is the level of a command."""
CORE_FAULTS = [kind.name for kind in KINDS if kind.where == "core"]
"""Kinds of faults in which the injecting process occupies a core. The screen must not do that."""


class RackScreen(App[None]):
    """Shows one rack until its run is over or `has_ended` returns True."""

    CSS = """
    Screen { overflow: hidden; }
    #head, #levels { height: 1; }
    TabbedContent { height: 1fr; }
    TabPane { padding: 0; }
    Input, OptionList { display: none; max-height: 50%; }
    .open { display: block; }
    .-low #head, .-low ContentTabs, .-low Footer { display: none; }
    """
    VERTICAL_BREAKPOINTS = [(0, "-low"), (10, "-high")]
    ENABLE_COMMAND_PALETTE = False
    BINDINGS = [
        Binding("h", "give('hold')", "hold"),
        Binding("r", "give('resume')", "resume"),
        Binding("l", "level", "level"),
        Binding("c", "write('')", "command"),
        Binding("i", "kinds", INJECT),
        Binding("e", "stop", "estop"),
        Binding("E", "carry_out(['reset'])", "reset"),
        Binding("w", "worst", "worst"),
        Binding("q", "quit", "quit"),
        Binding("escape", "close", show=False),
        Binding("ctrl+c", "interrupt", show=False, priority=True),
        *(Binding(str(number), f"pane({number})", show=False) for number in (1, 2, 3, 4)),
    ]

    def __init__(self, segment: Segment, has_ended: Callable[[], bool]) -> None:
        super().__init__()
        self._segment = segment
        self._has_ended = has_ended
        self._monitor = RackMonitor(segment, keeps_longest=True)
        self._alarms = AlarmReader(segment)
        self._lines = UtilityLines(segment)
        self._events: deque[Text] = deque(maxlen=500)  # newest first
        tasks = sorted(segment.layout.tasks, key=lambda task: -task.every)
        names = [task.name for task in tasks]
        boxes = {box.name for box in segment.layout.mailboxes}
        self._hierarchy = [name for name in names if f"{name}.operator" in boxes] or names
        self._levels = deque(self._hierarchy)  # the first is the one that keys command
        self._late: dict[str, np.ndarray] = {}
        self._sparklines = dict.fromkeys(names, "")
        self._panes: dict[str, Callable[[Snapshot], RenderableType]] = {
            "boards": self._build_board_view,
            "mailboxes": self._build_mailbox_table,
            "events": lambda snapshot: Text("\n").join(list(self._events)),
            "lateness": self._build_lateness_table,
        }

    def compose(self) -> ComposeResult:
        """Yield the widgets of the screen."""
        yield Static(id="head")
        yield Static(id="levels")
        with TabbedContent():
            for number, name in enumerate(self._panes, 1):
                with TabPane(f"{number} {name}", id=name), VerticalScroll():
                    yield Static()
        yield OptionList()
        yield Input(placeholder="LEVEL WHAT [GOAL], as in: task goto home", compact=True)
        yield Footer(compact=True)

    def on_mount(self) -> None:
        """Show the first snapshot, and refresh it periodically."""
        self._refresh()
        self.set_interval(REFRESH_INTERVAL_S, self._refresh)

    def _refresh(self) -> None:
        """Take a snapshot and show it. Exit when the run is over."""
        if self._segment.run_is_over or self._has_ended():
            self.exit()
            return
        snapshot = self._monitor.take_snapshot()
        for task, rows in self._monitor.cycles.items():
            late_us = compute_lateness_ns(rows) * 1e-3
            counts, _ = np.histogram(late_us, LATENESS_BORDERS_US)
            self._late[task] = self._late.get(task, 0) + counts
            if len(rows):
                mark = SPARKS[np.digitize(late_us.max(), LATENESS_BORDERS_US[2:-2])]
                self._sparklines[task] = (self._sparklines[task] + mark)[-SPARKLINE_LENGTH:]
        for event in (alarm.event for alarm in self._alarms.read_alarms()):
            if display.is_worth_showing(event):
                self._events.appendleft(display.format_event(event))
        self.query_one("#head", Static).update(Text(display.format_line(snapshot)))
        self.query_one("#levels", Static).update(self._format_levels(snapshot))
        pane = self.query_one(TabbedContent).active
        self.query_one(f"#{pane} Static", Static).update(self._panes[pane](snapshot))

    def _format_levels(self, snapshot: Snapshot) -> Text:
        """Format the levels, coloured by state. The selected level is shown in reverse."""
        states = {row.task: row.state for row in snapshot.tasks}
        chosen = {self._levels[0]: "reverse"}
        levels = [
            Text(name, f"{display.STATE_STYLES.get(states[name], '')} {chosen.get(name, '')}")
            for name in self._hierarchy
        ]
        return Text(" > ").join(levels)

    def _build_board_view(self, snapshot: Snapshot) -> RenderableType:
        """Return the table of tasks with sparklines, and the newest events below it."""
        events = [Text("\nevents, newest first:"), *self._events][: SHOWN_EVENTS + 1]
        return Group(display.RackView(snapshot, self._sparklines), *events)

    def _build_mailbox_table(self, snapshot: Snapshot) -> RenderableType:
        """Return the table of mailboxes."""
        rows = list_mailboxes(self._segment)
        cells = [[*map(str, row.values())] for row in rows]
        return build_grid([*rows[0]], cells, self.size.width - GAP, DROPPED)

    def _build_lateness_table(self, snapshot: Snapshot) -> RenderableType:
        """Return the table of lateness classes of the selected level."""
        level = self._levels[0]
        classes = zip(LATENESS_BORDERS_US[1:], self._late[level].tolist(), strict=True)
        rows = [[f"< {border:g}", str(count)] for border, count in classes]
        return build_grid(("late us", level), rows, self.size.width)

    def action_pane(self, number: int) -> None:
        """Show the pane with the given number, counted from 1."""
        self.query_one(TabbedContent).active = [*self._panes][number - 1]

    def action_level(self) -> None:
        """Select the next level. Keys that give commands apply to it."""
        self._levels.rotate(-1)

    def action_worst(self) -> None:
        """Reset the longest times and the counts of lateness."""
        self._monitor.forget_times()
        self._late.clear()

    def action_interrupt(self) -> None:
        """End the program as Ctrl-C does."""
        signal.raise_signal(signal.SIGINT)

    def action_stop(self) -> None:
        """Set the emergency stop. The head line shows it."""
        self._lines.latch_emergency_stop()

    def action_give(self, what: str) -> None:
        """Give the selected level a command that needs no goal."""
        self.action_carry_out([self._levels[0], what])

    def action_kinds(self) -> None:
        """Open the menu of faults."""
        options = self.query_one(OptionList)
        options.clear_options()
        for kind in KINDS:
            words = [INJECT, self._levels[0], kind.name]
            words += [f"{p.name}=" for p in kind.parameters if p.default is None]
            words += [] if kind.once else ["for=1s"]
            options.add_option(Option(Text(f"{kind.name:18}{kind.means}"), " ".join(words)))
        options.highlighted = 0
        self._open(options)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Write the chosen fault on the command line, where the user can change it."""
        self.action_write(event.option_id or "")

    def action_write(self, text: str) -> None:
        """Open the command line with a text."""
        line = self.query_one(Input)
        self._open(line)
        line.value = text
        line.action_end()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Execute the command line."""
        self.action_close()
        self.action_carry_out(event.value.split())

    def action_close(self) -> None:
        """Close menu and command line."""
        self.query(".open").remove_class("open")
        self.set_focus(None)

    def _open(self, widget: Widget) -> None:
        """Open a menu or the command line, and close any other."""
        self.action_close()
        widget.add_class("open")
        widget.focus()

    def action_carry_out(self, words: Sequence[str]) -> None:
        """Execute a command in the background, and show its answer when it arrives."""
        self.run_worker(partial(self._execute_in_thread, words), thread=True)

    def _execute_in_thread(self, words: Sequence[str]) -> None:
        """Execute a command and show its answer.

        This runs in a thread, because a level may take seconds to answer.
        """
        try:
            with convert_errors():
                answer = self._execute(words)
        except Failure as error:
            answer = str(error)
        self._events.appendleft(Text(answer))
        self.notify(answer, markup=False)

    def _execute(self, words: Sequence[str]) -> str:
        """Execute a reset, a fault or a command, and return its answer. Raises `Failure`."""
        match words:
            case ["reset"]:
                self._lines.reset_emergency_stop()
                return "the emergency stop is reset"
            case [first, board, kind, *given] if first == INJECT:
                if kind in CORE_FAULTS:
                    raise Failure(f"{kind}: needs a separate process; use 'rack inject'")
                values = dict(word.partition("=")[::2] for word in given)
                live = LiveRack(self._segment)
                fault = {"board": board, "kind": kind, **values}
                return str(live.inject_fault(fault, wait=False)["message"])
            case [level, what, *goal]:
                command = {"level": level, "what": what, **parse_goal(what, goal)}
                return LevelCommander(self._segment).give_command(command, wait=False).line
        raise Failure(f"'{' '.join(words)}': must be LEVEL WHAT [GOAL], or {INJECT} BOARD KIND ...")
