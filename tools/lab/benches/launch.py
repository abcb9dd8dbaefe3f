"""Times that a user waits: launches, short commands, and reactions to a killed board."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random

import pyarrow.compute as pc
import pyarrow.parquet as pq

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.faults.kind import DIED
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.faults.campaigns.plan import Kill
from rack.tools.faults.campaigns.trial import Killer
from rack.tools.faults.evidence import BRAKES
from rack.tools.lab.benches.checkout import THIS_TREE, RackCommand, build_rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, call_interleaved
from rack.tools.lab.benches.observed import remove_run_end

COMMAND_TIMEOUT_S = 60.0
"""Longest time that a command may take, s."""
KILL_INTERVAL_S = 2.5
"""Time between kills, in which the board returns and the arm moves again, s."""
RUN_S = 0.25
"""Simulated time of a run of which only the launch is measured, s."""
LAUNCH = "launch"
INTERPRETER = "python, numpy"
ROUND_S = 8.0
"""Expected time of a round of launches and commands, s."""


def measure_launches(
    name: str, rounds: int, kills: int, against: Path | None, share: bool, progress: Progress
) -> Comparison:
    """Measure how long launches, commands and reactions to kills take.

    Args:
        name: Config of the rack, by name or path.
        rounds: Number of rounds of launches and commands.
        kills: Number of kills of the board that drives the arm.
        against: Another checkout, launched alternately. None if there is none.
        share: Whether to run racks even on cores that another rack uses.
        progress: Shows the progress of launches, commands and kills.

    Raises:
        Failure: If a command fails, or the rack has no arm.
    """
    progress.set_total(rounds * ROUND_S + kills * KILL_INTERVAL_S)
    trees = build_rack_commands(against)
    with tempfile.TemporaryDirectory() as folder:
        progress.begin_run("launches and commands")
        samples = _measure_commands(name, trees, Path(folder), rounds, share)
        progress.end_run(rounds * ROUND_S)
        progress.begin_run("kills")
        samples += measure_kills(name, kills, share)
        progress.end_run(kills * KILL_INTERVAL_S)
    cases = [sample.case for sample in samples if sample.who == INTERPRETER]
    baselines = dict.fromkeys(cases, INTERPRETER)
    if against is not None:
        baselines[LAUNCH] = trees[-1].name
    return Comparison(
        "launch", "launches, short commands, and reactions to a kill", tuple(samples), baselines
    )


def _measure_commands(
    name: str, trees: list[RackCommand], folder: Path, rounds: int, share: bool
) -> list[Sample]:
    """Measure launches and commands alternately."""
    this_tree = trees[0]
    run = make_brief_run(this_tree, name, folder / "run", share)
    idle = load(name, [f"name=bench-{os.getpid()}", "clock.mode=lockstep"])
    commands: dict[str, tuple[object, ...]] = {
        "rack --help": ("--help",),
        "rack list": ("list",),
        "rack status": ("status", idle.name),
        "rack report": ("report", run),
    }
    contestants: dict[tuple[str, str], Callable[[], float]] = {
        (LAUNCH, tree.name): partial(measure_launch_s, tree, name, folder, share) for tree in trees
    }
    python = RackCommand(INTERPRETER, (sys.executable, "-c", "import numpy"))
    for case, arguments in commands.items():
        contestants[case, this_tree.name] = partial(_measure_command_s, this_tree, arguments)
        contestants[case, INTERPRETER] = partial(_measure_command_s, python, ())
    # This rack gives `list` and `status` a rack to show. Its boards only wait for its clock, so it
    # uses no core.
    with Rack(idle):
        times = call_interleaved(contestants, rounds)
    return [
        Sample(case, who, tuple(1e3 * seconds for seconds in times_s), "ms")
        for (case, who), times_s in times.items()
    ]


def measure_launch_s(rack: RackCommand, config: str, folder: Path, share: bool) -> float:
    """Return the time, in s, from the start of `rack run` to the fastest level's first cycle.

    Args:
        rack: Command to launch with.
        config: Config of the rack, by name or path.
        folder: Folder for temporary files.
        share: Whether to run even on cores that another rack uses.
    """
    with tempfile.TemporaryDirectory(dir=folder) as run_folder:
        start_ns = time.monotonic_ns()
        run = make_brief_run(rack, config, Path(run_folder) / "run", share)
        return (find_first_cycle_ns(run, find_fastest_board(load(config))) - start_ns) * 1e-9


def make_brief_run(rack: RackCommand, config: str, out: Path, share: bool) -> Path:
    """Record a short run and return its folder. Only its launch is evaluated.

    Args:
        rack: Command to run.
        config: Config of the rack, by name or path.
        out: Folder of the run.
        share: Whether to run even on cores that another rack uses.
    """
    options = ["--set", f"name=bench-run-{os.getpid()}", "--seconds", f"{RUN_S}", "--json"]
    # Missed cycles must not fail the run. Earlier checkouts do not have this key.
    options += ["--set=supervision.max_missed_fraction=1"] * (rack.name == THIS_TREE)
    options += ["--share"] * share
    rack.run("run", config, *options, "--out", out, bound_s=COMMAND_TIMEOUT_S)
    return out


def find_fastest_board(config: RackConfig) -> str:
    """Return the name of the executor with the shortest period."""
    return min(config.board, key=config.find_period)


def find_first_cycle_ns(run: Path, task: str) -> int:
    """Return the start of a task's first recorded cycle, in ns of CLOCK_MONOTONIC.

    The file is read directly, because another checkout may write other columns.

    Raises:
        Failure: If no cycle of the task was recorded.
    """
    cycles = pq.read_table(run / "cycles.parquet", columns=["task", "start_ns"])
    started = pc.min(cycles.filter(pc.equal(cycles["task"], task))["start_ns"]).as_py()
    if started is None:
        raise Failure(f"{run}: no cycle of '{task}' was recorded")
    return int(started)


def _measure_command_s(rack: RackCommand, arguments: tuple[object, ...]) -> float:
    """Return the time, in s, that a command takes."""
    start_s = time.monotonic()
    rack.run(*arguments, bound_s=COMMAND_TIMEOUT_S)
    return time.monotonic() - start_s


def measure_kills(name: str, count: int, share: bool = True) -> list[Sample]:
    """Repeatedly kill the board that drives the arm, at random phases of its cycle.

    Args:
        name: Config of the rack, by name or path.
        count: Number of kills.
        share: Whether to run even on cores that another rack uses.

    Returns:
        Times from each kill to its detection, and to the engagement of the brakes, ms.

    Raises:
        Failure: If the rack has no arm, or did not react to any kill.
    """
    config = load(name, [f"name=bench-kill-{os.getpid()}", "supervision.restarts=10000"])
    if config.robot is None:
        raise Failure(f"{name}: has no arm whose brakes could engage", 2)
    servo = find_fastest_board(config)
    random = Random(count)
    # Add one tick to vary the phase of each kill within the slower cycles.
    interval_ticks = round(KILL_INTERVAL_S * 1e9 / config.clock_ns) + 1
    kills = [Kill(servo, n * interval_ticks, random.random()) for n in range(1, count + 1)]
    with Rack(remove_run_end(config), share=share) as rack:
        killer = Killer(rack.segment, kills)
        rack.start(KILL_INTERVAL_S * (count + 1))
        while rack.watch(killer.compute_wait_s()):
            killer.kill_due_board()
        # Offset from CLOCK_MONOTONIC to the time of events.
        offset_ns = time.time_ns() - time.monotonic_ns()
        epoch_ns = rack.segment.words[System.EPOCH_NS]
    times_ms: dict[str, list[float]] = {"detected": [], "brakes engaged": []}
    for kill in killer.done:
        events = [event for event in rack.events if 0 <= event.tick - kill.tick < interval_ticks]
        died, braked = (
            next((event for event in events if event.code == code), None) for code in (DIED, BRAKES)
        )
        if died is not None and braked is not None:
            # The restarted board reports the tick at which the brakes engaged.
            braked_ns = epoch_ns + braked.tick * config.clock_ns
            times_ms["detected"].append((died.time_ns - offset_ns - kill.time_ns) * 1e-6)
            times_ms["brakes engaged"].append((braked_ns - kill.time_ns) * 1e-6)
    if not times_ms["detected"]:
        raise Failure(f"'{servo}' was killed {count} times, but nothing reacted")
    return [Sample(f"{servo} killed", who, tuple(times), "ms") for who, times in times_ms.items()]
