"""Measures what a user waits for: a launch, short commands, and a rack's reaction to a board that
is killed.
"""

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
from rack.tools.lab.benches.checkout import THIS, RackCommand, rack_commands
from rack.tools.lab.benches.harness import Comparison, Sample, interleaved
from rack.tools.lab.benches.observed import endless

BOUND_S = 60.0
"""Longest time that a command may take."""
KILL_S = 2.5
"""Time between kills: the board is back, and the arm moves again."""
RUN_S = 0.25
"""Simulated time of a run of which only the beginning counts."""
LAUNCH = "launch"
INTERPRETER = "python, numpy"
ROUND_S = 8.0
"""Expected time of a round of launches and commands."""


def measure(
    name: str, rounds: int, kills: int, against: Path | None, share: bool, progress: Progress
) -> Comparison:
    """Return how long launches, commands and reactions to kills take.

    Args:
        name: Config of the rack, by name or path.
        rounds: Rounds of launches and commands.
        kills: Kills of the board that drives the arm.
        against: Another checkout, launched by turns.
        share: Run racks even on cores that another one holds.
        progress: Told of both parts.

    Raises:
        Failure: If a command fails, or the rack has no arm.
    """
    progress.total(rounds * ROUND_S + kills * KILL_S)
    trees = rack_commands(against)
    with tempfile.TemporaryDirectory() as folder:
        progress.begin("launches and commands")
        samples = _measure_commands(name, trees, Path(folder), rounds, share)
        progress.end(rounds * ROUND_S)
        progress.begin("kills")
        samples += measure_kills(name, kills, share)
        progress.end(kills * KILL_S)
    cases = [sample.case for sample in samples if sample.who == INTERPRETER]
    baselines = dict.fromkeys(cases, INTERPRETER)
    if against is not None:
        baselines[LAUNCH] = trees[-1].name
    title = "launches, short commands, and reactions to a kill"
    return Comparison("launch", title, tuple(samples), baselines)


def _measure_commands(
    name: str, trees: list[RackCommand], folder: Path, rounds: int, share: bool
) -> list[Sample]:
    """Return the times of launches and commands, all measured by turns."""
    own = trees[0]
    run = run_briefly(own, name, folder / "run", share)
    idle = load(name, [f"name=bench-{os.getpid()}", "clock.mode=lockstep"])
    commands: dict[str, tuple[object, ...]] = {
        "rack --help": ("--help",),
        "rack list": ("list",),
        "rack status": ("status", idle.name),
        "rack report": ("report", run),
    }
    contestants: dict[tuple[str, str], Callable[[], float]] = {
        (LAUNCH, tree.name): partial(launch_s, tree, name, folder, share) for tree in trees
    }
    python = RackCommand(INTERPRETER, (sys.executable, "-c", "import numpy"))
    for case, arguments in commands.items():
        contestants[case, own.name] = partial(_command_s, own, arguments)
        contestants[case, INTERPRETER] = partial(_command_s, python, ())
    # Its boards are up and wait for the clock: `list` and `status` have a rack to show, which takes
    # no core.
    with Rack(idle):
        times = interleaved(contestants, rounds)
    return [
        Sample(case, who, tuple(1e3 * seconds for seconds in found), "ms")
        for (case, who), found in times.items()
    ]


def launch_s(rack: RackCommand, config: str, folder: Path, share: bool) -> float:
    """Return the time from a `rack run` to the first cycle of its fastest level, s."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        began_ns = time.monotonic_ns()
        run = run_briefly(rack, config, Path(place) / "run", share)
        return (first_cycle_ns(run, fastest(load(config))) - began_ns) * 1e-9


def run_briefly(rack: RackCommand, config: str, out: Path, share: bool) -> Path:
    """Make a run of which only the beginning counts; return its folder."""
    options = ["--set", f"name=bench-run-{os.getpid()}", "--seconds", f"{RUN_S}", "--json"]
    # Whether its cycles come in time does not count. Earlier checkouts do not have this key.
    options += ["--set=supervision.max_missed_fraction=1"] * (rack.name == THIS)
    options += ["--share"] * share
    rack.run("run", config, *options, "--out", out, bound_s=BOUND_S)
    return out


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


def measure_kills(name: str, count: int, share: bool = True) -> list[Sample]:
    """Kill the board that drives the arm again and again, from outside and at any phase of its
    cycle; return the times to detection and to engaged brakes.

    Raises:
        Failure: If the rack has no arm, or no kill had a reaction.
    """
    config = load(name, [f"name=bench-kill-{os.getpid()}", "supervision.restarts=10000"])
    if config.robot is None:
        raise Failure(f"{name}: no arm whose brakes could engage", 2)
    servo = fastest(config)
    random = Random(count)
    # One tick more than a multiple of the slower cycles: each kill comes at another phase of them.
    between = round(KILL_S * 1e9 / config.clock_ns) + 1
    kills = [Kill(servo, at * between, random.random()) for at in range(1, count + 1)]
    with Rack(endless(config), share=share) as rack:
        killer = Killer(rack.segment, kills)
        rack.start(KILL_S * (count + 1))
        while rack.watch(killer.due_in_s()):
            killer.advance()
        # From CLOCK_MONOTONIC to the time of events.
        offset_ns = time.time_ns() - time.monotonic_ns()
        epoch_ns = rack.segment.words[System.EPOCH_NS]
    times_ms: dict[str, list[float]] = {"detected": [], "brakes engaged": []}
    for kill in killer.done:
        own = [event for event in rack.events if 0 <= event.tick - kill.tick < between]
        died, braked = (
            next((event for event in own if event.code == code), None) for code in (DIED, BRAKES)
        )
        if died is not None and braked is not None:
            # The board reports the brakes once it is back, with the tick at which they engaged.
            braked_ns = epoch_ns + braked.tick * config.clock_ns
            times_ms["detected"].append((died.time_ns - offset_ns - kill.time_ns) * 1e-6)
            times_ms["brakes engaged"].append((braked_ns - kill.time_ns) * 1e-6)
    if not times_ms["detected"]:
        raise Failure(f"'{servo}' was killed {count} times: no reactions")
    return [Sample(f"{servo} killed", who, tuple(found), "ms") for who, found in times_ms.items()]
