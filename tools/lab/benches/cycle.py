"""The processor time of a board's cycle, by part, in real time and in lockstep.

The traces of runs give the times of reading, processing and writing. The rest of a cycle's
processor time is spent on waking up before it and on bookkeeping after it. Empty boards show the
cost of the rack itself. The physics of a servo cycle are also replayed without the rack. Another
checkout of rack can run the same racks alternately with this one.
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
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.checkout import THIS_TREE, RackCommand, build_rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, call_interleaved, format_value
from rack.tools.lab.benches.physics import SERVO_BOARD, replay_physics
from rack.tools.recording.cycles import Cycles, read_cycles
from rack.tools.recording.recording import Recording

PARTS = ("wake", "read", "process", "write", "bookkeeping")
"""Parts of a cycle in chronological order."""
EMPTY_RACK = "empty"
RATE_HZ = 400
BOARDS = 6
"""Number of boards in the empty rack, enough for four levels, a world model and a planner."""
LAUNCH_S = 5.0
"""Approximate time for launch and report, in addition to the time of a run, s."""
EXTRA_TIMEOUT_S = 120.0
"""Longest time for a run, in addition to ten times its simulated time, s."""
MAX_REPLAYED_TICKS = 1000
"""Maximum number of ticks in one replay of the physics."""
PHYSICS = "mj_step alone"
PHYSICS_CASE = f"{SERVO_BOARD}, lockstep"
"""Case in which the cycle is compared with its physics."""


class CycleRun(NamedTuple):
    """The cycles of one run.

    Attributes:
        cycles: Dictionary from boards to the cycles of their executors.
        physics_us: Processor time of each replayed tick of physics, us. Empty without a replay.
    """

    cycles: dict[str, Cycles]
    physics_us: list[float]


class RackKind(NamedTuple):
    """A rack to run, "nasrem" or "empty", and its clock mode."""

    config: str
    mode: str


KINDS = tuple(
    RackKind(config, mode)
    for mode in ("real time", "lockstep")
    for config in (EMPTY_RACK, "nasrem")
)


@dataclass(frozen=True)
class CycleCosts(Comparison):
    """Comparison of whole cycles, with the parts of each.

    Attributes:
        parts: Dictionary from case and contestant to the median processor time of each part, us.
    """

    parts: Mapping[tuple[str, str], Mapping[str, float]] = field(default_factory=dict)

    def to_document(self) -> dict[str, Any]:
        """Convert the comparison and the parts to plain data."""
        parts = [{"case": case, "who": who, **us} for (case, who), us in self.parts.items()]
        return {**super().to_document(), "parts_unit": "us", "parts": parts}

    def format_blocks(self) -> Blocks:
        """Yield the table of parts and the table of whole cycles for the terminal."""
        yield "Parts of a board's cycle, processor time, us, median"
        yield TextTable(
            [
                {
                    "board": board,
                    "who": who,
                    **{part: format_value(medians[part]) for part in PARTS},
                }
                for (board, who), medians in self.parts.items()
            ]
        )
        yield ""
        yield from super().format_blocks()


def measure_cycles(
    against: Path | None, seconds: float, rounds: int, progress: Progress, share: bool = False
) -> CycleCosts:
    """Run every rack of this tree and of another checkout alternately.

    Args:
        against: The other checkout. None if there is none.
        seconds: Simulated time of each run, s.
        rounds: Number of runs of each rack.
        progress: Shows each run.
        share: Whether to run even on cores that another rack's real-time boards use.

    Returns:
        Costs of all cycles.

    Raises:
        Failure: If a run fails.
    """
    commands = build_rack_commands(against)
    with TemporaryDirectory() as folder:
        progress.set_total(rounds * len(KINDS) * len(commands) * (seconds + LAUNCH_S))
        contestants = {
            (kind, command.name): partial(_run_kind, kind, command, seconds, folder, share)
            for kind in KINDS
            for command in commands
        }
        runs_by_contestant = call_interleaved(contestants, rounds, progress, seconds + LAUNCH_S)
    cycles: defaultdict[tuple[str, str], list[Cycles]] = defaultdict(list)
    physics_us: list[float] = []
    for (kind, who), runs in runs_by_contestant.items():
        for run in runs:
            physics_us += run.physics_us
            for board, board_cycles in run.cycles.items():
                name = EMPTY_RACK if kind.config == EMPTY_RACK else board
                cycles[f"{name}, {kind.mode}", who].append(board_cycles)
    return compute_costs(cycles, physics_us, commands[-1].name if against else None)


def _run_kind(
    kind: RackKind, command: RackCommand, seconds: float, scratch: str, share: bool
) -> CycleRun:
    """Run one rack and return its cycles.

    After a lockstep run of this tree, the physics of its arm is replayed alone for comparison.
    """
    folder = Path(mkdtemp(dir=scratch))
    lockstep = kind.mode == "lockstep"
    config = kind.config
    if config == EMPTY_RACK:
        path = folder / "empty.toml"
        path.write_text(Chain(BOARDS, RATE_HZ).format_config())
        config = str(path)
    # Missed cycles must not fail the run: the bench measures only what a cycle costs.
    settings = (f"name=bench-{os.getpid()}", "supervision.max_missed_fraction=1")
    options = [*(f"--set={setting}" for setting in settings), "--seconds", seconds]
    options += ["--lockstep"] * lockstep + ["--share"] * share
    options += ["--out", folder / "run"]
    command.run("run", config, *options, bound_s=EXTRA_TIMEOUT_S + 10.0 * seconds)
    all_cycles = read_cycles(Recording(folder / "run"))
    cycles = {name: each for name, each in all_cycles.items() if each.task.role == "executor"}
    if not lockstep or kind.config == EMPTY_RACK or command.name != THIS_TREE:
        return CycleRun(cycles, [])
    return CycleRun(
        cycles, run_in_board_environment(replay_physics, folder / "run", MAX_REPLAYED_TICKS)
    )


def compute_costs(
    cycles: Mapping[tuple[str, str], list[Cycles]], physics_us: list[float], baseline: str | None
) -> CycleCosts:
    """Compute the costs of all measured cycles.

    Args:
        cycles: Dictionary from case and contestant to the cycles of each run.
        physics_us: Processor time of ticks of bare physics, us.
        baseline: Name of the checkout with which this one is compared. None to compare the servo
            level's cycle with its physics.
    """
    cases = list(dict.fromkeys(case for case, _ in cycles))
    samples = []
    parts = {}
    # Keep the contestants of a case together.
    for key in sorted(cycles, key=lambda key: cases.index(key[0])):
        judged_ns = [run.rows["processor_ns"][run.is_judged] for run in cycles[key]]
        samples.append(Sample(*key, tuple((np.concatenate(judged_ns) * 1e-3).tolist()), "us"))
        run_parts = [compute_parts(run) for run in cycles[key]]
        medians = {part: np.concatenate([us[part] for us in run_parts]) for part in PARTS}
        # The bookkeeping of a cycle is in the next record, so a single cycle has no parts.
        if len(medians[PARTS[0]]):
            parts[key] = {part: float(np.median(times_us)) for part, times_us in medians.items()}
    if physics_us:
        samples.append(Sample(PHYSICS_CASE, PHYSICS, tuple(physics_us), "us"))
    baselines = {PHYSICS_CASE: PHYSICS} if baseline is None else dict.fromkeys(cases, baseline)
    return CycleCosts(
        "cycle", "Processor time of a board's cycle", tuple(samples), baselines, parts=parts
    )


def compute_parts(cycles: Cycles) -> dict[str, np.ndarray]:
    """Return a dictionary from each part of a cycle to its processor times, (n,), in us.

    The first cycle, cycles of the start-up and stalled cycles are left out.
    """
    rows = cycles.rows
    rest_ns = (rows["processor_ns"] - cycles.used_ns)[1:]
    # A record contains the bookkeeping of the previous cycle, because its own is not finished when
    # the record is written.
    closing_ns = rows["closed_ns"][1:] - rows["end_ns"][:-1]
    gap = rows["start_ns"][1:] - rows["closed_ns"][1:]
    # An interruption, for example by the clock in lockstep, makes the bookkeeping appear too long.
    # In this case, subtract the known gap to the next start from the rest of the processor time.
    closing_ns = np.where(closing_ns > rest_ns, rest_ns - np.minimum(gap, rest_ns), closing_ns)
    read_ns, process_ns, write_ns = (
        times_ns[1:]
        for times_ns in (
            cycles.exchange_ns + cycles.read_ns,
            cycles.process_ns,
            cycles.write_ns,
        )
    )
    times = rest_ns - closing_ns, read_ns, process_ns, write_ns, closing_ns
    is_judged = cycles.is_judged[1:]
    return {part: ns[is_judged] * 1e-3 for part, ns in zip(PARTS, times, strict=True)}
