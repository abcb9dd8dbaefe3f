"""Summary of a check.

It states whether the rack fits, its smallest margin, its response time, the abilities of its arm,
and the changes that would make it fit.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rack.boards.timing.forecast import NO_BUDGET, Forecast
from rack.boards.timing.response_time import compute_job_ns
from rack.boards.timing.verdicts import EQUATIONS, EquationVerdict
from rack.tools.console.tables import Blocks
from rack.tools.timing.repair import MAX_FACTOR, Fix
from rack.tools.timing.tables import build_verdict_table, format_side

if TYPE_CHECKING:
    # MuJoCo takes 0.5 s to import, therefore import it only for racks with an arm.
    from rack.levels.robot.abilities import Abilities

RESPONSES = "3.2", "3.3"
"""Equations of the response of the system."""
BAR_WIDTH = 16
"""Number of characters of a bar that shows the load of a core."""


def format_summary(forecast: Forecast, arm: Abilities | None, joints: Sequence[str]) -> Blocks:
    """Yield the summary as text for the terminal, with every verdict that fails.

    Args:
        forecast: Timing of the rack.
        arm: Abilities of the arm. None for a rack without one.
        joints: Names of the arm's joints.
    """
    yield from _format_cores(forecast)
    yield from find_tightest(forecast.verdicts)
    system = forecast.system
    if system.levels:
        yield (
            f"response: a command down {system.command_ms:g} ms, a status up"
            f" {system.status_ms:g} ms"
        )
    if arm is not None:
        yield (
            f"arm: its tool reaches {arm.reach:.2f} m, holds {arm.payload:.1f} kg at rest; gravity"
            f" leaves {arm.torque_left:.0%} of the torque of {joints[arm.joint]}"
        )
    if not forecast.holds:
        yield ""
        yield build_verdict_table(
            ("", verdict) for verdict in forecast.verdicts if not verdict.holds
        )
        yield ""


def format_fixes(fixes: Sequence[Fix], remaining: Sequence[EquationVerdict]) -> Iterator[str]:
    """Yield the fixes as options to append to the command, or the failures without a fix."""
    if fixes:
        yield "to make it fit, append one of these to the command, cheapest first:"
    elif remaining:
        names = dict.fromkeys(f"{verdict.equation} of {verdict.subject}" for verdict in remaining)
        yield (
            f"no change helps with {', '.join(names)}; tried: other priorities and cores, cycles"
            f" and plans up to {MAX_FACTOR} times as long"
        )
    for fix in fixes:
        yield "  " + shlex.join(word for text in fix.settings for word in ("--set", text))
        yield from (f"      {change.text}" for change in fix.changes)


def _format_cores(forecast: Forecast) -> Iterator[str]:
    """Yield a line for each core: its load as a bar, and the tasks that use most of it."""
    rack = forecast.rack
    for core in sorted({*rack.cores.values()}):
        load = rack.loads.get(core, 0.0)
        tasks = [
            (compute_job_ns(task, rack.context_switch_ns) / task.period_ns, task.name)
            for task in rack.tasks
            if task.core == core and task.cost_ns
        ]
        parts = [f"{name} {used:.0%}" for used, name in sorted(tasks, reverse=True)[:3]]
        parts += [
            f"{name} not counted" for name in forecast.uncounted if rack.cores.get(name) == core
        ]
        bar = "#" * min(int(load * BAR_WIDTH), BAR_WIDTH)
        yield f"core {core:<2} [{bar:.<{BAR_WIDTH}}] {load:6.1%}  {', '.join(parts)}"


def format_verdict(forecast: Forecast, measuring: Sequence[str]) -> Iterator[str]:
    """Yield lines that say whether the rack fits, and what the verdict does not include.

    Args:
        forecast: Timing of the rack.
        measuring: Commands that measure budgets. Empty if they were measured.
    """
    names: dict[str, list[str]] = {}
    for name, why in forecast.uncounted.items():
        names.setdefault(why, []).append(f"'{name}'")
    left_out = ", ".join(f"{', '.join(boards)} ({why})" for why, boards in names.items())
    count = len(forecast.verdicts)
    hold_text = f"all {count} equations and bounds hold; not counted: the recorder"
    if failing := sum(not verdict.holds for verdict in forecast.verdicts):
        yield f"does not fit: {failing} of {count} equations and bounds fail"
        if left_out:
            yield f"not counted: {left_out}"
    elif not forecast.rack.levels:
        yield "not known whether it fits: no board has a budget"
    elif left_out:
        yield f"fits, but {len(forecast.uncounted)} not counted: {left_out}"
        yield hold_text
    else:
        yield f"fits: {hold_text}"
    if NO_BUDGET in names and measuring:
        yield from ("to measure missing budgets:", *(f"  {command}" for command in measuring))


def find_tightest(verdicts: Sequence[EquationVerdict]) -> Iterator[str]:
    """Yield a line about the verdict with the smallest margin relative to its right side.

    Equalities are left out, because they have no margin, and so are the verdicts on the system
    response, because it is computed exactly.
    """
    bounds = [
        verdict
        for verdict in verdicts
        if verdict.sign != "=" and verdict.equation not in RESPONSES and verdict.right > 0.0
    ]
    if bounds:
        yield f"tightest: {format_margin(min(bounds, key=lambda each: each.margin / each.right))}"


def format_margin(verdict: EquationVerdict) -> str:
    """Format the margin of a verdict, such as "servo, eq. 3.1: 1 of 2.5 ms, 60% left"."""
    if verdict.endless:
        return verdict.endless
    criterion = verdict.equation
    if criterion in EQUATIONS:
        criterion = f"eq. {criterion}".replace("eq. fig.", "fig.")
    left_side = format_side(verdict.left, verdict.unit)
    right_side = format_side(verdict.right, verdict.unit)
    unit = " ms" if verdict.unit == "ns" else ""
    if verdict.right <= 0.0:
        return (
            f"{verdict.subject}, {criterion}: {left_side} {verdict.sign} {right_side}{unit} fails"
        )
    fraction = verdict.margin / verdict.right
    remainder = f"{fraction:.0%} left" if fraction >= 0.0 else f"{-fraction:.0%} too much"
    return f"{verdict.subject}, {criterion}: {left_side} of {right_side}{unit}, {remainder}"
