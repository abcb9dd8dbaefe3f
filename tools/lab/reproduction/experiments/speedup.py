"""Plans per second of levels on one, two and more processors, and of a sequential program."""

from __future__ import annotations

import os
from dataclasses import dataclass

from rack.boards.config import load_text
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

LEVELS = 4
EXECUTOR_MS = 0.2
PLAN_MS = 3.0
SECONDS = 2.0
LAUNCH_S = 2.5
CLOCK = """
[clock]
period_ms = 1
mode = "realtime"
core = 0
priority = 90
"""
PROGRAM = f"""
[board.program]
slot = 2
core = 0
every = 14
priority = 80
executor = "rack.levels.systems.figures:FigureLoop"
params = {{ process_ms = {LEVELS * (EXECUTOR_MS + PLAN_MS)} }}
"""
"""A program that computes all levels and a plan of each in a cycle."""
LEVEL = f"""
[board.level{{number}}]
slot = {{slot}}
core = {{core}}
every = 4
priority = 80
planner_priority = 40
executor = "rack.levels.systems.figures:FigureExecutor"
planner = "rack.levels.systems.figures:FigurePlanner"
coupling = "tight"
within_cycles = 1
params = {{{{ process_ms = {EXECUTOR_MS}, plan_ms = {PLAN_MS} }}}}
"""
"""A level whose planner begins at most one plan in a cycle."""


@dataclass(frozen=True)
class SpeedupRun:
    """Plans per second.

    Attributes:
        sequential: Plans of one program that computes level after level and plan after plan.
        by_cores: Plans of concurrent levels with planners, by number of processors.
    """

    sequential: float
    by_cores: dict[int, float]


def _measure_speedup(workshop: Workshop) -> SpeedupRun:
    """Run the levels as one sequential program, then concurrently on more and more processors."""
    cores = min(len(os.sched_getaffinity(0)), LEVELS)
    by_cores = {}
    for count in range(1, cores + 1):
        boards = (LEVEL.format(number=n, slot=n + 2, core=n % count) for n in range(LEVELS))
        by_cores[count] = _count_per_s(workshop, "plans", "".join(boards))
    return SpeedupRun(LEVELS * _count_per_s(workshop, "cycles", PROGRAM), by_cores)


def _count_per_s(workshop: Workshop, counted: str, boards: str) -> float:
    """Run a rack, and return the sum of a count of its tasks per second.

    Args:
        workshop: Folder and settings of the run.
        counted: "cycles" or "plans".
        boards: TOML text of its boards.
    """
    text = f'name = "{workshop.rack}"{CLOCK}{boards}'
    config = load_text(workshop.find_source(text))
    result, recording = workshop.run(f"speedup-{counted}", config, SECONDS)
    total = sum(task[counted] for task in result.tasks.values())
    return total * 1e9 / (result.outcome.ticks * recording.layout.clock_ns)


SPEEDUP = Experiment(
    "speedup",
    "the same plans by one program, and by levels on more and more processors",
    (1 + 2) * (SECONDS + LAUNCH_S),
    SpeedupRun,
    _measure_speedup,
    cores=2,
)
