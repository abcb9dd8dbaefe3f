"""Host boards as the rack sees them: restarted by its policy, done, given up, or stopped."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace
from typing import cast

import pytest

from rack.backplane.process import STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.config import resolve
from rack.boards.crate.line import CrateLine
from rack.boards.crate.recovery import Recovery, RestartPolicy
from rack.boards.crate.requests import Ended, PowerOff, PowerOn
from rack.boards.events import Event, Journal
from tests.boards.conftest import MakeConfig, MakeSegment
from tests.boards.host.test_board import HOSTED
from tests.processes import FORKS, forked, wait_until

SETTINGS = ("supervision.restarts=2", "supervision.within_s=1.0")


class Site:
    """A rack with host boards, and the requests made of its crate once they were started."""

    def __init__(self, segment: Segment, recovery: Recovery, asked: list[object]) -> None:
        self.recovery, self.asked = recovery, asked
        self.block = segment.get_block("program")

    def lose(self, status: int, tick: int) -> None:
        """Lose the program's process, and do what is due then."""
        end = Ended("program", status, 0, tick)
        self.recovery.record_loss(end, is_over=False, record_printed=lambda: None)
        self.recovery.restart_due_boards()


@pytest.fixture
def journal() -> Journal:
    return Journal(None)


@pytest.fixture
def site(config: MakeConfig, make_segment: MakeSegment, journal: Journal) -> Site:
    hosted = f'{HOSTED}\n[host.prompt]\nexternal = true\nbelow = "bridge"\n'
    settings = (*SETTINGS, 'host.prompt.program="rack.levels.host_program:HostProgram"')
    made = config(*settings, text=hosted)
    plan = resolve(made)
    segment = make_segment(plan.layout, "")
    asked: list[object] = []
    supervision = RestartPolicy(made, plan.layout)
    crate = cast(CrateLine, SimpleNamespace(try_request=asked.append))
    recovery = Recovery(segment, supervision, crate, journal)
    recovery.start(plan.build_clock_wiring(None), plan)
    return Site(segment, recovery, asked)


def told(journal: Journal) -> list[tuple[str, str]]:
    """Return code and text of the events since the last call."""
    found = [(event.code, event.text) for event in journal.events]
    journal.events.clear()
    return found


def test_the_rack_starts_its_host_boards_except_external_ones(site: Site) -> None:
    assert [cast(PowerOn, request).name for request in site.asked] == ["clock", "program"]
    assert "prompt" not in site.recovery.wirings


def test_a_host_board_that_ends_is_restarted_a_limited_number_of_times(
    site: Site, journal: Journal
) -> None:
    for tick in (10, 20, 30):
        site.lose(-signal.SIGKILL, tick)
    assert [cast(PowerOn, request).name for request in site.asked] == ["clock", *["program"] * 3]
    died = ("died", "host board 'program' ended: signal SIGKILL")
    found = told(journal)
    assert [code for code, _ in found] == ["died", "restart", "died", "restart", "died", "given_up"]
    assert found[0] == died
    assert found[1][1].startswith("restart 1 of at most 2 in 1 s")
    assert found[-1] == ("given_up", "gave up on 'program'")
    assert site.block[Block.STATE] == TaskState.GIVEN_UP
    assert site.recovery.faults == [f"{died[1]}; no restarts left"]
    assert not site.recovery.given_up


def test_a_host_board_whose_program_is_done_is_not_restarted(site: Site, journal: Journal) -> None:
    site.block[Block.STATE] = TaskState.ENDED
    site.lose(0, 10)
    assert told(journal) == [("done", "host board 'program': its program is done")]
    assert len(site.asked) == 2
    assert site.recovery.faults == []


@pytest.mark.filterwarnings(FORKS)
def test_a_host_board_stopped_by_a_signal_is_killed_once(site: Site, journal: Journal) -> None:
    with forked(signal.pause) as pid:
        site.block[Block.PID] = pid
        site.asked.clear()
        site.recovery.restart_due_boards()
        assert (site.asked, told(journal)) == ([], [])
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: read_state(pid) in STOPPED_STATES)
        site.recovery.restart_due_boards()
        site.recovery.restart_due_boards()
        assert site.asked == [PowerOff("program")]
        (event,) = cast("list[Event]", journal.events)
        assert (event.kind, event.code, event.subject) == ("detection", "hang", "program")
        assert event.text == "'program' is not responding: stopped by a signal"
        # Its successor may be stopped, too.
        site.lose(-signal.SIGKILL, 10)
        site.recovery.restart_due_boards()
        assert site.asked.count(PowerOff("program")) == 2
