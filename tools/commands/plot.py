"""`rack plot`: plot signals of a run or of a running rack, with marks of what happened."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.util import find_spec
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rack.backplane.json_text import encode_json
from rack.backplane.layout import MailboxSpec
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.crate.alarm_events import AlarmReader
from rack.tools.commands.record import save_run
from rack.tools.commands.status import find_run_folder
from rack.tools.commands.watch import await_trigger, check_writable, parse_span_s
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, argument, option
from rack.tools.console.pictures import NO_PICTURES, PICTURE_FORMATS, can_draw
from rack.tools.console.tables import create_console
from rack.tools.monitor.holds import find_holds
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.signals import SignalHistory
from rack.tools.plots.curves import MAX_CURVES, Plot, Series, build_panels, require_number
from rack.tools.plots.marks import Mark, list_event_marks, list_recorded_marks
from rack.tools.plots.terminal import (
    NO_CURVES,
    PLAIN_HEIGHT,
    TerminalSize,
    draw_plot,
    measure_terminal,
)
from rack.tools.recording.divergence import find_other_run, find_tick_range
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, Trigger

PLAIN_WIDTH = 80
"""Width of a plot if stdout is not a terminal."""
LATEST_S = 1e9


@dataclass(frozen=True)
class PlotRequest:
    """What the user wants to see.

    Attributes:
        signals: Names of the signals.
        against: Folder of the run to compare with, or None.
        from_s: Beginning of the window, or None.
        to_s: End of the window, or None.
        when: Condition around which to plot, or None.
        before_s: Time to plot before the condition held.
        after_s: Time to plot after the condition held.
    """

    signals: Sequence[str]
    against: Path | None
    from_s: float | None
    to_s: float | None
    when: str | None
    before_s: float
    after_s: float

    def parse_signals(self, boxes: Sequence[MailboxSpec]) -> list[Signal]:
        """Return the signals. Raises `Failure` for an unknown name, a text, or too many numbers."""
        signals = [Signal.parse(name, boxes) for name in self.signals]
        for signal in signals:
            require_number(signal)
        counts = [prod(signal.shape[len(signal.index) :]) for signal in signals]
        if sum(counts) > MAX_CURVES:
            largest = signals[int(np.argmax(counts))]
            single = f"{largest.name}{'[0]' * (len(largest.shape) - len(largest.index))}"
            why = f"has {max(counts)} numbers; a plot has at most {MAX_CURVES} curves"
            raise Failure(f"{largest.name}: {why}; choose single ones, as in {single}", 2)
        return signals

    def choose_window(self, begins_s: float, ends_s: float) -> tuple[float, float]:
        """Return the window within the given time. Raises `Failure` if it is outside or empty."""
        from_s = begins_s if self.from_s is None else self.from_s
        to_s = ends_s if self.to_s is None else self.to_s
        for name, time_s in (("--from", from_s), ("--to", to_s)):
            if not begins_s <= time_s <= ends_s:
                raise Failure(f"{name} {time_s:g}: must be {begins_s:g} to {ends_s:g} s", 2)
        if from_s >= to_s:
            why = "the window is empty; --from must be before --to"
            raise Failure(f"--from {from_s:g} --to {to_s:g}: {why}", 2)
        return from_s, to_s


def plot(
    subject: str = argument(
        "RUN|RACK", "folder of a run, as in runs/nasrem-20250101-120000, or a running rack by name"
    ),
    signals: list[str] = argument("SIGNAL...", "as in servo.status.position[2], or a whole field"),
    against: Path | None = option(
        "--against RUN",
        "also plot another run, dashed, or 'origin' for the run that RUN continues",
    ),
    from_s: float | None = option("--from S", "start of the window, s", min=0.0, max=LATEST_S),
    to_s: float | None = option("--to S", "end of the window, s", min=0.0, max=LATEST_S),
    when: str | None = option(
        "--when CONDITION",
        'plot around the first tick at which this holds, as in "servo.status.position[2] > 1.2"',
    ),
    before: str = option("--before TIME", "with --when: simulated time to plot before it", "0.5s"),
    after: str = option("--after TIME", "with --when: simulated time to plot after it", "1s"),
    out: Path | None = option(
        "--out FILE", "save a picture, FILE.png or FILE.svg, and do not plot on the terminal"
    ),
    as_json: Json = False,
) -> None:
    """Plot signals over simulated time, with marks of what happened.

    A signal is a field of a mailbox (the tables in RUN/signals have a column for each field), or
    one number of a field. Signals of the same unit share a panel. Faults, detections, missed
    cycles, holds, lost boards and restarts are marked. Times are simulated seconds.

    Of a running rack the recording so far is plotted. If it is not recorded, up to 2 s are plotted,
    which its mailboxes still hold; with --when the command waits until the condition holds.

    On the terminal this needs plotext (pip install 'nasrem-rack[live]'), with --out matplotlib
    (pip install 'nasrem-rack[charts]'). With --json the plotted values and marks are printed.

    \b
    Examples:
      rack plot runs/nasrem-20250101-120000 servo.status.position
      rack plot runs/nasrem-20250101-120000 servo.status.torque task.status.state --out torque.png
      rack plot runs/slower "servo.status.position[2]" --against origin --from 4 --to 5
      rack plot nasrem servo.status.torque --when "servo.status.position[2] > -2.5"
    """
    spans_s = parse_span_s("--before", before), parse_span_s("--after", after)
    request = PlotRequest(signals, against, from_s, to_s, when, *spans_s)
    if out is not None:
        _check_picture(out)
    elif not as_json and find_spec("plotext") is None:
        raise Failure(f"{NO_CURVES}; --out FILE.png draws a picture")
    if "/" in subject or Path(subject).is_dir():
        drawn = _plot_recording(Recording(Path(subject)), subject, request)
    else:
        drawn = _plot_rack(subject, request)
    if out is not None:
        # Import late, because matplotlib takes a second.
        from rack.tools.plots.figure import save_plot

        save_plot(drawn, out)
    if as_json:
        # On one line, because there may be thousands of values.
        print(encode_json({**drawn.to_document(), "picture": out and str(out)}))
    elif out is not None:
        print(f"picture: {out}")
    else:
        _print_plot(drawn)


def _check_picture(path: Path) -> None:
    """Raise `Failure` or `OSError` if a picture cannot be written."""
    if path.suffix[1:] not in PICTURE_FORMATS:
        raise Failure(f"--out {path}: the name of a picture must end in .png or .svg", 2)
    if not can_draw():
        raise Failure(NO_PICTURES)
    check_writable(path)


def _plot_recording(recording: Recording, title: str, request: PlotRequest) -> Plot:
    """Return the plot of a recorded run. Raises `Failure`."""
    tick_s = recording.layout.clock_ns * 1e-9
    boxes = recording.layout.mailboxes
    signals = request.parse_signals(boxes)
    trigger = None if request.when is None else Trigger.parse(request.when, boxes)
    name, others = "", list[Series]()
    begins_s, ends_s = (tick * tick_s for tick in find_tick_range(recording))
    if request.against is not None:
        other = find_other_run(recording.folder, request.against)
        name = Path(title).resolve().name
        others = _read_other_run(other, request)
        begins_s = min(begins_s, *(float(series.time_s[0]) for series in others))
        ends_s = max(ends_s, *(float(series.time_s[-1]) for series in others))
    all_series = [Series.read(recording, signal, name) for signal in signals]
    marks = list_recorded_marks(recording)
    window_s = request.choose_window(begins_s, ends_s)
    if trigger is not None:
        held_s = _find_trigger_s(recording, trigger, window_s)
        marks.append(Mark(held_s, "trigger", str(request.when)))
        window_s = max(held_s - request.before_s, begins_s), min(held_s + request.after_s, ends_s)
    if recording.kept_text:
        print(recording.kept_text, file=sys.stderr)
    return _build_plot(title, all_series, others, marks, window_s)


def _read_other_run(folder: Path, request: PlotRequest) -> list[Series]:
    """Return the signals of the run to compare with. Raises `Failure`."""
    recording = Recording(folder)
    try:
        signals = request.parse_signals(recording.layout.mailboxes)
        return [Series.read(recording, signal, folder.resolve().name, True) for signal in signals]
    except Failure as failure:
        raise Failure(f"--against {folder}: {failure}", 2) from None


def _find_trigger_s(recording: Recording, trigger: Trigger, window_s: tuple[float, float]) -> float:
    """Return the first time in a window at which a condition holds. Raises `Failure`."""
    series = Series.read(recording, trigger.signal)
    from_s, to_s = window_s
    is_inside = (series.time_s >= from_s) & (series.time_s <= to_s)
    times_s = series.time_s[trigger.evaluate_values(series.values) & is_inside]
    if not len(times_s):
        raise Failure(f"the condition does not hold from {from_s:g} to {to_s:g} s")
    return float(times_s[0])


def _plot_rack(name: str, request: PlotRequest) -> Plot:
    """Return the plot of a running rack: of its recording so far, or of its rings."""
    with closing(Segment.attach(name)) as segment:
        run = find_run_folder(segment)
        if run is None or request.when is not None:
            return _plot_rings(segment, request)
        with INTERRUPT.raise_interrupted(), TemporaryDirectory(prefix="rack-plot-") as folder:
            save_run(run, Path(folder))
            return _plot_recording(Recording(Path(folder)), name, request)


def _plot_rings(segment: Segment, request: PlotRequest) -> Plot:
    """Return the plot of what the mailboxes of a rack still hold, or of a captured window."""
    boxes = segment.layout.mailboxes
    signals = request.parse_signals(boxes)
    tick_s = segment.layout.clock_ns * 1e-9
    others = [] if request.against is None else _read_other_run(request.against, request)
    alarms = AlarmReader(segment)
    marks = []
    if request.when is None:
        history = SignalHistory(segment, signals, 0)
        last = segment.words[System.TICK]
        all_series = history.build_series(last)
        firsts_s = [float(series.time_s[0]) for series in all_series if len(series.time_s)]
        window_s = request.choose_window(min(firsts_s, default=0.0), (last + 1) * tick_s)
    else:
        trigger = Trigger.parse(request.when, boxes)
        before, after = (round(span_s / tick_s) for span_s in (request.before_s, request.after_s))
        history = SignalHistory(segment, signals, before + after, [trigger.signal])
        tick = await_trigger(segment, history, trigger, after)
        all_series = history.build_series(tick + after)
        marks.append(Mark(tick * tick_s, "trigger", request.when))
        window_s = max(tick - before, 0) * tick_s, (tick + after) * tick_s
    if others:
        all_series = [series._replace(run=segment.rack) for series in all_series]
    marks += list_event_marks((alarm.event for alarm in alarms.read_alarms()), tick_s)
    marks += [
        Mark(hold.since_s, "hold", f"{hold.level}: {hold.why}")
        for hold in find_holds(NewestMessages(segment))
    ]
    return _build_plot(segment.rack, all_series, others, marks, window_s)


def _build_plot(
    title: str,
    all_series: Sequence[Series],
    others: Sequence[Series],
    marks: Sequence[Mark],
    window_s: tuple[float, float],
) -> Plot:
    """Return the plot of a window, with a mark at the first difference from the other run.

    Args:
        title: Title of the plot.
        all_series: The signals.
        others: The same signals of the other run. Empty if there is none.
        marks: Marks of the run.
        window_s: The window.

    Raises:
        Failure: A signal has no message in the window, or before it.
    """
    if others:
        differences = [
            Mark(time_s, "first difference", series.signal.name)
            for series, other in zip(all_series, others, strict=True)
            if (time_s := series.find_first_difference_s(other)) is not None
        ]
        marks = [*marks, *sorted(differences)[:1]]
        if not differences:
            print("both runs are equal, in these signals and in the time of both", file=sys.stderr)
    from_s, to_s = window_s
    cut = [series.cut(from_s, to_s) for series in (*all_series, *others)]
    for series in cut:
        if not len(series.time_s):
            why = f"no message from {from_s:g} to {to_s:g} s, and none before"
            raise Failure(f"{series.signal.name}: {why}", 2)
    shown = [m for m in marks if m.time_s <= to_s and m.find_end_s(to_s) >= from_s]
    return Plot(title, cut, sorted(shown, key=lambda mark: mark.time_s), window_s)


def _print_plot(drawn: Plot) -> None:
    """Print a plot on the terminal, or as plain text of 80 columns."""
    panels = build_panels(drawn.series)
    console = create_console(PLAIN_WIDTH)
    # Leave lines free for the prompt.
    size = measure_terminal(console, margin=3)
    if not console.is_terminal:
        size = TerminalSize(PLAIN_WIDTH, PLAIN_HEIGHT * len(panels) + len(drawn.marks), False)
    console.print(draw_plot(panels, drawn.marks, drawn.window_s, size))
