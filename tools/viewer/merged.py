"""Recorded runs of several racks as one recording for the viewer: each below its name, all on one
time line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackPlace
from rack.tools.viewer.blueprint import RackViews, blueprint, together
from rack.tools.viewer.sink import RackWriter, Ran, block_of
from rack.tools.viewer.stream import Stream, Timelines, new_recording


def write_merged(
    placed: Sequence[RackPlace], file: Path, show: Callable[[float], None] = lambda part: None
) -> None:
    """Write one recording of all these racks; `show` gets the part that is done, 0 to 1.

    The notes on the times of racks are in its log. Of a single rack it is that rack's run.rrd.
    Raises `Failure` for a recording that cannot be read, and `RuntimeError` when the file cannot be
    written.
    """
    ran = {}
    for place in placed:
        run = place.own.recording
        ran[place.own.rack] = Ran.of(run.whole_layout, run.config, run.folder)
    name = ", ".join(ran)
    roots: dict[str, tuple[str, ...]] = {rack: (rack,) if len(ran) > 1 else () for rack in ran}
    views = {
        rack: RackViews(of.layout, of.config, of.cell, roots[rack]) for rack, of in ran.items()
    }
    view = blueprint(together(views) if len(views) > 1 else views[name].everything())
    launches = "-".join(str(place.own.launch.created_ns) for place in placed)
    recording = new_recording(name, f"{name}-{launches}", file, view)
    log = Stream(recording, Timelines(placed[0].own.clock_ns, placed[0].own.launch))
    for place in placed[1:]:
        log.say(0, place.line.epoch_ns, "time line", place.note, "INFO")
    for at, place in enumerate(placed):
        times = Timelines(place.own.clock_ns, place.own.launch, place)
        stream = Stream(recording, times, roots[place.own.rack])
        writer = RackWriter(stream, ran[place.own.rack])
        last = place.own.ticks[1] + 1
        for tick, taken in _blocks(place.own.recording, last, block_of(place.own.recording.layout)):
            writer.write(taken, tick, place.own.recording.lost if tick >= last else {})
            stream.flush()
            show((at + min(1.0, tick / last)) / len(placed))
    recording.disconnect()


def _blocks(
    recording: Recording, last: int, block: int
) -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
    """Yield the rows of all rings, by ring, up to a tick, and that tick, block by block."""
    layout = recording.whole_layout
    names = [*(task.name for task in layout.tasks), *(box.name for box in layout.timed)]
    rings = {name: rows for name in names if len(rows := _rows(recording, name))}
    done = dict.fromkeys(rings, 0)
    for begin in range(0, last, block):
        tick = min(last, begin + block)
        # The last block has all that is left: what clock and operator wrote after the last cycle,
        # too.
        ends = {
            name: int(np.searchsorted(rows["tick"], tick)) if tick < last else len(rows)
            for name, rows in rings.items()
        }
        yield (
            tick,
            {name: rings[name][done[name] : end] for name, end in ends.items() if end > done[name]},
        )
        done = ends


def _rows(recording: Recording, name: str) -> np.ndarray:
    is_there = name in recording.cycles or name in recording.mailboxes
    return recording.rows(name) if is_there else np.empty(0)
