"""Partitions of levels over processors: the same rack runs in real time in each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from rack.backplane.layout import TaskSpec
from rack.boards.config import RackConfig, build_rack_timing, load_text, resolve
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, BoardConfig, Coupling
from rack.boards.timing.trace_times import count_misses_and_skips, select_plans
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.recording.cycles import read_cycles
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import compute_core_loads

NAME = "nasrem"
SECONDS = 12.0
"""Time of a run, s.

In lockstep, every level has made a plan after half of this time. On one processor it takes longer.
"""
LAUNCH_S = 3.0


@dataclass(frozen=True)
class Partition:
    """A placement of levels on processors. Each board keeps its core, modulo `cores`."""

    coupling: Coupling
    cores: int

    def apply_to(self, config: RackConfig) -> RackConfig:
        """Return the config of the rack in this partition, in real time.

        A loose planner gets a separate board on the next core, or on the same core if there is only
        one.

        Raises:
            ConfigError: If the rack does not permit this partition.
        """
        taken = {board.slot for board in config.board.values()}
        free = (slot for slot in range(CLOCK_SLOT + 1, LAST_SLOT + 1) if slot not in taken)
        boards = {name: self._place_board(board, free) for name, board in config.board.items()}
        clock = config.clock.model_copy(
            update={"mode": "realtime", "core": config.clock.core % self.cores}
        )
        changed = config.model_copy(update={"board": boards, "clock": clock})
        # A copy is not validated, therefore load and check it like a user's config.
        return resolve(load_text(changed.to_toml_text())).config

    def _place_board(self, board: BoardConfig, free_slots: Iterator[int]) -> BoardConfig:
        """Return a board on its core, with its planner coupled as in this partition."""
        core = board.core % self.cores
        changes: dict[str, object] = {"core": core, "planner_slot": None, "planner_core": None}
        if board.planner is not None:
            changes["coupling"] = self.coupling
        if board.planner is not None and self.coupling == "loose":
            changes |= {"planner_slot": next(free_slots), "planner_core": (core + 1) % self.cores}
        return board.model_copy(update=changes)


PARTITIONS: tuple[Partition, ...] = tuple(
    Partition(c, n) for n in (1, 2) for c in ("tight", "loose")
)


@dataclass(frozen=True)
class TaskFigures:
    """Counts of a task in a run. For a planner, plans are counted instead of cycles."""

    board: str
    role: str
    cycles: int
    missed: int
    skipped: int


@dataclass(frozen=True)
class PartitionFigures:
    """Measurements of one partition.

    Attributes:
        partition: The partition.
        tasks: Counts of each task.
        loads: Fraction of each core's time that the tasks used.
    """

    partition: Partition
    tasks: tuple[TaskFigures, ...]
    loads: dict[int, float]


def _measure_partitions(workshop: Workshop) -> tuple[PartitionFigures, ...]:
    """Run the rack in every partition."""
    config = workshop.load_config(NAME)
    # Check all configs before the first rack runs.
    racks = [(partition, partition.apply_to(config)) for partition in PARTITIONS]
    return tuple(_measure_partition(workshop, *pair) for pair in racks)


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(PARTITIONS) * (SECONDS + LAUNCH_S),
    tuple[PartitionFigures, ...],
    _measure_partitions,
    cores=2,
)


def _measure_partition(
    workshop: Workshop, partition: Partition, rack: RackConfig
) -> PartitionFigures:
    """Run a rack in a partition, and return the counts of its tasks."""
    run = workshop.run(f"partition-{partition.coupling}-{partition.cores}", rack, SECONDS).recording
    loads = compute_core_loads(
        run, read_cycles(run), build_rack_timing(run.rack_config, run.layout)
    )
    return PartitionFigures(
        partition, tuple(_count_task(task, run) for task in run.layout.tasks), loads
    )


def _count_task(task: TaskSpec, run: Recording) -> TaskFigures:
    """Count the cycles of a task, or the plans of a planner."""
    rows = run.read_trace(task.name)
    # A planner's release without a plan is traced only if it was late. Such a record counts only
    # for the releases that were skipped before it.
    _, skipped = count_misses_and_skips(rows)
    if task.role == "planner":
        rows = select_plans(rows)
    missed, _ = count_misses_and_skips(rows)
    return TaskFigures(task.board, task.role, len(rows), missed, skipped)
