"""Recorded runs of several racks as one recording for the viewer: each below its name, all on one
time line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackPlace
from rack.tools.viewer.blueprint import RackViews, blueprint, side_by_side, together
from rack.tools.viewer.sink import RackWriter, Ran, block_of
from rack.tools.viewer.stream import Moment, Stream, Timelines, new_recording


def write_merged(placed: Sequence[RackPlace], file: Path, show: Callable[[float], None]) -> None:
    """Write one recording of all these racks; `show` gets the part that is done, 0 to 1.

    The notes on the times of racks are in its log. Of a single rack it is that rack's run.rrd.
    Raises `Failure` for a recording that cannot be read, and `RuntimeError` when the file cannot be
    written.
    """
    ran = {}
    roots: dict[str, tuple[str, ...]] = {}
    views = {}
    for place in placed:
        run = place.own.recording
        rack = place.own.rack
        ran[rack] = of = Ran.of(run.layout, run.config, run.folder)
        roots[rack] = (rack,) if len(placed) > 1 else ()
        views[rack] = RackViews(of.layout, of.config, of.cell, roots[rack])
    name = ", ".join(ran)
    if placed[0].by_ticks:
        root = side_by_side(views)
    else:
        root = together(views) if len(placed) > 1 else views[name].everything()
    launches = "-".join(str(place.own.launch.created_ns) for place in placed)
    recording = new_recording(name, f"{name}-{launches}", file, blueprint(root))
    first = placed[0].own
    log = Stream(recording, Timelines(first.clock_ns, first.launch))
    for place in placed:
        for tick, text in place.marks:
            stamp_ns = int(first.stamp_ns(np.array([tick]))[0])
            log.say(Moment(tick, stamp_ns), "time line", text, "INFO")
    for at, place in enumerate(placed):
        own = place.own
        stream = Stream(recording, Timelines(own.clock_ns, own.launch, place), roots[own.rack])
        writer = RackWriter(stream, ran[own.rack])
        last = own.ticks[1] + 1
        if kept := own.recording.kept_text:
            stream.say(Moment(0, own.epoch_ns), "recorder", f"recorder: {kept}", "WARN")
        for tick, taken in _blocks(own.recording, last, block_of(own.recording.layout)):
            if kept and not taken:
                writer.skip(tick)
                continue
            lost = own.recording.lost if tick == last else {}
            writer.write(taken, tick, lost)
            stream.flush()
            show((at + tick / last) / len(placed))
    recording.disconnect()


def _blocks(
    recording: Recording, last: int, block: int
) -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
    """Yield the rows of all rings, by ring, up to a tick, and that tick, block by block."""
    layout = recording.layout
    names = [*(task.name for task in layout.tasks), *(box.name for box in layout.timed)]
    recorded = {*recording.cycles, *recording.mailboxes}
    rings = {name: recording.rows(name) for name in names if name in recorded}
    borders = list(range(block, last, block))
    # The last block has all that is left: what clock and operator wrote after the last cycle, too.
    pieces = {
        name: np.split(rows, np.searchsorted(rows["tick"], borders)) for name, rows in rings.items()
    }
    for at, tick in enumerate((*borders, last)):
        yield tick, {name: rows[at] for name, rows in pieces.items() if len(rows[at])}
