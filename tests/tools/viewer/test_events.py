"""The viewer's log contains the events of the run in the order of their ticks."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path

from rack.boards.config import load, resolve_layout
from rack.boards.events import Event, EventKind
from rack.tools.recording.checksums import format_checked_line
from rack.tools.viewer.events import EventWriter
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import Moment
from tests.tools.viewer.streams import open_stream


def write_log(
    folder: Path, events: list[Event], blocks: list[float]
) -> tuple[list[str], list[tuple[int, str]]]:
    """Write events in blocks that end at these ticks.

    Returns:
        The lines in the viewer's order, and each loss as its tick and the task.
    """
    layout, path = resolve_layout(load("fig2")), folder / "events.jsonl"
    path.write_text("".join(format_checked_line(asdict(event)) for event in events))
    lost: list[tuple[int, str]] = []

    def add_loss(when: Moment, task: str) -> None:
        lost.append((when.tick, task))

    with open_stream(folder / "run.rrd", layout.clock_ns, time.time_ns()) as opened:
        lanes = {"servo": "1-servo"}
        writer = EventWriter(opened.stream, path, layout, lanes, add_loss, None)
        for tick in blocks:
            writer.write_events(tick)
    log = read_component(folder / "run.rrd", "/log/events", "TextLog:text")
    return [str(line) for line in log.values.ravel()], lost


def test_waits_of_a_launch_are_not_in_the_log(tmp_path: Path) -> None:
    texts = {"preloading 'a:B'": -1, "preloading 'a:C'": -1, "rack 'x' is awaited": 4}
    events = [Event(time.time_ns(), at, "waiting", "", text) for text, at in texts.items()]
    lines, _ = write_log(tmp_path, events, [math.inf])
    assert lines == ["tick 4: waiting: rack: rack 'x' is awaited"]


def test_the_log_tells_causes_before_effects_although_they_are_reported_late(
    tmp_path: Path,
) -> None:
    reported: list[tuple[int, EventKind, str, str]] = [
        (2800, "reaction", "restart", "restart 1"),
        (2800, "fault", "ends", "kill ends"),
        (2800, "died", "died", "ended"),
        (2800, "fault", "begins", "kill begins"),
        (3000, "recovery", "rejoined", "rejoined"),
        (2801, "reaction", "brakes_closed", "brakes engaged"),
        (3000, "recovery", "brakes_opened", "brakes released"),
        (3400, "end", "", "time over"),
    ]
    events = [
        Event(time.time_ns(), tick, kind, "servo", text, code)
        for tick, kind, code, text in reported
    ]
    lines, lost = write_log(tmp_path, events, [2900, 3300, math.inf])
    assert lost == [(2800, "servo")]
    assert lines == [
        "tick 2800: fault: servo: kill begins",
        "tick 2800: died: servo: ended",
        "tick 2800: reaction: servo: restart 1",
        "tick 2800: fault: servo: kill ends",
        "tick 2801: reaction: servo: brakes engaged",
        "tick 3000: recovery: servo: rejoined",
        "tick 3000: recovery: servo: brakes released",
        "tick 3400: end: servo: time over",
    ]
