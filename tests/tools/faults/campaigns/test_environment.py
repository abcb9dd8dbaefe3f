"""The surroundings of trials: leftovers are noticed, the load loads, and the violation counter is
checked."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

import pytest

from rack.backplane.process import name_process
from rack.backplane.segment import SHM_FOLDER
from rack.boards import config
from rack.levels.arm.simulation import Simulation
from rack.tools.console.answer import Failure
from rack.tools.faults.campaigns.environment import (
    check_violation_counter,
    find_leftovers,
    list_living_descendants,
    run_load,
)
from tests.processes import FORKS, forked, runs, wait_until


def test_a_file_left_in_shared_memory_is_noticed(rack_name: str) -> None:
    path = SHM_FOLDER / f"sem.nasrem-rack.{rack_name}.lower"
    path.touch()
    try:
        assert find_leftovers(rack_name, list_living_descendants()) == [str(path)]
    finally:
        path.unlink()
    assert find_leftovers(rack_name, list_living_descendants()) == []


@pytest.mark.filterwarnings(FORKS)
def test_a_process_left_behind_is_noticed_whoever_its_parent_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rack.tools.faults.campaigns.environment.BOUND_S", 0.05)
    rack = f"p{os.getpid()}x"

    def board() -> None:
        name_process(f"{rack}:lower")
        signal.pause()

    before = list_living_descendants()
    with forked(board) as pid:
        wait_until(lambda: Path(f"/proc/{pid}/comm").read_text().startswith(rack))
        assert find_leftovers(rack, before) == [f"process {pid} ({rack}:lower)"]
        # One that was there before is left out only as a descendant, not under the rack's name.
        assert find_leftovers(rack, list_living_descendants()) == [f"process {pid} ({rack}:lower)"]
        assert find_leftovers(f"q{os.getpid()}x", before) == [f"process {pid} ({rack}:lower)"]
        assert find_leftovers(f"q{os.getpid()}x", list_living_descendants()) == []


@pytest.mark.slow
@pytest.mark.parametrize("has_stress", [True, False])
def test_a_load_is_a_busy_process_a_core_and_one_that_writes(
    has_stress: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if has_stress and shutil.which("stress-ng") is None:
        pytest.skip("stress-ng is not installed")
    if not has_stress:
        monkeypatch.setattr("shutil.which", lambda name: None)
    before, cores = list_living_descendants(), len(os.sched_getaffinity(0))
    with run_load() as told:
        # stress-ng has a process of its own above the others.
        wait_until(lambda: len(list_living_descendants() - before) >= cores + 1 + has_stress)
        busy = list_living_descendants() - before
    wait_until(lambda: not any(runs(pid) for pid in busy))
    own = f"{cores} busy processes and one that writes"
    assert told == (f"stress-ng --cpu {cores} --io 1" if has_stress else own)


def test_a_counter_of_violations_that_does_not_count_ends_the_campaign(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A rack without an arm has no limits to violate.
    check_violation_counter(config.load("fig4"))
    check_violation_counter(config.load("nasrem"))
    monkeypatch.setattr(Simulation, "_check_limits", lambda plant: False)
    why = r"the violation counter does not count joint 'j1' at \d+.* rad/s, twice its limit"
    with pytest.raises(Failure, match=why):
        check_violation_counter(config.load("nasrem"))
