"""Partitions of levels over processors: the same rack, run in real time in each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rack.backplane.layout import TaskSpec
from rack.boards.config import RackConfig, loads, rack_timing, resolve
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, BoardConfig, Coupling
from rack.boards.faults.bounds import counting
from rack.levels.timing.trace_times import Distribution, counts, distribution, plans
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import core_loads
from rack.tools.timing.analysis.report import plan_ages_ms

NAME = "nasrem"
SECONDS = 12.0
"""By half of it every level has planned in lockstep; on one processor it takes longer."""
LAUNCH_S = 3.0


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
        """Return the rack in this partition, in real time.

        A loose planner gets its own board on the next core; with only one core, on the same one.

        Raises:
            ConfigError: If the rack does not permit this partition.
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
            changes |= {"planner_slot": next(free), "planner_core": (core + 1) % self.cores}
        return board.model_copy(update=changes)


PARTITIONS: tuple[Partition, ...] = tuple(
    Partition(c, n) for n in (1, 2) for c in ("tight", "loose")
)


@dataclass(frozen=True)
class TaskFigures:
    """One task in a run: its cycles (a planner's plans), and those missed and skipped.

    `fits` says whether its worst-case response time, by the config's budgets, is within its time
    slice; None without a budget.
    """

    cycles: int
    missed: int
    skipped: int
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
    used."""

    partition: str
    levels: tuple[LevelFigures, ...]
    loads: dict[int, float]


@dataclass(frozen=True)
class Partitions:
    """The measurements of all partitions, of runs of `seconds` each."""

    seconds: float
    partitions: tuple[PartitionFigures, ...]


def _run(workshop: Workshop) -> Partitions:
    need_real_time(cores=2)
    config = workshop.config(NAME)
    # All of them are checked before the first one runs.
    racks = {partition.name: partition.of(config) for partition in PARTITIONS}
    runs = {
        name: workshop.run(f"partition-{name.replace(', ', '-')}", rack, SECONDS).recording
        for name, rack in racks.items()
    }
    return Partitions(SECONDS, tuple(_figures(name, run) for name, run in runs.items()))


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(PARTITIONS) * (SECONDS + LAUNCH_S),
    Partitions,
    _run,
)


def _figures(partition: str, run: Recording) -> PartitionFigures:
    rack = rack_timing(run.rack_config, run.layout)
    fits = {response.task: response.holds for response in rack.responses}
    levels = tuple(_level(name, run, fits) for name in run.rack_config.board)
    return PartitionFigures(partition, levels, core_loads(run, cycles_of(run), rack))


def _level(board: str, run: Recording, fits: Mapping[str, bool]) -> LevelFigures:
    tasks = {task.role: task for task in run.layout.tasks if task.board == board}
    executor = _task(tasks["executor"], run, fits)
    if "planner" not in tasks:
        return LevelFigures(board, executor, planner=None, plan_age_ms=None)
    is_known = f"{board}.plan" in run.mailboxes
    age_ms = distribution(plan_ages_ms(run, board)) if is_known else None
    return LevelFigures(board, executor, _task(tasks["planner"], run, fits), age_ms)


def _task(task: TaskSpec, run: Recording, fits: Mapping[str, bool]) -> TaskFigures:
    rows = run.trace(task.name)
    # Releases without a plan are traced only if they were late; of them only the skipped releases
    # count.
    _, skipped = counts(rows)
    if task.role == "planner":
        rows = plans(rows)
    missed, _ = counts(rows)
    return TaskFigures(len(rows), missed, skipped, fits.get(task.name))
