"""A rack run for its trace alone: the host side reads the rings, and no recorder takes processor time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.ring import Ring
from rack.backplane.trace import trace_ring
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Outcome
from rack.levels.timing.trace_times import counts

READ_S = {"realtime": 0.5, "lockstep": 0.02}
"""Wall-clock time between two readings: the rings hold two seconds of simulated time."""
SETTLE_NS = 250_000_000
"""Start of a run, in which caches are cold: no peer is measured in its own."""


@dataclass(frozen=True)
class Observed:
    """What a run left in its rings: trace records by task, and messages by mailbox, oldest first."""

    traces: dict[str, np.ndarray]
    messages: dict[str, np.ndarray]
    outcome: Outcome

    def settled(self, task: str) -> np.ndarray:
        """Return the trace of a task after the start of the run."""
        rows = self.traces[task]
        return rows[rows["release_ns"] >= rows["release_ns"][0] + SETTLE_NS] if len(rows) else rows


def observe(config: RackConfig, seconds: float, mailboxes: Sequence[str] = ()) -> Observed:
    """Run a rack for `seconds` of simulated time, or until its task ends. Raises what `Rack` raises."""
    with Rack(config) as rack:
        segment = rack.segment
        traces: dict[str, Ring] = {task.name: trace_ring(segment, task.name) for task in segment.layout.tasks}
        rings = traces | {name: MailboxRing(segment, name) for name in mailboxes}
        blocks: dict[str, list[np.ndarray]] = {name: [] for name in rings}
        rack.start(seconds)
        is_on = True
        while is_on:
            is_on = rack.watch(READ_S[config.clock.mode])
            for name, ring in rings.items():
                blocks[name].append(ring.drain().rows)
        assert rack.outcome is not None, "the run is over"
        found = {name: np.concatenate(rows) for name, rows in blocks.items()}
    return Observed({name: found[name] for name in traces}, {name: found[name] for name in mailboxes}, rack.outcome)


def missed_share(rows: np.ndarray) -> float:
    """Return the share of a task's cycles that were missed or skipped."""
    missed, skipped = counts(rows)
    return (missed + skipped) / (len(rows) + skipped) if len(rows) else 0.0
