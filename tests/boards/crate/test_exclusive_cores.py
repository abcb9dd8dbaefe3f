"""A rack that asks for its cores: what a refusal does, and groups that no killed process leaves."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import pytest

from rack.backplane import exclusive_cores
from rack.backplane.exclusive_cores import find_hierarchy
from rack.backplane.words import Block, System
from rack.boards import Rack
from rack.boards.crate import launch_checks
from rack.boards.crate.clean import remove_dead_racks
from rack.boards.errors import LaunchError
from tests.boards.conftest import PLAIN, MakeConfig
from tests.processes import parent_of, wait_until

pytestmark = pytest.mark.slow
EXCLUSIVE = ("clock.mode=realtime", "clock.exclusive_cores=true", "clock.speed=0.1")
HIERARCHY = find_hierarchy()
needs_groups = pytest.mark.skipif(
    HIERARCHY is None or not os.access(HIERARCHY, os.W_OK) or os.geteuid() != 0,
    reason="needs root and a cgroup hierarchy of version 2",
)


def list_notes(rack: Rack) -> list[str]:
    return [event.text for event in rack.events if "cores" in event.text]


def refuse(rack: str, cores: Iterable[int]) -> str:
    """Refuse cores as a kernel does that has none to give."""
    return f"core {max(cores)}: root invalid (Parent unable to distribute cpu downstream)"


def test_a_refusal_is_a_note_or_ends_the_launch(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch_checks.exclusive_cores, "reserve_cores", refuse)
    why = "clock.exclusive_cores refused: core "
    with Rack(config(*EXCLUSIVE, text=PLAIN)) as rack:
        rack.run(0.02)
        (note,) = list_notes(rack)
        assert not rack.segment.words[System.EXCLUSIVE_CORES]
    assert note.startswith(why)
    assert "; other processes may run on cores 0" in note
    refusing = config(*EXCLUSIVE, "clock.on_no_realtime=refuse", text=PLAIN)
    with pytest.raises(LaunchError) as error, Rack(refusing):
        pass
    assert str(error.value).startswith(why)
    assert error.value.status == 2


def test_in_lockstep_a_rack_shares_its_cores(config: MakeConfig) -> None:
    with Rack(config("clock.exclusive_cores=true", text=PLAIN)) as rack:
        rack.run(0.02)
        assert list_notes(rack) == []


def make_groups(rack: str, cores: Iterable[int]) -> str:
    """Create the groups without a controller, in the kernel's own hierarchy."""
    assert HIERARCHY is not None
    exclusive_cores.release_cores(rack)
    for core in cores:
        (HIERARCHY / f"rack.{rack}.{core}").mkdir()
    return ""


@needs_groups
@pytest.mark.parametrize("killed", ["nothing", "board", "crate"])
def test_processes_are_in_the_groups_and_nothing_is_left(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch, rack_name: str, killed: str
) -> None:
    assert HIERARCHY is not None
    monkeypatch.setattr(launch_checks.exclusive_cores, "reserve_cores", make_groups)
    with Rack(config(*EXCLUSIVE, text=PLAIN)) as rack:
        rack.start()
        block = rack.segment.get_block("wave")
        pid, core = block[Block.PID], block[Block.CORE]
        group = f"/rack.{rack_name}.{core}"
        wait_until(lambda: rack.segment.words[System.CLOCK_PID])
        for process in (pid, rack.segment.words[System.CLOCK_PID]):
            assert f"0::/rack.{rack_name}." in Path(f"/proc/{process}/cgroup").read_text()
        if killed == "board":
            os.kill(pid, signal.SIGKILL)
            rack.watch(0.0)
            wait_until(lambda: (rack.watch(0.01), block[Block.PID] != pid)[1])
            found = Path(f"/proc/{block[Block.PID]}/cgroup")
            wait_until(lambda: (rack.watch(0.01), f"0::{group}\n" in found.read_text())[1])
        elif killed == "crate":
            os.kill(parent_of(pid), signal.SIGKILL)
        # As long as processes are there, nobody removes them.
        if killed != "crate":
            remove_dead_racks()
            assert (HIERARCHY / group[1:]).exists()
    assert not list(HIERARCHY.glob(f"rack.{rack_name}.*"))
