"""Reading a recording back: curves and spans of run.rrd as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from rack.tools.viewer.parts import parts_of
from rack.tools.viewer.stream import TICK


class Rows(NamedTuple):
    """Rows of one entity in the order of ticks: `ticks` (rows,), `values` one list or array a
    row.
    """

    ticks: np.ndarray
    values: np.ndarray


def read(file: Path, entity: str, component: str = "Scalars:scalars") -> Rows:
    """Return one component of an entity, from a file and the parts that continue it; curves are
    (rows, curves). Raises `KeyError` when they have none.
    """
    chunks = [
        chunk
        for part in parts_of(file)
        for chunk in RrdReader(str(part))
        .stream()
        .filter(content=entity, has_timeline=TICK, components=component)
        .to_chunks()
    ]
    if not chunks:
        raise KeyError(f"{file}: no {component} of '{entity}'")
    batches = [chunk.to_record_batch() for chunk in chunks]
    ticks = np.concatenate([batch.column(TICK).to_numpy() for batch in batches])
    rows = [row for batch in batches for row in batch.column(component).to_pylist()]
    order = np.argsort(ticks, kind="stable")
    try:
        values = np.array(rows)
    except ValueError:  # rows of different lengths
        values = np.array(rows, dtype=object)
    return Rows(ticks[order], values[order])
