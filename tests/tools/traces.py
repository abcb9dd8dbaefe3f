"""Traces written by hand, as the recording of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.config import RackConfig, wire
from rack.tools.charting.measured import Run
from rack.tools.recording import Recording
from rack.tools.runs.parquet import CyclesFile, SignalsFile

EPOCH_NS = 5_000_000_123
US = 1_000
Row = tuple[int, ...]


def cycle(
    tick: int, tick_us: int, *moments_us: int, processor_us: int | None = None, skipped: int = 0, planned: bool = False
) -> Row:
    """Return a trace record released at `tick`; its moments, start to end, are us since tick 0."""
    moments = [EPOCH_NS + moment * US for moment in moments_us]
    flags = skipped << SKIPPED_SHIFT | (skipped > 0) * Flag.SKIPPED | planned * Flag.PLANNED
    used = moments_us[-1] - moments_us[0] if processor_us is None else processor_us
    return (tick, EPOCH_NS + tick * tick_us * US, *moments, flags, 0, used * US)


def recorded(folder: Path, config: RackConfig, traces: Mapping[str, list[Row]]) -> Run:
    """Return the run whose tasks have left these records, in `folder`."""
    folder.mkdir(exist_ok=True)
    (folder / "config.toml").write_text(config.text())
    cycles, signals = CyclesFile(folder / "cycles.parquet"), SignalsFile(folder / "signals.parquet", wire(config))
    for task, rows in traces.items():
        cycles.add(task, np.array(rows, RECORD))
    cycles.close({})
    signals.close({})
    return Run(Recording(folder))
