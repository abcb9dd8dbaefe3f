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
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rack.boards.config import load, wire
from rack.levels.timing.trace_times import Occupation, unit_times
from rack.tools.console.progress import Progress
from rack.tools.console.tables import table
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.chain_figures import RATE_HZ
from rack.tools.lab.benches.chart import BASELINE, Diagram, Series, draw
from rack.tools.lab.benches.checkout import THIS, RackCommand, rack_commands
from rack.tools.lab.benches.harness import BenchResult, Comparison, Sample, interleaved, shown
from rack.tools.lab.benches.physics import SERVO, ReplayPace, replay
from rack.tools.recording.recording import Recording

PARTS = ("wake", "read", "process", "write", "bookkeeping")
"""Parts of a cycle, in the order of time; where a trace does not separate the last one, it is in
the first."""
STEADY_TICKS = 40
"""Ticks at the start that are not judged: a new process touches its memory for the first time."""
EMPTY = "empty"
BOARDS = 6
"""Boards of the empty rack: those of four levels, a world model and a loose planner."""
LAUNCH_S = 5.0
"""About how long launching a rack, and reporting on it, take in addition to its time."""
BOUND_S = 120.0
"""Longest time for a run, in addition to ten times its simulated time."""
REPLAYED_TICKS = 1000
"""Ticks of one replay of physics, at most."""
ROW = "mj_step, tick after tick"
PACED = "mj_step, at the servo's rate"


class Trace(NamedTuple):
    """Cycles of one task: records of the trace, shape (n,), and processor times of C, R, X, W, ns,
    shape (n, 4)."""

    rows: np.ndarray
    units: np.ndarray


class RackKind(NamedTuple):
    """A rack to run, "nasrem" or "empty", in one mode."""

    config: str
    lockstep: bool

    @property
    def mode(self) -> str:
        """The mode, in words."""
        return "lockstep" if self.lockstep else "real time"


KINDS = tuple(
    RackKind(config, lockstep) for config in ("nasrem", EMPTY) for lockstep in (False, True)
)


@dataclass(frozen=True)
class BoardParts:
    """The median of each part of one board's cycles, us; a part that a trace does not separate is
    0."""

    case: str
    who: str
    parts: Mapping[str, float]


@dataclass(frozen=True)
class CycleCosts(BenchResult):
    """What the runs cost: a comparison of whole cycles, and the parts of each."""

    comparison: Comparison
    parts: tuple[BoardParts, ...]

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        parts = [{"case": one.case, "who": one.who, **one.parts} for one in self.parts]
        return {**self.comparison.document(), "parts_unit": "us", "parts": parts}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield both tables for people, fitted to `width`."""
        yield "Parts of a board's cycle, processor time, us, median"
        rows = [
            [one.case, one.who, *(shown(one.parts[part]) for part in PARTS)] for one in self.parts
        ]
        yield from table(["board", "who", *PARTS], rows, width)
        if not all(one.parts["bookkeeping"] for one in self.parts):
            yield "bookkeeping 0: the trace does not separate it; it is in wake"
        yield ""
        yield from self.comparison.lines(width)

    def plot(self, folder: Path) -> list[Path]:
        """Write the parts of cycles as bars, a panel a board, into `folder`; return the paths."""
        rows = list(dict.fromkeys(one.who for one in self.parts))
        cases = dict.fromkeys(one.case for one in self.parts)
        panels = [
            Diagram(f"{case}, us", list(self._bars(case, rows)), is_linear=True) for case in cases
        ]
        return draw(folder / self.comparison.name, self.comparison.title, panels, rows)

    def _bars(self, case: str, rows: list[str]) -> Iterator[Series]:
        """Yield the bars of each part of a cycle; of the servo's also the physics in it."""
        own = [one for one in self.parts if one.case == case]
        places = [rows.index(one.who) for one in own]
        starts = [0.0] * len(own)
        for part in PARTS:
            ends = [start + one.parts[part] for start, one in zip(starts, own, strict=True)]
            yield Series(part, ends, places, "bar", starts=starts)
            starts = ends
        physics = self.comparison.sample(_with_physics(case), _bare(case))
        if physics is not None:
            processing = [one.parts["wake"] + one.parts["read"] for one in own]
            ends = [start + physics.median for start in processing]
            yield Series("bare mj_step in it", ends, places, "span", BASELINE, processing)


def _with_physics(case: str) -> str:
    """Return the case that compares the servo of this case with its physics."""
    return case.replace(f"{SERVO},", f"{SERVO} and its physics,")


def _bare(case: str) -> str:
    """Return the replay that runs as the boards of a case do."""
    return ROW if case.endswith("lockstep") else PACED


class Found(NamedTuple):
    """Everything measured, by contestant: traces also by case, times in us, arrays of shape
    (n,)."""

    traces: defaultdict[tuple[str, str], list[Trace]]
    physics_us: defaultdict[str, list[np.ndarray]]
    """Processor time of a tick's bare physics, by the way of their replay."""


def measure(
    against: Path | None, seconds: float, rounds: int, progress: Progress, share: bool = False
) -> CycleCosts:
    """Run every rack of this tree, and of another checkout, by turns, each for `seconds` of
    simulated time.

    `share`: run even on cores that another rack's real-time boards hold. Raises `Failure` if a run
    fails.
    """
    commands = rack_commands(against)
    with TemporaryDirectory() as folder:
        runs = CycleRuns(seconds, Path(folder), share)
        progress.total(rounds * len(KINDS) * len(commands) * (seconds + LAUNCH_S))
        contestants = {
            (kind.config, kind.mode, command.name): partial(runs.run, kind, command)
            for kind in KINDS
            for command in commands
        }
        interleaved(contestants, rounds, progress, seconds + LAUNCH_S)
        other = commands[-1].name if len(commands) > 1 else None
        return costs(runs.found, other)


class CycleRuns:
    """Runs racks, and collects what is `found` in their traces."""

    def __init__(self, seconds: float, folder: Path, share: bool) -> None:
        self.found = Found(defaultdict(list), defaultdict(list))
        self._seconds = seconds
        self._folder = folder
        self._share = share
        self._runs = 0
        config = load("nasrem")
        servo = wire(config).task(SERVO)
        self._pace = ReplayPace(config.clock_ns * servo.every, servo.core, servo.priority)

    def run(self, kind: RackKind, command: RackCommand) -> None:
        """Run one rack and take its traces; of this tree's arm in lockstep, replay the physics at
        once."""
        self._runs += 1
        folder = self._folder / str(self._runs)
        folder.mkdir()
        config = kind.config if kind.config != EMPTY else Chain(BOARDS, RATE_HZ).write(folder)
        options = ["--set", f"name=bench-{os.getpid()}", "--seconds", self._seconds]
        options += ["--lockstep"] * kind.lockstep + ["--share"] * self._share
        options += ["--out", folder / "run"]
        command.run("run", config, *options, bound_s=BOUND_S + 10.0 * self._seconds)
        for board, trace in traces_of(Recording(folder / "run")).items():
            what = EMPTY if kind.config == EMPTY else board
            self.found.traces[f"{what}, {kind.mode}", command.name].append(trace)
        if kind.lockstep and kind.config != EMPTY and command.name == THIS:
            for who, pace in ((ROW, ReplayPace()), (PACED, self._pace)):
                times_us = apart(replay, folder / "run", pace, REPLAYED_TICKS)
                self.found.physics_us[who].append(np.array(times_us))


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


def costs(found: Found, baseline: str | None) -> CycleCosts:
    """Return the costs of everything measured; `baseline` is the contestant that the others are
    compared with."""
    order = _ordered(found.traces)
    samples = [
        _sample(*one, (trace.rows["processor_ns"] * 1e-3 for trace in found.traces[one]))
        for one in order
    ]
    # A single cycle has no parts: the record of the next one has its bookkeeping.
    long = [one for one in order if any(len(trace.rows) > 1 for trace in found.traces[one])]
    parts = [BoardParts(*one, _medians(found.traces[one])) for one in long]
    baselines = {sample.case: baseline for sample in samples if baseline is not None}
    physics: list[Sample] = []
    for case in dict.fromkeys(case for case, _ in order if case.startswith(f"{SERVO},")):
        physics += [
            replace(sample, case=_with_physics(case)) for sample in samples if sample.case == case
        ]
        physics += [
            _sample(_with_physics(case), who, times) for who, times in found.physics_us.items()
        ]
        baselines[_with_physics(case)] = _bare(case)
    title = "Processor time of a board's cycle"
    return CycleCosts(Comparison("cycle", title, (*samples, *physics), baselines), tuple(parts))


def _ordered(found: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return cases and contestants: real time first, in it the empty boards; in each case this tree
    first."""
    cases = sorted(
        dict.fromkeys(case for case, _ in found),
        key=lambda case: (case.endswith("lockstep"), not case.startswith(EMPTY)),
    )
    return sorted(found, key=lambda one: (cases.index(one[0]), _is_other(one[1])))


def _is_other(who: str) -> bool:
    return who != THIS


def _sample(case: str, who: str, times_us: Iterable[np.ndarray]) -> Sample:
    return Sample(case, who, tuple(np.concatenate(list(times_us)).tolist()), "us")


def _medians(traces: Iterable[Trace]) -> dict[str, float]:
    found = [parts_of(trace) for trace in traces]
    return {part: float(np.median(np.concatenate([one[part] for one in found]))) for part in PARTS}


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
