"""The processor time of a board's cycle, by part: racks that run in real time and in lockstep, and
their traces.

Reading, processing and writing lie between stamps of the trace; what the processor time of a cycle
exceeds them by is waking up before it, and the bookkeeping after it. An empty board shows the
rack's own cost; the physics that are in a servo cycle are replayed alone. Another checkout of rack
runs the same racks by turns.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, NamedTuple

import numpy as np

from rack.levels.timing.trace_times import Occupation, unit_times
from rack.tools.console.progress import Progress
from rack.tools.console.tables import table
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.checkout import THIS, RackCommand, rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved, shown
from rack.tools.lab.benches.physics import SERVO, replay
from rack.tools.recording.recording import Recording

PARTS = ("wake", "read", "process", "write", "bookkeeping")
"""Parts of a cycle, in the order of time; where a trace does not separate the last one, it is in
the first."""
STEADY_TICKS = 40
"""Ticks at the start that are not judged: a new process touches its memory for the first time."""
EMPTY = "empty"
RATE_HZ = 400
BOARDS = 6
"""Boards of the empty rack: those of four levels, a world model and a loose planner."""
LAUNCH_S = 5.0
"""About how long launching a rack, and reporting on it, take in addition to its time."""
BOUND_S = 120.0
"""Longest time for a run, in addition to ten times its simulated time."""
REPLAYED_TICKS = 1000
"""Ticks of one replay of physics, at most."""
PHYSICS = "mj_step alone"
COMPARED = f"{SERVO}, lockstep"
"""The case that is compared with its physics."""


class Trace(NamedTuple):
    """Cycles of one task: records of the trace, shape (n,), and processor times of C, R, X, W, ns,
    shape (n, 4)."""

    rows: np.ndarray
    units: np.ndarray


class CycleRun(NamedTuple):
    """The steady cycles of a run by executor, and the processor time of each tick's bare physics,
    us; empty unless they were replayed."""

    traces: dict[str, Trace]
    physics_us: list[float]


class RackKind(NamedTuple):
    """A rack to run, "nasrem" or "empty", in one mode."""

    config: str
    mode: str


KINDS = tuple(
    RackKind(config, mode) for mode in ("real time", "lockstep") for config in (EMPTY, "nasrem")
)


@dataclass(frozen=True)
class CycleCosts(Comparison):
    """A comparison of whole cycles, and the medians of the parts of each by case and contestant,
    us."""

    parts: Mapping[tuple[str, str], Mapping[str, float]] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        parts = [{"case": case, "who": who, **one} for (case, who), one in self.parts.items()]
        return {**super().document(), "parts_unit": "us", "parts": parts}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield both tables for people, fitted to `width`."""
        yield "Parts of a board's cycle, processor time, us, median"
        rows = [
            [*place, *(shown(one[part]) for part in PARTS)] for place, one in self.parts.items()
        ]
        yield from table(["board", "who", *PARTS], rows, width)
        yield ""
        yield from super().lines(width)


def measure(
    against: Path | None, seconds: float, rounds: int, progress: Progress, share: bool = False
) -> CycleCosts:
    """Run every rack of this tree, and of another checkout, by turns.

    Args:
        against: The other checkout; None if there is none.
        seconds: Simulated time of each run.
        rounds: Runs of each rack.
        progress: Told of each run.
        share: Run even on cores that another rack's real-time boards hold.

    Raises:
        Failure: If a run fails.
    """
    commands = rack_commands(against)
    with TemporaryDirectory() as folder:
        progress.total(rounds * len(KINDS) * len(commands) * (seconds + LAUNCH_S))
        contestants = {
            (kind, command.name): partial(_run, kind, command, seconds, folder, share)
            for kind in KINDS
            for command in commands
        }
        found = interleaved(contestants, rounds, progress, seconds + LAUNCH_S)
    traces: defaultdict[tuple[str, str], list[Trace]] = defaultdict(list)
    physics_us: list[float] = []
    for (kind, who), runs in found.items():
        for run in runs:
            physics_us += run.physics_us
            for board, trace in run.traces.items():
                name = EMPTY if kind.config == EMPTY else board
                traces[f"{name}, {kind.mode}", who].append(trace)
    return costs(traces, physics_us, commands[-1].name if against else None)


def _run(
    kind: RackKind, command: RackCommand, seconds: float, scratch: str, share: bool
) -> CycleRun:
    """Run one rack and take its traces; of this tree's arm in lockstep, replay the physics at
    once."""
    folder = Path(mkdtemp(dir=scratch))
    lockstep = kind.mode == "lockstep"
    config = kind.config if kind.config != EMPTY else Chain(BOARDS, RATE_HZ).write(folder)
    options = ["--set", f"name=bench-{os.getpid()}", "--seconds", seconds]
    options += ["--lockstep"] * lockstep + ["--share"] * share
    options += ["--out", folder / "run"]
    command.run("run", config, *options, bound_s=BOUND_S + 10.0 * seconds)
    traces = traces_of(Recording(folder / "run"))
    if not lockstep or kind.config == EMPTY or command.name != THIS:
        return CycleRun(traces, [])
    return CycleRun(traces, apart(replay, folder / "run", REPLAYED_TICKS))


def traces_of(recording: Recording) -> dict[str, Trace]:
    """Return the steady cycles of every executor of a run, by task.

    Checkouts record the same columns; one that an earlier version did not record is 0.
    """
    tasks = [task for task in recording.layout.tasks if len(recording.trace(task.name))]
    spans = {task: Occupation.of(recording.trace(task.name)) for task in tasks}
    found: dict[str, Trace] = {}
    for task in tasks:
        above = [
            span
            for other, span in spans.items()
            if other.core == task.core and other.priority > task.priority
        ]
        rows = recording.trace(task.name)
        times = unit_times(rows, Occupation.union(above))
        steady = rows["tick"] >= STEADY_TICKS
        if task.role == "executor" and steady.any():
            found[task.name] = Trace(rows[steady], times[steady])
    return found


def costs(
    traces: Mapping[tuple[str, str], list[Trace]], physics_us: list[float], other: str | None
) -> CycleCosts:
    """Return the costs of everything measured.

    Args:
        traces: Traces of all runs, by case and contestant.
        physics_us: Processor time of ticks of bare physics.
        other: The checkout with which this one is compared; without one, the servo level's cycle is
            compared with its physics.
    """
    cases = list(dict.fromkeys(case for case, _ in traces))
    # The contestants of a case stand together.
    order = sorted(traces, key=lambda one: cases.index(one[0]))
    samples = []
    parts = {}
    for one in order:
        processor_us = np.concatenate([trace.rows["processor_ns"] * 1e-3 for trace in traces[one]])
        samples.append(Sample(*one, tuple(processor_us.tolist()), "us"))
        # A single cycle has no parts: the record of the next one has its bookkeeping.
        if len(processor_us) > len(traces[one]):
            each = [parts_of(trace) for trace in traces[one]]
            parts[one] = {
                part: float(np.median(np.concatenate([found[part] for found in each])))
                for part in PARTS
            }
    if physics_us:
        samples.append(Sample(COMPARED, PHYSICS, tuple(physics_us), "us"))
    baselines = {COMPARED: PHYSICS} if other is None else dict.fromkeys(cases, other)
    title = "Processor time of a board's cycle"
    return CycleCosts("cycle", title, tuple(samples), baselines, parts=parts)


def parts_of(trace: Trace) -> dict[str, np.ndarray]:
    """Return the processor time of each part of each cycle but the first, us, shape (n - 1,)."""
    rows = trace.rows
    units = trace.units[1:]
    exchange, read, process, write = units.T
    beyond = rows["processor_ns"][1:] - units.sum(axis=1)
    # A record counts, and stamps, the bookkeeping of the cycle before: its own is not done when it
    # is written.
    closing = rows["closed_ns"][1:] - rows["end_ns"][:-1]
    gap = rows["start_ns"][1:] - rows["closed_ns"][1:]
    # Interrupted, as by the clock in lockstep, it seems longer than it was; then the way to the
    # next start is known.
    closing = np.where(closing > beyond, beyond - np.minimum(gap, beyond), closing)
    closing[rows["closed_ns"][1:] == 0] = 0
    times = beyond - closing, exchange + read, process, write, closing
    return {part: time * 1e-3 for part, time in zip(PARTS, times, strict=True)}
