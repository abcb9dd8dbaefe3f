"""Reads curves and spans of run.rrd as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from rack.tools.viewer.parts import list_parts
from rack.tools.viewer.stream import TICK


class EntityRows(NamedTuple):
    """Rows of one entity in the order of ticks.

    Attributes:
        ticks: Tick of each row, shape (rows,).
        values: One list or array per row.
    """

    ticks: np.ndarray
    values: np.ndarray


def read_component(file: Path, entity: str, component: str = "Scalars:scalars") -> EntityRows:
    """Read one component of an entity, from a file and the parts that continue it.

    Args:
        file: The first file of the recording.
        entity: Path of the entity.
        component: The component. Defaults to curves, whose values have shape (rows, curves).

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
    except ValueError:  # rows of different lengths
        values = np.array(rows, dtype=object)
    return EntityRows(ticks[order], values[order])
