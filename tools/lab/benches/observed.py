"""A rack run by a bench: recorded, or for its trace alone, when no recorder takes processor
time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.ring import Drained, Ring
from rack.backplane.segment import Segment
from rack.backplane.trace import trace_ring
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Outcome
from rack.levels.timing.trace_times import is_missed
from rack.tools.live.display import Display
from rack.tools.live.launch import RunResult, run_rack
from rack.tools.recording.recording import Recording

READ_S = {"realtime": 0.5, "lockstep": 0.02}
"""Wall-clock time between two readings: the rings hold two seconds of simulated time."""
SETTLE_NS = 250_000_000
"""Start of a run, in which caches are cold: no peer is measured in its own."""


class Runs(NamedTuple):
    """How a bench runs its contestants: how long, in how many turns, and whether on cores that
    another rack holds."""

    seconds: float
    rounds: int
    share: bool = False


class Recorded(NamedTuple):
    """How a run went, and its recording."""

    result: RunResult
    recording: Recording


UNJUDGED = "supervision.max_missed_fraction=1"
"""Setting of a rack whose lost cycles are measured: they do not fail its run."""
UNVIEWED = ("record.keep=600", "record.checkpoint_s=0", UNJUDGED)
"""Settings of a rack whose recording nobody looks at: a flight recorder makes no viewer's file,
which takes a recorder of 1 kHz as long as the rest."""


def record(
    config: RackConfig,
    seconds: float | None,
    folder: Path,
    share: bool = True,
) -> Recorded:
    """Run a rack as `run_rack` does, which raises, record it into `folder`, and show nothing."""
    result = run_rack(config, seconds, folder, Display(), share=share)
    return Recorded(result, Recording(folder))


def endless(config: RackConfig) -> RackConfig:
    """Return a rack that no board ends."""
    boards = {
        name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()
    }
    return config.model_copy(update={"board": boards})


class Deed(NamedTuple):
    """Something that the host side does to a rack in lockstep, exactly before `tick`."""

    tick: int
    does: Callable[[Segment], None]


class CycleCount(NamedTuple):
    """Cycles of a task: how many were missed or skipped, and how many were due."""

    missed: int
    due: int


@dataclass(frozen=True)
class Observed:
    """What a run left in its rings: trace records by task, and messages by mailbox, oldest first.

    `lost` counts the records of a task that were overwritten before they were read.
    """

    traces: dict[str, np.ndarray]
    lost: dict[str, int]
    messages: dict[str, np.ndarray]
    layout: Layout
    outcome: Outcome

    def settled(self, task: str) -> np.ndarray:
        """Return the trace of a task after the start of the run."""
        rows = self.traces[task]
        return rows[rows["release_ns"] >= rows["release_ns"][0] + SETTLE_NS] if len(rows) else rows

    def cycles(self, task: str) -> CycleCount:
        """Count the cycles of a task by the clock's grid: skipped ones leave no record. The last
        tick does not count.

        Its record may be written after the last reading.
        """
        rows = self.traces[task]
        last = self.outcome.ticks - 1
        spec = self.layout.task(task)
        due = max(0, -(-(last - spec.phase) // spec.every)) - self.lost[task]
        in_time = np.count_nonzero((rows["tick"] < last) & ~is_missed(rows))
        return CycleCount(due - int(in_time), due)


def observe(
    config: RackConfig,
    seconds: float,
    share: bool,
    mailboxes: Sequence[str] = (),
    deeds: Sequence[Deed] = (),
) -> Observed:
    """Run a rack for `seconds` of simulated time, or until its task ends, and read its rings on the
    host side.

    `deeds` are in the order of their ticks. `share` is as in `Rack`, which raises if another rack
    holds a core.
    """
    with Rack(config, share=share) as rack:
        segment = rack.segment
        ahead = list(deeds)
        tasks = [task.name for task in segment.layout.tasks]
        rings: dict[str, Ring] = {name: trace_ring(segment, name) for name in tasks}
        rings |= {name: MailboxRing(segment, name) for name in mailboxes}
        drained: dict[str, list[Drained]] = {name: [] for name in rings}
        _hold_before(segment, ahead)
        rack.start(seconds)
        is_on = True
        while is_on:
            is_on = rack.watch(READ_S[config.clock.mode])
            if ahead and segment.words[System.HELD] == ahead[0].tick + 1:
                ahead.pop(0).does(segment)
                _hold_before(segment, ahead)
            for name, ring in rings.items():
                drained[name].append(ring.drain())
        assert rack.outcome is not None, "the run is over"
        rows = {
            name: np.concatenate([block.rows for block in blocks])
            for name, blocks in drained.items()
        }
        lost = {name: sum(block.lost for block in drained[name]) for name in tasks}
        layout = segment.layout
    traces = {name: rows[name] for name in tasks}
    messages = {name: rows[name] for name in mailboxes}
    return Observed(traces, lost, messages, layout, rack.outcome)


def _hold_before(segment: Segment, deeds: Sequence[Deed]) -> None:
    """Let lockstep hold before the tick of the first of these."""
    segment.words[System.HOLD_AT] = deeds[0].tick + 1 if deeds else 0


def missed_share(counts: Iterable[CycleCount]) -> float:
    """Return the share of the cycles that were missed, of several tasks or runs together."""
    missed, due = map(sum, zip(*counts, strict=True))
    return missed / due if due else 0.0
