"""Reads curves and spans of run.rrd as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from rack.tools.viewer.parts import list_parts
from rack.tools.viewer.stream import TICK


class EntityRows(NamedTuple):
    """Rows of one entity of the recording, sorted by tick.

    Attributes:
        ticks: Tick of each row, shape (rows,).
        values: Values of each row. An array of shape (rows, values) if all rows have equally many
            values, otherwise an array of lists.
    """

    ticks: np.ndarray
    values: np.ndarray


def read_component(file: Path, entity: str, component: str = "Scalars:scalars") -> EntityRows:
    """Read one component of an entity from run.rrd and the parts that continue it.

    Args:
        file: The first file of the recording.
        entity: Path of the entity.
        component: Name of the component. Defaults to the values of curves, which have shape
            (rows, curves).

    Raises:
        KeyError: The files contain no such component.
    """
    chunks = [
        chunk
        for part in list_parts(file)
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
    except ValueError:  # the rows have different lengths
        values = np.array(rows, dtype=object)
    return EntityRows(ticks[order], values[order])
