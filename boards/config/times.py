"""Tables of a rack's config for the timing model: processor times, and the static schedule."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rack.levels.tables import Positive, Table

Milliseconds = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
SHORTEST_MS = 0.01
"""Shortest tick, in real time and in simulated time."""


class TimingConfig(Table):
    """`[timing]`: assumptions of the timing model about the processors."""

    context_switch_ms: Milliseconds = 0.1
    """time of one context switch (t_cs) [ms]; the paper takes 0.1"""
    response_ms: float | None = Field(None, ge=SHORTEST_MS, le=1e9)
    """goal for the response time R_s of the system (eqs 3.2, 3.3) [ms]; simulated time; R_max is
    R_s / n"""
    clock_ms: Milliseconds = 0.0
    """processor time that the system clock's board needs per tick [ms]"""
    lockstep_load: float = Field(0.0, ge=0, le=1000)
    """in lockstep, each cycle and plan takes this multiple of its budget as simulated time, and two
    context switches, on cores under the boards' schedulers, which the config must name; with 0
    computing takes no simulated time"""
    small_share: float = Field(0.1, gt=0, le=1)
    """largest fraction of a cycle that counts as much smaller than the cycle (eq. 3.10)"""


class ScheduleConfig(Table):
    """`[schedule]`: static cyclic schedule of all boards; see `rack.boards.timing.frames`."""

    minor_ms: Positive
    """minor frame [ms]; a whole number of ticks that divides every board's cycle"""
    major_ms: Positive
    """major frame [ms]; a multiple of the minor frame and of every board's cycle"""


class BudgetConfig(Table):
    """`[board.<name>.budget]`: worst-case processor times of the level, for the timing model."""

    read_ms: Milliseconds = 0.0
    """R: read commands and statuses, per cycle [ms]"""
    process_ms: Milliseconds = 0.0
    """X: process, per cycle [ms]"""
    write_ms: Milliseconds = 0.0
    """W: write commands and statuses, per cycle [ms]"""
    exchange_ms: Milliseconds = 0.0
    """C: read the plan, per cycle [ms]"""
    plan_ms: Milliseconds = 0.0
    """P: plan, per plan [ms]"""
    update_ms: Milliseconds = 0.0
    """U: write the plan, per plan [ms]"""
    plan_within_ms: float | None = Field(None, gt=0, le=1e7)
    """longest acceptable time for a new plan [ms]; limits within_cycles"""
    send_within_ms: float | None = Field(None, gt=0, le=1e7)
    """interrupts are sent this long after a release [ms]; default: the worst-case response"""


class TransferConfig(Table):
    """`[board.<name>.transfer]`: least processor times of bus accesses, to emulate a slower bus."""

    read_ms: Milliseconds = 0.0
    """R: the executor reads commands and statuses, per cycle [ms]"""
    write_ms: Milliseconds = 0.0
    """W: the executor writes commands and statuses, per cycle [ms]"""
    exchange_ms: Milliseconds = 0.0
    """C: the executor reads the plan, per cycle [ms]"""
    update_ms: Milliseconds = 0.0
    """U: the planner writes its plan [ms]"""
