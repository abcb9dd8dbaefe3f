"""Simulated cores: what `rack check` says fits is never late in lockstep, and what does not is."""

from __future__ import annotations

import pytest

from rack.backplane.trace import open_trace_ring
from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import build_rack_timing, resolve
from rack.boards.timing.schedule import simulate_schedule
from rack.boards.timing.trace_times import compute_response_ns
from tests.boards.config.mistakes import find_mistake
from tests.boards.conftest import MakeConfig, format_figure


def format_rack(switch_ms: float, clock_ms: float, *boards: str) -> str:
    """Return a rack of boards that share a simulated core, and the times that are not theirs."""
    return f"""
format = 2
name = "shared-core"

[clock]
period_ms = 1.0
mode = "lockstep"
priority = 90
scheduler = "fixed-priority"

[timing]
lockstep_load = 1.0
context_switch_ms = {switch_ms}
clock_ms = {clock_ms}

{"".join(boards)}"""


LEVEL = """
[board.level]
slot = 2
every = 4
executor = "rack.levels.systems.figures:FigureExecutor"
planner = "rack.levels.systems.figures:FigurePlanner"
coupling = "tight"
within_cycles = 3
priority = 80
planner_priority = 40
params = { process_ms = 0.0, plan_ms = 0.0 }
budget = { process_ms = 0.9, plan_ms = 3.0, update_ms = 0.4 }
"""
RACK = format_rack(0.05, 0.1, LEVEL, format_figure("beside", 3, 1.4, every=6, priority=60))
"""With the clock and all context switches, the tasks need 0.992 of the core."""

EQUALS = format_rack(
    0.0,
    0.0,
    format_figure("one", 2, 2.5, every=4, priority=60),
    format_figure("two", 3, 2.5, every=4, priority=60),
)
"""Two tasks of equal priority that need 1.25 of their core."""
COUNT = 4
"""Cycles of each task until both wait for the core at a release."""

CRITICAL = 'protocol.mailbox={ "level.plan" = "lock" }'
ORDINARY = ("board.beside.priority=0", "board.level.planner_priority=0")
EARLIEST = "clock.scheduler=earliest-deadline-first"
URGENCY = "clock.scheduler=maximum-urgency-first"
LOOSE = ("board.level.coupling=loose", "board.level.planner_slot=4", "board.level.planner_core=0")


PLANNER = "level.planner"
LONG_PLAN = (*ORDINARY, "board.level.budget.plan_ms=11", "board.level.within_cycles=9")
ABOVE = ("board.level.planner_priority=70", "board.level.budget.plan_ms=1.2")
SETS = {
    "tight": ((), ()),
    "switches": (("timing.context_switch_ms=0.07",), (PLANNER,)),
    "clock": (("timing.clock_ms=0.2",), (PLANNER,)),
    "plan": (("board.level.budget.plan_ms=3.4",), (PLANNER,)),
    "update": ((CRITICAL,), ()),
    "long update": (
        (CRITICAL, "board.level.budget.plan_ms=0.1", "board.level.budget.update_ms=3.3"),
        ("level", "beside"),
    ),
    "planner above a board": (ABOVE, ("beside",)),
    "room for that board": ((*ABOVE, "board.beside.every=12"), ()),
    "turns": ((*ORDINARY, "board.beside.every=12"), ()),
    "turns of a long plan": (LONG_PLAN, ("beside", PLANNER)),
    "turns of a long plan with room": ((*LONG_PLAN, "board.beside.every=18"), ()),
    "deadlines": ((*LOOSE, EARLIEST), ()),
    "deadlines above a planner": (
        (*LOOSE, EARLIEST, "board.beside.budget.process_ms=1.6"),
        (PLANNER,),
    ),
    "urgency": ((URGENCY,), ()),
    "urgency above a planner": (
        (URGENCY, "board.level.critical=true", "board.level.budget.process_ms=1.0"),
        (PLANNER,),
    ),
}
"""Settings of the rack, and the tasks that do not fit."""


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "failing"), SETS.values(), ids=SETS)
def test_lockstep_agrees_with_the_check(
    config: MakeConfig, settings: tuple[str, ...], failing: tuple[str, ...]
) -> None:
    rack = config(*settings, text=RACK)
    predicted = {
        each.task: each for each in build_rack_timing(rack, resolve(rack).layout).responses
    }
    assert {each.task for each in predicted.values() if not each.holds} == {*failing}
    late = set()
    with Rack(rack) as crate:
        # A cycle of the long plan takes 36 ms.
        crate.run(0.2 if "board.level.within_cycles=9" in settings else 0.1)
        for task in crate.segment.layout.tasks:
            block = crate.segment.get_block(task.name)
            assert block[Block.CYCLES] > 3
            if block[Block.MISSED] + block[Block.SKIPPED]:
                late.add(task.name)
            elif bound_ns := predicted[task.name].response_ns:
                rows = open_trace_ring(crate.segment, task.name).read_new_rows().rows
                longest_ns = compute_response_ns(rows).max()
                assert 0 < longest_ns <= bound_ns
                # As the rack is, the longest response is the predicted one.
                assert settings or longest_ns == bound_ns
    assert late <= {*failing}
    assert bool(late) == bool(failing)


@pytest.mark.slow
def test_a_late_task_goes_on_before_others_of_its_priority(config: MakeConfig) -> None:
    rack = config(text=EQUALS)
    chart = simulate_schedule(build_rack_timing(rack, resolve(rack).layout).tasks, 30_000_000)
    with Rack(rack) as crate:
        crate.run(0.03)
        for name in rack.board:
            rows = open_trace_ring(crate.segment, name).read_new_rows().rows
            expected = [job.end_ns for job in chart.jobs if job.task == name and job.end_ns]
            ends = rows["end_ns"] - rows["release_ns"][0]
            # A job that ends with a tick ends 1 ns before, in it.
            assert ends[:COUNT] == pytest.approx(expected[:COUNT], abs=1)


def test_a_plan_without_a_budget_is_refused() -> None:
    none = (f"board.level.budget.{part}_ms=0" for part in ("plan", "update"))
    why = "board.level.budget.plan_ms: missing; a plan takes this time, times"
    assert why in find_mistake(RACK, *none)
