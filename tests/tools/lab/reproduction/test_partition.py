"""Partitions of a rack: couplings, cores and measurements."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments import partition
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.partition import (
    PARTITION,
    PARTITIONS,
    compute_distance,
)
from tests.boards.conftest import PLANNED
from tests.machine import needs_fifo, needs_two_cores

pytestmark = pytest.mark.thorough


def test_a_partition_couples_every_planner_alike_and_uses_all_its_cores() -> None:
    config = load("nasrem")
    found = {f"{one.coupling}, {one.cores}": one.apply_to(config) for one in PARTITIONS}
    assert list(found) == ["tight, 1", "loose, 1", "tight, 2", "loose, 2"]
    for name, rack in found.items():
        planned = [board for board in rack.board.values() if board.planner is not None]
        assert {board.coupling for board in planned} == {name.partition(",")[0]}
        cores = {board.core for board in rack.board.values()} | {rack.clock.core}
        cores |= {board.planner_core for board in planned if board.planner_core is not None}
        assert cores == set(range(int(name[7])))
        slots = [
            slot
            for board in rack.board.values()
            for slot in (board.slot, board.planner_slot)
            if slot
        ]
        assert len(slots) == len(set(slots)) == len(rack.board) + 4 * name.startswith("loose")
    assert found["loose, 2"].board["servo"].planner_core == 0
    assert found["tight, 2"].board["world"].coupling == "none"


@needs_fifo
@needs_two_cores
def test_partitions_are_run_and_measured_one_after_another(
    workshop: Workshop, write: Callable[[str, str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(partition, "NAME", str(write("rack.toml", PLANNED)))
    monkeypatch.setattr(partition, "SECONDS", 0.3)
    found = PARTITION.measure_if_possible(workshop)
    assert tuple(one.partition for one in found) == PARTITIONS
    for one in found:
        cycles = {(task.board, task.role): task.cycles for task in one.tasks}
        assert cycles.keys() == {("wave", "executor"), ("wave", "planner"), ("watch", "executor")}
        assert 0 < cycles["wave", "executor"] <= 120
        assert 0 < cycles["wave", "planner"] < cycles["wave", "executor"]
        assert all(0.0 < load < 1.0 for load in one.loads.values())


def test_paths_are_compared_whenever_their_points_were_passed() -> None:
    path = np.linspace([0.0, 0.0], [1.0, 0.0], 801)
    late = np.concatenate((path[:1].repeat(50, axis=0), path))
    assert compute_distance(late, path) == 0.0
    assert compute_distance(path + np.array((0.0, 0.1)), path) == pytest.approx(0.1)
    # Half of a path lies on the whole one, but not the other way round.
    assert compute_distance(path[:401], path) == 0.0
    assert compute_distance(path, path[:401]) == pytest.approx(0.5)
