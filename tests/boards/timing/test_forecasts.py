"""What the timing model says of the shipped racks, with their budgets and with others: nothing of
it changes unseen."""

from __future__ import annotations

import os
from collections.abc import Iterable

import pytest

from rack.boards.config import load, resolve
from rack.boards.config.timing import build_rack_timing
from rack.boards.timing.command_path import find_command_paths
from rack.boards.timing.forecast import Forecast
from rack.boards.timing.frames import compute_core_frames
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.response_time import compute_loads, compute_task_responses
from rack.boards.timing.schedule import simulate_schedule
from rack.boards.timing.tasks import Budget
from tests.snapshots import QUICK, ROOT, SHIPPED, Snapshots

SNAPSHOTS = Snapshots(__file__)
SHARE = 0.3
"""Heavy budgets, beside the config's own: the share of a cycle that a part takes, about."""
PERIODS = 3


def budgets(rack: RackTiming) -> dict[str, Budget]:
    """Return budgets for all boards, each another."""
    found = {}
    for at, (name, board) in enumerate(rack.boards.items(), 1):
        cycle_ns = board.every * rack.clock_ns
        part = round(SHARE * cycle_ns / (at + 3))
        plan = part * board.within_cycles if board.has_planner else 0
        found[name] = Budget(
            read_ns=part // 2 + at,
            process_ns=part,
            write_ns=part // 3 + at,
            exchange_ns=part // 5 if board.has_planner else 0,
            plan_ns=plan,
            update_ns=part // 7 if board.has_planner else 0,
        )
    return found


def model(rack: RackTiming) -> Iterable[object]:
    cycles_ns = [task.every_ns * task.within_cycles for task in rack.tasks]
    until_ns = PERIODS * max(cycles_ns, default=rack.clock_ns)
    chart = simulate_schedule(rack.tasks, min(until_ns, 2_000_000_000), rack.context_switch_ns)
    responses = compute_task_responses(rack.tasks, rack.context_switch_ns)
    return [
        Forecast.from_rack(rack).to_document(),
        Forecast.from_rack(rack, has_cores=False).notes,
        rack.tasks,
        [frames.to_document() for frames in compute_core_frames(rack)],
        {found.task: found.response_ns for found in responses},
        compute_loads(rack.tasks, rack.context_switch_ns),
        chart,
        chart.cut_window(until_ns // 5, until_ns // 2),
        [chart.list_late_jobs(task.name) for task in rack.tasks],
        rack.longest_cycles,
        rack.ranks,
        rack.cores,
        [chains.text for chains in rack.chain_groups],
    ]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.thorough) for name in SHIPPED],
)
def test_the_timing_of_a_shipped_rack_is_as_before(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})
    plan = resolve(load(ROOT / "configs" / name))
    rack = build_rack_timing(plan.config, plan.layout)
    parts: dict[str, object] = {"own": model(rack), "paths": find_command_paths(rack, plan.layout)}
    parts[f"share {SHARE:g}"] = model(build_rack_timing(plan.config, plan.layout, budgets(rack)))
    SNAPSHOTS.check(name, parts)
