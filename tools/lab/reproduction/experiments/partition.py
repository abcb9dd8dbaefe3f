"""Partitions of levels over processors: the same rack runs in real time in each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.boards.config import RackConfig, build_rack_timing, load_text, resolve
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, BoardConfig, Coupling
from rack.boards.timing.trace_times import count_misses_and_skips, select_plans
from rack.tools.lab.benches.observed import ObservedRun
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.recording.cycles import read_cycles
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import compute_core_loads
from rack.tools.report.arm_outcome import DRIVING, find_signals

NAME = "nasrem"
SECONDS = 12.0
"""Time of a run, s.

In lockstep, every level has made a plan after half of this time. On one processor it takes longer.
"""
TASK = "nasrem-three-poses"
TASK_S = 11.0
MAX_TASK_S = 25.0
"""Expected and longest time of a task that is done in every partition, s."""
LAUNCH_S = 3.0
COMPARED_CYCLES = 8
"""Cycles of the arm from one compared point of its path to the next."""


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
        ended: Reason for the end of the run.
        moved_rad: Length of the arm's path in joint space, rad.
        off_path_rad: Largest distance between this path and that in the first partition, rad.
    """

    partition: Partition
    tasks: tuple[TaskFigures, ...]
    loads: dict[int, float]
    ended: str
    moved_rad: float
    off_path_rad: float


def _measure_partitions(workshop: Workshop) -> tuple[PartitionFigures, ...]:
    """Run NASREM in every partition, as far as in `SECONDS`."""
    return _run_partitions(workshop, NAME, SECONDS)


def _measure_tasks(workshop: Workshop) -> tuple[PartitionFigures, ...]:
    """Run a whole task in every partition."""
    return _run_partitions(workshop, TASK, MAX_TASK_S)


def _run_partitions(workshop: Workshop, name: str, seconds: float) -> tuple[PartitionFigures, ...]:
    """Run a rack in every partition, for at most `seconds`."""
    config = workshop.load_config(name)
    # Check all configs before the first rack runs.
    racks = [partition.apply_to(config) for partition in PARTITIONS]
    runs = [
        workshop.run(f"partition-{seconds:g}-{partition.coupling}-{partition.cores}", rack, seconds)
        for partition, rack in zip(PARTITIONS, racks, strict=True)
    ]
    first = _read_path(runs[0].recording)
    return tuple(_summarize_run(*pair, first) for pair in zip(PARTITIONS, runs, strict=True))


PARTITION = Experiment(
    "partition",
    "nasrem with its planners on one core and on two",
    len(PARTITIONS) * (SECONDS + LAUNCH_S),
    tuple[PartitionFigures, ...],
    _measure_partitions,
    cores=2,
)
TASKS = Experiment(
    "partition-tasks",
    "the same task with its planners on one core and on two",
    len(PARTITIONS) * (TASK_S + LAUNCH_S),
    tuple[PartitionFigures, ...],
    _measure_tasks,
    cores=2,
)


def _summarize_run(partition: Partition, run: ObservedRun, first: np.ndarray) -> PartitionFigures:
    """Return the measurements of a partition.

    Args:
        partition: The partition.
        run: Its run.
        first: Path in the first partition, rad, shape (n, joints).
    """
    recording = run.recording
    path = _read_path(recording)
    loads = compute_core_loads(
        recording,
        read_cycles(recording),
        build_rack_timing(recording.rack_config, recording.layout),
    )
    return PartitionFigures(
        partition,
        tuple(_count_task(task, recording) for task in recording.layout.tasks),
        loads,
        ended=run.result.outcome.cause,
        moved_rad=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        off_path_rad=max(compute_distance(path, first), compute_distance(first, path)),
    )


def _read_path(recording: Recording) -> np.ndarray:
    """Return the joint positions of the arm in each of its cycles, rad, shape (n, joints)."""
    signals = find_signals(recording, *DRIVING)
    return np.empty((0, 0)) if signals is None else signals("position")


def compute_distance(path: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance of a path from another one, whenever each point was passed."""
    points = path[::COMPARED_CYCLES]
    return max(
        (float(np.linalg.norm(other - point, axis=1).min()) for point in points), default=0.0
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
