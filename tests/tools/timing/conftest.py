"""A rack of two levels with budgets for the timing model, which is never launched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.tools.timing.judged_config import JudgedConfig

BUDGETED = f"""
format = 2
name = "budgeted"
python_path = ["{Path(__file__).resolve().parents[2]}"]
clock = {{ period_ms = 2.5, core = 0, priority = 90 }}
timing.context_switch_ms = 0.1

[board.upper]
slot = 2
core = 0
rate_hz = 50
priority = 70
below = "lower"
executor = "two_levels:Upper"
budget = {{ read_ms = 1.0, process_ms = 2.0, write_ms = 1.0 }}

[board.lower]
slot = 3
core = 1
rate_hz = 100
priority = 80
above = "upper"
executor = "two_levels:Lower"
planner = "two_levels:LowerPlanner"
coupling = "tight"
within_cycles = 4
budget.read_ms = 0.5
budget.process_ms = 3.0
budget.write_ms = 0.5
budget.exchange_ms = 0.25
budget.plan_ms = 8.0
budget.update_ms = 0.5
"""
"""Lower: R 10 ms, t_exec 3, t_comm 1.25, t_residual 5.75, t_plan 8.5 within 4 cycles.

It fits, even within 2 cycles.
"""

Judge = Callable[..., JudgedConfig]


@pytest.fixture
def judge(tmp_path: Path) -> Judge:
    """Return a function that judges the rack with settings."""
    path = tmp_path / "budgeted.toml"
    path.write_text(BUDGETED)
    return lambda *settings: JudgedConfig.judge(load(path, settings))
