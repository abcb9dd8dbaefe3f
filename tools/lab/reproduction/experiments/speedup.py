"""Plans per second of levels on one, two and more processors, and of a sequential program."""

from __future__ import annotations

import os
from dataclasses import dataclass

from rack.boards.config import load_text
from rack.boards.config.schema import CLOCK_SLOT
from rack.boards.config.toml import to_toml
from rack.levels.systems import figures
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

LEVELS = 4
EXECUTOR_MS = 0.2
PLAN_MS = 3.0
CYCLE_MS = 4
"""Cycle of a level, ms. A planner starts at most one plan in it."""
SEQUENTIAL_CYCLE_MS = 14
"""Cycle of the program that computes all levels and their plans, ms."""
MAX_CORES = 4
SECONDS = 2.0
LAUNCH_S = 2.5


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
    cores = sorted(os.sched_getaffinity(0))[:MAX_CORES]
    work_ms = LEVELS * (EXECUTOR_MS + PLAN_MS)
    program = {
        "executor": _name(figures.FigureLoop),
        "every": SEQUENTIAL_CYCLE_MS,
        "params": {"process_ms": work_ms},
    }
    level = {
        "every": CYCLE_MS,
        "executor": _name(figures.FigureExecutor),
        "planner": _name(figures.FigurePlanner),
        "coupling": "tight",
        "planner_priority": 40,
        "params": {"process_ms": EXECUTOR_MS, "plan_ms": PLAN_MS},
    }
    return SpeedupRun(
        LEVELS * _count_per_s(workshop, [program], cores[:1], "cycles"),
        {
            count: _count_per_s(workshop, [level] * LEVELS, cores[:count], "plans")
            for count in range(1, len(cores) + 1)
        },
    )


def _name(executor: type) -> str:
    """Return the name of a class as a config gives it."""
    return f"{executor.__module__}:{executor.__name__}"


def _count_per_s(
    workshop: Workshop, levels: list[dict[str, object]], cores: list[int], counted: str
) -> float:
    """Run levels on processors, and return the sum of a count of their tasks per second.

    Args:
        workshop: Folder and settings of the run.
        levels: Tables of their boards.
        cores: Processors, which the levels take in turn.
        counted: "cycles" or "plans".
    """
    boards = {
        f"level{number}": {
            "slot": CLOCK_SLOT + 1 + number,
            "core": cores[number % len(cores)],
            "priority": 80,
            **level,
        }
        for number, level in enumerate(levels)
    }
    clock = {"period_ms": 1, "mode": "realtime", "core": cores[0], "priority": 90}
    text = to_toml({"name": "speedup", "clock": clock, "board": boards})
    config = load_text(workshop.find_source(text)).model_copy(update={"name": workshop.rack})
    run = workshop.run(f"speedup-{counted}-{len(cores)}", config, SECONDS)
    total = sum(task[counted] for task in run.result.tasks.values())
    return total * 1e9 / (run.result.outcome.ticks * config.clock_ns)


SPEEDUP = Experiment(
    "speedup",
    "the same plans by one program, and by levels on more and more processors",
    (1 + 2) * (SECONDS + LAUNCH_S),
    SpeedupRun,
    _measure_speedup,
    cores=2,
)
