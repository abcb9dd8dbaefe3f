"""The same rack, partitioned otherwise: its couplings and cores, and what is measured of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments import partition
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.partition import (
    PARTITION,
    PARTITIONS,
    Partitions,
)
from tests.boards.conftest import PLANNED
from tests.machine import needs_fifo, needs_two_cores

pytestmark = pytest.mark.thorough


def test_every_planner_is_coupled_the_same_way_on_so_many_cores() -> None:
    config = load("nasrem")
    found = {partition.name: partition.of(config) for partition in PARTITIONS}
    assert list(found) == ["tight, 1 core", "loose, 1 core", "tight, 2 cores", "loose, 2 cores"]
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
    assert found["loose, 2 cores"].board["servo"].planner_core == 0
    assert found["tight, 2 cores"].board["world"].coupling == "none"


def partitioned(
    text: str, seconds: float, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Partitions:
    """Run the partitions of the rack of a config."""
    (folder / "rack.toml").write_text(text)
    monkeypatch.setattr(partition, "NAME", str(folder / "rack.toml"))
    monkeypatch.setattr(partition, "SECONDS", seconds)
    workshop = Workshop(folder, share=True)
    workshop.prepare()
    return PARTITION.make(workshop)


@pytest.mark.slow
@needs_fifo
@needs_two_cores
def test_partitions_are_run_and_measured_one_after_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = partitioned(PLANNED, 0.3, tmp_path, monkeypatch)
    assert [one.partition for one in found.partitions] == [one.name for one in PARTITIONS]
    for one in found.partitions:
        wave, watch = one.levels
        assert (wave.level, watch.level) == ("wave", "watch")
        assert 0 < wave.executor.cycles <= 120
        assert wave.plan_age_ms is not None
        # A plan is read from the end of its slice on, four cycles after its release.
        assert wave.plan_age_ms["min"] >= 10.0
        assert (watch.planner, wave.executor.fits) == (None, None)
