"""`rack watch`: plot live signals, or capture a window around a trigger."""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from rack.backplane.segment import Segment
from rack.boards.faults.config import parse_seconds
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, argument, option
from rack.tools.console.tables import create_console
from rack.tools.monitor.polling import poll_run
from rack.tools.monitor.signals import (
    SignalHistory,
    SignalRows,
    build_printer,
    format_value,
    show_plot,
)
from rack.tools.plots.terminal import NO_CURVES
from rack.tools.recording.signal import Signal, Trigger

READ_INTERVAL_S = 0.02
"""Time between two readings of the rings.

The rings hold 2 s, and a quarter of that in a fast lockstep run.
"""
PLOT_SPAN_S = 10.0
"""Simulated time that a plot covers."""
MAX_CAPTURE_S = 600.0
"""Longest time that can be captured before or after a trigger, because all of it is in memory."""


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
        "--every TIME", "simulated time between two lines; 0s for a line per message", "0.1s"
    ),
    as_json: Json = False,
) -> None:
    """Show signals of a running rack until its run is over, or until Ctrl-C.

    A signal is a field of a mailbox ('rack mailbox RACK' lists the mailboxes), or one number of a
    field. On a terminal it is plotted, if plotext is installed (pip install 'nasrem-rack[live]').
    Otherwise each line has the time in s and the values; with --json each line is a document.

    With --when the command waits until a condition holds, and saves every message in a window
    around that tick. Watching reads the same rings as the recorder, and causes no missed deadlines.

    Exit status: 0 shown, or saved without a gap; 1 there is no such rack, messages were lost, or
    the run ended before the condition held; 2 usage.

    \b
    Examples:
      rack watch nasrem "servo.status.position[2]" "servo.status.torque[2]"
      rack watch nasrem servo.status.position --every 0s --json
      rack watch nasrem servo.status.torque --when "servo.status.position[2] > -2.5" --before 0.5s
    """
    before_s, after_s, every_s = (
        _parse_seconds("--before", before),
        _parse_seconds("--after", after),
        _parse_seconds("--every", every),
    )
    if out is not None and when is None:
        raise Failure("--out needs --when; give both, or neither", 2)
    segment = Segment.attach(rack)
    boxes = segment.layout.mailboxes
    shown_signals = [Signal.parse(name, boxes) for name in signals]
    if when is None:
        _show_signals(segment, shown_signals, every_s, as_json)
        return
    check_writable(out or Path(f"{rack}.csv"))
    trigger = Trigger.parse(when, boxes)
    ticks_before, ticks_after = map(segment.layout.to_ticks, (before_s, after_s))
    strip = SignalHistory(segment, shown_signals, ticks_before + ticks_after, [trigger.signal])
    tick = await_trigger(segment, strip, trigger, ticks_after)
    path = out or Path(f"{rack}-{tick}.csv")
    rows = strip.list_rows(tick - ticks_before, tick + ticks_after)
    _save_csv(path, strip, rows)
    time_s = strip.to_time_s(tick)
    print_answer(
        {"file": str(path), "tick": tick, "time_s": time_s, "rows": len(rows)},
        f"{when}: held first at {time_s:g} s, tick {tick}; {len(rows)} rows around it: {path}",
        as_json,
    )


def _parse_seconds(option: str, text: str) -> float:
    """Parse the time of an option in s. Raises `Failure`."""
    seconds = -1.0
    with suppress(ValueError):
        seconds = parse_seconds(text)
    if not 0.0 <= seconds <= MAX_CAPTURE_S:
        why = f"must be a time, as in 0.5s or 20ms, of at most {MAX_CAPTURE_S:g}s"
        raise Failure(f"{option} {text}: {why}", 2)
    return seconds


def check_writable(path: Path) -> None:
    """Raise `OSError` if a file cannot be written.

    Call this before the capture. Otherwise the captured messages could be lost.
    """
    is_new = not path.exists()
    with path.open("a"):
        pass
    if is_new:
        path.unlink()


def _show_signals(
    segment: Segment, signals: Sequence[Signal], every_s: float, as_json: bool
) -> None:
    """Show signals until the run is over."""
    span = segment.layout.to_ticks(PLOT_SPAN_S)
    strip = SignalHistory(segment, signals, span)
    first = segment.tick
    show_until = build_printer(strip, first, round(every_s / strip.tick_s), as_json)
    terminal = create_console()
    with ExitStack() as stack:
        if terminal.is_terminal and not as_json:
            if find_spec("plotext") is None:
                print(NO_CURVES, file=sys.stderr)
            else:
                from rich.live import Live

                live = Live(console=terminal, auto_refresh=False, vertical_overflow="crop")
                show_until = partial(show_plot, strip, span, stack.enter_context(live))
        for is_over in poll_run(segment, READ_INTERVAL_S):
            strip.read_new()
            settles = 0 if is_over else strip.settling_ticks
            show_until(segment.tick - settles)
    if strip.lost:
        raise Failure(f"{strip.lost} messages were overwritten before they could be shown")


def await_trigger(segment: Segment, history: SignalHistory, trigger: Trigger, after: int) -> int:
    """Wait until a condition holds, and then for `after` more ticks.

    Args:
        segment: The rack.
        history: History of the signals, which this function updates.
        trigger: The condition.
        after: Number of ticks to wait for afterwards.

    Returns:
        The first tick at which the condition held.

    Raises:
        Failure: The run ended, or the user interrupted it, before the condition held.
    """
    tick = -1
    for _ in poll_run(segment, READ_INTERVAL_S):
        rows = history.read_new()[trigger.signal.mailbox]
        if tick < 0:
            holding_ticks = rows["tick"][trigger.evaluate_messages(rows["message"])]
            tick = next(iter(holding_ticks.tolist()), -1)
        if tick >= 0 and segment.tick > tick + after + history.settling_ticks:
            break
    if tick < 0:
        why = "was interrupted" if INTERRUPT.number else "the run is over"
        raise Failure(f"rack '{segment.rack}': the condition has not held; {why}")
    return tick


def _save_csv(path: Path, history: SignalHistory, rows: SignalRows) -> None:
    """Write the captured values as CSV. Raises `Failure` if messages were lost."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time, s", "tick", *(signal.heading for signal in history.signals)])
            writer.writerows(
                [history.to_time_s(tick), tick, *map(format_value, row)] for tick, row in rows
            )
    except OSError as error:
        raise Failure(f"{path}: {error.strerror}: cut off") from None
    if history.lost:
        raise Failure(f"{path}: {history.lost} messages were overwritten before they were taken")
