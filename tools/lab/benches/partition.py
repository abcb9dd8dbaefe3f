"""Compares partitions of levels over processors: the same rack, run in real time in each, rounds
interleaved."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.boards.config import RackConfig, load, loads, rack_timing, resolve, wire
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, BoardConfig, Coupling
from rack.boards.faults.bounds import counting
from rack.levels.timing.response_time import TaskResponse
from rack.levels.timing.trace_times import (
    Distribution,
    counts,
    distribution,
    plans,
    residual_ns,
)
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import figure, table
from rack.tools.lab.benches.harness import BenchResult, interleaved
from rack.tools.lab.benches.observed import record
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import core_loads
from rack.tools.timing.analysis.report import plan_ages_ms

LAUNCH_S = 3.0
"""About how long launching and recording a run take in addition to its time."""
PLANNERS_DROPPED = ("plans", "residual p50", "age p50")
"""Columns that a narrow terminal leaves out, in this order."""


@dataclass(frozen=True)
class Partition:
    """One way of placing levels on processors. A board keeps its core, modulo `cores`."""

    coupling: Coupling
    cores: int

    @property
    def name(self) -> str:
        """The partition, in words."""
        return f"{self.coupling}, {counting(self.cores, 'core')}"

    def of(self, config: RackConfig) -> RackConfig:
        """Return the rack in this partition, in real time. Raises `ConfigError` if the rack does
        not permit it.

        A loose planner gets its own board on the next core; with only one core, on the same one.
        """
        taken = {board.slot for board in config.board.values()}
        free = (slot for slot in range(CLOCK_SLOT + 1, LAST_SLOT + 1) if slot not in taken)
        boards = {name: self._board(board, free) for name, board in config.board.items()}
        clock = config.clock.model_copy(
            update={"mode": "realtime", "core": config.clock.core % self.cores}
        )
        changed = config.model_copy(update={"board": boards, "clock": clock})
        # A copy is not validated: load and check it like a user's config.
        return resolve(loads(changed.text())).config

    def _board(self, board: BoardConfig, free: Iterator[int]) -> BoardConfig:
        core = board.core % self.cores
        changes: dict[str, object] = {"core": core, "planner_slot": None, "planner_core": None}
        if board.planner is not None:
            changes["coupling"] = self.coupling
        if board.planner is not None and self.coupling == "loose":
            slot = next(free, None)
            if slot is None:
                raise Failure(
                    f"the crate has no slot left for every planner: slots go up to {LAST_SLOT}"
                )
            changes |= {"planner_slot": slot, "planner_core": (core + 1) % self.cores}
        return board.model_copy(update=changes)


PARTITIONS: tuple[Partition, ...] = tuple(
    Partition(c, n) for n in (1, 2) for c in ("tight", "loose")
)


@dataclass(frozen=True)
class TaskFigures:
    """One task over all runs of a partition: cycles (a planner's plans), misses, and the rest of
    its time slice.

    `predicted_ms` is the worst-case response time by the config's budgets, None without a bound.
    `fits` says whether it is within the time slice, None without a budget.
    """

    slice_ms: float
    cycles: int
    missed: int
    skipped: int
    residual_ms: Distribution | None
    predicted_ms: float | None
    fits: bool | None


@dataclass(frozen=True)
class LevelFigures:
    """One level in one partition. `plan_age_ms` is the age of the plans that its executor could
    read."""

    level: str
    executor: TaskFigures
    planner: TaskFigures | None
    plan_age_ms: Distribution | None


@dataclass(frozen=True)
class PartitionFigures:
    """The measurements of one partition; `loads` are the parts of each core's time that its tasks
    used in the last run."""

    partition: str
    levels: tuple[LevelFigures, ...]
    loads: dict[int, float]


@dataclass(frozen=True)
class Partitions(BenchResult):
    """The measurements of all partitions of a rack."""

    name = "partition"

    config: str
    seconds: float
    rounds: int
    partitions: tuple[PartitionFigures, ...]

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield two tables for people, fitted to `width`: executors, and planners with their plan
        ages; times in ms."""
        executors = []
        planners = []
        for one in self.partitions:
            for level in one.levels:
                place = [one.partition, level.level]
                task = level.executor
                residuals = _cells(task.residual_ms, "p50", "min")
                executors.append([*place, *_counts(task), f"{task.skipped}", *residuals])
                if (planner := level.planner) is not None:
                    residuals = _cells(planner.residual_ms, "p50", "min")
                    ages = _cells(level.plan_age_ms, "p50", "max")
                    planners.append([*place, *_counts(planner), *residuals, *ages])
        yield "executors: predicted worst-case response, and residual, ms"
        head = [
            "partition",
            "level",
            "cycle",
            "predicted",
            "cycles",
            "missed",
            "skipped",
            "residual p50",
            "residual min",
        ]
        yield from table(head, executors, width, ("cycles", "residual p50"))
        yield ""
        yield "planners: the same for a plan's time slice, and the age of plans when read, ms"
        head = [
            "partition",
            "level",
            "slice",
            "predicted",
            "plans",
            "late",
            "residual p50",
            "residual min",
        ]
        yield from table([*head, "age p50", "age max"], planners, width, PLANNERS_DROPPED)


def measure(name: str, seconds: float, rounds: int, progress: Progress) -> Partitions:
    """Run every partition of a rack `rounds` times for `seconds`, interleaved, and return the
    figures."""
    config = load(name, [f"name=bench-{os.getpid()}"])
    racks = {partition: partition.of(config) for partition in PARTITIONS}
    each_s = seconds + LAUNCH_S
    progress.total(len(racks) * rounds * each_s)
    with TemporaryDirectory(prefix="rack-bench-") as scratch:
        runs = {
            partition.name: partial(_run, rack, seconds, scratch)
            for partition, rack in racks.items()
        }
        found = interleaved(runs, rounds, progress, each_s)
        figures = (_figures(each, rack, found[each.name]) for each, rack in racks.items())
        return Partitions(name, seconds, rounds, tuple(figures))


def _run(rack: RackConfig, seconds: float, scratch: str) -> Recording:
    return record(rack, seconds, Path(mkdtemp(dir=scratch))).recording


def _figures(
    partition: Partition, config: RackConfig, runs: Sequence[Recording]
) -> PartitionFigures:
    layout = wire(config)
    rack = rack_timing(config, layout)
    responses = {response.task: response for response in rack.responses}
    return PartitionFigures(
        partition.name,
        tuple(_level(name, layout, responses, runs) for name in config.board),
        core_loads(runs[-1], cycles_of(runs[-1]), rack),
    )


def _level(
    board: str, layout: Layout, responses: Mapping[str, TaskResponse], runs: Sequence[Recording]
) -> LevelFigures:
    tasks = {task.name: task for task in layout.tasks}
    executor = _task(tasks[board], layout.clock_ns, responses, runs)
    if f"{board}.planner" not in tasks:
        return LevelFigures(board, executor, planner=None, plan_age_ms=None)
    planner = _task(tasks[f"{board}.planner"], layout.clock_ns, responses, runs)
    plan = f"{board}.plan"
    ages = [plan_ages_ms(run, board) for run in runs if plan in run.mailboxes]
    age_ms = distribution(np.concatenate(ages)) if ages else None
    return LevelFigures(board, executor, planner, age_ms)


def _task(
    task: TaskSpec, tick_ns: int, responses: Mapping[str, TaskResponse], runs: Sequence[Recording]
) -> TaskFigures:
    cycles = np.concatenate([run.trace(task.name) for run in runs])
    # Releases without a plan are traced only if they were late; of them only the skipped releases
    # count.
    _, skipped = counts(cycles)
    cycles = plans(cycles) if task.role == "planner" else cycles
    missed, _ = counts(cycles)
    slice_ns = task.slice * tick_ns
    response = responses.get(task.name)
    fits = None if response is None else response.holds
    predicted_ms = None
    if response is not None and response.response_ns is not None:
        predicted_ms = response.response_ns * 1e-6
    return TaskFigures(
        slice_ms=slice_ns * 1e-6,
        cycles=len(cycles),
        missed=missed,
        skipped=skipped,
        residual_ms=distribution(residual_ns(cycles, slice_ns) * 1e-6),
        predicted_ms=predicted_ms,
        fits=fits,
    )


def _counts(task: TaskFigures) -> list[str]:
    """Return the time slice, the predicted response, and the cycles with those missed."""
    response = "-"
    if task.fits is not None:
        response = "no bound" if task.predicted_ms is None else f"{task.predicted_ms:.2f}"
    if task.fits is False:
        response += " FAILS"
    return [f"{task.slice_ms:g}", response, f"{task.cycles}", f"{task.missed}"]


def _cells(found: Distribution | None, *names: str) -> list[str]:
    return [figure(found, name, 2) for name in names]
