"""Partitions of levels over processors: the same rack, run in real time in each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rack.backplane.layout import TaskSpec
from rack.boards.config import RackConfig, loads, rack_timing, resolve
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, BoardConfig, Coupling
from rack.boards.timing.trace_times import counts, plans
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import core_loads

NAME = "nasrem"
SECONDS = 12.0
"""By half of it every level has planned in lockstep; on one processor it takes longer."""
LAUNCH_S = 3.0


@dataclass(frozen=True)
class Partition:
    """One way of placing levels on processors. A board keeps its core, modulo `cores`."""

    coupling: Coupling
    cores: int

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
    """A task in a run: its cycles, of a planner its plans, those missed, and releases skipped."""

    board: str
    role: str
    cycles: int
    missed: int
    skipped: int


@dataclass(frozen=True)
class PartitionFigures:
    """The measurements of one partition; `loads` are the parts of each core's time that its tasks
    used.
    """

    partition: Partition
    tasks: tuple[TaskFigures, ...]
    loads: dict[int, float]


def _measure(workshop: Workshop) -> tuple[PartitionFigures, ...]:
    config = workshop.config(NAME)
    # All of them are checked before the first one runs.
    racks = [(partition, partition.of(config)) for partition in PARTITIONS]
    return tuple(_figures(workshop, *one) for one in racks)


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(PARTITIONS) * (SECONDS + LAUNCH_S),
    tuple[PartitionFigures, ...],
    _measure,
    cores=2,
)


def _figures(workshop: Workshop, partition: Partition, rack: RackConfig) -> PartitionFigures:
    label = f"partition-{partition.coupling}-{partition.cores}"
    run = workshop.run(label, rack, SECONDS).recording
    loads = core_loads(run, cycles_of(run), rack_timing(run.rack_config, run.layout))
    return PartitionFigures(partition, tuple(_task(task, run) for task in run.layout.tasks), loads)


def _task(task: TaskSpec, run: Recording) -> TaskFigures:
    rows = run.trace(task.name)
    # Releases without a plan are traced only if they were late; of them only the skipped releases
    # count.
    _, skipped = counts(rows)
    if task.role == "planner":
        rows = plans(rows)
    missed, _ = counts(rows)
    return TaskFigures(task.board, task.role, len(rows), missed, skipped)
