"""Measures what a user waits for: a launch, short commands, and a rack's reaction to a board that is killed."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq

from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.tools.benches.checkout import RackCommand, checkout, this_rack
from rack.tools.benches.comparison import Comparison, Sample, interleaved
from rack.tools.benches.kill import Killing
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress

BOUND_S = 60.0
"""Longest time that a command may take."""
RUN_S = 0.25
"""Simulated time of a run of which only the beginning counts."""
LAUNCH, INTERPRETER = "launch", "python, numpy"
ROUND_S, KILL_S = 8.0, 2.5
"""Expected time of a round of launches and commands, and of a kill."""

Key = tuple[str, str]
"""Case and contestant."""


def measure(name: str, rounds: int, kills: int, against: Path | None, progress: Progress) -> Comparison:
    """Return how long launches, commands and reactions to kills take; `against` is another checkout, launched by turns.

    Raises `Failure` if a command fails, or a kill has no reaction.
    """
    progress.total(rounds * ROUND_S + 2 * kills * KILL_S)
    own = this_rack()
    with ExitStack() as stack:
        other = None if against is None else stack.enter_context(checkout(against))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        trees = [own, *([] if other is None else [other])]
        progress.begin("launches and commands")
        samples = list(_samples(name, trees, rounds, folder))
        progress.end(rounds * ROUND_S, "done", ())
    killing = Killing(name, kills, progress)
    samples += [sample for board in killing.boards for sample in killing.samples(board, KILL_S)]
    cases = dict.fromkeys(sample.case for sample in samples if sample.who == INTERPRETER)
    baselines = dict.fromkeys(cases, INTERPRETER) | ({} if other is None else {LAUNCH: other.name})
    return Comparison("launch", "launches, short commands, and reactions to a kill", tuple(samples), baselines)


def _samples(name: str, trees: list[RackCommand], rounds: int, folder: Path) -> Iterator[Sample]:
    """Yield the times of launches and commands, all measured by turns."""
    own = trees[0]
    run = folder / "run"
    idle = load(name, [f"name=bench-{os.getpid()}", "clock.mode=lockstep"])
    own.run("run", name, *_named("run"), "--seconds", RUN_S, "--out", run, "--json", bound_s=BOUND_S)
    commands: Mapping[str, tuple[object, ...]] = {
        "rack --help": ("--help",),
        "rack list": ("list",),
        "rack status": ("status", idle.name),
        "rack report": ("report", run),
    }
    contestants: dict[Key, Callable[[], float]] = {
        (LAUNCH, tree.name): partial(launch_s, tree, name, folder / f"{at}") for at, tree in enumerate(trees)
    }
    python = RackCommand(INTERPRETER, (sys.executable, "-c", "import numpy"), own.environment, "")
    for case, arguments in commands.items():
        contestants[case, own.name] = partial(_command_s, own, arguments)
        contestants[case, INTERPRETER] = partial(_command_s, python, ())
    # Its boards are up and wait for the clock: `list` and `status` have a rack to show, which takes no core.
    with Rack(idle):
        times = interleaved(contestants, rounds)
    for (case, who), found in times.items():
        # A launch takes seconds, all else milliseconds.
        yield Sample(case, who, tuple(1e3 * seconds for seconds in found), "ms")


def launch_s(rack: RackCommand, config: str, folder: Path) -> float:
    """Return the time from a `rack run` to the first cycle of its fastest level, s."""
    task = fastest(load(config))
    with tempfile.TemporaryDirectory(dir=folder.parent) as place:
        out = Path(place) / "run"
        began_ns = time.monotonic_ns()
        rack.run("run", config, *_named("run"), "--seconds", RUN_S, "--out", out, "--json", bound_s=BOUND_S)
        return (first_cycle_ns(out, task) - began_ns) * 1e-9


def fastest(config: RackConfig) -> str:
    """Return the executor with the shortest period."""
    return min(config.board, key=config.every)


def first_cycle_ns(run: Path, task: str) -> int:
    """Return when the first recorded cycle of a task started, CLOCK_MONOTONIC, ns. Raises `Failure` without any.

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


def _named(kind: str) -> tuple[str, str]:
    return "--set", f"name=bench-{kind}-{os.getpid()}"
