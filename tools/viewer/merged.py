"""Writes recorded runs of several racks as one recording for the viewer, on one time line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import RackAlignment
from rack.tools.viewer.blueprint import (
    RackViews,
    build_blueprint,
    build_common_view,
)
from rack.tools.viewer.sink import RackWriter, RunContext, compute_block_ticks
from rack.tools.viewer.stream import Moment, Stream, Timelines, open_recording


def write_merged(
    placed: Sequence[RackAlignment], file: Path, show_progress: Callable[[float], None]
) -> None:
    """Write one viewer recording that shows all of these racks, each under its name.

    The log of the recording contains the notes on how the times of the racks were aligned. For a
    single rack, the recording is equal to the run.rrd of the run.

    Args:
        placed: The racks and the conversions of their times to the common time line.
        file: File to write.
        show_progress: Called with the completed fraction, 0 to 1.

    Raises:
        Failure: A recording cannot be read.
        RuntimeError: The file cannot be written.
    """
    ran = {}
    roots: dict[str, tuple[str, ...]] = {}
    views = {}
    for place in placed:
        run = place.grid.recording
        rack = place.grid.rack
        ran[rack] = of = RunContext.from_config(run.layout, run.config, run.folder)
        roots[rack] = (rack,) if len(placed) > 1 else ()
        views[rack] = RackViews(of.layout, of.config, of.cell, roots[rack])
    name = ", ".join(ran)
    if len(placed) == 1:
        root = views[name].build_all_views()
    else:
        root = build_common_view(views, "runs" if placed[0].is_tick_aligned else "racks")
    launches = "-".join(str(place.grid.launch.created_ns) for place in placed)
    recording = open_recording(name, f"{name}-{launches}", file, build_blueprint(root))
    first = placed[0].grid
    log = Stream(recording, Timelines(first.clock_ns, first.launch))
    for place in placed:
        for tick, text in place.marks:
            stamp_ns = int(first.convert_ticks(np.array([tick]))[0])
            log.log_line(Moment(tick, stamp_ns), "time line", text, "INFO")
    for index, place in enumerate(placed):
        grid = place.grid
        stream = Stream(recording, Timelines(grid.clock_ns, grid.launch, place), roots[grid.rack])
        writer = RackWriter(stream, ran[grid.rack])
        last = grid.ticks[1] + 1
        if kept_text := grid.recording.kept_text:
            stream.log_line(Moment(0, grid.epoch_ns), "recorder", f"recorder: {kept_text}", "WARN")
        for tick, rows in _split_blocks(
            grid.recording, last, compute_block_ticks(grid.recording.layout)
        ):
            if kept_text and not rows:
                writer.skip_to(tick)
                continue
            lost = grid.recording.lost_rows if tick == last else {}
            writer.write(rows, tick, lost)
            stream.flush()
            show_progress((index + tick / last) / len(placed))
        writer.write_last_events()
    recording.disconnect()


def _split_blocks(
    recording: Recording, last: int, block: int
) -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
    """Yield the rows of all rings of a recording in blocks.

    Args:
        recording: The recording.
        last: Tick after the last recorded tick.
        block: Number of ticks in a block.

    Yields:
        The tick at which the block ends, and a dictionary from task or mailbox to its rows.
    """
    layout = recording.layout
    names = [*(task.name for task in layout.tasks), *(box.name for box in layout.timed)]
    recorded = {*recording.cycles, *recording.mailboxes}
    rings = {name: recording.read_rows(name) for name in names if name in recorded}
    borders = list(range(block, last, block))
    # The last block contains all remaining rows, including messages that the clock and operators
    # wrote after the last cycle.
    pieces = {
        name: np.split(rows, np.searchsorted(rows["tick"], borders)) for name, rows in rings.items()
    }
    for index, tick in enumerate((*borders, last)):
        yield tick, {name: rows[index] for name, rows in pieces.items() if len(rows[index])}
