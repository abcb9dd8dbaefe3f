"""A resolved rack: the wiring of its clock, its priorities and cores."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.words import Demand
from rack.boards.config.loader import load
from rack.boards.config.resolved import resolve
from tests.boards.conftest import MakeConfig


def test_the_clock_is_wired_in_ticks(config: MakeConfig) -> None:
    plan = resolve(config("supervision.lockstep_restart_s=0.25"))
    clock = plan.build_clock_wiring(0.5)
    fast = resolve(config("clock.mode=realtime", "clock.speed=2")).build_clock_wiring(None)
    # A tick of 2.5 ms.
    assert (clock.period_ns, fast.period_ns) == (2_500_000, 1_250_000)
    assert (clock.stop_tick, clock.restart_ticks, clock.linger) == (200, 100, 200)
    assert (clock.lockstep, clock.keeps_awake, clock.ends_run) == (True, False, "watch.status")
    assert set(clock.on_loss) == {"wave", "watch"}
    assert all(isinstance(demand, Demand) for demand in clock.on_loss.values())
    assert plan.build_clock_wiring(None).stop_tick == 0
    assert plan.build_clock_wiring(1e-9).stop_tick == 1


@pytest.mark.parametrize(
    ("priorities", "expected"), [((50, 60), 49), ((50, 0), 49), ((1, 1), 0), ((0, 0), 0)]
)
def test_the_crate_is_below_every_real_time_executor(
    small: Path, priorities: tuple[int, int], expected: int
) -> None:
    upper, lower = priorities
    settings = [
        "clock.mode=realtime",
        f"board.upper.priority={upper}",
        f"board.lower.priority={lower}",
        # Planners do not count.
        "board.lower.planner_priority=20" if lower > 20 else "board.lower.planner_priority=0",
    ]
    assert resolve(load(small, settings)).crate_priority == expected


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ([], 0),
        (["protocol.default=lock"], 50),
        (["protocol.default=lock", "board.lower.coupling=loose", "board.lower.planner_slot=7"], 0),
    ],
    ids=["without locks", "locks on one core", "locks on two boards"],
)
def test_a_planner_runs_at_its_executors_priority_while_it_may_hold_a_lock(
    small: Path, settings: list[str], expected: int
) -> None:
    priorities = ["board.lower.priority=50", "board.upper.priority=40"]
    plan = resolve(load(small, ["clock.mode=realtime", *priorities, *settings]))
    found = {task.task: task.critical_priority for task in plan.tasks}
    assert found == {"upper": 0, "lower": 0, "lower.planner": expected}
    # The fastest executor looks after the clock.
    assert [task.task for task in plan.tasks if task.guards_clock] == ["lower"]


def test_in_lockstep_the_clock_shares_the_core_of_the_fastest_that_yields(small: Path) -> None:
    cores = ["clock.core=0", "board.upper.core=0", "board.lower.core=1"]

    def core(*settings: str) -> int:
        return resolve(load(small, [*cores, *settings])).build_clock_wiring(None).core

    assert core() == 1
    assert core("clock.mode=realtime") == 0
    # As fast, and in a lower slot; one that polls keeps its core.
    assert core("board.upper.rate_hz=400") == 0
    apart = "wake=poll", "coupling=loose", "planner_slot=7", "planner_core=0"
    assert core(*(f"board.lower.{setting}" for setting in apart)) == 0
