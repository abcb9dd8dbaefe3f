"""Kills from outside, in a campaign's trial: the right process, at its instant, and once."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards.config import load
from rack.tools.faults.campaigns import trial
from rack.tools.faults.campaigns.plan import Kill, Plan
from rack.tools.faults.campaigns.trial import Killer, _watch, run_trial
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
        block, place = segment.block("level"), getattr(Block, word)
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


@pytest.mark.slow
def test_a_trial_has_what_its_judgement_needs(small: Path, rack_name: str) -> None:
    config = load(small)
    fault = {"kind": "mute", "board": "lower", "tick": 40, "for": "50ms"}
    plan = Plan(3, "faults", lockstep=True, faults=(fault,))
    found = run_trial(config, plan, rack_name, ticks=0, seconds=0.5)
    assert found.plan is plan
    assert found.outcome is not None
    assert (found.outcome.cause, found.outcome.ticks, found.refused) == ("time over", 200, "")
    assert [(strike.kind, strike.board, strike.tick) for strike in found.strikes] == [
        ("mute", "lower", 40)
    ]
    assert found.run is not None
    assert [task.name for task in found.run.layout.tasks] == ["upper", "lower", "lower.planner"]
    assert any(event.code == "mute" for event in found.events)
    assert (found.left, found.again, found.is_late) == ((), None, False)
    assert (found.run.moving, found.run.is_lockstep, found.run.has_failed) == ((), True, False)
    assert found.run.restart_s == config.supervision.lockstep_restart_s
    assert abs(time.time_ns() - time.monotonic_ns() - found.run.offset_ns) < 10**9
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
    # Two seconds of simulated time.
    assert (found.again.cause, found.again.ticks) == ("time over", 800)
    assert (found.strikes, found.run) == ((), None)


class Run:
    """A run as a trial sees it: its ticks go on by `pace` at each look, and it ends when it is told
    to, unless it is `stuck`."""

    def __init__(self, pace: int, now: list[float], stuck: bool = False) -> None:
        self.words = [0] * (System.SYSFAIL + 1)
        self.segment = SimpleNamespace(words=self.words)
        self.config = SimpleNamespace(clock_ns=PERIOD_NS)
        self.stopped: list[str] = []
        self.looks = 0
        self._pace = pace
        self._now = now
        self._stuck = stuck

    def start(self, seconds: float | None) -> None:
        """Begin."""
        self.seconds = seconds

    def stop(self, why: str) -> None:
        """Note it."""
        self.stopped.append(why)

    def watch(self, timeout_s: float) -> bool:
        """Let half a second pass."""
        self.looks += 1
        self._now[0] += 0.5
        self.words[System.TICK] += self._pace
        return self._stuck or not self.stopped


NO_KILLS = SimpleNamespace(due_in_s=lambda: 0.5, advance=lambda: None)
LONG = "the trial takes too long"


@pytest.mark.parametrize(
    ("ticks", "seconds", "pace", "ends_at"),
    [
        # Four times the length, and a minute.
        (1000, None, 1000, 4000 + 24_000),
        (1000, 90.0, 1000, 4000 + 36_000),
        # Half an hour where no length is known.
        (0, None, 40_000, 720_000),
    ],
)
def test_no_run_goes_on_for_ever(
    monkeypatch: pytest.MonkeyPatch, ticks: int, seconds: float | None, pace: int, ends_at: int
) -> None:
    now = [100.0]
    monkeypatch.setattr(trial, "time", SimpleNamespace(monotonic=lambda: now[0]))
    run = Run(pace, now)
    _watch(run, NO_KILLS, ticks, seconds, None)  # type: ignore[arg-type]
    assert run.stopped == [LONG]
    assert run.seconds == seconds
    # The look after it is the first beyond.
    assert ends_at < run.words[System.TICK] <= ends_at + 2 * pace


@pytest.mark.parametrize("stuck", [False, True])
def test_a_run_that_stands_still_is_stopped_and_left_if_it_is_stuck(
    monkeypatch: pytest.MonkeyPatch, stuck: bool
) -> None:
    now = [100.0]
    monkeypatch.setattr(trial, "time", SimpleNamespace(monotonic=lambda: now[0]))
    run = Run(0, now, stuck)
    _watch(run, NO_KILLS, 1000, None, None)  # type: ignore[arg-type]
    assert run.stopped == [LONG]
    # Two minutes of half seconds, and twenty seconds more if it does not end.
    assert run.looks in (range(280, 286) if stuck else range(240, 246))


def test_a_restart_takes_at_least_its_real_time_where_time_is_real(small: Path) -> None:
    config = load(small, ["supervision.lockstep_restart_s=0.5"])
    supervision = config.supervision
    assert (supervision.restart_s(True), supervision.restart_s(False)) == (0.5, 2.0)
    slow = load(small, ["supervision.lockstep_restart_s=3.0"]).supervision
    assert (slow.restart_s(True), slow.restart_s(False)) == (3.0, 3.0)
