"""`rack watch`: signals of a running rack, live, or what was around a moment."""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.faults.config import as_seconds
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName
from rack.tools.console.tables import console
from rack.tools.live.signals import Lines, Plot, SignalTap, Strip, Written, cell
from rack.tools.live.watched import looks
from rack.tools.recording.signal import Signal, Trigger

LOOK_S = 0.02
"""Time between looks: rings hold 2 s, in a fast lockstep a quarter of that."""
SHOWN_S = 10.0
"""Simulated time that a plot shows."""
MOST_S = 600.0
"""Longest time kept before or after a moment: all of it is in memory."""

Signals = Annotated[
    list[str],
    typer.Argument(metavar="SIGNAL...", help="as in servo.status.position[2], or a whole field"),
]
When = Annotated[
    str | None,
    typer.Option(
        metavar="CONDITION", help='wait until this holds, as in "servo.status.position[2] > 1.2"'
    ),
]
Before = Annotated[
    str, typer.Option(metavar="TIME", help="with --when: simulated time to save before it")
]
After = Annotated[
    str, typer.Option(metavar="TIME", help="with --when: simulated time to save after it")
]
Out = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="with --when: CSV file; default: RACK-TICK.csv"),
]
Every = Annotated[
    str,
    typer.Option(metavar="TIME", help="simulated time between two lines; 0s: a line a message"),
]


def watch(
    rack: RackName,
    signals: Signals,
    when: When = None,
    before: Before = "0.5s",
    after: After = "1s",
    out: Out = None,
    every: Every = "0.1s",
    as_json: Json = False,
) -> None:
    """Show signals of a running rack until its run is over, or until Ctrl-C.

    A signal is a field of a mailbox ('rack mailbox RACK' lists those), or one number of it. On a
    terminal it is plotted, if plotext is there (pip install 'nasrem-rack[live]'). Otherwise each
    line has the time, s, and the values; with --json each line is a document.

    With --when it waits for a moment, and saves what was around it: every message, none left out.
    Watching reads the rings that the recorder reads: it costs the rack no deadline.

    Exit status: 0 shown, or saved whole; 1 there is no such rack, messages were lost, or the run
    ended before the condition held; 2 usage.

    \b
    Examples:
      rack watch nasrem "servo.status.position[2]" "servo.status.torque[2]"
      rack watch nasrem servo.status.position --every 0s --json
      rack watch nasrem servo.status.torque --when "servo.status.position[2] > -2.5" --before 0.5s
    """
    before_s, after_s, every_s = (
        _seconds("--before", before),
        _seconds("--after", after),
        _seconds("--every", every),
    )
    if out is not None and when is None:
        raise Failure("--out needs --when; give both, or neither", 2)
    segment = Segment.attach(rack)
    boxes = segment.layout.mailboxes
    shown = [Signal.of(name, boxes) for name in signals]
    if when is None:
        _show(segment, shown, every_s, as_json)
        return
    _check_writable(out or Path(f"{rack}.csv"))
    capture = Capture(segment, shown, Trigger.of(when, boxes), before_s, after_s)
    capture.wait()
    path = out or Path(f"{rack}-{capture.tick}.csv")
    rows = capture.save(path)
    time_s = capture.strip.time_s(capture.tick)
    print_answer(
        {"file": str(path), "tick": capture.tick, "time_s": time_s, "rows": rows},
        f"{when}: held first at {time_s:g} s, tick {capture.tick}; {rows} rows around it: {path}",
        as_json,
    )


def _seconds(option: str, text: str) -> float:
    seconds = -1.0
    with suppress(ValueError):
        seconds = as_seconds(text)
    if not 0.0 <= seconds <= MOST_S:
        why = f"not a time; permitted: as in 0.5s or 20ms, at most {MOST_S:g}s"
        raise Failure(f"{option} {text}: {why}", 2)
    return seconds


def _check_writable(path: Path) -> None:
    """Raise `OSError` where a file cannot be written, before the moment: afterwards it is gone."""
    is_new = not path.exists()
    with path.open("a"):
        pass
    if is_new:
        path.unlink()


def _show(segment: Segment, signals: Sequence[Signal], every_s: float, as_json: bool) -> None:
    """Show signals until the run is over."""
    span = round(SHOWN_S * 1e9 / segment.layout.clock_ns)
    strip = Strip(segment, signals, span)
    tap = SignalTap(segment, signals)
    lost = 0
    for written in tap.take():
        strip.add(written)
    first = segment.words[System.TICK]
    view: Lines | Plot = Lines(strip, first, round(every_s / strip.tick_s), as_json)
    terminal = console()
    with ExitStack() as stack:
        if terminal.is_terminal and not as_json:
            try:
                view = stack.enter_context(Plot(strip, span, terminal))
            except ImportError:
                print("no curves without plotext: pip install 'nasrem-rack[live]'", file=sys.stderr)
        for is_over in looks(segment, LOOK_S):
            for written in tap.take():
                strip.add(written)
                lost += written.lost
            settles = 0 if is_over else strip.settles
            view.show(segment.words[System.TICK] - settles)
    if lost:
        raise Failure(f"{lost} messages were overwritten before they could be shown")


class Capture:
    """The tick at which a condition first holds, and the signals around it."""

    def __init__(
        self,
        segment: Segment,
        signals: Sequence[Signal],
        condition: Trigger,
        before_s: float,
        after_s: float,
    ) -> None:
        tick_s = segment.layout.clock_ns * 1e-9
        self._segment = segment
        self._condition = condition
        self._before = round(before_s / tick_s)
        self._after = round(after_s / tick_s)
        self._tap = SignalTap(segment, [condition.signal, *signals])
        self._lost = 0
        self.strip = Strip(segment, signals, self._before + self._after)
        self.tick = -1  # -1: it has not held yet

    def wait(self) -> None:
        """Wait until everything around the moment is there. Raises `Failure` when the run ends
        before the moment."""
        for written in self._tap.take():
            # Written before anyone asked: it does not count, but may be around the moment.
            self.strip.add(written)
        for _ in looks(self._segment, LOOK_S):
            for written in self._tap.take():
                self._look(written)
            if self._is_complete():
                break
        if self.tick < 0:
            why = "was interrupted" if INTERRUPT.number else "the run is over"
            raise Failure(f"rack '{self._segment.rack}': the condition has not held; {why}")

    def _look(self, written: Written) -> None:
        self._lost += written.lost
        self.strip.add(written)
        if self.tick < 0 and written.mailbox == self._condition.signal.mailbox:
            held = written.ticks[self._condition.holds(written.messages)]
            if len(held):
                self.tick = int(held[0])

    def _is_complete(self) -> bool:
        last = self.tick + self._after + self.strip.settles
        return self.tick >= 0 and self._segment.words[System.TICK] > last

    def save(self, path: Path) -> int:
        """Write the CSV file; return its number of rows. Raises `Failure` when messages are
        missing."""
        rows = self.strip.table(self.tick - self._before, self.tick + self._after)
        try:
            with path.open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                heads = (signal.head for signal in self.strip.signals)
                writer.writerow(["time, s", "tick", *heads])
                writer.writerows(
                    [self.strip.time_s(tick), tick, *map(cell, values)] for tick, values in rows
                )
        except OSError as error:
            raise Failure(f"{path}: {error.strerror}: cut off") from None
        if self._lost:
            raise Failure(f"{path}: {self._lost} messages were overwritten before they were taken")
        return len(rows)
