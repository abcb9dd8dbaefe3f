"""The viewer's log contains the events of the run, but not the waits of its launch."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path

import rerun.blueprint as rrb

from rack.backplane.segment import Launch
from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.events import Event
from rack.tools.recording.checksums import format_checked_line
from rack.tools.viewer.events import EventWriter
from rack.tools.viewer.levels import Hierarchy
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.stream import Stream, Timelines, open_recording


def test_waits_of_a_launch_are_not_in_the_log(tmp_path: Path) -> None:
    config = load("fig2")
    layout = resolve_layout(config)
    times = Timelines(layout.clock_ns, Launch(time.time_ns(), 0))
    stream = Stream(open_recording("events", "run", tmp_path / "run.rrd", rrb.Blueprint()), times)
    texts = {"preloading 'a:B'": -1, "preloading 'a:C'": -1, "rack 'x' is awaited": 4}
    events = [Event(time.time_ns(), at, "waiting", "", text) for text, at in texts.items()]
    (tmp_path / "events.jsonl").write_text("".join(format_checked_line(asdict(e)) for e in events))
    hierarchy = Hierarchy(stream, layout, build_rack_timing(config, layout))
    EventWriter(stream, tmp_path / "events.jsonl", hierarchy, None).write_new_events()
    stream.flush()
    stream.close()
    log = read_component(tmp_path / "run.rrd", "/log/events", "TextLog:text")
    assert log.values.ravel().tolist() == ["waiting: rack: rack 'x' is awaited"]
