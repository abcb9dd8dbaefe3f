"""`rack watch`: signals of a running rack, live, or what was around a moment."""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.faults.config import as_seconds
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, argument, option
from rack.tools.console.tables import console
from rack.tools.monitor.polling import looks
from rack.tools.monitor.signals import Lines, Plot, Rows, Strip, cell
from rack.tools.recording.signal import Signal, Trigger

LOOK_S = 0.02
"""Time between looks: rings hold 2 s, in a fast lockstep a quarter of that."""
SHOWN_S = 10.0
"""Simulated time that a plot shows."""
MOST_S = 600.0
"""Longest time kept before or after a moment: all of it is in memory."""


def watch(
    rack: RackName,
    signals: list[str] = argument("SIGNAL...", "as in servo.status.position[2], or a whole field"),
    when: str | None = option(
        "--when CONDITION", 'wait until this holds, as in "servo.status.position[2] > 1.2"'
    ),
    before: str = option("--before TIME", "with --when: simulated time to save before it", "0.5s"),
    after: str = option("--after TIME", "with --when: simulated time to save after it", "1s"),
    out: Path | None = option("--out FILE", "with --when: CSV file; default: RACK-TICK.csv"),
    every: str = option(
        "--every TIME", "simulated time between two lines; 0s: a line a message", "0.1s"
    ),
    as_json: Json = False,
) -> None:
    r"""Show signals of a running rack until its run is over, or until Ctrl-C.

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
    trigger = Trigger.of(when, boxes)
    ticks_before, ticks_after = (
        round(s * 1e9 / segment.layout.clock_ns) for s in (before_s, after_s)
    )
    strip = Strip(segment, shown, ticks_before + ticks_after, [trigger.signal])
    tick = _await_moment(segment, strip, trigger, ticks_after)
    path = out or Path(f"{rack}-{tick}.csv")
    rows = strip.table(tick - ticks_before, tick + ticks_after)
    _save(path, strip, rows)
    time_s = strip.time_s(tick)
    print_answer(
        {"file": str(path), "tick": tick, "time_s": time_s, "rows": len(rows)},
        f"{when}: held first at {time_s:g} s, tick {tick}; {len(rows)} rows around it: {path}",
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
            strip.take()
            settles = 0 if is_over else strip.settles
            view.show(segment.words[System.TICK] - settles)
    if strip.lost:
        raise Failure(f"{strip.lost} messages were overwritten before they could be shown")


def _await_moment(segment: Segment, strip: Strip, trigger: Trigger, after: int) -> int:
    """Return the tick at which a condition first holds, once the `after` ticks behind it are there.
    Raises `Failure` when the run ends before.
    """
    tick = -1
    for _ in looks(segment, LOOK_S):
        for written in strip.take():
            if tick < 0 and written.mailbox == trigger.signal.mailbox:
                held = written.ticks[trigger.holds(written.messages)]
                tick = int(held[0]) if len(held) else -1
        if tick >= 0 and segment.words[System.TICK] > tick + after + strip.settles:
            break
    if tick < 0:
        why = "was interrupted" if INTERRUPT.number else "the run is over"
        raise Failure(f"rack '{segment.rack}': the condition has not held; {why}")
    return tick


def _save(path: Path, strip: Strip, rows: Rows) -> None:
    """Write the CSV file. Raises `Failure` when messages are missing."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time, s", "tick", *(signal.head for signal in strip.signals)])
            writer.writerows([strip.time_s(tick), tick, *map(cell, row)] for tick, row in rows)
    except OSError as error:
        raise Failure(f"{path}: {error.strerror}: cut off") from None
    if strip.lost:
        raise Failure(f"{path}: {strip.lost} messages were overwritten before they were taken")
