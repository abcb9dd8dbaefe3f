"""A config in the terms of the timing model: its budgets, and the tasks that it makes."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import build_rack_timing, load, load_text, read_budgets, resolve_layout
from rack.boards.config.timing import replace_budgets
from rack.boards.timing.tasks import Budget, Part, Unit
from tests.boards.config.mistakes import find_mistake

MEASURED = Budget(
    read_ns=10_123, process_ns=500_001, write_ns=7, exchange_ns=31, plan_ns=2_000_003, update_ns=11
)
WITHIN = "board.lower.budget={ process_ms = 1.5, plan_ms = 3, plan_within_ms = 20 }"


def test_budgets_are_whole_nanoseconds_by_board(small: Path) -> None:
    budget = "board.lower.budget={ read_ms = 0.1, process_ms = 1.25, update_ms = 0.000001 }"
    lower = Budget(read_ns=100_000, process_ns=1_250_000, update_ns=1)
    assert read_budgets(load(small, [budget])) == {"lower": lower}


def test_plan_within_ms_is_not_part_of_the_budget(small: Path) -> None:
    lower = Budget(process_ns=1_500_000, plan_ns=3_000_000)
    assert read_budgets(load(small, [WITHIN])) == {"lower": lower}


def test_budgets_written_to_a_config_are_read_back_unchanged(small: Path) -> None:
    upper = Budget(process_ns=3, exchange_ns=5)
    changed = load_text(
        replace_budgets(load(small, [WITHIN]), {"lower": MEASURED, "upper": upper}).to_toml_text()
    )
    # The upper level has no planner, and so no plan to read.
    assert read_budgets(changed) == {"lower": MEASURED, "upper": Budget(process_ns=3)}
    assert changed.board["lower"].budget is not None
    assert changed.board["lower"].budget.plan_within_ms == 20
    assert read_budgets(load_text(replace_budgets(changed, {}).to_toml_text())) == {}


@pytest.mark.slow
@pytest.mark.parametrize("table", ["budget", "transfer"])
@pytest.mark.parametrize("key", ["exchange_ms", "update_ms"])
def test_planner_times_without_a_planner_are_a_mistake(small: Path, table: str, key: str) -> None:
    upper, lower = f"board.upper.{table}.{key}", f"board.lower.{table}.{key}"
    assert find_mistake(small, f"{upper}=1.5").startswith(
        f"{upper} = 1.5: the board has no planner"
    )
    assert resolve_layout(load(small, [f"{upper}=0", f"{lower}=1.5"]))


def test_tasks_are_on_the_cores_that_the_config_requests(small: Path) -> None:
    settings = ["core=7", "coupling=loose", "planner_slot=9", "planner_core=11"]
    settings += ["budget.process_ms=1", "budget.plan_ms=2"]
    config = load(small, [f"board.lower.{setting}" for setting in settings])
    tasks = {task.name: task for task in build_rack_timing(config, resolve_layout(config)).tasks}
    assert {name: task.core for name, task in tasks.items()} == {"lower": 7, "lower.planner": 11}
    assert tasks["lower.planner"].parts == (Part(Unit.PLAN, 2_000_000),)
    assert (tasks["lower"].period_ns, tasks["lower.planner"].period_ns) == (2_500_000, 10_000_000)
