"""Measures what a user waits for: a launch, short commands, and a rack's reaction to a board that
is killed."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pyarrow.compute as pc
import pyarrow.parquet as pq

from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.checkout import RackCommand, rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved
from rack.tools.lab.benches.kill import KILL_S, Killing

BOUND_S = 60.0
"""Longest time that a command may take."""
RUN_S = 0.25
"""Simulated time of a run of which only the beginning counts."""
LAUNCH = "launch"
INTERPRETER = "python, numpy"
ROUND_S = 8.0
"""Expected time of a round of launches and commands."""

Key = tuple[str, str]
"""Case and contestant."""


class LaunchCounts(NamedTuple):
    """Rounds of launches and commands, and kills of each board."""

    rounds: int
    kills: int


def measure(
    name: str, counts: LaunchCounts, against: Path | None, share: bool, progress: Progress
) -> Comparison:
    """Return how long launches, commands and reactions to kills take; `against` is another
    checkout, launched by turns.

    With `share`, racks run even on cores that another one holds. Raises `Failure` if a command
    fails, or a kill has no reaction.
    """
    rounds, kills = counts
    progress.total(rounds * ROUND_S + 2 * kills * KILL_S)
    trees = rack_commands(against)
    with tempfile.TemporaryDirectory() as folder:
        progress.begin("launches and commands")
        samples = list(_samples(name, trees, ShortRuns(Path(folder), share), rounds))
        progress.end(rounds * ROUND_S)
    killing = Killing(name, kills, progress)
    samples += [sample for board in killing.boards for sample in killing.samples(board)]
    cases = dict.fromkeys(sample.case for sample in samples if sample.who == INTERPRETER)
    baselines = dict.fromkeys(cases, INTERPRETER)
    if against is not None:
        baselines[LAUNCH] = trees[-1].name
    return Comparison(
        "launch", "launches, short commands, and reactions to a kill", tuple(samples), baselines
    )


class ShortRuns(NamedTuple):
    """Runs of a config of which only the beginning counts: in subfolders of `folder`; on the cores
    of others if so."""

    folder: Path
    share: bool = False

    def launch_s(self, rack: RackCommand, config: str) -> float:
        """Return the time from a `rack run` to the first cycle of its fastest level, s."""
        with tempfile.TemporaryDirectory(dir=self.folder) as place:
            began_ns = time.monotonic_ns()
            run = self.run(rack, config, Path(place) / "run")
            return (first_cycle_ns(run, fastest(load(config))) - began_ns) * 1e-9

    def run(self, rack: RackCommand, config: str, out: Path) -> Path:
        """Make a run; return its folder."""
        options = ["--share"] if self.share else []
        options += ["--set", f"name=bench-run-{os.getpid()}", "--seconds", f"{RUN_S}", "--json"]
        rack.run("run", config, *options, "--out", out, bound_s=BOUND_S)
        return out


def _samples(name: str, trees: list[RackCommand], runs: ShortRuns, rounds: int) -> Iterator[Sample]:
    """Yield the times of launches and commands, all measured by turns."""
    own = trees[0]
    run = runs.run(own, name, runs.folder / "run")
    idle = load(name, [f"name=bench-{os.getpid()}", "clock.mode=lockstep"])
    commands: Mapping[str, tuple[object, ...]] = {
        "rack --help": ("--help",),
        "rack list": ("list",),
        "rack status": ("status", idle.name),
        "rack report": ("report", run),
    }
    contestants: dict[Key, Callable[[], float]] = {
        (LAUNCH, tree.name): partial(runs.launch_s, tree, name) for tree in trees
    }
    python = RackCommand(INTERPRETER, (sys.executable, "-c", "import numpy"))
    for case, arguments in commands.items():
        contestants[case, own.name] = partial(_command_s, own, arguments)
        contestants[case, INTERPRETER] = partial(_command_s, python, ())
    # Its boards are up and wait for the clock: `list` and `status` have a rack to show, which takes
    # no core.
    with Rack(idle):
        times = interleaved(contestants, rounds)
    for (case, who), found in times.items():
        # A launch takes seconds, all else milliseconds.
        yield Sample(case, who, tuple(1e3 * seconds for seconds in found), "ms")


def fastest(config: RackConfig) -> str:
    """Return the executor with the shortest period."""
    return min(config.board, key=config.every)


def first_cycle_ns(run: Path, task: str) -> int:
    """Return when the first recorded cycle of a task started, CLOCK_MONOTONIC, ns. Raises `Failure`
    without any.

    It reads the file itself: that of another checkout may have other columns.
    """
    cycles = pq.read_table(run / "cycles.parquet", columns=["task", "start_ns"])
    started = pc.min(cycles.filter(pc.equal(cycles["task"], task))["start_ns"]).as_py()
    if started is None:
        raise Failure(f"{run}: no cycle of '{task}' was recorded")
    return int(started)


def _command_s(rack: RackCommand, arguments: tuple[object, ...]) -> float:
    began = time.monotonic()
    rack.run(*arguments, bound_s=BOUND_S)
    return time.monotonic() - began
