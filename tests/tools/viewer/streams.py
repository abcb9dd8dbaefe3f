"""Files for the viewer that hold only what a part of the view writes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun.blueprint as rrb

from rack.backplane.message import Message
from rack.backplane.segment import Launch
from rack.levels.robot.cell import Cell, compute_sizes
from rack.tools.viewer.stream import RowBlock, Stream, Timelines, open_recording


class Opened(NamedTuple):
    """An open file for the viewer."""

    stream: Stream
    times: Timelines

    def block(self, rows: np.ndarray) -> RowBlock:
        """Return rows as parts of the view take them."""
        return RowBlock(rows, self.times)


@contextmanager
def open_stream(file: Path, clock_ns: int, created_ns: int = 0) -> Iterator[Opened]:
    """Write a file for the viewer of a rack that was created at this time."""
    times = Timelines(clock_ns, Launch(created_ns, 0))
    stream = Stream(open_recording("run", "run", file, rrb.Blueprint(rrb.TextLogView())), times)
    yield Opened(stream, times)
    stream.flush()
    stream.close()


def build_rows(kind: type[Message], cell: Cell, count: int) -> np.ndarray:
    """Return messages with fields of 0, one per tick."""
    message = kind.message_type.build_dtype(compute_sizes(cell))
    rows = np.zeros(count, [("tick", "i8"), ("stamp_ns", "i8"), ("message", message)])
    rows["tick"] = rows["stamp_ns"] = np.arange(count)
    return rows
