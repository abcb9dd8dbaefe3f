"""The schedulers of the rack chimera: fixed priorities by rate, and earliest deadline first."""

from __future__ import annotations

import os

import pytest

from rack.backplane.process import DEADLINE, Reservation
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError
from tests.machine import needs_deadlines

EARLIEST = "clock.scheduler=earliest-deadline-first"


def test_its_priorities_are_rate_monotonic() -> None:
    boards = load("chimera").board.values()
    by_priority = sorted(boards, key=lambda board: -board.priority)
    rates = [board.rate_hz or 0.0 for board in by_priority]
    assert rates == sorted(rates, reverse=True)
    assert len({board.priority for board in boards}) == len(boards)


def test_a_board_reserves_twice_its_budget_in_each_of_its_cycles_by_deadlines_alone() -> None:
    rack = resolve(load("chimera", [EARLIEST, "clock.speed=0.5"]))
    found = {task.task: task.reservation for task in rack.tasks}
    assert found["arm"] == Reservation(800_000, 4_000_000)
    assert found["trajectory"] == Reservation(3_300_000, 40_000_000)
    assert rack.build_clock_wiring(None).reservation == Reservation(200_000, 4_000_000)
    for settings in ((), (EARLIEST, "clock.mode=lockstep")):
        rack = resolve(load("chimera", settings))
        assert {task.reservation for task in rack.tasks} == {None}
        assert rack.build_clock_wiring(None).reservation is None


MISTAKES = {
    "tight": ("nasrem", (), 'board.task.coupling = "tight": a planner with'),
    "polling": ("chimera", ("board.servo.wake=poll",), 'board.servo.wake = "poll": busy-waiting'),
    "no time": ("chimera", ("timing.clock_ms=0",), "timing.clock_ms = 0.0: missing; the clock"),
    "no budget": (
        "chimera",
        tuple(f"board.arm.budget.{part}_ms=0" for part in ("read", "process", "write")),
        "board.arm.budget: missing; the board reserves twice its budget",
    ),
    "network": (
        "brown/servo",
        (),
        "the network adapter's threads need its priority; use fixed-priority",
    ),
}


@pytest.mark.parametrize(("rack", "settings", "line"), MISTAKES.values(), ids=MISTAKES)
def test_what_cannot_be_reserved_is_named(rack: str, settings: tuple[str], line: str) -> None:
    with pytest.raises(ConfigError) as error:
        resolve(load(rack, [EARLIEST, *settings]))
    assert line in str(error.value)


@pytest.mark.alone
@pytest.mark.slow
@needs_deadlines
def test_boards_are_scheduled_by_their_deadlines_and_the_launch_says_so(rack_name: str) -> None:
    with Rack(load("chimera", [f"name={rack_name}", EARLIEST])) as rack:
        assert rack.run(0.2).cause == "time over"
        names = [task.name for task in rack.segment.layout.tasks]
        assert {rack.segment.get_block(name)[Block.PRIORITY] for name in names} == {DEADLINE}
        said = [event.text for event in rack.events if event.kind == "ready"]
    cores = "on any core" if len(os.sched_getaffinity(0)) > 1 else "on their cores"
    what = f"earliest deadline first by SCHED_DEADLINE, {cores}"
    assert f"{what}: arm, bridge, servo, trajectory, world" in said


@pytest.mark.alone
@pytest.mark.slow
def test_a_refused_reservation_leaves_fixed_priorities_and_the_launch_says_so(
    rack_name: str,
) -> None:
    # A cycle is longer than the kernel's longest period, 4.2 s.
    slow = "clock.speed=0.004"
    with Rack(load("chimera", [f"name={rack_name}", EARLIEST, slow])) as rack:
        rack.start(1.0)
        said = [event.text for event in rack.events if event.kind == "ready"]
        rack.stop()
    assert any(
        text.startswith("SCHED_DEADLINE refused, fixed priorities: ") and "world" in text
        for text in said
    )
