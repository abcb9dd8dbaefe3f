"""Recordings with synthetic traces, in the files that a recorder writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.segment import Launch
from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.config import RackConfig, resolve_layout
from rack.boards.events import Event, EventKind
from rack.tools.recording.checksums import Checksums, format_checked_line
from rack.tools.recording.cores import UNMEASURED
from rack.tools.recording.parquet import CyclesFile, create_signal_tables
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import TABLE_PATTERNS

MS, US = 1_000_000, 1_000
EPOCH_NS = 5_000_000_123
"""Time of tick 0 in the rows of `cycle`."""
LAUNCH = Launch(EPOCH_NS, EPOCH_NS)
Row = tuple[int, ...]
Traces = Mapping[str, "Sequence[Cycle | Row] | np.ndarray"]


class Cycle(NamedTuple):
    """One trace record, ms.

    `parts` are the stamped lengths of C, R, X and W. `processor` is None for their sum.
    """

    tick: int
    parts: tuple[float, float, float, float]
    late: float = 0.0
    processor: float | None = None
    flags: int = 0

    def row(self, period_ns: int) -> Row:
        """Return the record, with ticks of `period_ns`."""
        release = self.tick * period_ns
        stamps = np.cumsum([round(ms * MS) for ms in (self.late, *self.parts)]) + release
        processor = sum(self.parts) if self.processor is None else self.processor
        return (self.tick, release, *stamps.tolist(), self.flags, 0, round(processor * MS), 0)


def cycle(
    tick: int,
    tick_us: int,
    *moments_us: int,
    processor_us: int | None = None,
    skipped: int = 0,
    planned: bool = False,
) -> Row:
    """Return a trace record released at `tick`, with its stamps in us since tick 0."""
    moments = [EPOCH_NS + moment * US for moment in moments_us]
    flags = skipped << SKIPPED_SHIFT | (skipped > 0) * Flag.SKIPPED | planned * Flag.PLANNED
    used = moments_us[-1] - moments_us[0] if processor_us is None else processor_us
    return (tick, EPOCH_NS + tick * tick_us * US, *moments, flags, 0, used * US, 0)


def recorded(
    folder: Path,
    config: RackConfig,
    traces: Traces,
    events: Sequence[Mapping[str, Any]] = (),
    messages: Mapping[str, np.ndarray] | None = None,
    launch: Launch = LAUNCH,
) -> Recording:
    """Write the recording of a rack with these traces and messages into `folder`, and return it."""
    folder.mkdir(exist_ok=True)
    (folder / "config.toml").write_text(config.to_toml_text())
    (folder / "events.jsonl").write_text(
        "".join(format_checked_line({**event}) for event in events)
    )
    layout = resolve_layout(config)
    cycles = CyclesFile(folder / "cycles.parquet", layout, launch)
    signals = create_signal_tables(folder / "signals", layout)
    for task, trace in traces.items():
        rows = [cycle.row(config.tick_ns) if isinstance(cycle, Cycle) else cycle for cycle in trace]
        cycles.add_records(task, np.array(rows, RECORD))
    for mailbox, rows in (messages or {}).items():
        signals[mailbox].add_rows(rows)
    cycles.close({}, UNMEASURED, (), ())
    for table in signals.values():
        table.close()
    Checksums(folder).store("config.toml", *TABLE_PATTERNS)
    return Recording(folder)


def add_events(folder: Path, *events: tuple[int, EventKind, str, str]) -> None:
    """Add events of the lower board to a recording: tick, kind, code and text of each."""
    with (folder / "events.jsonl").open("a") as file:
        for tick, kind, code, text in events:
            event = Event(0, tick, kind, "lower", text, code)
            file.write(format_checked_line(asdict(event)))
