"""How a planner is coupled to its executor: one board, two boards, or no planner at all."""

from __future__ import annotations

import os

import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from tests.boards.conftest import LOOSE, MakeConfig
from tests.boards.messages import run_and_read
from tests.boards.run.test_lockstep import SECONDS, TICKS, digest, first_run
from tests.boards.runs import run_until, stop
from tests.machine import needs_fifo
from tests.processes import wait_until

pytestmark = pytest.mark.slow

PRIORITIES = ("board.wave.priority=20", "board.watch.priority=19")


def test_tight_and_loose_coupling_write_equal_messages_in_lockstep(config: MakeConfig) -> None:
    tight, loose = (first_run(config, *coupling)[0] for coupling in ((), LOOSE))
    assert digest(tight) == digest(loose)


@pytest.mark.parametrize(("mode", "coupling"), [("lockstep", ()), ("realtime", LOOSE)])
def test_executor_and_planner_are_two_processes(
    config: MakeConfig, mode: str, coupling: tuple[str, ...]
) -> None:
    with Rack(config(f"clock.mode={mode}", *coupling)) as rack:
        tasks = [rack.segment.layout.find_task(name) for name in ("wave", "wave.planner")]
        pids = [rack.segment.get_block(task.name)[Block.PID] for task in tasks]
        assert len({*pids, os.getpid()}) == 3
        assert [task.slot for task in tasks] == ([2, 9] if coupling else [2, 2])
        rack.start()
        # Others of this machine may have the core for a while.
        wait_until(lambda: rack.segment.get_block("wave.planner")[Block.PLANS] > 0)
        assert stop(rack).cause == "stopped"


def test_a_plan_takes_effect_at_the_end_of_its_slice(config: MakeConfig) -> None:
    _, found = first_run(config)
    plans, wave = found.messages["wave.plan"], found.messages["wave.status"]
    # A plan is wanted in every cycle: the next one begins where a slice ends.
    assert plans["tick"].tolist() == list(range(0, TICKS, 4))
    assert plans["visible_at"].tolist() == list(range(4, TICKS + 4, 4))
    assert plans["message"]["made_at"].tolist() == plans["tick"].tolist()
    height = wave["message"]["value"]
    gain = plans["message"]["gain"]
    expected = [0.5 * tick * (gain[tick // 4 - 1] if tick >= 4 else 1.0) for tick in range(TICKS)]
    assert height.tolist() == expected


@pytest.mark.parametrize("every", [3, 50])
def test_a_planner_is_asked_again_as_soon_as_it_may_plan(config: MakeConfig, every: int) -> None:
    rack = Rack(config(f"board.wave.params.plan_every={every}"))
    found = run_and_read(rack, SECONDS).messages["wave.plan"]["tick"].tolist()
    expected = [0]
    # Asked at every tick that no plan is being made in, four ticks each.
    while (following := next(t for t in range(expected[-1] + 4, 10_000) if t % every == 0)) < TICKS:
        expected.append(following)
    assert found == expected


@needs_fifo
@pytest.mark.parametrize("protocol", ["time-slice", "lock"])
def test_a_tight_planner_runs_below_its_executor(config: MakeConfig, protocol: str) -> None:
    settings = (*PRIORITIES, "board.wave.planner_priority=5", f"protocol.default={protocol}")
    with Rack(config("clock.mode=realtime", *settings)) as rack:
        pids = {
            name: rack.segment.get_block(name)[Block.PID]
            for name in ("wave", "wave.planner", "watch")
        }
        assert {name: os.sched_getscheduler(pid) for name, pid in pids.items()} == dict.fromkeys(
            pids, os.SCHED_FIFO
        )
        got = {name: os.sched_getparam(pid).sched_priority for name, pid in pids.items()}
        assert got == {"wave": 20, "wave.planner": 5, "watch": 19}
        assert got == {name: rack.segment.get_block(name)[Block.PRIORITY] for name in pids}
        rack.start()
        block = rack.segment.get_block("wave.planner")
        assert run_until(rack, lambda: block[Block.PLANS] > 0).cause == "time over"
