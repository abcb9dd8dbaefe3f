"""Kills from outside, in a campaign's trial: the right process, at its instant, and once."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards.config import load
from rack.tools.faults.campaigns.plan import Kill, Plan
from rack.tools.faults.campaigns.trial import Killer, run_trial
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, exit_status, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
PERIOD_NS = 2_500_000


@pytest.fixture
def board(make_bus: MakeBus) -> Iterator[tuple[int, Segment]]:
    """The process of a board `level`, and the memory of its rack, whose clock is at tick 0."""
    with forked(lambda: time.sleep(BOUND_S)) as pid:
        segment = make_bus(task("level"), task("other", slot=3))
        words, block = segment.words, segment.get_block("level")
        words[System.PERIOD_NS], words[System.LOCKSTEP], words[System.TICK] = PERIOD_NS, True, 0
        words[System.EPOCH_NS] = time.monotonic_ns()
        block[Block.PID], block[Block.STATE] = pid, TaskState.RUNNING
        yield pid, segment


def test_a_board_is_killed_once_at_its_tick_and_not_before(board: tuple[int, Segment]) -> None:
    pid, segment = board
    killer = Killer(segment, [Kill(board="level", tick=5, phase=0.0)])
    segment.words[System.TICK] = 4
    killer.kill_due_board()
    assert killer.done == []
    segment.words[System.TICK] = 5
    before = time.monotonic_ns()
    killer.kill_due_board()
    (kill,) = killer.done
    assert (kill.board, kill.tick) == ("level", 5)
    assert before <= kill.time_ns <= time.monotonic_ns()
    killer.kill_due_board()
    assert killer.done == [kill]
    assert exit_status(pid) == -9


@pytest.mark.parametrize("word", ["STATE", "LOST"])
def test_a_board_that_is_not_running_is_killed_as_soon_as_it_is(
    board: tuple[int, Segment], word: str
) -> None:
    pid, segment = board
    block, place = segment.get_block("level"), getattr(Block, word)
    sound, block[place] = block[place], TaskState.STARTING if word == "STATE" else 1
    killer = Killer(segment, [Kill(board="level", tick=0, phase=0.0)])
    killer.kill_due_board()
    assert killer.done == []
    assert os.waitpid(pid, os.WNOHANG) == (0, 0)
    block[place] = sound
    wait_until(lambda: killer.kill_due_board() or killer.done)
    assert exit_status(pid) == -9


@pytest.mark.slow
def test_a_trial_contains_everything_for_its_judgement(small: Path, rack_name: str) -> None:
    config = load(small)
    fault = {"kind": "mute", "board": "lower", "tick": 40, "for": "50ms"}
    plan = Plan(3, "faults", lockstep=True, faults=(fault,))
    found = run_trial(config, plan, rack_name, ticks=0, seconds=0.5)
    assert found.plan is plan
    assert found.outcome is not None
    assert (found.outcome.cause, found.outcome.ticks, found.refused) == ("time over", 200, "")
    (struck,) = found.strikes
    assert (struck.kind, struck.board, struck.tick) == ("mute", "lower", 40)
    run = found.run
    assert run is not None
    assert [task.name for task in run.layout.tasks] == ["upper", "lower", "lower.planner"]
    assert any(event.code == "mute" for event in found.events)
    assert (found.left, found.again, found.is_late) == ((), None, False)
    assert (run.moving, run.is_lockstep, run.has_failed) == ((), True, False)
    assert run.restart_s == config.supervision.lockstep_restart_s
    assert abs(time.time_ns() - time.monotonic_ns() - run.offset_ns) < 10**9
    assert 0.0 < found.wall_s < BOUND_S
    assert "upper" in found.levels


@pytest.mark.slow
def test_a_rack_that_a_fault_keeps_from_launching_is_tried_without_it(
    small: Path, rack_name: str
) -> None:
    plan = Plan(4, "faults", lockstep=True, faults=({"kind": "self-test", "board": "lower"},))
    found = run_trial(load(small), plan, rack_name, ticks=0, seconds=0.5)
    assert "lower" in found.refused
    assert found.again is not None
    # Each task begins a cycle at tick 0.
    assert (found.again.cause, found.again.ticks) == ("time over", 1)
    assert (found.strikes, found.run) == ((), None)
