"""Kills from outside, in a campaign's trial: the right process, at its instant, and once."""

from __future__ import annotations

import os
import time

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.tools.faults.campaigns.plan import Kill
from rack.tools.faults.campaigns.trial import Killer
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus, make_bus  # noqa: F401  a fixture
from tests.processes import BOUND_S, FORKS, exit_status, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
PERIOD_NS = 2_500_000


def bus(make: MakeBus, pid: int, lockstep: bool = True) -> Segment:
    """Return the memory of a rack whose board `level` is this process, and whose clock stands at
    tick 0."""
    segment = make(task("level"), task("other", slot=3))
    words, block = segment.words, segment.block("level")
    words[System.PERIOD_NS], words[System.LOCKSTEP], words[System.TICK] = PERIOD_NS, lockstep, 0
    words[System.EPOCH_NS] = time.monotonic_ns()
    block[Block.PID], block[Block.STATE] = pid, TaskState.RUNNING
    return segment


def test_a_board_is_killed_once_at_its_tick_and_not_before(make_bus: MakeBus) -> None:  # noqa: F811
    with forked(lambda: time.sleep(BOUND_S)) as pid:
        segment = bus(make_bus, pid)
        killer = Killer(segment, [Kill(board="level", tick=5, phase=0.0)])
        segment.words[System.TICK] = 4
        killer.advance()
        assert killer.done == []
        segment.words[System.TICK] = 5
        before = time.monotonic_ns()
        killer.advance()
        (kill,) = killer.done
        assert (kill.board, kill.tick) == ("level", 5)
        assert before <= kill.time_ns <= time.monotonic_ns()
        killer.advance()
        assert killer.done == [kill]
        assert exit_status(pid) == -9


@pytest.mark.parametrize("word", ["STATE", "LOST"])
def test_a_board_that_is_not_running_is_killed_as_soon_as_it_is(
    make_bus: MakeBus,  # noqa: F811
    word: str,
) -> None:
    with forked(lambda: time.sleep(BOUND_S)) as pid:
        segment = bus(make_bus, pid)
        block, place = segment.block("level"), Block[word]
        sound, block[place] = block[place], TaskState.STARTING if word == "STATE" else 1
        killer = Killer(segment, [Kill(board="level", tick=0, phase=0.0)])
        killer.advance()
        assert killer.done == []
        assert os.waitpid(pid, os.WNOHANG) == (0, 0)
        block[place] = sound
        wait_until(lambda: killer.advance() or killer.done)
        assert exit_status(pid) == -9


def test_it_looks_often_in_lockstep_and_sleeps_to_its_instant_in_real_time(
    make_bus: MakeBus,  # noqa: F811
) -> None:
    segment = bus(make_bus, os.getpid(), lockstep=False)
    assert Killer(segment, []).due_in_s() == 0.5
    near, far = Kill(board="level", tick=60, phase=0.5), Kill(board="level", tick=4000, phase=0.0)
    # At 60.5 ticks of 2.5 ms after the start, which is now.
    assert 0.0 <= Killer(segment, [near]).due_in_s() <= 0.15125
    assert Killer(segment, [far, near]).due_in_s() == 0.5
    segment.words[System.EPOCH_NS] += 10**9
    assert Killer(segment, [near]).due_in_s() == 0.5
    segment.words[System.EPOCH_NS] -= 2 * 10**9
    assert Killer(segment, [near]).due_in_s() == 0.0
    segment.words[System.LOCKSTEP] = 1
    assert Killer(segment, [far]).due_in_s() < 0.05
