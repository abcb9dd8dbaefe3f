"""Recordings whose trace is made up, in the files that a recorder writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.trace import RECORD
from rack.boards.config import RackConfig, wire
from rack.boards.config.timing import tick_ns
from rack.tools.recording import Recording
from rack.tools.runs.parquet import CyclesFile, SignalsFile

MS = 1_000_000


class Cycle(NamedTuple):
    """One trace record, ms: `parts` are the stamped lengths of C, R, X, W; `processor` is counted beside them."""

    tick: int
    parts: tuple[float, float, float, float]
    late: float = 0.0
    processor: float | None = None
    flags: int = 0


def recorded(
    folder: Path,
    config: RackConfig,
    traces: Mapping[str, Sequence[Cycle]],
    events: Sequence[Mapping[str, Any]] = (),
) -> Recording:
    """Write a recording of a rack whose tasks left these traces; return it."""
    folder.mkdir()
    (folder / "config.toml").write_text(config.text())
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    layout = wire(config)
    signals = SignalsFile(folder / "signals.parquet", layout)
    signals.close({})
    cycles = CyclesFile(folder / "cycles.parquet")
    for task, trace in traces.items():
        cycles.add(task, np.array([_row(cycle, tick_ns(config)) for cycle in trace], RECORD))
    cycles.close({})
    return Recording(folder)


def _row(cycle: Cycle, period_ns: int) -> tuple[int, ...]:
    release = cycle.tick * period_ns
    stamps = np.cumsum([round(ms * MS) for ms in (cycle.late, *cycle.parts)]) + release
    processor = sum(cycle.parts) if cycle.processor is None else cycle.processor
    return (cycle.tick, release, *stamps.tolist(), cycle.flags, 0, round(processor * MS))
