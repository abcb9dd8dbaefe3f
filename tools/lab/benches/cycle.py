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
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, NamedTuple

import numpy as np

from rack.tools.console.progress import Progress
from rack.tools.console.tables import Blocks, TextTable
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.checkout import THIS, RackCommand, rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved, shown
from rack.tools.lab.benches.physics import SERVO, replay
from rack.tools.recording.cycles import Cycles, cycles_of
from rack.tools.recording.recording import Recording

PARTS = ("wake", "read", "process", "write", "bookkeeping")
"""Parts of a cycle, in the order of time."""
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


class CycleRun(NamedTuple):
    """The cycles of a run by executor, and the processor time of each tick's bare physics, us;
    empty unless they were replayed.
    """

    cycles: dict[str, Cycles]
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
    us.
    """

    parts: Mapping[tuple[str, str], Mapping[str, float]] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        parts = [{"case": case, "who": who, **one} for (case, who), one in self.parts.items()]
        return {**super().document(), "parts_unit": "us", "parts": parts}

    def blocks(self) -> Blocks:
        """Yield both tables for people."""
        yield "Parts of a board's cycle, processor time, us, median"
        yield TextTable(
            [
                {"board": board, "who": who, **{part: shown(one[part]) for part in PARTS}}
                for (board, who), one in self.parts.items()
            ]
        )
        yield ""
        yield from super().blocks()


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
    cycles: defaultdict[tuple[str, str], list[Cycles]] = defaultdict(list)
    physics_us: list[float] = []
    for (kind, who), runs in found.items():
        for run in runs:
            physics_us += run.physics_us
            for board, own in run.cycles.items():
                name = EMPTY if kind.config == EMPTY else board
                cycles[f"{name}, {kind.mode}", who].append(own)
    return costs(cycles, physics_us, commands[-1].name if against else None)


def _run(
    kind: RackKind, command: RackCommand, seconds: float, scratch: str, share: bool
) -> CycleRun:
    """Run one rack and take its cycles; of this tree's arm in lockstep, replay the physics at
    once.
    """
    folder = Path(mkdtemp(dir=scratch))
    lockstep = kind.mode == "lockstep"
    config = kind.config
    if config == EMPTY:
        path = folder / "empty.toml"
        path.write_text(Chain(BOARDS, RATE_HZ).text())
        config = str(path)
    # What is measured is the cost of a cycle, not whether all cycles came in time.
    settings = (f"name=bench-{os.getpid()}", "supervision.max_missed_fraction=1")
    options = [*(f"--set={setting}" for setting in settings), "--seconds", seconds]
    options += ["--lockstep"] * lockstep + ["--share"] * share
    options += ["--out", folder / "run"]
    command.run("run", config, *options, bound_s=BOUND_S + 10.0 * seconds)
    found = cycles_of(Recording(folder / "run"))
    cycles = {name: own for name, own in found.items() if own.task.role == "executor"}
    if not lockstep or kind.config == EMPTY or command.name != THIS:
        return CycleRun(cycles, [])
    return CycleRun(cycles, apart(replay, folder / "run", REPLAYED_TICKS))


def costs(
    cycles: Mapping[tuple[str, str], list[Cycles]], physics_us: list[float], other: str | None
) -> CycleCosts:
    """Return the costs of everything measured.

    Args:
        cycles: Cycles of all runs, by case and contestant.
        physics_us: Processor time of ticks of bare physics.
        other: The checkout with which this one is compared; without one, the servo level's cycle is
            compared with its physics.
    """
    cases = list(dict.fromkeys(case for case, _ in cycles))
    samples = []
    parts = {}
    # The contestants of a case stand together.
    for one in sorted(cycles, key=lambda one: cases.index(one[0])):
        judged_ns = [own.rows["processor_ns"][own.is_judged] for own in cycles[one]]
        samples.append(Sample(*one, tuple((np.concatenate(judged_ns) * 1e-3).tolist()), "us"))
        each = [parts_of(own) for own in cycles[one]]
        medians = {part: np.concatenate([found[part] for found in each]) for part in PARTS}
        # A single cycle has no parts: the record of the next one has its bookkeeping.
        if len(medians[PARTS[0]]):
            parts[one] = {part: float(np.median(times_us)) for part, times_us in medians.items()}
    if physics_us:
        samples.append(Sample(COMPARED, PHYSICS, tuple(physics_us), "us"))
    baselines = {COMPARED: PHYSICS} if other is None else dict.fromkeys(cases, other)
    title = "Processor time of a board's cycle"
    return CycleCosts("cycle", title, tuple(samples), baselines, parts=parts)


def parts_of(cycles: Cycles) -> dict[str, np.ndarray]:
    """Return the processor time of each part of each judged cycle but the first, us, shape (n,)."""
    rows = cycles.rows
    beyond = (rows["processor_ns"] - cycles.used_ns)[1:]
    # A record counts, and stamps, the bookkeeping of the cycle before: its own is not done when it
    # is written.
    closing = rows["closed_ns"][1:] - rows["end_ns"][:-1]
    gap = rows["start_ns"][1:] - rows["closed_ns"][1:]
    # Interrupted, as by the clock in lockstep, it seems longer than it was; then the way to the
    # next start is known.
    closing = np.where(closing > beyond, beyond - np.minimum(gap, beyond), closing)
    read_ns, process_ns, write_ns = (
        times_ns[1:]
        for times_ns in (
            cycles.exchange_ns + cycles.read_ns,
            cycles.process_ns,
            cycles.write_ns,
        )
    )
    times = beyond - closing, read_ns, process_ns, write_ns, closing
    judged = cycles.is_judged[1:]
    return {part: time[judged] * 1e-3 for part, time in zip(PARTS, times, strict=True)}
