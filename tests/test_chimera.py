"""The schedulers of the rack chimera: chosen per board, changed, and compared by an overload."""

from __future__ import annotations

import os
import re
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.process import DEADLINE, Reservation
from rack.backplane.trace import Flag, open_trace_ring
from rack.backplane.words import Block, Scheduler, System
from rack.boards import Rack
from rack.boards.config import build_rack_timing, load, resolve
from rack.boards.errors import ConfigError, LaunchError
from rack.tools.monitor.desk import LevelCommander
from rack.tools.monitor.snapshot import RackMonitor
from tests.boards.config.mistakes import find_lines
from tests.machine import needs_deadlines, needs_fifo
from tests.processes import run_to_end, wait_until

EARLIEST = "clock.scheduler=earliest-deadline-first"
URGENCY = "clock.scheduler=maximum-urgency-first"
BOARDS = ("arm", "servo", "trajectory", "world", "bridge")
PARTS = ("read", "process", "write")
LOAD = "timing.lockstep_load=1"


def test_its_priorities_are_rate_monotonic() -> None:
    boards = load("chimera").board.values()
    by_priority = sorted(boards, key=lambda board: -board.priority)
    rates = [board.rate_hz or 0.0 for board in by_priority]
    assert rates == sorted(rates, reverse=True)
    assert len({board.priority for board in boards}) == len(boards)


def test_a_board_reserves_twice_its_budget_in_each_of_its_cycles() -> None:
    rack = resolve(load("chimera", [EARLIEST, "clock.speed=0.5"]))
    found = {task.task: task.scheduling for task in rack.tasks}
    reserved = {name: entry.reservation for name, entry in found.items() if entry is not None}
    assert reserved["arm"] == Reservation(800_000, 4_000_000)
    assert reserved["trajectory"] == Reservation(3_300_000, 40_000_000)
    # The clock is on the core of the trajectory, and would run below it.
    assert rack.build_clock_wiring(None).reservation == Reservation(200_000, 4_000_000)
    assert found["arm"] is not None
    assert found["arm"].clocks is None
    lone = resolve(load("chimera", ["board.arm.scheduler=earliest-deadline-first"]))
    assert lone.build_clock_wiring(None).reservation is None
    stepped = resolve(load("chimera", [EARLIEST, "clock.mode=lockstep"]))
    assert not [t for t in stepped.tasks if t.scheduling is None or t.scheduling.reservation]


MISTAKES = {
    "tight": ("nasrem", (), 'board.task.coupling = "tight": a planner with'),
    "polling": ("chimera", ("board.servo.wake=poll",), 'board.servo.wake = "poll": busy-waiting'),
    "no time": ("chimera", ("timing.clock_ms=0",), "timing.clock_ms = 0.0: missing; the clock"),
    "no budget": (
        "chimera",
        tuple(f"board.arm.budget.{part}_ms=0" for part in PARTS),
        "board.arm.budget: missing; the board reserves twice its budget",
    ),
    "network": (
        "brown/servo",
        (),
        "the network adapter's threads need its priority; use fixed-priority",
    ),
    "no urgency": (
        "chimera",
        (URGENCY,),
        'clock.scheduler = "maximum-urgency-first": Linux has no such scheduler; in real time use',
    ),
    "one without urgency": (
        "chimera",
        ("board.arm.scheduler=maximum-urgency-first",),
        'board.arm.scheduler = "maximum-urgency-first": Linux has no such scheduler; in real',
    ),
    "unknown": (
        "chimera",
        ("board.arm.scheduler=round-robin",),
        "board.arm.scheduler = \"round-robin\": should be 'fixed-priority', 'earliest-",
    ),
    "load of a planner": (
        "nasrem",
        (
            LOAD,
            "clock.mode=lockstep",
            "clock.scheduler=fixed-priority",
            *(f"board.task.budget.{part}_ms=0" for part in ("plan", "update")),
        ),
        "board.task.budget.plan_ms: missing; a plan takes this time, times timing.lockstep_load",
    ),
    "load without a budget": (
        "chimera",
        (LOAD, "clock.mode=lockstep", *(f"board.world.budget.{part}_ms=0" for part in PARTS)),
        "board.world.budget: missing; a cycle takes this time, times timing.lockstep_load",
    ),
}


@pytest.mark.parametrize(("rack", "settings", "line"), MISTAKES.values(), ids=MISTAKES)
def test_what_cannot_be_reserved_is_named(rack: str, settings: tuple[str], line: str) -> None:
    lines = find_lines(rack, *(() if LOAD in settings else (EARLIEST,)), *settings)
    assert any(line in found for found in lines)


@pytest.mark.alone
@pytest.mark.slow
@needs_deadlines
def test_boards_are_scheduled_by_their_deadlines_on_their_cores(rack_name: str) -> None:
    with Rack(load("chimera", [f"name={rack_name}", EARLIEST])) as rack:
        rack.command("trajectory", "schedule", name="fixed-priority", tick=50)
        assert rack.run(0.2).cause == "time over"
        blocks = {task: rack.segment.get_block(task.name) for task in rack.segment.layout.tasks}
        said = [event.text for event in rack.events if event.kind == "ready"]
    found = {task.name: block[Block.PRIORITY] for task, block in blocks.items()}
    assert found.pop("trajectory") == 70
    assert set(found.values()) == {DEADLINE}
    text = "earliest deadline first by SCHED_DEADLINE: arm, bridge, servo, trajectory, world"
    assert text in said


@pytest.mark.thorough
@needs_fifo
def test_a_refused_scheduler_ends_the_launch_with_one_line(rack_name: str) -> None:
    # A cycle is longer than the kernel's longest period, 4.2 s, on any machine.
    with (
        pytest.raises(LaunchError) as error,
        Rack(load("chimera", [f"name={rack_name}", EARLIEST, "clock.speed=0.004"])),
    ):
        pass
    refused = "board.trajectory.scheduler: earliest-deadline-first refused: "
    assert re.match(f"{refused}.*; otherwise use fixed-priority$|board.arm", str(error.value))
    assert error.value.status == 2


@pytest.mark.thorough
@needs_fifo
def test_a_board_goes_on_as_before_when_the_system_refuses_another_scheduler(
    rack_name: str,
) -> None:
    slow = ["clock.speed=0.1", "board.world.rate_hz=1"]  # a period of 10 s is never granted
    with Rack(load("chimera", [f"name={rack_name}", *slow])) as rack:
        rack.command("world", "schedule", name="earliest-deadline-first", tick=2)
        rack.run(0.02)
        block = rack.segment.get_block("world")
        assert (block[Block.SCHEDULER], block[Block.PRIORITY]) == (Scheduler.FIXED_PRIORITY, 65)
        (kept,) = [event for event in rack.events if event.code == "scheduler_kept"]
    assert kept.board == "world"
    assert kept.text.startswith("'world' goes on as before: earliest-deadline-first refused: ")


class Ran(NamedTuple):
    """A run of chimera/overload: lost cycles by board, digest, and the trajectory's end."""

    missed: dict[str, int]
    digest: str
    reason: str
    late: dict[str, int]


@cache
def run_overload(*settings: str, attempt: int = 1) -> Ran:
    """Run the overload for half a second; tests share the first attempt of each."""
    name = f"name=test-overload-{os.getpid()}"
    config = load("chimera/overload", [name, "clock.mode=lockstep", *settings])
    with Rack(config) as rack:
        digest = rack.run(0.5).digest
        segment = rack.segment
        cycles = {
            task.name: open_trace_ring(segment, task.name).read_new_rows().rows
            for task in segment.layout.tasks
        }
        counts = {task.name: segment.count_cycles(task, 250) for task in segment.layout.tasks}
        reason = open_observer(segment, "trajectory.status").peek().message.reason
    lost = Flag.MISSED | Flag.SKIPPED
    late = {
        name: rows["tick"][rows["flags"] & lost > 0].max(initial=-1)
        for name, rows in cycles.items()
    }
    return Ran({n: c.missed + c.skipped for n, c in counts.items()}, digest, reason, late)


@pytest.mark.thorough
def test_under_an_overload_urgency_alone_spares_the_critical_boards() -> None:
    fixed = run_overload()
    earliest = run_overload(EARLIEST)
    urgency = run_overload(URGENCY)
    # The slowest boards, of which one is critical.
    assert {board for board, missed in fixed.missed.items() if missed} == {"trajectory", "bridge"}
    # One late job delays the next: all miss.
    assert {board for board, missed in earliest.missed.items() if missed} == {*BOARDS}
    critical = {name for name, board in load("chimera/overload").board.items() if board.critical}
    assert critical == {"arm", "servo", "trajectory"}
    assert {board for board, missed in urgency.missed.items() if missed} == {*BOARDS} - critical
    assert run_overload(EARLIEST, attempt=2) == earliest


LESS, LEAST = (f"board.world.budget.process_ms={ms}" for ms in (2.4, 1.6))
LATE_BOARDS = (
    ((), 2),
    ((EARLIEST,), 5),
    ((URGENCY,), 2),
    ((LESS,), 0),
    ((EARLIEST, LESS), 0),
    ((URGENCY, LESS), 1),
    ((URGENCY, LEAST), 0),
)
"""Settings of the overload, which has fixed priorities, and the number of late boards."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "count"),
    [
        *LATE_BOARDS[:2],
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in LATE_BOARDS[2:]),
    ],
)
def test_the_check_predicts_which_boards_are_late_under_each_scheduler(
    settings: tuple[str, ...], count: int
) -> None:
    late = {board for board, missed in run_overload(*settings).missed.items() if missed}
    config = load("chimera/overload", ["clock.mode=lockstep", *settings])
    timing = build_rack_timing(config, resolve(config).layout)
    predicted = {response.task for response in timing.responses if not response.holds}
    assert late <= predicted
    assert bool(late) == bool(predicted)
    assert len(late) == count


@pytest.mark.slow
def test_without_an_overload_no_board_misses_a_deadline() -> None:
    assert set(run_overload(EARLIEST, "timing.lockstep_load=0.8").missed.values()) == {0}


CHANGE = [
    f"{{level='{board}', what='schedule', name='maximum-urgency-first', tick=100}}"
    for board in BOARDS
]


@pytest.mark.thorough
def test_schedulers_change_while_the_rack_runs_and_the_arm_goes_on_when_told() -> None:
    held = run_overload(EARLIEST)
    assert re.match("deadline missed before tick [0-9]+: `resume` of trajectory or", held.reason)
    changed = run_overload(EARLIEST, f"command=[{', '.join(CHANGE)}]")
    # Jobs that were late at the change may end late.
    assert max(changed.late[board] for board in ("arm", "servo", "trajectory")) <= 120
    assert changed.late["world"] > 200
    assert changed.reason == held.reason
    resume = "{level='trajectory', what='resume', tick=150}"
    gone_on = run_overload(EARLIEST, f"command=[{', '.join([*CHANGE, resume])}]")
    assert gone_on.reason == ""
    assert gone_on.late == changed.late


@pytest.mark.slow
def test_an_operator_changes_the_scheduler_of_a_starved_board(rack_name: str) -> None:
    config = load("chimera/overload", [f"name={rack_name}", "clock.mode=lockstep"])
    with Rack(config) as rack:
        rack.start(1000.0)
        block = rack.segment.get_block("bridge")
        wait_until(lambda: rack.segment.words[System.TICK] > 100)
        assert block[Block.CYCLES] == 0
        desk = LevelCommander(rack.segment)
        for board in BOARDS:
            command = {"level": board, "what": "schedule", "name": "maximum-urgency-first"}
            assert desk.give_command(command, wait=False).fate == "done"
        wait_until(lambda: block[Block.CYCLES] > 3)
        row = next(
            row for row in RackMonitor(rack.segment).take_snapshot().tasks if row.task == "bridge"
        )
        assert row.scheduler == "maximum-urgency-first"
        with pytest.raises(ConfigError) as error:
            desk.give_command({"level": "arm", "what": "schedule", "name": "fastest"}, wait=False)
        assert 'name = "fastest": no scheduler in this clock mode; valid: ' in str(error.value)
        rack.stop()


@pytest.mark.thorough
def test_the_comparison_is_the_one_on_the_page() -> None:
    script = Path(__file__).parents[1] / "configs/chimera/compare_schedulers.py"
    ran = run_to_end([sys.executable, script, f"name=compared-{os.getpid()}"], 120, check=True)
    assert ran.stdout in (script.parent / "README.md").read_text()
