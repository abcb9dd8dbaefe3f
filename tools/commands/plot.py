"""`rack plot`: plot signals of a run or of a running rack, with marks of what happened."""

from __future__ import annotations

from contextlib import ExitStack, closing
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from rack.backplane.json_text import encode_json
from rack.backplane.segment import Segment
from rack.tools.commands.record import copy_recording
from rack.tools.commands.watch import await_trigger, check_writable
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, argument, option
from rack.tools.console.pictures import check_picture_path
from rack.tools.console.tables import create_console
from rack.tools.monitor.signals import SignalHistory
from rack.tools.plots.curves import Mark, Plot, Series, list_marks, read_series
from rack.tools.plots.terminal import NO_CURVES, draw_plot
from rack.tools.recording.divergence import find_other_run, find_tick_range
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, Trigger

MAX_CURVES = 32
"""Largest number of curves of a signal."""
BEFORE_S = 0.5
AFTER_S = 1.0
PLAIN_WIDTH = 80
"""Width of a plot if stdout is not a terminal."""
PLAIN_HEIGHT = 40


def plot(
    subject: str = argument(
        "RUN|RACK", "folder of a run, as in runs/nasrem-20250101-120000, or a running rack by name"
    ),
    signals: list[str] = argument("SIGNAL...", "as in servo.status.position[2], or a whole field"),
    against: Path | None = option(
        "--against RUN", "also plot another run, or 'origin' for the run that RUN continues"
    ),
    from_s: float | None = option("--from S", "start of the window, s"),
    to_s: float | None = option("--to S", "end of the window, s"),
    when: str | None = option(
        "--when CONDITION",
        'plot from 0.5 s before to 1 s after this holds, as in "servo.status.position[2] > 1.2"',
    ),
    out: Path | None = option(
        "--out FILE", "save a picture, FILE.png or FILE.svg, and do not plot on the terminal"
    ),
    as_json: Json = False,
) -> None:
    """Plot signals over simulated time, with marks of what happened.

    A signal is a field of a mailbox (the tables in RUN/signals have a column for each field), or
    one number of a field. Signals of the same unit share a panel. Faults, detections, missed
    cycles, holds, lost boards and restarts are marked.

    Of a running rack the recording so far is plotted. With --when the command waits until the
    condition holds there.

    On the terminal this needs plotext (pip install 'nasrem-rack[live]'), with --out matplotlib
    (pip install 'nasrem-rack[charts]'). --json prints the plotted values and marks.

    \b
    Examples:
      rack plot runs/nasrem-20250101-120000 servo.status.position
      rack plot runs/nasrem-20250101-120000 servo.status.torque task.status.state --out torque.png
      rack plot runs/slower "servo.status.position[2]" --against origin --from 4 --to 5
      rack plot nasrem servo.status.torque --when "servo.status.position[2] > -2.5"
    """
    if out is not None:
        check_picture_path("--out", out)
        check_writable(out)
    elif not as_json and find_spec("plotext") is None:
        raise Failure(f"{NO_CURVES}; --out FILE.png draws a picture")
    with INTERRUPT.raise_interrupted(), ExitStack() as stack:
        folder = Path(subject)
        if "/" not in subject and not folder.is_dir():
            segment = stack.enter_context(closing(Segment.attach(subject)))
            if when is not None and from_s is None:
                trigger = Trigger.parse(when, segment.layout.mailboxes)
                tick_s = segment.layout.clock_ns * 1e-9
                after = round(AFTER_S / tick_s)
                history = SignalHistory(segment, [trigger.signal], after)
                from_s = await_trigger(segment, history, trigger, after) * tick_s
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="rack-plot-")))
            copy_recording(segment, folder)
        drawn = _build_plot(subject, folder, signals, against, when, (from_s, to_s))
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
        console = create_console(PLAIN_WIDTH)
        height = console.height - 2 if console.is_terminal else PLAIN_HEIGHT
        console.print(draw_plot(drawn, console, height))


def _build_plot(
    title: str,
    run: Path,
    signals: list[str],
    against: Path | None,
    when: str | None,
    window: tuple[float | None, float | None],
) -> Plot:
    """Return the plot of a recorded run.

    Args:
        title: Title of the plot.
        run: Folder of the run.
        signals: Names of the signals.
        against: Run to compare with, as `find_other_run` takes it, or None.
        when: Condition around which to plot, or None.
        window: Beginning and end of the window in s. None for those of the run.

    Raises:
        Failure: The run cannot be read, a name is unknown, or the window is empty.
    """
    recording = Recording(run)
    other = None if against is None else find_other_run(run, against)
    # Runs in folders of the same name are named by their paths.
    name, other_name = Path(title).name, other.name if other else ""
    if name == other_name:
        name, other_name = title, str(other)
    all_series = _read_signals(recording, signals, name if other else "")
    marks = list_marks(recording)
    tick_s = recording.layout.clock_ns * 1e-9
    begins_s, ends_s = (round(tick * tick_s, 9) for tick in find_tick_range(recording))
    if other is not None:
        others = _read_signals(Recording(other), signals, other_name)
        all_series += others
        ends_s = max(ends_s, *(float(series.time_s[-1]) for series in others))
    from_s = begins_s if window[0] is None else window[0]
    to_s = ends_s if window[1] is None else window[1]
    if not begins_s <= from_s < to_s <= ends_s:
        span = f"{begins_s:g} <= FROM < TO <= {ends_s:g} s"
        raise Failure(f"--from {from_s:g} --to {to_s:g}: must be {span}", 2)
    if when is not None:
        trigger = Trigger.parse(when, recording.layout.mailboxes)
        (watched,) = read_series(recording, trigger.signal)
        held = watched.time_s[trigger.evaluate_values(watched.values)]
        held_s = next(iter(held[(held >= from_s) & (held <= to_s)].tolist()), None)
        if held_s is None:
            raise Failure(f"{when}: does not hold from {from_s:g} to {to_s:g} s")
        marks.append(Mark(held_s, "trigger", when, held_s))
        from_s, to_s = max(held_s - BEFORE_S, begins_s), min(held_s + AFTER_S, ends_s)
    selected = [series.select_window(from_s, to_s) for series in all_series]
    if missing := [series.name for series in selected if not len(series.time_s)]:
        raise Failure(f"{missing[0]}: no message until {to_s:g} s", 2)
    shown = [mark for mark in marks if mark.time_s <= to_s and mark.until_s >= from_s]
    return Plot(title, selected, sorted(shown), (from_s, to_s))


def _read_signals(recording: Recording, names: list[str], run: str) -> list[Series]:
    """Return the signals of a run. Raises `Failure`, also if one has too many numbers."""
    all_series: list[Series] = []
    for name in names:
        series = read_series(recording, Signal.parse(name, recording.layout.mailboxes), run)
        if len(series) > MAX_CURVES:
            raise Failure(
                f"{name}: has {len(series)} numbers, too many to plot; choose some, as in"
                f" {name}[0]",
                2,
            )
        all_series += series
    return all_series
